//! Shared by both drivers: the recorder's sink, the end of a run, and the service of the actuator.

use crate::core::CoreError;
use crate::life::{Event, Life, Request};
use crate::realtime::Conditions;
use crate::recording::{RecorderReport, Unconfirmed};
use crate::summary::{End, Statistics, Summary};
use crate::tick_record::TickRecord;
use cellpos_control::{LearnedTable, LearnerState};
use cellpos_rig::{Actuator, ActuatorError, CameraError};
use std::time::Duration;

/// Where records and events go. Called on the recorder thread; may block, allocate and fail. A sink that cannot write counts its losses and
/// says so ([`RunSink::is_refused`]), and the run is frozen and parked. A sink never waits for a terminal.
pub trait RunSink: Send {
    /// One tick.
    fn tick(&mut self, record: &TickRecord);
    /// One event.
    fn event(&mut self, event: &Event);
    /// The next sink, if this one is in front of another: everything that it does not look at goes there.
    fn inner(&self) -> Option<&dyn RunSink> {
        None
    }
    /// The same, mutable.
    fn inner_mut(&mut self) -> Option<&mut dyn RunSink> {
        None
    }
    /// Events of one kind that came too often to be reported singly: the last one, and their number.
    fn repeated(&mut self, last: &Event, count: u64) {
        match self.inner_mut() {
            Some(inner) => inner.repeated(last, count),
            None => self.event(last),
        }
    }
    /// What the operator wrote into the run while it went on.
    fn note(&mut self, time_ns: i64, text: &str) {
        if let Some(inner) = self.inner_mut() {
            inner.note(time_ns, text);
        }
    }
    /// Whether it takes a record now: an emulated disk that hangs does not. Records left in the ring until it is full are
    /// lost.
    fn is_ready(&self) -> bool {
        self.inner().is_none_or(RunSink::is_ready)
    }
    /// Whether its last data could not be kept: a full disk, a folder that is gone. Asked some hundred times a second.
    fn is_refused(&self) -> bool {
        self.inner().is_some_and(RunSink::is_refused)
    }
    /// Data that it has taken and the disk has not confirmed. Asked some hundred times a second.
    fn unconfirmed(&self) -> Unconfirmed {
        self.inner()
            .map_or_else(Unconfirmed::default, RunSink::unconfirmed)
    }
    /// What is being learned over the cycles of a periodic motion, as it stands: about four times a second while learning.
    fn learned(&mut self, motion: u16, state: &LearnerState) {
        if let Some(inner) = self.inner_mut() {
            inner.learned(motion, state);
        }
    }
    /// Called about ten times a second of the run, and at its end.
    fn progress(&mut self, statistics: &Statistics);
}

/// A sink for runs of which only the summary is wanted.
#[derive(Debug, Clone, Copy, Default)]
pub struct NoSink;

impl RunSink for NoSink {
    fn tick(&mut self, _: &TickRecord) {}
    fn event(&mut self, _: &Event) {}
    fn progress(&mut self, _: &Statistics) {}
}

/// Why a run could not be carried through. A run that ends in Safe is no error: see [`Summary::safe_reason`].
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// The loop cannot be built.
    #[error(transparent)]
    Core(#[from] CoreError),
    /// The board.
    #[error(transparent)]
    Actuator(#[from] ActuatorError),
    /// The camera.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// A thread could not be started.
    #[error("thread {thread} could not be started")]
    Thread {
        /// Which.
        thread: &'static str,
        /// What the operating system said.
        #[source]
        source: std::io::Error,
    },
    /// A thread panicked: a defect of this program. The board has been told to park, or parks by its watchdog.
    #[error("thread {thread} panicked; the PZT was parked")]
    Panicked {
        /// Which.
        thread: &'static str,
    },
    /// The recorder did not come back from a write after the end of the run, and was left behind: the PZT is parked.
    #[error(
        "the recorder did not come back from a write within {waited_s} s of the end of the run, and was given up: of {ticks} rows \
         the last {unkept} are lost or were never confirmed by the disk"
    )]
    RecorderHangs {
        /// How long the program waited without a sign of it, s.
        waited_s: u64,
        /// Rows of the run.
        ticks: u64,
        /// Rows that the disk has not confirmed.
        unkept: u64,
    },
}

/// When a run ends, in periods of the loop by the clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EndRule {
    /// Periods of the run; `None`: until the operator or a fault ends it.
    pub ticks: Option<u64>,
    /// Periods frozen by the operator before the run ends.
    pub freeze_ticks: u64,
    /// Periods recorded after Safe was latched: long enough to see the board park.
    pub safe_ticks: u64,
}

impl Default for EndRule {
    fn default() -> Self {
        Self {
            ticks: None,
            freeze_ticks: 500,
            safe_ticks: 100,
        }
    }
}

/// Applies an [`EndRule`] tick by tick.
#[derive(Debug, Clone, Copy)]
pub(crate) struct EndWatch {
    rule: EndRule,
    /// Periods that have passed.
    passed: u64,
    frozen: u64,
    safe: u64,
}

impl EndWatch {
    pub(crate) fn new(rule: EndRule) -> Self {
        Self {
            rule,
            passed: 0,
            frozen: 0,
            safe: 0,
        }
    }

    /// To be asked once after each tick, with its number on the clock's grid.
    pub(crate) fn after_tick(
        &mut self,
        index: u64,
        life: Life,
        request: Request,
        reference_finished: bool,
    ) -> Option<End> {
        let steps = (index + 1).saturating_sub(self.passed);
        self.passed = index + 1;
        self.frozen = if request == Request::Freeze {
            self.frozen + steps
        } else {
            0
        };
        if life == Life::Safe {
            self.safe += steps;
            let by_operator = request == Request::Park;
            return (self.safe > self.rule.safe_ticks).then_some(if by_operator {
                End::Operator
            } else {
                End::Safe
            });
        }
        if self.frozen > self.rule.freeze_ticks {
            return Some(End::Operator);
        }
        if reference_finished {
            return Some(End::Script);
        }
        match self.rule.ticks {
            Some(ticks) if self.passed >= ticks => Some(End::Duration),
            _ => None,
        }
    }
}

/// Leaves the hardware in a defined state after the last tick: frozen at neutral for a moment, then at park.
pub(crate) fn close_session(
    actuator: &mut dyn Actuator,
    life: Life,
    wait: impl Fn(Duration),
) -> Result<(), ActuatorError> {
    if life == Life::Safe {
        return actuator.park();
    }
    actuator.freeze()?;
    wait(Duration::from_millis(20));
    // What is still on its way: the account of the commands is complete after it.
    actuator.poll()?;
    actuator.disarm()
}

/// A finished run.
#[derive(Debug)]
pub struct Finished<S> {
    /// Its figures.
    pub summary: Summary,
    /// Real-time conditions of the control thread.
    pub conditions: Conditions,
    /// The sink, with all that it was given.
    pub sink: S,
    /// What was learned over cycles, for each periodic motion of the reference generator; `None`: without a learner.
    pub learned: Vec<Option<LearnedTable>>,
    /// How the recording went.
    pub recorder: RecorderReport,
    /// The failure of an I/O thread, if one failed; the loop has seen it as silence and acted on it.
    pub io_error: Option<RunError>,
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Counts its calls, and keeps nothing.
    #[derive(Default)]
    struct Told {
        repeated: u64,
        notes: usize,
    }

    impl RunSink for Told {
        fn tick(&mut self, _: &TickRecord) {}
        fn event(&mut self, _: &Event) {}
        fn repeated(&mut self, _: &Event, count: u64) {
            self.repeated += count;
        }
        fn note(&mut self, _: i64, _: &str) {
            self.notes += 1;
        }
        fn is_ready(&self) -> bool {
            false
        }
        fn is_refused(&self) -> bool {
            true
        }
        fn unconfirmed(&self) -> Unconfirmed {
            Unconfirmed {
                rows: 7,
                ..Unconfirmed::default()
            }
        }
        fn progress(&mut self, _: &Statistics) {}
    }

    /// Looks at nothing.
    struct Before(Told);

    impl RunSink for Before {
        fn inner(&self) -> Option<&dyn RunSink> {
            Some(&self.0)
        }
        fn inner_mut(&mut self) -> Option<&mut dyn RunSink> {
            Some(&mut self.0)
        }
        fn tick(&mut self, _: &TickRecord) {}
        fn event(&mut self, _: &Event) {}
        fn progress(&mut self, _: &Statistics) {}
    }

    #[test]
    fn what_a_sink_does_not_look_at_goes_to_the_one_behind_it() {
        let mut sink = Before(Told::default());
        assert!(!sink.is_ready() && sink.is_refused());
        assert_eq!(sink.unconfirmed().rows, 7);
        sink.note(0, "a note");
        let event = Event {
            seq: 0,
            time_ns: 0,
            kind: crate::life::EventKind::Running,
        };
        sink.repeated(&event, 3);
        assert_eq!((sink.0.notes, sink.0.repeated), (1, 3));
    }
}
