//! What a set of effects costs, and what one more must gain.

use crate::fit::catalogue::Part;
use crate::fit::context::{Context, Fit, freedom_of};
use crate::mask::Mask;
use crate::thresholds::{CHANCE, CHANCE_SD, NUMBER, THRESHOLDS};
use cellpos_plant::effects::{Action, Candidate};

/// Upper quantile of chi-square with `k` degrees of freedom at `z` standard normal deviations (Wilson-Hilferty).
fn chi2_quantile(k: f64, z: f64) -> f64 {
    let a = 2.0 / (9.0 * k);
    k * (1.0 - a + z * a.sqrt()).powi(3)
}

/// What an addition must gain to count: beyond chance over all variants, their starts and the scan of pixel sizes, and beyond the error of
/// the noise estimate.
pub(crate) fn threshold(freedom: usize) -> f64 {
    THRESHOLDS.addition_noise * chi2_quantile(freedom as f64, CHANCE_SD)
}

/// Least gain of a further response to the command over a set that explains `gained` by equations which may differ from nature's.
///
/// The difference is a response too, [`Thresholds::form_error`](crate::thresholds::Thresholds::form_error) times as large, and may look like
/// any of the catalogue's numbers: as many directions, all alike. Along each it adds `form_error^2 gained / numbers` to the variance of the
/// noise, which is 1; a gain counts in units of the sum.
pub(crate) fn least_gain(ctx: &Context<'_>, freedom: usize, gained: f64) -> f64 {
    let numbers: usize = (ctx.variants.iter())
        .map(|v| v.candidate().params.len())
        .sum();
    threshold(freedom) * (1.0 + along_a_number(numbers, gained))
}

/// Variance that an error of form adds to the noise along each of the catalogue's numbers.
fn along_a_number(numbers: usize, gained: f64) -> f64 {
    THRESHOLDS.form_error.powi(2) * gained.max(0.0) / numbers.max(1) as f64
}

/// Least gain of the best of this number of waves, each with its sine and cosine: the tail of chi-square with two degrees is
/// `exp(-x/2)`.
pub(crate) fn threshold_of_waves(tried: usize) -> f64 {
    THRESHOLDS.addition_noise * 2.0 * (tried as f64 / CHANCE).ln()
}

/// As [`threshold`], for a variant in a problem of this number of records.
pub(crate) fn threshold_of(v: &Candidate, records: usize) -> f64 {
    threshold(freedom_of(v, records))
}

/// Price of the amplitudes of a part's waves, which are free numbers as its parameters are.
pub(crate) fn price_of_waves(part: &Part, records: usize) -> f64 {
    NUMBER * (freedom_of(part.variant(), records) - part.variant().params.len()) as f64
}

/// Sum of squares with a price per parameter, so that a form with many numbers wins only if it is worth them.
pub(crate) fn penalised_cost(ctx: &Context<'_>, fit: &Fit) -> f64 {
    let left = surely_left(ctx, fit);
    let typical: f64 = fit.parts.iter().map(|p| prior_penalty(p, left)).sum();
    // Decides ties only: the localisation noise of a rig need not be that of its model.
    let white = ctx
        .white
        .map_or(0.0, |w| w.distance(&fit.parts, &ctx.scope).min(40.0));
    fit.chi2 + NUMBER * fit.freedom() as f64 + typical + white
}

/// Sum of squares beyond the noise.
pub(crate) fn left_over(fit: &Fit) -> f64 {
    (fit.chi2 - fit.count as f64).max(0.0)
}

/// Sum of squares beyond the noise by which model and records disagree without effects, the model's stated error included.
pub(crate) fn gap(null: &Fit) -> f64 {
    left_over(null) + null.absorbed
}

/// What is left over beyond the error of a measured floor: a misfit for certain.
pub(crate) fn surely_left(ctx: &Context<'_>, fit: &Fit) -> f64 {
    let noise = fit.count as f64 * (1.0 + ctx.floor_error).powi(2);
    (fit.chi2 - noise).max(0.0)
}

/// Sum of squares before the effects of a set that have a choice of equation. The set's delay and gain are already in it: each has
/// one equation, so it leaves no error of form that could be taken for another name.
pub(crate) fn before_forms(ctx: &Context<'_>, null: &Fit, fit: &Fit, mask: &Mask) -> f64 {
    let of_one_form =
        |p: &&Part| p.variant.is_gain() || matches!(p.effect(&ctx.scope).act(), Action::Delay(_));
    let exact: Vec<Part> = fit.parts.iter().filter(of_one_form).cloned().collect();
    let before = null.chi2 + null.absorbed;
    let alone = match exact.len() {
        0 => return before,
        n if n == fit.parts.len() => fit.chi2,
        _ => ctx.fit_from(exact, Some(fit.soft), mask, 8).chi2,
    };
    alone.min(before)
}

/// Scatter of a sum of squares over `n` rows: chance, and the error of the noise estimate.
pub(crate) fn scatter(n: f64) -> f64 {
    (2.0 * n + (0.012 * n).powi(2)).sqrt()
}

/// What a set must close to count as whole. Positions are known only within the noise where a pixel's error is steep: an error
/// periodic in position never closes altogether.
fn whole(fit: &Fit) -> f64 {
    if fit.position_parts().next().is_some() {
        THRESHOLDS.closed_least
    } else {
        THRESHOLDS.closed_whole
    }
}

/// Whether a set leaves more than chance, and more than equations leave that are not nature's to the last digit.
pub(crate) fn leaves_much(null: &Fit, fit: &Fit) -> bool {
    let left = left_over(fit);
    left > THRESHOLDS.left_sd * scatter(fit.count as f64) && left > (1.0 - whole(fit)) * gap(null)
}

/// A price for a main number outside the range that real rigs show: decides ties between names. A fit that leaves something over
/// (`left`) is wrong somewhere else, and by how much tells how little its last percent decides.
pub(crate) fn prior_penalty(part: &Part, left: f64) -> f64 {
    let beyond = beyond(part.variant().typical, part.natural()[0]).min(THRESHOLDS.untypical);
    beyond * (1.0 + THRESHOLDS.untypical_share / THRESHOLDS.untypical * left)
}

/// Price of a number beyond the end of a range, which is known to a tenth: minus twice the logarithm of the probability density,
/// relative to the end. A number a little beyond the end costs next to nothing.
fn beyond((low, high): (f64, f64), x: f64) -> f64 {
    const END_SD: f64 = 0.1;
    let past = match low {
        l if !l.is_finite() => return 0.0,
        l if l >= 0.0 => {
            let x = x.max(f64::MIN_POSITIVE);
            let below = if l > 0.0 { (l / x).ln() } else { 0.0 };
            (x / high).ln().max(below)
        }
        l => 2.0 * (x - l).max(high - x) / (high - l) - 2.0,
    };
    (past.max(0.0) / END_SD).powi(2)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_of_form_as_large_as_the_noise_along_each_number_doubles_the_least_gain() {
        // 6 % of a response of 400 numbers times (1 / 0.06)^2 is 400: one along each.
        let gained = 400.0 / THRESHOLDS.form_error.powi(2);
        assert!((along_a_number(400, gained) - 1.0).abs() < 1e-12);
        assert_eq!(along_a_number(400, -5.0), 0.0);
    }

    #[test]
    fn a_number_a_little_beyond_the_range_of_rigs_costs_a_little() {
        for (range, end, far) in [
            ((0.0, 0.06), 0.06, 0.06 * f64::exp(0.3)),
            ((0.01, 1.0), 1.0, f64::exp(0.3)),
            ((0.01, 1.0), 0.01, 0.01 * f64::exp(-0.3)),
            ((-1.0, 3.0), -1.0, -1.6),
            ((-1.0, 3.0), 3.0, 3.6),
        ] {
            assert_eq!(beyond(range, end), 0.0, "{range:?}");
            assert!(beyond(range, end + 0.01 * (far - end)) < 0.01, "{range:?}");
            assert!((beyond(range, far) - 9.0).abs() < 1e-6, "{range:?}");
        }
        assert_eq!(beyond((f64::NEG_INFINITY, f64::INFINITY), 1e9), 0.0);
    }
}
