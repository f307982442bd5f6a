//! Which form: as it was asked for, or the simplest of those that predict halves of the records as well as any.

use super::design::Data;
use super::fit::{Found, descend, finished, most_delay, search};
use super::form::Form;
use super::{BaseFit, Series, checked};
use crate::error::IdentError;
use crate::sampled::Hold;

/// Rows that starts are tried on, and that the last fit sees.
const ROWS_TO_START: usize = 6_000;
const ROWS_TO_FIT: usize = 24_000;

/// By how much a richer form must predict better than a simpler one.
const LEAST_GAIN: f64 = 0.02;

const NO_FIT: IdentError = IdentError::NoFit {
    what: "a base model",
    reason: "no start led to a finite residual",
};

/// Fits base models to records of one plant, all together; the best first.
///
/// With `asked`, the model has that form (its zeros chosen where they are left open). Without, the order is chosen up to
/// `most_order`, with and without a pole at zero, with a delay where one helps, by how well a fit to the first halves of the records
/// runs freely through the last and the other way round: the simplest within 2 % of the best.
///
/// # Errors
/// [`IdentError::Lengths`], [`IdentError::OutOfRange`] (rate, an input that is constant), [`IdentError::TooShort`],
/// [`IdentError::NoFit`].
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
    let mut trials = Vec::new();
    let kinds: &[bool] = match asked {
        Some(form) if form.integrating => &[true],
        Some(_) => &[false],
        None => &[false, true],
    };
    let skipped = match asked {
        Some(form) if !form.delay => 2,
        _ => 0,
    };
    let few = Data::new(records, hold, ROWS_TO_START, skipped);
    let many = Data::new(records, hold, ROWS_TO_FIT, skipped);
    for &integrating in kinds {
        let delay = asked.is_none_or(|form| form.delay);
        let mut below: Vec<Option<Found>> = Vec::new();
        for order in usize::from(integrating)..=top {
            let form = Form {
                order,
                zeros: Some(order.saturating_sub(1)),
                delay,
                integrating,
            };
            if checked(records, rate_hz, form.parameters()).is_err() {
                break;
            }
            let found = search(&few, &form, &below);
            if let Some(found) = &found
                && asked.is_none_or(|asked| asked.order == order)
            {
                trials.extend(Trial::new(&many, form, &found.theta));
            }
            below.push(found);
        }
    }
    let mut best = simplest(&trials).ok_or(NO_FIT)?.clone();
    trials = variants(&many, &best, asked);
    best = simplest(&trials).unwrap_or(&best).clone();
    let mut fits: Vec<BaseFit> = Vec::new();
    for trial in std::iter::once(&best).chain(&trials) {
        if fits.iter().any(|fit| fit.form == trial.form) {
            continue;
        }
        let Some(mut fit) = finished(&many, &trial.form, &trial.found, rate_hz) else {
            continue;
        };
        fit.held_out_rms = Some(trial.held_out_rms);
        fits.push(fit);
    }
    if fits.is_empty() {
        return Err(NO_FIT);
    }
    Ok(fits)
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
    /// Fits to all rows, and to each half, which must predict the other.
    fn new(data: &Data, form: Form, start: &[f64]) -> Option<Self> {
        let longest = most_delay(data.longest);
        let found = descend(data, &form, start, longest)?;
        let (mut left, mut rows) = (0.0, 0);
        for last in [false, true] {
            let (seen, unseen) = (data.half(last), data.half(!last));
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

    /// Numbers of the form: a pole at zero is no number, and is preferred to one that is only near it.
    fn size(&self) -> usize {
        self.form.free_poles() + self.form.zeros.unwrap_or(0) + usize::from(self.form.delay)
    }
}

/// The simplest of those that predict within 2 % of the best, and stand at no bound where others do not.
fn simplest(trials: &[Trial]) -> Option<&Trial> {
    let free = trials.iter().any(|t| !t.at_bound);
    let eligible = || trials.iter().filter(move |t| !(free && t.at_bound));
    let best = eligible()
        .map(|t| t.held_out_rms)
        .fold(f64::INFINITY, f64::min);
    eligible()
        .filter(|t| t.held_out_rms <= best * (1.0 + LEAST_GAIN))
        .min_by(|a, b| {
            (a.size().cmp(&b.size())).then_with(|| a.held_out_rms.total_cmp(&b.held_out_rms))
        })
}

/// The chosen order with other zeros, and, where the form was left open, without a delay.
fn variants(data: &Data, best: &Trial, asked: Option<Form>) -> Vec<Trial> {
    let order = best.form.order;
    let zeros: Vec<usize> = match asked.and_then(|form| form.zeros) {
        Some(zeros) => vec![zeros],
        // A direct path of a plant of high order is seldom one.
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
