//! Two effects that look poor alone and explain together what a third one only comes near to.
//!
//! A step of the search adds the best effect to those before it, and goes wrong where the first one was such a compromise. So once, all
//! pairs of starts are weighed together: each start gives a direction in the space of innovations, and a pair is worth what the plane of
//! two explains.

use crate::dot::dot;
use crate::fit::catalogue::{Part, Variant};
use crate::fit::context::{Context, Fit};
use crate::fit::descent::Until;
use crate::mask::Mask;
use crate::search::cost::penalised_cost;
use crate::search::effort::Effort;
use cellpos_plant::effects::Role;

/// Rows that weigh a pair: a ranking needs no more, and all starts are held at once.
const MOST_ROWS: usize = 16_000;
/// Rows that follow each other in them.
const BLOCK: usize = 64;
/// A start that would be scaled down to less than this part of itself points elsewhere.
const LEAST_SCALE: f64 = 0.02;

/// Some of the rows of a mask, evenly over the records.
struct Thinned {
    rows: Vec<(usize, std::ops::Range<usize>)>,
}

impl Thinned {
    fn new(mask: &Mask) -> Self {
        let blocks: Vec<_> = (mask.iter().enumerate())
            .flat_map(|(record, ranges)| ranges.iter().map(move |r| (record, r)))
            .flat_map(|(record, r)| {
                let starts = (r.start..r.end).step_by(BLOCK);
                starts.map(move |k| (record, k..(k + BLOCK).min(r.end)))
            })
            .collect();
        let step = (blocks.len() * BLOCK).div_ceil(MOST_ROWS).max(1);
        Self {
            rows: blocks.into_iter().step_by(step).collect(),
        }
    }

    fn of(&self, innovations: &[Vec<f64>]) -> Vec<f64> {
        let of =
            |(record, rows): &(usize, std::ops::Range<usize>)| &innovations[*record][rows.clone()];
        self.rows.iter().flat_map(of).copied().collect()
    }
}

/// Takes an orthonormal basis off a direction.
fn take_off(basis: &[Vec<f64>], direction: &mut [f64]) {
    for b in basis {
        let share = dot(b, direction);
        direction
            .iter_mut()
            .zip(b)
            .for_each(|(d, b)| *d -= share * b);
    }
}

/// What two directions explain of the innovations together, each at a scale of its own: `[xx, yy, xy]` and `[xe, ye]` are the inner
/// products. Nothing if one of them would have to turn around.
fn worth_of_plane([xx, yy, xy]: [f64; 3], [xe, ye]: [f64; 2]) -> f64 {
    let det = xx * yy - xy * xy;
    if det <= 1e-6 * xx * yy || det.is_nan() {
        return 0.0;
    }
    let (x, y) = ((xy * ye - yy * xe) / det, (xy * xe - xx * ye) / det);
    match x > LEAST_SCALE && y > LEAST_SCALE {
        true => -(x * xe + y * ye),
        false => 0.0,
    }
}

/// The most valuable pairs, one of every two ids, best first.
fn pairs(
    ctx: &Context<'_>,
    null: &Fit,
    mask: &Mask,
    threads: usize,
    allowed: impl Fn(Variant) -> bool,
) -> Vec<[Part; 2]> {
    let chains =
        (ctx.variants.iter()).filter(|v| allowed(**v) && v.candidate().role == Role::Chain);
    let starts: Vec<Part> = chains.flat_map(|v| v.starts(&ctx.scope)).collect();
    let thinned = Thinned::new(mask);
    let mut basis: Vec<Vec<f64>> = Vec::new();
    let tangents = ctx.tangents(null, mask);
    for number in 0..tangents.gradient.len() {
        let of = |(columns, e): (&Vec<(usize, Vec<f64>)>, &Vec<f64>)| {
            let column = columns.iter().find(|(i, _)| *i == number);
            column.map_or_else(|| vec![0.0; e.len()], |(_, c)| c.clone())
        };
        let whole: Vec<Vec<f64>> = (tangents.columns.iter())
            .zip(&null.innovations)
            .map(of)
            .collect();
        let mut column = thinned.of(&whole);
        take_off(&basis, &mut column);
        let size = dot(&column, &column).sqrt();
        if size > 0.0 {
            column.iter_mut().for_each(|c| *c /= size);
            basis.push(column);
        }
    }
    let sim = ctx.simulated(&null.parts, null.offset_um, mask);
    let directions = cellpos_numeric::parallel::map(&starts, threads, |part| {
        let mut direction = thinned.of(&ctx.change(null, &sim, part, mask));
        take_off(&basis, &mut direction);
        direction
    });
    let e = thinned.of(&null.innovations);
    let own: Vec<[f64; 2]> = directions.iter().map(|d| [dot(d, d), dot(d, &e)]).collect();
    let firsts: Vec<usize> = (0..starts.len()).filter(|&i| own[i][0] > 0.0).collect();
    let of_first = cellpos_numeric::parallel::map(&firsts, threads, |&i| {
        let others = (i + 1..starts.len()).filter(|&j| starts[j].id() != starts[i].id());
        let weighed = others.map(|j| {
            let xy = dot(&directions[i], &directions[j]);
            let worth = worth_of_plane([own[i][0], own[j][0], xy], [own[i][1], own[j][1]]);
            (worth, i, j)
        });
        weighed
            .filter(|(worth, ..)| *worth > 0.0)
            .collect::<Vec<_>>()
    });
    let mut all: Vec<(f64, usize, usize)> = of_first.into_iter().flatten().collect();
    all.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut seen: Vec<[&str; 2]> = Vec::new();
    all.retain(|(_, i, j)| {
        let mut ids = [starts[*i].id(), starts[*j].id()];
        ids.sort_unstable();
        let new = !seen.contains(&ids);
        if new {
            seen.push(ids);
        }
        new
    });
    all.into_iter()
        .map(|(_, i, j)| [starts[i].clone(), starts[j].clone()])
        .collect()
}

/// The best pair of effects of which none is that of a set of one, in which it may be a compromise between the two. `top` is the set that
/// it must beat.
pub(crate) fn pair_in_place_of(
    (ctx, mask, effort): (&Context<'_>, &Mask, Effort),
    null: &Fit,
    fit: &Fit,
    top: &Fit,
) -> Option<Fit> {
    /// As many as a screening follows, and a half of them to the end.
    const MOST: usize = 8;
    let leads = pairs(ctx, null, mask, effort.threads, |v| {
        !v.candidate().late && !v.is_own() && !ctx.excludes(v.id()) && !fit.has(v.id())
    });
    let cost = |f: &Fit| penalised_cost(ctx, f);
    let leads: Vec<[Part; 2]> = leads.into_iter().take(MOST).collect();
    let mut fits = cellpos_numeric::parallel::map(&leads, effort.threads, |pair| {
        ctx.fit_from(pair.to_vec(), Some(fit.soft), mask, 4)
    });
    fits.sort_by(|a, b| cost(a).total_cmp(&cost(b)));
    fits.truncate(MOST / 2);
    let until = Until {
        iterations: 14,
        // No set costs less than its sum of squares.
        least_chi2: cost(top),
    };
    let fits = cellpos_numeric::parallel::map(&fits, effort.threads, |f| {
        ctx.refit_towards(f, mask, until)
    });
    let best = fits.into_iter().min_by(|a, b| cost(a).total_cmp(&cost(b)));
    best.filter(|f| cost(f) < cost(top))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plane_explains_what_two_directions_do_together_and_neither_backwards() {
        let (x, y) = ([1.0, 1.0, 0.0], [0.0, 1.0, 1.0]);
        let worth = |e: [f64; 3]| {
            worth_of_plane(
                [dot(&x, &x), dot(&y, &y), dot(&x, &y)],
                [dot(&x, &e), dot(&y, &e)],
            )
        };
        // The change of the innovations that takes them off: -(x + y) and -(x - y).
        assert!((worth([-1.0, -2.0, -1.0]) - 6.0).abs() < 1e-12);
        assert_eq!(worth([-1.0, 0.0, 1.0]), 0.0);
        assert_eq!(worth_of_plane([1.0, 1.0, 1.0], [-1.0, -1.0]), 0.0);
    }
}
