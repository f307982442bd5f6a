//! Events of a run as sentences: for the terminal, the page and the report.

use cellpos_runtime::life::{EventKind, FreezeReason, Refusal, SafeReason};

/// How much an event matters to whoever looks on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Level {
    /// The run goes as it should.
    Info,
    /// Something was not as it should be, and the run got over it.
    Warning,
    /// The run cannot go on as it was to.
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

/// Why Safe was latched, as the end of a sentence.
pub fn safe_reason(reason: SafeReason) -> &'static str {
    match reason {
        SafeReason::Operator => "the operator asked for park",
        SafeReason::BeadLost => {
            "the bead was not seen for longer than the loop may go on without it"
        }
        SafeReason::CameraLost => "no frames came for longer than the loop may go on without them",
        SafeReason::StaleFrames => "too many frames in a row were old or repeated",
        SafeReason::LateTicks => "too many commands in a row were handed over late",
        SafeReason::NotFinite => "the controller's output was not a number",
        SafeReason::Board => "the board left the session by itself",
        SafeReason::BoardForeign => "the board is in the session of another program",
        SafeReason::BoardNotObeying => "the board is heard but obeys no command",
        SafeReason::BoardNotFollowing => "the board's output does not follow the commands",
        SafeReason::LinkLost => "the board was not heard for longer than allowed",
        SafeReason::ActuatorRingFull => "commands could not be handed over to the board",
        SafeReason::ArmingRefused => "the plant did not answer the arming pulse as the model says",
        SafeReason::Unrecorded => "the run could no longer be recorded",
        SafeReason::VisionSlow => {
            "vision takes longer for a frame than the camera, and frames grew old"
        }
        SafeReason::Stalled => {
            "the loop stood still for so long that the bead's place is not known"
        }
    }
}

fn freeze_reason(reason: FreezeReason) -> &'static str {
    match reason {
        FreezeReason::Operator => "the operator asked for it",
        FreezeReason::BeadLost => "the bead is not seen",
        FreezeReason::CameraStalled => "no frames come",
        FreezeReason::Unrecorded => "the run can no longer be recorded",
    }
}

fn refusal(reason: Refusal) -> &'static str {
    match reason {
        Refusal::NoBead => "no steady bead was seen",
        Refusal::NoResponse => "the bead did not move with the PZT beyond its own noise",
        Refusal::WrongSign => "the bead moved the other way: is the sign in [calibration] right?",
        Refusal::WrongGain => "the gain is outside what the controller is safe for",
    }
}

/// Whether a gain over the model's differs from 1 by more than a rig does from day to day, beyond its 95 % interval.
pub(crate) fn is_odd(ratio: f64, ci95: f64) -> bool {
    const USUAL: f64 = 1.25;
    ratio - ci95 > USUAL || ratio + ci95 < 1.0 / USUAL
}

/// An event in a sentence, and how much it matters.
pub fn sentence(kind: &EventKind) -> (Level, String) {
    use Level::{Fault, Info, Warning};
    let text = |text: &str| text.to_string();
    match *kind {
        EventKind::Armed => (
            Info,
            text("The board is armed; the bead is being looked for."),
        ),
        EventKind::ArmingPassed { gain_ratio, ci95 } if is_odd(gain_ratio, ci95) => (
            Warning,
            format!(
                "The plant answered the arming pulse with {gain_ratio:.2} +- {ci95:.2} of the model's gain: is the pixel size wrong \
                 by this factor, or the um per volt?"
            ),
        ),
        EventKind::ArmingPassed { gain_ratio, ci95 } => (
            Info,
            format!(
                "The plant answered the arming pulse: its gain is {gain_ratio:.2} +- {ci95:.2} of the model's."
            ),
        ),
        EventKind::ArmingRepeated { refusal: why, .. } => (
            Warning,
            format!(
                "The arming pulse was disturbed and is made again ({}).",
                refusal(why)
            ),
        ),
        EventKind::ArmingRefused {
            refusal: why,
            gain_ratio,
            ..
        } => (
            Fault,
            if gain_ratio.is_finite() {
                format!(
                    "Arming was refused: {}; the measured gain is {gain_ratio:.2} of the model's.",
                    refusal(why)
                )
            } else {
                format!("Arming was refused: {}.", refusal(why))
            },
        ),
        EventKind::Running => (Info, text("The loop is closed.")),
        EventKind::CoastingStarted => (Warning, text("No position: the loop runs on prediction.")),
        EventKind::CoastingEnded { lasted_ms } => {
            (Info, format!("Positions are back after {lasted_ms:.1} ms."))
        }
        EventKind::FreezeStarted { reason } => (
            if reason == FreezeReason::Operator {
                Info
            } else {
                Warning
            },
            format!("The bead is being stopped: {}.", freeze_reason(reason)),
        ),
        EventKind::FreezeEnded { lasted_ms } => {
            (Info, format!("Control goes on after {lasted_ms:.0} ms."))
        }
        EventKind::SafeLatched { reason } => (
            if reason == SafeReason::Operator {
                Info
            } else {
                Fault
            },
            format!("The PZT parks: {}.", safe_reason(reason)),
        ),
        EventKind::FramesDropped { count } => (
            Warning,
            format!(
                "{count} {} missing.",
                plural(count, "frame is", "frames are")
            ),
        ),
        EventKind::FrameRepeated { frame_id } => (Warning, format!("Frame {frame_id} came again.")),
        EventKind::FrameStale { age_ms } => (
            Warning,
            format!("A frame was {age_ms:.1} ms old and was not used."),
        ),
        EventKind::FrameFromFuture { ahead_ms } => (
            Warning,
            format!("A frame is stamped with a time {ahead_ms:.1} ms ahead and was not used."),
        ),
        EventKind::FramesEarlyStarted {
            age_ms,
            expected_ms,
        } => (
            Warning,
            format!(
                "Frames are {age_ms:.2} ms old where {expected_ms:.2} ms are expected: is camera_delay_ms right?"
            ),
        ),
        EventKind::FramesEarlyEnded { lasted_ms } => (
            Info,
            format!("Frames come as expected again after {lasted_ms:.0} ms."),
        ),
        EventKind::VisionSlowStarted {
            vision_ms,
            period_ms,
        } => (
            Warning,
            format!("Vision takes {vision_ms:.2} ms for a frame of {period_ms:.2} ms."),
        ),
        EventKind::VisionSlowEnded { lasted_ms } => (
            Info,
            format!("Vision keeps up again after {lasted_ms:.0} ms."),
        ),
        EventKind::CameraRestarted => (Warning, text("The camera began to count its frames anew.")),
        EventKind::BeadReacquired { position_um } => (
            Warning,
            format!(
                "A bead was taken at {position_um:.3} um after the one followed had been lost: it may be another."
            ),
        ),
        EventKind::LateTick { compute_us } => (
            Warning,
            format!("A command was handed over {compute_us:.0} us after its tick began: late."),
        ),
        EventKind::TicksSkipped { count } => (
            Warning,
            format!(
                "{count} {} skipped: the loop was not woken in time.",
                plural(count, "tick was", "ticks were")
            ),
        ),
        EventKind::PlantChanged {
            verdict,
            gain_ratio,
            lag_ms,
        } => (
            Warning,
            if gain_ratio.is_finite() && lag_ms.is_finite() {
                format!(
                    "The plant is {verdict:?}: {gain_ratio:.2} of the model's gain, {lag_ms:.2} ms of lag that it lacks."
                )
            } else {
                format!("The plant is {verdict:?}.")
            },
        ),
        EventKind::StuckStarted => (
            Warning,
            text("The bead does not follow the PZT: it sticks."),
        ),
        EventKind::StuckEnded { lasted_ms } => (
            Info,
            format!("The bead follows again after {lasted_ms:.0} ms."),
        ),
        EventKind::SaturationStarted => (Warning, text("The PZT is at an end of its range.")),
        EventKind::SaturationEnded { lasted_ms } => (
            Info,
            format!("The PZT is off the end of its range after {lasted_ms:.0} ms."),
        ),
        EventKind::BoardChanged { state, fault } => (
            Warning,
            format!("The board reports {state:?}, fault {fault:?}."),
        ),
        EventKind::BoardHeld { count } => (
            Warning,
            format!(
                "Commands had stopped for the board's watchdog, {count} {}: it held the bead by itself, and the loop takes up again.",
                plural(u64::from(count), "time", "times")
            ),
        ),
        EventKind::LinkGarbage { count } => (
            Warning,
            format!(
                "{count} damaged {} on the link.",
                plural(u64::from(count), "message", "messages")
            ),
        ),
        EventKind::DiskSlowStarted {
            unconfirmed_ms,
            rows,
            limit_ms,
        } => (
            Warning,
            format!(
                "The disk has not confirmed what was written for {:.1} s: {rows} rows are in memory only, and a power failure now \
                 would cost them; the run stops after {:.0} s of it.",
                unconfirmed_ms * 1e-3,
                limit_ms * 1e-3
            ),
        ),
        EventKind::DiskSlowEnded { longest_ms } => (
            Info,
            format!(
                "The disk confirms in time again; it took {:.1} s at most.",
                longest_ms * 1e-3
            ),
        ),
        EventKind::Finished => (Info, text("The time is up.")),
        EventKind::Script { stage } => (Info, format!("Script: {}.", stage.name())),
        EventKind::StepSkipped => (Info, text("The operator went on with the next step.")),
    }
}

fn plural(count: u64, one: &'static str, many: &'static str) -> &'static str {
    if count == 1 { one } else { many }
}
