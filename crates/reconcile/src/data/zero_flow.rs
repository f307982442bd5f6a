//! A zero flow that moves: its strength and time by maximum likelihood, from what a fit leaves over.
//!
//! In a closed loop the command holds what the zero flow did: with noise that does not know of it, every slow effect of the response
//! is biased, and one is found where there is none.

use crate::data::motion::{ZeroFlow, parabola};
use crate::data::noise::{NoiseModel, Whitener};
use crate::dot::dot;
use crate::thresholds::NUMBER;

/// The time that a zero flow keeps, at least \[s\]: of what changes faster the likelihood sees the strength alone, and tubes and
/// reservoirs do not.
const SHORTEST_S: f64 = 1.0;
/// And at most, in lengths of the longest record: a walk, or an offset.
const LONGEST: f64 = 100.0;
/// Starts of a descent: motions in a row in parts of the innovation, and times in lengths of a record.
const STARTS: [(f64, f64); 3] = [(0.003, 0.1), (0.03, 0.5), (0.03, 20.0)];

/// One record's residual and what its filter needs.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Left<'a> {
    pub residual: &'a [f64],
    pub present: &'a [bool],
    pub extra_walk: Option<&'a [f64]>,
}

/// Numbers of a zero flow that moves beside so many records.
pub(crate) fn numbers(z: &ZeroFlow, records: usize) -> usize {
    2 + if z.drifts { records } else { 0 }
}

/// Twice the negative log-likelihood of residuals under a noise, without a constant, with the price of its numbers.
fn cost(noise: &NoiseModel, left: &[Left<'_>]) -> f64 {
    let drifts = noise.zero_flow.is_some_and(|z| z.drifts);
    let of = |l: &Left<'_>| {
        let filter = Whitener::new(noise, l.present, l.extra_walk);
        let mut e = vec![0.0; l.residual.len()];
        filter.apply(l.residual, &mut e);
        let squares = dot(&e, &e) + filter.log_determinant();
        if !drifts {
            return squares;
        }
        let mut drift = vec![0.0; e.len()];
        filter.apply(&parabola(e.len()), &mut drift);
        squares - dot(&drift, &e).powi(2) / dot(&drift, &drift).max(1e-300)
    };
    let priced = noise.zero_flow.map_or(0, |z| numbers(&z, left.len()));
    left.iter().map(of).sum::<f64>() + NUMBER * priced as f64
}

/// The same noise with the zero flow that the residuals make most likely.
pub(crate) fn estimate(noise: &NoiseModel, left: &[Left<'_>], sample_s: f64) -> Option<NoiseModel> {
    let rows = left.iter().map(|l| l.residual.len()).max()? as f64;
    let still = NoiseModel {
        zero_flow: None,
        ..*noise
    };
    let within = Within {
        sigma_um: still.innovation_um(),
        rows,
        shortest: (SHORTEST_S / sample_s).max(4.0).ln(),
        longest: (LONGEST * rows).ln(),
    };
    [false, true]
        .into_iter()
        .filter_map(|drifts| {
            let with = |x: [f64; 2]| NoiseModel {
                zero_flow: Some(ZeroFlow {
                    motion_um2: x[0].exp(),
                    time_rows: x[1].exp(),
                    drifts,
                }),
                ..still
            };
            let (x, least) = descend(noise.zero_flow, &within, |x| cost(&with(x), left))?;
            Some((with(x), least))
        })
        .min_by(|a, b| a.1.total_cmp(&b.1))
        .map(|(noise, _)| noise)
}

/// Where the numbers of a zero flow may lie.
struct Within {
    /// Innovation without a zero flow.
    sigma_um: f64,
    /// Rows of the longest record.
    rows: f64,
    /// Logarithms of the times \[rows\].
    shortest: f64,
    longest: f64,
}

impl Within {
    /// Logarithms of motion and time in their ranges.
    fn bounded(&self, x: [f64; 2]) -> [f64; 2] {
        [
            // A motion that no record of this length could show, and one that no filter would call slow.
            x[0].clamp(
                2.0 * (1e-3 * self.sigma_um / self.rows).ln(),
                2.0 * self.sigma_um.ln(),
            ),
            x[1].clamp(self.shortest, self.longest),
        ]
    }
}

/// Descends by steps that become smaller, from what was found before or the best of some starts: logarithms of motion and time.
fn descend(
    before: Option<ZeroFlow>,
    within: &Within,
    value: impl Fn([f64; 2]) -> f64,
) -> Option<([f64; 2], f64)> {
    // Along the strength, along the time, and along both together, of which short records tell the ratio alone.
    const WAYS: [[f64; 2]; 3] = [[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]];
    let begun = before
        .iter()
        .map(|z| [z.motion_um2.ln(), z.time_rows.ln()])
        .chain(STARTS.map(|(motion, time)| {
            [
                2.0 * (motion * within.sigma_um).ln(),
                (time * within.rows).ln(),
            ]
        }))
        .map(|x| within.bounded(x));
    let (mut x, mut least) = begun
        .map(|x| (x, value(x)))
        .min_by(|a, b| a.1.total_cmp(&b.1))?;
    let mut step = 1.6;
    while step > 0.05 {
        let best = WAYS
            .iter()
            .flat_map(|w| [-step, step].map(|s| within.bounded([x[0] + s * w[0], x[1] + s * w[1]])))
            .map(|x| (x, value(x)))
            .min_by(|a, b| a.1.total_cmp(&b.1));
        match best {
            Some((at, c)) if c < least - 1e-2 => (x, least) = (at, c),
            _ => step *= 0.5,
        }
    }
    Some((x, least))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn normal(state: &mut u64) -> f64 {
        let mut uniform = || {
            *state = state
                .wrapping_mul(6364136223846793005)
                .wrapping_add(1442695040888963407);
            (*state >> 11) as f64 / (1u64 << 53) as f64
        };
        (0..12).map(|_| uniform()).sum::<f64>() - 6.0
    }

    /// A bead of the nominal rig over a zero flow of a motion a row (RMS) and a time, or of a steady change.
    fn series(rows: usize, motion_um: f64, time_rows: f64, drift: f64, seed: u64) -> Vec<f64> {
        let n = NoiseModel::new(0.33, 1e-3, 0.030);
        let mut state = seed;
        let keep = (-1.0 / time_rows).exp();
        let mut v = motion_um * normal(&mut state);
        let mut m = 0.0;
        (0..rows)
            .map(|k| {
                m += v + drift * k as f64 + n.walk_um2.sqrt() * normal(&mut state);
                v = keep * v + (1.0 - keep * keep).sqrt() * motion_um * normal(&mut state);
                m + n.white_um2.sqrt() * normal(&mut state)
            })
            .collect()
    }

    fn estimated(series: &[f64]) -> (NoiseModel, f64) {
        let present = vec![true; series.len()];
        let left = Left {
            residual: series,
            present: &present,
            extra_walk: None,
        };
        let still = NoiseModel::new(0.33, 1e-3, 0.030);
        let moving = estimate(&still, &[left], 1e-3).expect("rows");
        (moving, cost(&still, &[left]) - cost(&moving, &[left]))
    }

    #[test]
    fn a_zero_flow_that_moves_is_found_with_its_strength() {
        // 5 nm of displacement that move the bead by 2 nm a row, for five seconds.
        for seed in 1..5 {
            let (noise, gain) = estimated(&series(40_000, 0.002, 5000.0, 0.0, seed));
            let z = noise.zero_flow.expect("a zero flow");
            // What is gained in a second is told better than size and time apart: eight times of five seconds.
            let found = z.motion_um2 / z.time_rows / (4e-6 / 5000.0);
            assert!(gain > 30.0, "{gain}");
            assert!(found.ln().abs() < 1.4, "{found} {z:?}");
        }
    }

    #[test]
    fn a_zero_flow_that_stands_still_gains_nothing() {
        for seed in 1..7 {
            let (noise, gain) = estimated(&series(20_000, 0.0, 1.0, 0.0, seed));
            // Two numbers at the edge of their range: 1 % of chi-square with two.
            assert!(gain + 2.0 * NUMBER < 9.2, "{gain} {noise:?}");
        }
    }

    #[test]
    fn a_drift_of_the_zero_flow_is_told_from_its_wandering() {
        // 0.4 nm a row more in every second: 1 nm/s of displacement at 400 1/s.
        let (noise, gain) = estimated(&series(38_000, 0.0, 1.0, 0.4e-6, 3));
        let z = noise.zero_flow.expect("a zero flow");
        assert!(gain > 100.0 && z.drifts, "{gain} {z:?}");
    }
}
