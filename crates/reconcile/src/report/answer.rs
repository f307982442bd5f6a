//! The answer of a report: the missing effects, and the fall of the gap with them.

use super::{digits, small};
use crate::verdict::result::{Effect, Interval, Reconciliation, Verdict};
use cellpos_report::{Emphasis, Report};

/// A parameter with its unit and interval: "delay = 2.0 ms (95 %: 1.9 to 2.1)".
fn number(name: &str, found: &Interval) -> String {
    // The unit is behind the number, not in the name.
    let suffix = match found.unit.as_str() {
        "s" => "_s",
        "um" => "_um",
        "um/s" => "_um_per_s",
        "rad/s" => "_rad_per_s",
        "1/s" => "_per_s",
        "1/um" => "_per_um",
        unit if unit.contains("units") => ["_per_um2", "_per_um", "_um_per_s", "_um"]
            .into_iter()
            .find(|suffix| name.ends_with(suffix))
            .unwrap_or(""),
        _ => "",
    };
    let name = name.strip_suffix(suffix).unwrap_or(name).replace('_', " ");
    let (factor, unit) = match found.unit.as_str() {
        "s" if found.value.abs() < 0.1 => (1e3, "ms"),
        unit => (1.0, unit),
    };
    let [value, low, high] = digits(factor * found.value, found.ci95.map(|end| factor * end));
    let unit = if unit.is_empty() {
        String::new()
    } else {
        format!(" {unit}")
    };
    format!("{name} = {value}{unit} (95 %: {low} to {high})")
}

/// An effect with its first numbers in one clause: "time-delay at the camera, delay = 2.0 ms (95 %: 1.9 to 2.1)".
fn clause(e: &Effect) -> String {
    /// An effect of more numbers is a curve: they say nothing one by one.
    const SAID: usize = 4;
    let numbers: String = match e.parameters.len() {
        0..=SAID => (e.parameters.iter())
            .take(2)
            .map(|(name, found)| format!(", {}", number(name, found)))
            .collect(),
        many => format!(" (a curve of {many} numbers, below)"),
    };
    let or = match e.alternatives.is_empty() {
        true => String::new(),
        false => format!(", or {}", e.alternatives.join(" or ")),
    };
    format!("{} at the {}{numbers}{or}", e.id, e.place)
}

/// The answer in two sentences.
pub(super) fn answer(r: &mut Report, result: &Reconciliation) {
    let names: Vec<String> = result.effects.iter().map(clause).collect();
    let names = names.join("; ");
    let (status, text) = match result.verdict {
        Verdict::Named => (Emphasis::Good, format!("The model lacks: {names}.")),
        Verdict::NamedWithRemainder => (
            Emphasis::Warning,
            format!("The model lacks {names}; and something more that the catalogue does not name."),
        ),
        Verdict::Ambiguous => (
            Emphasis::Warning,
            format!("The model lacks {names}; these records do not tell which."),
        ),
        Verdict::Unknown => (
            Emphasis::Bad,
            "The model lacks something: the gap is beyond the noise floor, and nothing in the catalogue closes enough of it."
                .to_owned(),
        ),
        Verdict::NothingMissing => (
            Emphasis::Good,
            match result.floor.is_known() {
                true => "Nothing is missing: the model is at the noise floor.",
                false => {
                    "Nothing is missing: what is left does not follow the command. No rest and no repeated command tells the noise floor."
                }
            }
            .to_owned(),
        ),
    };
    let g = &result.gap;
    let [before, after, floor] = [g.before, g.after, g.floor].map(|value| small(result, value));
    let text_of_gap = match result.verdict {
        Verdict::NothingMissing => {
            format!(
                "The prediction error on records that the fit had not seen is {before}; the noise floor is {floor}."
            )
        }
        Verdict::Unknown => format!(
            "The prediction error on records that the fit had not seen is {before}, and {after} with the best of the catalogue; the noise floor is {floor}."
        ),
        // Frames that are missing or repeated make no error of prediction.
        _ if g.after >= g.before => {
            format!(
                "The prediction error on records that the fit had not seen stays {after}; the noise floor is {floor}."
            )
        }
        _ => format!(
            "With that the prediction error on records that the fit had not seen falls from {before} to {after}; the noise floor is {floor}."
        ),
    };
    r.result(status, &format!("{text} {text_of_gap}"));
    r.certainty(&sure(result));
}

/// How sure the answer is.
fn sure(result: &Reconciliation) -> String {
    let least = result.effects.iter().map(|e| e.p_value).reduce(f64::max);
    let chance = least.map_or_else(String::new, |p| {
        let p = super::p_value(p);
        let p = match p.strip_prefix("< ") {
            Some(less) => format!("below {less}"),
            None => p,
        };
        format!("the probability that chance made what was found, in the whole search, is {p}. Intervals are those of the fit. ")
    });
    let floor = match result.floor.is_known() {
        true => format!("The noise floor is {}", result.floor.words()),
        false => "The noise floor is what the fit leaves, as no record tells it".to_owned(),
    };
    format!(
        "{chance}Prediction errors (RMS, one sample ahead) are of parts of the records that the fit had not seen. {floor}."
    )
}
