//! The noise floor, from the records or from what is stated, before any model is believed; or the statement that it is not
//! known.

use crate::data::coloured::{NoiseKind, choose};
use crate::data::estimate::{
    Differences, Estimate, FloorSource, independent, of, of_increments, pooled,
};
use crate::data::no_response::holds;
use crate::data::noise::NoiseModel;
use crate::data::record::Record;
use crate::data::repeats::{Repeats, nearly_repeats, repeats, rests, whole_periods};
use crate::data::zero_flow::descend;
use crate::thresholds::THRESHOLDS;
use std::ops::Range;

/// The noise floor of a set of records.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Floor {
    pub noise: NoiseModel,
    pub source: FloorSource,
    /// Increments that it was measured from; 0 where it was not.
    pub rows: usize,
}

/// Estimates both noises from residuals of the null model.
///
/// A rest record shows the noise itself (lines at the mains frequency and a drift removed). If the command of a record repeats, the
/// difference of successive periods cancels every response that repeats; so does the difference of two records of the same command. The
/// surely smallest estimate rules, with those that differ from it by chance: a misfit can only add, and the smallest of several uncertain
/// ones is too small. A bead held in closed loop shows the noise by what does not follow the command. Without any estimate the model's
/// noise is taken, unless the records are below it; then what a loop's command tells that nearly repeats. Without that the floor is not
/// known, and the increments of the residuals replace it in the figures alone.
pub(crate) fn estimate(
    records: &[Record],
    present: &[Vec<bool>],
    residuals: &[Vec<f64>],
    stated: Option<NoiseModel>,
    kind: NoiseKind,
) -> Floor {
    let quantum_um2 = quantisation_um2(records);
    let walks = kind == NoiseKind::Walk && quantum_um2 == 0.0;
    let mut found = of_records(records, present, residuals, walks);
    // Steps of a sensor that counts are no Gaussian process: nothing is read from their correlation unasked.
    let unasked = kind == NoiseKind::Auto && quantum_um2 > 0.0;
    let kind = if unasked { NoiseKind::Walk } else { kind };
    // If no whole record shows the noise, parts of records may: a misfit can only add.
    if found.is_empty() {
        found = of_parts(records, present, residuals, walks);
    }
    if found.is_empty() && walks {
        found = of_holds(records, present, residuals);
    }
    let of_measured = |found: &[Estimate]| -> Option<Floor> {
        let least = found.iter().min_by(|a, b| a.most().total_cmp(&b.most()))?;
        let pooled = pooled(found, least);
        let walk = NoiseModel::from_increments(pooled.c0, pooled.c1);
        Some(Floor {
            noise: choose(kind, walk, &least.alone()).at_least(quantum_um2),
            source: least.source,
            rows: pooled.rows,
        })
    };
    if let Some(floor) = of_measured(&found) {
        return floor;
    }
    let own: Vec<Estimate> = (residuals.iter().zip(present))
        .map(|(e, present)| of_increments(e, present))
        .filter(|f| f.rows >= 20 && f.c0 > 0.0)
        .collect();
    let residual = own
        .iter()
        .min_by(|a, b| a.most().total_cmp(&b.most()))
        .map(|least| {
            let all = pooled(&own, least);
            let walk = NoiseModel::from_increments(all.c0, all.c1);
            // The residual of a base that was fitted to these records is a sensor's noise or a slow disturbance, and seldom a
            // walk.
            choose(kind, walk, &least.alone()).at_least(quantum_um2)
        });
    let sample_s = records.first().map_or(1e-3, |r| r.sample_s);
    match (stated, residual) {
        (Some(noise), Some(least))
            if noise.innovation_um() < (1.0 + THRESHOLDS.stated_excess) * least.innovation_um() =>
        {
            Floor {
                noise: NoiseModel {
                    white_um2: noise.white_um2.max(quantum_um2),
                    ..noise
                },
                source: FloorSource::Stated,
                rows: 0,
            }
        }
        (_, least) => {
            let of_loops = walks.then(|| of_loops(records, present, residuals));
            of_loops
                .and_then(|found| of_measured(&found))
                .unwrap_or(Floor {
                    noise: least.unwrap_or_else(|| NoiseModel::new(0.33, sample_s, 0.03)),
                    source: FloorSource::Unknown,
                    rows: 0,
                })
        }
    }
}

/// The noise that whole records show. Each row counts once: by the rest or the periods of its record, else by the previous record
/// with the same command.
fn of_records(
    records: &[Record],
    present: &[Vec<bool>],
    residuals: &[Vec<f64>],
    walks: bool,
) -> Vec<Estimate> {
    let whole = crate::data::record::command_range_um(records);
    let mut found: Vec<Estimate> = Vec::new();
    let mut silent: Vec<usize> = Vec::new();
    for (i, r) in records.iter().enumerate() {
        let (e, ok) = (&residuals[i], &present[i]);
        let own = if r.rests_within(THRESHOLDS.rest_share * whole) {
            Some(of(e, ok, r.sample_s, FloorSource::Rest, 1.0))
        } else {
            whole_periods(r).and_then(|repeats| between_periods(r, e, ok, &repeats, walks))
        };
        match own.filter(Estimate::counts) {
            Some(own) => found.push(own),
            None => silent.push(i),
        }
    }
    for (at, &i) in silent.iter().enumerate() {
        let equal = |j: &&usize| records[i].same_command(&records[**j]);
        let Some(&j) = silent[..at].iter().rev().find(equal) else {
            continue;
        };
        let differences = silent.iter().filter(equal).count() - 1;
        let ok: Vec<bool> = (present[i].iter().zip(&present[j]))
            .map(|(a, b)| *a && *b)
            .collect();
        let of = apart(&residuals[i], &residuals[j]);
        let told = Differences {
            command_um: &apart(&records[i].pzt_um, &records[j].pzt_um),
            ok: &ok[..of.len()],
            of: &of,
        };
        let mut equals = told.noise(records[i].sample_s, FloorSource::EqualRecords, walks);
        equals.independent = independent(differences as f64);
        found.push(equals);
    }
    found.retain(Estimate::counts);
    found
}

/// What parts of records tell of the noise: stretches in which the command repeats itself, and its rests elsewhere.
fn of_parts(
    records: &[Record],
    present: &[Vec<bool>],
    residuals: &[Vec<f64>],
    walks: bool,
) -> Vec<Estimate> {
    let mut found: Vec<Estimate> = Vec::new();
    for (i, r) in records.iter().enumerate() {
        let (e, ok) = (&residuals[i], &present[i]);
        let repeated = repeats(r).and_then(|repeats| {
            let own = between_periods(r, e, ok, &repeats, walks).filter(Estimate::counts)?;
            Some((repeats, own))
        });
        let told = |rows: &Range<usize>| {
            repeated.iter().any(|(repeats, _)| {
                (repeats.ranges.iter())
                    .any(|o| rows.start < o.end && rows.end > o.start - repeats.rows)
            })
        };
        for rows in rests(r).into_iter().filter(|rows| !told(rows)) {
            let (e, ok) = (&e[rows.clone()], &ok[rows]);
            found.push(of(e, ok, r.sample_s, FloorSource::Rest, 1.0));
        }
        found.extend(repeated.map(|(_, own)| own));
    }
    found.retain(Estimate::counts);
    found
}

/// What the differences between rows and the rows a period before tell: of residuals or of positions, whichever is the smaller. The
/// noise of a measured input goes through the model into the residuals, and not into the positions; they are the same rows.
fn between_periods(
    r: &Record,
    e: &[f64],
    present: &[bool],
    repeats: &Repeats,
    walks: bool,
) -> Option<Estimate> {
    let p = repeats.rows;
    let last = repeats.ranges.last().map_or(p, |range| range.end);
    let rows = p..last;
    let ok: Vec<bool> = rows
        .clone()
        .map(|k| {
            let inside = repeats.ranges.iter().any(|range| range.contains(&k));
            inside && present[k] && present[k - p]
        })
        .collect();
    let periods = ok.iter().filter(|ok| **ok).count() as f64 / p as f64;
    let since = |values: &[f64]| apart(&values[rows.clone()], values);
    let command = since(&r.pzt_um);
    let told = |values: &[f64]| {
        let told = Differences {
            command_um: &command,
            of: &since(values),
            ok: &ok,
        };
        let mut own = told.noise(r.sample_s, FloorSource::Periods, walks);
        own.independent = independent(periods);
        own
    };
    [told(e), told(&r.bead_um)]
        .into_iter()
        .filter(|f| f.c0 > 0.0)
        .min_by(|a, b| a.sigma().total_cmp(&b.sigma()))
}

/// Differences row by row; nothing where a value is missing.
fn apart(a: &[f64], b: &[f64]) -> Vec<f64> {
    let differences = a.iter().zip(b).map(|(a, b)| a - b);
    differences
        .map(|d| if d.is_finite() { d } else { 0.0 })
        .collect()
}

/// Holds of a bead in closed loop: stretches in which the command moves the bead by less than the noise does. The estimate leaves out
/// the linear response to the command.
fn of_holds(records: &[Record], present: &[Vec<bool>], residuals: &[Vec<f64>]) -> Vec<Estimate> {
    let mut found: Vec<Estimate> = Vec::new();
    for ((r, e), ok) in records.iter().zip(residuals).zip(present) {
        for rows in holds(r, e, ok) {
            let (u, e, ok) = (&r.pzt_um[rows.clone()], &e[rows.clone()], &ok[rows]);
            let raw = Estimate {
                source: FloorSource::Rest,
                ..of_increments(e, ok)
            };
            found.extend(raw.without_response((u, e, ok), r.sample_s, 1.0));
        }
    }
    found.retain(Estimate::counts);
    found
}

/// What the noise of loops is whose command comes back to itself but for their answers to the noise.
fn of_loops(records: &[Record], present: &[Vec<bool>], residuals: &[Vec<f64>]) -> Vec<Estimate> {
    (records.iter().zip(present).zip(residuals))
        .filter_map(|((r, ok), e)| between_periods(r, e, ok, &nearly_repeats(r)?, true))
        .filter(Estimate::counts)
        .collect()
}

/// Variance that the finest step of the position column adds: a sensor that counts is never better than that.
fn quantisation_um2(records: &[Record]) -> f64 {
    records
        .iter()
        .filter(|r| r.is_quantised())
        .map(|r| r.resolution_um * r.resolution_um / 12.0)
        .fold(0.0, f64::max)
}

/// A noise with the walk and the white noise of the greatest likelihood; `unlikelihood` is twice the negative log-likelihood of a
/// fit's residual. Increments alone would take a zero flow that drifts for a walk.
pub(crate) fn refined(noise: &NoiseModel, unlikelihood: impl Fn(&NoiseModel) -> f64) -> NoiseModel {
    // Shares of the increments' variance that white noise may have.
    const LEAST: f64 = -NoiseModel::MOST_CORRELATION;
    const RANGE: f64 = -NoiseModel::LEAST_CORRELATION - LEAST;
    let of = |[size, share]: [f64; 2]| {
        let variance = size.exp();
        let white = variance * (LEAST + RANGE / (1.0 + (-share).exp()));
        NoiseModel {
            coloured: noise.coloured,
            zero_flow: noise.zero_flow,
            ..NoiseModel::from_increments(variance, -white)
        }
    };
    let variance = noise.walk_um2 + 2.0 * noise.white_um2;
    let share = ((noise.white_um2 / variance - LEAST) / RANGE).clamp(1e-3, 1.0 - 1e-3);
    let begun = [variance.ln(), (share / (1.0 - share)).ln()];
    of(descend(begun, 2e-3, |x| unlikelihood(&of(x))))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn measured(sigma: f64, rows: usize) -> Estimate {
        Estimate {
            c0: sigma * sigma,
            c1: 0.0,
            rows,
            independent: 1.0,
            source: FloorSource::Rest,
            alone: Default::default(),
            share: 1.0,
        }
    }

    #[test]
    fn a_stretch_that_is_quiet_by_chance_is_not_the_floor() {
        // 481 rows know a standard deviation to 3.2 %.
        let all = [measured(0.94, 481), measured(1.0, 20_000)];
        let least = (all.iter().min_by(|a, b| a.most().total_cmp(&b.most()))).unwrap();
        assert_eq!(least.rows, 20_000);
        let floor = pooled(&all, least).sigma();
        assert!((floor - 1.0).abs() < 0.005, "{floor}");
        // What is larger by more than that is a misfit.
        let floor = pooled(
            &[measured(1.0, 481), measured(1.3, 20_000)],
            &measured(1.0, 481),
        );
        assert!((floor.sigma() - 1.0).abs() < 1e-9);
    }

    /// Estimates of the noise over many seeds, each from this number of records: a walk behind a command of 450 rows. Checked: the
    /// scatter of the variance over that of the stated number of independent increments.
    fn scatter(commands: &[Vec<f64>]) -> f64 {
        const SEEDS: u64 = 300;
        let mut squares = 0.0;
        for seed in 0..SEEDS {
            let mut random = cellpos_numeric::Random::new(seed);
            let (mut records, mut residuals, mut present) = (Vec::new(), Vec::new(), Vec::new());
            for (i, u) in commands.iter().enumerate() {
                let t: Vec<f64> = (0..u.len()).map(|k| 1e-3 * k as f64).collect();
                let mut walk = 0.0;
                let steps = std::iter::repeat_with(|| {
                    walk += random.normal();
                    walk
                });
                let walk: Vec<f64> = steps.take(u.len()).collect();
                let y: Vec<f64> = u.iter().zip(&walk).map(|(u, w)| u + w).collect();
                records.push(Record::from_rows(&format!("r{i}"), &t, u, &y).unwrap());
                present.push(vec![true; u.len()]);
                residuals.push(walk);
            }
            let floor = estimate(&records, &present, &residuals, None, NoiseKind::Walk);
            let error = floor.noise.innovation_um().powi(2) - 1.0;
            squares += error * error * floor.rows as f64 / 2.0;
        }
        squares / SEEDS as f64
    }

    #[test]
    fn every_row_is_counted_once() {
        let mut random = cellpos_numeric::Random::new(3);
        let levels: Vec<f64> = (0..45).map(|_| 10.0 * random.uniform()).collect();
        let once: Vec<f64> = (0..450).map(|k| levels[k / 10]).collect();
        let periods = |n: usize| once.repeat(n);
        let rest = vec![5.0; 450];
        let ways = [
            vec![periods(2)],
            vec![periods(5)],
            vec![once.clone(), once.clone(), once.clone(), once.clone()],
            vec![once.clone(), rest.clone(), rest.clone(), rest],
            vec![periods(3), periods(3)],
        ];
        for (i, way) in ways.iter().enumerate() {
            let scatter = scatter(way);
            // 300 squares scatter by 8 %.
            assert!((0.75..1.3).contains(&scatter), "{i}: {scatter}");
        }
    }
}
