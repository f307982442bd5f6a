//! A recorded run through its loop again.
//!
//! A record holds everything that a tick was given, so a run can be repeated from its first tick on and every command compared to the bit.
//! The loop's own state is not recorded. So a replay ends at a gap (records lost because the recorder ring was full, or a damaged file),
//! and [`Outcome::gap`] says where. Later ticks are counted, not compared.

use crate::board_watch::BoardTrouble;
use crate::core::{Core, TickInput, TickOutput};
use crate::frames::FrameTally;
use crate::life::Request;
use crate::reference::ReferenceGenerator;
use crate::tick_record::{TickFlags, TickRecord};
use cellpos_control::{SolverStatus, SolverTerms};
use cellpos_rig::{ActuatorFault, ActuatorReport, ActuatorState, Measurement, PartnerReport};
use cellpos_vision::{Decision, FixQuality, TrackState};
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

/// Records missing between two that are there; a record that does not begin with tick 0 has one before its first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Gap {
    /// First tick that is missing.
    pub from_seq: u64,
    /// Number of the record found in its place.
    pub found_seq: u64,
}

/// How a replay went.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Outcome {
    /// Records given.
    pub ticks: u64,
    /// Records that were replayed: those before the first gap.
    pub replayed: u64,
    /// Records whose command, estimate, neutral and own columns of the law came out the same to the bit.
    pub identical: u64,
    /// The gap at which the replay ended.
    pub gap: Option<Gap>,
    /// The first that did not.
    pub first_mismatch: Option<Mismatch>,
}

/// Replays records one by one.
#[derive(Debug)]
pub struct Replay<R> {
    core: Core<R>,
    previous: Option<TickRecord>,
    outcome: Outcome,
}

impl<R: ReferenceGenerator> Replay<R> {
    /// A replay through a loop built as the recorded one was.
    pub fn new(core: Core<R>) -> Self {
        Self {
            core,
            previous: None,
            outcome: Outcome {
                ticks: 0,
                replayed: 0,
                identical: 0,
                gap: None,
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
        let expected = match self.previous {
            Some(previous) => previous.seq.wrapping_add(1),
            None => self.core.next_seq(),
        };
        if self.outcome.gap.is_none() && record.seq != expected {
            self.outcome.gap = Some(Gap {
                from_seq: expected,
                found_seq: record.seq,
            });
        }
        if self.outcome.gap.is_some() {
            return;
        }
        self.outcome.replayed += 1;
        let output = self.core.step(&input(record, self.previous.as_ref()));
        self.previous = Some(*record);
        let Some(TickOutput {
            record: replayed, ..
        }) = output
        else {
            // Two ticks in one period of the clock: this loop makes one.
            self.outcome.first_mismatch.get_or_insert(Mismatch {
                seq: record.seq,
                column: "time_ns",
                recorded: record.time_ns as f64,
                replayed: f64::NAN,
            });
            return;
        };
        let columns = [
            ("command_um", record.command_um, replayed.command_um),
            (
                "partner_command_um",
                record.partner_command_um,
                replayed.partner_command_um,
            ),
            ("requested_um", record.requested_um, replayed.requested_um),
            ("estimate_um", record.estimate_um, replayed.estimate_um),
            ("neutral_um", record.neutral_um, replayed.neutral_um),
            ("target_um", record.target_um, replayed.target_um),
            ("error_um", record.error_um, replayed.error_um),
            ("plan_ns", record.plan_ns as f64, replayed.plan_ns as f64),
            ("stage", f64::from(record.stage), f64::from(replayed.stage)),
            ("life", f64::from(record.life), f64::from(replayed.life)),
        ];
        let names = self.core.controller().columns();
        let own = names.iter().zip(record.law.iter().zip(&replayed.law));
        let differing = columns
            .into_iter()
            .find(|(_, a, b)| a.to_bits() != b.to_bits())
            .or_else(|| {
                // A record that was written without these columns has nothing to compare.
                own.map(|(name, (a, b))| (*name, *a, *b))
                    .find(|(_, a, b)| !a.is_nan() && a.to_bits() != b.to_bits())
                    .map(|(name, a, b)| (name, f64::from(a), f64::from(b)))
            });
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
        FixQuality::Good,
        FixQuality::NoSignal,
        FixQuality::BadFit,
        FixQuality::AtBorder,
        FixQuality::NotConverged,
    ]
    .into_iter()
    .find(|verdict| *verdict as u8 == record.verdict)
    .unwrap_or(FixQuality::NoSignal);
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
        length_sd_um: record.length_sd_um,
        area_sd_um2: record.area_sd_um2,
        true_um: record.true_um,
        true_pzt_um: f64::NAN,
    });
    let board = record
        .flags
        .has(TickFlags::BOARD_HEARD)
        .then_some(ActuatorReport {
            state: ActuatorState::from_number(record.board),
            fault: ActuatorFault::from_number(record.board_fault),
            applied_um: record.applied_um,
            session: 0,
            last_seq: None,
            last_time_us: 0,
            device_time_us: 0,
            bad_frames: 0,
            ignored: 0,
            holds: 0,
            read_ns: record.time_ns,
        });
    TickInput {
        time_ns: record.time_ns,
        measurement,
        frames: frames(record),
        previous_late_ns: previous
            .filter(|p| p.flags.has(TickFlags::LATE))
            .map(|p| p.compute_ns),
        slow_vision_ns: record.flags.has(TickFlags::VISION_SLOW).then_some(0),
        board_trouble: record
            .flags
            .has(TickFlags::BOARD_TROUBLE)
            .then_some(BoardTrouble::Foreign),
        previous_refused: previous.is_some_and(|p| p.flags.has(TickFlags::ACTUATOR_RING_FULL)),
        command_lost: record.flags.has(TickFlags::COMMAND_LOST),
        board,
        partner: record
            .flags
            .has(TickFlags::PARTNER_HEARD)
            .then_some(PartnerReport {
                state: ActuatorState::from_number(record.partner),
                applied_um: record.partner_applied_um,
            }),
        request: Request::from_number(record.request),
        // A reference that can be steered took just this; the others ignore it.
        target_um: Some(record.target_um).filter(|um| um.is_finite()),
        solver: SolverTerms::Recorded(
            SolverStatus::from_number(record.solver_status),
            record.solver_iterations,
        ),
    }
}
/// What is known of the frames of a record: whether there were some of a kind, which is all that the loop acts on.
fn frames(record: &TickRecord) -> FrameTally {
    let has = |mask| u32::from(record.flags.has(mask));
    FrameTally {
        arrived: u32::from(record.drained),
        missed: has(TickFlags::DROPPED_FRAME),
        // Of frames that were not new the loop acts on [`TickFlags::STALE`] alone.
        stale: has(TickFlags::STALE),
        ..FrameTally::default()
    }
}
