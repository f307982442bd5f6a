//! The noise of a bead's position record: Brownian motion, localisation noise, commands that come at uneven times, and a flow that wanders.
//!
//! Increments of a record hold `2 D T` of Brownian motion at every frequency and `s^2 |1 - e^(-jwT)|^2` of localisation
//! noise. A command that comes `d` late moves the bead by `d` times the change of its velocity less, for good: with a standard deviation
//! `t` of that time, increments hold `t^2` times the mean square of that change, which each segment knows of its own bead. A flow that
//! wanders as a random walk puts its power over `|1 - e^(-jwT)|^2` into them. The levels are fitted to what the plant leaves of the record
//! between the driven lines (`rest.rs`), so all rows tell of them. If they do not describe the scatter at the lines (another rig,
//! another disturbance), the scatter is used as measured. Not for finding the cause of such a disturbance.

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

/// Power of increments in a band, um^2 a row, as it was measured.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Scatter {
    pub(crate) um2: f64,
    /// [`shares`] of the noises in it.
    pub(crate) shares: [f64; 4],
    pub(crate) dof: f64,
}

impl Scatter {
    pub(crate) const NONE: Self = Self {
        um2: 0.0,
        shares: [0.0; 4],
        dof: 0.0,
    };

    /// The mean of both.
    pub(crate) fn join(&mut self, other: &Self) {
        let dof = self.dof + other.dof;
        let of = other.dof / dof;
        self.um2 += of * (other.um2 - self.um2);
        for (share, other) in self.shares.iter_mut().zip(other.shares) {
            *share += of * (other - *share);
        }
        self.dof = dof;
    }
}

/// Shares of Brownian motion, localisation noise, timing and a wandering flow in the power of increments at `frequency_hz`.
pub(crate) fn shares(frequency_hz: f64, period_s: f64, velocity_changes: f64) -> [f64; 4] {
    let x = increment_power(frequency_hz, period_s);
    // Positions at the ends of a row, whose velocity changes within it: a sixth less.
    [1.0, x, velocity_changes, 1.0 / x - 1.0 / 6.0]
}

/// Levels of the kinds of noise, none below 0, and what is known of them.
struct Levels {
    levels: [f64; 4],
    /// Fisher's information on the first level, the others unknown.
    information: f64,
    deviance: f64,
}

/// Sum of the noises in a scatter, um^2 a row.
fn sum(levels: &[f64; 4], shares: &[f64; 4]) -> f64 {
    levels.iter().zip(shares).map(|(l, s)| l * s).sum()
}

/// The likeliest levels of the noises `kinds` (a scatter is gamma-distributed, of variance `2 S^2 / dof`); `None` if the lines do not
/// tell them apart or a level would be negative.
fn levels(data: &[Scatter], kinds: &[usize]) -> Option<Levels> {
    let n = kinds.len();
    let dof: f64 = data.iter().map(|d| d.dof).sum();
    let mean = data.iter().map(|d| d.um2 * d.dof).sum::<f64>() / dof;
    let mut found = Levels {
        levels: [0.0; 4],
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
    // An exposure of a whole period takes a sixth of Brownian motion off as if it were localisation noise.
    let [walk, white, timing, wander] = found.levels;
    if walk < 0.0 || timing < 0.0 || wander < 0.0 || white < -walk / 6.0 {
        return None;
    }
    found.information = 1.0 / information.try_inverse()?[(0, 0)];
    found.deviance = deviance(data, &found.levels);
    Some(found)
}

fn deviance(data: &[Scatter], levels: &[f64; 4]) -> f64 {
    let of = |d: &Scatter| {
        let r = d.um2 / sum(levels, &d.shares);
        d.dof * (r - 1.0 - r.ln())
    };
    data.iter().map(of).sum()
}

/// Fits the levels of the noises to the power of increments between the lines, `octaves`; if they describe the scatter of the `points` (p >
/// 0.005), sets their `variance` from them.
pub(crate) fn apply_noise_model(
    octaves: &[Scatter],
    points: &mut [FrequencyPoint],
    period_s: f64,
) -> Option<NoiseModel> {
    if octaves.len() < 4 {
        return None;
    }
    // Segments that saw one timing, or one segment: the share of Brownian motion again.
    let most = octaves.iter().map(|d| d.shares[2]).fold(0.0, f64::max);
    let apart = octaves.iter().any(|d| d.shares[2] < 0.99 * most);
    let kinds = (0..8_usize).filter(|set| apart || set & 2 == 0).map(|set| {
        let others = (1..4).filter(move |kind| set >> (kind - 1) & 1 == 1);
        std::iter::once(0).chain(others).collect::<Vec<usize>>()
    });
    // The likeliest of those without a negative level is that of all levels from 0 on.
    let found = kinds.filter_map(|kinds| levels(octaves, &kinds));
    let found = found.min_by(|a, b| a.deviance.total_cmp(&b.deviance))?;
    let free = found.levels.iter().filter(|&&level| level != 0.0).count();
    // What is uneven beyond chance is in the interval.
    let widened = (found.deviance / (octaves.len() - free) as f64).max(1.0);
    let dof = octaves.iter().map(|d| d.dof).sum::<f64>() / widened;
    let level = |p: &FrequencyPoint| {
        let shares = shares(p.frequency_hz, period_s, p.velocity_changes);
        sum(&found.levels, &shares) * p.spread
    };
    let lines: Vec<Scatter> = points
        .iter()
        .filter(|p| p.scatter_variance > 0.0 && p.variance_dof >= 2.0)
        .map(|p| Scatter {
            um2: p.scatter_variance / level(p),
            shares: [1.0, 0.0, 0.0, 0.0],
            dof: p.variance_dof,
        })
        .collect();
    let p_value = chi2_exceeds(deviance(&lines, &[1.0, 0.0, 0.0, 0.0]), lines.len() as f64);
    let used = p_value > 0.005;
    if used {
        for p in points.iter_mut() {
            p.variance = level(p);
            p.variance_dof = dof;
        }
    }
    let [walk, white, timing, _] = found.levels;
    Some(NoiseModel {
        diffusion_um2_per_s: walk / (2.0 * period_s),
        diffusion_ci95_um2_per_s: student_t_quantile(0.975, dof)
            * (widened / found.information).sqrt()
            / (2.0 * period_s),
        localisation_um: white.max(0.0).sqrt(),
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

    /// Octaves whose power is that of 0.33 um^2/s, fixes of 10 nm and commands that come at times off by 0.2 ms.
    fn octaves(velocity_changes: impl Fn(usize) -> f64) -> Vec<Scatter> {
        let of = |(i, frequency_hz): (usize, f64)| {
            let x = increment_power(frequency_hz, PERIOD_S);
            let level = 2.0 * 0.33 * PERIOD_S
                + 0.01f64.powi(2) * x
                + 0.2e-3f64.powi(2) * velocity_changes(i);
            Scatter {
                um2: level,
                shares: shares(frequency_hz, PERIOD_S, velocity_changes(i)),
                dof: 1000.0,
            }
        };
        let hz = [2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 150.0, 200.0, 300.0];
        hz.into_iter().enumerate().map(of).collect()
    }

    fn noise(octaves: &[Scatter]) -> NoiseModel {
        apply_noise_model(octaves, &mut [], PERIOD_S).unwrap()
    }

    #[test]
    fn commands_at_uneven_times_are_no_diffusion_where_segments_differ() {
        let noise = noise(&octaves(|i| 3e3 * (i * i) as f64));
        assert!((noise.diffusion_um2_per_s - 0.33).abs() < 1e-3, "{noise:?}");
        assert!(
            (noise.timing_s - 0.2e-3).abs() < 1e-6 && noise.used,
            "{noise:?}"
        );
        assert!((noise.localisation_um - 0.01).abs() < 1e-4, "{noise:?}");
    }

    #[test]
    fn lines_of_one_segment_leave_uneven_times_in_the_diffusion() {
        let noise = noise(&octaves(|_| 1e4));
        assert!((noise.diffusion_um2_per_s - 0.53).abs() < 1e-3, "{noise:?}");
        assert!(noise.timing_s == 0.0, "{noise:?}");
    }

    #[test]
    fn a_long_exposure_is_no_lack_of_diffusion() {
        let mut averaged = octaves(|_| 0.0);
        for octave in &mut averaged {
            octave.um2 = 2.0 * 0.33 * PERIOD_S * (1.0 - 0.9 * octave.shares[1] / 6.0);
        }
        let noise = noise(&averaged);
        assert!((noise.diffusion_um2_per_s - 0.33).abs() < 1e-3, "{noise:?}");
        assert!(noise.localisation_um == 0.0, "{noise:?}");
    }
}
