//! The file of finished segments with which a stopped identification continues.

use cellpos_ident::experiment::{Plan, RecordedSegment};
use cellpos_session::Failure;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// What is kept.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Partial {
    /// One description per planned segment: a plan with any difference is a different experiment.
    plan: Vec<String>,
    segments: Vec<Kept>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Kept {
    index: usize,
    from: usize,
    #[serde(default)]
    age_s: Option<f64>,
    input_um: Vec<Option<f64>>,
    /// `null` if no frame showed the bead.
    output_um: Vec<Option<f64>>,
}

fn describe(plan: &Plan) -> Vec<String> {
    let segments = plan.segments.iter();
    segments
        .map(|s| format!("{} s, {s:?}", plan.period_s))
        .collect()
}

/// Writes the segments that are finished.
pub(super) fn save(path: &Path, plan: &Plan, records: &[RecordedSegment]) -> Result<(), Failure> {
    let partial = Partial {
        plan: describe(plan),
        segments: records
            .iter()
            .map(|r| Kept {
                index: r.index,
                from: r.from,
                age_s: r.age_s,
                input_um: known(&r.input),
                output_um: known(&r.output),
            })
            .collect(),
    };
    let text = serde_json::to_string(&partial).map_err(Failure::failed)?;
    cellpos_table::write_atomically(path, text.as_bytes()).map_err(Failure::failed)
}

/// Reads them back.
pub(super) fn load(path: &Path, plan: &Plan) -> Result<Vec<RecordedSegment>, Failure> {
    let refuse = |problem: String, help: &str| {
        Failure::bad_input(format!("{}: {problem}", path.display()), help)
    };
    let help = "give the file that the stopped identification named";
    let text = cellpos_table::read_text(path, cellpos_table::MOST_OF_A_RECORD)
        .map_err(|e| refuse(format!("cannot read: {e}"), help))?;
    let partial: Partial = serde_json::from_str(&text).map_err(|e| refuse(e.to_string(), help))?;
    if partial.plan != describe(plan) {
        return Err(refuse(
            "was made with other lines, amplitudes, times or another model".to_owned(),
            "repeat the arguments of the stopped identification, or start again without --resume",
        ));
    }
    let sound = |k: &Kept| {
        k.index < plan.segments.len()
            && k.input_um.len() == k.output_um.len()
            && k.from < k.input_um.len()
            && k.age_s.is_none_or(f64::is_finite)
            && k.input_um.iter().flatten().all(|u| u.is_finite())
    };
    if !partial.segments.iter().all(sound) {
        return Err(refuse("damaged".to_owned(), help));
    }
    Ok(partial
        .segments
        .into_iter()
        .map(|k| RecordedSegment {
            index: k.index,
            from: k.from,
            age_s: k.age_s,
            input: or_nan(k.input_um),
            output: or_nan(k.output_um),
        })
        .collect())
}

/// JSON has no NaN.
fn known(values: &[f64]) -> Vec<Option<f64>> {
    values.iter().map(|v| v.is_finite().then_some(*v)).collect()
}

fn or_nan(values: Vec<Option<f64>>) -> Vec<f64> {
    values.into_iter().map(|v| v.unwrap_or(f64::NAN)).collect()
}
