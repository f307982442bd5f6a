//! The end of a run in sentences: observation, expectation, remedy.

use crate::clues::Clues;
use crate::failure::{Failure, describe};
use crate::words::{of_what_is_followed, safe_reason};
use cellpos_rig::{ActuatorFault as Fault, ActuatorState as State};
use cellpos_runtime::life::{Refusal, SafeReason};
use cellpos_runtime::realtime::Conditions;
use cellpos_runtime::recorder::RecorderFault;
use cellpos_runtime::{ArmingConfig, End, EndState, Kept, NotKept, RunError, Summary, Timing};
use serde::{Deserialize, Serialize};
use std::fmt;

/// The kinds of end, for programs that react to them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum EndKind {
    /// It ran for its whole time.
    Done,
    /// The reference generator came to its end: a script, an excitation.
    ReferenceOver,
    /// The operator ended it; the bead was frozen, then the PZT parked.
    Operator,
    /// A limit of the script was passed; the bead was frozen, then the PZT parked.
    Stopped,
    /// The loop was never closed: the plant did not respond to the arming pulse as the model predicts, or no bead was seen.
    ArmingRefused,
    /// It ran for its whole time, but did not keep its bead.
    NotKept,
    /// The loop went to Safe during the run.
    Safe,
    /// The run could no longer be recorded.
    Unrecorded,
    /// A device or a thread failed.
    Failed,
}

/// How a run ended.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Ended {
    /// In a word.
    pub kind: EndKind,
    /// Why arming was refused, if it was.
    pub refusal: Option<Refusal>,
    /// Why Safe was latched, if it was.
    pub reason: Option<SafeReason>,
    /// What was seen.
    pub seen: String,
    /// The expectation; empty if nothing went wrong.
    pub expected: String,
    /// The remedy; empty if there is nothing to do.
    pub to_do: String,
}

impl Ended {
    /// A run that a limit of its script ended; `seen`: which one, and where.
    pub fn stopped(seen: String) -> Self {
        Self {
            kind: EndKind::Stopped,
            refusal: None,
            reason: None,
            seen,
            expected: String::new(),
            to_do: String::new(),
        }
    }

    /// Whether it ended as requested.
    pub fn as_asked(&self) -> bool {
        matches!(
            self.kind,
            EndKind::Done | EndKind::ReferenceOver | EndKind::Operator | EndKind::Stopped
        )
    }

    /// Whether the cause may be over by now, for example a stall of this machine, of the line or of the camera. Another run may then
    /// succeed without a person's action. A lost bead, or a board that another program holds, is not such a cause.
    pub fn may_pass(&self) -> bool {
        self.refusal == Some(Refusal::Disturbed)
            || matches!(
                self.reason,
                Some(
                    SafeReason::Board
                        | SafeReason::BoardNotObeying
                        | SafeReason::CameraLost
                        | SafeReason::LateTicks
                        | SafeReason::LinkLost
                        | SafeReason::StaleFrames
                        | SafeReason::Stalled
                        | SafeReason::VisionSlow
                )
            )
    }

    /// The failure of a command that needed another end; `help` says how to continue.
    pub fn failure(&self, help: &str) -> Failure {
        let advice = [self.to_do.as_str(), help];
        let advice = advice.iter().filter(|part| !part.is_empty());
        let help = advice.copied().collect::<Vec<_>>().join("; ");
        Failure::Failed(miette::miette!(help = help, "{}", self.seen_and_expected()))
    }

    fn seen_and_expected(&self) -> String {
        let expected = if self.expected.is_empty() {
            String::new()
        } else {
            format!("; expected {}", self.expected)
        };
        format!("{}{expected}", self.seen)
    }
}

impl fmt::Display for Ended {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.seen_and_expected())?;
        if !self.to_do.is_empty() {
            write!(f, "; {}", self.to_do)?;
        }
        Ok(())
    }
}

/// The expectations of the loop's set-up.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Expected {
    pub(crate) timing: Timing,
    pub(crate) arming: ArmingConfig,
    /// Whether a cell is followed rather than a bead.
    pub(crate) cell: bool,
}

/// Remedy if no cell is found: vision sees a cell as the difference from the background.
const NO_CELL: &str = "bring a cell into view and into focus, then start again; if one is in view, the background may be of another \
    region, light or focus: record the empty channel again (cellpos background)";

/// Remedy if vision is slower than the camera. A background that does not fit makes objects of every wall.
fn slow_vision(cell: bool) -> &'static str {
    if cell {
        "record the empty channel again if its region, light or focus changed (cellpos background); else choose a smaller region, a lower \
         frame rate, or a faster machine"
    } else {
        "choose a smaller region (origin_px, width_px), a lower frame rate, or a faster machine"
    }
}

/// Three sentences: observation, expectation, remedy.
type Sentences = (String, String, String);

fn sentences(seen: impl Into<String>, expected: impl Into<String>, to_do: &str) -> Sentences {
    (seen.into(), expected.into(), to_do.to_string())
}

impl Clues {
    /// The end of a run, from its summary, its trouble, the rights of its control thread and these clues.
    pub(crate) fn ended(
        &self,
        summary: &Summary,
        trouble: Option<&RunError>,
        recorder: Option<RecorderFault>,
        conditions: &Conditions,
        expected: &Expected,
    ) -> Ended {
        let refusal = self.arming.map(|(refusal, ..)| refusal);
        let refused = summary.safe_reason == Some(SafeReason::ArmingRefused);
        let by_operator = summary.end == End::Operator
            || summary.safe_reason == Some(SafeReason::Operator)
            || trouble.is_none() && summary.state != EndState::Safe && summary.end == End::Safe;
        let kind = match (trouble, summary.state) {
            (Some(_), _) => EndKind::Failed,
            _ if recorder.is_some() => EndKind::Unrecorded,
            _ if by_operator => EndKind::Operator,
            (None, EndState::Safe) if refused => EndKind::ArmingRefused,
            (None, EndState::Safe) => EndKind::Safe,
            (None, EndState::Armed | EndState::Disarmed) => EndKind::ArmingRefused,
            (None, EndState::NotKept) => EndKind::NotKept,
            (None, EndState::Running) if summary.end == End::Script => EndKind::ReferenceOver,
            (None, EndState::Running) => EndKind::Done,
        };
        let (seen, wanted, to_do) = match kind {
            EndKind::Done => sentences("the time of the run was over", "", ""),
            EndKind::ReferenceOver => sentences("the reference came to its end", "", ""),
            EndKind::NotKept => not_kept(&summary.kept, self.clipped_um),
            EndKind::Unrecorded => sentences(
                recorder.map_or("the run was not recorded", RecorderFault::sentence),
                "a disk that takes the record",
                "make room, or name another folder with --runs; what was written is kept",
            ),
            EndKind::Failed => trouble.map_or_else(Default::default, failed),
            EndKind::ArmingRefused if refused => self.refused(expected),
            EndKind::ArmingRefused => sentences(
                "the time of the run was over before the loop was closed",
                "a bead held steadily in view, and time for the arming pulse",
                "bring a bead into view, or run longer",
            ),
            EndKind::Safe => {
                let (seen, wanted, to_do) = self.safe(summary.safe_reason, expected);
                let first = self.machine(summary.safe_reason, conditions);
                (
                    seen,
                    wanted,
                    format!("{}{to_do}", first.unwrap_or_default()),
                )
            }
            EndKind::Operator | EndKind::Stopped => sentences("the operator ended the run", "", ""),
        };
        let said = |sentence: String| of_what_is_followed(&sentence, expected.cell);
        Ended {
            kind,
            refusal: refusal.filter(|_| kind == EndKind::ArmingRefused),
            reason: summary.safe_reason,
            seen: said(seen),
            expected: said(wanted),
            to_do: said(to_do),
        }
    }

    fn refused(&self, expected: &Expected) -> Sentences {
        let arming = &expected.arming;
        let Some((refusal, ratio, ci95)) = self.arming else {
            return sentences(
                "the arming pulse was refused",
                "an answer as the model says",
                "see events.jsonl in the run folder",
            );
        };
        let gain = format!("{ratio:+.2} of the model's gain (95 %: +-{ci95:.2})");
        let range = format!("{} to {}", arming.lowest_ratio, arming.highest_ratio);
        match refusal {
            Refusal::LostInPulse => sentences(
                "the bead was in view, and was lost while the arming pulse moved it",
                format!(
                    "positions in half of the {} ticks of the pulse at least",
                    2 * arming.pulse_ticks
                ),
                "is the tracked object the bead, and not dirt? If vision refuses fast motion, see [tracking] in rig.toml",
            ),
            Refusal::NoBead => sentences(
                format!(
                    "no bead was steadily in view for {} ticks",
                    arming.patience_ticks
                ),
                format!("{} good positions in a row", arming.steady_ticks),
                if expected.cell {
                    NO_CELL
                } else {
                    "bring a bead into view and into focus (see cellpos camera --snapshot), then start again"
                },
            ),
            Refusal::NoResponse => sentences(
                format!(
                    "the bead did not move with the PZT: {gain} after a pulse of {} um",
                    arming.pulse_um
                ),
                format!("{range} of it"),
                "is the amplifier on, the syringe connected, the bead free of the wall?",
            ),
            Refusal::WrongSign => sentences(
                format!("the bead moved against the PZT: {gain}"),
                format!("{range} of it: the same sign"),
                "change the sign of `sign` in [calibration] of rig.toml: the camera's axis points the other way",
            ),
            Refusal::WrongGain => sentences(
                format!("the bead moved by {gain}"),
                format!("{range} of it, for which the controller is stable"),
                "check pixel_um and um per volt; if both are right measure this rig (cellpos identify) and design for it (cellpos \
                 design)",
            ),
            Refusal::Disturbed => sentences(
                "ticks were skipped or frames came too late in every arming pulse, so the motion of the bead says nothing about the plant",
                format!(
                    "half of the {} ticks of a pulse undisturbed",
                    2 * arming.pulse_ticks
                ),
                "see with cellpos doctor what keeps this machine busy, then start again",
            ),
        }
    }

    fn safe(&self, reason: Option<SafeReason>, expected: &Expected) -> Sentences {
        let timing = &expected.timing;
        let in_a_row = timing.faults_in_a_row;
        let lost_ms = f64::from(timing.lost_ticks) * timing.period_us * 1e-3;
        let last = |value: Option<f64>, unit: &str| {
            value.map_or_else(String::new, |v| format!(", the last {v:.1} {unit}"))
        };
        let Some(reason) = reason else {
            return sentences(
                "the loop went safe, and gave no reason",
                "a loop that runs",
                "see events.jsonl in the run folder",
            );
        };
        let (figures, wanted, to_do) = match reason {
            SafeReason::Board => return self.board(),
            SafeReason::BeadLost => sentences(
                format!(" ({lost_ms:.0} ms)"),
                "the bead in view",
                if expected.cell {
                    NO_CELL
                } else {
                    "bring a bead into view and start again; a faster flow than the loop can hold shows as drift before the loss"
                },
            ),
            SafeReason::CameraLost => sentences(
                format!(" ({lost_ms:.0} ms)"),
                format!("one every {} ms", timing.period_us * 1e-3),
                "check cable, power and trigger of the camera (see cellpos camera)",
            ),
            SafeReason::StaleFrames if self.picture_frozen => sentences(
                format!(" ({lost_ms:.0} ms of one picture)"),
                "a new picture in each frame",
                "the camera repeats one picture: restart it, or its server",
            ),
            SafeReason::StaleFrames => sentences(
                format!(" (more than {in_a_row}{})", last(self.stale_ms, "ms old")),
                format!("new frames not older than {} ms", timing.oldest_ms),
                "check the camera's buffers and [timing] camera_delay_ms (cellpos camera shows ages)",
            ),
            SafeReason::LateTicks => sentences(
                format!(
                    " (more than {in_a_row}{})",
                    last(self.late_us, "us after the tick began")
                ),
                format!("within {} us", timing.budget_us),
                "run cellpos doctor; close other programs, or choose a lighter controller",
            ),
            SafeReason::LinkLost => sentences(
                format!(" ({} ms)", timing.board_silence_ms),
                "a status every 10 ms",
                "check cable and power of the board; its watchdogs hold the bead at zero flow, then park the PZT",
            ),
            SafeReason::NotFinite => sentences(
                "",
                "a displacement, um",
                "keep the run folder: this is a defect, or a controller.toml that no loop can use",
            ),
            SafeReason::VisionSlow => sentences(
                self.vision_ms
                    .map_or_else(String::new, |[vision_ms, period_ms]| {
                        format!(" (it takes {vision_ms:.1} ms a frame of {period_ms:.1})")
                    }),
                format!("new frames not older than {} ms", timing.oldest_ms),
                slow_vision(expected.cell),
            ),
            SafeReason::Stalled => sentences(
                " (more than a second)",
                format!("a tick every {} ms", timing.period_us * 1e-3),
                "find out why this program or this machine was suspended; the board has stopped the bead",
            ),
            SafeReason::BoardForeign => sentences(
                "",
                "a board that only this run uses",
                "make sure that only one program uses the board, then start again",
            ),
            SafeReason::BoardNotObeying => sentences(
                format!(" (for {} ms)", timing.board_silence_ms),
                "a sequence number that moves with the commands",
                "check the line to the board for damaged frames, and its baud rate",
            ),
            SafeReason::NotFollowing if self.clipped_um.is_some() => {
                return clipped(self.clipped_um);
            }
            SafeReason::NotFollowing => sentences(
                " further and further, until it was frozen",
                "a bead that goes where the commands push it",
                "check the sign of the calibration, the amplifier and the tubes; then measure the plant again with `cellpos identify`",
            ),
            SafeReason::BoardNotFollowing => sentences(
                " (for 100 ms)",
                "an output within 0.2 um of the commands of the last 30 ms",
                "check the limits of the board against [limits], and its amplifier",
            ),
            SafeReason::Operator | SafeReason::ArmingRefused | SafeReason::Unrecorded => {
                sentences("", "a loop that runs", "see events.jsonl in the run folder")
            }
        };
        (format!("{}{figures}", safe_reason(reason)), wanted, to_do)
    }

    fn board(&self) -> Sentences {
        let why = match self.board {
            Some((_, Fault::CommandTimeout)) => {
                "the board parked the PZT: no command came within both its watchdog times; this program was stopped, or the line was blocked"
            }
            Some((_, Fault::FreezeTimeout)) => "the board parked the PZT: nothing ended a freeze",
            Some((_, Fault::ArmTimeout)) => "the board parked the PZT: no command followed arming",
            Some((State::Disarmed, _)) => {
                "the board is disarmed: another host did it, or it was switched off and on"
            }
            Some((State::Safe, _)) => "another host told the board to park",
            Some((_, Fault::Device)) => {
                "the board reports a fault: temperature, current, supply or converter"
            }
            _ => "the board is in another state or session than this run's",
        };
        sentences(
            why,
            "a board that follows only this run's commands",
            "make sure that only one program uses the board and that it is not suspended, then start again",
        )
    }
}

/// A bead that did not follow the commands beyond a level.
fn clipped(level_um: Option<f64>) -> Sentences {
    let beyond = level_um.map_or_else(|| "a level".to_owned(), |um| format!("about {um:.1} um"));
    sentences(
        format!(
            "the bead did not follow the commands beyond {beyond}: the amplifier or the PZT is clipped, or the flow grows as fast as the commands"
        ),
        "motion in proportion to the command over the whole range",
        "check offset, supply and limits of the amplifier, and the range in [limits] of rig.toml",
    )
}

/// A run that reached its end but had lost the bead that it was to keep.
fn not_kept(kept: &Kept, clipped_um: Option<f64>) -> Sentences {
    let within_um = kept.held_within_nm.unwrap_or(f64::NAN) * 1e-3;
    let held = kept.held_percent.map_or_else(String::new, |percent| {
        format!("; {percent:.1} % of the time it was within {within_um:.2} um")
    });
    let times = |n: u64| {
        if n == 1 {
            "once".to_owned()
        } else {
            format!("{n} times")
        }
    };
    let a_hold =
        format!("within {within_um:.2} um of its reference (five standard deviations of hold)");
    match kept.why {
        Some(NotKept::AnotherBead) => sentences(
            format!(
                "the bead was lost, and {} a bead was found that may be another one",
                times(kept.other_beads)
            ),
            "one bead in view from beginning to end",
            "look at the events and the clip of the loss; use fewer beads, or a larger field of view",
        ),
        Some(NotKept::OutOfSight) => sentences(
            format!(
                "the bead was out of sight when the run ended, for {:.0} ms",
                kept.unseen_at_end_ms
            ),
            "a bead in view",
            "check the camera (cellpos camera), and bring a bead into view",
        ),
        Some(NotKept::Clipped) => clipped(clipped_um),
        Some(NotKept::Frozen) => sentences(
            "the loop had frozen the bead when the run ended".to_owned(),
            "a bead that the loop controls to the end",
            "look at the last events (cellpos report): they name the reason",
        ),
        Some(NotKept::Strayed) | None => sentences(
            format!(
                "the bead strayed {}, up to {:.2} um from its reference{held}",
                times(kept.strayed),
                kept.furthest_um
            ),
            a_hold,
            "check the flow (leaks, taps, tubes), the amplifier and the model; cellpos report shows when it happened",
        ),
    }
}

fn failed(error: &RunError) -> Sentences {
    let seen = describe(error);
    match error {
        RunError::Camera(_) => sentences(
            seen,
            "a camera that delivers until the run ends",
            "check its cable and power, then start again",
        ),
        RunError::Actuator(_) => sentences(
            seen,
            "a board that answers until the run ends",
            "check its cable and power; its watchdogs hold the bead at zero flow, then park the PZT",
        ),
        _ => sentences(
            seen,
            "a run without trouble in the program itself",
            "keep the run folder: this is worth a report",
        ),
    }
}
