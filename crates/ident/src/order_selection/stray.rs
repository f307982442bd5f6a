//! Delays that stray from line to line: a board's output has steps, and where in a step a command comes wanders.

use super::{CandidateFits, OrderSelection, noise_of_weight};
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
    /// The problem and its fit, with a delay of each line that strays about the common one. The residuals of the phases tell by how much:
    /// with it they are as large as the noise makes them. This is the moment estimate of a variance between groups (Paule and Mandel,
    /// 1982). `most_s` is the largest standard deviation that is possible; residuals that exceed the noise even then have another cause.
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
        let of_weights = self.points.iter().map(|p| noise_of_weight(p.variance_dof));
        let noise = of_weights.sum::<f64>() / self.points.len() as f64;
        let best = fits.best();
        let mut residuals = vec![0.0; self.rows()];
        self.residuals(&self.data(), &best.model, &mut residuals);
        let of_phase = residuals[..2 * self.points.len()].iter().skip(1).step_by(2);
        let beyond = of_phase.map(|r| r * r).sum::<f64>() > 0.5 * best.dof * noise;
        Ok((fits, beyond))
    }
}
