//! Offsets of the rows and columns of a window, as a camera reads them out: their variance from fix to fix, and their effect on
//! the position.

/// Offsets of separate rows or columns.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Lines {
    /// Variance between the means of neighbouring lines next to the bead, grey^2 ...
    between: f64,
    /// ... and what noise of variance 1 grey^2 contributes to it.
    of_noise: f64,
    /// Variance of the place (px^2) for lines of variance 1 grey^2.
    pub moves: f64,
}

impl Lines {
    /// Variance of the lines' offsets beyond noise of a variance; below 0 by chance.
    pub(crate) fn excess(&self, variance: f64) -> f64 {
        self.between - variance * self.of_noise
    }

    /// From the sums of each line next to the bead and their pixels, and the sums of the template's derivative along it.
    pub(crate) fn of(
        sums: &[f32],
        pixels: &[f32],
        derivative: &[f32],
        square: f64,
        amplitude: f32,
    ) -> Self {
        /// Fewest pixels of a line.
        const FEWEST: f32 = 4.0;
        let (mut between, mut of_noise, mut pairs) = (0.0_f32, 0.0_f32, 0.0_f32);
        for (sums, pixels) in sums.windows(2).zip(pixels.windows(2)) {
            if let ([a, b], [m, n]) = (sums, pixels)
                && *m >= FEWEST
                && *n >= FEWEST
            {
                let difference = a / m - b / n;
                between += 0.5 * difference * difference;
                of_noise += 0.5 * (1.0 / m + 1.0 / n);
                pairs += 1.0;
            }
        }
        let pairs = pairs.max(1.0);
        let along = derivative.iter().map(|d| f64::from(d * d)).sum::<f64>();
        let slope = square * f64::from(amplitude);
        Lines {
            between: f64::from(between / pairs),
            of_noise: f64::from(of_noise / pairs),
            moves: along / (slope * slope).max(1e-12),
        }
    }
}
