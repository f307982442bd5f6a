//! The parameters that trade against each other behind a hold: delay, far zero, and the slow pole below the band.

use crate::candidate_model::CandidateModel;
use crate::identified_parameter::{Identifiability, IdentifiedParameter, WIDEST_RELATIVE};
use crate::order_selection::{CandidateFits, CandidateOrder, DelayPrior};

pub(crate) fn delay_parameter(
    model: &CandidateModel,
    prior: Option<DelayPrior>,
    effective_ms: f64,
    half_ms: f64,
    lead_ms: [f64; 2],
    period_ms: f64,
) -> IdentifiedParameter {
    let meaning = "delay from the command to the middle of the exposure";
    match prior {
        Some(prior) => {
            let half = (prior.half95_s + prior.not_accounted_s) * 1e3;
            let value = model.delay_s * 1e3;
            IdentifiedParameter {
                name: "delay_ms",
                meaning,
                unit: "ms",
                value,
                ci95: [value - half, value + half],
                bootstrap95: None,
                verdict: Identifiability::Identified,
            }
        }
        None => {
            let (low, high) = (
                effective_ms + lead_ms[0] - half_ms,
                effective_ms + lead_ms[1] + half_ms,
            );
            let narrow = high - low < 0.25 * period_ms;
            IdentifiedParameter {
                name: "delay_ms",
                meaning,
                unit: "ms",
                value: effective_ms + lead_ms[0],
                ci95: [low, high],
                bootstrap95: None,
                verdict: if narrow {
                    Identifiability::Identified
                } else {
                    Identifiability::NotIdentifiable {
                        reason: "a far zero's lead trades against it behind a zero-order hold; the LED test tells them apart".to_owned(),
                    }
                },
            }
        }
    }
}

pub(crate) fn far_zero_parameter(
    fit: &CandidateFits,
    model: &CandidateModel,
    prior: Option<DelayPrior>,
    lead_ms: [f64; 2],
    half_ms: f64,
    period_ms: f64,
) -> IdentifiedParameter {
    let invert = |ms: f64| if ms > 0.0 { 1e3 / ms } else { f64::INFINITY };
    let middle = if lead_ms[1].is_finite() {
        0.5 * (lead_ms[0] + lead_ms[1])
    } else {
        lead_ms[0]
    };
    let width = 0.5 * (lead_ms[1] - lead_ms[0]);
    // A lead up to half a sampling period differs from a delay only in which row shows it.
    let identified = fit.best().order >= CandidateOrder::FarZero
        && lead_ms[1] < 0.5 * period_ms
        && width < WIDEST_RELATIVE * middle;
    // With a delay measured otherwise, lead and interval are the phase slope minus that delay.
    let shown_ms = match prior {
        Some(prior) if model.far_lead_s > 0.0 => {
            let (lead, half) = (model.far_lead_s * 1e3, half_ms.hypot(prior.half95_s * 1e3));
            [(lead - half).max(0.0), lead + half]
        }
        _ => lead_ms,
    };
    let ci95 = [
        if shown_ms[1].is_finite() {
            invert(shown_ms[1])
        } else {
            0.0
        },
        invert(shown_ms[0]),
    ];
    let value = if prior.is_some() && model.far_lead_s > 0.0 {
        1.0 / model.far_lead_s
    } else {
        invert(middle.max(1e-3 * period_ms))
    };
    let verdict = if identified {
        Identifiability::Identified
    } else {
        let mut reason = format!(
            "its lead trades against the delay: the record alone allows leads of {:.3} to {} ms",
            lead_ms[0],
            if lead_ms[1].is_finite() {
                format!("{:.3}", lead_ms[1])
            } else {
                "any number of".to_owned()
            }
        );
        if prior.is_some() {
            reason.push_str("; the value shown takes the LED test's delay as given");
        }
        Identifiability::NotIdentifiable { reason }
    };
    IdentifiedParameter {
        name: "far_zero_rad_per_s",
        meaning: "far zero of Eq. (4)",
        unit: "rad/s",
        value,
        ci95,
        bootstrap95: None,
        verdict,
    }
}

pub(crate) fn slow_pole_parameter(
    value: f64,
    half: f64,
    chosen: CandidateOrder,
) -> IdentifiedParameter {
    let identified = chosen == CandidateOrder::Eq4 && half < WIDEST_RELATIVE * value;
    let high = value + half;
    IdentifiedParameter {
        name: "slow_pole_rad_per_s",
        meaning: "slow pole of Eq. (4)",
        unit: "rad/s",
        value: value.max(0.0),
        ci95: [(value - half).max(0.0), high.max(0.0)],
        bootstrap95: None,
        verdict: if identified {
            Identifiability::Identified
        } else {
            Identifiability::NotIdentifiable {
                reason: format!(
                    "it is far below the lowest frequency; the data only show that it is below {:.2} rad/s",
                    high.max(0.0)
                ),
            }
        },
    }
}
