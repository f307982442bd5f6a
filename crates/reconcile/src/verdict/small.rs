//! Small effects next to large ones, which the search leaves out: looked for last, under the strictest conditions.
//!
//! An effect that explains a thousandth of the gap may be the difference between the catalogue's equation of a large effect and
//! the rig's. So the search asks for more (`least_gain`). But a slow creep together with a delay explains no more either, and
//! yet spoils the free run. At the end the two cases can be separated. If the small effect is real, freer forms of the large ones
//! have nothing left to take up. If it only replaces their form, they gain in addition to it. If something was set aside, the form
//! of the large effects is known to differ, and nothing small is looked for.

use crate::fit::context::{Context, Fit};
use crate::search::cost::{before_forms, least_gain, penalised_cost, prior_penalty, threshold};
use crate::search::effort::Effort;
use crate::search::found::Found;
use crate::search::sequential::{FREELY, extensions, ids, settle};
use crate::thresholds::THRESHOLDS;
use crate::verdict::{form, held_out, judge, split};

/// Leads that are followed to the end.
const LEADS: usize = 3;

/// Adds the small effects that hold next to a set, one after another.
pub(crate) fn add(
    ctx: &Context<'_>,
    found: &mut Found,
    effort: Effort,
    progress: &mut dyn FnMut(&str),
) {
    let all = ctx.problem.all();
    while !found.fit.parts.is_empty() && found.fit.parts.len() < effort.max_effects {
        progress(&format!(
            "looking for what is small beside {}",
            ids(&found.fit).join(" + ")
        ));
        let next = extensions(ctx, &found.fit, &all, effort, LEADS, &[], FREELY);
        let Some(top) = next.first() else {
            return;
        };
        if !stands(ctx, found, top, &next[1..], effort.threads) {
            return;
        }
        let (fit, rivals) = settle(ctx, top.clone(), None, &all, effort);
        // All names so far hold, and there was work left to weigh everything.
        if rivals.len() < fit.parts.len() || !top.parts.iter().all(|p| fit.has(p.id())) {
            return;
        }
        found.steps.push((ids(&fit), fit.chi2));
        (found.fit, found.rivals) = (fit, rivals);
    }
}

/// Whether the last part of an enlarged set is a separate effect: the cheap questions first.
fn stands(ctx: &Context<'_>, found: &Found, top: &Fit, others: &[Fit], threads: usize) -> bool {
    let large = found.fit.parts.len();
    let part = &top.parts[large];
    let gained = found.fit.chi2 - top.chi2;
    let added = top.freedom().saturating_sub(found.fit.freedom()).max(1);
    let before: Vec<usize> = (0..large).collect();
    let cost = penalised_cost(ctx, top);
    let rivalled = others.iter().any(|f| {
        penalised_cost(ctx, f) - cost < THRESHOLDS.tie
            && f.parts.last().is_some_and(|p| p.id() != part.id())
    });
    let another_anchoring =
        part.variant.is_gain() && top.parts.iter().any(|p| p.variant.has_two_gains());
    // What gains more was weighed by the search.
    let began = before_forms(ctx, &found.null, &found.fit, &ctx.problem.all());
    let most = least_gain(ctx, added, began - found.fit.chi2);
    gained < most
        && gained > THRESHOLDS.small_gain * threshold(added)
        && part.matters()
        && prior_penalty(part, 0.0) == 0.0
        && !rivalled
        && !another_anchoring
        && judge::first_at_bound(ctx, top).is_none()
        && form::gain_of_freer(ctx, top, &before) < THRESHOLDS.companion_rest * gained
        && held_out::check(ctx, top, threads).unconfirmed.is_empty()
        && split::disagreement(ctx, &found.null, top, threads).is_none_or(|m| !m.of_size)
}
