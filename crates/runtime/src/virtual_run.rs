//! A run on the virtual clock: the same core, rings and I/O as in real time, one after the other in one thread.
//!
//! Each period: frames that have been delivered by now, the tick, the actuator, the recorder. A seed of the emulated
//! rig fixes every bit of the records; wake-up and compute times in them are zero.

use crate::core::Core;
use crate::guide::Guide;
use crate::life::Request;
use crate::realtime::Conditions;
use crate::run::{EndRule, EndWatch, Finished, RunError, RunSink, close_session, serve_actuator};
use crate::summary::{Statistics, Summary};
use crate::ticker::{RingSizes, Ticker};
use cellpos_rig::{Actuator, Clock, PositionSource};

/// Runs until `end` says so. `request` is asked at each tick with its sequence number.
///
/// # Errors
/// The actuator fails in a way that ends the run. A camera that fails is silence: the loop freezes, then parks.
#[allow(
    clippy::too_many_arguments,
    reason = "each is one part of the rig or one rule of the run"
)]
pub fn run<R: Guide, S: RunSink>(
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
    let period_ns = core.timing().period_ns();
    let start_ns = clock.now_ns();
    let (mut ticker, mut ends) = Ticker::new(core, clock.clone(), start_ns, RingSizes::default());
    let mut watch = EndWatch::new(end);
    let mut io_error = None;
    let mut tick = 0_u64;
    let end = loop {
        let now_ns = start_ns + tick as i64 * period_ns;
        clock.sleep_until_ns(now_ns);
        while io_error.is_none() {
            match source.next(now_ns) {
                Ok(Some(measurement)) => {
                    // A refused measurement shows as a gap in the frame ids.
                    let _ = ends.measurements.push(measurement);
                }
                Ok(None) => break,
                Err(error) => io_error = Some(error.into()),
            }
        }
        let asked = request(tick);
        let life = ticker.tick(now_ns, asked);
        serve_actuator(actuator, &mut ends.orders, &mut ends.reports)?;
        // A recorder that waits for its disk leaves records in the ring; a full ring refuses, and the refusal is counted.
        while sink.is_ready() {
            let Ok(record) = ends.records.pop() else {
                break;
            };
            statistics.add(&record);
            sink.tick(&record);
        }
        while let Ok(event) = ends.events.pop() {
            sink.event(&event);
        }
        while let Ok((motion, state)) = ends.learned.pop() {
            sink.learned(motion, &state);
        }
        if tick.is_multiple_of(PROGRESS_TICKS) {
            sink.progress(&statistics);
        }
        tick += 1;
        if let Some(end) = watch.after_tick(life, asked, ticker.core().guide().finished()) {
            break end;
        }
    };
    let life = ticker.core().life();
    close_session(actuator, life, |span| clock.sleep(span))?;
    while let Ok(record) = ends.records.pop() {
        statistics.add(&record);
        sink.tick(&record);
    }
    sink.progress(&statistics);
    let summary = Summary::new(
        life,
        ticker.core().safe_reason(),
        end,
        *ticker.core().counts(),
        ticker.account(),
        &statistics,
        ticker.core().timing().period_us,
    );
    let conditions = Conditions {
        policy: "virtual clock".to_string(),
        ..Conditions::default()
    };
    Ok(Finished {
        summary,
        conditions,
        sink,
        learned: ticker.core().learners().tables(),
        io_error,
    })
}
