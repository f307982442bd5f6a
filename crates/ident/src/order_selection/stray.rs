//! Delays that stray from line to line: a board's output has steps, and where in a step a command comes wanders.

use super::{CandidateFits, OrderSelection};
use crate::error::IdentError;
use crate::frequency_response::FrequencyPoint;
use std::f64::consts::TAU;

/// Halvings of the range in which the standard deviation is looked for.
const HALVINGS: usize = 7;

/// Weights of the real data of each point: of gain, and of phase, in which a delay shows that strays by `stray_s`.
pub(super) fn weights(points: &[FrequencyPoint], stray_s: f64) -> Vec<[f64; 2]> {
    let of = |p: &FrequencyPoint| {
        let strays = TAU * p.frequency_hz * stray_s * p.response.norm();
        [0.0, strays].map(|sd| (0.5 * p.variance + sd * sd).sqrt().recip())
    };
    points.iter().map(of).collect()
}

impl OrderSelection<'_> {
    /// The problem and its fit, with a delay of each line that strays about the common one. By how much the phases' residuals tell: they
    /// become as large as the noise makes them (the moment estimate of Paule and Mandel, 1982, of a variance between groups). `most_s` is the
    /// largest standard deviation that is possible; what is left with it is something else.
    ///
    /// # Errors
    /// Those of [`OrderSelection::fit`].
    pub fn fit_straying(mut self, most_s: f64) -> Result<(Self, CandidateFits), IdentError> {
        let (fits, beyond) = self.fit_with(0.0)?;
        if !beyond {
            return Ok((self, fits));
        }
        let (mut fits, beyond) = self.fit_with(most_s)?;
        if beyond {
            return Ok((self, fits));
        }
        let (mut least_s, mut most_s) = (0.0, most_s);
        for _ in 0..HALVINGS {
            let middle_s = 0.5 * (least_s + most_s);
            let (found, beyond) = self.fit_with(middle_s)?;
            if beyond {
                least_s = middle_s;
            } else {
                (most_s, fits) = (middle_s, found);
            }
        }
        self.set_stray(most_s);
        Ok((self, fits))
    }

    /// Standard deviation of each line's delay about the common one, s.
    pub fn stray_s(&self) -> f64 {
        self.stray_s
    }

    fn set_stray(&mut self, stray_s: f64) {
        self.stray_s = stray_s;
        self.weights = weights(self.points, stray_s);
    }

    /// The fit with delays that stray so, and whether the phases of its residuals exceed the noise.
    fn fit_with(&mut self, stray_s: f64) -> Result<(CandidateFits, bool), IdentError> {
        self.set_stray(stray_s);
        let fits = self.fit()?;
        // Weights from few blocks make residuals larger by the variance of Student's t.
        let of = |p: &FrequencyPoint| match p.variance_dof {
            dof if dof > 2.5 => dof / (dof - 2.0),
            _ => 1.0,
        };
        let noise = self.points.iter().map(of).sum::<f64>() / self.points.len() as f64;
        let best = fits.best();
        let mut residuals = vec![0.0; self.rows()];
        self.residuals(&self.data(), &best.model, &mut residuals);
        let of_phase = residuals[..2 * self.points.len()].iter().skip(1).step_by(2);
        let beyond = of_phase.map(|r| r * r).sum::<f64>() > 0.5 * best.dof * noise;
        Ok((fits, beyond))
    }
}
