//! Records of a closed loop: a test whether the input answers the output, and a response without bias if it does.
//!
//! With feedback, the input contains the output's noise. If the noise outweighs the excitation, cross-spectrum over input
//! spectrum tends to minus the inverse of the controller, and averaging does not help. A noise-free signal, the reference or an
//! added excitation, separates plant and controller. Input and output are both projected on it, and the ratio of the projections
//! is the plant's response (joint input-output method, instrumental variable).

pub use crate::spectral::by_reference;
use nalgebra::{DMatrix, DVector};

/// Whether the input of a record answers its output.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Feedback {
    /// Fraction of the input's change that the output's past predicts beyond the input's past.
    pub share: f64,
    /// The test's F statistic.
    pub f: f64,
}

impl Feedback {
    /// Whether that is significant, and large enough to bias an estimate.
    pub fn is_there(self) -> bool {
        self.share > 0.05 && self.f > 10.0
    }
}

/// Tests for feedback: does the past of the output help to predict the input, beyond the input's own past (Granger)? Skips rows
/// without an output. None if the record is too short or its input hardly moves.
pub fn feedback(input: &[f64], output: &[f64]) -> Option<Feedback> {
    const LAGS: usize = 8;
    const MOST_ROWS: usize = 40_000;
    let n = input.len().min(output.len());
    let mut rows = Vec::new();
    for k in LAGS + 2..n {
        // The row's own output is known before its command takes effect.
        if output[k - LAGS - 1..=k].iter().all(|y| y.is_finite()) {
            rows.push(k);
        }
        if rows.len() >= MOST_ROWS {
            break;
        }
    }
    if rows.len() < 20 * LAGS {
        return None;
    }
    let du = |k: usize| input[k] - input[k - 1];
    let dy = |k: usize| output[k] - output[k - 1];
    let target = DVector::from_iterator(rows.len(), rows.iter().map(|&k| du(k)));
    let full = DMatrix::from_fn(rows.len(), 2 * LAGS + 1, |i, j| match j {
        0 => 1.0,
        j if j <= LAGS => du(rows[i] - j),
        j => dy(rows[i] - (j - LAGS - 1)),
    });
    let own = full.columns(0, LAGS + 1).into_owned();
    let left = |x: &DMatrix<f64>| -> Option<f64> {
        let mut normal = x.transpose() * x;
        // A pure sine makes its past linearly dependent; this regularisation does not change the prediction.
        let scale = normal.diagonal().max().max(f64::MIN_POSITIVE);
        for i in 0..normal.nrows() {
            normal[(i, i)] += 1e-12 * scale;
        }
        let solution = normal.cholesky()?.solve(&(x.transpose() * &target));
        Some((&target - x * solution).norm_squared())
    };
    let (own, both) = (left(&own)?, left(&full)?);
    let moved = target.norm_squared();
    if own <= 1e-9 * moved || own <= 0.0 {
        // The input's past predicts it completely, so the output can explain nothing more.
        return Some(Feedback { share: 0.0, f: 0.0 });
    }
    let freedom = (rows.len() - 2 * LAGS - 1) as f64;
    Some(Feedback {
        share: 1.0 - both / own,
        f: (own - both) / LAGS as f64 / (both.max(1e-12 * own) / freedom),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frequency_response::FrequencyPoint;
    use crate::spectral::welch;
    use cellpos_numeric::Random;
    use nalgebra::Complex;
    use std::f64::consts::TAU;

    /// A bead with drift-free Brownian motion under a PI, the reference white within some hertz; gain 400/s at 1 kHz, one row
    /// of delay.
    fn closed_loop(reference_um: f64, rows: usize) -> [Vec<f64>; 3] {
        let mut random = Random::new(4);
        let (mut r, mut u, mut y) = (Vec::new(), Vec::new(), Vec::new());
        let (mut x, mut integral, mut slow, mut command) = (0.0, 0.0, 0.0, 0.0);
        for _ in 0..rows {
            slow += 0.1 * (reference_um * random.normal() - slow);
            let seen = x + 0.01 * random.normal();
            x += 0.4 * command + 0.025 * random.normal();
            let e = slow - seen;
            integral += 0.005 * e;
            command = 0.4 * e + integral;
            r.push(slow);
            y.push(seen);
            u.push(command);
        }
        [r, u, y]
    }

    #[test]
    fn feedback_is_found_where_it_is_and_not_where_the_input_goes_its_own_way() {
        let [_, u, y] = closed_loop(0.0, 8000);
        let found = feedback(&u, &y).unwrap();
        assert!(found.is_there() && found.share > 0.5, "{found:?}");
        let mut random = Random::new(9);
        let mut x = 0.0;
        let (mut u, mut y) = (Vec::new(), Vec::new());
        for k in 0..8000 {
            let noise = 0.3 * random.normal();
            u.push((TAU * 7.0 * f64::from(k) * 1e-3).sin() + noise);
            y.push(x + 0.01 * random.normal());
            x += 0.4 * (u[u.len() - 1] - 0.001 * x) + 0.025 * random.normal();
        }
        let none = feedback(&u, &y).unwrap();
        assert!(!none.is_there(), "{none:?}");
        assert_eq!(feedback(&u[..50], &y[..50]), None);
    }

    #[test]
    fn by_way_of_the_reference_the_response_is_the_plants_and_by_the_input_it_is_not() {
        let [r, u, y] = closed_loop(0.5, 60_000);
        let exact = |hz: f64| {
            let z = Complex::from_polar(1.0, TAU * hz * 1e-3);
            0.4 / (z - 1.0)
        };
        let off = |points: &[FrequencyPoint], low: f64, high: f64| {
            let of = points
                .iter()
                .filter(|p| (low..high).contains(&p.frequency_hz));
            let (sum, n) = of.fold((0.0, 0.0), |(sum, n), p| {
                let ratio = p.response / exact(p.frequency_hz) - 1.0;
                (sum + ratio.norm(), n + 1.0)
            });
            (sum / n, n)
        };
        let right = by_reference(&r, &u, &y, 1e-3, 2048, 0.3);
        let (error, n) = off(&right, 2.0, 30.0);
        assert!(n > 15.0 && error < 0.15, "{error} of {n} points");
        let wrong = welch(&u, &y, 1e-3, 2048, 0.0, false);
        let (bias, _) = off(&wrong, 100.0, 300.0);
        assert!(bias > 0.3, "{bias}: the input alone tells the controller");
    }
}
