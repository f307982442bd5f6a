//! The noise of a bead's position record from the scatter at many lines: Brownian motion plus localisation noise.
//!
//! Increments of a record hold `2 D T` of Brownian motion at every frequency and `s^2 |1 - e^(-jwT)|^2` of localisation
//! noise. Two numbers fitted to the scatter of all lines have far more degrees of freedom than the scatter of one line,
//! so the weights are less noisy. If the two numbers do not describe the scatter (another rig, another disturbance),
//! the scatter is used as measured. Not for finding the cause of such a disturbance.

use nalgebra::Complex;

use crate::frequency_response::FrequencyPoint;
use cellpos_numeric::statistics::{chi2_exceeds, student_t_quantile};

/// Brownian motion plus localisation noise, as seen in position records.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NoiseModel {
    /// Diffusion coefficient, um^2/s (in units of the output squared per second).
    pub diffusion_um2_per_s: f64,
    /// Half-width of its 95 % interval, um^2/s.
    pub diffusion_ci95_um2_per_s: f64,
    /// Standard deviation of localisation, um.
    pub localisation_um: f64,
    /// Degrees of freedom behind the two numbers.
    pub dof: f64,
    /// Probability of a scatter at least this uneven if the model is correct.
    pub p_value: f64,
    /// Whether the model is used for the weights.
    pub used: bool,
}

/// Power of increments at `frequency_hz`: `|1 - e^(-j 2 pi f T)|^2`.
fn increment_power(frequency_hz: f64, period_s: f64) -> f64 {
    let angle = 2.0 * std::f64::consts::PI * frequency_hz * period_s;
    (1.0 - Complex::from_polar(1.0, -angle)).norm_sqr()
}

/// Fits the noise model to the scatter of `points`; if the model holds (p > 0.005), sets their `variance` from it.
pub fn apply_noise_model(points: &mut [FrequencyPoint], period_s: f64) -> Option<NoiseModel> {
    // Per point: scatter of increments per row, the localisation regressor, degrees of freedom.
    let data: Vec<(f64, f64, f64)> = points
        .iter()
        .filter(|p| p.scatter_variance > 0.0 && p.variance_dof >= 2.0)
        .map(|p| {
            let x = increment_power(p.frequency_hz, period_s);
            let shown = p.scatter_variance * p.input.norm_sqr() * x * p.rows as f64 / 4.0;
            (shown, x, p.block_errors.len() as f64 * 2.0 - 2.0)
        })
        .collect();
    let dof: f64 = data.iter().map(|d| d.2).sum();
    if data.len() < 3 || dof < 12.0 {
        return None;
    }
    let mean = data.iter().map(|d| d.0 * d.2).sum::<f64>() / dof;
    let (mut walk, mut white) = (mean, 0.0);
    let mut information = 0.0;
    for _ in 0..200 {
        // Scoring for gamma-distributed scatter: variance of a scatter is 2 S^2 / dof.
        let (mut a11, mut a12, mut a22, mut b1, mut b2) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for &(s, x, v) in &data {
            let level: f64 = walk + white * x;
            let weight = v / (2.0 * level * level);
            a11 += weight;
            a12 += weight * x;
            a22 += weight * x * x;
            b1 += weight * s;
            b2 += weight * x * s;
        }
        let determinant = a11 * a22 - a12 * a12;
        let (mut w, mut l) = (
            (b1 * a22 - b2 * a12) / determinant,
            (a11 * b2 - a12 * b1) / determinant,
        );
        if !(w.is_finite() && l.is_finite()) || determinant <= 1e-12 * a11 * a22 || l < 0.0 {
            (w, l) = (b1 / a11, 0.0);
        } else if w < 0.0 {
            (w, l) = (1e-6 * mean, b2 / a22);
        }
        let moved = (w - walk).abs() + (l - white).abs();
        (walk, white) = (w.max(1e-9 * mean), l);
        information = if l > 0.0 {
            (a11 * a22 - a12 * a12) / a22
        } else {
            a11
        };
        if moved < 1e-12 * mean {
            break;
        }
    }
    let deviance: f64 = data
        .iter()
        .map(|&(s, x, v)| {
            let r = s / (walk + white * x);
            v * (r - 1.0 - r.ln())
        })
        .sum();
    let p_value = chi2_exceeds(deviance, data.len() as f64 - 2.0);
    let used = p_value > 0.005;
    if used {
        for p in points.iter_mut() {
            let x = increment_power(p.frequency_hz, period_s);
            p.variance = 4.0 * (walk + white * x) / (p.rows as f64 * x * p.input.norm_sqr());
            p.variance_dof = dof;
        }
    }
    Some(NoiseModel {
        diffusion_um2_per_s: walk / (2.0 * period_s),
        diffusion_ci95_um2_per_s: student_t_quantile(0.975, dof)
            / information.sqrt()
            / (2.0 * period_s),
        localisation_um: white.sqrt(),
        dof,
        p_value,
        used,
    })
}
