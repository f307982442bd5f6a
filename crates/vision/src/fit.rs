//! One Gauss-Newton pass of the radial-template fit over a window.
//!
//! The model `grey = b + A f(r)` is linear in the amplitude `A` and the background `b`, so each pass solves the linear
//! least-squares problem in (A dx, A dy, A, b) with the columns (df/dx0, df/dy0, f, 1): the Gauss-Newton step without
//! a start value for A or b. The 4x4 normal matrix of the last pass is the Fisher information of the same four
//! parameters for normal noise, and its inverse their Cramer-Rao bound.

use crate::crop::{Crop, LANES, Row, STRIDE};
use crate::profile::Template;
use nalgebra::{Matrix2, Matrix4, Vector4};

/// How the noise of a pixel depends on its grey level.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Weights {
    /// The same variance everywhere, grey^2.
    Even { variance: f32 },
    /// `base + gain * (amplitude f(r))`, at least `floor`, with the model of the pass before (grey^2).
    Shot {
        base: f32,
        gain_times_amplitude: f32,
        floor: f32,
    },
}

/// What a pass found.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Pass {
    pub step_x_px: f64,
    pub step_y_px: f64,
    pub amplitude: f64,
    /// Above the crop's pedestal.
    pub background: f64,
    /// Weighted residual sum of squares after the step.
    pub chi2: f64,
    /// Covariance of the position, px^2.
    pub covariance: Matrix2<f64>,
}

/// Sums over the window, one lane each.
#[derive(Clone, Copy, Default)]
struct Sums {
    w: [f32; LANES],
    wf: [f32; LANES],
    wx: [f32; LANES],
    wy: [f32; LANES],
    wff: [f32; LANES],
    wxf: [f32; LANES],
    wyf: [f32; LANES],
    wxx: [f32; LANES],
    wxy: [f32; LANES],
    wyy: [f32; LANES],
    wp: [f32; LANES],
    wfp: [f32; LANES],
    wxp: [f32; LANES],
    wyp: [f32; LANES],
    wpp: [f32; LANES],
}

/// One pass at the position (`x_px`, `y_px`), frame coordinates. `None` when the normal matrix is singular.
pub(crate) fn pass(
    crop: &Crop,
    template: &Template,
    x_px: f64,
    y_px: f64,
    weights: Weights,
) -> Option<Pass> {
    let x = (x_px - crop.x0 as f64) as f32;
    let y = (y_px - crop.y0 as f64) as f32;
    let lanes_end = crop.width.next_multiple_of(LANES).min(STRIDE);
    let mut dx: Row = [0.0; STRIDE];
    for (i, d) in dx.iter_mut().enumerate() {
        *d = i as f32 - x;
    }
    let mut value: Row = [0.0; STRIDE];
    // Minus twice the derivative with respect to the squared radius: times dx it is the derivative by the centre.
    let mut inward: Row = [0.0; STRIDE];
    let mut weight: Row = crop.mask;
    if let Weights::Even { variance } = weights {
        weight.iter_mut().for_each(|w| *w /= variance);
    }
    let mut sums = Sums::default();
    for (j, pixels) in crop.rows.iter().enumerate().take(crop.height) {
        let dy = j as f32 - y;
        let dy2 = dy * dy;
        for ((v, g), d) in value.iter_mut().zip(&mut inward).zip(&dx).take(lanes_end) {
            let (f, df) = template.at(d * d + dy2);
            *v = f;
            *g = -2.0 * df;
        }
        if let Weights::Shot {
            base,
            gain_times_amplitude,
            floor,
        } = weights
        {
            for ((w, m), f) in weight
                .iter_mut()
                .zip(&crop.mask)
                .zip(&value)
                .take(lanes_end)
            {
                *w = m / (base + gain_times_amplitude * f).max(floor);
            }
        }
        sums.add_row(
            &weight[..lanes_end],
            &value[..lanes_end],
            &inward[..lanes_end],
            &dx,
            dy,
            pixels,
        );
    }
    sums.solve()
}

impl Sums {
    #[inline(always)]
    fn add_row(
        &mut self,
        weight: &[f32],
        value: &[f32],
        inward: &[f32],
        dx: &Row,
        dy: f32,
        pixels: &Row,
    ) {
        let chunks = weight
            .as_chunks::<LANES>()
            .0
            .iter()
            .zip(value.as_chunks::<LANES>().0);
        let chunks = chunks
            .zip(inward.as_chunks::<LANES>().0)
            .zip(dx.as_chunks::<LANES>().0);
        let mut s = *self;
        for ((((w, f), g), d), p) in chunks.zip(pixels.as_chunks::<LANES>().0) {
            for l in 0..LANES {
                let (w, f, p) = (w[l], f[l], p[l]);
                let fx = g[l] * d[l];
                let fy = g[l] * dy;
                let (wf, wx, wy, wp) = (w * f, w * fx, w * fy, w * p);
                s.w[l] += w;
                s.wf[l] += wf;
                s.wx[l] += wx;
                s.wy[l] += wy;
                s.wff[l] += wf * f;
                s.wxf[l] += wx * f;
                s.wyf[l] += wy * f;
                s.wxx[l] += wx * fx;
                s.wxy[l] += wx * fy;
                s.wyy[l] += wy * fy;
                s.wp[l] += wp;
                s.wfp[l] += wf * p;
                s.wxp[l] += wx * p;
                s.wyp[l] += wy * p;
                s.wpp[l] += wp * p;
            }
        }
        *self = s;
    }

    fn solve(&self) -> Option<Pass> {
        let t = |lanes: &[f32; LANES]| lanes.iter().map(|v| f64::from(*v)).sum::<f64>();
        let normal = Matrix4::new(
            t(&self.wxx),
            t(&self.wxy),
            t(&self.wxf),
            t(&self.wx), //
            t(&self.wxy),
            t(&self.wyy),
            t(&self.wyf),
            t(&self.wy), //
            t(&self.wxf),
            t(&self.wyf),
            t(&self.wff),
            t(&self.wf), //
            t(&self.wx),
            t(&self.wy),
            t(&self.wf),
            t(&self.w),
        );
        let right = Vector4::new(t(&self.wxp), t(&self.wyp), t(&self.wfp), t(&self.wp));
        let inverse = normal.cholesky()?.inverse();
        let solution = inverse * right;
        let amplitude = solution[2];
        let chi2 = t(&self.wpp) - solution.dot(&right);
        let pass = Pass {
            step_x_px: solution[0] / amplitude,
            step_y_px: solution[1] / amplitude,
            amplitude,
            background: solution[3],
            chi2,
            covariance: inverse.fixed_view::<2, 2>(0, 0) / (amplitude * amplitude),
        };
        let finite =
            pass.step_x_px.is_finite() && pass.step_y_px.is_finite() && pass.chi2.is_finite();
        finite.then_some(pass)
    }
}
