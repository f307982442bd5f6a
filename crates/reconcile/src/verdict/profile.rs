//! How far a number may go before the records speak against it: the profile of the likelihood, all other numbers fitted again.
//!
//! If the records fix little more than the ratio of two numbers, the likelihood is a curved ridge. The ellipse of the curvature at
//! the best place touches it there and nowhere else.

use crate::fit::context::{Context, Fit, freedom_of};
use crate::verdict::parameters::SURE;
use cellpos_plant::effects::Role;

/// Steps towards an end.
const STEPS: usize = 4;
/// An end is found if the likelihood has fallen by the required amount, to this share of it: a twentieth of a standard deviation.
const NEAR: f64 = 0.05;
/// Rounds of a fit with a number held.
const ROUNDS: usize = 5;

/// Ends of the 95 % interval of every number of a set, in the fit's coordinates. `None` for a number without a profile: a weight,
/// a line, one that no record shows. `wide` is the factor by which each is less sure than the likelihood says.
pub(crate) fn ends(
    ctx: &Context<'_>,
    fit: &Fit,
    wide: &[f64],
    threads: usize,
) -> Vec<Option<[f64; 2]>> {
    let mut jobs = Vec::new();
    let (mut at, mut column) = (0, 0);
    for (index, part) in fit.parts.iter().enumerate() {
        for (j, p) in part.variant().params.iter().enumerate() {
            let sd = fit.covariance[(at, at)].max(0.0).sqrt();
            let has_profile = part.variant().role == Role::Chain && p.name != "weights";
            let told = has_profile && sd.is_finite() && sd > 0.0;
            jobs.push(told.then_some((
                Number {
                    index,
                    j,
                    at,
                    column: column + j,
                },
                sd,
            )));
            at += 1;
        }
        column += freedom_of(part.variant(), ctx.problem.records.len());
    }
    let ways: Vec<(usize, f64)> = (0..jobs.len())
        .flat_map(|i| [(i, -1.0), (i, 1.0)])
        .collect();
    let found = cellpos_numeric::parallel::map(&ways, threads, |&(i, way)| {
        jobs[i].map(|(number, sd)| number.end(ctx, fit, way * sd, SURE * wide[i]))
    });
    (found.chunks_exact(2))
        .map(|pair| Some([pair[0]?, pair[1]?]))
        .collect()
}

/// A number of a set.
#[derive(Debug, Clone, Copy)]
struct Number {
    /// Its part, and which of the part's.
    index: usize,
    j: usize,
    /// Its place among the numbers of all parts, and among those of the fit.
    at: usize,
    column: usize,
}

impl Number {
    /// The place on the side of `sd` at which the root of the likelihood's fall is `limit`.
    fn end(self, ctx: &Context<'_>, fit: &Fit, sd: f64, limit: f64) -> f64 {
        let part = &fit.parts[self.index];
        let p = &part.variant().params[self.j];
        let (low, high) = (p.coordinate(p.lower), p.coordinate(p.upper));
        let x = part.theta[self.j];
        let mut near = (x, 0.0);
        let mut moved = limit * sd;
        let mut from = fit.clone();
        for _ in 0..STEPS {
            let to = (x + moved).clamp(low, high);
            from = self.held_at(ctx, &from, to);
            let fallen = (from.chi2 - fit.chi2).max(0.0).sqrt();
            if (fallen - limit).abs() < NEAR * limit || (fallen < limit && to != x + moved) {
                return to;
            }
            // A line through this place and the best one; beyond the end, the last one on this side.
            let (a, f) = if fallen > limit { near } else { (to, fallen) };
            let (b, g) = if fallen > limit { (to, fallen) } else { near };
            let slope = (g - f) / (b - a);
            let ahead = a + (limit - f) / slope - x;
            if fallen <= limit {
                near = (to, fallen);
            }
            moved = if ahead.is_finite() && ahead * sd > 0.0 {
                sd * (ahead / sd).min(3.0 * (to - x) / sd)
            } else {
                3.0 * (to - x)
            };
        }
        (x + moved).clamp(low, high)
    }

    /// The fit with this number at a place, the others first where the curvature expects them.
    fn held_at(self, ctx: &Context<'_>, fit: &Fit, to: f64) -> Fit {
        let mut held = fit.clone();
        let moved = to - fit.parts[self.index].theta[self.j];
        let variance = fit.covariance[(self.at, self.at)];
        let mut at = 0;
        for part in &mut held.parts {
            for (x, p) in part.theta.iter_mut().zip(part.variant.candidate().params) {
                let shift = moved * fit.covariance[(at, self.at)] / variance;
                if at == self.at {
                    *x = to;
                } else if shift.is_finite() && part.variant.candidate().role == Role::Chain {
                    *x = p.coordinate(p.natural(*x + shift));
                }
                at += 1;
            }
        }
        ctx.refit_with(&held, &ctx.problem.all(), ROUNDS, self.column)
    }
}
