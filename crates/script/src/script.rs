//! Content of a script. Reading it from a file: `read.rs`.

use crate::sample::Sample;
use std::ops::Range;

/// Profile of a move from one position to another.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MoveShape {
    /// Constant velocity.
    ConstantVelocity,
    /// Fifth-order polynomial: velocity and acceleration zero at both ends.
    MinimumJerk,
    /// Raised-cosine velocity: x = t - sin(2 pi t) / (2 pi).
    SCurve,
}

/// Shapes of periodic motion; each starts and ends at its centre.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WaveShape {
    /// Sine.
    Sine,
    /// Triangle: constant speed between the peaks.
    Triangle,
    /// Trapezoid: a triangle of twice the amplitude, cut at the amplitude.
    Trapezoid,
}

impl WaveShape {
    /// Its name in a script.
    pub fn name(self) -> &'static str {
        match self {
            Self::Sine => "sine",
            Self::Triangle => "triangle",
            Self::Trapezoid => "trapezoid",
        }
    }
}

/// The condition of a wait.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Condition {
    /// The error stays within a band for a time.
    Settled {
        /// Half width of the band, um.
        within_um: f64,
        /// For how long, s.
        during_s: f64,
    },
    /// The measured position is above (or below) a level.
    Position {
        /// The level, um.
        level_um: f64,
        /// Above it, else below.
        above: bool,
    },
    /// The measured length of the cell is above (or below) a level.
    CellLength {
        /// The level, um.
        level_um: f64,
        /// Above it, else below.
        above: bool,
    },
}

/// The action if a wait takes too long.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum OnTimeout {
    /// The script stops.
    #[default]
    Stop,
    /// The script continues.
    Continue,
}

/// Order of a sweep's values.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Order {
    /// As listed.
    #[default]
    Listed,
    /// From the last to the first.
    Reversed,
    /// Shuffled with the seed.
    Random,
}

/// Load of a static control arm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Load {
    /// The time mean of the cyclic arm's position.
    #[default]
    Mean,
    /// The cyclic arm's position furthest from its start.
    Peak,
}

/// Stop conditions of a script.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Stop {
    /// No bead or cell seen for longer than this, s.
    pub lost_longer_than_s: Option<f64>,
    /// Tracking error above this, um.
    pub error_above_um: Option<f64>,
    /// Mean amplitude error of ten cycles above this, as a share of the commanded amplitude. Judged on the rows of the
    /// per-cycle table by [`crate::AmplitudeWatch`], not by a [`crate::Cursor`].
    pub amplitude_error_above: Option<f64>,
    /// Length of the cell changed by more than this since the first frame, um.
    pub length_change_above_um: Option<f64>,
    /// Mean stretch of ten cycles below that of the first ten by this share. This and the next two are judged on the
    /// rows of the per-cycle table, see [`crate::FatigueWatch`].
    pub stretch_down: Option<f64>,
    /// Mean length of the cell at the start of ten cycles away from that of the first ten by this share, up or down.
    pub rest_length_change: Option<f64>,
    /// Mean recovery time of ten cycles above this, s.
    pub recovery_above_s: Option<f64>,
    /// Running time, waits included, s.
    pub after_s: Option<f64>,
    /// Cycles completed.
    pub after_cycles: Option<u64>,
}

/// The clips of the camera's picture to keep.
#[derive(Debug, Clone, PartialEq)]
pub struct ClipWishes {
    /// Cycles, from 1.
    pub cycles: Vec<u64>,
    /// Phases, as fractions of a cycle.
    pub phases: Vec<f64>,
    /// Time before the moment, s.
    pub before_s: f64,
    /// Time behind it, s.
    pub after_s: f64,
    /// Largest size of all clips together, MB.
    pub most_mb: u64,
    /// Whether to keep clips of events too (bead lost, freeze, Safe).
    pub events: bool,
}

impl Default for ClipWishes {
    fn default() -> Self {
        Self {
            cycles: vec![],
            phases: vec![0.5],
            before_s: 0.25,
            after_s: 0.25,
            most_mb: 200,
            events: true,
        }
    }
}

/// One step of a script, with its place in the file.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// What is done.
    pub kind: StepKind,
    /// Name by which a control arm refers to it.
    pub label: Option<String>,
    /// Line in the file, from 1.
    pub line: usize,
    pub(crate) span: Range<usize>,
}

/// The action of a step. Positions are those of the bead, um; each step starts at the end of the step before.
#[derive(Debug, Clone, PartialEq)]
pub enum StepKind {
    /// Stay.
    Hold {
        /// For how long, s.
        duration_s: f64,
    },
    /// Go to a position.
    Move {
        /// Where to, um.
        to_um: f64,
        /// How long it takes, s; None: from the speed.
        duration_s: Option<f64>,
        /// Mean speed, um/s; None: from the duration.
        speed_um_per_s: Option<f64>,
        /// How.
        shape: MoveShape,
    },
    /// Periodic motion about the present position.
    Wave {
        /// Shape.
        shape: WaveShape,
        /// Amplitude (half of peak to peak), um.
        amplitude_um: f64,
        /// Frequency, Hz.
        frequency_hz: f64,
        /// Number of cycles.
        cycles: u64,
        /// Cycles over which the amplitude grows.
        ramp_in: u64,
        /// Cycles over which it falls.
        ramp_out: u64,
    },
    /// Periodic motion given by points (time s, displacement um) from the present position.
    Waveform {
        /// The points; the first at 0 s and 0 um.
        points: Vec<(f64, f64)>,
        /// Number of cycles.
        cycles: u64,
    },
    /// The steps several times over.
    Repeat {
        /// How often.
        times: u64,
        /// What.
        steps: Vec<Step>,
    },
    /// Steps one after the other, a pass for each value: a sweep written out.
    Sweep(Vec<Vec<Step>>),
    /// Hold until a condition is met.
    Wait {
        /// The condition.
        condition: Condition,
        /// Longest time, s.
        timeout_s: f64,
        /// What then.
        on_timeout: OnTimeout,
    },
    /// Note in the record.
    Mark {
        /// The text.
        text: String,
    },
    /// Static control: as long as a labelled step, at its load, without cycles.
    Static {
        /// Label of its cyclic step.
        like: String,
        /// Which load.
        load: Load,
    },
}

/// A setpoint script, read and checked for form (not yet against a rig: see [`crate::check()`]).
#[derive(Debug, Clone, PartialEq)]
pub struct Script {
    /// The file, for messages.
    pub file: String,
    /// The text, for messages.
    pub text: String,
    /// Name of the run.
    pub name: String,
    /// Free text, kept with the run.
    pub notes: String,
    /// Content of the channel; missing values come from the rig file.
    pub sample: Sample,
    /// Position at which the script starts, um.
    pub start_um: f64,
    /// Whether the feed-forward of its periodic motions is learned over their cycles.
    pub learn: bool,
    /// Stop conditions.
    pub stop: Stop,
    /// Clips to keep, besides those of events.
    pub clips: Option<ClipWishes>,
    /// The steps.
    pub steps: Vec<Step>,
}
