//! Jumps of the bead or the table: steps of the position in single rows, which nothing announces.
//!
//! They are looked for in what a set leaves. A bad fix is another matter: it is off in one row, and the next is where it was. What a
//! wrong equation leaves in single rows is where the command moves the bead, and a jump is anywhere.

use crate::data::whitener::Whitener;
use crate::dot::dot;
use crate::fit::context::{Context, Fit};
use crate::thresholds::{NUMBER, THRESHOLDS};

/// Standard deviations of one chance in a thousand, both ways.
const ONE_IN_A_THOUSAND: f64 = 3.29;

/// One of at least so many rows jumps: more are a misfit or another noise.
pub(crate) const MOST_OF_ROWS: usize = 100;

/// A step in one row, or in two if it came during an exposure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Jump {
    pub record: usize,
    pub row: usize,
    pub um: f64,
}

/// The jumps of all records.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Jumps {
    all: Vec<Jump>,
    /// Their gain in twice the log-likelihood.
    pub gain: f64,
}

impl Jumps {
    /// The jumps in what a fit leaves.
    pub(crate) fn find(ctx: &Context<'_>, fit: &Fit) -> Self {
        let mut found = Self::default();
        let records = &ctx.problem.records;
        for (record, (r, e)) in records.iter().zip(&fit.innovations).enumerate() {
            found.find_in(record, &r.whitener, e.clone());
        }
        found
    }

    /// Takes off one after another, the largest first.
    fn find_in(&mut self, record: usize, whitener: &Whitener, mut e: Vec<f64>) {
        let loud = e.iter().filter(|e| e.abs() > THRESHOLDS.jump_sd).count();
        if loud > e.len() / MOST_OF_ROWS {
            return;
        }
        let (first, rows) = (self.all.len(), e.len());
        let mut seen = vec![false; e.len()];
        loop {
            let open = e.iter().enumerate().filter(|(k, _)| !seen[*k]);
            let Some((row, size)) = open.max_by(|a, b| a.1.abs().total_cmp(&b.1.abs())) else {
                return;
            };
            if size.abs() < THRESHOLDS.jump_sd {
                break;
            }
            seen[row] = true;
            let of = |from: usize, until: usize| -> Vec<f64> {
                let raw = |k: usize| f64::from(u8::from((from..until).contains(&k)));
                let raw: Vec<f64> = (0..rows).map(raw).collect();
                // A step is over in a few innovations, and the free numbers of a record are slow.
                let mut column = vec![0.0; rows];
                whitener.apply(&raw, &mut column);
                column
            };
            // An exposure during which it came shows a part of it.
            let [step, edge] = [of(row, rows), of(row, row + 1)];
            let gain = gain_of(&step, &e);
            let as_bad_fix = gain_of(&edge, &e);
            if gain < THRESHOLDS.jump_sd.powi(2).max(as_bad_fix + NUMBER) {
                // Noise with tails has bad fixes by the hundred. The next rows of one return from where it was: they are no step.
                if as_bad_fix > gain {
                    let um = size_of(&edge, &e);
                    take_off(&mut e, &edge, um);
                }
                continue;
            }
            let [um, part_um] = fitted([&step, &edge], &e);
            take_off(&mut e, &step, um);
            take_off(&mut e, &edge, part_um);
            self.gain += gain;
            let of_this = self.all[first..].iter_mut();
            match of_this.into_iter().find(|j| j.row.abs_diff(row) <= 1) {
                Some(same) => same.um += um,
                None => self.all.push(Jump { record, row, um }),
            }
        }
    }

    /// Measures their sizes in what a fit leaves whose position is open there: from what the rows before predict to the row behind.
    pub(crate) fn measure(&mut self, ctx: &Context<'_>, fit: &Fit) {
        let (residual, _) = ctx.residual(fit);
        for (record, (r, left)) in ctx.problem.records.iter().zip(&residual).enumerate() {
            let expected = r.whitener.ahead(left);
            for jump in self.all.iter_mut().filter(|j| j.record == record) {
                let behind = (jump.row + 1..left.len()).find(|k| r.present[*k]);
                if let Some(behind) = behind {
                    jump.um = left[behind] - expected[jump.row];
                }
            }
        }
    }

    /// The same with those that were found before.
    pub(crate) fn and(mut self, before: Self) -> Self {
        self.gain += before.gain;
        self.all.extend(before.all);
        self
    }

    pub(crate) fn count(&self) -> usize {
        self.all.len()
    }

    /// The rows of a record at which the position is anywhere: an exposure may have seen a part of a jump.
    pub(crate) fn rows_of(&self, record: usize) -> impl Iterator<Item = usize> {
        let here = self.all.iter().filter(move |j| j.record == record);
        here.flat_map(|j| [j.row, j.row + 1])
    }

    /// Root of the mean square of their sizes \[um\].
    pub(crate) fn rms_um(&self) -> f64 {
        let squares = self.all.iter().map(|j| j.um * j.um);
        (squares.sum::<f64>() / self.count().max(1) as f64).sqrt()
    }

    /// Half the width of its 95 % interval, by the scatter of the sizes \[um\].
    pub(crate) fn rms_error_um(&self) -> f64 {
        let (rms, n) = (self.rms_um(), self.count().max(2) as f64);
        let off = self.all.iter().map(|j| (j.um * j.um - rms * rms).powi(2));
        1.96 * (off.sum::<f64>() / (n * (n - 1.0))).sqrt() / (2.0 * rms.max(f64::MIN_POSITIVE))
    }

    /// The largest of at least one.
    pub(crate) fn largest(&self) -> Jump {
        let larger = |a: &&Jump, b: &&Jump| a.um.abs().total_cmp(&b.um.abs());
        *self.all.iter().max_by(larger).expect("a jump")
    }

    /// Whether they are an effect: as many as a fault of the camera has, few of all rows, and no likelier while the bead is driven.
    pub(crate) fn are_an_effect(&self, ctx: &Context<'_>, fit: &Fit) -> bool {
        let rows = rows_of_all(ctx);
        (THRESHOLDS.faults_least..rows / MOST_OF_ROWS).contains(&self.count())
            && self.driven_sd(ctx, fit).abs() < ONE_IN_A_THOUSAND
    }

    /// Mean rank of their rows among all by the speed of the bead that the commands make, in standard deviations from chance (Wilcoxon).
    fn driven_sd(&self, ctx: &Context<'_>, fit: &Fit) -> f64 {
        let simulated = ctx.simulated(&fit.parts, fit.offset_um, &ctx.problem.all());
        let speed = |y: &[f64], row: usize| (y[row] - y[row.saturating_sub(1)]).abs();
        let rows = simulated
            .iter()
            .flat_map(|y| (1..y.len()).map(|k| speed(y, k)));
        let mut speeds: Vec<f64> = rows.collect();
        speeds.sort_by(f64::total_cmp);
        let all = speeds.len().max(1) as f64;
        let rank = |jump: &Jump| {
            let own = speed(&simulated[jump.record], jump.row);
            let below = speeds.partition_point(|v| *v < own);
            let up_to = speeds.partition_point(|v| *v <= own);
            0.5 * (below + up_to) as f64 / all
        };
        let n = self.count() as f64;
        let mean = self.all.iter().map(rank).sum::<f64>() / n;
        (mean - 0.5) * (12.0 * n).sqrt()
    }
}

/// Rows of all records.
pub(crate) fn rows_of_all(ctx: &Context<'_>) -> usize {
    ctx.problem.records.iter().map(|r| r.u.len()).sum()
}

/// What a column explains of innovations, in twice the log-likelihood.
fn gain_of(column: &[f64], e: &[f64]) -> f64 {
    size_of(column, e) * dot(column, e)
}

/// The size of a column that explains most of innovations.
fn size_of(column: &[f64], e: &[f64]) -> f64 {
    dot(column, e) / dot(column, column).max(f64::MIN_POSITIVE)
}

/// Innovations without a column of a size.
fn take_off(e: &mut [f64], column: &[f64], size: f64) {
    for (e, column) in e.iter_mut().zip(column) {
        *e -= size * column;
    }
}

/// Sizes of two columns fitted to innovations.
fn fitted([a, b]: [&[f64]; 2], e: &[f64]) -> [f64; 2] {
    let (aa, ab, bb) = (dot(a, a), dot(a, b), dot(b, b));
    let (ae, be) = (dot(a, e), dot(b, e));
    let det = aa * bb - ab * ab;
    if det > 1e-12 * aa * bb {
        [(bb * ae - ab * be) / det, (aa * be - ab * ae) / det]
    } else {
        [size_of(a, e), 0.0]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::noise::NoiseModel;
    use crate::data::row_noise::RowNoise;
    use cellpos_numeric::Random;

    const ROWS: usize = 12_000;

    /// Jumps in a bead that walks by 26 nm a row and steps by `steps` (row, um). Its fixes are off by Student's t with four degrees of
    /// freedom, 25 nm RMS.
    fn found(seed: u64, steps: &[(usize, f64)]) -> Vec<Jump> {
        let noise = NoiseModel::new(0.33, 1e-3, 0.025);
        let mut random = Random::new(seed);
        let mut at = 0.0;
        let residual: Vec<f64> = (0..ROWS)
            .map(|k| {
                at += noise.walk_um2.sqrt() * random.normal();
                at += steps.iter().filter(|s| s.0 == k).map(|s| s.1).sum::<f64>();
                let chi2: f64 = (0..4).map(|_| random.normal().powi(2)).sum();
                at + (0.5 * noise.white_um2 / (0.25 * chi2)).sqrt() * random.normal()
            })
            .collect();
        let whitener = Whitener::new(&noise, &vec![true; ROWS], &RowNoise::default());
        let mut e = vec![0.0; ROWS];
        whitener.apply(&residual, &mut e);
        let mut jumps = Jumps::default();
        jumps.find_in(0, &whitener, e);
        jumps.all
    }

    #[test]
    fn the_return_from_a_bad_fix_is_no_jump() {
        let of_none: Vec<Jump> = (0..40).flat_map(|seed| found(seed, &[])).collect();
        assert!(of_none.len() <= 2, "{of_none:?}");
        let steps = [(1000, 0.5), (4000, -0.5), (9000, 0.5)];
        for seed in 0..10 {
            let rows: Vec<usize> = found(seed, &steps).iter().map(|j| j.row).collect();
            for (row, _) in steps {
                assert!(
                    rows.iter().any(|r| r.abs_diff(row) <= 1),
                    "{seed}: {rows:?}"
                );
            }
        }
    }
}
