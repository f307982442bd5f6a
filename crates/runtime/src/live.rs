//! A run in real time: camera, control, actuator and recorder threads, joined only by lock-free rings.
//!
//! | thread | does | waits for |
//! |---|---|---|
//! | camera | frame -> position -> measurement ring, wakes control | the camera |
//! | control | the tick, wakes the actuator thread | a measurement, or the timer |
//! | actuator | order ring -> board, board -> report ring | control |
//! | recorder | record and event rings -> sink | 5 ms |
//!
//! Nothing in a tick waits for any of the others: a ring that is full refuses, and the refusal is counted. If the control thread dies, its
//! end of the order ring closes and the actuator thread parks the PZT at once. If the process dies, the board's watchdog parks it.

use crate::core::Core;
use crate::life::{Life, Request};
pub use crate::operator::Operator;
use crate::realtime::{self, Conditions};
use crate::recorder::{self, Pulse, PulseWatch, RecorderReport};
use crate::reference::ReferenceGenerator;
use crate::run::{EndRule, Finished, RunError, RunSink, close_session};
use crate::summary::{Statistics, Summary};
use crate::threads::{Acting, ControlEnd, Controlling, Next, Seeing, Shared};
use crate::ticker::{Ends, Feed, RingSizes, Ticker};
use cellpos_rig::clock::monotonic_ns;
use cellpos_rig::{Actuator, Clock, PositionSource};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread::{self, JoinHandle, Thread};
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
    /// SCHED_FIFO for all three on one CPU, control before the others, memory locked.
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

/// After the end of a run: how long the program waits for a recorder that shows no progress.
const LAST_PATIENCE: Duration = Duration::from_secs(5);

/// Runs until `end` says so or the operator asks for it.
///
/// # Errors
/// A thread that could not be started or panicked; [`RunError::RecorderHangs`] when the sink does not come back: it is left
/// behind with its thread, the PZT is parked. Trouble with camera or board ends the run in Safe and is in
/// [`Finished::io_error`].
#[allow(
    clippy::too_many_arguments,
    reason = "each is one part of the rig or one rule of the run"
)]
pub fn run<R: ReferenceGenerator + Send, S: RunSink + 'static>(
    core: Core<R>,
    source: &mut dyn PositionSource,
    actuator: &mut dyn Actuator,
    sink: S,
    statistics: Statistics,
    end: EndRule,
    threads: &Threads,
    operator: &Arc<Operator>,
) -> Result<Finished<S>, RunError> {
    source.begin();
    let (ticker, ends) = Ticker::new(
        core,
        source.rejections(),
        Clock::Real,
        monotonic_ns(),
        RingSizes::default(),
    );
    let period_ns = ticker.core().frame_period_ns();
    let Ends {
        measurements,
        orders,
        heard,
        feed,
    } = ends;
    let shared = Shared::default();
    let shared = &shared;
    let start = |thread: &'static str| move |source| RunError::Thread { thread, source };
    let recorder = Recording::start(feed, sink, statistics, operator, &shared.pulse)
        .map_err(start("recorder"))?;
    let ended = thread::scope(|scope| {
        // No thread that is not made here gets real-time rights: whoever calls keeps those that it has, and so do the programs
        // and threads that it starts.
        let serving = thread::Builder::new()
            .name("cellpos-actuator".to_string())
            .spawn_scoped(scope, move || {
                realtime::apply(&threads.actuator);
                let failed = actuate(Acting::new(&mut *actuator, orders, heard));
                (actuator, failed)
            })
            .map_err(start("actuator"))?;
        let actuator_thread = serving.thread().clone();
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
                // The measurement ring is gone: control freezes and parks; park now all the same.
                operator.ask(Request::Park);
                let _ = control.join();
                let _ = serving.join();
                return Err(start("camera")(error));
            }
        };
        let control_end = control.join();
        let served = serving.join();
        shared.stop.store(true, Ordering::Release);
        let life = match &control_end {
            Ok((end, _)) => end.life,
            Err(_) => Life::Safe,
        };
        // A thread that panicked has let go of the board: whoever gave it to this run parks it.
        let (actuator, mut io_error) =
            served.map_err(|_| RunError::Panicked { thread: "actuator" })?;
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
        let control_end = control_end.map_err(|_| RunError::Panicked { thread: "control" })?;
        Ok((control_end, io_error, actuator.account()))
    });
    let ticks = ended.as_ref().map_or(0, |((end, _), ..)| end.counts.ticks);
    let recorded = recorder.wait(ticks, LAST_PATIENCE);
    let ((control_end, conditions), io_error, commands) = ended?;
    let mut finished = finished(control_end, conditions, recorded?, io_error, operator);
    finished.summary = finished.summary.with_commands(commands);
    Ok(finished)
}

/// What the recorder's thread gives back.
type Recorded<S> = (S, Statistics, RecorderReport);

/// What is left of a run of which every thread has ended.
fn finished<S>(
    control: ControlEnd,
    conditions: Conditions,
    (sink, statistics, mut recorder): Recorded<S>,
    io_error: Option<RunError>,
    operator: &Operator,
) -> Finished<S> {
    recorder.fault = recorder.fault.or(operator.recorder_fault());
    Finished {
        summary: Summary::new(
            control.life,
            control.safe_reason,
            control.end,
            control.counts,
            &control.account,
            &statistics,
            control.period_us,
        )
        .with_unkept(&recorder)
        .with_adaptation(control.adaptation),
        recorder,
        conditions,
        learned: control.learned,
        sink,
        io_error,
    }
}

/// The recorder's thread. It owns its files, so that the program can leave it behind if a write never returns.
struct Recording<S> {
    thread: JoinHandle<Recorded<S>>,
    pulse: Arc<Pulse>,
}

impl<S: RunSink + 'static> Recording<S> {
    fn start(
        feed: Feed,
        mut sink: S,
        mut statistics: Statistics,
        operator: &Arc<Operator>,
        pulse: &Arc<Pulse>,
    ) -> std::io::Result<Self> {
        let (operator, beats) = (Arc::clone(operator), Arc::clone(pulse));
        let serve = move || {
            let report = recorder::serve(feed, &mut sink, &mut statistics, &operator, &beats);
            (sink, statistics, report)
        };
        let thread = thread::Builder::new()
            .name("cellpos-record".to_string())
            .spawn(serve)?;
        Ok(Self {
            thread,
            pulse: Arc::clone(pulse),
        })
    }

    /// Waits for its end as long as it shows signs of life, and for a while without. `ticks`: rows of the run.
    fn wait(self, ticks: u64, patience: Duration) -> Result<Recorded<S>, RunError> {
        const LOOK_EVERY: Duration = Duration::from_millis(5);
        let mut watch = PulseWatch::default();
        while !self.thread.is_finished() {
            watch.stuck(&self.pulse, monotonic_ns());
            if u128::from(watch.still_ns().unsigned_abs()) >= patience.as_nanos() {
                return Err(RunError::RecorderHangs {
                    waited_s: patience.as_secs(),
                    ticks,
                    unkept: ticks.saturating_sub(self.pulse.kept()),
                });
            }
            thread::sleep(LOOK_EVERY);
        }
        let recorded = self.thread.join();
        recorded.map_err(|_| RunError::Panicked { thread: "recorder" })
    }
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
