//! A run on the virtual clock: the same core, rings and I/O as in real time, one after the other in one thread.
//!
//! Frames as they are delivered until a tick is due, by the same rule as on threads; the tick, the actuator, the recorder. A seed of
//! the emulated rig fixes every bit of the records; compute times in them are zero.

use crate::core::Core;
use crate::life::Request;
use crate::pacer::{Pace, Pacer};
use crate::realtime::Conditions;
use crate::recorder::{Pulse, Recorder};
use crate::reference::ReferenceGenerator;
use crate::run::{EndRule, EndWatch, Finished, RunError, RunSink, close_session};
use crate::summary::{Statistics, Summary};
use crate::threads::Acting;
use crate::ticker::{Ends, RingSizes, Ticker};
use cellpos_rig::{Actuator, Clock, Measurement, PositionSource};
use rtrb::Producer;

/// Runs until `end` says so. `request` is asked at each tick with its sequence number.
///
/// # Errors
/// None today. A camera that fails is silence: the loop freezes, then parks; a board that is silent is, too.
#[allow(
    clippy::too_many_arguments,
    reason = "each is one part of the rig or one rule of the run"
)]
pub fn run<R: ReferenceGenerator, S: RunSink>(
    core: Core<R>,
    clock: &Clock,
    source: &mut dyn PositionSource,
    actuator: &mut dyn Actuator,
    mut sink: S,
    mut statistics: Statistics,
    end: EndRule,
    mut request: impl FnMut(u64) -> Request,
) -> Result<Finished<S>, RunError> {
    const PROGRESS_TICKS: u64 = 100;
    let periods_ns = [core.timing().period_ns(), core.frame_period_ns()];
    let start_ns = clock.now_ns();
    let mut pacer = Pacer::new(periods_ns, start_ns);
    source.begin();
    let (sizes, rejections) = (RingSizes::default(), source.rejections());
    let (mut ticker, ends) = Ticker::new(core, rejections, clock.clone(), start_ns, sizes);
    let Ends {
        mut measurements,
        orders,
        heard,
        feed,
    } = ends;
    let pulse = Pulse::default();
    let mut recorder = Recorder::new(feed, &mut sink, &mut statistics, &pulse);
    let mut watch = EndWatch::new(end);
    let mut io_error = None;
    let mut acting = Acting::new(&mut *actuator, orders, heard);
    let (mut tick, mut met) = (0_u64, false);
    let end = loop {
        // As on the real clock: on the arrival of a frame, or on the timer.
        let due_ns = loop {
            while receive(source, clock.now_ns(), &mut measurements, &mut io_error) {}
            let ready_ns = ticker.look();
            let now_ns = clock.now_ns();
            met |= ready_ns.is_some();
            let pace = if met {
                pacer.decide(now_ns, ticker.opens_ns(), ready_ns)
            } else {
                // Before the first frame there is none to wait for.
                Pacer::at(now_ns, start_ns + tick as i64 * periods_ns[0])
            };
            match pace {
                Pace::Tick(due_ns) => {
                    if met {
                        pacer.ticked(now_ns, ready_ns);
                    }
                    break due_ns;
                }
                Pace::Wait(until_ns) => {
                    if !receive(source, until_ns, &mut measurements, &mut io_error) {
                        clock.sleep_until_ns(until_ns);
                    }
                }
            }
        };
        let mut asked = request(tick);
        if recorder.fault().is_some() && asked != Request::Park {
            asked = Request::Unrecorded;
        }
        ticker.tell_truth(source.truth_um());
        let life = ticker.tick(due_ns, asked);
        acting.round();
        // A recorder that waits for its disk leaves records in the ring; a full ring refuses, and the refusal is counted.
        recorder.round(clock.now_ns());
        if tick.is_multiple_of(PROGRESS_TICKS) {
            recorder.progress();
        }
        tick += 1;
        let core = ticker.core();
        if let Some(end) = watch.after_tick(core.index(), life, asked, core.reference().finished())
        {
            break end;
        }
    };
    let life = ticker.core().life();
    io_error = io_error.or(acting.finish());
    if let Err(error) = close_session(actuator, life, |span| clock.sleep(span)) {
        io_error.get_or_insert(error.into());
    }
    let recorded = recorder.finish();
    let summary = Summary::new(
        life,
        ticker.core().safe_reason(),
        end,
        *ticker.core().counts(),
        ticker.account(),
        &statistics,
        ticker.core().timing().period_us,
    )
    .with_unkept(&recorded)
    .with_commands(actuator.account())
    .with_adaptation(ticker.core().controller().adaptation());
    let conditions = Conditions {
        policy: "virtual clock".to_string(),
        ..Conditions::default()
    };
    Ok(Finished {
        summary,
        conditions,
        recorder: recorded,
        sink,
        learned: ticker.core().learners().tables(),
        io_error,
    })
}

/// Takes the next frame that is delivered by `deadline_ns`; whether one was. After a failure of the camera none is.
fn receive(
    source: &mut dyn PositionSource,
    deadline_ns: i64,
    measurements: &mut Producer<Measurement>,
    failure: &mut Option<RunError>,
) -> bool {
    if failure.is_some() {
        return false;
    }
    match source.next(deadline_ns) {
        Ok(Some(measurement)) => {
            // A refused measurement shows as a gap in the frame ids.
            let _ = measurements.push(measurement);
            true
        }
        Ok(None) => false,
        Err(error) => {
            *failure = Some(error.into());
            false
        }
    }
}
