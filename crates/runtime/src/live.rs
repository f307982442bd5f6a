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
use crate::guide::Guide;
use crate::life::{Event, Life, Request};
use crate::realtime::{self, Conditions};
use crate::run::{EndRule, EndWatch, Finished, RunError, RunSink, close_session, serve_actuator};
use crate::summary::{End, Statistics, Summary};
use crate::tick_record::TickRecord;
use crate::ticker::{Ends, Order, RingSizes, Ticker};
use cellpos_control::{LearnedTable, LearnerState};
use cellpos_rig::clock::{monotonic_ns, sleep_until_ns};
use cellpos_rig::{Actuator, BoardReport, Clock, Measurement, PositionSource};
use rtrb::{Consumer, Producer};
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::thread::{self, Thread};
use std::time::Duration;

/// What the operator asks for, shared with a signal handler or a keyboard.
#[derive(Debug, Default)]
pub struct Operator(AtomicU8);

impl Operator {
    /// Asks.
    pub fn ask(&self, request: Request) {
        self.0.store(request as u8, Ordering::Release);
    }

    /// What was last asked.
    pub fn asked(&self) -> Request {
        Request::from_number(self.0.load(Ordering::Acquire))
    }

    /// What was last asked, to be acted on: asking to skip holds for one tick.
    pub fn take(&self) -> Request {
        let asked = self.asked();
        if asked == Request::Skip {
            // Something asked meanwhile stays.
            let _ = self.0.compare_exchange(
                Request::Skip as u8,
                Request::None as u8,
                Ordering::AcqRel,
                Ordering::Acquire,
            );
        }
        asked
    }

    /// Replaces one request by another, unless something else was asked meanwhile; says whether it did.
    pub fn change(&self, from: Request, to: Request) -> bool {
        self.0
            .compare_exchange(from as u8, to as u8, Ordering::AcqRel, Ordering::Acquire)
            .is_ok()
    }

    /// The next step of stopping: first freeze, then park.
    pub fn stop(&self) -> Request {
        let next = match self.asked() {
            Request::None | Request::Skip | Request::Pause => Request::Freeze,
            Request::Freeze | Request::Park => Request::Park,
        };
        self.ask(next);
        next
    }
}

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

struct ControlEnd {
    end: End,
    conditions: Conditions,
    life: Life,
    safe_reason: Option<crate::life::SafeReason>,
    counts: crate::core::Counts,
    account: crate::ticker::Account,
    learned: Vec<Option<LearnedTable>>,
    period_us: f64,
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
pub fn run<R: Guide + Send, S: RunSink>(
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
    let Ends {
        measurements,
        mut orders,
        mut reports,
        records,
        events,
        learned,
    } = ends;
    let stop = AtomicBool::new(false);
    let start = |thread: &'static str| move |source| RunError::Thread { thread, source };
    thread::scope(|scope| {
        let recorder = thread::Builder::new()
            .name("cellpos-record".to_string())
            .spawn_scoped(scope, || {
                record(records, events, learned, &mut sink, &mut statistics);
            })
            .map_err(start("recorder"))?;
        // The actuator thread is this one, so that `actuator` needs no owner of its own; control is told whom to wake.
        let actuator_thread = thread::current();
        let control = thread::Builder::new()
            .name("cellpos-control".to_string())
            .spawn_scoped(scope, move || {
                let conditions = realtime::apply(&threads.control);
                control(ticker, end, operator, &actuator_thread, conditions)
            })
            .map_err(start("control"))?;
        let control_thread = control.thread().clone();
        let camera = thread::Builder::new()
            .name("cellpos-camera".to_string())
            .spawn_scoped(scope, {
                let stop = &stop;
                move || {
                    realtime::apply(&threads.camera);
                    see(source, measurements, &control_thread, stop)
                }
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
        let mut io_error = actuate(actuator, &mut orders, &mut reports).err();
        let control_end = control.join();
        stop.store(true, Ordering::Release);
        let life = match &control_end {
            Ok(end) => end.life,
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
        recorded.map_err(|_| RunError::Panicked { thread: "recorder" })?;
        Ok((control_end, io_error))
    })
    .map(|(control_end, io_error)| Finished {
        summary: Summary::new(
            control_end.life,
            control_end.safe_reason,
            control_end.end,
            control_end.counts,
            &control_end.account,
            &statistics,
            control_end.period_us,
        ),
        conditions: control_end.conditions,
        learned: control_end.learned,
        sink,
        io_error,
    })
}

fn see(
    source: &mut dyn PositionSource,
    mut measurements: Producer<Measurement>,
    control: &Thread,
    stop: &AtomicBool,
) -> Result<(), RunError> {
    const LOOK_UP_NS: i64 = 20_000_000;
    /// A deadline that is past: only what has arrived already.
    const NOW_NS: i64 = 0;
    // Frames that piled up before the run are of no use to it.
    while source.next(NOW_NS)?.is_some() {}
    while !stop.load(Ordering::Acquire) && !measurements.is_abandoned() {
        if let Some(measurement) = source.next(monotonic_ns() + LOOK_UP_NS)? {
            // A full ring means that control has not run for a second; the gap in the frame ids tells the rest.
            let _ = measurements.push(measurement);
            // After a stall frames come in a burst: control is woken for the newest, not for each of the past.
            while let Some(measurement) = source.next(NOW_NS)? {
                let _ = measurements.push(measurement);
            }
            control.unpark();
        }
    }
    Ok(())
}

fn control<R: Guide>(
    mut ticker: Ticker<R>,
    end: EndRule,
    operator: &Operator,
    actuator: &Thread,
    conditions: Conditions,
) -> ControlEnd {
    let period_ns = ticker.core().timing().period_ns();
    // A frame may be this late before the timer stands in for it.
    let grace_ns = period_ns * 3 / 10;
    let mut watch = EndWatch::new(end);
    let mut last_ns = monotonic_ns();
    let mut last_tick_ns = last_ns;
    let end = loop {
        let due_ns = last_ns + period_ns + grace_ns;
        let timer = loop {
            if ticker.has_measurement() {
                break false;
            }
            let now_ns = monotonic_ns();
            if now_ns >= due_ns {
                break true;
            }
            thread::park_timeout(Duration::from_nanos((due_ns - now_ns) as u64));
        };
        // However the frames come, two ticks are never closer than half a period.
        sleep_until_ns(last_tick_ns + period_ns / 2);
        last_tick_ns = monotonic_ns();
        // After a timer tick the next one is due a period later; after a stall the past is not made up for.
        let now_ns = monotonic_ns();
        last_ns = if timer && now_ns - due_ns < period_ns {
            due_ns - grace_ns
        } else {
            now_ns
        };
        let request = operator.take();
        let life = ticker.tick(due_ns, request);
        actuator.unpark();
        if let Some(end) = watch.after_tick(life, request, ticker.core().guide().finished()) {
            break end;
        }
    };
    ControlEnd {
        end,
        conditions,
        life: ticker.core().life(),
        safe_reason: ticker.core().safe_reason(),
        counts: *ticker.core().counts(),
        learned: ticker.core().learners().tables(),
        account: ticker.account().clone(),
        period_us: ticker.core().timing().period_us,
    }
    // Dropping the ticker closes the rings: the recorder drains them and ends, the actuator thread leaves its loop.
}

fn actuate(
    actuator: &mut dyn Actuator,
    orders: &mut Consumer<Order>,
    reports: &mut Producer<BoardReport>,
) -> Result<(), RunError> {
    loop {
        let control_is_gone = orders.is_abandoned();
        if let Err(error) = serve_actuator(actuator, orders, reports) {
            // Control hears nothing more of the board and latches Safe; wait for it to end, without eating a CPU.
            while !orders.is_abandoned() {
                while orders.pop().is_ok() {}
                thread::park_timeout(Duration::from_millis(10));
            }
            return Err(error.into());
        }
        if control_is_gone {
            return Ok(());
        }
        thread::park_timeout(Duration::from_millis(1));
    }
}

fn record(
    mut records: Consumer<TickRecord>,
    mut events: Consumer<Event>,
    mut learned: Consumer<(u16, LearnerState)>,
    sink: &mut impl RunSink,
    statistics: &mut Statistics,
) {
    const LOOK_EVERY: Duration = Duration::from_millis(5);
    const PROGRESS_EVERY: u32 = 20;
    let mut round = 0_u32;
    loop {
        // Asked first: whatever was pushed before the ring was closed is still drained below.
        let over = records.is_abandoned() && events.is_abandoned();
        while let Ok(record) = records.pop() {
            statistics.add(&record);
            sink.tick(&record);
        }
        while let Ok(event) = events.pop() {
            sink.event(&event);
        }
        while let Ok((motion, state)) = learned.pop() {
            sink.learned(motion, &state);
        }
        if over {
            sink.progress(statistics);
            return;
        }
        if round.is_multiple_of(PROGRESS_EVERY) {
            sink.progress(statistics);
        }
        round = round.wrapping_add(1);
        thread::sleep(LOOK_EVERY);
    }
}
