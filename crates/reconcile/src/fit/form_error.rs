//! The error of form: what an effect's equation in the catalogue may leave of the rig's own.
//!
//! The catalogue has one equation for an effect, and a rig another. Their difference is small compared with the effect, and looks like a
//! little of something else: a knee like a gain, a drag like a slew limit. So it is part of the covariance of the residuals. Of each effect
//! k of a set that covariance has the term `(s a_k)^2 F_k F_k'`: `s` is [`crate::thresholds::Thresholds::form_error`], `a_k` is the size of the effect's response, and the columns of `F_k`
//! are what such a difference can look like. These are
//!
//! - the effect's numbers varying with command, position, speed and time, at the output and where they act; spread about their values;
//!   slower in parts; a curve that bends elsewhere;
//! - and the response of every other effect of the catalogue.
//!
//! An effect that is added to the set must then gain more than such a difference would.

use crate::dot::dot;
use crate::fit::catalogue::Part;
use crate::fit::context::{Context, Fit};
use crate::fit::linear::{Tangents, sum_squares};
use crate::mask::Mask;
use crate::thresholds::THRESHOLDS;
use cellpos_plant::effects::{Action, Role};
use nalgebra::{DMatrix, SymmetricEigen};

/// Sizes that an error of form may have, in those of [`crate::thresholds::Thresholds::form_error`]: some equations are nearly nature's, and some
/// describe a knee that is as wide as the range. Each is as likely.
const SIZES: [f64; 3] = [1.0 / 3.0, 1.0, 3.0];
/// Time constants of the slower parts, in rows: up to a decade beyond the memory of the effect.
const SMOOTH_ROWS: [f64; 4] = [1.0, 10.0, 100.0, 1000.0];
/// How far numbers are spread, in parts of themselves.
const SPREAD: [f64; 2] = [0.04, 0.12];
/// Places in the command's range, as shares of it, at which a curve may bend.
const KNOTS: [f64; 7] = [0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875];
/// Directions along which the variance is less than this part of the noise's take nothing off that matters.
const LEAST_VARIANCE: f64 = 0.02;

/// The error of form of a set, in the space of innovations.
pub(crate) struct FormError {
    /// By record: its principal directions, as long as their standard deviations.
    columns: Vec<Vec<Vec<f64>>>,
    /// Variance along the response of any other effect, in that of the noise.
    along_others: f64,
}

impl FormError {
    /// None, such as beside a model without effects.
    pub(crate) fn none(ctx: &Context<'_>) -> Self {
        Self {
            columns: vec![Vec::new(); ctx.problem.records.len()],
            along_others: 0.0,
        }
    }

    /// That of a fit, in the rows of a mask.
    pub(crate) fn of(ctx: &Context<'_>, fit: &Fit, mask: &Mask, threads: usize) -> Self {
        let mut error = Self::none(ctx);
        let parts: Vec<usize> = (0..fit.parts.len())
            .filter(|&k| has_forms(ctx, &fit.parts[k]))
            .collect();
        if parts.is_empty() {
            return error;
        }
        let sim = ctx.simulated(&fit.parts, fit.offset_um, mask);
        let others: usize = ctx
            .variants
            .iter()
            .map(|v| v.candidate().params.len())
            .sum();
        let of_part = cellpos_numeric::parallel::map(&parts, threads, |&k| {
            let each = THRESHOLDS.form_error.powi(2) * size_of(ctx, fit, k, mask);
            let mut kinds = Vec::new();
            if fit.parts[k].variant().role == Role::Chain {
                kinds.push(freer(ctx, fit, (k, &sim), mask));
            }
            if fit.parts[k].variant.is_curve() {
                kinds.push(curve(ctx, fit));
            }
            let own = kinds.iter().map(|columns| principal(columns, each, mask));
            (each, own.collect::<Vec<_>>())
        });
        for (each, kinds) in of_part {
            error.along_others += each / others as f64;
            for own in kinds {
                for (all, own) in error.columns.iter_mut().zip(own) {
                    all.extend(own);
                }
            }
        }
        error
    }

    /// What a gain is worth that was computed beside the columns, for a response that is one of those it may be taken for.
    pub(crate) fn beside_others(&self, gained: f64) -> f64 {
        gained / (1.0 + self.along_others)
    }

    /// The tangents of a fit with the columns beside them, each with the prior that it has.
    pub(crate) fn beside(&self, tangents: Tangents, fit: &Fit, mask: &Mask) -> Tangents {
        match self.columns.iter().all(Vec::is_empty) {
            true => tangents,
            false => tangents.with_priors(&self.columns, &fit.innovations, mask),
        }
    }

    /// Its most probable size in the residual of a fit whose numbers are fitted again, to the first order.
    pub(crate) fn most_probable(&self, ctx: &Context<'_>, fit: &Fit, mask: &Mask) -> MostProbable {
        let mut best = MostProbable::default();
        if self.columns.iter().all(Vec::is_empty) {
            return best;
        }
        let along = ctx
            .tangents(fit, mask)
            .across(&self.columns, &fit.innovations, mask);
        for size in SIZES {
            let variances = along
                .iter()
                .map(|(square, score)| (size * size * square, score));
            let (mut takes_off, mut worth) = (0.0, 0.0);
            for (variance, score) in variances {
                let off = size * size * score / (1.0 + variance);
                takes_off += off;
                worth += off - variance.ln_1p();
            }
            if worth > best.worth {
                best = MostProbable { takes_off, worth };
            }
        }
        best
    }
}

/// Part of the gap that the largest error of form explains.
pub(crate) fn largest_share() -> f64 {
    (SIZES[SIZES.len() - 1] * THRESHOLDS.form_error).powi(2)
}

/// The error of form of the most probable size; nothing if none at all is more probable.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct MostProbable {
    /// What it takes off the sum of squares.
    pub takes_off: f64,
    /// What it adds to twice the log-likelihood.
    pub worth: f64,
}

/// Whether the equation of a part may differ from the rig's: a delay, a gain and a constant have one equation, and a user's own effect is
/// what it is.
fn has_forms(ctx: &Context<'_>, part: &Part) -> bool {
    let variant = part.variant();
    let is_constant = variant.role == Role::Chain && variant.off_response;
    let is_delay = matches!(part.effect(&ctx.scope).act(), Action::Delay(_));
    !is_constant && !is_delay && !part.variant.is_gain() && !part.variant.is_own()
}

/// Sum of squares of the innovations that a part makes.
fn size_of(ctx: &Context<'_>, fit: &Fit, k: usize, mask: &Mask) -> f64 {
    let mut without = fit.clone();
    match fit.parts[k].variant().role {
        Role::Chain => {
            without.parts.remove(k);
        }
        Role::Line { .. } => {
            let line = &mut without.lines[fit.nth_of_role(k)];
            (line.iter_mut().flatten()).for_each(|wave| *wave = [0.0; 2]);
        }
        Role::Position => without.positions[fit.nth_of_role(k)] = [0.0; 2],
    }
    let (mut left, _) = ctx.innovations(&without, mask);
    for (left, e) in left.iter_mut().zip(&fit.innovations) {
        left.iter_mut().zip(e).for_each(|(left, e)| *left -= e);
    }
    sum_squares(&left, mask)
}

/// Principal directions of columns by record under a mask, as long as the square roots of their variances. Of columns of one size the
/// variance is `each` times the number of independent ones among them.
fn principal(columns: &[Vec<Vec<f64>>], each: f64, mask: &Mask) -> Vec<Vec<Vec<f64>>> {
    let count = columns.iter().map(Vec::len).max().unwrap_or(0);
    let mut products = DMatrix::<f64>::zeros(count, count);
    for (columns, ranges) in columns.iter().zip(mask) {
        for range in ranges {
            for (i, a) in columns.iter().enumerate() {
                for (j, b) in columns[..=i].iter().enumerate() {
                    products[(i, j)] += dot(&a[range.clone()], &b[range.clone()]);
                }
            }
        }
    }
    products.fill_upper_triangle_with_lower_triangle();
    let scale: Vec<f64> = (products.diagonal().iter())
        .map(|square| {
            if *square > 0.0 {
                square.sqrt().recip()
            } else {
                0.0
            }
        })
        .collect();
    let correlation = DMatrix::from_fn(count, count, |i, j| products[(i, j)] * scale[i] * scale[j]);
    let squares = correlation.norm_squared();
    // The decomposition of NaN would never end.
    if squares <= 0.0 || !squares.is_finite() {
        return vec![Vec::new(); columns.len()];
    }
    let variance = each * correlation.trace() / squares;
    let eigen = SymmetricEigen::new(correlation);
    let ways: Vec<_> = (eigen.eigenvalues.iter())
        .zip(eigen.eigenvectors.column_iter())
        .filter(|(along, _)| **along * variance > LEAST_VARIANCE)
        .map(|(_, way)| way)
        .collect();
    let of_record = |columns: &Vec<Vec<f64>>| -> Vec<Vec<f64>> {
        let rows = columns.first().map_or(0, Vec::len);
        ways.iter()
            .map(|way| {
                let mut all = vec![0.0; rows];
                for ((c, part), scale) in columns.iter().zip(way.iter()).zip(&scale) {
                    let part = part * scale * variance.sqrt();
                    all.iter_mut().zip(c).for_each(|(s, c)| *s += part * c);
                }
                all
            })
            .collect()
    };
    columns.iter().map(of_record).collect()
}

/// Innovations by record and column of what freer forms of a part of a fit would change.
fn freer(
    ctx: &Context<'_>,
    fit: &Fit,
    (k, sim): (usize, &[Vec<f64>]),
    mask: &Mask,
) -> Vec<Vec<Vec<f64>>> {
    let records = &ctx.problem.records;
    let dt = ctx.problem.base.sample_s;
    let mut out: Vec<Vec<Vec<f64>>> = vec![Vec::new(); records.len()];
    let moved = |j: usize, step: f64| {
        let mut parts = fit.parts.clone();
        parts[k].theta[j] += step;
        ctx.simulated(&parts, fit.offset_um, mask)
    };
    let part = &fit.parts[k];
    let memory_rows = part.memory_s(&ctx.scope) / dt;
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
            let (up, down) = (moved(j, step), moved(j, -step));
            for (i, r) in records.iter().enumerate() {
                let (a, b, c) = (&up[i], &down[i], &sim[i]);
                let rows = 0..c.len();
                let mut raw = vec![rows.clone().map(|n| a[n] + b[n] - 2.0 * c[n]).collect()];
                if spread == SPREAD[0] {
                    let slope: Vec<f64> = rows.map(|n| a[n] - b[n]).collect();
                    raw.extend(let_go(&slope, &r.u, c, (memory_rows, dt)));
                }
                out[i].extend(raw.iter().map(|raw: &Vec<f64>| match raw.is_empty() {
                    true => Vec::new(),
                    false => r.whitened(raw),
                }));
            }
        }
    }
    out
}

/// Innovations by record and column of any curve in front of a set. The bend where the range begins is a gain.
pub(crate) fn curve(ctx: &Context<'_>, fit: &Fit) -> Vec<Vec<Vec<f64>>> {
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

    #[test]
    fn independent_columns_have_the_variance_each_and_those_that_are_alike_share_it() {
        let mask: Mask = vec![
            std::iter::once(0..2).collect(),
            std::iter::once(0..1).collect(),
        ];
        // Two columns that are one but for their size, and one across.
        let columns = vec![
            vec![vec![3.0, 1.0], vec![6.0, 2.0], vec![1.0, -3.0]],
            vec![vec![2.0], vec![4.0], vec![0.0]],
        ];
        let kept = principal(&columns, 9.0, &mask);
        let sizes: Vec<f64> = (0..2)
            .map(|k| {
                let mine = [kept[0][k].clone(), kept[1][k].clone()];
                sum_squares(&mine, &mask)
            })
            .collect();
        // Of three columns 9/5 are independent: squares of the eigenvalues 2 and 1 over the square of their sum.
        assert!(
            (sizes[0] + sizes[1] - 9.0 * 9.0 / 5.0).abs() < 1e-9,
            "{sizes:?}"
        );
        assert!((sizes[0].max(sizes[1]) - 2.0 * 9.0 * 3.0 / 5.0).abs() < 1e-9);
        // What is below the noise is left out.
        assert!(principal(&columns, 0.02, &mask)[0].len() == 1);
    }
}
