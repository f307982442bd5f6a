//! The plain record that each tick of the loop hands to the recorder ring.

use crate::life::Life;
use crate::reference_history::ReferenceHistory;
use cellpos_control::LAW_COLUMNS;
use cellpos_vision::FixQuality;

/// What happened in a tick, as bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct TickFlags(pub u32);

impl TickFlags {
    /// The tick was started by the timer: no new frame arrived.
    pub const TIMER: u32 = 1 << 0;
    /// The command was handed over later than the tick's budget.
    pub const LATE: u32 = 1 << 1;
    /// Frames came, but no new one: repeated, older than allowed, or stamped with a time in the future.
    pub const STALE: u32 = 1 << 2;
    /// At least one frame id is missing before this one.
    pub const DROPPED_FRAME: u32 = 1 << 3;
    /// A frame id came twice.
    pub const DOUBLED_FRAME: u32 = 1 << 4;
    /// The frame has no valid bead position.
    pub const LOST: u32 = 1 << 5;
    /// The estimator ran on prediction alone.
    pub const COASTING: u32 = 1 << 6;
    /// The command was clipped to the range.
    pub const RANGE_LIMITED: u32 = 1 << 7;
    /// The command was clipped to the slew limit.
    pub const SLEW_LIMITED: u32 = 1 << 8;
    /// The controller's output was not finite and was replaced.
    pub const NOT_FINITE: u32 = 1 << 9;
    /// A measurement was refused because it was too far from the prediction.
    pub const GATED: u32 = 1 << 10;
    /// The actuator ring was full: the command was not handed over.
    pub const ACTUATOR_RING_FULL: u32 = 1 << 11;
    /// The bead is frozen: the PZT is held at, or moving to, the estimate of neutral.
    pub const FREEZE: u32 = 1 << 12;
    /// Records were lost before this one because the recorder ring was full.
    pub const RECORDS_LOST: u32 = 1 << 13;
    /// A report of the board came since the previous tick.
    pub const BOARD_HEARD: u32 = 1 << 14;
    /// The bead does not follow the flow: it sticks to a wall.
    pub const STUCK: u32 = 1 << 15;

    /// The frame came earlier than expected by more than half a tick: the model behind the loop has another delay.
    pub const EARLY: u32 = 1 << 16;
    /// The board reports, and does not obey.
    pub const BOARD_TROUBLE: u32 = 1 << 17;
    /// No frame was to come in this tick: the loop is faster than its camera.
    pub const BETWEEN: u32 = 1 << 18;

    /// Since the previous tick it became known that a command was lost: the line did not take it, or the board never named it.
    pub const COMMAND_LOST: u32 = 1 << 19;

    /// The bead does not follow the commands beyond a level: the actuator is clipped.
    pub const CLIPPED: u32 = 1 << 20;

    /// A report of the slow partner came since the previous tick.
    pub const PARTNER_HEARD: u32 = 1 << 21;
    /// The slow partner is silent, parked or does not obey: the PZT is alone.
    pub const PARTNER_LOST: u32 = 1 << 22;
    /// The slow partner is at an end of its range.
    pub const PARTNER_LIMITED: u32 = 1 << 23;

    /// Vision takes longer for a frame than the camera.
    pub const VISION_SLOW: u32 = 1 << 24;

    /// Whether all bits of `mask` are set.
    pub fn has(self, mask: u32) -> bool {
        self.0 & mask == mask
    }

    /// Sets the bits of `mask`.
    pub fn set(&mut self, mask: u32) {
        self.0 |= mask;
    }
}

/// Counts of the loop up to this tick that its flags do not give, for displays of a run that is going on. They have no column.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct TickCounts {
    /// Ticks that never came.
    pub skipped: u64,
    /// Frames lost on the way.
    pub frames_lost: u64,
    /// Stale frames.
    pub stale: u64,
}

/// Everything about one tick, in a fixed size. Times are nanoseconds since the start of the run.
///
/// A number that does not exist (no bead in the frame, no truth on a real rig) is NaN.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TickRecord {
    /// Sequence number; runs on when records are lost, so that a gap shows.
    pub seq: u64,
    /// Start of the tick.
    pub time_ns: i64,
    /// Unwrapped id of the frame used, or of the last one seen on a timer tick.
    pub frame_id: u64,
    /// Mid-exposure time of that frame.
    pub mid_exposure_ns: i64,
    /// Measured bead position, um.
    pub measured_um: f64,
    /// Variance of the measured position, um^2.
    pub variance_um2: f64,
    /// Verdict of vision ([`cellpos_vision::FixQuality`] as a number; 255: no frame).
    pub verdict: u8,
    /// State of the tracker ([`cellpos_vision::TrackState`] as a number; 255: no frame, or no tracker).
    pub track: u8,
    /// What the tracker decided of the frame ([`cellpos_vision::Decision`] as a number; 255: no frame, or no tracker).
    pub decision: u8,
    /// Reference, um.
    pub target_um: f64,
    /// Measured position less the reference at the exposure of its frame, um; NaN without a good position.
    pub error_um: f64,
    /// Time of the script's plan, ns; -1 without a script. It stands still while the script waits for a condition or the bead is frozen.
    pub plan_ns: i64,
    /// Activity of the script (number of [`crate::Stage`]).
    pub stage: u8,
    /// Measured length of the cell, um.
    pub length_um: f64,
    /// Measured projected area of the cell, um^2.
    pub area_um2: f64,
    /// Standard deviation of `length_um`, um.
    pub length_sd_um: f64,
    /// Standard deviation of `area_um2`, um^2.
    pub area_sd_um2: f64,
    /// Estimated bead position at the tick, um.
    pub estimate_um: f64,
    /// Standard deviation of that estimate, um.
    pub estimate_sd_um: f64,
    /// Estimated PZT displacement at which the bead is at rest, um.
    pub neutral_um: f64,
    /// Output of the controller before the limits, um.
    pub requested_um: f64,
    /// Commanded PZT displacement, um.
    pub command_um: f64,
    /// PZT displacement last reported by the board, um.
    pub applied_um: f64,
    /// True bead position at the tick, um (emulated rig only).
    pub true_um: f64,
    /// Life-cycle state (number of the runtime's state).
    pub life: u8,
    /// What the operator or the program asked for at this tick (number of the runtime's request).
    pub request: u8,
    /// State that the board last reported (number of the link's board state; 255: none yet).
    pub board: u8,
    /// Latched fault that the board last reported (number of the link's fault; 0: none).
    pub board_fault: u8,
    /// Command of the slow partner in force, um on the partner's scale; NaN without one.
    pub partner_command_um: f64,
    /// Newest reported position of the slow partner, um on the partner's scale.
    pub partner_applied_um: f64,
    /// Effect of the slow partner on the flow as the loop reckons it, um of PZT.
    pub partner_effect_um: f64,
    /// State that the slow partner last reported (as `board`; 255: none).
    pub partner: u8,
    /// What happened.
    pub flags: TickFlags,
    /// Frames that came since the previous tick, at most 255 (one is used, the rest counted).
    pub drained: u8,
    /// From the due time to the start of the tick, ns; 0 on the virtual clock.
    pub wake_ns: u32,
    /// From the start of the tick to the hand-over of the command, ns; 0 on the virtual clock.
    pub compute_ns: u32,
    /// Age of a command that the board has reported since the previous tick, from the start of the command's tick to the start of this
    /// one, us. Of several commands it is the one that was longest on its way. NaN without a new one.
    pub obeyed_before_us: f64,
    /// The board's clock when it had that command, us. Only differences tell: its zero is the board's.
    pub obeyed_at_us: f64,
    /// How the optimiser ended (number of [`cellpos_control::SolverStatus`]; 0: none in use).
    pub solver_status: u8,
    /// Its iterations, at most 255.
    pub solver_iterations: u8,
    /// Constraints active at its solution, at most 255.
    pub solver_active: u8,
    /// Time it took, ns; 0 on the virtual clock.
    pub solver_ns: u32,
    /// The control law's own columns after the tick, named by [`cellpos_control::Controller::columns`]; NaN where there is
    /// none.
    pub law: [f32; LAW_COLUMNS],
    /// Counts so far; zeros in a row that is read from a folder.
    pub counts: TickCounts,
}

impl TickRecord {
    /// Whether the loop was closed.
    pub fn is_running(&self) -> bool {
        self.life == Life::Running as u8
    }

    /// Whether the loop was closed and the bead not frozen: its command answers its position.
    pub fn is_controlled(&self) -> bool {
        self.is_running() && !self.flags.has(TickFlags::FREEZE)
    }

    /// [`TickRecord::error_um`], from the references up to this tick.
    pub fn error_at_exposure_um(&self, references: &ReferenceHistory) -> f64 {
        if self.verdict == FixQuality::Good as u8 {
            self.measured_um - references.at(self.mid_exposure_ns)
        } else {
            f64::NAN
        }
    }

    /// A record in which nothing is known: what a missing column reads as.
    pub fn unknown() -> Self {
        Self {
            seq: 0,
            time_ns: 0,
            frame_id: 0,
            mid_exposure_ns: 0,
            measured_um: f64::NAN,
            variance_um2: f64::NAN,
            verdict: 255,
            track: 255,
            decision: 255,
            target_um: f64::NAN,
            error_um: f64::NAN,
            estimate_um: f64::NAN,
            estimate_sd_um: f64::NAN,
            neutral_um: f64::NAN,
            requested_um: f64::NAN,
            command_um: f64::NAN,
            applied_um: f64::NAN,
            true_um: f64::NAN,
            life: 0,
            request: 0,
            board: 255,
            board_fault: 0,
            partner_command_um: f64::NAN,
            partner_applied_um: f64::NAN,
            partner_effect_um: f64::NAN,
            partner: 255,
            flags: TickFlags(0),
            drained: 0,
            wake_ns: 0,
            compute_ns: 0,
            obeyed_before_us: f64::NAN,
            obeyed_at_us: f64::NAN,
            solver_status: 0,
            solver_iterations: 0,
            solver_active: 0,
            solver_ns: 0,
            plan_ns: -1,
            stage: 0,
            length_um: f64::NAN,
            area_um2: f64::NAN,
            length_sd_um: f64::NAN,
            area_sd_um2: f64::NAN,
            law: [f32::NAN; LAW_COLUMNS],
            counts: TickCounts::default(),
        }
    }
}
