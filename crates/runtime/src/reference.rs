//! Who says, tick by tick, where the bead is to be.
//!
//! Every [`Reference`] is a reference generator: a function of the time since the loop was closed. A script is a generator with a state:
//! its clock stands still while the bead is frozen or the script waits for a condition, and it has an end. The tick calls it, so it
//! allocates nothing, takes no lock and cannot panic. Its answer depends on its inputs alone, so that a run replays to the bit.

use cellpos_control::{Reference, fill_preview};
use serde::Serialize;

/// Input of a reference generator at a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReferenceInput {
    /// Whether the loop is closed.
    pub running: bool,
    /// Whether the bead is frozen: by the operator, or because it was not seen for too long.
    pub frozen: bool,
    /// The operator asks to go on with the next step.
    pub skip: bool,
    /// Ticks since the loop was closed; 0 while it is not.
    pub tick: u64,
    /// Sample time, s.
    pub sample_s: f64,
    /// Measured position, um; `None`: no fresh one.
    pub position_um: Option<f64>,
    /// Age of the measured position in ticks, beyond the camera's usual delay.
    pub age_ticks: u16,
    /// Measured length of the cell, um.
    pub length_um: Option<f64>,
    /// Where the operator wants the bead, um; `None`: the operator has said nothing.
    pub target_um: Option<f64>,
}

/// Activity of a script.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "kebab-case")]
#[repr(u8)]
pub enum Stage {
    /// There is no script, or the loop is not closed.
    #[default]
    None = 0,
    /// The bead is on its way to the place at which the script begins or continues.
    Approach = 1,
    /// By the plan.
    Running = 2,
    /// Until a condition is met.
    Waiting = 3,
    /// The plan's clock stands still because the bead is frozen.
    Paused = 4,
    /// At the end of the plan.
    Done = 5,
    /// Stopped: the bead was not seen for too long.
    StoppedLost = 10,
    /// Stopped: the tracking error was too large.
    StoppedError = 11,
    /// Stopped: the cell's length changed too much.
    StoppedLength = 12,
    /// Stopped: the time was up.
    StoppedTime = 13,
    /// Stopped: the cycles were done.
    StoppedCycles = 14,
    /// Stopped: a wait took too long.
    StoppedWait = 15,
}

impl Stage {
    /// The stage of a number in a record.
    pub fn from_number(number: u8) -> Self {
        [
            Self::Approach,
            Self::Running,
            Self::Waiting,
            Self::Paused,
            Self::Done,
            Self::StoppedLost,
            Self::StoppedError,
            Self::StoppedLength,
            Self::StoppedTime,
            Self::StoppedCycles,
            Self::StoppedWait,
        ]
        .into_iter()
        .find(|stage| *stage as u8 == number)
        .unwrap_or(Self::None)
    }

    /// In words.
    pub fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Approach => "approach",
            Self::Running => "running",
            Self::Waiting => "waiting",
            Self::Paused => "paused",
            Self::Done => "done",
            Self::StoppedLost => "stopped: not seen for too long",
            Self::StoppedError => "stopped: tracking error too large",
            Self::StoppedLength => "stopped: length changed too much",
            Self::StoppedTime => "stopped: time is up",
            Self::StoppedCycles => "stopped: cycles are done",
            Self::StoppedWait => "stopped: a wait took too long",
        }
    }

    /// Whether the script is over.
    pub fn is_over(self) -> bool {
        self as u8 >= Self::Done as u8
    }
}

/// What a reference generator answers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReferenceOutput {
    /// Where the bead is to be now, um.
    pub reference_um: f64,
    /// Time of the plan, ns; -1 without a script.
    pub plan_ns: i64,
    /// Activity of the script.
    pub stage: Stage,
    /// Phase of a periodic reference in cycles, `None` while it is not periodic: what learning is laid on. The same
    /// motion must have the same phase each time, and the phase must advance by the same amount at each tick.
    pub phase: Option<f64>,
    /// Number of the periodic motion that the phase is of; 0 for a generator that has one only.
    pub motion: u16,
}

/// Says where the bead is to be.
pub trait ReferenceGenerator {
    /// One tick: the reference now, and in `preview_um` that of the ticks to come, the next one first.
    fn step(&mut self, input: &ReferenceInput, preview_um: &mut [f64]) -> ReferenceOutput;

    /// What to add to the controller's command at the tick just stepped, um of PZT displacement: an excitation for
    /// identification. Added only while the loop controls.
    fn excitation_um(&self) -> f64 {
        0.0
    }

    /// Whether the run may end.
    fn finished(&self) -> bool {
        false
    }
}

impl<R: Reference> ReferenceGenerator for R {
    fn step(&mut self, input: &ReferenceInput, preview_um: &mut [f64]) -> ReferenceOutput {
        fill_preview(self, input.tick, input.sample_s, preview_um);
        ReferenceOutput {
            reference_um: self.at_um(input.tick as f64 * input.sample_s),
            plan_ns: -1,
            stage: Stage::None,
            motion: 0,
            phase: if input.running {
                self.phase(input.tick as f64 * input.sample_s)
            } else {
                None
            },
        }
    }
}

/// A position that the operator may move during the run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Steered {
    target_um: f64,
}

impl Steered {
    /// Begins at a position, um.
    pub fn new(target_um: f64) -> Self {
        Self { target_um }
    }
}

impl ReferenceGenerator for Steered {
    fn step(&mut self, input: &ReferenceInput, preview_um: &mut [f64]) -> ReferenceOutput {
        self.target_um = input.target_um.unwrap_or(self.target_um);
        preview_um.fill(self.target_um);
        ReferenceOutput {
            reference_um: self.target_um,
            plan_ns: -1,
            stage: Stage::None,
            motion: 0,
            phase: None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_control::Profile;

    #[test]
    fn a_reference_is_given_by_the_time_since_the_loop_was_closed() {
        let mut ramp = Profile::Ramp {
            from_um: 0.0,
            to_um: 10.0,
            duration_s: 1.0,
        };
        let input = ReferenceInput {
            running: true,
            frozen: false,
            skip: false,
            tick: 500,
            sample_s: 1e-3,
            position_um: None,
            age_ticks: 0,
            length_um: None,
            target_um: None,
        };
        let mut preview = [0.0; 2];
        let output = ReferenceGenerator::step(&mut ramp, &input, &mut preview);
        assert_eq!((output.plan_ns, output.stage), (-1, Stage::None));
        assert!((output.reference_um - 5.0).abs() < 1e-12);
        assert!((preview[1] - 5.02).abs() < 1e-12);
        assert!(!ReferenceGenerator::finished(&ramp));
    }

    #[test]
    fn a_stage_survives_its_number() {
        for number in 0..=255 {
            let stage = Stage::from_number(number);
            assert!(stage == Stage::None || stage as u8 == number);
        }
        assert!(Stage::StoppedWait.is_over() && Stage::Done.is_over());
        assert!(!Stage::Paused.is_over());
    }
}
