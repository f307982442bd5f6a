//! The sequential search: add the best candidate, look again, take back what is no longer needed, try replacements.

use crate::fit::catalogue::{self, Part};
use crate::fit::context::{Context, Fit};
use crate::fit::descent::Until;
use crate::mask::Mask;
use crate::search::cost::{
    before_forms, gap, least_gain, leaves_much, left_over, penalised_cost, surely_left,
    threshold_of,
};
use crate::search::effort::Effort;
use crate::search::found::{Found, Rival};
use crate::search::pairs::pair_in_place_of;
use crate::search::screen::screen;
use crate::thresholds::THRESHOLDS;

/// Sums of squares this far above that of a fit decide nothing, whatever their prices.
pub(crate) fn within(fit: &Fit) -> f64 {
    100.0 + THRESHOLDS.untypical_share * left_over(fit)
}

/// Whatever is beyond chance, followed to the end.
pub(crate) const FREELY: [f64; 2] = [0.0, f64::INFINITY];

/// Fits the best leads next to a set and returns the fits, best first. `least` is the least gain that a lead must promise. A fit
/// with a sum of squares above `rival_of` is not continued.
pub(crate) fn extensions(
    ctx: &Context<'_>,
    fit: &Fit,
    mask: &Mask,
    effort: Effort,
    wide: usize,
    forbidden: &[&str],
    [least, rival_of]: [f64; 2],
) -> Vec<Fit> {
    let tangents = ctx.tangents(fit, mask);
    let leads = screen(ctx, fit, &tangents, mask, effort.threads, |v| {
        !v.candidate().late
            && !v.is_own()
            && !ctx.excludes(v.id())
            && !fit.has(v.id())
            && !forbidden.contains(&v.id())
    });
    let records = ctx.problem.records.len();
    let worth: Vec<Part> = leads
        .into_iter()
        .filter(|l| {
            let least = if l.part.variant().off_response {
                0.0
            } else {
                least
            };
            l.score > 0.5 * threshold_of(l.part.variant(), records).max(least)
        })
        .map(|l| l.part)
        .collect();
    // The best form of each effect in each band of its frequency, and the second best if neither form is a limit of the other.
    let mut seen: Vec<(&str, usize)> = Vec::new();
    let worth = worth.into_iter().filter(|part| {
        let valley = (part.id(), part.band(ctx.problem.base.sample_s));
        let before = seen.iter().filter(|s| **s == valley).count();
        let new = before < part.variant.forms_worth_following();
        if new {
            seen.push(valley);
        }
        new
    });
    let mut ids: Vec<&str> = Vec::new();
    let is_wide = |part: &Part| {
        if ids.len() < wide && !ids.contains(&part.id()) {
            ids.push(part.id());
        }
        ids.contains(&part.id())
    };
    let worth: Vec<Part> = worth.filter(is_wide).collect();
    // A short fit of all, then the best few to the end.
    let mut fits = cellpos_numeric::parallel::map(&worth, effort.threads, |part| {
        let mut parts = fit.parts.clone();
        parts.push(part.clone());
        ctx.fit_from(parts, Some(fit.soft), mask, 4)
    });
    fits.sort_by(|a, b| penalised_cost(ctx, a).total_cmp(&penalised_cost(ctx, b)));
    let close = fits
        .first()
        .map_or(0.0, |best| best.chi2 + 0.5 * (fit.chi2 - best.chi2));
    let rest = fits.split_off(fits.iter().take(4).filter(|f| f.chi2 <= close).count());
    let target = fits
        .first()
        .map_or(f64::INFINITY, |best| best.chi2 + within(best));
    let until = Until {
        iterations: 14,
        least_chi2: target.min(rival_of),
    };
    let mut fits = cellpos_numeric::parallel::map(&fits, effort.threads, |f| {
        // Steps become smaller: what is out of reach with steps like the last is out of reach.
        if f.chi2 - f.last_gain * until.iterations as f64 > until.least_chi2 {
            f.clone()
        } else {
            ctx.refit_towards(f, mask, until)
        }
    });
    fits.extend(rest);
    fits.extend(own(ctx, fit, mask, effort, forbidden));
    fits.retain(|f| ctx.is_possible(f));
    fits.sort_by(|a, b| penalised_cost(ctx, a).total_cmp(&penalised_cost(ctx, b)));
    fits
}

/// Every effect of the user next to a set, from its best start. Screening is linear, so equations with many numbers look like
/// nothing at first. A user asks for few effects: all are fitted.
fn own(ctx: &Context<'_>, fit: &Fit, mask: &Mask, effort: Effort, forbidden: &[&str]) -> Vec<Fit> {
    const SHORT: usize = 6;
    const LONG: usize = 200;
    let mut best: Vec<Fit> = Vec::new();
    for variant in ctx.variants.iter().filter(|v| {
        v.is_own() && !ctx.excludes(v.id()) && !fit.has(v.id()) && !forbidden.contains(&v.id())
    }) {
        let starts = variant.starts(&ctx.scope);
        let fits = cellpos_numeric::parallel::map(&starts, effort.threads, |part| {
            let mut parts = fit.parts.clone();
            parts.push(part.clone());
            ctx.fit_from(parts, Some(fit.soft), mask, SHORT)
        });
        best.extend(fits.into_iter().min_by(|a, b| a.chi2.total_cmp(&b.chi2)));
    }
    cellpos_numeric::parallel::map(&best, effort.threads, |f| ctx.refit(f, mask, LONG))
}

/// Whether the part of `bigger` that `smaller` lacks is worth having; `null` is the sum of squares before the forms of `smaller`.
fn worth_it(ctx: &Context<'_>, smaller: &Fit, bigger: &Fit, null: f64) -> bool {
    let added = bigger.freedom().saturating_sub(smaller.freedom()).max(1);
    let off_response = bigger
        .parts
        .iter()
        .filter(|p| !smaller.has(p.id()))
        .all(|p| p.variant().off_response);
    let gained = if off_response {
        0.0
    } else {
        null - smaller.chi2
    };
    smaller.chi2 - bigger.chi2 > least_gain(ctx, added, gained)
}

/// Takes back effects that are no longer needed.
fn eliminate(ctx: &Context<'_>, mut fit: Fit, null: &Fit, mask: &Mask, effort: Effort) -> Fit {
    let null = before_forms(ctx, null, &fit, mask);
    while fit.parts.len() > 1 {
        let indices: Vec<usize> = (0..fit.parts.len()).collect();
        let without = cellpos_numeric::parallel::map(&indices, effort.threads, |&i| {
            let mut parts = fit.parts.clone();
            parts.remove(i);
            // Only whether it comes so far down that the part was worth nothing is asked.
            let until = Until {
                iterations: 8,
                least_chi2: fit.chi2 + least_gain(ctx, fit.freedom(), null - fit.chi2),
            };
            ctx.fit_towards(parts, Some(fit.soft), mask, until)
        });
        let Some(best) = without
            .into_iter()
            .filter(|w| !worth_it(ctx, w, &fit, null))
            .min_by(|a, b| penalised_cost(ctx, a).total_cmp(&penalised_cost(ctx, b)))
        else {
            break;
        };
        fit = best;
    }
    fit
}

/// Replaces single effects by others while that helps; also gathers the rivals of each effect: of none where there is no work left.
fn replace(ctx: &Context<'_>, mut fit: Fit, mask: &Mask, effort: Effort) -> (Fit, Vec<Vec<Rival>>) {
    for round in 0..3 {
        let mut rivals: Vec<Vec<Rival>> = Vec::new();
        let mut better: Option<Fit> = None;
        let target = fit.chi2 + within(&fit);
        let mut consider = |other: Fit, at: usize, list: &mut Vec<Rival>| {
            let part = &other.parts[at];
            list.push(Rival {
                id: part.id(),
                chi2: other.chi2,
                part: part.clone(),
                is_limit: other.is_limit(at),
            });
            if penalised_cost(ctx, &other) < penalised_cost(ctx, &fit) - 1.0
                && better
                    .as_ref()
                    .is_none_or(|b| penalised_cost(ctx, &other) < penalised_cost(ctx, b))
            {
                better = Some(other);
            }
        };
        for i in 0..fit.parts.len() {
            if effort.is_over(ctx) {
                return (fit, Vec::new());
            }
            let id = fit.parts[i].id();
            let without = ctx.fit_without(&fit, i, mask, 10);
            let mut list: Vec<Rival> = Vec::new();
            for other in extensions(
                ctx,
                &without,
                mask,
                effort,
                4,
                &[id],
                [0.25 * (without.chi2 - fit.chi2), target],
            ) {
                let last = other.parts.len() - 1;
                consider(other, last, &mut list);
            }
            // Screening is linear; a lag of another shape need not look promising from afar. Those of the same length
            // are fitted for certain.
            let twins: Vec<Part> = fit.parts[i]
                .lag_s()
                .map(|lag_s| {
                    let starts = catalogue::of_lag(lag_s, &ctx.scope);
                    let valleys = |id: &str| starts.iter().filter(|p| p.id() == id).count();
                    let several: Vec<bool> = starts.iter().map(|p| valleys(p.id()) > 1).collect();
                    starts
                        .into_iter()
                        .zip(several)
                        .filter(|(p, several)| {
                            let other = p.id();
                            !ctx.excludes(other)
                                && (*several || !list.iter().any(|r| r.id == other))
                                && if other == id {
                                    *several
                                } else {
                                    !fit.has(other)
                                }
                        })
                        .map(|(p, _)| p)
                        .collect()
                })
                .unwrap_or_default();
            for other in cellpos_numeric::parallel::map(&twins, effort.threads, |part| {
                let mut parts = fit.parts.clone();
                parts[i] = part.clone();
                let until = Until {
                    iterations: 12,
                    least_chi2: target,
                };
                ctx.fit_towards(parts, Some(fit.soft), mask, until)
            }) {
                if ctx.is_possible(&other) {
                    consider(other, i, &mut list);
                }
            }
            rivals.push(list);
        }
        match better {
            // An exchange that there is no work left to look beyond: the set stands as it was, with the better one as its rival.
            Some(_) if round > 0 && effort.is_spent(ctx) => return (fit, rivals),
            Some(b) => fit = b,
            None => return (fit, rivals),
        }
    }
    let none = vec![Vec::new(); fit.parts.len()];
    (fit, none)
}

/// Tries the other forms of the same effects (play operators for Bouc-Wen, a dissolving bubble, two-sided clipping).
fn reparametrise(ctx: &Context<'_>, mut fit: Fit, mask: &Mask, effort: Effort, rich: bool) -> Fit {
    for i in 0..fit.parts.len() {
        if effort.is_over(ctx) {
            return fit;
        }
        let id = fit.parts[i].id();
        let others: Vec<Part> = ctx
            .variants
            .iter()
            .filter(|v| {
                if ctx.excludes(v.id()) {
                    return false;
                }
                let form = v.id() == id && **v != fit.parts[i].variant;
                // A lag that dissolves is a bubble.
                let dissolving = v.is_rich_double_of(fit.parts[i].variant);
                (form || dissolving) && (rich || !v.candidate().late)
            })
            .flat_map(|v| v.starts_from(&fit.parts[i], &ctx.scope))
            .collect();
        let fits = cellpos_numeric::parallel::map(&others, effort.threads, |part| {
            let mut parts = fit.parts.clone();
            parts[i] = part.clone();
            let until = Until {
                iterations: 10,
                least_chi2: fit.chi2 + within(&fit),
            };
            ctx.fit_towards(parts, Some(fit.soft), mask, until)
        });
        if let Some(best) = fits
            .into_iter()
            .min_by(|a, b| penalised_cost(ctx, a).total_cmp(&penalised_cost(ctx, b)))
            && penalised_cost(ctx, &best) < penalised_cost(ctx, &fit) - THRESHOLDS.tie
        {
            fit = best;
        }
    }
    fit
}

/// Whether so much is left beyond the noise that a richer form is worth its time, whatever else may explain it.
fn much_left(fit: &Fit) -> bool {
    left_over(fit) > 0.01 * fit.count as f64
}

/// Whether a set of two or more cannot become an explanation. Even with the largest number of effects, each worth the average of
/// the set, it would explain too little. A search takes the most valuable effects first.
fn is_hopeless(fit: &Fit, null: &Fit, most: usize) -> bool {
    let (whole, left, count) = (gap(null), left_over(fit), fit.parts.len());
    let open = left - (whole - left) / count.max(1) as f64 * most.saturating_sub(count) as f64;
    count > 1 && open > (1.0 - THRESHOLDS.closed_least) * whole
}

/// The best single effect; `None` if nothing is worth a name.
fn first(ctx: &Context<'_>, null: &Fit, mask: &Mask, effort: Effort) -> Option<Fit> {
    let singles = extensions(ctx, null, mask, effort, 8, &[], FREELY);
    let mut singles = singles.into_iter();
    singles.find(|f| worth_it(ctx, null, f, null.chi2))
}

/// The best set with one more effect than a set, or in place of one of its own; `None` if none is worth it. `least` is the least gain that
/// it must promise, `forms` the sum of squares before the forms of the set.
fn larger(
    how: (&Context<'_>, &Mask, Effort),
    null: &Fit,
    fit: &Fit,
    (least, forms): (f64, f64),
    first_choice: bool,
) -> Option<Fit> {
    let (ctx, mask, effort) = how;
    let next = extensions(ctx, fit, mask, effort, 6, &[], [least, f64::INFINITY]);
    let top = next.into_iter().find(|f| worth_it(ctx, fit, f, forms));
    // A first choice that leaves something may have been a compromise.
    let leaves = top.is_some() || surely_left(ctx, fit) > 0.0;
    let pair = (first_choice && leaves)
        .then(|| pair_in_place_of(how, null, fit, top.as_ref().unwrap_or(fit)));
    pair.flatten().or(top)
}

/// The model alone.
fn without_effects(ctx: &Context<'_>, mask: &Mask) -> Fit {
    let mut null = ctx.fit(Vec::new(), mask, 6);
    null.absorbed = ctx.absorbed(&null, mask);
    null
}

/// The whole search on the rows of a mask; with `start`, on from a set that was found under another noise.
pub(crate) fn search(
    ctx: &Context<'_>,
    mask: &Mask,
    effort: Effort,
    start: Option<&Fit>,
    mut progress: impl FnMut(&str),
) -> Found {
    let null = without_effects(ctx, mask);
    let mut steps = vec![(Vec::new(), null.chi2)];
    let begun = match start.filter(|f| !f.parts.is_empty()) {
        Some(start) => {
            let again = ctx.fit_from(start.parts.clone(), Some(start.soft), mask, 12);
            Some(eliminate(ctx, again, &null, mask, effort))
        }
        None => {
            progress("screening single effects");
            first(ctx, &null, mask, effort)
        }
    };
    let Some(mut fit) = begun else {
        return Found {
            fit: null.clone(),
            null,
            steps,
            rivals: Vec::new(),
            cut_short: false,
        };
    };
    steps.push((ids(&fit), fit.chi2));
    // The residual of a simple form must not get a name before the richer form was tried. A set that has to beat another has its forms.
    if effort.to_beat == f64::INFINITY {
        let reparametrised = reparametrise(ctx, fit.clone(), mask, effort, much_left(&fit));
        if reparametrised.parts != fit.parts {
            fit = reparametrised;
            steps.push((ids(&fit), fit.chi2));
        }
    }
    // The last set whose effects were weighed against their rivals.
    let mut weighed: Option<(Fit, Vec<Vec<Rival>>)> = None;
    let mut cut_short = false;
    while fit.parts.len() < effort.max_effects {
        if effort.is_spent(ctx) {
            cut_short = true;
            break;
        }
        if is_hopeless(&fit, &null, effort.max_effects) {
            break;
        }
        progress(&format!("looking further beside {}", ids(&fit).join(" + ")));
        let forms = before_forms(ctx, &null, &fit, mask);
        let least = least_gain(ctx, 1, forms - fit.chi2);
        let first_choice = fit.parts.len() == 1 && start.is_none();
        let limits = (least, forms);
        let Some(top) = larger((ctx, mask, effort), &null, &fit, limits, first_choice) else {
            break;
        };
        let top = eliminate(ctx, top, &null, mask, effort);
        if penalised_cost(ctx, &top) >= penalised_cost(ctx, &fit) {
            break;
        }
        if effort.is_beaten(&top, fit.chi2 - top.chi2) {
            break;
        }
        // A richer form of a present effect may explain as much as the next name.
        if top.parts.len() > fit.parts.len() {
            let reparametrised = reparametrise(ctx, fit.clone(), mask, effort, true);
            if reparametrised.parts != fit.parts
                && penalised_cost(ctx, &reparametrised) < penalised_cost(ctx, &top)
            {
                fit = reparametrised;
                steps.push((ids(&fit), fit.chi2));
                continue;
            }
        }
        if effort.is_spent(ctx) {
            fit = top;
            steps.push((ids(&fit), fit.chi2));
            cut_short = true;
            break;
        }
        let (top, rivals) = replace(ctx, top, mask, effort);
        weighed = Some((top.clone(), rivals));
        let forms = top.parts.clone();
        let rich = much_left(&top);
        fit = reparametrise(ctx, top, mask, effort, rich);
        if !alike(&fit.parts, &forms) {
            fit = eliminate(ctx, fit, &null, mask, effort);
        }
        steps.push((ids(&fit), fit.chi2));
    }
    // A set that cannot beat another is not told. Rivals of a set that is no whole explanation, and that nothing more will be added to,
    // decide nothing: no name.
    let beaten = effort.is_beaten(&fit, 0.0);
    let (fit, rivals) = if beaten || cut_short && leaves_much(&null, &fit) {
        let none = vec![Vec::new(); fit.parts.len()];
        (fit, none)
    } else {
        progress("refitting all together");
        settle(ctx, fit, weighed, mask, effort)
    };
    cut_short |= beaten;
    Found {
        fit,
        null,
        steps,
        rivals,
        cut_short,
    }
}

/// Refits all together; the rivals are weighed again unless that was done for this very set.
pub(crate) fn settle(
    ctx: &Context<'_>,
    mut fit: Fit,
    weighed: Option<(Fit, Vec<Vec<Rival>>)>,
    mask: &Mask,
    effort: Effort,
) -> (Fit, Vec<Vec<Rival>>) {
    let refined = ctx.fit_from(fit.parts.clone(), Some(fit.soft), mask, 12);
    if refined.chi2 <= fit.chi2 {
        fit = refined;
    }
    match weighed {
        // The very same, up to what decides nothing.
        Some((before, rivals))
            if rivals.len() == fit.parts.len()
                && rivals.iter().any(|r| !r.is_empty())
                && alike(&before.parts, &fit.parts)
                && (before.chi2 - fit.chi2).abs() < 0.1 * THRESHOLDS.tie =>
        {
            (fit, rivals)
        }
        _ => replace(ctx, fit, mask, effort),
    }
}

/// Whether two sets have the same forms in the same order.
pub(crate) fn alike(a: &[Part], b: &[Part]) -> bool {
    a.iter().map(|p| p.variant).eq(b.iter().map(|p| p.variant))
}

/// Ids of a set in the order in which they were found.
pub(crate) fn ids(fit: &Fit) -> Vec<&'static str> {
    fit.parts.iter().map(|p| p.id()).collect()
}
