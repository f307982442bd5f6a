//! The result of localising a bead in one frame.

/// Whether a fix can be used, and if not, why.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum FixQuality {
    /// The position and its covariance are valid.
    Good = 0,
    /// Nothing stands out of the background by the required signal-to-noise ratio.
    NoSignal = 1,
    /// Something is there, but it does not look like the template (another object, two beads merged, out of focus).
    BadFit = 2,
    /// The bead is cut by the border of the frame.
    AtBorder = 3,
    /// The fit did not converge.
    NotConverged = 4,
}

/// Position of a bead in one frame, in pixels, with its covariance and the figures behind the verdict.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fix {
    /// Position along the row, px.
    pub x_px: f64,
    /// Position along the column, px.
    pub y_px: f64,
    /// Variance of `x_px`, px^2, from the Fisher information of the template.
    pub var_x_px2: f64,
    /// Variance of `y_px`, px^2.
    pub var_y_px2: f64,
    /// Covariance of `x_px` and `y_px`, px^2.
    pub cov_xy_px2: f64,
    /// Peak contrast of the fitted template, grey levels.
    pub amplitude: f64,
    /// Fitted background, grey levels.
    pub background: f64,
    /// Residual sum of squares over the noise's prediction (chi^2 per degree of freedom): about 1 for a true bead.
    pub residual_ratio: f64,
    /// Peak contrast over the noise of one pixel.
    pub snr: f64,
    /// Used share of the settings' range: near 0 for a bead like those of the settings, 1 if a bead is no longer a good fix. The
    /// larger of the shares that noise and shape use. Measured for good fixes.
    pub range_used: f64,
    /// Whether the fix can be used.
    pub verdict: FixQuality,
}

impl Fix {
    /// A fix without a position: the place looked at and the reason.
    pub fn none(x_px: f64, y_px: f64, verdict: FixQuality) -> Self {
        Fix {
            x_px,
            y_px,
            var_x_px2: f64::INFINITY,
            var_y_px2: f64::INFINITY,
            cov_xy_px2: 0.0,
            amplitude: 0.0,
            background: 0.0,
            residual_ratio: 0.0,
            snr: 0.0,
            range_used: 0.0,
            verdict,
        }
    }
}

/// Square of a distance. Each bead is compared with each other one: a root, or `hypot`, would be most of the time of many beads.
pub(crate) fn squared(dx: f64, dy: f64) -> f64 {
    dx * dx + dy * dy
}
