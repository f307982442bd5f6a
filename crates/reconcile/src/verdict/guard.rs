//! Records that must get a message instead of a name: nothing moves, too little, other units, another rig.

use crate::data::record::Record;
use crate::dot::dot;
use crate::error::ReconcileError;
use crate::fit::context::Context;
use crate::thresholds::THRESHOLDS;
use crate::verdict::unlike::unlike;

/// Samples by which an output may be delayed, or seem to lead.
const MOST_SAMPLES: usize = 20;

/// Delays that are tried, in samples: one by one, and of another plant on as far as its lags reach, in steps of a tenth.
fn delays(ctx: &Context<'_>) -> Vec<usize> {
    let mut all: Vec<usize> = (0..=MOST_SAMPLES).collect();
    let most = (ctx.longest_delay_s() / ctx.problem.base.sample_s) as usize;
    let mut next = MOST_SAMPLES + 2;
    while ctx.problem.base.free_start && next <= most {
        all.push(next);
        next += next / 10;
    }
    all
}

/// What can be seen without a model.
pub(crate) fn records(records: &[Record], bead: bool) -> Result<(), ReconcileError> {
    let Some(first) = records.first() else {
        return Err(ReconcileError::NoRecords);
    };
    for r in records {
        if (r.sample_s / first.sample_s - 1.0).abs() > 1e-3 {
            return Err(ReconcileError::SampleTime {
                record: r.name.clone(),
                found_s: r.sample_s,
                expected_s: first.sample_s,
            });
        }
    }
    let moving: Vec<&Record> = records.iter().filter(|r| !r.is_rest()).collect();
    if moving.is_empty() {
        return Err(ReconcileError::ConstantInput);
    }
    let seconds: f64 = moving.iter().map(|r| r.frames() as f64 * r.sample_s).sum();
    let rows: usize = records.iter().map(Record::frames).sum();
    let least = match bead {
        true => THRESHOLDS.floor_rows,
        false => THRESHOLDS.needed_rows_of_others,
    };
    let needed = if bead && seconds < THRESHOLDS.needed_s {
        format!("{} s", THRESHOLDS.needed_s)
    } else if rows < least {
        format!("{least} rows")
    } else {
        return Ok(());
    };
    Err(ReconcileError::TooShort {
        seconds,
        rows,
        needed,
    })
}

/// Smallest and largest command of all records.
fn range_um(records: &[Record]) -> (f64, f64) {
    records
        .iter()
        .map(Record::pzt_range_um)
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), (c, d)| {
            (a.min(c), b.max(d))
        })
}

/// Whether commands look like volts: within 0 to 10, and at 4 um per volt near the working point.
pub fn looks_like_volts(records: &[Record], working_point_um: f64) -> bool {
    let (low, high) = range_um(records);
    low >= -0.5 && high <= 10.5 && (0.5 * (low + high) * 4.0 / working_point_um - 1.0).abs() < 0.5
}

/// The statement of the working point about the command's unit.
pub(crate) fn working_point(
    records: &[Record],
    working_point_um: f64,
) -> Result<(), ReconcileError> {
    let (low, high) = range_um(records);
    let span = (high - low).max(1e-9);
    if working_point_um < low - 0.5 * span || working_point_um > high + 0.5 * span {
        let volts = looks_like_volts(records, working_point_um);
        return Err(ReconcileError::WorkingPoint {
            low_um: low,
            high_um: high,
            working_point_um,
            hint: if volts {
                "the column looks like volts: convert at 4 um per volt, or name the column with --input-column and its scale with --input-um-per-unit"
            } else {
                "check the unit of the column and working_point_um of the model"
            },
        });
    }
    Ok(())
}

/// Whether the motion follows the command as the model says, at any gain and any delay up to 20 samples. A bead is judged by its
/// innovations, and by its positions, which a strong nonlinearity changes less. For another plant, whose model may come from these
/// records, a mismatch is no error but the result.
pub(crate) fn motion(ctx: &Context<'_>) -> Result<Option<String>, ReconcileError> {
    let problem = ctx.problem;
    let sim = ctx.simulated(&[], 0.0, &problem.all());
    let delays = delays(ctx);
    let (mut yy, mut count) = (0.0, 0.0);
    let mut white: Vec<(Vec<f64>, Vec<f64>)> = Vec::new();
    for (r, s) in problem.records.iter().zip(&sim) {
        if r.rest {
            continue;
        }
        let (mut y, mut w) = (vec![0.0; s.len()], vec![0.0; s.len()]);
        // A command that is off its working point would drown everything in a ramp; take the ramp off both.
        r.whiten(&without_ramp(&r.y, &r.present), &mut y);
        r.whiten(&without_ramp(s, &r.present), &mut w);
        yy += dot(&y, &y);
        count += r.whitener.count() as f64;
        white.push((y, w));
    }
    let (mut best, mut gain) = (0.0f64, 0.0f64);
    let ss: f64 = white.iter().map(|(_, s)| dot(s, s)).sum();
    for &d in &delays {
        let ys: f64 = white
            .iter()
            .map(|(y, s)| dot(&y[d.min(y.len())..], &s[..s.len().saturating_sub(d)]))
            .sum();
        if ss > 0.0 && ys * ys / ss > best {
            best = ys * ys / ss;
            gain = ys / ss;
        }
    }
    if let Some(lead) = leads(&white, &delays) {
        return Err(ReconcileError::Leads {
            lead_s: lead as f64 * problem.base.sample_s,
        });
    }
    let excess = yy - count;
    // Of another plant the noise may be the residual of a base that is far too poor. A bubble or a slow wall takes the fast motion
    // away, which is what innovations show; the slow motion then still goes with the command.
    let still = excess < 0.02 * count && ss > 0.5 * count && !problem.base.free_start;
    if still && level_likeness(problem, &sim, &delays).0 <= THRESHOLDS.least_alike {
        return Err(ReconcileError::AnotherRig {
            explained_percent: 0.0,
            detail: "; the bead hardly moves although the command does".to_owned(),
        });
    }
    if excess < 0.02 * count {
        return Ok(None);
    }
    let explained = best / excess;
    let units = |what, hint| {
        Err(ReconcileError::Units {
            what,
            ratio: gain,
            hint,
        })
    };
    if explained > 0.25 && problem.base.free_start {
        return of_other_data(gain).map(|()| None);
    }
    if explained > 0.25 {
        of_a_bead(gain)?;
        // A lag takes fast motion away, and no unit: the gain of slow motion has a say.
        let plausible = 0.3..=3.0;
        if !plausible.contains(&gain)
            && !plausible.contains(&level_likeness(problem, &sim, &delays).1)
        {
            return units(
                "the gain of command or position",
                "check the units of both columns and the model file",
            );
        }
        return Ok(None);
    }
    let (alike, _) = level_likeness(problem, &sim, &delays);
    if explained.max(alike) > THRESHOLDS.least_alike {
        return Ok(None);
    }
    if problem.base.free_start {
        let signless: Vec<Vec<f64>> = sim
            .iter()
            .map(|s| s.iter().map(|v| v.abs()).collect())
            .collect();
        let (without_sign, _) = level_likeness(problem, &signless, &delays);
        return Ok(Some(unlike(
            &problem.records,
            explained.max(alike),
            without_sign,
        )));
    }
    Err(ReconcileError::AnotherRig {
        explained_percent: 100.0 * explained.max(alike).clamp(0.0, 1.0),
        detail: String::new(),
    })
}

/// The statement of a gain about the units of a bead's records.
fn of_a_bead(gain: f64) -> Result<(), ReconcileError> {
    let units = |what, hint| {
        Err(ReconcileError::Units {
            what,
            ratio: gain,
            hint,
        })
    };
    if gain < 0.0 {
        return units(
            "sign",
            "the bead moves against the model: swap the sign of the bead or of the command",
        );
    }
    if gain > 100.0 {
        return units(
            "bead_um looks like nanometres",
            "divide the column by 1000, or pass its scale with --output-um-per-unit 0.001",
        );
    }
    if gain < 0.01 {
        return units(
            "bead_um looks like millimetres",
            "multiply the column by 1000, or pass its scale with --output-um-per-unit 1000",
        );
    }
    if (3.0..5.5).contains(&gain) {
        return units(
            "pzt_um looks like volts",
            "convert at 4 um per volt, or pass its scale with --input-um-per-unit 4",
        );
    }
    Ok(())
}

/// Of another plant's units only those of its model are known.
fn of_other_data(gain: f64) -> Result<(), ReconcileError> {
    if (0.3..=3.0).contains(&gain) {
        return Ok(());
    }
    Err(ReconcileError::Units {
        what: "model and records differ in a factor",
        ratio: gain,
        hint: "they have other units (--input-um-per-unit, --output-um-per-unit), or the model is of another plant: identify it from these records",
    })
}

/// Part of the variance of the positions that the model's own positions explain at the best gain and delay, and that gain.
fn level_likeness(
    problem: &crate::problem::Problem,
    sim: &[Vec<f64>],
    delays: &[usize],
) -> (f64, f64) {
    let (mut best, mut gain, mut yy, mut ss) = (0.0f64, 0.0f64, 0.0, 0.0);
    let pairs: Vec<(Vec<f64>, Vec<f64>)> = problem
        .records
        .iter()
        .zip(sim)
        .filter(|(r, _)| !r.rest)
        .map(|(r, s)| (r.without_start(&r.y, true), r.without_start(s, true)))
        .collect();
    for (y, s) in &pairs {
        yy += dot(y, y);
        ss += dot(s, s);
    }
    for &d in delays {
        let ys: f64 = pairs
            .iter()
            .map(|(y, s)| dot(&y[d.min(y.len())..], &s[..s.len().saturating_sub(d)]))
            .sum();
        if ss > 0.0 && yy > 0.0 && ys * ys / (ss * yy) > best {
            best = ys * ys / (ss * yy);
            gain = ys / ss;
        }
    }
    (best, gain)
}

/// By how many samples the output leads, where it fits clearly better so than with any delay.
fn leads(white: &[(Vec<f64>, Vec<f64>)], delays: &[usize]) -> Option<usize> {
    let at = |d: isize| -> f64 {
        let k = d.unsigned_abs();
        let ys: f64 = white
            .iter()
            .map(|(y, s)| {
                let (a, b) = if d >= 0 { (y, s) } else { (s, y) };
                dot(&a[k.min(a.len())..], &b[..b.len().saturating_sub(k)])
            })
            .sum();
        ys * ys
    };
    let most = MOST_SAMPLES as isize;
    let late = (delays.iter()).map(|d| at(*d as isize)).fold(0.0, f64::max);
    let (lead, early) = (2..=most)
        .map(|d| (d, at(-d)))
        .max_by(|a, b| a.1.total_cmp(&b.1))?;
    (early > 4.0 * late && early > 0.0).then_some(lead as usize)
}

fn without_ramp(y: &[f64], present: &[bool]) -> Vec<f64> {
    let (mut n, mut t1, mut t2, mut y1, mut ty) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for (k, (v, p)) in y.iter().zip(present).enumerate() {
        if *p {
            let t = k as f64;
            n += 1.0;
            t1 += t;
            t2 += t * t;
            y1 += v;
            ty += t * v;
        }
    }
    let det = n * t2 - t1 * t1;
    if det <= 0.0 {
        return y.to_vec();
    }
    let (slope, offset) = ((n * ty - t1 * y1) / det, (t2 * y1 - t1 * ty) / det);
    y.iter()
        .zip(present)
        .enumerate()
        .map(|(k, (v, p))| {
            if *p {
                v - offset - slope * k as f64
            } else {
                0.0
            }
        })
        .collect()
}
