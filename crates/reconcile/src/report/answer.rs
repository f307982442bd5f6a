//! The answer of a report: what the model lacks, and how far the gap falls with it.

use super::{interval, small};
use crate::verdict::result::{Effect, Reconciliation, Verdict};
use cellpos_report::{Emphasis, Report};

/// An effect with its first numbers in one clause: "time-delay at the camera (95 %: delay_s = 0.0020 [0.0019, 0.0021] s)".
fn clause(e: &Effect) -> String {
    let numbers: Vec<String> = (e.parameters.iter())
        .map(|(name, v)| {
            let number = format!("{name} = {} {}", interval(v.value, v.ci95), v.unit);
            number.trim_end().to_owned()
        })
        .take(2)
        .collect();
    let or = match e.alternatives.is_empty() {
        true => String::new(),
        false => format!(", or {}", e.alternatives.join(" or ")),
    };
    let numbers = match numbers.is_empty() {
        true => String::new(),
        false => format!(" (95 %: {})", numbers.join(", ")),
    };
    format!("{} at the {}{numbers}{or}", e.id, e.place)
}

/// The answer in two sentences.
pub(super) fn answer(r: &mut Report, result: &Reconciliation) {
    let names: Vec<String> = result.effects.iter().map(clause).collect();
    let names = names.join("; ");
    let (status, text) = match result.verdict {
        Verdict::Named => (Emphasis::Good, format!("The model lacks {names}.")),
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
                "The prediction error on held-out records is {before}; the noise floor is {floor}."
            )
        }
        Verdict::Unknown => format!(
            "The prediction error on held-out records is {before}, and {after} with the best of the catalogue; the noise floor is {floor}."
        ),
        // Frames that are missing or repeated make no error of prediction.
        _ if g.after >= g.before => {
            format!(
                "The prediction error on held-out records stays {after}; the noise floor is {floor}."
            )
        }
        _ => format!(
            "With that the prediction error on held-out records falls from {before} to {after}; the noise floor is {floor}."
        ),
    };
    r.result(status, &format!("{text} {text_of_gap}"));
}
