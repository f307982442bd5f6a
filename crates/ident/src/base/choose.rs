//! Chooses the form of a base model: the one requested, or the simplest that predicts unseen halves of the records as well as any other.

use super::design::Data;
use super::fit::{Found, descend, finished, most_delay, search};
use super::form::Form;
use super::types::{BaseFit, Series, checked};
use crate::error::IdentError;
use crate::rational::roots;
use crate::sampled::Hold;

/// Most rows on which starts are tried, and most rows of the final fit.
const ROWS_TO_START: usize = 3_000;
const ROWS_TO_FIT: usize = 12_000;

/// Each further number of a form must reduce the prediction error to this part of it.
const PER_NUMBER: f64 = 0.97;

/// If the slowest pole times the longest stretch is below this, the records cannot tell the pole from one at zero.
const AS_GOOD_AS_ZERO: f64 = 1.0;
/// If the product is above this, the pole is certainly not at zero.
const NEVER_ZERO: f64 = 30.0;

const NO_FIT: IdentError = IdentError::NoFit {
    what: "a base model",
    reason: "no start led to a finite residual",
};

/// Fits base models to all records of one plant together. The best comes first.
///
/// With `asked`, the model has that form (with chosen zeros if they are open). Otherwise it tries orders up to `most_order`, with and
/// without a pole at zero, and with a delay if one helps. It fits the first halves of the records, predicts the last halves by a free
/// run, and the other way round. Each further number must lower the prediction error by 3 %.
///
/// # Errors
/// [`IdentError::Lengths`], [`IdentError::OutOfRange`] (rate, constant input), [`IdentError::TooShort`], [`IdentError::NoFit`].
pub fn choose(
    records: &[Series],
    rate_hz: f64,
    hold: Hold,
    asked: Option<Form>,
    most_order: usize,
) -> Result<Vec<BaseFit>, IdentError> {
    let least = Form {
        order: 0,
        zeros: None,
        delay: false,
        integrating: false,
    };
    let form = asked.unwrap_or(least);
    checked(records, rate_hz, form.parameters())?;
    let most = most_order.min(super::form::MOST_ORDER);
    let top = asked.map_or(most, |form| form.order);
    let skipped = match asked {
        Some(form) if !form.delay => 2,
        _ => 0,
    };
    let few = Data::new(records, hold, ROWS_TO_START, skipped);
    let many = Data::new(records, hold, ROWS_TO_FIT, skipped);
    let enough = |form: &Form| checked(records, rate_hz, form.parameters()).is_ok();
    let chain = |integrating| orders(&few, &many, asked, top, integrating, &enough);
    let stable = match asked {
        Some(form) if form.integrating => Vec::new(),
        _ => chain(false),
    };
    let best_stable = simplest(&stable);
    let at_rest = best_stable.is_some_and(|t| t.slowest(&many) > NEVER_ZERO);
    let integrating = match asked {
        Some(form) if !form.integrating => Vec::new(),
        None if at_rest => Vec::new(),
        _ => chain(true),
    };
    let best = match (best_stable, simplest(&integrating)) {
        (Some(stable), Some(integrating)) => {
            // A ramp with an integrator follows anything slow, so that alone does not justify an integrator.
            let slow = stable.at_bound || stable.slowest(&many) < AS_GOOD_AS_ZERO;
            let factor = if slow { 1.05 } else { 0.7 };
            if integrating.held_out_rms < factor * stable.held_out_rms {
                integrating
            } else {
                stable
            }
        }
        (stable, integrating) => stable.or(integrating).ok_or(NO_FIT)?,
    };
    let mut left = variants(&many, best, asked);
    let mut fits: Vec<BaseFit> = Vec::new();
    while let Some(trial) = simplest(&left).cloned() {
        left.retain(|t| t.form != trial.form);
        let Some(mut fit) = finished(&many, &trial.form, &trial.found, rate_hz) else {
            continue;
        };
        fit.held_out_rms = Some(trial.held_out_rms);
        fits.push(fit);
    }
    // A form with a number that the records do not determine has one number too many.
    fits.sort_by_key(|fit| !fit.is_seen());
    if fits.is_empty() {
        return Err(NO_FIT);
    }
    Ok(fits)
}

/// The best form of each order, richest numerator first; ends when more poles do not help.
fn orders(
    few: &Data,
    many: &Data,
    asked: Option<Form>,
    top: usize,
    integrating: bool,
    enough: &dyn Fn(&Form) -> bool,
) -> Vec<Trial> {
    let mut below: Vec<Option<Found>> = Vec::new();
    let mut trials: Vec<Trial> = Vec::new();
    let (mut best, mut idle) = (f64::INFINITY, 0);
    for order in usize::from(integrating)..=top {
        let form = Form {
            order,
            zeros: Some(order.saturating_sub(1)),
            delay: asked.is_none_or(|form| form.delay),
            integrating,
        };
        if !enough(&form) {
            break;
        }
        let found = search(few, &form, &below);
        if let Some(found) = &found
            && asked.is_none_or(|asked| asked.order == order)
            && let Some(trial) = Trial::new(many, form, &found.theta)
        {
            idle = if trial.held_out_rms < 0.98 * best {
                0
            } else {
                idle + 1
            };
            best = best.min(trial.held_out_rms);
            trials.push(trial);
        }
        below.push(found);
        if idle >= 2 {
            break;
        }
    }
    trials
}

/// A form that was fitted and tested.
#[derive(Debug, Clone)]
struct Trial {
    form: Form,
    found: Found,
    held_out_rms: f64,
    at_bound: bool,
}

impl Trial {
    /// Fits all rows, then each half; each half must predict the other.
    fn new(data: &Data, form: Form, start: &[f64]) -> Option<Self> {
        let longest = most_delay(data.longest);
        let found = descend(data, &form, start, longest)?;
        let (mut left, mut rows) = (0.0, 0);
        let delay = found.theta.get(form.free_poles()).copied().unwrap_or(0.0);
        for last in [false, true] {
            let (seen, unseen) = (data.half(last, delay), data.half(!last, delay));
            let of_half = descend(&seen, &form, &found.theta, longest)?;
            let gains = seen.solve(&form, &of_half.theta, None)?.numerator;
            let predicted = unseen.solve(&form, &of_half.theta, Some(&gains))?;
            let scale = unseen.output_rms;
            left += predicted
                .residual
                .iter()
                .map(|e| (e * scale).powi(2))
                .sum::<f64>();
            rows += predicted.residual.len();
        }
        let held_out_rms = (left / rows.max(1) as f64).sqrt();
        held_out_rms.is_finite().then(|| Self {
            at_bound: data.at_bound(&form, &found.theta),
            form,
            found,
            held_out_rms,
        })
    }

    /// Slowest pole (rad per row) times the rows of the longest stretch; infinite for a static plant.
    fn slowest(&self, data: &Data) -> f64 {
        let poles = roots(&data.denominator(&self.form, &self.found.theta));
        let slowest = poles.iter().map(|p| p.norm()).fold(f64::INFINITY, f64::min);
        slowest * data.longest as f64
    }

    /// Free numbers of the form. A pole at zero is not one, so it is preferred to a pole near zero.
    fn size(&self) -> usize {
        self.form.free_poles() + self.form.zeros.unwrap_or(0) + usize::from(self.form.delay)
    }
}

/// The form with the smallest penalised prediction error. Forms without a parameter at its bound come first.
fn simplest(trials: &[Trial]) -> Option<&Trial> {
    let free = trials.iter().any(|t| !t.at_bound);
    let cost =
        |t: &Trial| t.held_out_rms.max(f64::MIN_POSITIVE).ln() - PER_NUMBER.ln() * t.size() as f64;
    trials
        .iter()
        .filter(|t| !(free && t.at_bound))
        .min_by(|a, b| cost(a).total_cmp(&cost(b)))
}

/// The chosen order with other numbers of zeros and, if no form was requested, without a delay.
fn variants(data: &Data, best: &Trial, asked: Option<Form>) -> Vec<Trial> {
    let order = best.form.order;
    let zeros: Vec<usize> = match asked.and_then(|form| form.zeros) {
        Some(zeros) => vec![zeros],
        // A direct path found in a plant of high order is rarely real.
        None => (0..=if order <= 2 { order } else { order - 1 }).collect(),
    };
    let delays: &[bool] = match asked {
        Some(form) if form.delay => &[true],
        Some(_) => &[false],
        None => &[false, true],
    };
    let mut out = Vec::new();
    for &zeros in &zeros {
        for &delay in delays {
            let form = Form {
                zeros: Some(zeros),
                delay,
                ..best.form
            };
            if form == best.form {
                out.push(best.clone());
                continue;
            }
            let poles = form.free_poles();
            let mut start = best.found.theta[..poles].to_vec();
            start.extend(delay.then(|| best.found.theta.get(poles).copied().unwrap_or(0.0)));
            out.extend(Trial::new(data, form, &start));
        }
    }
    out
}
