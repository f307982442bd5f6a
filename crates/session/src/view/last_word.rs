//! The last word of a run on the page, however it ended.

use crate::connect::ENDED;
use crate::ended::{EndKind, Ended};
use crate::failure::Failure;
use cellpos_live::LastWord;
use cellpos_record::RunEnd;
use cellpos_runtime::life::SafeReason;

/// Where the PZT is when the board took the command to park.
const AT_PARK: &str = "The PZT is at park, or ramps there.";
/// Where it is when nobody could see that the board took it.
const NOT_SEEN: &str =
    "The board was told to park and was not heard since; its own watchdog parks the PZT.";
/// Where it is when another host has the board.
const FOREIGN: &str = "Another program has the board: where the PZT is, this program cannot say.";
/// Where it is when the board was never armed.
const NOT_ARMED: &str = "The board was not armed: the PZT was not moved.";

impl Ended {
    /// The last word of this end.
    pub fn last_word(&self) -> LastWord {
        let how = match self.kind {
            EndKind::Done | EndKind::ReferenceOver => "done",
            EndKind::Operator => "stopped",
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

/// Of a run that was over for a reason in a sentence.
pub(super) fn of_reason(how: &'static str, reason: &str) -> LastWord {
    LastWord {
        how,
        seen: capital(reason),
        to_do: String::new(),
        pzt: AT_PARK.to_string(),
    }
}

/// Of a run whose board could not be armed.
pub(super) fn of_refusal(failure: &Failure) -> LastWord {
    LastWord {
        how: "failed",
        seen: format!("{}.", capital(&failure.text())),
        to_do: String::new(),
        pzt: NOT_ARMED.to_string(),
    }
}

/// Of a run whose program ended without a summary: an error or a panic on one of its threads.
pub(super) fn of_silence() -> LastWord {
    LastWord {
        how: "failed",
        seen: "The program ended the run without a summary; its terminal says why.".to_string(),
        to_do: "Read the terminal, then start again".to_string(),
        pzt: NOT_SEEN.to_string(),
    }
}

/// Of a run in another program of which nothing is heard any more.
pub(super) fn of_gone(seconds: u64) -> LastWord {
    LastWord {
        how: "failed",
        seen: format!(
            "Nothing was written for {seconds} s, and the record has no end: the program is gone, or its disk is."
        ),
        to_do: "See whether the program still runs".to_string(),
        pzt: "Without commands the board's own watchdog holds the bead, then parks the PZT."
            .to_string(),
    }
}

/// The recorded end of a run that is read from its folder.
pub(super) fn of_record(end: &RunEnd) -> LastWord {
    let ended = end.summary.get(ENDED).and_then(toml::Value::as_table);
    let text = |key: &str| {
        let value = ended.and_then(|ended| ended.get(key));
        value.and_then(toml::Value::as_str).unwrap_or_default()
    };
    let how = match (end.outcome.as_str(), text("kind")) {
        (_, "operator") | ("stopped" | "aborted", _) => "stopped",
        ("done", _) | (_, "done" | "reference-over") => "done",
        ("safe", _) => "safe",
        _ => "failed",
    };
    let seen = match (text("seen"), text("expected")) {
        ("", _) => format!("The record ends: {}.", end.outcome),
        (seen, "") => format!("{}.", capital(seen)),
        (seen, expected) => format!("{}. Expected: {expected}.", capital(seen)),
    };
    LastWord {
        how,
        seen,
        to_do: capital(text("to_do")),
        pzt: "The program parked the PZT when the run ended.".to_string(),
    }
}

fn capital(text: &str) -> String {
    let mut letters = text.chars();
    match letters.next() {
        Some(first) => first.to_uppercase().chain(letters).collect(),
        None => String::new(),
    }
}
