//! Life cycle of a run, and the events that mark its way.
//!
//! Disarmed -> Armed -> Running -> Safe. Safe is latched: only a new run, with a new arming of the board, leaves it.
//! Freezing (slew to the estimate of neutral, so that the bead all but stops) is a mode within Running and is left
//! when its cause goes away; safe (ramp to park: the bead is lost, the hardware is not) is not.

use crate::reference::Stage;
use cellpos_rig::{ActuatorFault, ActuatorState};
use serde::{Deserialize, Serialize};

/// Where a run stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
#[repr(u8)]
pub enum Life {
    /// No session: the board is at park or on its way there.
    Disarmed = 0,
    /// The board follows; the bead is being found and the plant's sign and gain are being checked.
    Armed = 1,
    /// The loop is closed.
    Running = 2,
    /// Latched: the board ramps to park.
    Safe = 3,
}

impl Life {
    /// The state of a number in a record.
    pub fn from_number(number: u8) -> Option<Self> {
        [Self::Disarmed, Self::Armed, Self::Running, Self::Safe]
            .into_iter()
            .find(|life| *life as u8 == number)
    }

    /// Its name, as in JSON.
    pub fn name(self) -> &'static str {
        match self {
            Self::Disarmed => "disarmed",
            Self::Armed => "armed",
            Self::Running => "running",
            Self::Safe => "safe",
        }
    }
}

/// What the operator or the program asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "kebab-case")]
#[repr(u8)]
pub enum Request {
    /// Nothing: go on.
    #[default]
    None = 0,
    /// Stop the bead at its place.
    Freeze = 1,
    /// Ramp to park.
    Park = 2,
    /// Go on with the script's next step; holds for one tick.
    Skip = 3,
    /// Stop the bead at its place until the next request; does not end the run.
    Pause = 4,
    /// The run is no longer being recorded: stop the bead at its place, then ramp to park.
    Unrecorded = 5,
}

impl Request {
    /// Whether the bead is to stop at its place.
    pub(crate) fn stops(self) -> bool {
        matches!(self, Self::Freeze | Self::Pause)
    }

    /// The request of a number in a record; anything unknown is the safest, [`Request::Park`].
    pub fn from_number(number: u8) -> Self {
        match number {
            0 => Self::None,
            1 => Self::Freeze,
            3 => Self::Skip,
            4 => Self::Pause,
            5 => Self::Unrecorded,
            _ => Self::Park,
        }
    }
}

/// Why Safe was latched.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SafeReason {
    /// The operator asked for park.
    Operator,
    /// No bead for longer than allowed, though frames came.
    BeadLost,
    /// No frames for longer than allowed.
    CameraLost,
    /// Frames that were old or repeated, too many in a row.
    StaleFrames,
    /// The bead moved against the commands: a wrong sign, a gain far off, an actuator that does not follow.
    NotFollowing,
    /// Frames grew old because vision takes longer for one than the camera.
    VisionSlow,
    /// Commands handed over late, too many in a row.
    LateTicks,
    /// The controller's output was not a finite number.
    NotFinite,
    /// The board went safe, disarmed or was armed by another host.
    Board,
    /// Nothing was heard of the board for longer than allowed.
    LinkLost,
    /// The board was armed by another host.
    BoardForeign,
    /// The board obeyed no command any more, though it talked.
    BoardNotObeying,
    /// The board's output did not stand where the commands were.
    BoardNotFollowing,
    /// The loop stood still for so long that the commands no longer say where the bead is.
    Stalled,
    /// The plant did not answer the arming pulse as the model says.
    ArmingRefused,
    /// The run could no longer be recorded: the recorder died, its disk refused, or it fell behind.
    Unrecorded,
}

/// Why the bead is frozen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum FreezeReason {
    /// The operator asked for it.
    Operator,
    /// No bead in the frames.
    BeadLost,
    /// No frames.
    CameraStalled,
    /// The camera gives the same picture again and again.
    PictureFrozen,
    /// The bead moves against the commands.
    NotFollowing,
    /// The run is no longer being recorded.
    Unrecorded,
    /// Commands do not reach the board, or its reports do not come.
    LineStalled,
    /// Vision takes longer for a frame than the camera, and frames are too old when it has finished.
    VisionSlow,
}

/// Why arming was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Refusal {
    /// No steady bead was seen in the time given.
    NoBead,
    /// The bead was seen in too little of the pulse.
    LostInPulse,
    /// The bead did not move with the PZT beyond its own noise.
    NoResponse,
    /// The bead moved the other way.
    WrongSign,
    /// The gain is outside the range that the controller is safe for.
    WrongGain,
    /// Ticks or frames were so irregular in every pulse that the answers say nothing.
    Disturbed,
}

impl Refusal {
    /// Whether there was no bead, or no longer: with another one in view arming may succeed.
    pub fn lacks_a_bead(self) -> bool {
        matches!(self, Self::NoBead | Self::LostInPulse)
    }
}

/// What happened. Times in milliseconds, positions in micrometres.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(
    tag = "event",
    rename_all = "kebab-case",
    rename_all_fields = "snake_case"
)]
pub enum EventKind {
    /// The board is armed; the bead is being looked for.
    Armed,
    /// The plant answered the pulse: its gain over the model's, with the 95 % interval.
    ArmingPassed {
        /// Measured gain over the model's.
        gain_ratio: f64,
        /// Half width of its 95 % interval.
        ci95: f64,
    },
    /// A refusal is in doubt (skipped ticks, late frames, a wide interval): the pulse is made again and fitted together with this one.
    ArmingRepeated {
        /// What a regular answer would have meant.
        refusal: Refusal,
        /// Measured gain over the model's; NaN when none was measured.
        gain_ratio: f64,
        /// Half width of its 95 % interval.
        ci95: f64,
    },
    /// What was seen did not move with the PZT: another bead is looked for.
    ArmingRejected {
        /// Measured gain over the model's.
        gain_ratio: f64,
        /// Half width of its 95 % interval.
        ci95: f64,
    },
    /// The plant did not answer the pulse as the model says.
    ArmingRefused {
        /// Why.
        refusal: Refusal,
        /// Measured gain over the model's; NaN when none was measured.
        gain_ratio: f64,
        /// Half width of its 95 % interval.
        ci95: f64,
    },
    /// The loop is closed.
    Running,
    /// No usable position: the loop runs on prediction.
    CoastingStarted,
    /// Positions are back.
    CoastingEnded {
        /// How long it ran on prediction.
        lasted_ms: f64,
    },
    /// The bead is being stopped.
    FreezeStarted {
        /// Why.
        reason: FreezeReason,
    },
    /// Control continues.
    FreezeEnded {
        /// How long it lasted.
        lasted_ms: f64,
    },
    /// Safe is latched.
    SafeLatched {
        /// Why.
        reason: SafeReason,
    },
    /// Frames are missing; a frame that comes late after all leaves the count again.
    FramesDropped {
        /// How many.
        count: u64,
    },
    /// A frame came twice, or after a newer one.
    FrameRepeated {
        /// Its id; of several in a tick, the last one's.
        frame_id: u64,
    },
    /// A frame with a new id is older than allowed, or its time stamp does not advance.
    FrameStale {
        /// Age of the exposure; of several, the oldest.
        age_ms: f64,
    },
    /// Frames are stamped with a time that has not come.
    FrameFromFuture {
        /// By how much the worst frame.
        ahead_ms: f64,
    },
    /// Frames come earlier than expected by more than half a tick: the camera path is shorter than `camera_delay_ms` says.
    FramesEarlyStarted {
        /// Age of the exposure.
        age_ms: f64,
        /// Age expected.
        expected_ms: f64,
    },
    /// Frames come when they are expected again.
    FramesEarlyEnded {
        /// How long they came early.
        lasted_ms: f64,
    },
    /// Vision takes longer for a frame than the camera: frames pile up and grow old.
    VisionSlowStarted {
        /// Mean time for a frame.
        vision_ms: f64,
        /// Time from frame to frame.
        period_ms: f64,
    },
    /// Vision keeps up again.
    VisionSlowEnded {
        /// How long it did not.
        lasted_ms: f64,
    },
    /// The camera restarted its count of frames. Frames lost meanwhile are not known by number.
    CameraRestarted,
    /// Noise, focus or blur come near the end of the range that the settings of vision hold for.
    NearLimit,
    /// Vision took a bead after the one followed had been lost: like it in size and brightness, but it may be another.
    BeadReacquired {
        /// Where.
        position_um: f64,
    },
    /// The command was handed over late.
    LateTick {
        /// From the start of the tick to the hand-over, us.
        compute_us: f64,
    },
    /// Ticks were skipped: the loop was not woken in time.
    TicksSkipped {
        /// How many.
        count: u64,
    },
    /// The loop was tuned to another gain or delay of the plant.
    Adapted {
        /// Estimated gain over the model's when a change was reported last; 1 at the start.
        gain_before: f64,
        /// Estimated gain now.
        gain: f64,
        /// Delay beyond the model's that it was tuned to, ms.
        delay_before_ms: f64,
        /// Delay that it is tuned to.
        delay_ms: f64,
        /// Time that the change took, s.
        over_s: f64,
    },
    /// The bead does not follow the PZT.
    StuckStarted,
    /// It follows again.
    StuckEnded {
        /// How long it did not.
        lasted_ms: f64,
    },
    /// The PZT is at an end of its range.
    SaturationStarted,
    /// It is off the end.
    SaturationEnded {
        /// How long it was there.
        lasted_ms: f64,
    },
    /// The bead seemed to move against the commands: the loop let go of it for some ticks, to see whether it then stops.
    LoopPaused {
        /// Times since the last such event.
        count: u32,
    },
    /// The bead follows the commands up to a level and no further: amplifier, supply or PZT is clipped.
    ActuatorClipped {
        /// The level, about, um of PZT.
        level_um: f64,
    },
    /// The board reports another state or fault.
    BoardChanged {
        /// State.
        #[serde(serialize_with = "as_debug")]
        state: ActuatorState,
        /// Latched fault.
        #[serde(serialize_with = "as_debug")]
        fault: ActuatorFault,
    },
    /// Commands had stopped for the board's watchdog: it went to the zero-flow displacement and held it. The loop has
    /// taken up again, or will with the next command.
    BoardHeld {
        /// Times since the last such event.
        count: u16,
    },
    /// The slow partner is silent, parked or does not obey: the run continues within the PZT's stroke.
    PartnerLost,
    /// It takes commands again.
    PartnerBack {
        /// How long it did not.
        lasted_ms: f64,
    },
    /// The slow partner is at an end of its range.
    PartnerLimitStarted,
    /// It is off the end.
    PartnerLimitEnded {
        /// How long it was there.
        lasted_ms: f64,
    },
    /// Frames on the link were damaged.
    LinkGarbage {
        /// Damaged frames since the last such event.
        count: u32,
    },
    /// The disk has not confirmed what was written for longer than a working disk takes.
    DiskSlowStarted {
        /// For how long.
        unconfirmed_ms: f64,
        /// Rows that a power failure now would cost.
        rows: u64,
        /// How long it may go on before the run is stopped.
        limit_ms: f64,
    },
    /// The disk has been confirming in time for a while.
    DiskSlowEnded {
        /// The longest that it did not.
        longest_ms: f64,
    },
    /// The run was ended by its duration.
    Finished,
    /// The script came to another stage.
    Script {
        /// Which.
        stage: Stage,
    },
    /// The operator went on with the next step of the script.
    StepSkipped,
}

fn as_debug<S: serde::Serializer>(
    value: &impl std::fmt::Debug,
    serializer: S,
) -> Result<S::Ok, S::Error> {
    serializer.collect_str(&format_args!("{value:?}"))
}

/// An event with its place in the run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Event {
    /// Tick.
    pub seq: u64,
    /// Start of the tick since the start of the run, ns.
    pub time_ns: i64,
    /// What happened.
    #[serde(flatten)]
    pub kind: EventKind,
}

/// Most events of one tick; more are counted in [`Events::lost`].
pub const EVENTS_PER_TICK: usize = 8;

/// The events of one tick, in a fixed size.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Events {
    events: [Option<Event>; EVENTS_PER_TICK],
    count: usize,
    /// Events beyond [`EVENTS_PER_TICK`].
    pub lost: u32,
}

impl Events {
    /// Adds one.
    pub fn push(&mut self, event: Event) {
        match self.events.get_mut(self.count) {
            Some(slot) => {
                *slot = Some(event);
                self.count += 1;
            }
            None => self.lost += 1,
        }
    }

    /// All reasons, in order.
    pub fn iter(&self) -> impl Iterator<Item = &Event> {
        self.events.iter().flatten()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_event_reads_as_one_flat_json_object() {
        let event = Event {
            seq: 7,
            time_ns: 8_000_000,
            kind: EventKind::SafeLatched {
                reason: SafeReason::StaleFrames,
            },
        };
        assert_eq!(
            serde_json::to_string(&event).expect("plain data"),
            r#"{"seq":7,"time_ns":8000000,"event":"safe-latched","reason":"stale-frames"}"#
        );
        let board = EventKind::BoardChanged {
            state: ActuatorState::Safe,
            fault: ActuatorFault::CommandTimeout,
        };
        assert_eq!(
            serde_json::to_string(&board).expect("plain data"),
            r#"{"event":"board-changed","state":"Safe","fault":"CommandTimeout"}"#
        );
    }

    #[test]
    fn events_beyond_the_room_of_a_tick_are_counted() {
        let mut events = Events::default();
        for seq in 0..EVENTS_PER_TICK as u64 + 3 {
            events.push(Event {
                seq,
                time_ns: 0,
                kind: EventKind::Armed,
            });
        }
        assert_eq!(events.iter().count(), EVENTS_PER_TICK);
        assert_eq!(events.lost, 3);
    }
}
