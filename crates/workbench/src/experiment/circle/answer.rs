//! What came out of a circle, in sentences.

use crate::experiment::circle::Circle;
use crate::experiment::circle::stage::{Stage, Tracked};
use crate::run_report::half95;
use cellpos_reconcile::{Reconciliation, Verdict};
use cellpos_report::Emphasis;
use cellpos_report::with_interval;

/// One of a stage's two runs.
pub(super) type OfStage = fn(&Stage) -> Option<&Tracked>;

pub(super) const RUNS: [(&str, OfStage); 2] = [
    ("holding", |s| s.hold.as_ref()),
    ("on the sine", |s| s.sine.as_ref()),
];

pub(super) fn rms(tracked: Option<&Tracked>) -> String {
    let Some(tracked) = tracked else {
        return "no loop".to_owned();
    };
    match tracked.rms_true_nm.or(tracked.rms_measured_nm) {
        Some(nm) if tracked.state == "running" => format!("{nm:.1} nm"),
        Some(nm) => format!("{nm:.1} nm, ended in {}", tracked.state),
        None => format!("ended in {}", tracked.state),
    }
}

/// RMS error of a run and half its 95 % interval, nm.
pub(super) fn error(tracked: &Tracked) -> Option<(f64, f64)> {
    let nm = tracked.rms_true_nm.or(tracked.rms_measured_nm)?;
    Some((nm, half95(&tracked.pieces_nm2) / (2.0 * nm)))
}

/// For example `named: driver-lag + time-delay`.
pub(super) fn verdict_and_names(circle: &Circle) -> String {
    let Reconciliation {
        verdict, effects, ..
    } = &circle.reconciled;
    let names: Vec<&str> = effects.iter().map(|e| e.id.as_str()).collect();
    format!("{}: {}", verdict.word(), names.join(" + "))
}

/// The verdict in a sentence.
fn lacks(circle: &Circle) -> String {
    let names: Vec<&str> = (circle.reconciled.effects.iter())
        .map(|effect| effect.id.as_str())
        .collect();
    let names = names.join(" and ");
    match circle.reconciled.verdict {
        Verdict::Named => format!("What the model lacked was found: {names}."),
        Verdict::NamedWithRemainder => {
            format!(
                "What the model lacked was found in part: {names}, and something without a name."
            )
        }
        Verdict::Ambiguous => format!("The model lacks {names}; these records do not tell which."),
        Verdict::Unknown => "The model lacks something that no known effect explains.".to_owned(),
        Verdict::NothingMissing => "The model lacked nothing.".to_owned(),
    }
}

/// A delay and its 95 % interval, ms.
struct Delay {
    ms: f64,
    ci95: [f64; 2],
}

/// The delay of the loop as identified and as reconciled, both from the middle of an exposure to the tick that uses it.
fn delays(circle: &Circle) -> Option<[Delay; 2]> {
    let judged = &circle.identified.result.judged;
    let identified = judged.parameter("effective_delay_ms")?;
    let added = (circle.reconciled.effects.iter())
        .find(|effect| effect.id == "time-delay")?
        .parameters
        .get("delay_s")?;
    let stage = circle.stages.last()?;
    // Half the exposure comes on top of what was added.
    let rest_ms = stage.delay_ms - 1e3 * added.value;
    let identified = Delay {
        ms: identified.value,
        ci95: identified.ci95,
    };
    let reconciled = Delay {
        ms: stage.delay_ms,
        ci95: added.ci95.map(|s| 1e3 * s + rest_ms),
    };
    Some([identified, reconciled])
}

/// Whether the intervals of the two delays exclude each other.
pub(super) fn delays_differ(circle: &Circle) -> bool {
    delays(circle).is_some_and(|[a, b]| a.ci95[1] < b.ci95[0] || b.ci95[1] < a.ci95[0])
}

fn delays_text(circle: &Circle) -> Option<String> {
    let [identified, reconciled] = delays(circle)?.map(
        |Delay {
             ms,
             ci95: [from, to],
         }| {
            (
                format!("{ms:.3} ms"),
                format!("(95 %: {from:.3} to {to:.3})"),
            )
        },
    );
    Some(format!(
        " Delay from a frame's exposure to its use: {} identified {}, {} reconciled {}.",
        identified.0, identified.1, reconciled.0, reconciled.1
    ))
}

/// What the correction was worth in one run, and the sign of a change beyond chance.
fn worth(first: &Stage, last: &Stage, name: &str, of: OfStage) -> (String, i8) {
    let said = |stage: &Stage| match of(stage).and_then(error) {
        Some((nm, half)) if of(stage).is_some_and(|run| run.state == "running") => {
            format!("{} nm", with_interval(nm, half))
        }
        _ => rms(of(stage)),
    };
    let sign = match (of(first).and_then(error), of(last).and_then(error)) {
        (Some(before), Some(after)) if (after.0 - before.0).abs() > before.1.hypot(after.1) => {
            if after.0 < before.0 {
                1
            } else {
                -1
            }
        }
        _ => 0,
    };
    (
        format!("{name} {} before, {} after", said(first), said(last)),
        sign,
    )
}

/// The verdict on all runs: 1 is a run that became better beyond chance, -1 one that became worse.
fn verdict(signs: &[i8]) -> String {
    let runs = signs.len();
    let [better, worse] = [1, -1].map(|sign| signs.iter().filter(|one| **one == sign).count());
    let in_runs = |count: usize, word: &str| match count {
        _ if count == runs => format!("is {word}"),
        _ => format!("is {word} in {count} of {runs} runs, the same in the other"),
    };
    match (better, worse) {
        (0, 0) => "gains nothing".to_owned(),
        (_, 0) => in_runs(better, "better"),
        (0, _) => in_runs(worse, "worse"),
        _ => "is better in one run and worse in the other".to_owned(),
    }
}

/// What came out.
pub(super) fn sentence(circle: &Circle) -> (Emphasis, String) {
    let mut text = lacks(circle);
    if let Some(delays) = delays_text(circle) {
        text.push_str(&delays);
    }
    let mut gain = 0;
    if let [first, .., last] = circle.stages.as_slice() {
        let (runs, signs): (Vec<String>, Vec<i8>) = RUNS
            .iter()
            .map(|(name, of)| worth(first, last, name, *of))
            .unzip();
        gain = signs.iter().sum();
        text.push_str(&format!(
            " The controller of the corrected model {}: RMS error {}.",
            verdict(&signs),
            runs.join("; ")
        ));
    }
    let status = match circle.reconciled.verdict {
        Verdict::Unknown => Emphasis::Bad,
        Verdict::Ambiguous => Emphasis::Warning,
        _ if gain > 0 => Emphasis::Good,
        _ => Emphasis::Plain,
    };
    (status, text)
}

#[cfg(test)]
mod tests {
    use super::verdict;

    #[test]
    fn a_correction_is_worth_what_the_runs_show() {
        assert_eq!(verdict(&[0, 0]), "gains nothing");
        assert_eq!(verdict(&[1, 1]), "is better");
        assert_eq!(
            verdict(&[0, -1]),
            "is worse in 1 of 2 runs, the same in the other"
        );
        assert_eq!(
            verdict(&[1, -1]),
            "is better in one run and worse in the other"
        );
    }
}
