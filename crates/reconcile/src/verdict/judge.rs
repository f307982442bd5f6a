//! The verdict: the conditions under which a set of effects gets its names, and the sentence if it does not.

use crate::data::floor::Floor;
use crate::fit::context::{Context, Fit};
use crate::search::cost::{leaves_much, left_over, scatter};
use crate::search::sequential::ids;
use crate::thresholds::{CHANCE_SD, THRESHOLDS};
use crate::units::figure;
use crate::verdict::battery::{self, Column, Hypothesis};
use crate::verdict::form::Aside;
use crate::verdict::held_out::HeldOut;
use crate::verdict::hidden;
use crate::verdict::map::DiscrepancyMap;
use crate::verdict::names::Names;
use crate::verdict::parameters;
use crate::verdict::result::{Remainder, Verdict};
use crate::verdict::sentences::sentences;
use crate::verdict::split;

/// Everything that a verdict rests on.
pub(crate) struct Evidence<'a> {
    pub null: &'a Fit,
    pub fit: &'a Fit,
    pub names: &'a Names,
    pub held: &'a HeldOut,
    /// Part of the gap in innovations that closes on held-out records.
    pub closure: f64,
    pub floor: &'a Floor,
    /// Whether the map of the null shows anything beyond the floor.
    pub null_flagged: bool,
    pub after: &'a DiscrepancyMap,
    /// Whether missing or repeated frames were counted.
    pub counted: bool,
    /// The search ended with its budget.
    pub cut_short: bool,
    /// And before other effects were tried in place of those found.
    pub unweighed: bool,
    /// What is said where the records hardly go with the model.
    pub unlike: Option<&'a str>,
    /// What was taken out of the names as another form of the others.
    pub aside: &'a Aside,
}

/// The verdict with its reasons.
pub(crate) struct Judgement {
    pub verdict: Verdict,
    /// Sentences for `where`.
    pub reasons: Vec<String>,
    pub hypothesis: Option<Hypothesis>,
    pub remainder: Option<Remainder>,
}

pub(crate) fn judge(ctx: &Context<'_>, e: &Evidence<'_>, threads: usize) -> Judgement {
    let n = e.null.count as f64;
    let scatter = scatter(n);
    let excess = e.null.chi2 + e.null.absorbed - n;
    let left = e.fit.chi2 - n;
    let closed_by = |fit: &Fit| match excess > 0.0 {
        true => 1.0 - (fit.chi2 - n).max(0.0) / excess,
        false => 1.0,
    };
    let closed = closed_by(e.fit);
    let all = ctx.problem.all();
    let library = battery::library(ctx, e.fit);
    let strongest = battery::strongest(&library, &ctx.tangents(e.fit, &all), e.fit, &all);
    // A term counts if it is beyond chance and beyond the residual of equations that differ in their last digits.
    let gained = (excess - left).max(0.0);
    let term = strongest
        .filter(|(_, gain)| *gain > THRESHOLDS.term_least.max(THRESHOLDS.term_share * gained));
    let much = leaves_much(e.null, e.fit);
    let beyond_chance = much || term.is_some();
    let mut companions = e.aside.companions.iter();
    let remains = beyond_chance || companions.any(|(_, share)| *share > THRESHOLDS.term_share);
    let mut out = Judgement {
        verdict: Verdict::NothingMissing,
        reasons: Vec::new(),
        hypothesis: None,
        remainder: None,
    };
    if e.fit.parts.is_empty() {
        let beyond = left > CHANCE_SD * scatter || e.null_flagged || term.is_some();
        without_effects(ctx, e, (&library, term), beyond, threads, &mut out);
        return out;
    }
    // Numbers of an equation that is off in its form differ a little from record to record; with the companions they must not.
    let whole = e.aside.whole.as_ref().unwrap_or(e.fit);
    let refused = refusal(ctx, e, closed, left > THRESHOLDS.left_sd * scatter);
    let moved = match refused {
        None => split::disagreement(ctx, e.null, whole, threads),
        Some(_) => None,
    };
    let of_size = moved
        .as_ref()
        .filter(|m| m.of_size)
        .map(|m| no_name(e.fit, &m.words));
    if let Some(reason) = refused.or(of_size) {
        out.verdict = Verdict::Unknown;
        out.reasons.push(reason);
        describe(ctx, e.null, &battery::library(ctx, e.null), None, &mut out);
        return out;
    }
    let beyond_chance = beyond_chance || moved.is_some();
    let remains = remains || beyond_chance;
    // One of several names, next to a remainder: only if the set is complete but for the last digits of its equations.
    let least = match (e.cut_short, e.names.ambiguous) {
        (true, _) => THRESHOLDS.cut_closed,
        (false, true) => THRESHOLDS.closed_whole,
        (false, false) => THRESHOLDS.remainder_closed,
    };
    // What was set aside is another form of what is named.
    if beyond_chance && closed.max(closed_by(whole)) < least {
        out.verdict = Verdict::Unknown;
        out.reasons.push(format!(
            "the best of the catalogue, {}, closes {:.1} % of it, and more than chance is left: no name",
            ids(e.fit).join(" + "),
            100.0 * closed
        ));
        describe(ctx, e.null, &battery::library(ctx, e.null), None, &mut out);
        return out;
    }
    out.verdict = if e.names.ambiguous {
        Verdict::Ambiguous
    } else if remains {
        Verdict::NamedWithRemainder
    } else {
        Verdict::Named
    };
    if remains {
        let mut left = remainder(ctx, e, &library, term, 1.0 - closed);
        if let Some(moved) = moved {
            left.how = format!("{}; {}", moved.words, left.how);
        }
        out.remainder = Some(left);
    }
    out
}

/// Where no effect was found: whether something is missing all the same, `beyond` chance.
fn without_effects(
    ctx: &Context<'_>,
    e: &Evidence<'_>,
    (library, term): (&[Column], Option<(usize, f64)>),
    beyond: bool,
    threads: usize,
    out: &mut Judgement,
) {
    if !e.floor.source.is_known() && beyond {
        out.verdict = Verdict::Unknown;
        out.reasons
            .push(no_floor(ctx, e, "nothing of the catalogue helps"));
    } else if !e.floor.source.is_known() {
        out.reasons.push(
            "nothing says how large the noise is (no rest, no repeated command, no stated noise), but what is left does not follow the command"
                .to_owned(),
        );
    } else if beyond && e.counted {
        // Missing frames are counted, whatever the rest is.
        out.verdict = Verdict::NamedWithRemainder;
        out.remainder = Some(remainder(ctx, e, library, term, 1.0));
    } else if beyond {
        out.verdict = Verdict::Unknown;
        out.reasons
            .push("no effect of the catalogue explains it".to_owned());
    } else {
        if e.counted {
            out.verdict = Verdict::Named;
        }
        out.reasons.extend(hidden::sentence(ctx, e.fit, threads));
    }
    if out.verdict == Verdict::Unknown {
        describe(ctx, e.fit, library, term, out);
    }
}

/// That a set is no name, and why.
fn no_name(fit: &Fit, words: &str) -> String {
    format!(
        "the best of the catalogue, {}, is no name: {words}",
        ids(fit).join(" + ")
    )
}

/// The reason why a set gets no name, if it gets none.
fn refusal(ctx: &Context<'_>, e: &Evidence<'_>, closed: f64, open: bool) -> Option<String> {
    let best = ids(e.fit).join(" + ");
    if !e.floor.source.is_known() {
        return Some(no_floor(
            ctx,
            e,
            &format!("the best of the catalogue is {best}"),
        ));
    }
    if e.unweighed {
        return Some(format!(
            "the best of the catalogue is {best}, but the search ended with its budget before others were tried in its stead: no name"
        ));
    }
    // If the model does not describe these records at all, nothing of the catalogue is missing; the user's equations may stand for
    // it.
    if e.unlike.is_some() && e.fit.parts.iter().all(|p| !p.variant.is_own()) {
        return Some(format!(
            "the best of the catalogue, {best}, is no name beside a model that these records do not follow"
        ));
    }
    if e.names.curvature {
        return Some(format!(
            "the best of the catalogue, {best}, explains no more than a curve of the response without memory: no name"
        ));
    }
    if let Some(id) = e.names.by_chance {
        return Some(format!(
            "the best of the catalogue is {best}, but {id} gains no more than chance may, given what is left beyond the noise: no name"
        ));
    }
    if open && closed < THRESHOLDS.closed_least {
        return Some(format!(
            "the best of the catalogue, {best}, closes {:.0} % of it: not enough for a name",
            100.0 * closed
        ));
    }
    at_bound(ctx, e.fit)
        .or_else(|| not_earned(ctx, e))
        .or_else(|| one_term(ctx, e))
        .map(|words| no_name(e.fit, &words))
}

/// For another plant: a single library term that explains as much as several effects together. A curved characteristic is not
/// missing from the catalogue only because several effects bend in the same way.
fn one_term(ctx: &Context<'_>, e: &Evidence<'_>) -> Option<String> {
    if !ctx.problem.base.free_start || e.fit.parts.len() < 2 {
        return None;
    }
    let all = ctx.problem.all();
    let mut library = battery::library(ctx, e.null);
    library.retain(Column::is_curved);
    let (i, gain) = battery::strongest(&library, &ctx.tangents(e.null, &all), e.null, &all)?;
    let column = &library[i];
    (gain >= e.null.chi2 - e.fit.chi2).then(|| {
        format!(
            "one term alone, {} at the {}, explains as much: {}",
            column.name, column.place, column.says
        )
    })
}

/// What is said where there is no floor.
fn no_floor(ctx: &Context<'_>, e: &Evidence<'_>, best: &str) -> String {
    // On this rig ten seconds; what is sampled slowly rests for as many rows as a floor needs.
    let rest_s = (2.0 * THRESHOLDS.floor_rows as f64 * ctx.scope.sample_s).max(10.0);
    format!(
        "without a noise floor no name is given (no rest, no repeated command, no stated noise); {best}: innovations {} before, {} after, free run {} before, {} after, on held-out records; record a rest of {rest_s:.0} s or the command twice, and look again",
        ctx.scales.told(e.held.before_um),
        ctx.scales.told(e.held.after_um),
        ctx.scales.told(e.held.free_before_um),
        ctx.scales.told(e.held.free_after_um)
    )
}

/// A number that stopped at its bound was looking for another equation.
fn at_bound(ctx: &Context<'_>, fit: &Fit) -> Option<String> {
    first_at_bound(ctx, fit).map(|(_, words)| words)
}

/// The first part with such a number, and the number in words.
pub(crate) fn first_at_bound(ctx: &Context<'_>, fit: &Fit) -> Option<(usize, String)> {
    let mut at = 0;
    for (i, part) in fit.parts.iter().enumerate() {
        if !part.is_possible(&ctx.scope) {
            let words = format!(
                "no camera exposes for longer than a frame, as {} would",
                part.id()
            );
            return Some((i, words));
        }
        for (j, (p, v)) in part.variant().params.iter().zip(part.natural()).enumerate() {
            let (low, high) = (p.coordinate(p.lower), p.coordinate(p.upper));
            let x = part.theta[j];
            let near = 1e-4 * (high - low);
            let sd = fit.covariance[(at + j, at + j)].max(0.0).sqrt();
            if x > high - near || (x < low + near && p.lower != 0.0) {
                let words = format!(
                    "{} of {} stands at its bound, {}",
                    p.name,
                    part.id(),
                    figure(parameters::told(ctx, part, p.name, v).value)
                );
                return Some((i, words));
            }
            if j == 0 && p.log && 1.96 * sd > 0.5 * (high - low) {
                return Some((i, format!("{} of {} may be anything", p.name, part.id())));
            }
            if p.name == "delay_s" && v >= ctx.longest_delay_s() {
                let words = format!(
                    "{} of {} is {} s, longer than these records tell",
                    p.name,
                    part.id(),
                    figure(v)
                );
                return Some((i, words));
            }
            let nyquist_hz = 0.5 / ctx.scope.sample_s;
            if ctx.scope.sampled_input && p.name.ends_with("_hz") && v > nyquist_hz {
                let words = format!(
                    "{} of {} is {} Hz, above half the sampling rate of {} Hz",
                    p.name,
                    part.id(),
                    figure(v),
                    figure(2.0 * nyquist_hz)
                );
                return Some((i, words));
            }
        }
        at += part.theta.len();
    }
    None
}

/// A name must help on data that was not fitted: in innovations and, if its effect is larger than the walk, in free run.
fn not_earned(ctx: &Context<'_>, e: &Evidence<'_>) -> Option<String> {
    let of_other_data = ctx.problem.base.free_start;
    let (before, after) = (e.held.free_before_um, e.held.free_after_um);
    // The scatter of the walk is as large as the walk. A zero flow makes nearly one curve of one size: 3.3 standard deviations of
    // one number are one in a thousand.
    let times = match ctx.problem.noise.zero_flow {
        Some(_) => 3.3,
        None => 2.0,
    };
    let floor = times * e.held.free_floor_um;
    let falls = after <= (1.0 - THRESHOLDS.free_run_fall) * before;
    // The walk is the same in both. So whatever its size, a base that was fitted to the records does not run worse with the
    // missing effect.
    let grows = of_other_data && after > (1.0 + THRESHOLDS.free_run_fall) * before;
    if grows || (before > floor && after > floor && !falls) {
        return Some(format!(
            "the free run on held-out records is off by {} with it and by {} without",
            ctx.scales.told(after),
            ctx.scales.told(before)
        ));
    }
    if e.closure < THRESHOLDS.held_out_least {
        return Some(format!(
            "it closes {:.0} % of the gap on held-out records",
            100.0 * e.closure
        ));
    }
    None
}

/// Says what is left, with a formula.
fn describe(
    ctx: &Context<'_>,
    fit: &Fit,
    library: &[Column],
    term: Option<(usize, f64)>,
    out: &mut Judgement,
) {
    let all = ctx.problem.all();
    let term = term.or_else(|| {
        battery::strongest(library, &ctx.tangents(fit, &all), fit, &all)
            .filter(|(_, gain)| *gain > THRESHOLDS.term_least.max(0.1 * left_over(fit)))
    });
    if let Some((i, gain)) = term {
        out.reasons.push(format!(
            "what it is like: {} ({} at the {}, {:.0} % of what is left)",
            library[i].says,
            library[i].name,
            library[i].place,
            100.0 * (gain / left_over(fit).max(gain)).min(1.0)
        ));
    }
    out.hypothesis = battery::hypothesis(ctx, fit, library);
}

/// The remainder next to the names.
fn remainder(
    ctx: &Context<'_>,
    e: &Evidence<'_>,
    library: &[Column],
    term: Option<(usize, f64)>,
    share: f64,
) -> Remainder {
    let mut how: Vec<String> = e
        .aside
        .companions
        .iter()
        .map(|(id, share)| {
            format!(
                "{:.2} % of the gap that {id} beside it would explain, and another form of the named effect as well",
                100.0 * share
            )
        })
        .collect();
    how.extend(term.map(|(i, _)| {
        format!(
            "{} ({} at the {})",
            library[i].says, library[i].name, library[i].place
        )
    }));
    if how.is_empty() {
        how.push("nothing of the library of terms stands out".to_owned());
    }
    Remainder {
        places: sentences(ctx, e.fit, e.after, e.floor.source.is_known()),
        how: how.join("; "),
        share: share.clamp(0.0, 1.0),
        formula: battery::hypothesis(ctx, e.fit, library),
    }
}
