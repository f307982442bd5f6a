//! Small effects that only replace the form of larger ones.
//!
//! The catalogue has one equation for an effect, and a rig another. Their difference is small compared with the effect, and looks
//! like a little of something else: a knee like a gain, a drag like a slew limit. The large effects themselves show whether a
//! small companion is such a difference. Their numbers may vary with command, position, speed and time, at the output and where
//! they act; they may be spread about their values, or slower in parts; a curve may bend elsewhere. If that gains as much as the
//! companion, and still gains when the companion is present, the companion gets no name.

use crate::dot::dot;
use crate::fit::catalogue::Part;
use crate::fit::context::{Context, Fit, freedom_of};
use crate::fit::linear::Columns;
use crate::search::cost::{gap, penalised_cost, prior_penalty, threshold};
use crate::search::found::Found;
use crate::thresholds::THRESHOLDS;
use cellpos_plant::effects::Role;
use nalgebra::{DMatrix, DVector};

/// What was taken out of the names.
#[derive(Debug, Default)]
pub(crate) struct Aside {
    /// Ids, of several that go together with "and" between, with the part of the gap that they explain.
    pub companions: Vec<(String, f64)>,
    /// The set with them.
    pub whole: Option<Fit>,
}

/// Time constants of the slower parts, in rows: up to a decade beyond the memory of the effect.
const SMOOTH_ROWS: [f64; 4] = [1.0, 10.0, 100.0, 1000.0];
/// How far numbers are spread, in parts of themselves.
const SPREAD: [f64; 2] = [0.04, 0.12];
/// Rounds of a fit without a part.
const ROUNDS: usize = 12;

/// Takes companions out of a set that are no more than the form of the others, smallest first.
pub(crate) fn set_aside(ctx: &Context<'_>, found: &mut Found, threads: usize) -> Aside {
    let mut aside = Aside::default();
    let all = ctx.problem.all();
    let gap = gap(&found.null).max(1e-12);
    one_form(ctx, found, &mut aside, threads);
    while found.fit.parts.len() > 1 {
        let indices: Vec<usize> = (0..found.fit.parts.len()).collect();
        let without = cellpos_numeric::parallel::map(&indices, threads, |&i| {
            ctx.fit_without(&found.fit, i, &all, ROUNDS)
        });
        let worth: Vec<f64> = without
            .iter()
            .map(|w| (w.chi2 - found.fit.chi2).max(0.0) / gap)
            .collect();
        let mut order = indices;
        order.sort_by(|a, b| worth[*a].total_cmp(&worth[*b]));
        let Some(i) = order.into_iter().find(|&i| {
            let part = &found.fit.parts[i];
            let gained = without[i].chi2 - found.fit.chi2;
            may_be_form(part)
                && (part.variant.memoryless().is_some()
                    && WithoutMemory::beside(ctx, &without[i]).explains(part, gained)
                    || worth[i] < THRESHOLDS.companion_share
                        && is_form(ctx, &found.fit, i, &without[i], &worth))
        }) else {
            break;
        };
        // What is small is a form of the others.
        let is_large = worth[i] >= THRESHOLDS.companion_share;
        if is_large && let Some(fit) = in_its_stead(ctx, found, i, &without[i]) {
            found.fit = fit;
            let taken = found.fit.parts[i].id();
            found.rivals[i].retain(|r| r.id != taken);
            continue;
        }
        aside
            .companions
            .push((found.fit.parts[i].id().to_owned(), worth[i].min(1.0)));
        aside.whole.get_or_insert_with(|| found.fit.clone());
        found.lose(ctx, i, without[i].clone(), threads);
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

/// Reduces a set to one effect if that effect alone, in a freer form, explains as much as the set. Within such a set no effect is
/// small compared with the others.
fn one_form(ctx: &Context<'_>, found: &mut Found, aside: &mut Aside, threads: usize) {
    let all = ctx.problem.all();
    let gap = gap(&found.null).max(1e-12);
    let count = found.fit.parts.len();
    if count < 3 || !found.fit.parts.iter().all(may_be_form) {
        return;
    }
    let indices: Vec<usize> = (0..count).collect();
    let alone = cellpos_numeric::parallel::map(&indices, threads, |&i| {
        let part = found.fit.parts[i].clone();
        ctx.fit_from(vec![part], Some(found.fit.soft), &all, ROUNDS)
    });
    let Some(best) = indices
        .into_iter()
        .min_by(|a, b| alone[*a].chi2.total_cmp(&alone[*b].chi2))
    else {
        return;
    };
    let one = &alone[best];
    let gained = one.chi2 - found.fit.chi2;
    if gained > THRESHOLDS.companion_share * gap
        || gain_of_freer(ctx, one, &[0]) < gained
        || gain_of_freer(ctx, &found.fit, &[best]) < THRESHOLDS.companion_rest * gained
    {
        return;
    }
    let others = found.fit.parts.iter().enumerate();
    let others: Vec<&str> = others
        .filter(|(i, _)| *i != best)
        .map(|(_, part)| part.id())
        .collect();
    aside.companions.push((others.join(" and "), gained / gap));
    aside.whole = Some(found.fit.clone());
    found.keep(ctx, &[best], one.clone(), threads);
}

/// Whether a part is one whose share of the response another effect's form may take.
fn may_be_form(part: &Part) -> bool {
    let variant = part.variant();
    variant.role == Role::Chain && !variant.off_response && !part.variant.is_own()
}

/// Whether part `i` only replaces the form of the larger parts: their freer forms gain as much without it, and still gain with it.
/// They may imitate much of a real companion, but gain nothing once it is present.
fn is_form(ctx: &Context<'_>, fit: &Fit, i: usize, without: &Fit, worth: &[f64]) -> bool {
    let gained = without.chi2 - fit.chi2;
    let larger: Vec<usize> = (0..fit.parts.len())
        .filter(|&k| k != i && worth[k] > THRESHOLDS.companion_times * worth[i])
        .collect();
    // In the set without it, parts behind it have moved up.
    let moved: Vec<usize> = larger.iter().map(|&k| k - usize::from(k > i)).collect();
    // A number that no rig shows asks for less.
    let share = match prior_penalty(&fit.parts[i], 0.0) > 0.0 {
        true => THRESHOLDS.companion_untypical,
        false => 1.0,
    };
    gain_of_freer(ctx, without, &moved) > share * gained
        && gain_of_freer(ctx, fit, &larger) > THRESHOLDS.companion_rest * gained
}

/// The gain in twice the log-likelihood by freer forms of some parts of a fit, beyond chance; None if they have no such forms.
pub(crate) fn gain_of_freer(ctx: &Context<'_>, fit: &Fit, parts: &[usize]) -> f64 {
    let free = freer(ctx, fit, parts);
    if free.first().is_none_or(Vec::is_empty) {
        return 0.0;
    }
    gained_beside(ctx, fit, free)
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
    let mut columns = ctx.tangents(fit, &ctx.problem.all()).columns;
    let own = gain_of(&columns, &fit.innovations);
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
    gain_of(&columns, &fit.innovations) - own - count as f64
}

/// Innovations by record and column of what freer forms of some parts of a fit would change.
fn freer(ctx: &Context<'_>, fit: &Fit, parts: &[usize]) -> Vec<Vec<Vec<f64>>> {
    let all = ctx.problem.all();
    let records = &ctx.problem.records;
    let mut out: Vec<Vec<Vec<f64>>> = vec![Vec::new(); records.len()];
    let mut curved = false;
    let sim = ctx.simulated(&fit.parts, fit.offset_um, &all);
    let moved = |k: usize, j: usize, step: f64| {
        let mut parts = fit.parts.clone();
        parts[k].theta[j] += step;
        ctx.simulated(&parts, fit.offset_um, &all)
    };
    for &k in parts {
        let part = &fit.parts[k];
        if part.variant().role != Role::Chain {
            continue;
        }
        curved |= part.variant.is_curve();
        let memory_rows = part.memory_s(&ctx.scope) / ctx.problem.base.sample_s;
        for (j, p) in part.variant().params.iter().enumerate() {
            if p.name == "weights" {
                continue;
            }
            for spread in SPREAD {
                let step = if p.log {
                    spread
                } else {
                    spread * part.theta[j].abs()
                };
                let (up, down) = (moved(k, j, step), moved(k, j, -step));
                for (i, r) in records.iter().enumerate() {
                    let rows = 0..r.u.len();
                    let (a, b, c) = (&up[i], &down[i], &sim[i]);
                    let mut raw = vec![rows.clone().map(|n| a[n] + b[n] - 2.0 * c[n]).collect()];
                    if spread == SPREAD[0] {
                        let slope: Vec<f64> = rows.map(|n| a[n] - b[n]).collect();
                        raw.extend(let_go(
                            &slope,
                            &r.u,
                            c,
                            (memory_rows, ctx.problem.base.sample_s),
                        ));
                    }
                    out[i].extend(raw.iter().map(|raw: &Vec<f64>| r.whitened(raw)));
                }
            }
        }
    }
    if curved {
        for (out, bends) in out.iter_mut().zip(bends(ctx, fit, &KNOTS)) {
            out.extend(bends);
        }
    }
    out
}

/// Places in the command's range, as shares of it, at which a curve may bend.
const KNOTS: [f64; 7] = [0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875];

/// Innovations by record and column of any curve in front of a set. The bend where the range begins is a gain.
fn curve(ctx: &Context<'_>, fit: &Fit) -> Vec<Vec<Vec<f64>>> {
    bends(ctx, fit, &[&[0.0], &KNOTS[..]].concat())
}

/// Innovations by record and column of a curve in front of a set that bends at these places of the command's range.
fn bends(ctx: &Context<'_>, fit: &Fit, knots: &[f64]) -> Vec<Vec<Vec<f64>>> {
    let records = &ctx.problem.records;
    let sim = ctx.simulated(&fit.parts, fit.offset_um, &ctx.problem.all());
    let (low, high) = records
        .iter()
        .flat_map(|r| &r.u)
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), u| {
            (a.min(*u), b.max(*u))
        });
    records
        .iter()
        .zip(&sim)
        .map(|(r, sim)| {
            knots
                .iter()
                .map(|knot| {
                    let at = low + knot * (high - low);
                    let bent: Vec<f64> = r.u.iter().map(|u| (u - at).max(0.0)).collect();
                    r.whitened(&ctx.response(fit, (r, sim), &bent))
                })
                .collect()
        })
        .collect()
}

/// A change by a number, as it would be if the number went with command, position, speed or time, or its effect came later.
fn let_go(slope: &[f64], u: &[f64], y: &[f64], (memory_rows, dt): (f64, f64)) -> Vec<Vec<f64>> {
    let with = |f: &dyn Fn(usize) -> f64| -> Vec<f64> {
        slope.iter().enumerate().map(|(k, s)| s * f(k)).collect()
    };
    let speed = |x: &[f64], k: usize| x[k] - x[k.saturating_sub(1)];
    // In a closed loop a row's command answers the row's own innovation; the command before it does not.
    let command = |k: usize| u[k.saturating_sub(1)];
    let acts = |f: &dyn Fn(usize) -> f64| -> Vec<f64> {
        let mut sum = 0.0;
        (0..slope.len())
            .map(|k| {
                sum += speed(slope, k) * f(k);
                sum
            })
            .collect()
    };
    let mut out = vec![
        with(&command),
        with(&|k| command(k).abs()),
        with(&|k| command(k) * command(k)),
        with(&|k| y[k]),
        with(&|k| y[k].abs()),
        with(&|k| y[k] * y[k]),
        with(&|k| speed(y, k).abs()),
        with(&|k| k as f64 * dt),
        acts(&command),
        acts(&|k| command(k).abs()),
        acts(&|k| command(k) * command(k)),
        acts(&|k| speed(y, k).abs()),
    ];
    let slowest = 10.0 * memory_rows;
    for rows in SMOOTH_ROWS.into_iter().filter(|r| *r <= slowest.max(1.0)) {
        let share = -(-1.0 / rows).exp_m1();
        let mut low = 0.0;
        out.push(
            slope
                .iter()
                .map(|s| {
                    low += share * (s - low);
                    low
                })
                .collect(),
        );
    }
    out
}

/// The gain in twice the log-likelihood when all columns are fitted to innovations, each scaled by its size.
fn gain_of(columns: &[Columns], e: &[Vec<f64>]) -> f64 {
    let n = columns
        .iter()
        .flatten()
        .map(|(k, _)| k + 1)
        .max()
        .unwrap_or(0);
    let (mut a, mut g) = (DMatrix::<f64>::zeros(n, n), DVector::<f64>::zeros(n));
    for (columns, e) in columns.iter().zip(e) {
        for (x, (i, ci)) in columns.iter().enumerate() {
            g[*i] += dot(ci, e);
            for (j, cj) in &columns[..=x] {
                let v = dot(ci, cj);
                a[(*i, *j)] += v;
                if i != j {
                    a[(*j, *i)] += v;
                }
            }
        }
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn freer_forms_say_nothing_of_a_row_by_the_command_that_answers_it() {
        let rows = 40;
        let slope: Vec<f64> = (0..rows).map(|k| (0.9 * f64::from(k)).sin()).collect();
        let y: Vec<f64> = (0..rows).map(|k| (0.3 * f64::from(k)).cos()).collect();
        let before: Vec<f64> = (0..rows).map(|k| (1.7 * f64::from(k)).sin()).collect();
        let mut after = before.clone();
        after[20] += 1.0;
        let of = |u: &[f64]| let_go(&slope, u, &y, (2.0, 1e-3));
        let mut moved = false;
        for (a, b) in of(&before).iter().zip(&of(&after)) {
            assert_eq!(a[..=20], b[..=20]);
            moved |= a[21..] != b[21..];
        }
        assert!(moved);
    }
}
