//! From the search to the answer: rivals, the four verdicts, the gap, and the augmented model.

use crate::augment::{augment, parameters, place_of};
use crate::catalogue::{CURVATURE, VARIANTS};
use crate::data::Record;
use crate::fit::{Context, Fit, Part};
use crate::frames::{self, FrameCounts};
use crate::held_out::{self, HeldOut};
use crate::hypothesis;
use crate::map;
use crate::result::{
    Effect as NamedEffect, Gap, GapStep, Interval, Reconciliation, Traces, Verdict,
};
use crate::search::{Found, ids, implausibility, left_over};
use crate::separate::separate_by;
use crate::significance;
use cellpos_plant::Model;
use std::collections::BTreeMap;

/// Rivals closer than this (twice the log-likelihood) cannot be told from the winner.
const TIE: f64 = 10.0;

/// A valley no deeper than this below the best belongs to the 95 % interval (chi-square, one number).
const VALLEY: f64 = 3.84;

/// Pairs of names that no record of command and bead position can tell apart.
fn inseparable(a: &str, b: &str) -> bool {
    matches!((a, b), ("driver-lag", "bubble") | ("bubble", "driver-lag"))
}

pub(crate) fn assemble(
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
        let mut parameters = parameters(ctx, &fit, i, left / n);
        // Other valleys of the same equation that fit as well.
        for r in rivals.get(i).map_or(&[][..], Vec::as_slice) {
            if r.part.variant == part.variant && r.chi2 - fit.chi2 < VALLEY {
                for (p, value) in part.variant().params.iter().zip(r.part.natural()) {
                    if let Some(found) = parameters.get_mut(p.name) {
                        found.reach(value);
                    }
                }
            }
        }
        effects.push(NamedEffect {
            id: id.to_owned(),
            place: place_of(id),
            parameters,
            p_value: significance::p_value(gain, freedom),
            explained: if excess > 0.0 {
                (gain / excess).clamp(0.0, 1.0)
            } else {
                0.0
            },
            separate_by: needs_text.then(|| separate_by(id, &alternatives)),
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
        unit: "um",
        quantity: "RMS innovation on held-out records",
        steps: gap_steps(ctx, &null, &steps, rms),
        per_record: held.per_record.clone(),
        bands: held_out::bands(&null_map, &after_map),
    };
    let base_shift = BTreeMap::from([
        (
            "frame_edge_share".to_owned(),
            Interval {
                value: fit.soft,
                ci95: [
                    fit.soft - 1.96 * fit.errors[0],
                    fit.soft + 1.96 * fit.errors[0],
                ],
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

/// The search step by step; after the null model, by itself, what a free base gain alone would do.
fn gap_steps(
    ctx: &Context<'_>,
    null: &Fit,
    steps: &[(Vec<&'static str>, f64)],
    rms: impl Fn(f64) -> f64,
) -> Vec<GapStep> {
    let mut out: Vec<GapStep> = steps
        .iter()
        .map(|(names, chi2)| GapStep {
            effects: names.iter().map(|s| (*s).to_owned()).collect(),
            rms: rms(*chi2),
            base_gain: None,
        })
        .collect();
    if ctx.free_gain {
        if let Some(first) = out.first_mut() {
            first.base_gain = Some(null.gain);
        }
    } else if let Some(v) = VARIANTS.iter().position(|v| v.id == "gain-error") {
        let parts = vec![Part::new(v, &[1.0])];
        let free = ctx.fit_from(parts, Some(null.soft), &ctx.problem.all(), 6);
        let step = GapStep {
            effects: Vec::new(),
            rms: rms(free.chi2),
            base_gain: free.parts.first().map(|p| p.natural()[0]),
        };
        out.insert(1.min(out.len()), step);
    }
    out
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
