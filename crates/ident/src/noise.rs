//! The noise of a bead's position record from the scatter at many lines: Brownian motion, localisation noise, and commands that come at
//! uneven times.
//!
//! Increments of a record hold `2 D T` of Brownian motion at every frequency and `s^2 |1 - e^(-jwT)|^2` of localisation
//! noise. A command that comes `d` late moves the bead by `d` times the change of its velocity less, for good: with a standard deviation
//! `t` of that time, increments hold `t^2` times the mean square of that change, which each segment knows of its own bead. Three numbers
//! fitted to the scatter of all lines have far more degrees of freedom than the scatter of one line, so the weights are less noisy. If
//! they do not describe the scatter (another rig, another disturbance), the scatter is used as measured. Not for finding the cause of
//! such a disturbance.

use nalgebra::{Complex, DMatrix, DVector};

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
    /// Standard deviation of the times at which commands act, s; 0 if the lines cannot tell it from Brownian motion: all in one segment.
    pub timing_s: f64,
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

/// Mean square of the change of the bead's velocity from row to row that `points` of one segment show, (um/s)^2.
pub(crate) fn velocity_changes(points: &[FrequencyPoint], period_s: f64) -> f64 {
    let of = |p: &FrequencyPoint| {
        let x = increment_power(p.frequency_hz, period_s);
        0.5 * p.output.norm_sqr() * (x / period_s).powi(2)
    };
    points.iter().map(of).sum()
}

/// The scatter of increments at a line, um^2 a row, as it was measured.
struct Scatter {
    um2: f64,
    /// Shares of Brownian motion, localisation noise and timing in it.
    shares: [f64; 3],
    dof: f64,
}

/// Levels of the three kinds of noise, none below 0, and what is known of them.
struct Levels {
    levels: [f64; 3],
    /// Fisher's information on the first level, the others unknown.
    information: f64,
    deviance: f64,
}

/// Sum of the noises in a scatter, um^2 a row.
fn sum(levels: &[f64; 3], shares: &[f64; 3]) -> f64 {
    levels.iter().zip(shares).map(|(l, s)| l * s).sum()
}

/// The likeliest levels of the noises `kinds` (a scatter is gamma-distributed, of variance `2 S^2 / dof`); `None` if the lines do not
/// tell them apart or a level would be negative.
fn levels(data: &[Scatter], kinds: &[usize]) -> Option<Levels> {
    let n = kinds.len();
    let dof: f64 = data.iter().map(|d| d.dof).sum();
    let mean = data.iter().map(|d| d.um2 * d.dof).sum::<f64>() / dof;
    let mut found = Levels {
        levels: [0.0; 3],
        information: 0.0,
        deviance: 0.0,
    };
    // Begin where each kind has its share of the mean.
    for &kind in kinds {
        let share = data.iter().map(|d| d.shares[kind] * d.dof).sum::<f64>() / dof;
        found.levels[kind] = mean / (share * n as f64);
    }
    let mut information = DMatrix::zeros(n, n);
    for _ in 0..200 {
        information.fill(0.0);
        let mut right = DVector::<f64>::zeros(n);
        for d in data {
            let weight = d.dof / (2.0 * sum(&found.levels, &d.shares).powi(2));
            for (i, &a) in kinds.iter().enumerate() {
                right[i] += weight * d.shares[a] * d.um2;
                for (j, &b) in kinds.iter().enumerate() {
                    information[(i, j)] += weight * d.shares[a] * d.shares[b];
                }
            }
        }
        let next = information.clone().cholesky()?.solve(&right);
        // A step that leaves a scatter without variance is taken in part. No part of one that is no number will do.
        let in_part = |halvings: i32| {
            let mut levels = found.levels;
            for (i, &kind) in kinds.iter().enumerate() {
                levels[kind] += 0.5_f64.powi(halvings) * (next[i] - levels[kind]);
            }
            let all_vary = data.iter().all(|d| sum(&levels, &d.shares) > 0.0);
            all_vary.then_some(levels)
        };
        let stepped = (0..52).find_map(in_part)?;
        let change = |&kind: &usize| (stepped[kind] / found.levels[kind] - 1.0).abs();
        let moved: f64 = kinds.iter().map(change).sum();
        found.levels = stepped;
        if moved < 1e-9 {
            break;
        }
    }
    if kinds.iter().any(|&kind| found.levels[kind] < 0.0) {
        return None;
    }
    found.information = 1.0 / information.try_inverse()?[(0, 0)];
    found.deviance = data
        .iter()
        .map(|d| {
            let r = d.um2 / sum(&found.levels, &d.shares);
            d.dof * (r - 1.0 - r.ln())
        })
        .sum();
    Some(found)
}

/// Fits the noise model to the scatter of `points`; if the model holds (p > 0.005), sets their `variance` from it.
pub fn apply_noise_model(points: &mut [FrequencyPoint], period_s: f64) -> Option<NoiseModel> {
    let data: Vec<Scatter> = points
        .iter()
        .filter(|p| p.scatter_variance > 0.0 && p.variance_dof >= 2.0)
        .map(|p| {
            let x = increment_power(p.frequency_hz, period_s);
            Scatter {
                um2: p.scatter_variance * p.input.norm_sqr() * x * p.rows as f64 / 4.0,
                shares: [1.0, x, p.velocity_changes],
                dof: p.block_errors.len() as f64 * 2.0 - 2.0,
            }
        })
        .collect();
    let dof: f64 = data.iter().map(|d| d.dof).sum();
    if data.len() < 3 || dof < 12.0 {
        return None;
    }
    // Lines of one segment saw one timing: the share of Brownian motion again.
    let most = data.iter().map(|d| d.shares[2]).fold(0.0, f64::max);
    let apart = data.iter().any(|d| d.shares[2] < 0.99 * most);
    let kinds: &[&[usize]] = match apart {
        true => &[&[0], &[0, 1], &[0, 2], &[0, 1, 2]],
        false => &[&[0], &[0, 1]],
    };
    // The likeliest of those without a negative level is that of all levels from 0 on.
    let found = kinds.iter().filter_map(|kinds| levels(&data, kinds));
    let found = found.min_by(|a, b| a.deviance.total_cmp(&b.deviance))?;
    let free = found.levels.iter().filter(|&&level| level > 0.0).count();
    let p_value = chi2_exceeds(
        found.deviance,
        (data.len() - free.min(data.len() - 1)) as f64,
    );
    let used = p_value > 0.005;
    if used {
        for p in points.iter_mut() {
            let x = increment_power(p.frequency_hz, period_s);
            let level = sum(&found.levels, &[1.0, x, p.velocity_changes]);
            p.variance = 4.0 * level / (p.rows as f64 * x * p.input.norm_sqr());
            p.variance_dof = dof;
        }
    }
    let [walk, white, timing] = found.levels;
    Some(NoiseModel {
        diffusion_um2_per_s: walk / (2.0 * period_s),
        diffusion_ci95_um2_per_s: student_t_quantile(0.975, dof)
            / found.information.sqrt()
            / (2.0 * period_s),
        localisation_um: white.sqrt(),
        timing_s: timing.sqrt(),
        dof,
        p_value,
        used,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD_S: f64 = 1e-3;

    /// Lines whose scatter is that of 0.33 um^2/s, fixes of 10 nm and commands that come at times off by 0.2 ms.
    fn lines(velocity_changes: impl Fn(usize) -> f64) -> Vec<FrequencyPoint> {
        let point = |(i, frequency_hz): (usize, f64)| {
            let x = increment_power(frequency_hz, PERIOD_S);
            let level = 2.0 * 0.33 * PERIOD_S
                + 0.01f64.powi(2) * x
                + 0.2e-3f64.powi(2) * velocity_changes(i);
            let none = Complex::new(0.0, 0.0);
            FrequencyPoint {
                frequency_hz,
                response: none,
                scatter_variance: 4.0 * level / (1000.0 * x),
                variance: 1.0,
                variance_dof: 14.0,
                coherence: 1.0,
                input: Complex::new(1.0, 0.0),
                output: none,
                block_errors: vec![none; 8],
                rows: 1000,
                later_s: 0.0,
                velocity_changes: velocity_changes(i),
            }
        };
        let hz = [2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 150.0, 200.0, 300.0];
        hz.into_iter().enumerate().map(point).collect()
    }

    #[test]
    fn commands_at_uneven_times_are_no_diffusion_where_segments_differ() {
        let mut apart = lines(|i| 3e3 * (i * i) as f64);
        let noise = apply_noise_model(&mut apart, PERIOD_S).unwrap();
        assert!((noise.diffusion_um2_per_s - 0.33).abs() < 1e-3, "{noise:?}");
        assert!(
            (noise.timing_s - 0.2e-3).abs() < 1e-6 && noise.used,
            "{noise:?}"
        );
        assert!((noise.localisation_um - 0.01).abs() < 1e-4, "{noise:?}");
    }

    #[test]
    fn lines_of_one_segment_leave_uneven_times_in_the_diffusion() {
        let mut together = lines(|_| 1e4);
        let noise = apply_noise_model(&mut together, PERIOD_S).unwrap();
        assert!((noise.diffusion_um2_per_s - 0.53).abs() < 1e-3, "{noise:?}");
        assert!(noise.timing_s == 0.0, "{noise:?}");
    }
}
