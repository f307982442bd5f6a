//! The base model of a plant that is not this rig's: fitted to records in time, written as a model file, said in words.

use super::form::richer;
use cellpos_ident::base::{BaseFit, Form, Series, choose};
use cellpos_ident::rational::RationalFit;
use cellpos_ident::sampled::Hold;
use cellpos_numeric::statistics::Z95;
use cellpos_plant::{Model, Noise, TransferFunction, effects};
use cellpos_report::{number, with_interval};
use cellpos_session::Failure;
use serde_json::{Value, json};
use std::collections::BTreeMap;

/// Provenance of a model of other data: how its input was sampled.
pub const HOLD: &str = "hold";
/// Provenance: its form.
const FORM: &str = "base";
/// Provenance: the output while the input rests.
pub const REST_OUTPUT: &str = "rest_output";

/// Marks of the inputs that a base was fitted to.
const RECORDS: &str = "records";

/// A mark by which a record's input is known again.
fn mark(input: &[f64]) -> String {
    // FNV-1a over the bits.
    let bytes = input.iter().flat_map(|v| v.to_bits().to_le_bytes());
    let hash = bytes.fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
    });
    format!("{hash:016x}")
}

/// Whether a model says that it was fitted to a record of this input.
pub fn was_fitted_to(model: &Model, input: &[f64]) -> bool {
    let marks = model.provenance.get(RECORDS);
    marks.is_some_and(|marks| marks.split(' ').any(|known| known == mark(input)))
}

fn hold_word(hold: Hold) -> &'static str {
    match hold {
        Hold::ZeroOrder => "zero-order",
        Hold::None => "none",
    }
}

/// The form that a model says it was fitted with.
pub fn form_of(model: &Model) -> Option<Form> {
    model.provenance.get(FORM)?.parse().ok()
}

/// A fitted base model and its messages.
pub struct Base {
    /// The fit.
    pub fit: BaseFit,
    /// What the input does between rows.
    pub hold: Hold,
    /// What a user should know before using it.
    pub advice: Vec<String>,
    marks: String,
    mean_input: f64,
    range: (f64, f64),
    mean_output: f64,
}

/// Fits a base model to records of one rate.
///
/// # Errors
/// Records that cannot be fitted.
pub fn fit(
    records: &[Series],
    rate_hz: f64,
    hold: Hold,
    asked: Option<Form>,
    most_order: usize,
) -> Result<Base, Failure> {
    let failed = |e: cellpos_ident::IdentError| {
        Failure::bad_input(
            format!("no base model: {e}"),
            "check --input and --output, try a lower order in --base, or give longer records",
        )
    };
    let fits = choose(records, rate_hz, hold, asked, most_order).map_err(failed)?;
    let Some(fit) = fits.into_iter().next() else {
        return Err(Failure::bad_input(
            "no base model could be fitted",
            "try another order in --base",
        ));
    };
    let inputs = || records.iter().flat_map(|r| r.input.iter().copied());
    let outputs = records.iter().flat_map(|r| r.output.iter().copied());
    let mean = |values: &mut dyn Iterator<Item = f64>| {
        let (sum, count) = values
            .filter(|v| v.is_finite())
            .fold((0.0, 0usize), |(s, n), v| (s + v, n + 1));
        sum / count.max(1) as f64
    };
    let range = inputs().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| {
        (a.min(v), b.max(v))
    });
    let mut advice = Vec::new();
    if fit.at_bound {
        advice.push(
            "a pole is at the end of the range that these records determine: use a lower order or longer records"
                .to_owned(),
        );
    }
    if fit.residual_rms > 0.6 * fit.output_rms {
        advice.push(format!(
            "the model explains little: its free run is off by {} of {} RMS; are the columns swapped, does another input act, or is the plant nonlinear?",
            number(fit.residual_rms),
            number(fit.output_rms)
        ));
    }
    if let Some(form) = asked {
        advice.extend(too_poor(form, &fit, |richer| {
            choose(records, rate_hz, hold, Some(richer), richer.order)
        }));
    }
    let changes = inputs()
        .zip(inputs().skip(1))
        .filter(|(a, b)| a != b)
        .count();
    // Steps that last are held, whatever fits.
    if 2 * changes > inputs().count() {
        let other = match hold {
            Hold::ZeroOrder => Hold::None,
            Hold::None => Hold::ZeroOrder,
        };
        let twin = choose(records, rate_hz, other, Some(fit.form), fit.form.order);
        if let Ok(Some(twin)) = twin.map(|fits| fits.into_iter().next())
            && twin.residual_rms < 0.9 * fit.residual_rms
        {
            advice.push(format!(
                "the same form with --hold {} leaves {} instead of {}: use it if the input was {}",
                hold_word(other),
                number(twin.residual_rms),
                number(fit.residual_rms),
                match other {
                    Hold::None => "measured beside the output",
                    Hold::ZeroOrder => "a command that keeps its value until the next row",
                }
            ));
        }
    }
    let marks: Vec<String> = records.iter().map(|r| mark(&r.input)).collect();
    Ok(Base {
        marks: marks.join(" "),
        mean_input: mean(&mut inputs()),
        mean_output: mean(&mut { outputs }),
        range,
        fit,
        hold,
        advice,
    })
}

/// What is said of a stated form where one with a pole or a delay more predicts halves of the records far better.
fn too_poor(
    form: Form,
    fit: &BaseFit,
    fits: impl Fn(Form) -> Result<Vec<BaseFit>, cellpos_ident::IdentError>,
) -> Option<String> {
    /// A form that is right predicts as well as one that has more: the rest is by so much worse.
    const FAR_BETTER: f64 = 0.8;
    let stated = fit.held_out_rms?;
    let better = richer(form).into_iter().filter_map(|richer| {
        let found = fits(richer).ok()?.into_iter().next()?;
        let held_out = found.held_out_rms.filter(|e| *e < FAR_BETTER * stated)?;
        (!found.at_bound).then_some((richer, held_out))
    });
    let (richer, held_out) = better.min_by(|a, b| a.1.total_cmp(&b.1))?;
    Some(format!(
        "the stated form {form} is too simple: {richer} predicts held-out halves of the records with an error of {} instead of {}; write --base {richer}, or leave the form out",
        number(held_out),
        number(stated)
    ))
}

/// The rate of records that are to be fitted together.
///
/// # Errors
/// Records of different rates.
pub fn common_rate(rates: impl Iterator<Item = f64>) -> Result<f64, Failure> {
    let rates: Vec<f64> = rates.collect();
    let first = rates.first().copied().unwrap_or(f64::NAN);
    match rates.iter().find(|rate| (*rate / first - 1.0).abs() > 1e-3) {
        None => Ok(first),
        Some(other) => Err(Failure::bad_input(
            format!("records of {first} and of {other} rows a second cannot be fitted together"),
            "give records of one rate, or one file at a time",
        )),
    }
}

impl Base {
    /// The model, from its input at rest.
    ///
    /// # Errors
    /// A model that no file can hold.
    pub fn model(&self) -> Result<Model, Failure> {
        let (low, high) = self.range;
        let span = high - low;
        let rest = self.fit.rest_input.filter(|rest| {
            // Extrapolated far beyond what was commanded it is no place to rest.
            (low - 0.5 * span..=high + 0.5 * span).contains(rest)
        });
        let at_rest = rest.unwrap_or(self.mean_input);
        let mut model = model_of(&self.fit.model, self.hold, at_rest)?;
        let mut say = |key: &str, value: String| {
            model.provenance.insert(key.to_owned(), value);
        };
        say(FORM, self.fit.form.to_string());
        say(RECORDS, self.marks.clone());
        if !self.fit.form.integrating {
            say(REST_OUTPUT, self.mean_output.to_string());
        }
        say(
            "verdict",
            format!(
                "free run off by {} RMS, output {} RMS about its mean",
                number(self.fit.residual_rms),
                number(self.fit.output_rms)
            ),
        );
        Ok(model)
    }

    /// Messages about it.
    pub fn words(&self) -> String {
        let m = &self.fit.model;
        let mut text = format!(
            "base model {}: num {}, den {}, {}\n  its free run is off by {} RMS; the output moves by {} RMS",
            self.fit.form,
            coefficients(&m.numerator, &m.numerator_sd),
            coefficients(&m.denominator, &m.denominator_sd),
            match self.fit.form.delay {
                true => format!(
                    "delay {} ms",
                    with_interval(m.delay_s * 1e3, 1e3 * Z95 * m.delay_sd_s)
                ),
                false => "no delay".to_owned(),
            },
            number(self.fit.residual_rms),
            number(self.fit.output_rms),
        );
        if let Some(held_out) = self.fit.held_out_rms {
            text += &format!(
                "; of halves predicted by a fit to the other halves it is off by {}",
                number(held_out)
            );
        }
        text.push('\n');
        for advice in &self.advice {
            text += &format!("  note: {advice}\n");
        }
        text
    }

    /// The same as JSON.
    pub fn to_json(&self) -> Value {
        let m = &self.fit.model;
        json!({
            "form": self.fit.form.to_string(), "order": m.order, "num": m.numerator, "num_sd": finite(&m.numerator_sd),
            "den": m.denominator, "den_sd": finite(&m.denominator_sd), "delay_ms": m.delay_s * 1e3,
            "delay_sd_ms": finite(&[m.delay_sd_s * 1e3])[0], "hold": hold_word(self.hold),
            "poles_rad_per_s": m.poles.iter().map(|p| [p.re, p.im]).collect::<Vec<_>>(),
            "output_rms": self.fit.output_rms, "residual_rms": self.fit.residual_rms, "held_out_rms": self.fit.held_out_rms,
            "at_bound": self.fit.at_bound, "advice": self.advice,
        })
    }
}

fn finite(values: &[f64]) -> Vec<Value> {
    let one = |v: &f64| if v.is_finite() { json!(v) } else { Value::Null };
    values.iter().map(one).collect()
}

/// Coefficients with their 95 % intervals.
pub fn coefficients(values: &[f64], sds: &[f64]) -> String {
    let terms: Vec<String> = values
        .iter()
        .zip(sds)
        .map(|(value, sd)| match *sd {
            0.0 => number(*value),
            sd => format!("{} +- {}", number(*value), number(Z95 * sd)),
        })
        .collect();
    format!("[{}]", terms.join(", "))
}

/// Says in a model with which form it was fitted.
pub fn say_form(model: &mut Model, form: Form) {
    model.provenance.insert(FORM.to_owned(), form.to_string());
}

/// A linear fit as a model. The delay is an effect; the sampling of the input is in the provenance, for the next command.
///
/// # Errors
/// A model that no file can hold.
pub fn model_of(best: &RationalFit, hold: Hold, at_rest: f64) -> Result<Model, Failure> {
    let plant = TransferFunction::new(best.numerator.clone(), best.denominator.clone())
        .map_err(Failure::failed)?;
    let delay_s = best.delay_s.max(0.0);
    let mut intervals = BTreeMap::new();
    if best.delay_sd_s.is_finite() && best.delay_sd_s > 0.0 && delay_s > 0.0 {
        let wide_s = Z95 * best.delay_sd_s;
        intervals.insert(
            "time-delay.delay_s".to_owned(),
            [best.delay_s - wide_s, best.delay_s + wide_s],
        );
    }
    let model = Model {
        name: "identified".to_owned(),
        description: format!("linear model of order {} from records", best.order),
        plant,
        working_point_um: at_rest,
        effects: Vec::new(),
        noise: Noise::NONE,
        // A delay that the record shows is not known to be the camera's.
        camera_delay_s: None,
        frame_age_s: None,
        covariance: None,
        intervals,
        provenance: BTreeMap::from([
            (
                "command".to_owned(),
                cellpos_session::provenance::command_text(),
            ),
            (
                "version".to_owned(),
                cellpos_session::provenance::VERSION_AND_COMMIT.to_owned(),
            ),
            (HOLD.to_owned(), hold_word(hold).to_owned()),
        ]),
    };
    if delay_s <= 0.0 {
        return Ok(model);
    }
    let delay = effects::time_delay(delay_s);
    delay.validate().map_err(Failure::input)?;
    Ok(model.with_effect(delay))
}
