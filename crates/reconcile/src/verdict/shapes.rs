//! Shapes of one effect: equations under one name and with the same numbers that the records may not tell apart.
//!
//! The shape is one more number of the fit. An interval covers all shapes: the values that each allows, within the likelihood that
//! its own fit leaves.

use crate::fit::catalogue::Part;
use crate::fit::context::{Context, Fit};
use crate::verdict::parameters::{SURE, Sureness, parameters};
use crate::verdict::result::Effect as NamedEffect;

/// Rounds of a fit with another shape.
const ROUNDS: usize = 12;

/// Widens the intervals of all numbers of a set to what other shapes of its effects allow. `effects` are those of the set, in its order;
/// `wide` is by how many times each number is less sure than the likelihood says.
pub(crate) fn reach(
    ctx: &Context<'_>,
    fit: &Fit,
    wide: &[f64],
    effects: &mut [NamedEffect],
    threads: usize,
) {
    let least_wide = wide.iter().copied().fold(f64::INFINITY, f64::min);
    let shapes: Vec<(usize, Part)> = (fit.parts.iter().enumerate())
        .flat_map(|(i, part)| {
            let theta = part.theta.clone();
            (part.variant.shapes()).map(move |variant| {
                let theta = theta.clone();
                (i, Part { variant, theta })
            })
        })
        .collect();
    let others = cellpos_numeric::parallel::map(&shapes, threads, |(i, shape)| {
        let mut parts = fit.parts.clone();
        parts[*i] = shape.clone();
        ctx.fit_from(parts, Some(fit.soft), &ctx.problem.all(), ROUNDS)
    });
    for other in others {
        let fallen = (other.chi2 - fit.chi2).max(0.0) / (SURE * SURE);
        if fallen >= least_wide * least_wide {
            continue;
        }
        let sure = Sureness {
            ends: vec![None; wide.len()],
            wide: wide.iter().map(|w| (w * w - fallen).sqrt()).collect(),
        };
        for (index, effect) in effects.iter_mut().enumerate() {
            for (name, allowed) in parameters(ctx, &other, index, &sure) {
                if let Some(found) = effect.parameters.get_mut(&name) {
                    found.cover(allowed.ci95);
                }
            }
        }
    }
}
