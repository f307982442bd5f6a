//! Quality of each parameter: intervals by covariance and by bootstrap, and a verdict.
//!
//! Every parameter gets an interval and a verdict. A parameter is identified if the chosen order contains it and its 95 % interval is
//! narrower than half the value on either side. Slow pole and far zero are judged on the profile of the fit, because a delay may trade
//! against the far zero. Not for choosing a model: [`crate::order_selection`].

use nalgebra::Complex;

pub use crate::bootstrap::bootstrap;
use crate::candidate_model::CandidateModel;
use crate::delay::apart_s;
use crate::delay_parameters::{delay_parameter, far_zero_parameter, slow_pole_parameter};
use crate::identified_parameter::WIDEST_RELATIVE;
pub use crate::identified_parameter::{Identifiability, IdentifiedParameter};
use crate::order_selection::{
    CandidateFits, CandidateOrder, DelayPrior, OrderSelection, index, model_of,
};
use cellpos_numeric::statistics::{Z95, quantile, student_t_quantile};

/// The parameters of a fit of candidate orders with verdicts, and the model to use.
#[derive(Debug, Clone, PartialEq)]
pub struct Judged {
    /// One entry per parameter of Eq. (4) with delay.
    pub parameters: Vec<IdentifiedParameter>,
    /// The chosen model, with the delay of the prior if there is one.
    pub model: CandidateModel,
    /// Interval of the delay from the phase slope alone, far zero included (upper end infinite where unbounded), s.
    pub phase_delay95_s: [f64; 2],
    /// Best delay from the phase slope alone, s: the smallest far-zero lead that the data allow.
    pub phase_delay_s: f64,
    /// Contradiction between the delay measured otherwise and the phase slope, s. The model then uses the record's own delay, which is
    /// the one that acts in the loop.
    pub contradiction_s: Option<f64>,
}

impl Judged {
    /// The parameter called `name`.
    pub fn parameter(&self, name: &str) -> Option<&IdentifiedParameter> {
        self.parameters.iter().find(|p| p.name == name)
    }
}

/// 95 % threshold of a profile's rise, chi-squared with one degree of freedom.
const PROFILE_RISE: f64 = 3.841;

/// Factor from a 95 % to a 99.9 % interval: two 95 % intervals fail to overlap by chance in a few runs of a hundred.
const SURE: f64 = 3.29 / Z95;

/// Rise of chi-squared between the middles of two 99.9 % intervals that touch: a delay measured otherwise costs a fit no more.
const MOST_APART: f64 = (2.0 * 3.29) * (2.0 * 3.29);

/// Error that neither LED test nor phase slope covers, s: half of the converter's update step of 0.1 ms. The edges of the LED fall
/// anywhere in a step; the commands of a loop come at one place in it, which changes with the machine's load.
pub const NOT_ACCOUNTED_S: f64 = 5e-5;

/// Profile interval of the far zero's lead, ms, searched in 0..`LEAD_MOST_MS` sampling periods.
fn lead_interval_ms(
    problem: &OrderSelection<'_>,
    fit: &CandidateFits,
    data: &[Complex<f64>],
    period_ms: f64,
) -> Option<[f64; 2]> {
    let far = fit
        .candidates
        .iter()
        .find(|r| r.order == CandidateOrder::FarZero)?;
    // Without the weak bound on the lead: the data alone must limit it.
    let bound = |lead_ms: f64| (lead_ms / (0.3 * period_ms)).powi(2);
    let chi2_at = |lead_ms: f64| -> f64 {
        [0.0, 0.08, -0.08]
            .iter()
            .map(|shift| {
                let mut start = far.parameters.clone();
                start[index::EFFECTIVE_DELAY_MS] += shift * period_ms;
                problem
                    .fit_from(
                        data,
                        CandidateOrder::FarZero,
                        &start,
                        Some((index::FAR_LEAD_MS, lead_ms)),
                    )
                    .chi2
            })
            .fold(f64::INFINITY, f64::min)
            - bound(lead_ms)
    };
    let grid: Vec<f64> = [
        0.0, 0.01, 0.02, 0.035, 0.05, 0.075, 0.1, 0.15, 0.2, 0.3, 0.5, 0.8, 1.2, 2.0,
    ]
    .iter()
    .map(|g| g * period_ms)
    .collect();
    let costs: Vec<f64> = grid.iter().map(|&g| chi2_at(g)).collect();
    let own = far.parameters[index::FAR_LEAD_MS];
    let at_own = if (0.0..=2.0 * period_ms).contains(&own) {
        chi2_at(own)
    } else {
        f64::INFINITY
    };
    let best = costs.iter().copied().fold(at_own, f64::min);
    let limit = best + PROFILE_RISE * fit.scale;
    let inside = |c: f64| c <= limit;
    let edge = |mut out: f64, mut within: f64| {
        for _ in 0..12 {
            let mid = 0.5 * (out + within);
            if inside(chi2_at(mid)) {
                within = mid;
            } else {
                out = mid;
            }
        }
        within
    };
    let first = costs.iter().position(|&c| inside(c));
    let last = costs.iter().rposition(|&c| inside(c));
    let low = match first {
        Some(0) => 0.0,
        Some(i) => edge(grid[i - 1], grid[i]),
        None => 0.0,
    };
    let high = match last {
        Some(i) if i + 1 == grid.len() => f64::INFINITY,
        Some(i) => edge(grid[i + 1], grid[i]),
        None => f64::INFINITY,
    };
    Some([low, high])
}

fn log_interval(value: f64, sd_log: f64, t: f64) -> [f64; 2] {
    [value * (-t * sd_log).exp(), value * (t * sd_log).exp()]
}

fn judge_width(value: f64, interval: [f64; 2], why_not: &str) -> Identifiability {
    let widest = (interval[1] - value).abs().max((value - interval[0]).abs());
    if widest.is_finite() && widest < WIDEST_RELATIVE * value.abs() {
        Identifiability::Identified
    } else {
        Identifiability::NotIdentifiable {
            reason: why_not.to_owned(),
        }
    }
}

/// The bootstrap's interval of a function of the parameters, if enough replicates were fitted.
type Drawn<'a> = dyn Fn(&dyn Fn(&[f64]) -> f64) -> Option<[f64; 2]> + 'a;

/// Judges candidates that were fitted without a delay prior; `prior` then enters the resulting model.
///
/// `replicates` bootstrap fits (0: none) resample the blocks of every line with replacement; see [`bootstrap`].
pub fn judge(
    problem: &OrderSelection<'_>,
    fit: &CandidateFits,
    prior: Option<DelayPrior>,
    replicates: usize,
    seed: u64,
) -> Judged {
    let data = problem.data();
    let best = fit.best();
    let t = student_t_quantile(0.975, fit.interval_dof.min(1e6));
    let period_ms = problem.sampling().period_s * 1e3;
    let draws = bootstrap(problem, fit, replicates, seed);
    // Replicates know the noise exactly, the data only estimate it: the spread is widened as Student's t is.
    let wider = t / 1.959_964;
    let drawn = |f: &dyn Fn(&[f64]) -> f64| -> Option<[f64; 2]> {
        (draws.len() >= 40).then(|| {
            let values: Vec<f64> = draws.iter().map(|x| f(x)).collect();
            let value = f(&best.parameters);
            // A new draw is below the k-th of n in k of n + 1 cases.
            let n = values.len() as f64;
            [0.025, 0.975].map(|share| {
                let place = ((n + 1.0) * share - 1.0) / (n - 1.0);
                value + wider * (quantile(&values, place) - value)
            })
        })
    };
    let sd = |i: usize| best.covariance[(i, i)].sqrt();
    let mut parameters = Vec::new();

    let gain = best.parameters[index::LN_GAIN].exp();
    let gain95 = log_interval(gain, sd(index::LN_GAIN), t);
    parameters.push(IdentifiedParameter {
        name: "gain_per_s",
        meaning: "integrator gain K: bead speed per PZT displacement",
        unit: "1/s",
        value: gain,
        ci95: gain95,
        bootstrap95: drawn(&|x| x[index::LN_GAIN].exp()),
        verdict: judge_width(
            gain,
            gain95,
            "the gain's interval is wider than half its value: excite more strongly or longer",
        ),
    });
    parameters.extend(pair_parameters(fit, t, &drawn));

    let effective = best.parameters[index::EFFECTIVE_DELAY_MS];
    let half = t * sd(index::EFFECTIVE_DELAY_MS);
    parameters.push(IdentifiedParameter {
        name: "effective_delay_ms",
        meaning: "delay less the far zero's lead: what the phase slope determines",
        unit: "ms",
        value: effective,
        ci95: [effective - half, effective + half],
        bootstrap95: drawn(&|x| x[index::EFFECTIVE_DELAY_MS]),
        // A delay may be near zero: its scale is the sampling period, not its own value.
        verdict: if half < 0.25 * period_ms {
            Identifiability::Identified
        } else {
            Identifiability::NotIdentifiable {
                reason: "the phase slope is too uncertain: excite higher frequencies".to_owned(),
            }
        },
    });

    let two_lags = best.order.two_lags();
    // A plant with two lags has no far zero that could trade against the delay.
    let lead = if two_lags {
        [0.0; 2]
    } else {
        lead_interval_ms(problem, fit, &data, period_ms).unwrap_or([0.0, f64::INFINITY])
    };
    let phase_low = effective + lead[0] - half;
    let phase_high = effective + lead[1] + half;
    let phase95_s = [phase_low * 1e-3, phase_high * 1e-3];
    let contradiction_s = prior.and_then(|p| contradiction_s(fit, p, effective, half, lead));
    let agreed = prior.filter(|_| contradiction_s.is_none());
    let model = with_prior(problem, fit, agreed);
    let mut delay = delay_parameter(&model, agreed, effective, half, lead, period_ms);
    if let (Some(gap_s), Some(prior)) = (contradiction_s, prior) {
        contradicted(&mut delay, prior, [phase_low, phase_high], gap_s);
    }
    parameters.push(delay);
    if !two_lags {
        parameters.push(far_zero_parameter(
            fit, &model, agreed, lead, half, period_ms,
        ));
    }
    if let Some(full) = fit
        .candidates
        .iter()
        .find(|r| r.order == CandidateOrder::Eq4 && !two_lags)
    {
        parameters.push(slow_pole_parameter(
            full.parameters[index::SLOW_POLE],
            full.covariance[(index::SLOW_POLE, index::SLOW_POLE)].sqrt() * t,
            best.order,
        ));
    }
    Judged {
        parameters,
        model,
        phase_delay95_s: phase95_s,
        contradiction_s,
        phase_delay_s: (effective + lead[0]) * 1e-3,
    }
}

/// Significant contradiction between a delay measured otherwise and the phase slope, s: the gap between their 95 % intervals, if their
/// 99.9 % intervals do not touch either. Delays in ms: effective, half of its interval, the far zero's lead.
fn contradiction_s(
    fit: &CandidateFits,
    prior: DelayPrior,
    effective: f64,
    half: f64,
    lead: [f64; 2],
) -> Option<f64> {
    let far = fit
        .candidates
        .iter()
        .find(|r| r.order == CandidateOrder::FarZero);
    let own = far.map_or(lead[0], |r| r.parameters[index::FAR_LEAD_MS]);
    let own = own.clamp(lead[0], lead[1]);
    let phase = |times: f64| {
        [
            own - times * (own - lead[0] + half),
            own + times * (lead[1] - own + half),
        ]
        .map(|lead| (effective + lead) * 1e-3)
    };
    let given = |times: f64| [-1.0, 1.0].map(|side| prior.delay_s + side * times * prior.half95_s);
    let tolerated_s = prior.not_accounted_s.max(NOT_ACCOUNTED_S);
    apart_s(given(SURE), phase(SURE), tolerated_s)?;
    apart_s(given(1.0), phase(1.0), tolerated_s)
}

/// A delay whose two measurements contradict each other by `gap_s`: its interval holds both, and it is not identified.
fn contradicted(
    delay: &mut IdentifiedParameter,
    prior: DelayPrior,
    phase_ms: [f64; 2],
    gap_s: f64,
) {
    let given_ms = prior.delay_s * 1e3;
    delay.ci95 = [delay.ci95[0].min(given_ms), delay.ci95[1].max(given_ms)];
    delay.verdict = Identifiability::NotIdentifiable {
        reason: format!(
            "the LED test says {given_ms:.2} ms, the phase slope {:.2} to {:.2} ms: {:.0} degrees at 200 Hz apart; measure both again on an \
             idle machine",
            phase_ms[0],
            phase_ms[1],
            360.0 * 200.0 * gap_s
        ),
    };
}

/// Zero and pole of the pair, if a fit has them.
fn pair_parameters(fit: &CandidateFits, t: f64, drawn: &Drawn) -> Vec<IdentifiedParameter> {
    let best = fit.best();
    let pole = (
        "pair_pole_rad_per_s",
        "pole of the pole-zero pair",
        index::LN_POLE,
    );
    let zero = |i| ("pair_zero_rad_per_s", "zero of the pole-zero pair", i);
    let second = (
        "second_pole_rad_per_s",
        "pole of a second lag, such as a tube that stretches",
        index::LN_SECOND_POLE,
    );
    let wanted = match best.order {
        CandidateOrder::TwoLags => vec![pole, second],
        CandidateOrder::TwoLagsZero => vec![zero(index::LN_ZERO_OF_LAGS), pole, second],
        _ => vec![zero(index::LN_ZERO), pole],
    };
    let mut found = Vec::new();
    for (name, meaning, i) in wanted {
        let source = if best.order >= CandidateOrder::PoleZeroPair {
            Some(best)
        } else {
            fit.candidates
                .iter()
                .find(|r| r.order == CandidateOrder::PoleZeroPair)
        };
        let Some(source) = source else { continue };
        let value = source.parameters[i].exp();
        let ci95 = log_interval(value, source.covariance[(i, i)].sqrt(), t);
        let chosen = best.order >= CandidateOrder::PoleZeroPair;
        found.push(IdentifiedParameter {
            name,
            meaning,
            unit: "rad/s",
            value,
            ci95,
            bootstrap95: if chosen { drawn(&|x| x[i].exp()) } else { None },
            verdict: if chosen {
                judge_width(
                    value,
                    ci95,
                    "the pair is seen, but not its frequency: excite more frequencies around it",
                )
            } else {
                Identifiability::NotIdentifiable {
                    reason: "the data do not need a pole-zero pair".to_owned(),
                }
            },
        });
    }
    found
}

/// Fits the chosen order again with the delay measured otherwise; the far zero is free to account for the difference.
fn with_prior(
    problem: &OrderSelection<'_>,
    fit: &CandidateFits,
    prior: Option<DelayPrior>,
) -> CandidateModel {
    let best = fit.best();
    let Some(prior) = prior else {
        return best.model;
    };
    let with = problem.clone().with_prior(Some(prior));
    let data = problem.data();
    let far = fit
        .candidates
        .iter()
        .find(|r| r.order == CandidateOrder::FarZero && !best.order.two_lags());
    let Some(far) = far else {
        let found = with.fit_from(&data, best.order, &best.parameters, None);
        return model_of(&found.parameters, best.order);
    };
    let order = best.order.max(CandidateOrder::FarZero);
    let source = if order == CandidateOrder::Eq4 {
        best
    } else {
        far
    };
    let found = [0.0, 0.05, 0.2]
        .iter()
        .map(|extra| {
            let mut start = source.parameters.clone();
            start[index::FAR_LEAD_MS] =
                prior.delay_s * 1e3 - start[index::EFFECTIVE_DELAY_MS] + extra;
            with.fit_from(&data, order, &start, None)
        })
        .min_by(|a, b| a.chi2.total_cmp(&b.chi2));
    // What fits worse by more than that found no minimum.
    let found = found.filter(|f| f.chi2 <= best.chi2 + MOST_APART * fit.scale);
    found.map_or(best.model, |f| model_of(&f.parameters, order))
}
