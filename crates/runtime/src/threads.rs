//! The work of each thread of a run, one round at a time. The threads themselves only wait in between ([`crate::live`]), so a test can run
//! the same rounds on its own clock, in any order.

use crate::core::{Action, Counts};
use crate::life::{Life, SafeReason};
use crate::operator::Operator;
use crate::pacer::{Pace, Pacer};
use crate::recorder::{Pulse, PulseWatch};
use crate::recording::RecorderFault;
use crate::reference::ReferenceGenerator;
use crate::run::{EndRule, EndWatch, RunError};
use crate::summary::End;
use crate::tick::Heard;
use crate::ticker::{Account, Order, Ticker};
use cellpos_control::{Adaptation, LearnedTable};
use cellpos_rig::{Actuator, ActuatorError, ActuatorReport, Clock, Measurement, PositionSource};
use cellpos_vision::Decision;
use rtrb::{Consumer, Producer};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};

/// Flags that the threads share in addition to the rings.
#[derive(Debug, Default)]
pub(crate) struct Shared {
    /// The run is over.
    pub(crate) stop: AtomicBool,
    /// Mean time that vision takes for a frame while it is slower than the camera, ns; 0: it keeps up.
    slow_vision_ns: AtomicU32,
    /// The recorder's.
    pub(crate) pulse: Arc<Pulse>,
}

/// The camera thread: frame -> position -> ring.
pub(crate) struct Seeing<'a> {
    source: &'a mut dyn PositionSource,
    measurements: Producer<Measurement>,
    clock: Clock,
    period_ns: i64,
    shared: &'a Shared,
    /// Frames in a row that had been waiting, and the time that they took.
    backlog: u32,
    backlog_ns: i64,
    /// Whether frames were left waiting.
    behind: bool,
}

impl<'a> Seeing<'a> {
    /// How long to wait for a frame before looking whether the run is over, ns.
    const LOOK_UP_NS: i64 = 20_000_000;
    /// A deadline that is past: only what has arrived already.
    const NOW_NS: i64 = 0;
    /// Frames that piled up before the run are thrown away for no longer than this, ns.
    const CLEAR_NS: i64 = 100_000_000;
    /// Frames in a row that must have been waiting before vision is called slow.
    const SURE: u32 = 5;

    pub(crate) fn new(
        source: &'a mut dyn PositionSource,
        measurements: Producer<Measurement>,
        clock: Clock,
        period_ns: i64,
        shared: &'a Shared,
    ) -> Self {
        Self {
            source,
            measurements,
            clock,
            period_ns,
            shared,
            backlog: 0,
            backlog_ns: 0,
            behind: false,
        }
    }

    /// Whether nobody wants its positions any more.
    pub(crate) fn is_over(&self) -> bool {
        self.shared.stop.load(Ordering::Acquire) || self.measurements.is_abandoned()
    }

    /// Throws away the frames that piled up before the run. Vision that is slower than the camera would never finish, so this has an end.
    pub(crate) fn clear(&mut self) -> Result<(), RunError> {
        let until_ns = self.clock.now_ns().saturating_add(Self::CLEAR_NS);
        while !self.is_over() && self.clock.now_ns() < until_ns {
            if self.source.next(Self::NOW_NS)?.is_none() {
                break;
            }
        }
        Ok(())
    }

    /// Waits for a frame, for a while; then takes those that wait, for a period at most. Says whether control is to be
    /// woken.
    pub(crate) fn round(&mut self) -> Result<bool, RunError> {
        let from_ns = self.clock.now_ns();
        let had_waited = self.behind;
        if !self.push(from_ns.saturating_add(Self::LOOK_UP_NS), had_waited)? {
            self.caught_up();
            return Ok(false);
        }
        // After a stall frames come in a burst: control is woken for the newest, not for each of the past.
        let burst_ns = self.clock.now_ns();
        self.behind = true;
        while self.clock.now_ns() - burst_ns < self.period_ns && !self.is_over() {
            if !self.push(Self::NOW_NS, true)? {
                self.caught_up();
                break;
            }
        }
        Ok(true)
    }

    /// Takes the next frame, if one comes in time.
    fn push(&mut self, deadline_ns: i64, had_waited: bool) -> Result<bool, RunError> {
        let from_ns = self.clock.now_ns();
        let Some(measurement) = self.source.next(deadline_ns)? else {
            return Ok(false);
        };
        // A full ring means that control has not run for a second; the gap in the frame ids tells the rest.
        let _ = self.measurements.push(measurement);
        // A frame that was passed over says nothing of how long a look takes.
        let passed = matches!(measurement.track, Some((_, Decision::PassedOver)));
        if had_waited && !passed {
            self.backlog = self.backlog.saturating_add(1);
            self.backlog_ns = self
                .backlog_ns
                .saturating_add(self.clock.now_ns() - from_ns);
            let mean_ns = self.backlog_ns / i64::from(self.backlog);
            if self.backlog >= Self::SURE && mean_ns > self.period_ns {
                let ns = u32::try_from(mean_ns).unwrap_or(u32::MAX);
                self.shared.slow_vision_ns.store(ns, Ordering::Release);
            }
        }
        Ok(true)
    }

    fn caught_up(&mut self) {
        (self.backlog, self.backlog_ns, self.behind) = (0, 0, false);
        self.shared.slow_vision_ns.store(0, Ordering::Release);
    }
}

/// What the control thread does next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Next {
    /// Wait until then, ns, or until a frame has come.
    Wait(i64),
    /// A tick was made: the actuator is to be woken.
    Ticked,
    /// The run is over; the actuator is to be woken.
    Over(End),
}

/// The control thread: the tick.
pub(crate) struct Controlling<'a, R> {
    ticker: Ticker<R>,
    clock: Clock,
    pacer: Pacer,
    watch: EndWatch,
    recorder: PulseWatch,
    operator: &'a Operator,
    shared: &'a Shared,
}

/// What the control thread leaves behind.
pub(crate) struct ControlEnd {
    pub(crate) end: End,
    pub(crate) life: Life,
    pub(crate) safe_reason: Option<SafeReason>,
    pub(crate) counts: Counts,
    pub(crate) account: Account,
    pub(crate) learned: Vec<Option<LearnedTable>>,
    pub(crate) adaptation: Option<Adaptation>,
    pub(crate) period_us: f64,
}

impl<'a, R: ReferenceGenerator> Controlling<'a, R> {
    pub(crate) fn new(
        ticker: Ticker<R>,
        clock: Clock,
        end: EndRule,
        operator: &'a Operator,
        shared: &'a Shared,
    ) -> Self {
        let core = ticker.core();
        let periods_ns = [core.timing().period_ns(), core.frame_period_ns()];
        Self {
            pacer: Pacer::new(periods_ns, clock.now_ns()),
            watch: EndWatch::new(end),
            recorder: PulseWatch::default(),
            ticker,
            clock,
            operator,
            shared,
        }
    }

    /// Makes a tick, if one is due.
    pub(crate) fn round(&mut self) -> Next {
        let ready_ns = self.ticker.look();
        let now_ns = self.clock.now_ns();
        let due_ns = match self.pacer.decide(now_ns, self.ticker.opens_ns(), ready_ns) {
            Pace::Wait(until_ns) => return Next::Wait(until_ns),
            Pace::Tick(due_ns) => due_ns,
        };
        self.pacer.ticked(now_ns, ready_ns);
        let slow_ns = self.shared.slow_vision_ns.load(Ordering::Acquire);
        self.ticker.vision_is_slow((slow_ns > 0).then_some(slow_ns));
        let request = self.operator.take();
        self.ticker.steer(self.operator.target_um());
        let life = self.ticker.tick(due_ns, request);
        if self.recorder.stuck(&self.shared.pulse, now_ns) {
            self.operator.unrecorded(RecorderFault::Stuck);
        } else if self.ticker.recorder_is_behind() {
            self.operator.unrecorded(RecorderFault::Behind);
        }
        let core = self.ticker.core();
        let over = core.reference().finished();
        match self.watch.after_tick(core.index(), life, request, over) {
            Some(end) => Next::Over(end),
            None => Next::Ticked,
        }
    }

    /// Closes the rings: the recorder drains them and ends, the actuator thread leaves its loop.
    pub(crate) fn finish(self, end: End) -> ControlEnd {
        let core = self.ticker.core();
        ControlEnd {
            end,
            life: core.life(),
            safe_reason: core.safe_reason(),
            counts: *core.counts(),
            learned: core.learners().tables(),
            adaptation: core.controller().adaptation(),
            account: self.ticker.account().clone(),
            period_us: core.timing().period_us,
        }
    }
}

/// The actuator thread: orders -> board, board -> reports.
///
/// An error of the line ends nothing: a command that was not taken is lost, and the next one is tried. A board that stays
/// silent ends the run, in control.
pub(crate) struct Acting<'a> {
    actuator: &'a mut dyn Actuator,
    orders: Consumer<Order>,
    heard: Producer<Heard>,
    /// Whether the PZT is to be parked and the line has not taken it.
    park: bool,
    /// Commands lost that control knows of.
    told_lost: u64,
    /// What went wrong since the board was last heard.
    trouble: Option<RunError>,
}

impl<'a> Acting<'a> {
    pub(crate) fn new(
        actuator: &'a mut dyn Actuator,
        orders: Consumer<Order>,
        heard: Producer<Heard>,
    ) -> Self {
        Self {
            actuator,
            orders,
            heard,
            park: false,
            told_lost: 0,
            trouble: None,
        }
    }

    /// Carries out the waiting orders and reads the board's reports; returns whether the run is over.
    pub(crate) fn round(&mut self) -> bool {
        // Asked first: what was ordered before control ended is still carried out below.
        let over = self.orders.is_abandoned();
        let sent = self.send();
        let polled = self.actuator.poll();
        let report = polled.as_ref().ok().copied().flatten();
        self.tell(report);
        match sent.and(polled) {
            Ok(Some(_)) => self.trouble = None,
            Ok(None) => {}
            Err(error) => self.trouble = Some(error.into()),
        }
        over
    }

    /// Sends what waits. A newer command replaces an older one that has not been sent: a burst after a stall would only make the
    /// PZT rattle through the past.
    fn send(&mut self) -> Result<(), ActuatorError> {
        let (mut newest, mut partner) = (None, None);
        while let Ok(order) = self.orders.pop() {
            partner = order.partner_um.map(|um| (um, order.time_us)).or(partner);
            match order.action {
                Action::Command {
                    command_um,
                    neutral_um,
                } => newest = Some((command_um, neutral_um, order.time_us)),
                Action::Park => self.park = true,
                Action::None => {}
            }
        }
        if let Some((um, time_us)) = partner.filter(|_| !self.park) {
            self.actuator.command_partner(um, time_us);
        }
        if self.park {
            // Asked again until the line has taken it.
            self.actuator.park()?;
            self.park = false;
        } else if let Some((command_um, neutral_um, time_us)) = newest {
            self.actuator.command(command_um, neutral_um, time_us)?;
        }
        Ok(())
    }

    /// Tells control what is new.
    fn tell(&mut self, report: Option<ActuatorReport>) {
        let account = self.actuator.account().unwrap_or_default();
        let partner = self.actuator.poll_partner();
        if report.is_some() || partner.is_some() || account.lost() != self.told_lost {
            self.told_lost = account.lost();
            // A full ring means that the loop is not running: it will hear the next one.
            let _ = self.heard.push(Heard {
                report,
                partner,
                account,
            });
        }
    }

    /// What was wrong with the line when the run ended, if anything was.
    pub(crate) fn finish(self) -> Option<RunError> {
        self.trouble
    }
}

#[cfg(test)]
#[path = "threads_tests/mod.rs"]
mod tests;
