//! Whether the numbers of a set are those of one equation: fitted to parts of the records, they must agree.

use crate::fit::context::{Context, Fit};
use crate::mask::Mask;
use crate::search::cost::{threshold, threshold_of};
use crate::thresholds::{CHANCE_SD, THRESHOLDS};
use crate::units::figure;
use crate::verdict::parameters::{numeric_error, told};
use cellpos_plant::effects::Role;

/// A set of rows, with its name for messages.
type Group = (String, Mask);

/// Halves of the time, and records one by one.
fn groupings(ctx: &Context<'_>) -> Vec<Vec<Group>> {
    let moving = moving(ctx);
    let mut all = vec![halves(ctx)];
    if moving.len() > 1 {
        all.push(moving);
    }
    all
}

/// The two halves of the time.
fn halves(ctx: &Context<'_>) -> Vec<Group> {
    let records = &ctx.problem.records;
    [
        ("the first half of the time", 0),
        ("the second half of the time", 1),
    ]
    .iter()
    .map(|(name, half)| {
        let mask = records
            .iter()
            .map(|r| {
                let n = r.u.len();
                std::iter::once(half * n / 2..(half + 1) * n / 2).collect()
            })
            .collect();
        ((*name).to_owned(), mask)
    })
    .collect()
}

/// Records whose command moves, one by one.
fn moving(ctx: &Context<'_>) -> Vec<Group> {
    let records = &ctx.problem.records;
    (0..records.len())
        .filter(|&i| !records[i].rest)
        .map(|i| {
            let mut mask = vec![Vec::new(); records.len()];
            mask[i] = std::iter::once(0..records[i].u.len()).collect();
            (records[i].name.clone(), mask)
        })
        .collect()
}

/// Scatter of a set's numbers between the records, over the scatter that their uncertainties predict, at least 1: the Birge ratio
/// (Birge 1932, Phys. Rev. 40:207) of each number of each part. An equation that is not quite the rig's gets another number from
/// each excitation. So the number is less sure than the curvature of the joint fit says. A single record is compared between its
/// halves: a record that is cut in two gives the same.
pub(crate) fn birge(ctx: &Context<'_>, fit: &Fit, threads: usize) -> Vec<f64> {
    let numbers: usize = fit.parts.iter().map(|p| p.theta.len()).sum();
    let mut groups = moving(ctx);
    if groups.len() < 2 {
        groups = halves(ctx);
    }
    let fits =
        cellpos_numeric::parallel::map(&groups, threads, |(_, mask)| ctx.refit(fit, mask, 6));
    let mut ratios = Vec::with_capacity(numbers);
    let mut at = 0;
    for (i, part) in fit.parts.iter().enumerate() {
        for (j, p) in part.variant().params.iter().enumerate() {
            let numeric = numeric_error(p, part.theta[j]);
            // A record that leaves a number anywhere in its range does not know it, and agrees with nothing.
            let range = p.coordinate(p.upper) - p.coordinate(p.lower);
            let (mut weights, mut sum, mut squares, mut told) = (0.0, 0.0, 0.0, 0usize);
            for own in &fits {
                let variance = own.covariance[(at + j, at + j)].max(0.0);
                if variance >= range * range {
                    continue;
                }
                let moved = own.parts[i].theta[j] - part.theta[j];
                let weight = 1.0 / (variance + numeric * numeric).max(1e-24);
                weights += weight;
                sum += weight * moved;
                squares += weight * moved * moved;
                told += 1;
            }
            if told < 2 {
                ratios.push(1.0);
                continue;
            }
            let spread = squares - sum * sum / weights;
            let ratio = (spread / (told - 1) as f64).max(1.0).sqrt();
            ratios.push(ratio.min(THRESHOLDS.birge_most));
        }
        at += part.theta.len();
    }
    ratios
}

/// The part that is least beyond chance, if it is not beyond it at all: where its size scatters between parts of the records by more than
/// the noise, an addition must gain as much more.
pub(crate) fn scattered(ctx: &Context<'_>, fit: &Fit, threads: usize) -> Option<usize> {
    let ratios = birge(ctx, fit, threads);
    let (all, records) = (ctx.problem.all(), ctx.problem.records.len());
    let short_of = |i: usize| {
        let (ratio, variant) = (ratios[fit.numbers_before(i)], fit.parts[i].variant());
        // The search has seen to a part that does not scatter.
        if ratio <= 1.0 || variant.role != Role::Chain {
            return f64::INFINITY;
        }
        let gain = ctx.fit_without(fit, i, &all, 8).chi2 - fit.chi2;
        gain / (ratio * ratio) / threshold_of(variant, records)
    };
    let worst = (0..fit.parts.len()).map(|i| (i, short_of(i)));
    let (i, share) = worst.min_by(|a, b| a.1.total_cmp(&b.1))?;
    (share < 1.0).then_some(i)
}

/// A number that is not the same in all parts of the records.
pub(crate) struct Disagreement {
    /// It is the first of its effect, that says how large it is; another says how it is shaped.
    pub of_size: bool,
    pub words: String,
}

/// What does not agree between parts of the records, sizes before shapes; `None` where everything does.
pub(crate) fn disagreement(
    ctx: &Context<'_>,
    null: &Fit,
    fit: &Fit,
    threads: usize,
) -> Option<Disagreement> {
    let numbers: usize = fit.parts.iter().map(|p| p.theta.len()).sum();
    if numbers == 0 || fit.parts.iter().all(|p| p.variant().role != Role::Chain) {
        return None;
    }
    let gained = (null.chi2 - fit.chi2).max(0.0);
    let mut of_shape = None;
    for groups in groupings(ctx) {
        let fits = cellpos_numeric::parallel::map(&groups, threads, |(_, mask)| {
            (fit.chi2_on(mask), ctx.refit(fit, mask, 6))
        });
        let freedom = (numbers + 1) * (groups.len() - 1);
        let better: f64 = fits
            .iter()
            .map(|(joint, own)| (joint - own.chi2).max(0.0))
            .sum();
        let enough = threshold(freedom.max(1)).max(THRESHOLDS.term_share * gained);
        if better < enough {
            continue;
        }
        // The number that moves most beyond its own uncertainty, in the group that asks for it.
        let mut worst: Option<(bool, f64, String)> = None;
        for ((name, _), (joint, own)) in groups.iter().zip(&fits) {
            if joint - own.chi2 < 0.5 * better / groups.len() as f64 {
                continue;
            }
            let mut at = 0;
            for (a, b) in fit.parts.iter().zip(&own.parts) {
                let (va, vb) = (a.natural(), b.natural());
                for (j, p) in a.variant().params.iter().enumerate() {
                    let sd = own.covariance[(at + j, at + j)].max(0.0).sqrt();
                    let moved = (b.theta[j] - a.theta[j]).abs();
                    let size = (va[j].abs().max(vb[j].abs())).max(1e-300);
                    let share = (va[j] - vb[j]).abs() / size;
                    // The weights of a sum are its size together.
                    let of_size = j == 0 || p.name == "weights";
                    if a.variant().role == Role::Chain
                        && moved > CHANCE_SD * sd
                        && share > THRESHOLDS.split_share
                        && worst.as_ref().is_none_or(|w| (of_size, share) > (w.0, w.1))
                    {
                        worst = Some((
                            of_size,
                            share,
                            format!(
                                "{} of {} is {} in {name} and {} over all: another equation",
                                p.name,
                                a.id(),
                                figure(told(ctx, a, p.name, vb[j]).value),
                                figure(told(ctx, a, p.name, va[j]).value)
                            ),
                        ));
                    }
                }
                at += a.theta.len();
            }
        }
        if let Some((of_size, _, words)) = worst {
            let found = Disagreement { of_size, words };
            if of_size {
                return Some(found);
            }
            of_shape.get_or_insert(found);
        }
    }
    of_shape
}
