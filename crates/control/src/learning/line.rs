//! What is known of one harmonic of the addition, and how a stretch of ticks corrects it.

use super::config::HarmonicResponse;
use super::evidence::{Driven, ErrorNoise, Evidence};
use nalgebra::Complex;

/// Variances by which an error must stand out before it is learned: noise does it in one look of 8000.
const SURE: f64 = 9.0;
/// Variances that an addition must save, or it is given up.
const PAYS: f64 = 2.0;
/// Part of the bound on a response's uncertainty that is its standard uncertainty.
const STANDARD: f64 = 0.5;
/// Part of what another run learned that may be wrong in this one.
const OTHER_RUN: f64 = 0.2;

/// What is known of a harmonic.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Line {
    /// Addition, um of PZT, and its source while it changes.
    pub theta: Complex<f64>,
    pub from: Complex<f64>,
    /// It is being learned.
    pub active: bool,
    /// Variance of the error that is left, um^2.
    pub variance_um2: f64,
}

impl Line {
    /// What another run learned.
    pub(super) fn of_another_run(theta: Complex<f64>, response: Option<&HarmonicResponse>) -> Self {
        let size = |r: &HarmonicResponse| r.re_um_per_um.hypot(r.im_um_per_um) * theta.norm();
        Self {
            theta,
            from: theta,
            active: true,
            variance_um2: response.map_or(0.0, |r| (OTHER_RUN * size(r)).powi(2)),
        }
    }

    /// One harmonic at the end of a stretch.
    pub(super) fn correct(
        &mut self,
        response: &HarmonicResponse,
        evidence: &Evidence,
        noise: &ErrorNoise,
        (advance, floor, most): (f64, f64, f64),
        driven: &Driven,
    ) {
        let h = response.harmonic;
        let found = evidence.error(h, advance);
        let variance_um2 = evidence.variance_um2(h, advance, noise);
        let above_um2 = found.norm_sqr() - variance_um2;
        let surely = found.norm_sqr() > SURE * variance_um2;
        if !self.active && !surely {
            return;
        }
        let mut before_um2 = if self.active { self.variance_um2 } else { 0.0 };
        if surely {
            before_um2 = before_um2.max(above_um2);
        }
        let part = (before_um2 / (before_um2 + variance_um2)).max(floor);
        let t = Complex::new(response.re_um_per_um, response.im_um_per_um) * driven.gain;
        let corrected = found * part;
        self.theta += evidence.forward_over(h, driven.feed_forward_gain) - corrected / t;
        let uncertain = STANDARD * response.relative_uncertainty;
        self.variance_um2 = (1.0 - part).powi(2) * before_um2
            + part * part * variance_um2
            + uncertain * uncertain * corrected.norm_sqr();
        self.theta = Complex::new(
            self.theta.re.clamp(-most, most),
            self.theta.im.clamp(-most, most),
        );
        let saved_um2 = (t * self.theta).norm_sqr();
        self.active = saved_um2 > PAYS * part * variance_um2;
        if !self.active {
            *self = Self::default();
        }
    }
}
