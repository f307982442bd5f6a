//! A run in real time: camera, control, actuator and recorder threads, joined only by lock-free rings.
//!
//! | thread | does | waits for |
//! |---|---|---|
//! | camera | frame -> position -> measurement ring, wakes control | the camera |
//! | control | the tick, wakes the actuator thread | a measurement, or the timer |
//! | actuator | order ring -> board, board -> report ring | control |
//! | recorder | record and event rings -> sink | 5 ms |
//!
//! Nothing in a tick waits for any of the others: a ring that is full refuses, and the refusal is counted. When the
//! control thread dies its end of the order ring dies with it, and the actuator thread parks the PZT at once; when
//! the process dies the board's watchdog does.

use crate::core::Core;
use crate::life::{Life, Request};
pub use crate::operator::Operator;
use crate::realtime;
use crate::recorder::{self, Feed};
use crate::reference::ReferenceGenerator;
use crate::run::{EndRule, Finished, RunError, RunSink, close_session};
use crate::summary::{Statistics, Summary};
use crate::threads::{Acting, ControlEnd, Controlling, Next, Seeing, Shared};
use crate::ticker::{Ends, RingSizes, Ticker};
use cellpos_rig::clock::monotonic_ns;
use cellpos_rig::{Actuator, Clock, PositionSource};
use std::sync::atomic::Ordering;
use std::thread::{self, Thread};
use std::time::Duration;

/// How the threads are to run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Threads {
    /// Control thread.
    pub control: realtime::Request,
    /// Camera thread.
    pub camera: realtime::Request,
    /// Actuator thread.
    pub actuator: realtime::Request,
}

impl Threads {
    /// SCHED_FIFO for all three, control on a CPU of its own choice, memory locked.
    pub fn real_time() -> Self {
        Self {
            control: realtime::Request::control_thread(),
            camera: realtime::Request::io_thread(70),
            actuator: realtime::Request::io_thread(75),
        }
    }

    /// No real time at all.
    pub fn best_effort() -> Self {
        Self {
            control: realtime::Request::best_effort(),
            camera: realtime::Request::best_effort(),
            actuator: realtime::Request::best_effort(),
        }
    }
}

/// Runs until `end` says so or the operator asks for it.
///
/// # Errors
/// A thread that could not be started or panicked. Trouble with camera or board ends the run in Safe and is in
/// [`Finished::io_error`].
#[allow(
    clippy::too_many_arguments,
    reason = "each is one part of the rig or one rule of the run"
)]
pub fn run<R: ReferenceGenerator + Send, S: RunSink>(
    core: Core<R>,
    source: &mut dyn PositionSource,
    actuator: &mut dyn Actuator,
    mut sink: S,
    mut statistics: Statistics,
    end: EndRule,
    threads: &Threads,
    operator: &Operator,
) -> Result<Finished<S>, RunError> {
    let (ticker, ends) = Ticker::new(core, Clock::Real, monotonic_ns(), RingSizes::default());
    let period_ns = ticker.core().timing().period_ns();
    let Ends {
        measurements,
        orders,
        reports,
        records,
        events,
        learned,
    } = ends;
    let feed = Feed {
        records,
        events,
        learned,
    };
    let shared = Shared::default();
    let shared = &shared;
    let start = |thread: &'static str| move |source| RunError::Thread { thread, source };
    thread::scope(|scope| {
        let recorder = thread::Builder::new()
            .name("cellpos-record".to_string())
            .spawn_scoped(scope, || {
                recorder::serve(feed, &mut sink, &mut statistics, operator, &shared.pulse)
            })
            .map_err(start("recorder"))?;
        // The actuator thread is this one, so that `actuator` needs no owner of its own; control is told whom to wake.
        let actuator_thread = thread::current();
        let control = thread::Builder::new()
            .name("cellpos-control".to_string())
            .spawn_scoped(scope, move || {
                let conditions = realtime::apply(&threads.control);
                let controlling = Controlling::new(ticker, Clock::Real, end, operator, shared);
                (control(controlling, &actuator_thread), conditions)
            })
            .map_err(start("control"))?;
        let control_thread = control.thread().clone();
        let camera = thread::Builder::new()
            .name("cellpos-camera".to_string())
            .spawn_scoped(scope, move || {
                realtime::apply(&threads.camera);
                let seeing = Seeing::new(source, measurements, Clock::Real, period_ns, shared);
                see(seeing, &control_thread)
            });
        let camera = match camera {
            Ok(camera) => camera,
            Err(error) => {
                // The measurement ring is gone: control freezes and parks by itself; park now, all the same.
                operator.ask(Request::Park);
                let _ = actuator.park();
                let _ = control.join();
                return Err(start("camera")(error));
            }
        };
        realtime::apply(&threads.actuator);
        let mut io_error = actuate(Acting::new(actuator, orders, reports));
        let control_end = control.join();
        shared.stop.store(true, Ordering::Release);
        let life = match &control_end {
            Ok((end, _)) => end.life,
            Err(_) => Life::Safe,
        };
        let closed = close_session(actuator, life, thread::sleep);
        if let Err(error) = closed {
            io_error.get_or_insert(error.into());
        }
        match camera.join() {
            Ok(Ok(())) => {}
            Ok(Err(error)) => {
                io_error.get_or_insert(error);
            }
            Err(_) => io_error = Some(RunError::Panicked { thread: "camera" }),
        }
        let recorded = recorder.join();
        let control_end = control_end.map_err(|_| RunError::Panicked { thread: "control" })?;
        let mut recorded = recorded.map_err(|_| RunError::Panicked { thread: "recorder" })?;
        recorded.fault = recorded.fault.or(operator.recorder_fault());
        Ok((control_end, io_error, recorded))
    })
    .map(|((control_end, conditions), io_error, recorder)| Finished {
        summary: Summary::new(
            control_end.life,
            control_end.safe_reason,
            control_end.end,
            control_end.counts,
            &control_end.account,
            &statistics,
            control_end.period_us,
        )
        .with_unkept(&recorder),
        recorder,
        conditions,
        learned: control_end.learned,
        sink,
        io_error,
    })
}

fn see(mut seeing: Seeing, control: &Thread) -> Result<(), RunError> {
    seeing.clear()?;
    while !seeing.is_over() {
        if seeing.round()? {
            control.unpark();
        }
    }
    Ok(())
}

fn control<R: ReferenceGenerator>(
    mut controlling: Controlling<R>,
    actuator: &Thread,
) -> ControlEnd {
    loop {
        match controlling.round() {
            Next::Wait(until_ns) => {
                let wait_ns = until_ns.saturating_sub(monotonic_ns());
                thread::park_timeout(Duration::from_nanos(wait_ns.max(0).unsigned_abs()));
            }
            Next::Ticked => actuator.unpark(),
            Next::Over(end) => {
                let ended = controlling.finish(end);
                actuator.unpark();
                return ended;
            }
        }
    }
}

fn actuate(mut acting: Acting) -> Option<RunError> {
    while !acting.round() {
        thread::park_timeout(Duration::from_millis(1));
    }
    acting.finish()
}
