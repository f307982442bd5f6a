//! The check on data not used in fitting: whole records (frequencies, amplitudes, wave forms) and the last part of the
//! time.

use crate::fit::{Context, Fit};
use crate::map::{BAND_EDGES_HZ, DiscrepancyMap};
use crate::parallel;
use crate::problem::{Mask, split_in_time};
use crate::result::{BandGap, Interval, RecordGap};

/// What the held-out check found.
#[derive(Debug, Clone)]
pub(crate) struct HeldOut {
    /// RMS innovation of the null on held-out records \[um\].
    pub before_um: f64,
    /// RMS innovation of the set, fitted without the record \[um\].
    pub after_um: f64,
    pub per_record: Vec<RecordGap>,
    /// Parts that do not help in the last 40 % of the time when fitted on the first 60 %.
    pub unconfirmed: Vec<usize>,
    /// How far a free base gain moves when it is refitted together with the set.
    pub gain_shift: Interval,
}

/// Runs the check.
pub(crate) fn check(ctx: &Context<'_>, fit: &Fit, threads: usize) -> HeldOut {
    let records = &ctx.problem.records;
    let sigma = ctx.problem.noise.innovation_um();
    // Records: each predicted by a fit to all others. Amplitudes and phases of lines are each record's own: kept.
    let folds: Vec<usize> = (0..records.len()).collect();
    let results = parallel::map(&folds, threads, |&i| {
        let mut train = ctx.problem.all();
        let mut test: Mask = vec![Vec::new(); records.len()];
        std::mem::swap(&mut train[i], &mut test[i]);
        let null = ctx.fit(Vec::new(), &train, 3);
        let enough = records.len() > 1 && ctx.problem.count(&train) > 2000;
        let refit = if fit.parts.is_empty() {
            null.clone()
        } else if enough {
            let mut f = ctx.refit(fit, &train, 4);
            f.lines.clone_from(&fit.lines);
            let (innovations, _) = ctx.innovations(&f, &train);
            f.innovations = innovations;
            f
        } else {
            fit.clone()
        };
        (
            null.chi2_on(&test),
            refit.chi2_on(&test),
            ctx.problem.count(&test),
        )
    });
    let per_record: Vec<RecordGap> = records
        .iter()
        .zip(&results)
        .map(|(r, (before, after, n))| {
            let rms = |c: f64| sigma * (c / (*n).max(1) as f64).sqrt();
            RecordGap {
                record: r.name.clone(),
                before: rms(*before),
                after: rms(*after),
            }
        })
        .collect();
    let total: f64 = results.iter().map(|r| r.2 as f64).sum::<f64>().max(1.0);
    let rms = |pick: fn(&(f64, f64, usize)) -> f64| {
        sigma * (results.iter().map(pick).sum::<f64>() / total).sqrt()
    };
    // Time: the first 60 % of every record predict the rest.
    let (train, test) = split_in_time(records);
    let indices: Vec<usize> = (0..fit.parts.len()).collect();
    let whole = (!fit.parts.is_empty()).then(|| ctx.refit(fit, &train, 4).chi2_on(&test));
    let unconfirmed = parallel::map(&indices, threads, |&i| {
        let mut parts = fit.parts.clone();
        parts.remove(i);
        let without = ctx
            .fit_from(parts, Some(fit.soft), &train, 6)
            .chi2_on(&test);
        whole.is_some_and(|w| without - w < 2.0)
    });
    let unconfirmed = indices
        .into_iter()
        .zip(unconfirmed)
        .filter(|(_, u)| *u)
        .map(|(i, _)| i)
        .collect();
    HeldOut {
        before_um: rms(|r| r.0),
        after_um: rms(|r| r.1),
        per_record,
        unconfirmed,
        gain_shift: gain_shift(ctx, fit),
    }
}

/// Refits with a free gain beside the set (or alone) and says how far it moves from 1.
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
    if fit.has("gain-error") {
        return Interval {
            value: 1.0,
            ci95: [1.0, 1.0],
            unit,
        };
    }
    let Some(v) = crate::catalogue::VARIANTS
        .iter()
        .position(|v| v.id == "gain-error")
    else {
        return Interval {
            value: 1.0,
            ci95: [1.0, 1.0],
            unit,
        };
    };
    let mut parts = fit.parts.clone();
    parts.push(crate::fit::Part::new(v, &[1.0]));
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
    let n = BAND_EDGES_HZ.len() - 1;
    (0..n)
        .map(|b| {
            let rms = |m: &DiscrepancyMap| {
                let cells: Vec<f64> = m
                    .rows
                    .iter()
                    .filter(|r| r.cells.len() > n)
                    .map(|r| r.cells[b].rms_um.powi(2))
                    .collect();
                (cells.iter().sum::<f64>() / cells.len().max(1) as f64).sqrt()
            };
            let floor = before.rows.first().map_or(0.0, |r| r.cells[b].floor_um);
            BandGap {
                low_hz: BAND_EDGES_HZ[b],
                high_hz: BAND_EDGES_HZ[b + 1],
                before: rms(before),
                after: rms(after),
                floor,
            }
        })
        .collect()
}
