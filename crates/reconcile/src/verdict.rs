//! The workflow: guards, null model, search, held-out check, verdict, and the augmented model.

use crate::augment::{augment, parameters, place_of};
use crate::catalogue::{self, CURVATURE, Scope, VARIANTS};
use crate::data::{self, Record};
use crate::error::ReconcileError;
use crate::fit::{Context, Fit, Part, WhiteEvidence};
use crate::frames::{self, FrameCounts};
use crate::guard;
use crate::held_out::{self, HeldOut};
use crate::hypothesis;
use crate::map;
use crate::noise::Noise;
use crate::predict::{Base, Block, Zpk};
use crate::problem::Problem;
use crate::result::{
    Effect as NamedEffect, Gap, GapStep, Interval, Reconciliation, Traces, Verdict,
};
use crate::search::{self, Effort, Found, ids, implausibility, left_over};
use crate::{floor, significance};
use cellpos_plant::Model;
use std::collections::BTreeMap;

/// How to run.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Threads for candidates; the result does not depend on it.
    pub threads: usize,
    /// Most effects to add.
    pub max_effects: usize,
    /// The command is an analogue signal sampled together with the output, not held between rows.
    pub interpolated_input: bool,
    /// The base model is a constant gain fitted to these very records, those of a bare actuator and its displacement
    /// sensor: the gain is free in every fit, the null included, and effects of the chip and of the bead are not looked for.
    pub free_gain: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            threads: 2,
            max_effects: 4,
            interpolated_input: false,
            free_gain: false,
        }
    }
}

/// Finds, names and adds what a model lacks.
///
/// `progress` is told in words what goes on. The result depends on nothing but the model, the records and the options:
/// neither on the order of the records nor on the number of threads, and a record cut in two is put together again.
///
/// # Errors
/// Records or a model about which no verdict is possible: see [`ReconcileError`].
pub fn reconcile(
    model: &Model,
    records: &[Record],
    options: &Options,
    progress: &mut dyn FnMut(&str),
) -> Result<Reconciliation, ReconcileError> {
    let records = data::canonical(records.to_vec());
    guard::records(&records)?;
    guard::working_point(&records, model.working_point_um)?;
    let frames = frames::count(&records);
    let none: Vec<Vec<bool>> = records.iter().map(|r| vec![false; r.rows()]).collect();
    let repeated = if frames.repeats_named() {
        &frames.repeated
    } else {
        &none
    };
    let base = base_of(model, &records, options)?;
    let scope = scope_of(model, &records, &base);
    let fixed = fixed_blocks(model, &scope);
    let start = Noise::new(
        model.noise.diffusion_um2_per_s.max(1e-4),
        base.sample_s,
        model.noise.localisation_um.max(1e-3),
    );
    let problem = Problem::new(base, &records, repeated, start);
    let present: Vec<Vec<bool>> = problem.records.iter().map(|r| r.present.clone()).collect();

    progress("null model and noise floor");
    let first = context(&problem, scope, &fixed, options).fit(Vec::new(), &problem.all(), 4);
    let (residual, _) = context(&problem, scope, &fixed, options).residual(&first);
    let (noise, trusted) = floor::estimate(&records, &present, &residual);
    let problem = problem.with_noise(noise);
    guard::motion(&context(&problem, scope, &fixed, options))?;

    let effort = Effort {
        threads: options.threads,
        max_effects: options.max_effects,
    };
    let mut noise = noise;
    let mut problem = problem;
    let mut found;
    let mut round = 0;
    loop {
        let ctx = Context {
            white: evidence(model, &noise, trusted, &problem),
            ..context(&problem, scope, &fixed, options)
        };
        found = search::search(&ctx, &problem.all(), effort, &mut *progress);
        // What the final residual shows is at least as good an estimate of the noise, if the fit is good.
        let (residual, _) = ctx.residual(&found.fit);
        let refined = floor::from_residuals(&present, &residual);
        round += 1;
        if round >= 2 || refined.innovation_um() > 0.97 * noise.innovation_um() {
            break;
        }
        noise = refined;
        problem = problem.with_noise(noise);
    }
    let ctx = Context {
        white: evidence(model, &noise, trusted, &problem),
        ..context(&problem, scope, &fixed, options)
    };
    progress("held-out check");
    let mut held = held_out::check(&ctx, &found.fit, options.threads);
    // What does not help where it was not fitted is not named.
    while let Some(i) = held.unconfirmed.first().copied() {
        progress(&format!(
            "{} does not hold on held-out data: taken back",
            ids(&found.fit)[i]
        ));
        let mut parts = found.fit.parts.clone();
        parts.remove(i);
        if i < found.rivals.len() {
            found.rivals.remove(i);
        }
        found.fit = ctx.fit(parts, &problem.all(), 12);
        held = held_out::check(&ctx, &found.fit, options.threads);
    }
    progress("map and verdict");
    Ok(assemble(model, &records, &ctx, found, held, &frames))
}

fn context<'a>(
    problem: &'a Problem,
    scope: Scope,
    fixed: &[Block],
    options: &Options,
) -> Context<'a> {
    Context {
        problem,
        scope,
        fixed: fixed.to_vec(),
        free_gain: options.free_gain,
        white: None,
    }
}

fn base_of(model: &Model, records: &[Record], options: &Options) -> Result<Base, ReconcileError> {
    let (num, den) = (model.plant.num(), model.plant.den());
    let (Some(n), Some(d)) = (num.first(), den.first()) else {
        return Err(ReconcileError::Model(
            "the plant has no coefficients".to_owned(),
        ));
    };
    let zpk = Zpk {
        zeros: model.plant.zeros(),
        poles: model.plant.poles(),
        gain: n / d,
    };
    if zpk.poles.iter().any(|p| p.re > 1e-6) {
        return Err(ReconcileError::Model(
            "the plant is unstable: a free run of it cannot be compared with a record".to_owned(),
        ));
    }
    Ok(Base {
        zpk,
        working_point_um: model.working_point_um,
        sample_s: records[0].sample_s,
        interpolated_input: options.interpolated_input,
    })
}

fn scope_of(model: &Model, records: &[Record], base: &Base) -> Scope {
    let (low, high) = records
        .iter()
        .map(Record::pzt_range_um)
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), (c, d)| {
            (a.min(c), b.max(d))
        });
    let w = model.working_point_um;
    Scope {
        working_point_um: w,
        low_um: low,
        high_um: high,
        // A sampled analogue input starts anywhere; what counts are the swings.
        stroke_um: if base.interpolated_input {
            (0.5 * (high - low)).max(1e-6)
        } else {
            (high - w).abs().max((w - low).abs()).max(1e-6)
        },
        sample_s: base.sample_s,
    }
}

fn fixed_blocks(model: &Model, scope: &Scope) -> Vec<Block> {
    model
        .ordered_effects()
        .into_iter()
        .filter_map(|e| catalogue::block_of(e, scope))
        .collect()
}

fn evidence(
    model: &Model,
    noise: &Noise,
    trusted: usize,
    problem: &Problem,
) -> Option<WhiteEvidence> {
    let model_um2 = model.noise.localisation_um.powi(2);
    if trusted < 5000 || model_um2 <= 0.0 {
        return None;
    }
    let variance = noise.walk_um2 + 2.0 * noise.white_um2;
    // Only where the walk is that of the model: else the model's noise says nothing about this rig.
    let walk = 2.0 * model.noise.diffusion_um2_per_s * problem.base.sample_s;
    if walk <= 0.0 || (noise.walk_um2 / walk - 1.0).abs() > 0.15 {
        return None;
    }
    Some(WhiteEvidence {
        estimate_um2: noise.white_um2,
        error_um2: 1.5 * variance / (trusted as f64).sqrt(),
        model_um2,
        walk_um2: noise.walk_um2,
    })
}

/// Rivals closer than this (twice the log-likelihood) cannot be told from the winner.
const TIE: f64 = 10.0;

/// Pairs of names that no record of command and bead position can tell apart.
fn inseparable(a: &str, b: &str) -> bool {
    matches!((a, b), ("driver-lag", "bubble") | ("bubble", "driver-lag"))
}

fn assemble(
    model: &Model,
    records: &[Record],
    ctx: &Context<'_>,
    found: Found,
    held: HeldOut,
    frames: &FrameCounts,
) -> Reconciliation {
    let Found {
        fit,
        null,
        steps,
        rivals,
    } = found;
    let all = ctx.problem.all();
    let sigma = ctx.problem.noise.innovation_um();
    let n = null.count as f64;
    let scatter = (2.0 * n + (0.012 * n).powi(2)).sqrt();
    let excess = null.chi2 - n;
    let left = fit.chi2 - n;
    let null_map = map::map(ctx, &null);
    let after_map = map::map(ctx, &fit);
    let mut places = map::sentences(ctx, &null, &null_map);

    let over = left_over(&fit);
    let mut effects = Vec::new();
    let mut ambiguous = false;
    let mut curvature = false;
    for (i, part) in fit.parts.iter().enumerate() {
        let id = part.variant().id;
        let mut parts = fit.parts.clone();
        parts.remove(i);
        let without = ctx.fit_from(parts, Some(fit.soft), &all, 8);
        let gain = (without.chi2 - fit.chi2).max(0.0);
        curvature |= mostly_curvature(ctx, &fit, i, gain);
        let mut alternatives: Vec<String> = Vec::new();
        for r in rivals.get(i).map_or(&[][..], Vec::as_slice) {
            if r.id == id || alternatives.iter().any(|a| a == r.id) {
                continue;
            }
            let decided = ctx.white.is_some_and(|w| {
                let mut other = fit.parts.clone();
                other[i] = r.part.clone();
                let s = ctx.problem.base.sample_s;
                w.distance(&other, s) - w.distance(&fit.parts, s) > 16.0
            });
            // A richer form that only holds the winner as a limit of its numbers is no rival; one as simple is, however
            // unusual its size, unless what is left over says that the last percent decides nothing.
            let rough = over > 0.02 * fit.count as f64;
            let price = if rough || r.part.theta.len() > part.theta.len() {
                implausibility(&r.part, over) - implausibility(part, over)
            } else {
                0.0
            };
            if r.chi2 + price - fit.chi2 < TIE && !decided {
                if !inseparable(id, r.id) {
                    ambiguous = true;
                }
                alternatives.push(r.id.to_owned());
            }
        }
        // A lag with a plain exponential is both, unless it dissolves.
        for (a, b) in [("driver-lag", "bubble"), ("bubble", "driver-lag")] {
            if id == a && part.variant().params.len() == 1 && !alternatives.iter().any(|x| x == b) {
                alternatives.push(b.to_owned());
            }
        }
        alternatives.sort();
        let needs_text = !alternatives.is_empty() || id == "gain-error";
        let freedom = crate::fit::freedom_of(part.variant(), ctx.problem.records.len());
        effects.push(NamedEffect {
            id: id.to_owned(),
            place: place_of(id),
            parameters: parameters(ctx, &fit, i, left / n),
            p_value: significance::p_value(gain, freedom),
            explained: if excess > 0.0 {
                (gain / excess).clamp(0.0, 1.0)
            } else {
                0.0
            },
            separate_by: needs_text.then(|| catalogue::separate_by(id, &alternatives)),
            alternatives,
        });
    }
    for (id, named, count, total, rate) in [
        (
            "frame-drops",
            frames.drops_named(),
            frames.missing,
            frames.rows,
            frames.drop_rate(),
        ),
        (
            "frame-repeats",
            frames.repeats_named(),
            frames.repeats,
            frames.pairs,
            frames.repeat_rate(),
        ),
    ] {
        if named {
            let chance = if id == "frame-repeats" {
                frames.by_chance
            } else {
                0.0
            };
            let wide = frames::wilson(count as f64, total.max(1) as f64);
            let off = chance / total.max(1) as f64;
            effects.push(NamedEffect {
                id: id.to_owned(),
                place: "camera",
                parameters: BTreeMap::from([(
                    "rate".to_owned(),
                    Interval {
                        value: rate,
                        ci95: [(wide[0] - off).max(0.0), (wide[1] - off).max(0.0)],
                        unit: String::new(),
                    },
                )]),
                p_value: significance::p_value(2.0 * (count as f64 - chance), 1),
                explained: 0.0,
                alternatives: Vec::new(),
                separate_by: None,
            });
            places.push(format!("{id}: {count} of {total} frames"));
        }
    }
    effects.sort_by(|a, b| {
        b.explained
            .total_cmp(&a.explained)
            .then_with(|| a.id.cmp(&b.id))
    });

    // Does the set close the gap?
    let beyond = null.chi2 - n > 4.0 * scatter || null_map.any_flagged();
    let closed = if excess > 0.0 {
        1.0 - left.max(0.0) / excess
    } else {
        1.0
    };
    let open = (left > 5.0 * scatter && closed < CLOSED) || curvature;
    let verdict = if !fit.parts.is_empty() && open {
        Verdict::Unknown
    } else if effects.is_empty() {
        if beyond {
            Verdict::Unknown
        } else {
            Verdict::NothingMissing
        }
    } else if ambiguous {
        Verdict::Ambiguous
    } else {
        Verdict::Named
    };
    let hypothesis = (verdict == Verdict::Unknown)
        .then(|| hypothesis::hypothesis(ctx, &null))
        .flatten();
    if verdict == Verdict::Unknown {
        let best = ids(&fit).join(" + ");
        places.push(if best.is_empty() {
            "no effect of the catalogue explains it".to_owned()
        } else if curvature {
            format!(
                "the best of the catalogue, {best}, needs a static curvature more than the memory of a hysteresis: no name"
            )
        } else {
            format!(
                "the best of the catalogue, {best}, closes {:.0} % of it: not enough for a name",
                100.0 * closed
            )
        });
    } else if after_map.any_flagged() && left > 4.0 * scatter {
        places.push(format!(
            "after the addition {:.1} % of the excess is left",
            100.0 * left / excess
        ));
    }

    let named = if verdict == Verdict::Unknown {
        Vec::new()
    } else {
        effects
    };
    let rms = |chi2: f64| sigma * (chi2 / n).max(0.0).sqrt();
    // The noise of these very rows: what the full fit leaves, where that is the floor within its own error.
    let in_sample = rms(fit.chi2);
    let floor_um = if in_sample <= 1.01 * sigma {
        in_sample
    } else {
        sigma
    };
    let gap = Gap {
        before: held.before_um,
        after: held.after_um,
        floor: floor_um,
        unit: "um RMS of innovation on held-out records",
        steps: steps
            .iter()
            .map(|(names, chi2)| GapStep {
                effects: names.iter().map(|s| (*s).to_owned()).collect(),
                rms: rms(*chi2),
            })
            .collect(),
        per_record: held.per_record.clone(),
        bands: held_out::bands(&null_map, &after_map),
    };
    let base_shift = BTreeMap::from([
        (
            "frame_edge_share".to_owned(),
            Interval {
                value: fit.soft,
                ci95: [fit.soft, fit.soft],
                unit: "um/um".to_owned(),
            },
        ),
        ("gain".to_owned(), held.gain_shift.clone()),
    ]);
    let augmented = augment(model, ctx, &fit, frames, &named, verdict);
    let traces = Traces::new(ctx, &null, &fit);
    Reconciliation {
        verdict,
        effects: named,
        places,
        gap,
        base_shift,
        hypothesis,
        noise: ctx.problem.noise,
        sample_s: ctx.problem.base.sample_s,
        augmented,
        before: null_map,
        after: after_map,
        traces,
        records: records
            .iter()
            .map(|r| (r.name.clone(), r.rows(), r.frames()))
            .collect(),
    }
}

/// Whether most of what play operators gain is their static quadratic term, which is no hysteresis.
fn mostly_curvature(ctx: &Context<'_>, fit: &Fit, index: usize, gain: f64) -> bool {
    let part = &fit.parts[index];
    let Some(quadratic) = part
        .variant()
        .params
        .iter()
        .position(|p| p.name == "quadratic_per_um")
    else {
        return false;
    };
    let Some(v) = VARIANTS.iter().position(|v| v.id == CURVATURE) else {
        return false;
    };
    let mut parts = fit.parts.clone();
    parts[index] = Part::new(v, &[part.natural()[quadratic]]);
    let forgetful = ctx.fit_from(parts, Some(fit.soft), &ctx.problem.all(), 12);
    // What memory adds must be at least a half of the whole.
    forgetful.chi2 - fit.chi2 < 0.5 * gain
}

/// A set that closes less than this part of the excess is no explanation.
const CLOSED: f64 = 0.80;

/// A base model for records without one: the constant gain that fits best, and the command at which the output was at
/// rest before the records began.
///
/// That command is read off the first row, which comes before the first command takes effect, through the gain. A piezo
/// remembers it. An estimate within a tenth of the command's range of zero is zero: not yet switched on.
///
/// # Errors
/// No records, or a command that never changes.
pub fn constant_gain(records: &[Record]) -> Result<(f64, f64), ReconcileError> {
    if records.is_empty() {
        return Err(ReconcileError::NoRecords);
    }
    let rows = || {
        records
            .iter()
            .flat_map(|r| r.pzt_um.iter().zip(&r.bead_um))
            .filter(|(_, y)| y.is_finite())
            .map(|(u, y)| (*u, *y))
    };
    let n = rows().count().max(1) as f64;
    // Regression over all records.
    let (mean_u, mean_y) = (
        rows().map(|(u, _)| u).sum::<f64>() / n,
        rows().map(|(_, y)| y).sum::<f64>() / n,
    );
    let (mut uu, mut uy) = (0.0, 0.0);
    for (u, y) in rows() {
        uu += (u - mean_u) * (u - mean_u);
        uy += (u - mean_u) * (y - mean_y);
    }
    if uu <= 0.0 {
        return Err(ReconcileError::ConstantInput);
    }
    let gain = uy / uu;
    let mut before = Vec::new();
    for r in records {
        let seen: Vec<(f64, f64)> = r
            .pzt_um
            .iter()
            .zip(&r.bead_um)
            .filter(|(_, y)| y.is_finite())
            .map(|(u, y)| (*u, *y))
            .collect();
        let n = seen.len().max(1) as f64;
        let (u, y) = (
            seen.iter().map(|s| s.0).sum::<f64>() / n,
            seen.iter().map(|s| s.1).sum::<f64>() / n,
        );
        if let Some(first) = seen.first() {
            before.push(u + (first.1 - y) / gain);
        }
    }
    before.sort_by(f64::total_cmp);
    let (low, high) = records
        .iter()
        .map(Record::pzt_range_um)
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), (c, d)| {
            (a.min(c), b.max(d))
        });
    let at_rest = before[before.len() / 2].clamp(low.min(0.0), high.max(0.0));
    let at_rest = if at_rest.abs() < 0.1 * (high - low) {
        0.0
    } else {
        at_rest
    };
    Ok((gain, at_rest))
}
