//! A recorded run through its loop again.
//!
//! A record holds everything that a tick was given, so the tick can be repeated and its command compared to the bit.
//! Behind a gap (records lost because the recorder ring was full, or a file cut off) the loop's own state is not
//! known; the rest of such a run is counted as not replayed rather than compared with something else.

use crate::core::{Core, TickInput};
use crate::guide::Guide;
use crate::life::Request;
use crate::tick_record::{TickFlags, TickRecord};
use cellpos_control::{SolverStatus, SolverTerms};
use cellpos_link::{BoardState, Fault};
use cellpos_rig::{BoardReport, Measurement};
use cellpos_vision::{Decision, TrackState, Verdict};
use serde::Serialize;

/// The first difference between a record and its replay.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Mismatch {
    /// Tick.
    pub seq: u64,
    /// Column.
    pub column: &'static str,
    /// Value in the record.
    pub recorded: f64,
    /// Value of the replay.
    pub replayed: f64,
}

/// How a replay went.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Outcome {
    /// Records given.
    pub ticks: u64,
    /// Records whose command, estimate, neutral and state came out the same to the bit.
    pub identical: u64,
    /// The first that did not.
    pub first_mismatch: Option<Mismatch>,
}

/// Replays records one by one.
#[derive(Debug)]
pub struct Replay<R> {
    core: Core<R>,
    previous: Option<TickRecord>,
    broken: bool,
    outcome: Outcome,
}

impl<R: Guide> Replay<R> {
    /// A replay through a loop built as the recorded one was.
    pub fn new(core: Core<R>) -> Self {
        Self {
            core,
            previous: None,
            broken: false,
            outcome: Outcome {
                ticks: 0,
                identical: 0,
                first_mismatch: None,
            },
        }
    }

    /// How it went so far.
    pub fn outcome(&self) -> Outcome {
        self.outcome
    }

    /// Replays the next record.
    pub fn add(&mut self, record: &TickRecord) {
        self.outcome.ticks += 1;
        let expected = self.previous.map_or(0, |previous| previous.seq + 1);
        if record.seq != expected {
            self.broken = true;
        }
        if self.broken {
            return;
        }
        let output = self.core.step(&input(record, self.previous.as_ref()));
        self.previous = Some(*record);
        let replayed = output.record;
        let columns = [
            ("command_um", record.command_um, replayed.command_um),
            ("requested_um", record.requested_um, replayed.requested_um),
            ("estimate_um", record.estimate_um, replayed.estimate_um),
            ("neutral_um", record.neutral_um, replayed.neutral_um),
            ("target_um", record.target_um, replayed.target_um),
            ("plan_ns", record.plan_ns as f64, replayed.plan_ns as f64),
            ("stage", f64::from(record.stage), f64::from(replayed.stage)),
            ("life", f64::from(record.life), f64::from(replayed.life)),
        ];
        let states = record
            .controller_state
            .iter()
            .zip(&replayed.controller_state);
        let differing = columns
            .into_iter()
            .chain(states.map(|(a, b)| ("controller_state", *a, *b)))
            .find(|(_, a, b)| a.to_bits() != b.to_bits());
        match differing {
            None => self.outcome.identical += 1,
            Some((column, recorded, replayed)) => {
                self.outcome.first_mismatch.get_or_insert(Mismatch {
                    seq: record.seq,
                    column,
                    recorded,
                    replayed,
                });
            }
        }
    }
}

/// What the tick of a record was given.
fn input(record: &TickRecord, previous: Option<&TickRecord>) -> TickInput {
    let verdict = [
        Verdict::Good,
        Verdict::NoSignal,
        Verdict::BadFit,
        Verdict::AtBorder,
        Verdict::NotConverged,
    ]
    .into_iter()
    .find(|verdict| *verdict as u8 == record.verdict)
    .unwrap_or(Verdict::NoSignal);
    let measurement = (!record.flags.has(TickFlags::TIMER)).then_some(Measurement {
        frame_id: record.frame_id,
        mid_exposure_ns: record.mid_exposure_ns,
        ready_ns: record.time_ns,
        position_um: record.measured_um,
        variance_um2: record.variance_um2,
        verdict,
        track: TrackState::from_number(record.track).zip(Decision::from_number(record.decision)),
        snr: f64::NAN,
        length_um: record.length_um,
        area_um2: record.area_um2,
        true_um: record.true_um,
        true_pzt_um: f64::NAN,
    });
    let board = record
        .flags
        .has(TickFlags::BOARD_HEARD)
        .then_some(BoardReport {
            state: board_state(record.board),
            fault: board_fault(record.board_fault),
            applied_um: record.applied_um,
            last_seq: None,
            last_time_us: 0,
            bad_frames: 0,
            read_ns: record.time_ns,
        });
    TickInput {
        time_ns: record.time_ns,
        measurement,
        drained: u32::from(record.drained),
        previous_late_ns: previous
            .filter(|p| p.flags.has(TickFlags::LATE))
            .map(|p| p.compute_ns),
        previous_refused: previous.is_some_and(|p| p.flags.has(TickFlags::ACTUATOR_RING_FULL)),
        board,
        request: Request::from_number(record.request),
        solver: SolverTerms::Recorded(SolverStatus::from_number(record.solver_status)),
    }
}

fn board_state(number: u8) -> BoardState {
    [
        BoardState::Disarmed,
        BoardState::Armed,
        BoardState::Running,
        BoardState::Frozen,
    ]
    .into_iter()
    .find(|state| *state as u8 == number)
    .unwrap_or(BoardState::Safe)
}

fn board_fault(number: u8) -> Fault {
    [
        Fault::CommandTimeout,
        Fault::FreezeTimeout,
        Fault::ArmTimeout,
    ]
    .into_iter()
    .find(|fault| *fault as u8 == number)
    .unwrap_or(Fault::None)
}
