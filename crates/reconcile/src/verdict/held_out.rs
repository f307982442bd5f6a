//! The check on data not used in fitting: whole records (frequencies, amplitudes, wave forms), then the end of what an effect does in
//! a record by its beginning and the reverse.

use crate::fit::context::{Context, Fit};
use crate::mask::{Mask, splits_of};
use crate::problem::Prepared;
use crate::thresholds::THRESHOLDS;
use crate::verdict::map::DiscrepancyMap;
use crate::verdict::result::{BandGap, Interval, RecordGap};

/// What the held-out check found.
#[derive(Debug, Clone)]
pub(crate) struct HeldOut {
    /// RMS innovation of the null on held-out records \[um\].
    pub before_um: f64,
    /// RMS innovation of the set, fitted without the record \[um\].
    pub after_um: f64,
    /// The same for the RMS of the free run's error: without level, transients, and, for a plant that integrates, a ramp \[um\].
    pub free_before_um: f64,
    /// The same of the set \[um\].
    pub free_after_um: f64,
    /// The value expected from the walk and the white noise alone \[um\].
    pub free_floor_um: f64,
    pub per_record: Vec<RecordGap>,
    /// Parts that do not help in the last 40 % and the first 40 % of what they do together, each when fitted on the rest, or that
    /// one of the two contradicts.
    pub unconfirmed: Vec<usize>,
    /// How far a free base gain moves when it is refitted together with the set.
    pub gain_shift: Interval,
}

/// Sums over the held-out rows of one fold.
#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    before: f64,
    after: f64,
    count: usize,
    free_before: f64,
    free_after: f64,
    free_floor: f64,
    rows: f64,
}

impl Sums {
    fn plus(self, o: &Self) -> Self {
        Self {
            before: self.before + o.before,
            after: self.after + o.after,
            count: self.count + o.count,
            free_before: self.free_before + o.free_before,
            free_after: self.free_after + o.free_after,
            free_floor: self.free_floor + o.free_floor,
            rows: self.rows + o.rows,
        }
    }
}

/// Free-run error on the rows of a mask: energies before and after, energy expected from the noise, and number of rows.
fn free_run(ctx: &Context<'_>, null: &Fit, set: &Fit, test: &Mask) -> Sums {
    let ramp = ctx.integrates();
    let noise = &ctx.problem.noise;
    let mut sums = Sums::default();
    let (before, after) = (
        ctx.residual_under(null, test),
        ctx.residual_under(set, test),
    );
    for (i, (r, ranges)) in ctx.problem.records.iter().zip(test).enumerate() {
        if ranges.is_empty() {
            continue;
        }
        let energy = |e: &[f64]| -> f64 {
            let left = r.without_start(e, ramp);
            ranges
                .iter()
                .map(|m| left[m.clone()].iter().map(|x| x * x).sum::<f64>())
                .sum()
        };
        let rows: f64 = ranges
            .iter()
            .flat_map(Clone::clone)
            .filter(|&k| r.present[k])
            .count() as f64;
        sums.free_before += energy(&before[i]);
        sums.free_after += energy(&after[i]);
        // A walk of n rows about its mean has the variance q n/6, about its regression line q n/15.
        let share = if ramp { 1.0 / 15.0 } else { 1.0 / 6.0 };
        let of_rows = r.u.len() as f64;
        let flow = noise.zero_flow.map_or(0.0, |z| z.path_um2(of_rows, ramp));
        let coloured = noise.coloured.map_or(0.0, |c| c.variance_um2);
        let still = noise.white_um2 + coloured;
        sums.free_floor += rows * (noise.walk_um2 * of_rows * share + flow + still);
        sums.rows += rows;
    }
    sums
}

/// Runs the check.
pub(crate) fn check(ctx: &Context<'_>, fit: &Fit, threads: usize) -> HeldOut {
    let records = &ctx.problem.records;
    let sigma = ctx.problem.noise.innovation_um();
    let all = ctx.problem.all();
    let null = ctx.fit(Vec::new(), &all, ROUNDS);
    let splits = splits_of(&change(&null, fit));
    // Records: each predicted by a fit to all others, where those are enough; else the end of what the set does in it by the beginning,
    // and the beginning by the end.
    // Amplitudes and phases of lines are each record's own: kept.
    let folds: Vec<usize> = (0..records.len()).collect();
    let results = cellpos_numeric::parallel::map(&folds, threads, |&i| {
        let mut others = all.clone();
        let mut own: Mask = vec![Vec::new(); records.len()];
        std::mem::swap(&mut others[i], &mut own[i]);
        // A record at rest says nothing of a response.
        let moving = |mask: &Mask| -> usize {
            let moves = |(m, r): (&Vec<std::ops::Range<usize>>, &Prepared)| {
                if r.rest { Vec::new() } else { m.clone() }
            };
            ctx.problem
                .count(&mask.iter().zip(records).map(moves).collect())
        };
        let enough = records[i].rest || 4 * moving(&others) > moving(&others) + moving(&own);
        if enough {
            return fold(ctx, fit, &others, &own);
        }
        let of_splits = splits.iter().map(|(train, test)| {
            let mut own: Mask = vec![Vec::new(); records.len()];
            own[i].clone_from(&test[i]);
            fold(ctx, fit, train, &own)
        });
        of_splits.fold(Sums::default(), |a, s| a.plus(&s))
    });
    let innovation = |c: f64, n: usize| sigma * (c / n.max(1) as f64).sqrt();
    let per_record: Vec<RecordGap> = records
        .iter()
        .zip(&results)
        .map(|(r, s)| {
            let free = |e: f64| (e / s.rows.max(1.0)).sqrt();
            RecordGap {
                record: r.name.clone(),
                before: innovation(s.before, s.count),
                after: innovation(s.after, s.count),
                free_run_before: free(s.free_before),
                free_run_after: free(s.free_after),
            }
        })
        .collect();
    let total = results.iter().fold(Sums::default(), |a, s| a.plus(s));
    let free = |e: f64| (e / total.rows.max(1.0)).sqrt();
    HeldOut {
        before_um: innovation(total.before, total.count),
        after_um: innovation(total.after, total.count),
        free_before_um: free(total.free_before),
        free_after_um: free(total.free_after),
        free_floor_um: free(total.free_floor),
        per_record,
        unconfirmed: unconfirmed(ctx, fit, threads),
        gain_shift: gain_shift(ctx, fit),
    }
}

/// Rounds of a fit without the held-out rows: it stops before where it stands still.
const ROUNDS: usize = 12;

/// What the set and the null make of rows that neither was fitted to.
fn fold(ctx: &Context<'_>, fit: &Fit, others: &Mask, own: &Mask) -> Sums {
    let null = ctx.fit(Vec::new(), others, ROUNDS);
    let set = if fit.parts.is_empty() {
        null.clone()
    } else {
        let mut f = ctx.refit(fit, others, ROUNDS);
        f.lines.clone_from(&fit.lines);
        f.innovations = ctx.innovations(&f, &ctx.problem.all()).0;
        f
    };
    Sums {
        before: null.chi2_on(own),
        after: set.chi2_on(own),
        count: ctx.problem.count(own),
        ..free_run(ctx, &null, &set, own)
    }
}

/// What the parts by which two fits differ change in every row.
fn change(without: &Fit, with: &Fit) -> Vec<Vec<f64>> {
    let rows = |(a, b): (&Vec<f64>, &Vec<f64>)| a.iter().zip(b).map(|(a, b)| a - b).collect();
    (without.innovations.iter().zip(&with.innovations))
        .map(rows)
        .collect()
}

/// Parts that rows which they were not fitted to do not speak for, or that one of the splits speaks against by [`THRESHOLDS`]' tie. Rows
/// in which a part makes no difference (a clipping command that is small there) gain nothing and say nothing: what is split is the
/// difference that the part makes.
fn unconfirmed(ctx: &Context<'_>, fit: &Fit, threads: usize) -> Vec<usize> {
    let indices: Vec<usize> = (0..fit.parts.len()).collect();
    let fails = cellpos_numeric::parallel::map(&indices, threads, |&i| {
        let without = ctx.fit_without(fit, i, &ctx.problem.all(), ROUNDS);
        let splits = splits_of(&change(&without, fit));
        let gains = splits.iter().map(|(train, _)| {
            let of = |all: &Fit| surprise(all, &ctx.refit(all, train, ROUNDS));
            of(&without) - of(fit)
        });
        let (sum, least) = gains.fold((0.0, f64::INFINITY), |(s, l): (f64, f64), g| {
            (s + g, l.min(g))
        });
        sum < 2.0 || least < -THRESHOLDS.tie
    });
    let failed = indices.into_iter().zip(fails).filter(|(_, fails)| *fails);
    failed.map(|(i, _)| i).collect()
}

/// Twice the negative logarithm of the probability of the held-out rows, given the fitted rows. It is over all values that the
/// fitted rows leave possible for the numbers of `some` (Laplace's approximation). A number that one part of a record leaves open
/// predicts nothing of the other, and nothing against it.
fn surprise(all: &Fit, some: &Fit) -> f64 {
    all.chi2 - some.chi2 + all.log_information - some.log_information
}

/// Refits with a free gain in addition to the set (or alone) and returns its change from 1.
fn gain_shift(ctx: &Context<'_>, fit: &Fit) -> Interval {
    let unit = String::new();
    if ctx.free_gain {
        return Interval {
            value: fit.gain,
            ci95: [
                fit.gain - 1.96 * fit.errors[1],
                fit.gain + 1.96 * fit.errors[1],
            ],
            unit,
        };
    }
    if fit.parts.iter().any(|p| p.variant.is_gain()) {
        return Interval {
            value: 1.0,
            ci95: [1.0, 1.0],
            unit,
        };
    }
    let Some(v) = crate::fit::catalogue::Variant::gain() else {
        return Interval {
            value: 1.0,
            ci95: [1.0, 1.0],
            unit,
        };
    };
    let mut parts = fit.parts.clone();
    parts.push(crate::fit::catalogue::Part::new(v, &[1.0]));
    let free = ctx.fit_from(parts, Some(fit.soft), &ctx.problem.all(), 3);
    let value = free.parts.last().map_or(1.0, |p| p.natural()[0]);
    let n = free.covariance.nrows();
    let sd = if n > 0 {
        free.covariance[(n - 1, n - 1)].max(0.0).sqrt()
    } else {
        0.0
    };
    Interval {
        value,
        ci95: [value - 1.96 * sd, value + 1.96 * sd],
        unit,
    }
}

/// RMS innovation per band before and after, all records together.
pub(crate) fn bands(before: &DiscrepancyMap, after: &DiscrepancyMap) -> Vec<BandGap> {
    let edges = &before.edges_hz;
    (edges.windows(2).enumerate())
        .map(|(b, edge)| {
            let rms = |m: &DiscrepancyMap| {
                let cells: Vec<f64> = m
                    .rows
                    .iter()
                    .filter(|r| r.cells.len() == edges.len())
                    .map(|r| r.cells[b].rms_um.powi(2))
                    .collect();
                (cells.iter().sum::<f64>() / cells.len().max(1) as f64).sqrt()
            };
            let floor = before.rows.first().map_or(0.0, |r| r.cells[b].floor_um);
            BandGap {
                low_hz: edge[0],
                high_hz: edge[1],
                before: rms(before),
                after: rms(after),
                floor,
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::verdict::map::{Cell, MapRow, band_edges_hz};

    /// White noise of one unit, from slow records to those of a fast camera: the parts of the bands add up to the whole.
    #[test]
    fn bands_end_at_half_the_rate_and_add_up() {
        for rate_hz in [1.0, 200.0, 1000.0, 2000.0, 5000.0, 20_000.0] {
            let cell = Cell {
                rms_um: 1.0,
                floor_um: 1.0,
                z: 0.0,
                flagged: false,
            };
            let edges_hz = band_edges_hz(1.0 / rate_hz);
            let row = MapRow {
                name: "a".to_owned(),
                cells: vec![cell; edges_hz.len()],
            };
            let map = DiscrepancyMap {
                edges_hz,
                rows: vec![row],
                ratios: Vec::new(),
            };
            let found = bands(&map, &map);
            let half_rate = 0.5 * rate_hz;
            assert_eq!(found.last().map(|band| band.high_hz), Some(half_rate));
            let whole: f64 = (found.iter())
                .map(|band| band.before.powi(2) * (band.high_hz - band.low_hz) / half_rate)
                .sum();
            assert!((whole - 1.0).abs() < 1e-12, "{rate_hz} Hz: {whole}");
        }
    }
}
