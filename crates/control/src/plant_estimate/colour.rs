//! Prediction of the residual of the fixes from its past: it may have a colour (a pump, the mains, a flow that wanders).
//!
//! All series of the regression pass the same filter, so it changes no gain. Without its predictable part a disturbance hides less of
//! the dither.

use super::evidence::{MEMORY_FIXES, part};
use super::motion::MEMBERS;

/// Order of the prediction: two for each of three lines, and two for a colour.
const ORDER: usize = 8;
/// Part of the variance that is taken for white: the relative error of a mean over [`MEMORY_FIXES`].
const WHITE: f64 = 1.0 / MEMORY_FIXES;

/// The series: fix, motion for each lag, instrument for each lag.
const SERIES: usize = 1 + 2 * MEMBERS;

/// The prediction and the past that it needs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Colour {
    correlations_um2: [f64; ORDER + 1],
    prediction: [f64; ORDER],
    /// Mean square of the prediction error, um^2.
    pub white_um2: f64,
    left_um: [f64; ORDER],
    past_um: [[f64; SERIES]; ORDER],
    fixes: f64,
}

impl Colour {
    pub(super) fn new(white_um2: f64) -> Self {
        let mut correlations_um2 = [0.0; ORDER + 1];
        correlations_um2[0] = white_um2;
        Self {
            correlations_um2,
            prediction: [0.0; ORDER],
            white_um2,
            left_um: [0.0; ORDER],
            past_um: [[0.0; SERIES]; ORDER],
            fixes: 0.0,
        }
    }

    /// Mean square of the residual, um^2.
    pub(super) fn usual_um2(&self) -> f64 {
        self.correlations_um2[0]
    }

    /// Removes the part that the past predicts from the series of a fix with this residual.
    pub(super) fn take_out(&mut self, series: &mut [f64; SERIES], left_um: f64) {
        let now = *series;
        for (past, part) in self.past_um.iter().zip(self.prediction) {
            series
                .iter_mut()
                .zip(past)
                .for_each(|(s, past)| *s -= part * past);
        }
        self.past_um.copy_within(0..ORDER - 1, 1);
        self.past_um[0] = now;
        // A model that is wrong along a reference is no disturbance.
        let chosen_um2 = (now.iter().skip(1 + MEMBERS)).fold(0.0_f64, |most, x| most.max(x * x));
        if chosen_um2 > self.white_um2 {
            return;
        }
        self.fixes += 1.0;
        let part = part(self.fixes, MEMORY_FIXES);
        let [own, others @ ..] = &mut self.correlations_um2;
        *own += part * (left_um * left_um - *own);
        for (mean, past) in others.iter_mut().zip(self.left_um) {
            *mean += part * (left_um * past - *mean);
        }
        self.left_um.copy_within(0..ORDER - 1, 1);
        self.left_um[0] = left_um;
    }

    /// The best prediction by the correlations so far (Levinson and Durbin).
    pub(super) fn solve(&mut self) {
        let r = &self.correlations_um2;
        let mut error = r[0] * (1.0 + WHITE);
        let mut a = [0.0; ORDER];
        for k in 0..ORDER {
            if error <= 0.0 {
                break;
            }
            let known: f64 = (0..k).map(|i| a[i] * r[k - i]).sum();
            let reflection = (r[k + 1] - known) / error;
            let before = a;
            for i in 0..k {
                a[i] = before[i] - reflection * before[k - 1 - i];
            }
            a[k] = reflection;
            error *= 1.0 - reflection * reflection;
        }
        (self.prediction, self.white_um2) = (a, error.max(0.0));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sine_is_predicted_and_white_noise_is_not() {
        for (amplitude, most) in [(0.0, 1.1), (10.0, 3.0)] {
            let mut colour = Colour::new(1.0);
            let (mut random, mut squares) = (cellpos_numeric::Random::new(1), 0.0);
            for k in 0..20_000 {
                let value = random.normal() + amplitude * (0.3 * f64::from(k)).sin();
                let mut series = [0.0; SERIES];
                series[0] = value;
                colour.take_out(&mut series, value);
                if k % 16 == 0 {
                    colour.solve();
                }
                if k >= 10_000 {
                    squares += series[0] * series[0] / 10_000.0;
                }
            }
            assert!((0.9..most).contains(&squares), "{amplitude}: {squares}");
        }
    }
}
