//! The effects of a set as results: numbers with intervals, rivals, and what would tell them apart.

use crate::fit::catalogue::Part;
use crate::fit::context::{Context, Fit, freedom_of};
use crate::search::cost::{price_of_waves, prior_penalty, surely_left, threshold};
use crate::search::found::Rival;
use crate::thresholds::{NUMBER, THRESHOLDS};
use crate::verdict::form::WithoutMemory;
use crate::verdict::map;
use crate::verdict::parameters::{SURE, Sureness, parameters, told};
use crate::verdict::profile;
use crate::verdict::result::Effect as NamedEffect;
use crate::verdict::shapes;
use crate::verdict::significance;
use crate::verdict::split;
use cellpos_plant::effects;
use std::cell::LazyCell;

/// Whether no record of command and bead position can tell two effects apart.
fn inseparable(a: &str, b: &str) -> bool {
    effects::find(a).is_some_and(|k| k.spec().inseparable_from.contains(&b))
}

/// What would tell an effect from its rivals, in words for the result.
fn separate_by(id: &str, alternatives: &[String]) -> String {
    let Some(kind) = effects::find(id) else {
        return String::new();
    };
    let double = alternatives.iter().any(|a| inseparable(id, a));
    let of_double = kind.separate_from_double().filter(|_| double);
    of_double.unwrap_or(kind.spec().separate_by).to_owned()
}

/// The effects of a set.
pub(crate) struct Names {
    pub effects: Vec<NamedEffect>,
    /// Whether other names explain the records as well.
    pub ambiguous: bool,
    /// Whether a hysteresis explains by its static curvature more than by its memory.
    pub curvature: bool,
    /// An effect that gains no more than chance may, given what the set leaves.
    pub by_chance: Option<&'static str>,
}

/// Ids that explain the records as well in place of part `index`, and whether a record could separate them from it.
fn alternatives(
    ctx: &Context<'_>,
    fit: &Fit,
    index: usize,
    rivals: &[Rival],
) -> (Vec<String>, bool) {
    let part = &fit.parts[index];
    let id = part.id();
    let over = surely_left(ctx, fit);
    let (mut found, mut open): (Vec<String>, bool) = (Vec::new(), false);
    for r in rivals {
        if r.id == id || found.iter().any(|a| a == r.id) {
            continue;
        }
        let decided = ctx.white.is_some_and(|w| {
            let mut other = fit.parts.clone();
            other[index] = r.part.clone();
            let distance = |parts: &[Part]| w.distance(parts, &ctx.scope);
            distance(&other) - distance(&fit.parts) > THRESHOLDS.tie
        });
        // A richer form that only contains the winner as a limit of its numbers is no rival. A form as simple is one, however
        // unusual its size, unless the residual shows that the last percent decides nothing.
        let richer = r.part.theta.len() > part.theta.len();
        if richer && r.is_limit {
            continue;
        }
        let rough = over > THRESHOLDS.rough * fit.count as f64;
        let price = if rough || richer {
            prior_penalty(&r.part, over) - prior_penalty(part, over)
        } else {
            0.0
        };
        let records = ctx.problem.records.len();
        let price = price + price_of_waves(&r.part, records) - price_of_waves(part, records);
        // The winner has to be worth each number that it has more.
        let spared = part.theta.len().saturating_sub(r.part.theta.len());
        let price = price - NUMBER * spared as f64;
        let ties = r.chi2 + price - fit.chi2 < THRESHOLDS.tie && !decided;
        if ties && !(richer && ends_as_well(ctx, fit, index, r)) {
            open |= !inseparable(id, r.id);
            found.push(r.id.to_owned());
        }
    }
    // If nothing separates two names, both are given, as long as both have their plain form.
    let same = effects::find(id).map_or(&[][..], |k| k.spec().inseparable_from);
    for other in same {
        if part.variant().params.len() == 1 && !found.iter().any(|x| x == other) {
            found.push((*other).to_owned());
        }
    }
    found.sort();
    (found, open)
}

/// Whether a rival explains as much with one of its times or rates at the end of its range, where it is a simpler effect, and less in the
/// middle of it. A relaxation that takes longer than a zero flow stands still is a gain. A number that may be anything from the middle to the
/// end belongs to a rival.
fn ends_as_well(ctx: &Context<'_>, fit: &Fit, index: usize, rival: &Rival) -> bool {
    let before = fit.numbers_before(index);
    let all = ctx.problem.all();
    let params = rival.part.variant().params.iter().enumerate();
    params.filter(|(_, p)| p.log).any(|(j, p)| {
        let as_well = |coordinate: f64| {
            let mut there = fit.clone();
            there.parts[index] = rival.part.clone();
            there.parts[index].theta[j] = coordinate;
            ctx.refit_with(&there, &all, 8, before + j).chi2 - fit.chi2 < THRESHOLDS.tie
        };
        let ends = [p.lower, p.upper].map(|end| p.coordinate(end));
        ends.into_iter().any(as_well) && !as_well(0.5 * (ends[0] + ends[1]))
    })
}

/// The effects of a fit, with the rivals of each.
pub(crate) fn names(
    ctx: &Context<'_>,
    null: &Fit,
    fit: &Fit,
    rivals: &[Vec<Rival>],
    threads: usize,
) -> Names {
    let all = ctx.problem.all();
    let n = null.count as f64;
    let excess = null.chi2 + null.absorbed - n;
    let mut out = Names {
        effects: Vec::new(),
        ambiguous: false,
        curvature: false,
        by_chance: None,
    };
    // A fit that leaves something over is less sure than its own curvature says.
    let left = (1.0 + ((fit.chi2 - n) / n).max(0.0)).sqrt();
    let birge = split::birge(ctx, fit, threads);
    let wide: Vec<f64> = birge.iter().map(|b| left * b).collect();
    let sure = Sureness {
        ends: profile::ends(ctx, fit, &wide, threads),
        wide,
    };
    for (i, part) in fit.parts.iter().enumerate() {
        let id = part.id();
        let without = ctx.fit_without(fit, i, &all, 8);
        let gain = (without.chi2 - fit.chi2).max(0.0);
        let no_memory = LazyCell::new(|| WithoutMemory::beside(ctx, &without));
        let of_no_memory = |part: &Part, gained: f64| {
            part.variant.memoryless().is_some() && no_memory.explains(part, gained)
        };
        out.curvature |= of_no_memory(part, gain)
            || is_of_plays(part) && mostly_curvature(ctx, fit, i, no_memory.beyond_a_gain(gain));
        // A hysteresis that remembers nothing is the curve that it is, and no rival of another.
        let remembers = |r: &&Rival| !of_no_memory(&r.part, without.chi2 - r.chi2);
        let rivals: Vec<Rival> = (rivals.get(i).into_iter().flatten())
            .filter(remembers)
            .cloned()
            .collect();
        let (alternatives, open) = alternatives(ctx, fit, i, &rivals);
        out.ambiguous |= open;
        let mut parameters = parameters(ctx, fit, i, &sure);
        // Other valleys of the same equation that fit as well.
        for r in &rivals {
            if r.part.variant == part.variant && r.chi2 - fit.chi2 < SURE * SURE {
                for (p, value) in part.variant().params.iter().zip(r.part.natural()) {
                    if let Some(found) = parameters.get_mut(p.name) {
                        found.reach(told(ctx, part, p.name, value).value);
                    }
                }
            }
        }
        let needs_text =
            !alternatives.is_empty() || effects::find(id).is_some_and(|k| k.has_doubles());
        let freedom = freedom_of(part.variant(), ctx.problem.records.len());
        if gain < threshold(freedom) * map::left_along(ctx, fit, &without) {
            out.by_chance = Some(id);
        }
        out.effects.push(NamedEffect {
            id: id.to_owned(),
            place: effects::find(id).map_or("camera", |k| k.spec().shown_place()),
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
    shapes::reach(ctx, fit, &sure.wide, &mut out.effects, threads);
    out
}

fn is_of_plays(part: &Part) -> bool {
    part.variant().params.iter().any(|p| p.name == "weights")
}

/// Whether most of `beyond`, what play operators gain beyond a gain of the plant, is their static curve, which is no hysteresis.
fn mostly_curvature(ctx: &Context<'_>, fit: &Fit, index: usize, beyond: f64) -> bool {
    let part = &fit.parts[index];
    let Some(v) = part.variant.memoryless() else {
        return false;
    };
    // Without memory the sum of the operators is the input.
    let of = |word: &str| -> f64 {
        let curves = part.variant().params.iter().zip(part.natural());
        let alike = curves.filter(|(p, _)| p.name.ends_with(word));
        alike.map(|(_, value)| value).sum()
    };
    let curve = v.candidate().params.iter().map(|p| of(p.name));
    let mut parts = fit.parts.clone();
    parts[index] = Part::new(v, &curve.collect::<Vec<_>>());
    let forgetful = ctx.fit_from(parts, Some(fit.soft), &ctx.problem.all(), 12);
    // What memory adds must be at least a half of the whole.
    forgetful.chi2 - fit.chi2 < 0.5 * beyond
}
