//! Events of a run as sentences: for the terminal, the page and the report.

use crate::adapt;
use cellpos_rig::{ActuatorFault, ActuatorState};
use cellpos_runtime::life::{EventKind, FreezeReason, Refusal, SafeReason};

/// Importance of an event for the operator.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Level {
    /// The run is as expected.
    Info,
    /// Something went wrong, but the run recovered.
    Warning,
    /// The run cannot continue as planned.
    Fault,
}

impl Level {
    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Info => "info",
            Self::Warning => "warning",
            Self::Fault => "fault",
        }
    }
}

/// A sentence about the tracked object: replaces "bead" by "cell" if it is a cell.
pub fn of_what_is_followed(sentence: &str, cell: bool) -> String {
    if !cell {
        return sentence.to_owned();
    }
    let mut out = String::with_capacity(sentence.len());
    let mut rest = sentence;
    while let Some(at) = rest.find("bead") {
        let (before, found) = rest.split_at(at);
        let after = &found["bead".len()..];
        let inside = |c: char| c.is_alphanumeric() || matches!(c, '-' | '_');
        let end = after.strip_prefix('s').unwrap_or(after);
        let alone = !before.ends_with(inside) && !end.starts_with(inside);
        out.push_str(before);
        out.push_str(if alone { "cell" } else { "bead" });
        rest = after;
    }
    out.push_str(rest);
    out
}

/// Why Safe was latched, as the end of a sentence.
pub fn safe_reason(reason: SafeReason) -> &'static str {
    match reason {
        SafeReason::Operator => "the operator asked for park",
        SafeReason::BeadLost => "the bead was not seen for longer than the loop may run without it",
        SafeReason::CameraLost => "no frames came for longer than the loop may run without them",
        SafeReason::StaleFrames => "too many frames in a row were old or repeated",
        SafeReason::LateTicks => "too many commands in a row were handed over late",
        SafeReason::NotFinite => "the controller's output was not a number",
        SafeReason::Board => "the board left the session",
        SafeReason::BoardForeign => "the board is in the session of another program",
        SafeReason::BoardNotObeying => "the board is heard but obeys no command",
        SafeReason::NotFollowing => "the bead did not follow the commands, or moved against them",
        SafeReason::BoardNotFollowing => "the board's output does not follow the commands",
        SafeReason::LinkLost => "the board was not heard for longer than allowed",
        SafeReason::ArmingRefused => "the plant did not answer the arming pulse as the model says",
        SafeReason::Unrecorded => "the run could no longer be recorded",
        SafeReason::VisionSlow => {
            "vision takes longer for a frame than the camera, and frames grew old"
        }
        SafeReason::Stalled => {
            "the loop was interrupted for so long that the position of the bead is unknown"
        }
    }
}

fn freeze_reason(reason: FreezeReason) -> &'static str {
    match reason {
        FreezeReason::Operator => "the operator asked for it",
        FreezeReason::BeadLost => "the bead is not seen",
        FreezeReason::CameraStalled => "no frames come",
        FreezeReason::VisionSlow => "vision takes longer for a frame than the camera",
        FreezeReason::LineStalled => "the line to the board is stalled",
        FreezeReason::PictureFrozen => "the camera gives the same picture again and again",
        FreezeReason::NotFollowing => {
            "the bead does not follow the commands, or moves against them"
        }
        FreezeReason::Unrecorded => "the run can no longer be recorded",
    }
}

fn refusal(reason: Refusal) -> &'static str {
    match reason {
        Refusal::NoBead => "no steady bead was seen",
        Refusal::LostInPulse => "the bead was lost while the arming pulse moved it",
        Refusal::NoResponse => "the bead did not move with the PZT beyond its own noise",
        Refusal::WrongSign => "the bead moved the wrong way: is the sign in [calibration] right?",
        Refusal::WrongGain => "with this gain the controller may be unstable",
        Refusal::Disturbed => "ticks were skipped or frames came too late in every pulse",
    }
}

/// Whether a gain over the model's differs from 1, beyond its 95 % interval, by more than a rig varies from day to day.
pub(crate) fn is_odd(ratio: f64, ci95: f64) -> bool {
    const USUAL: f64 = 1.25;
    ratio - ci95 > USUAL || ratio + ci95 < 1.0 / USUAL
}

/// An event in a sentence, and its importance.
pub fn sentence(kind: &EventKind) -> (Level, String) {
    (level(kind), text(kind))
}

fn level(kind: &EventKind) -> Level {
    match *kind {
        EventKind::ArmingPassed { gain_ratio, ci95 } if is_odd(gain_ratio, ci95) => Level::Warning,
        EventKind::FreezeStarted {
            reason: FreezeReason::Operator,
        }
        | EventKind::SafeLatched {
            reason: SafeReason::Operator,
        }
        | EventKind::Armed
        | EventKind::ArmingPassed { .. }
        | EventKind::Running
        | EventKind::CoastingEnded { .. }
        | EventKind::FreezeEnded { .. }
        | EventKind::FramesEarlyEnded { .. }
        | EventKind::VisionSlowEnded { .. }
        | EventKind::StuckEnded { .. }
        | EventKind::PartnerBack { .. }
        | EventKind::PartnerLimitEnded { .. }
        | EventKind::SaturationEnded { .. }
        | EventKind::DiskSlowEnded { .. }
        | EventKind::Finished
        | EventKind::Script { .. }
        | EventKind::StepSkipped => Level::Info,
        EventKind::ArmingRefused { .. } | EventKind::SafeLatched { .. } => Level::Fault,
        _ => Level::Warning,
    }
}

const NEAR_LIMIT: &str = "The bead is nearly too faint, too blurred or too far out of focus for the settings of vision: mend light or \
                          focus before it is lost.";

fn text(kind: &EventKind) -> String {
    match *kind {
        EventKind::Armed => "The board is armed; the bead is being looked for.".to_string(),
        EventKind::ArmingPassed { gain_ratio, ci95 } => arming_passed(gain_ratio, ci95),
        EventKind::ArmingRepeated { refusal: why, .. } => {
            let why = refusal(why);
            format!("The arming pulse was disturbed and is made again ({why}).")
        }
        EventKind::ArmingRejected { .. } => {
            "What is seen did not move with the PZT: another bead is looked for.".to_string()
        }
        EventKind::ArmingRefused {
            refusal: why,
            gain_ratio,
            ..
        } => arming_refused(why, gain_ratio),
        EventKind::Running => "The loop is closed.".to_string(),
        EventKind::CoastingStarted => "No position: the loop runs on prediction.".to_string(),
        EventKind::CoastingEnded { lasted_ms } => {
            format!("Positions are back after {lasted_ms:.1} ms.")
        }
        EventKind::FreezeStarted { reason } => {
            format!("The bead is being stopped: {}.", freeze_reason(reason))
        }
        EventKind::FreezeEnded { lasted_ms } => ended("Control continues", lasted_ms),
        EventKind::SafeLatched { reason } => format!("The PZT parks: {}.", safe_reason(reason)),
        EventKind::FramesDropped { count } => {
            let frames = plural(count, "frame is", "frames are");
            format!("{count} {frames} missing.")
        }
        EventKind::FrameRepeated { frame_id } => format!("Frame {frame_id} came again."),
        EventKind::FrameStale { age_ms } => {
            format!("A frame was {age_ms:.1} ms old and was not used.")
        }
        EventKind::FrameFromFuture { ahead_ms } => {
            format!("A frame is stamped with a time {ahead_ms:.1} ms ahead and was not used.")
        }
        EventKind::FramesEarlyStarted {
            age_ms,
            expected_ms,
        } => format!(
            "Frames are {age_ms:.2} ms old where {expected_ms:.2} ms are expected: is camera_delay_ms right?"
        ),
        EventKind::FramesEarlyEnded { lasted_ms } => {
            ended("Frames come as expected again", lasted_ms)
        }
        EventKind::VisionSlowStarted {
            vision_ms,
            period_ms,
        } => format!("Vision takes {vision_ms:.2} ms for a frame of {period_ms:.2} ms."),
        EventKind::VisionSlowEnded { lasted_ms } => ended("Vision keeps up again", lasted_ms),
        EventKind::CameraRestarted => "The camera restarted its frame numbers.".to_string(),
        EventKind::NearLimit => NEAR_LIMIT.to_string(),
        EventKind::BeadReacquired { position_um } => {
            format!("The bead was lost; the one found at {position_um:.3} um may be another.")
        }
        EventKind::LateTick { compute_us } => {
            format!("A command was handed over {compute_us:.0} us after its tick began: late.")
        }
        EventKind::TicksSkipped { count } => {
            let ticks = plural(count, "tick was", "ticks were");
            format!("{count} {ticks} skipped: the loop was not woken in time.")
        }
        EventKind::Adapted { .. } => adapt::sentence(kind),
        EventKind::StuckStarted => "The bead does not follow the PZT: it sticks.".to_string(),
        EventKind::StuckEnded { lasted_ms } => ended("The bead follows again", lasted_ms),
        EventKind::SaturationStarted => "The PZT is at an end of its range.".to_string(),
        EventKind::LoopPaused { count } => paused(count),
        EventKind::ActuatorClipped { level_um } => format!(
            "The bead does not follow the commands beyond about {level_um:.1} um: the amplifier or the PZT is clipped."
        ),
        EventKind::SaturationEnded { lasted_ms } => {
            ended("The PZT has left the end of its range", lasted_ms)
        }
        EventKind::BoardChanged { state, fault } => board_changed(state, fault),
        EventKind::BoardHeld { count } => board_held(count),
        EventKind::PartnerLost
        | EventKind::PartnerBack { .. }
        | EventKind::PartnerLimitStarted
        | EventKind::PartnerLimitEnded { .. } => partner(kind),
        EventKind::LinkGarbage { count } => {
            let messages = plural(u64::from(count), "message", "messages");
            format!("{count} damaged {messages} on the link.")
        }
        EventKind::DiskSlowStarted {
            unconfirmed_ms,
            rows,
            limit_ms,
        } => disk_slow(unconfirmed_ms, rows, limit_ms),
        EventKind::DiskSlowEnded { longest_ms } => format!(
            "The disk confirms in time again; it took {:.1} s at most.",
            longest_ms * 1e-3
        ),
        EventKind::Finished => "The time is up.".to_string(),
        EventKind::Script { stage } => format!("Script: {}.", stage.name()),
        EventKind::StepSkipped => "The operator skipped to the next step.".to_string(),
    }
}

fn paused(count: u32) -> String {
    let pauses = plural(u64::from(count), "pause", "pauses");
    format!("{count} {pauses} of the loop: the bead seemed to move against the commands.")
}

/// The state of the slow actuator in words.
fn partner(kind: &EventKind) -> String {
    match *kind {
        EventKind::PartnerBack { lasted_ms } => ended("The slow actuator obeys again", lasted_ms),
        EventKind::PartnerLimitStarted => {
            "The slow actuator is at an end of its range: the PZT takes the rest."
                .to_string()
        }
        EventKind::PartnerLimitEnded { lasted_ms } => {
            ended("The slow actuator has left the end of its range", lasted_ms)
        }
        _ => "The slow actuator is silent, parked or does not obey: the run continues within the PZT's stroke.".to_string(),
    }
}

fn ended(what: &str, lasted_ms: f64) -> String {
    format!("{what} after {lasted_ms:.0} ms.")
}

fn arming_passed(gain_ratio: f64, ci95: f64) -> String {
    if is_odd(gain_ratio, ci95) {
        format!(
            "The plant answered the arming pulse with {gain_ratio:.2} +- {ci95:.2} of the model's gain: is the pixel size wrong \
             by this factor, or the um per volt?"
        )
    } else {
        format!(
            "The plant answered the arming pulse: its gain is {gain_ratio:.2} +- {ci95:.2} of the model's."
        )
    }
}

fn arming_refused(why: Refusal, gain_ratio: f64) -> String {
    let why = refusal(why);
    if gain_ratio.is_finite() {
        format!("Arming was refused: {why}; the measured gain is {gain_ratio:.2} of the model's.")
    } else {
        format!("Arming was refused: {why}.")
    }
}

fn board_changed(state: ActuatorState, fault: ActuatorFault) -> String {
    let state = match state {
        ActuatorState::Disarmed => "The board is disarmed",
        ActuatorState::Armed => "The board is armed, and waits for the first command",
        ActuatorState::Running => "The board follows the commands",
        ActuatorState::Frozen => "The board holds the displacement of zero flow: frozen",
        ActuatorState::Safe => "The board parks the PZT",
        ActuatorState::Holding => "The board holds the displacement of zero flow",
    };
    let why = match fault {
        ActuatorFault::None => "",
        ActuatorFault::CommandTimeout => ": no command came in time",
        ActuatorFault::FreezeTimeout => ": nothing ended a freeze",
        ActuatorFault::ArmTimeout => ": no command followed arming",
        ActuatorFault::Device => {
            ": it reports a fault of temperature, current, supply or converter"
        }
    };
    format!("{state}{why}.")
}

fn board_held(count: u16) -> String {
    let times = plural(u64::from(count), "time", "times");
    format!("The board missed commands and held the bead {count} {times}; the loop continues.")
}

fn disk_slow(unconfirmed_ms: f64, rows: u64, limit_ms: f64) -> String {
    format!(
        "The disk has not confirmed what was written for {:.1} s: {rows} rows are in memory only, and a power failure now \
         would cost them; the run stops after {:.0} s of it.",
        unconfirmed_ms * 1e-3,
        limit_ms * 1e-3
    )
}

fn plural(count: u64, one: &'static str, many: &'static str) -> &'static str {
    if count == 1 { one } else { many }
}

#[cfg(test)]
mod tests {
    use super::of_what_is_followed;

    #[test]
    fn a_cell_is_called_so_and_names_stay() {
        let sentence = "the bead was lost, two beads; lose-bead, bead_um, a beaded line";
        assert_eq!(
            of_what_is_followed(sentence, true),
            "the cell was lost, two cells; lose-bead, bead_um, a beaded line"
        );
        assert_eq!(of_what_is_followed(sentence, false), sentence);
    }
}
