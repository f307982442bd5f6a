//! The noise floor, from the records or from what is stated, before any model is believed; or the statement that it is not
//! known.

use crate::data::coloured::{Alone, NoiseKind, choose};
use crate::data::noise::NoiseModel;
use crate::data::record::Record;
use crate::data::repeats::{Repeats, repeats, rests, whole_periods};
use crate::data::zero_flow::descend;
use crate::thresholds::THRESHOLDS;
use serde::Serialize;
use std::f64::consts::TAU;

/// Where the noise floor comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum FloorSource {
    /// Records whose command rests.
    Rest,
    /// Differences of successive periods of a command that repeats.
    Periods,
    /// Differences of records with the same command.
    EqualRecords,
    /// The noise that the model states.
    Stated,
    /// Nowhere: nothing rests or repeats, and nothing is stated. The figures are then the fit's own residual.
    Unknown,
}

impl FloorSource {
    /// In words, for results.
    pub fn words(self) -> &'static str {
        match self {
            Self::Rest => "measured at rest",
            Self::Periods => "measured between periods of the command",
            Self::EqualRecords => "measured between records of the same command",
            Self::Stated => {
                "stated in the model: no record has a rest of the command or repeats it for long enough"
            }
            Self::Unknown => {
                "not known: no rest of the command, no repeated command, no stated noise"
            }
        }
    }

    /// Whether there is a floor at all.
    pub fn is_known(self) -> bool {
        self != Self::Unknown
    }
}

/// The noise floor of a set of records.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Floor {
    pub noise: NoiseModel,
    pub source: FloorSource,
    /// Increments that it was measured from; 0 where it was not.
    pub rows: usize,
}

/// Variance and lag-1 covariance of increments, how many, and where from.
#[derive(Debug, Clone)]
struct Estimate {
    c0: f64,
    c1: f64,
    rows: usize,
    source: FloorSource,
    /// The noise itself, lines and jumps off, and which rows count.
    alone: (Vec<f64>, Vec<bool>),
    share: f64,
}

impl Estimate {
    fn alone(&self) -> Alone<'_> {
        Alone {
            values: &self.alone.0,
            counts: &self.alone.1,
            share: self.share,
        }
    }

    fn sigma(&self) -> f64 {
        NoiseModel::from_increments(self.c0, self.c1).innovation_um()
    }

    /// The most that the standard deviation is, by so many increments.
    fn most(&self) -> f64 {
        self.sigma() * (1.0 + error_of(self.rows))
    }
}

/// Error of a noise's standard deviation from so many increments, in parts of it: three standard deviations, for of several estimates
/// one is small by chance. A noise that was not measured is taken as it is stated.
pub(crate) fn error_of(rows: usize) -> f64 {
    match rows {
        0 => 0.0,
        rows => 3.0 / (2.0 * rows as f64).sqrt(),
    }
}

/// Estimates both noises from residuals of the null model.
///
/// A rest record shows the noise itself (lines at the mains frequency and a drift taken off); of a record whose command
/// repeats, the difference of successive periods cancels every response that repeats, and so does the difference of two
/// records of the same command. The one that is surely smallest rules, with those that differ from it by chance: a misfit can only
/// add, and the smallest of several that are known badly is too small. Without any, what the model states is
/// taken, as long as the records do not lie below it; and without that, the floor is not known, and the increments of the
/// residuals stand in for the figures alone.
pub(crate) fn estimate(
    records: &[Record],
    present: &[Vec<bool>],
    residuals: &[Vec<f64>],
    stated: Option<NoiseModel>,
    kind: NoiseKind,
) -> Floor {
    let whole = crate::data::record::command_range_um(records);
    let mut found: Vec<Estimate> = Vec::new();
    let mut own: Vec<Estimate> = Vec::new();
    for (i, r) in records.iter().enumerate() {
        let (e, present_i) = (&residuals[i], &present[i]);
        if r.rests_within(THRESHOLDS.rest_share * whole) {
            found.push(of(e, present_i, r.sample_s, FloorSource::Rest, 1.0));
        } else if let Some(repeats) = whole_periods(r) {
            for (d, ok) in between_periods(r, e, present_i, &repeats) {
                found.push(of(&d, &ok, r.sample_s, FloorSource::Periods, 0.5));
            }
        }
        for j in 0..i {
            if r.same_command(&records[j]) {
                let n = e.len().min(residuals[j].len());
                let ok: Vec<bool> = (0..n).map(|k| present_i[k] && present[j][k]).collect();
                let d: Vec<f64> = (0..n).map(|k| e[k] - residuals[j][k]).collect();
                found.push(of(&d, &ok, r.sample_s, FloorSource::EqualRecords, 0.5));
            }
        }
        let (c0, c1, rows) = increment_moments(e, present_i);
        own.push(Estimate {
            c0,
            c1,
            rows,
            source: FloorSource::Unknown,
            alone: (e.clone(), present_i.clone()),
            share: 1.0,
        });
    }
    let quantum_um2 = quantisation_um2(records);
    // Steps of a sensor that counts are no Gaussian process: nothing is read from their correlation unasked.
    let unasked = kind == NoiseKind::Auto && quantum_um2 > 0.0;
    let kind = if unasked { NoiseKind::Walk } else { kind };
    let counts = |f: &Estimate| f.rows >= THRESHOLDS.floor_rows && f.c0 > 0.0;
    // Where no record as a whole tells the noise, parts of them may: a misfit can only add.
    if !found.iter().any(counts) {
        for (i, r) in records.iter().enumerate() {
            let (e, ok) = (&residuals[i], &present[i]);
            if let Some(repeats) = repeats(r) {
                for (d, ok) in between_periods(r, e, ok, &repeats) {
                    found.push(of(&d, &ok, r.sample_s, FloorSource::Periods, 0.5));
                }
            }
            for rows in rests(r) {
                let (e, ok) = (&e[rows.clone()], &ok[rows]);
                found.push(of(e, ok, r.sample_s, FloorSource::Rest, 1.0));
            }
        }
    }
    found.retain(counts);
    if let Some(least) = found.iter().min_by(|a, b| a.most().total_cmp(&b.most())) {
        let pooled = pooled(&found, least);
        let walk = NoiseModel::from_increments(pooled.c0, pooled.c1);
        let alone = least.alone();
        return Floor {
            noise: choose(kind, walk, &alone).at_least(quantum_um2),
            source: least.source,
            rows: pooled.rows,
        };
    }
    own.retain(|f| f.rows >= 20 && f.c0 > 0.0);
    let residual = own
        .iter()
        .min_by(|a, b| a.most().total_cmp(&b.most()))
        .map(|least| {
            let all = pooled(&own, least);
            let walk = NoiseModel::from_increments(all.c0, all.c1);
            // What a base that was fitted to these records leaves is a sensor's noise or a slow disturbance: seldom a walk.
            choose(kind, walk, &least.alone()).at_least(quantum_um2)
        });
    let sample_s = records.first().map_or(1e-3, |r| r.sample_s);
    match (stated, residual) {
        (Some(noise), Some(least))
            if noise.innovation_um() < (1.0 + THRESHOLDS.stated_excess) * least.innovation_um() =>
        {
            Floor {
                noise: noise.at_least(quantum_um2),
                source: FloorSource::Stated,
                rows: 0,
            }
        }
        (_, least) => Floor {
            noise: least.unwrap_or_else(|| NoiseModel::new(0.33, sample_s, 0.03)),
            source: FloorSource::Unknown,
            rows: 0,
        },
    }
}

/// An estimate from residuals or differences that hold nothing but noise, `share` of it that of one record.
fn of(e: &[f64], ok: &[bool], sample_s: f64, source: FloorSource, share: f64) -> Estimate {
    let clean = without_lines(e, ok, sample_s);
    let counts = without_jumps(&clean, ok);
    let (c0, c1, rows) = increment_moments(&clean, &counts);
    Estimate {
        c0: share * c0,
        c1: share * c1,
        rows,
        source,
        alone: (clean, counts),
        share,
    }
}

/// Differences of residuals and of positions between a row and the row a period before, and which of them count.
fn between_periods(
    r: &Record,
    e: &[f64],
    present: &[bool],
    repeats: &Repeats,
) -> [(Vec<f64>, Vec<bool>); 2] {
    let p = repeats.rows;
    let first = repeats.ranges.first().map_or(p, |range| range.start);
    let last = repeats.ranges.last().map_or(p, |range| range.end);
    let rows = first..last;
    let ok: Vec<bool> = rows
        .clone()
        .map(|k| {
            let inside = repeats.ranges.iter().any(|range| range.contains(&k));
            inside && present[k] && present[k - p]
        })
        .collect();
    // The noise of a measured input goes through the model into the residuals, and not into the positions.
    let y = &r.bead_um;
    let of_residuals = rows.clone().map(|k| e[k] - e[k - p]).collect();
    let of_positions = rows
        .map(|k| y[k] - y[k - p])
        .map(|d| if d.is_finite() { d } else { 0.0 })
        .collect();
    [(of_residuals, ok.clone()), (of_positions, ok)]
}

/// Those that differ from the least by chance together.
fn pooled(of: &[Estimate], least: &Estimate) -> Estimate {
    let by_chance = |f: &&Estimate| {
        let error = error_of(f.rows).hypot(error_of(least.rows));
        (f.sigma() / least.sigma() - 1.0).abs() <= error
    };
    let near: Vec<&Estimate> = of.iter().filter(by_chance).collect();
    let n: f64 = near.iter().map(|f| f.rows as f64).sum::<f64>().max(1.0);
    let mean =
        |get: fn(&Estimate) -> f64| near.iter().map(|f| get(f) * f.rows as f64).sum::<f64>() / n;
    Estimate {
        c0: mean(|f| f.c0),
        c1: mean(|f| f.c1),
        rows: n as usize,
        source: FloorSource::Unknown,
        alone: Default::default(),
        share: 1.0,
    }
}

/// Variance that the finest step of the position column adds: a sensor that counts is never better than that.
fn quantisation_um2(records: &[Record]) -> f64 {
    records
        .iter()
        .filter(|r| r.is_quantised())
        .map(|r| r.resolution_um * r.resolution_um / 12.0)
        .fold(0.0, f64::max)
}

/// A noise with the walk and the white noise of the greatest likelihood; `unlikelihood` is twice the negative log-likelihood of what a fit
/// leaves. Increments alone would take a zero flow that drifts for a walk.
pub(crate) fn refined(noise: &NoiseModel, unlikelihood: impl Fn(&NoiseModel) -> f64) -> NoiseModel {
    // Shares of the increments' variance that white noise may have, as [`NoiseModel::from_increments`] has them.
    const LEAST: f64 = -0.25;
    const RANGE: f64 = 0.7495;
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

/// Variance and lag-1 covariance of increments over runs of present frames, and how many increments.
pub(crate) fn increment_moments(r: &[f64], present: &[bool]) -> (f64, f64, usize) {
    let (mut c0, mut c1, mut n0, mut n1, mut mean) = (0.0, 0.0, 0usize, 0usize, 0.0);
    let valid = |k: usize| k >= 1 && present[k] && present[k - 1];
    for k in 1..r.len() {
        if valid(k) {
            mean += r[k] - r[k - 1];
            n0 += 1;
        }
    }
    if n0 == 0 {
        return (0.0, 0.0, 0);
    }
    mean /= n0 as f64;
    for k in 1..r.len() {
        if valid(k) {
            let d = r[k] - r[k - 1] - mean;
            c0 += d * d;
            if valid(k - 1) {
                c1 += d * (r[k - 1] - r[k - 2] - mean);
                n1 += 1;
            }
        }
    }
    (
        c0 / n0 as f64,
        if n1 > 0 { c1 / n1 as f64 } else { 0.0 },
        n0,
    )
}

/// Rows that count, without those after an increment of more than six standard deviations (by the median of their sizes):
/// a bead that jumps is no noise, and must not raise the floor under which its jumps would then hide.
fn without_jumps(e: &[f64], present: &[bool]) -> Vec<bool> {
    let mut sizes: Vec<f64> = (1..e.len())
        .filter(|&k| present[k] && present[k - 1])
        .map(|k| (e[k] - e[k - 1]).abs())
        .collect();
    if sizes.is_empty() {
        return present.to_vec();
    }
    let middle = sizes.len() / 2;
    let (_, median, _) = sizes.select_nth_unstable_by(middle, f64::total_cmp);
    let limit = 6.0 * 1.4826 * *median;
    (0..e.len())
        .map(|k| {
            let jumps = k > 0 && limit > 0.0 && (e[k] - e[k - 1]).abs() > limit;
            present[k] && !jumps
        })
        .collect()
}

/// Takes lines at 50 and 60 Hz and their second harmonics off.
fn without_lines(e: &[f64], present: &[bool], sample_s: f64) -> Vec<f64> {
    let mut clean = e.to_vec();
    for hz in [50.0, 60.0, 100.0, 120.0] {
        if hz * sample_s > 0.45 {
            continue;
        }
        // On increments, where the walk does not leak into the line.
        let (mut ss, mut cc, mut sc, mut se, mut ce) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for k in 1..clean.len() {
            if present[k] && present[k - 1] {
                let w = TAU * hz * sample_s;
                let (s1, c1) = (w * k as f64).sin_cos();
                let (s0, c0) = (w * (k - 1) as f64).sin_cos();
                let (s, c, d) = (s1 - s0, c1 - c0, clean[k] - clean[k - 1]);
                ss += s * s;
                cc += c * c;
                sc += s * c;
                se += s * d;
                ce += c * d;
            }
        }
        let det = ss * cc - sc * sc;
        if det > 1e-12 {
            let (a, b) = ((cc * se - sc * ce) / det, (ss * ce - sc * se) / det);
            for (k, v) in clean.iter_mut().enumerate() {
                let (s, c) = (TAU * hz * sample_s * k as f64).sin_cos();
                *v -= a * s + b * c;
            }
        }
    }
    clean
}

#[cfg(test)]
mod tests {
    use super::*;

    fn measured(sigma: f64, rows: usize) -> Estimate {
        Estimate {
            c0: sigma * sigma,
            c1: 0.0,
            rows,
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
}
