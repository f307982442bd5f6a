//! The final message of a run on the page, for every kind of end.

use crate::connect::ENDED;
use crate::ended::{EndKind, Ended};
use crate::failure::Failure;
use cellpos_live::LastWord;
use cellpos_record::RunEnd;
use cellpos_runtime::life::SafeReason;

/// Text on the PZT's place if the board accepted the command to park.
const AT_PARK: &str = "The PZT is at park, or ramps there.";
/// Text for a run that ended long ago.
const PARKED_THEN: &str = "The program parked the PZT when the run ended.";
/// Text if the acceptance of park was not observed.
const NOT_SEEN: &str =
    "The board was told to park and has been silent since; its own watchdog parks the PZT.";
/// Text if another host has the board.
const FOREIGN: &str =
    "Another program uses the board: this program does not know where the PZT is.";
/// Text if the board was never armed.
const NOT_ARMED: &str = "The board was not armed: the PZT was not moved.";

impl Ended {
    /// The final message for this end.
    pub fn last_word(&self) -> LastWord {
        let how = match self.kind {
            EndKind::Done | EndKind::ReferenceOver => "done",
            EndKind::Operator | EndKind::Stopped => "stopped",
            EndKind::NotKept => "not-kept",
            EndKind::ArmingRefused | EndKind::Safe => "safe",
            EndKind::Unrecorded | EndKind::Failed => "failed",
        };
        let pzt = match (self.kind, self.reason) {
            (_, Some(SafeReason::BoardForeign)) => FOREIGN,
            (EndKind::Failed, _)
            | (_, Some(SafeReason::LinkLost | SafeReason::BoardNotObeying)) => NOT_SEEN,
            _ => AT_PARK,
        };
        let expected = match self.expected.is_empty() {
            true => String::new(),
            false => format!(" Expected: {}.", self.expected),
        };
        LastWord {
            how,
            seen: format!("{}.{expected}", capital(&self.seen)),
            to_do: capital(&self.to_do),
            pzt: pzt.to_string(),
        }
    }
}

/// For a run that is over for a reason in a sentence.
pub(super) fn of_reason(how: &'static str, reason: &str) -> LastWord {
    LastWord {
        how,
        seen: capital(reason),
        to_do: String::new(),
        pzt: AT_PARK.to_string(),
    }
}

/// For a run whose board could not be armed.
pub(super) fn of_refusal(failure: &Failure) -> LastWord {
    not_armed(&failure.text())
}

fn not_armed(why: &str) -> LastWord {
    LastWord {
        how: "failed",
        seen: format!("{}.", capital(why)),
        to_do: String::new(),
        pzt: NOT_ARMED.to_string(),
    }
}

/// For a run whose program ended without a summary: an error or a panic on one of its threads.
pub(super) fn of_silence() -> LastWord {
    LastWord {
        how: "failed",
        seen: "The program ended the run without a summary; its terminal says why.".to_string(),
        to_do: "Read the terminal, then start again".to_string(),
        pzt: NOT_SEEN.to_string(),
    }
}

/// For a run of another program that has fallen silent.
pub(super) fn of_gone(seconds: u64) -> LastWord {
    LastWord {
        how: "failed",
        seen: format!(
            "Nothing was written for {seconds} s, and the record has no end: the program or its disk failed."
        ),
        to_do: "See whether the program still runs".to_string(),
        pzt: "Without commands the board's own watchdog holds the bead, then parks the PZT."
            .to_string(),
    }
}

/// The recorded end of a run that is read from its folder, in the words of its own page.
pub(super) fn of_record(end: &RunEnd) -> LastWord {
    let recorded = end.summary.get(ENDED).cloned();
    if let Some(ended) = recorded.and_then(|ended| ended.try_into::<Ended>().ok()) {
        let word = ended.last_word();
        let pzt = match word.pzt == AT_PARK {
            true => PARKED_THEN.to_string(),
            false => word.pzt,
        };
        return LastWord { pzt, ..word };
    }
    if let Some(why) = end.summary.get("why").and_then(toml::Value::as_str) {
        return not_armed(why);
    }
    let how = match end.outcome.as_str() {
        "done" => "done",
        "stopped" | "aborted" => "stopped",
        "safe" => "safe",
        _ => "failed",
    };
    LastWord {
        how,
        seen: format!("The record ends: {}.", end.outcome),
        to_do: String::new(),
        pzt: PARKED_THEN.to_string(),
    }
}

fn capital(text: &str) -> String {
    let mut letters = text.chars();
    match letters.next() {
        Some(first) => first.to_uppercase().chain(letters).collect(),
        None => String::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_runtime::life::Refusal;

    #[test]
    fn a_recorded_end_has_the_words_that_the_page_of_the_run_had() {
        let ends = [
            (EndKind::Done, None, None),
            (EndKind::Operator, None, Some(SafeReason::Operator)),
            (EndKind::NotKept, None, None),
            (EndKind::Safe, None, Some(SafeReason::LinkLost)),
            (EndKind::Safe, None, Some(SafeReason::BoardForeign)),
            (EndKind::ArmingRefused, Some(Refusal::NoBead), None),
            (EndKind::Unrecorded, None, Some(SafeReason::Unrecorded)),
            (EndKind::Failed, None, None),
        ];
        for (kind, refusal, reason) in ends {
            let ended = Ended {
                kind,
                refusal,
                reason,
                seen: "the bead was lost".to_string(),
                expected: "a bead".to_string(),
                to_do: "start again".to_string(),
            };
            let mut end = RunEnd::new("any");
            let value = toml::Value::try_from(&ended).unwrap();
            end.summary.insert(ENDED.to_string(), value);
            let (live, read) = (ended.last_word(), of_record(&end));
            assert_eq!(
                (live.how, &live.seen, &live.to_do),
                (read.how, &read.seen, &read.to_do)
            );
            assert_eq!(live.pzt == AT_PARK, read.pzt == PARKED_THEN, "{read:?}");
        }
        let mut end = RunEnd::new("not-armed");
        let why = toml::Value::String("the board did not answer".to_string());
        end.summary.insert("why".to_string(), why);
        let read = of_record(&end);
        assert_eq!((read.how, read.pzt.as_str()), ("failed", NOT_ARMED));
        assert_eq!(read.seen, "The board did not answer.");
    }
}
