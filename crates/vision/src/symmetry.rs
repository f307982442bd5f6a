//! Positions without a template: radial symmetry and thresholded centroid, as fallback and for comparison.

use crate::config::Polarity;
use crate::crop::Crop;
use crate::frame::Frame;

/// Centre of radial symmetry of the window of side `side_px` about (`x_px`, `y_px`): the point nearest to all lines
/// through the pixel corners along the intensity gradient (Parthasarathy, Nature Methods 9, 724, 2012).
///
/// Works for any profile, bright or dark, and needs no template; its error is above the Cramer-Rao bound and its
/// covariance is not known. Allocates nothing. `None` without any gradient or off the frame.
#[derive(Debug, Clone)]
pub struct RadialSymmetry {
    crop: Crop,
    side_px: usize,
}

impl RadialSymmetry {
    /// Buffers for windows of side `side_px` (at most [`crate::config::MAX_WINDOW_PX`]).
    pub fn new(side_px: usize) -> Self {
        RadialSymmetry {
            crop: Crop::new(),
            side_px,
        }
    }

    /// Centre of symmetry (px) of the window about (`x_px`, `y_px`).
    pub fn locate(&mut self, frame: &Frame, x_px: f64, y_px: f64) -> Option<(f64, f64)> {
        if !self.crop.take(frame, x_px, y_px, self.side_px) {
            return None;
        }
        let c = &self.crop;
        let (width, height) = (c.width, c.height);
        // Weights fall with the distance to the centroid of the gradient's magnitude.
        let (mut g_sum, mut gx_sum, mut gy_sum) = (0.0, 0.0, 0.0);
        self.gradients(|x, y, u, v| {
            let g2 = u * u + v * v;
            g_sum += g2;
            gx_sum += g2 * x;
            gy_sum += g2 * y;
        });
        if g_sum <= 0.0 || width < 5 || height < 5 {
            return None;
        }
        let (cx, cy) = (gx_sum / g_sum, gy_sum / g_sum);
        let (mut sxx, mut sxy, mut syy, mut bx, mut by) = (0.0, 0.0, 0.0, 0.0, 0.0);
        self.gradients(|x, y, u, v| {
            let g2 = u * u + v * v;
            if g2 <= 0.0 {
                return;
            }
            let w = g2 / f64::hypot(x - cx, y - cy).max(0.5);
            // Distance to the line through (x, y) along (u, v): the component along the normal (-v, u) / |g|.
            let (nx, ny) = (-v, u);
            let p = nx * x + ny * y;
            let w = w / g2;
            sxx += w * nx * nx;
            sxy += w * nx * ny;
            syy += w * ny * ny;
            bx += w * nx * p;
            by += w * ny * p;
        });
        let determinant = sxx * syy - sxy * sxy;
        let x = (syy * bx - sxy * by) / determinant;
        let y = (sxx * by - sxy * bx) / determinant;
        let found = (c.x0 as f64 + x, c.y0 as f64 + y);
        (found.0.is_finite() && found.1.is_finite()).then_some(found)
    }

    /// Visits the corners between pixels: position in the window and gradient, smoothed over 3 x 3 corners.
    fn gradients(&self, mut visit: impl FnMut(f64, f64, f64, f64)) {
        let c = &self.crop;
        // A corner's diagonal differences, summed over its neighbours: what remains of a 3 x 3 sum of differences are
        // differences of pixels three apart, summed along the diagonals.
        for (j, rows) in c
            .rows
            .windows(4)
            .enumerate()
            .take(c.height.saturating_sub(3))
        {
            let [r0, r1, r2, r3] = rows else { continue };
            for i in 0..c.width.saturating_sub(3) {
                let at = |r: &crate::crop::Row, k: usize| r.get(i + k).copied().unwrap_or(0.0);
                let right = at(r0, 3) + 2.0 * (at(r1, 3) + at(r2, 3)) + at(r3, 3);
                let left = at(r0, 0) + 2.0 * (at(r1, 0) + at(r2, 0)) + at(r3, 0);
                let bottom = at(r3, 0) + 2.0 * (at(r3, 1) + at(r3, 2)) + at(r3, 3);
                let top = at(r0, 0) + 2.0 * (at(r0, 1) + at(r0, 2)) + at(r0, 3);
                let (u, v) = (f64::from(right - left), f64::from(bottom - top));
                visit(i as f64 + 1.5, j as f64 + 1.5, u, v);
            }
        }
    }

    /// Centroid of what exceeds half the largest contrast in the same window.
    pub fn threshold_centroid(
        &mut self,
        frame: &Frame,
        x_px: f64,
        y_px: f64,
        polarity: Polarity,
        radius_px: f64,
    ) -> Option<(f64, f64)> {
        if !self.crop.take(frame, x_px, y_px, self.side_px) {
            return None;
        }
        self.crop.centroid(polarity.sign() as f32, radius_px)
    }
}
