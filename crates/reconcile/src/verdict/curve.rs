//! A hysteresis whose memory does not show: a static curve in front of the plant explains as much.

use crate::fit::catalogue::Part;
use crate::fit::context::{Context, Fit, freedom_of};
use crate::fit::form_error::{curve, largest_share};
use crate::fit::linear::{Columns, normal_equations};
use crate::mask::Mask;
use crate::search::cost::{gap, penalised_cost, threshold};
use crate::search::found::Found;
use crate::thresholds::THRESHOLDS;
use nalgebra::{DMatrix, DVector};

/// What was taken out of the names.
#[derive(Debug, Default)]
pub(crate) struct Aside {
    /// Ids with the part of the gap that they explain.
    pub curved: Vec<(String, f64)>,
    /// The set with them.
    pub whole: Option<Fit>,
}

/// Rounds of a fit without a part.
const ROUNDS: usize = 12;

/// Takes each hysteresis out of a set that a curve beside the others explains as well, or replaces it by a rival that is such a curve.
pub(crate) fn set_aside(ctx: &Context<'_>, found: &mut Found) -> Aside {
    let mut aside = Aside::default();
    let all = ctx.problem.all();
    let gap = gap(&found.null).max(1e-12);
    let mut i = 0;
    while found.fit.parts.len() > 1 && i < found.fit.parts.len() {
        let part = &found.fit.parts[i];
        if part.variant.memoryless().is_none() {
            i += 1;
            continue;
        }
        let without = ctx.fit_without(&found.fit, i, &all, ROUNDS);
        let gained = without.chi2 - found.fit.chi2;
        if !WithoutMemory::beside(ctx, &without).explains(part, gained) {
            i += 1;
            continue;
        }
        // What is smaller than an error of form may be is a form of the others.
        let is_large = gained > largest_share() * gap;
        if is_large && let Some(fit) = in_its_stead(ctx, found, i, &without) {
            found.fit = fit;
            let taken = found.fit.parts[i].id();
            found.rivals[i].retain(|r| r.id != taken);
            i += 1;
            continue;
        }
        let share = (gained.max(0.0) / gap).min(1.0);
        aside.curved.push((part.id().to_owned(), share));
        aside.whole.get_or_insert_with(|| found.fit.clone());
        found.lose(ctx, i, without, 1);
    }
    aside
}

/// The set with a rival in place of a hysteresis without memory: one that explains as much as a static curve does. A gain is such a
/// curve.
fn in_its_stead(ctx: &Context<'_>, found: &Found, i: usize, without: &Fit) -> Option<Fit> {
    found.fit.parts[i].variant.memoryless()?;
    let least = THRESHOLDS.curve_share * (without.chi2 - found.fit.chi2);
    let rivals = found.rivals.get(i)?.iter();
    let mut fits: Vec<Fit> = rivals
        .filter(|r| !r.is_limit && r.part.variant.memoryless().is_none())
        .map(|r| {
            let mut parts = found.fit.parts.clone();
            parts[i] = r.part.clone();
            ctx.fit_from(parts, Some(found.fit.soft), &ctx.problem.all(), ROUNDS)
        })
        .filter(|fit| without.chi2 - fit.chi2 > least)
        .collect();
    fits.sort_by(|a, b| penalised_cost(ctx, a).total_cmp(&penalised_cost(ctx, b)));
    fits.into_iter().next()
}

/// Gains in twice the log-likelihood over a set by what has no memory, in front of the plant.
pub(crate) struct WithoutMemory {
    by_a_gain: f64,
    by_a_curve: f64,
    records: usize,
}

impl WithoutMemory {
    pub(crate) fn beside(ctx: &Context<'_>, set: &Fit) -> Self {
        let curve = curve(ctx, set);
        let gain = curve.iter().map(|columns| columns[..1].to_vec()).collect();
        let beside = gained_beside(ctx, set, curve);
        Self {
            by_a_gain: gained_beside(ctx, set, gain),
            by_a_curve: instead_of_curves(ctx, set).map_or(beside, |by| by.max(beside)),
            records: ctx.problem.records.len(),
        }
    }

    /// What is left of a gain in twice the log-likelihood beyond a gain of the plant.
    pub(crate) fn beyond_a_gain(&self, gained: f64) -> f64 {
        gained - self.by_a_gain
    }

    /// Whether some curve explains a hysteresis that gains so much as well. Of a gain nothing is said: a hysteresis makes
    /// one, however well its memory shows.
    pub(crate) fn explains(&self, part: &Part, gained: f64) -> bool {
        let memory = gained - self.by_a_curve;
        memory < threshold(freedom_of(part.variant(), self.records))
            || self.beyond_a_gain(self.by_a_curve)
                > THRESHOLDS.curve_share * self.beyond_a_gain(gained)
    }
}

/// The gain of a set if one curve takes the place of all curves in it; None if it has none. Where a curve of the set is flat, such
/// as beyond a saturation, no bend in front of it shows.
fn instead_of_curves(ctx: &Context<'_>, set: &Fit) -> Option<f64> {
    let bent = set.parts.iter().filter(|p| !p.variant.is_curve());
    let bent: Vec<Part> = bent.cloned().collect();
    if bent.len() == set.parts.len() {
        return None;
    }
    let bare = ctx.fit_from(bent, Some(set.soft), &ctx.problem.all(), ROUNDS);
    Some(gained_beside(ctx, &bare, curve(ctx, &bare)) - (bare.chi2 - set.chi2))
}

/// The gain in twice the log-likelihood by further columns in a fit, with its numbers free as well, beyond chance.
fn gained_beside(ctx: &Context<'_>, fit: &Fit, more: Vec<Vec<Vec<f64>>>) -> f64 {
    let all = ctx.problem.all();
    let mut columns = ctx.tangents(fit, &all).columns;
    let own = gain_of(&columns, &fit.innovations, &all);
    let at = columns
        .iter()
        .flatten()
        .map(|(k, _)| k + 1)
        .max()
        .unwrap_or(0);
    let count = more.first().map_or(0, Vec::len);
    for (columns, more) in columns.iter_mut().zip(more) {
        columns.extend(more.into_iter().enumerate().map(|(k, c)| (at + k, c)));
    }
    gain_of(&columns, &fit.innovations, &all) - own - count as f64
}

/// The gain in twice the log-likelihood when all columns are fitted to innovations, each scaled by its size.
fn gain_of(columns: &[Columns], e: &[Vec<f64>], mask: &Mask) -> f64 {
    let n = columns
        .iter()
        .flatten()
        .map(|(k, _)| k + 1)
        .max()
        .unwrap_or(0);
    let (a, g) = normal_equations(n, columns, e, mask);
    let size: Vec<f64> = (0..n)
        .map(|i| a[(i, i)].sqrt())
        .map(|s| if s > 0.0 { 1.0 / s } else { 0.0 })
        .collect();
    let scaled = DMatrix::from_fn(n, n, |i, j| {
        let v = a[(i, j)] * size[i] * size[j];
        if i == j { v + 1e-7 } else { v }
    });
    let g = DVector::from_fn(n, |i, _| g[i] * size[i]);
    scaled.cholesky().map_or(0.0, |c| g.dot(&c.solve(&g)))
}
