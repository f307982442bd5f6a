//! The tick around the core: rings in, rings out, the deadline account. The same on both clocks.

use crate::board_watch::{BoardTrouble, BoardWatch};
use crate::core::{Action, Core, TickInput};
use crate::frames::FrameWatch;
use crate::latency::Latency;
use crate::life::{Event, EventKind, Life, Request};
use crate::reference::ReferenceGenerator;
use crate::tick::Heard;
use crate::tick_record::{TickFlags, TickRecord};
use crate::timing::Timing;
use cellpos_control::{LearnerState, SolverTerms};
use cellpos_rig::clock::monotonic_ns;
use cellpos_rig::{ActuatorReport, Clock, CommandAccount, Measurement, PartnerReport, Rejections};
use rtrb::{Consumer, Producer, RingBuffer};
use std::time::{Duration, Instant};

/// Ticks between two words to the recorder on what is being learned.
const LEARNED_EVERY: u64 = 256;

/// An order to the actuator thread.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Order {
    /// What to do.
    pub action: Action,
    /// Command for the slow partner, um of its own scale, if one is due.
    pub partner_um: Option<f64>,
    /// Start of its tick since the start of the run, us.
    pub time_us: u64,
}

/// A command that the board has reported.
#[derive(Debug, Clone, Copy)]
struct Obeyed {
    seq: u32,
    /// Start of its tick, us since the start of the run.
    host_us: u64,
    /// The board's clock when it had the command, us.
    board_us: u64,
}

impl Obeyed {
    /// How long it was on its way, plus the difference of the clocks, us.
    fn offset_us(self) -> i64 {
        self.board_us.cast_signed() - self.host_us.cast_signed()
    }
}

/// The I/O threads' ends of the rings.
#[derive(Debug)]
pub struct Ends {
    /// For the camera thread. Full: the newest is refused and counted as lost by the gap in its frame id.
    pub measurements: Producer<Measurement>,
    /// For the actuator thread.
    pub orders: Consumer<Order>,
    /// For the actuator thread.
    pub heard: Producer<Heard>,
    /// For the recorder thread.
    pub feed: Feed,
}

/// The recorder thread's ends of the rings.
#[derive(Debug)]
pub struct Feed {
    /// The ticks.
    pub records: Consumer<TickRecord>,
    /// The events.
    pub events: Consumer<Event>,
    /// What is being learned, of which motion. Full: the next one says more anyway.
    pub learned: Consumer<(u16, LearnerState)>,
}

/// Sizes of the rings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RingSizes {
    /// Measurements: a burst after a stall of the control thread must fit, so that the newest is never refused.
    pub measurements: usize,
    /// Orders to the actuator thread.
    pub orders: usize,
    /// Tick records: how long the recorder may stall, in ticks.
    pub records: usize,
    /// Events.
    pub events: usize,
}

impl Default for RingSizes {
    /// The recorder may stall for 16 s (a disk that spins up, a directory on a slow network).
    fn default() -> Self {
        Self {
            measurements: 1024,
            orders: 64,
            records: 16_384,
            events: 16_384,
        }
    }
}

/// Timing and losses of a run as the control thread saw them.
#[derive(Debug, Clone)]
pub struct Account {
    /// From the start of a tick to the hand-over of its command.
    pub tick: Latency,
    /// From when a tick was due to its start: by the arrival of its position, the clock's grid, or the timer.
    pub wake: Latency,
    /// From the middle of the exposure to the hand-over of the command computed from it.
    pub exposure_to_command: Latency,
    /// Distance between the spacing of commands as the board saw it and as they were handed over.
    pub board_spacing: Latency,
    /// Records that found the recorder ring full.
    pub records_lost: u64,
    /// Events that found their ring, or their tick, full.
    pub events_lost: u64,
}

/// Core, rings and account.
#[derive(Debug)]
pub struct Ticker<R> {
    core: Core<R>,
    clock: Clock,
    start_ns: i64,
    budget_ns: i64,
    solver_time: Duration,
    measurements: Consumer<Measurement>,
    frames: FrameWatch,
    orders: Producer<Order>,
    heard: Consumer<Heard>,
    records: Producer<TickRecord>,
    events: Producer<Event>,
    rejections: Option<Rejections>,
    learned: Producer<(u16, LearnerState)>,
    ticks: u64,
    previous_late_ns: Option<u32>,
    steered_um: Option<f64>,
    /// Where the bead truly is at this tick, um, where anything knows.
    truth_um: f64,
    previous_refused: bool,
    slow_vision_ns: Option<u32>,
    board_watch: BoardWatch,
    /// What had become of the commands by the last tick.
    commands: CommandAccount,
    /// The last command that the board has reported.
    obeyed: Option<Obeyed>,
    /// Of the commands reported since the previous tick the one that was longest on its way.
    slowest: Option<Obeyed>,
    records_lost_before: bool,
    account: Account,
}

impl<R: ReferenceGenerator> Ticker<R> {
    /// Puts rings around a core. `rejections` is where the source of its positions hears that it follows no bead, `start_ns` the start
    /// of the run on `clock`.
    pub fn new(
        core: Core<R>,
        rejections: Option<Rejections>,
        clock: Clock,
        start_ns: i64,
        sizes: RingSizes,
    ) -> (Self, Ends) {
        let (measurements_in, measurements) = RingBuffer::new(sizes.measurements.max(1));
        let (orders, orders_out) = RingBuffer::new(sizes.orders.max(1));
        let (heard_in, heard) = RingBuffer::new(64);
        let (records, records_out) = RingBuffer::new(sizes.records.max(1));
        let (events, events_out) = RingBuffer::new(sizes.events.max(1));
        let (learned, learned_out) = RingBuffer::new(16);
        let silence_ns = Timing::ms_to_ns(core.timing().board_silence_ms);
        let ticker = Self {
            budget_ns: core.timing().budget_ns(),
            solver_time: Duration::from_secs_f64(core.timing().solver_us * 1e-6),
            frames: FrameWatch::new(core.frame_period_ns(), core.timing().oldest_ns()),
            core,
            clock,
            start_ns,
            measurements,
            orders,
            heard,
            records,
            events,
            rejections,
            learned,
            ticks: 0,
            previous_late_ns: None,
            steered_um: None,
            truth_um: f64::NAN,
            previous_refused: false,
            slow_vision_ns: None,
            board_watch: BoardWatch::new(silence_ns),
            commands: CommandAccount::default(),
            obeyed: None,
            slowest: None,
            records_lost_before: false,
            account: Account {
                tick: Latency::new(),
                wake: Latency::new(),
                exposure_to_command: Latency::new(),
                board_spacing: Latency::new(),
                records_lost: 0,
                events_lost: 0,
            },
        };
        let ends = Ends {
            measurements: measurements_in,
            orders: orders_out,
            heard: heard_in,
            feed: Feed {
                records: records_out,
                events: events_out,
                learned: learned_out,
            },
        };
        (ticker, ends)
    }

    /// The core.
    pub fn core(&self) -> &Core<R> {
        &self.core
    }

    /// Timing and losses so far.
    pub fn account(&self) -> &Account {
        &self.account
    }

    /// Looks at what has come from the camera; when the newest new frame that may be used was ready, ns, if there is one.
    pub fn look(&mut self) -> Option<i64> {
        let now_ns = self.clock.now_ns();
        // A ring's worth at most: a camera that delivers faster than this looks must not hold it here.
        for _ in 0..self.measurements.slots() {
            let Ok(measurement) = self.measurements.pop() else {
                break;
            };
            self.frames.add(&measurement, now_ns);
        }
        self.frames.newest(now_ns).map(|newest| newest.ready_ns)
    }

    /// From when on the next tick may be made, ns on the clock; `None`: at any time.
    pub fn opens_ns(&self) -> Option<i64> {
        self.core
            .opens_ns()
            .map(|opens_ns| opens_ns.saturating_add(self.start_ns))
    }

    /// How long vision takes for a frame, ns, while it is slower than the camera: told to the next ticks.
    pub fn vision_is_slow(&mut self, ns: Option<u32>) {
        self.slow_vision_ns = ns;
    }

    /// Whether the recorder no longer keeps up: half of its ring is full, or nobody is at its other end.
    pub fn recorder_is_behind(&self) -> bool {
        self.records.is_abandoned() || self.records.slots() < self.records.buffer().capacity() / 2
    }

    /// Says where the operator wants the bead, um, from the next tick on.
    pub(crate) fn steer(&mut self, target_um: Option<f64>) {
        self.steered_um = target_um;
    }

    /// Says where the bead truly is now, um: for the record of a tick without a frame.
    pub(crate) fn tell_truth(&mut self, bead_um: f64) {
        self.truth_um = bead_um;
    }

    /// One tick, due at `due_ns`. Before its time has come ([`Ticker::opens_ns`]) nothing is done.
    pub fn tick(&mut self, due_ns: i64, request: Request) -> Life {
        let start_ns = self.clock.now_ns();
        let tick_from = Instant::now();
        let compute_from_ns = monotonic_ns();
        if self.opens_ns().is_some_and(|opens_ns| start_ns < opens_ns) {
            return self.core.life();
        }
        self.look();
        let (newest, frames) = self.frames.take(start_ns);
        let lost_before = self.commands.lost();
        let (board, board_trouble, partner) = self.listen(start_ns);
        // On the virtual clock the line takes no time.
        let obeyed = self.slowest.take().filter(|_| !self.clock.is_virtual());
        let since_start = |ns: i64| ns - self.start_ns;
        let ready_ns = newest.map_or(due_ns, |m| m.ready_ns.max(due_ns));
        let input = TickInput {
            time_ns: since_start(start_ns),
            measurement: newest.map(|m| Measurement {
                mid_exposure_ns: since_start(m.mid_exposure_ns),
                ready_ns: since_start(m.ready_ns),
                ..m
            }),
            frames,
            previous_late_ns: self.previous_late_ns,
            previous_refused: self.previous_refused,
            slow_vision_ns: self.slow_vision_ns,
            command_lost: self.commands.lost() > lost_before,
            board,
            partner,
            board_trouble,
            request,
            target_um: self.steered_um,
            solver: if self.clock.is_virtual() {
                // The virtual clock stands still while the solver works.
                SolverTerms::Unlimited
            } else {
                SolverTerms::Until(tick_from + self.solver_time)
            },
        };
        let Some(output) = self.core.step(&input) else {
            return self.core.life();
        };
        let mut record = output.record;
        if record.true_um.is_nan() {
            record.true_um = self.truth_um;
        }
        self.previous_refused = false;
        if output.action != Action::None || output.partner_um.is_some() {
            let order = Order {
                action: output.action,
                partner_um: output.partner_um,
                time_us: (input.time_ns / 1000).max(0) as u64,
            };
            let time_us = order.time_us;
            if self.orders.push(order).is_err() {
                self.previous_refused = true;
                record.flags.set(TickFlags::ACTUATOR_RING_FULL);
            } else if let Action::Command { command_um, .. } = output.action {
                self.board_watch.commanded(time_us, command_um);
            }
        }
        // Hand-over: from here on the command is on its way.
        let handed_ns = self.clock.now_ns();
        let wake_ns = (start_ns - ready_ns).max(0);
        let compute_ns = handed_ns - start_ns;
        let seq = record.seq;
        let took_ns = (monotonic_ns() - compute_from_ns).max(0) as u64;
        self.account.tick.record(took_ns, seq);
        self.account.wake.record(wake_ns as u64, seq);
        if let Some(m) = newest {
            let ns = (handed_ns - m.mid_exposure_ns).max(0) as u64;
            self.account.exposure_to_command.record(ns, seq);
        }
        self.previous_late_ns = None;
        if compute_ns > self.budget_ns {
            self.previous_late_ns = Some(clamp_u32(compute_ns));
            record.flags.set(TickFlags::LATE);
        }
        record.wake_ns = clamp_u32(wake_ns);
        record.compute_ns = clamp_u32(compute_ns);
        if let Some(obeyed) = obeyed {
            record.obeyed_before_us = (input.time_ns / 1000) as f64 - obeyed.host_us as f64;
            record.obeyed_at_us = obeyed.board_us as f64;
        }
        self.hand_over_record(record);
        self.account.events_lost += u64::from(output.events.lost);
        for event in output.events.iter() {
            if let (EventKind::ArmingRejected { .. }, Some(followed)) =
                (event.kind, &self.rejections)
            {
                followed.reject();
            }
            if self.events.push(*event).is_err() {
                self.account.events_lost += 1;
            }
        }
        self.ticks += 1;
        if self.ticks.is_multiple_of(LEARNED_EVERY)
            && let Some(learned) = self.core.learners().current()
        {
            let _ = self.learned.push(learned);
        }
        self.core.life()
    }

    /// What the actuator thread has told since the previous tick: the board's newest report, what is wrong with it, the partner's.
    fn listen(
        &mut self,
        now_ns: i64,
    ) -> (
        Option<ActuatorReport>,
        Option<BoardTrouble>,
        Option<PartnerReport>,
    ) {
        let (mut board, mut trouble, mut partner) = (None, None, None);
        while let Ok(heard) = self.heard.pop() {
            let not_taken = heard.account.not_taken - self.commands.not_taken;
            self.board_watch.not_taken(not_taken);
            self.commands = heard.account;
            partner = heard.partner.or(partner);
            let Some(report) = heard.report else {
                continue;
            };
            self.spacing(&report);
            trouble = trouble.or(self.board_watch.heard(now_ns, &report));
            board = Some(report);
        }
        (board, trouble, partner)
    }

    /// A report of a new command: how far its distance from the command before is off that at which they were given; and which command
    /// was longest on its way.
    fn spacing(&mut self, report: &ActuatorReport) {
        let Some(seq) = report.last_seq else { return };
        let obeyed = Obeyed {
            seq,
            host_us: report.last_time_us,
            board_us: report.device_time_us,
        };
        // Later reports of one command tell nothing of its way.
        if self.obeyed.is_some_and(|before| before.seq == seq) {
            return;
        }
        let Some(before) = self.obeyed.replace(obeyed) else {
            self.slowest = Some(obeyed);
            return;
        };
        let host = obeyed.host_us.saturating_sub(before.host_us);
        let board = obeyed.board_us.saturating_sub(before.board_us);
        let off_ns = host.abs_diff(board).saturating_mul(1000);
        self.account.board_spacing.record(off_ns, self.ticks);
        let slower = |other: &Obeyed| other.offset_us() >= obeyed.offset_us();
        self.slowest = self.slowest.filter(slower).or(Some(obeyed));
    }

    fn hand_over_record(&mut self, mut record: TickRecord) {
        if self.records_lost_before {
            record.flags.set(TickFlags::RECORDS_LOST);
        }
        self.records_lost_before = self.records.push(record).is_err();
        self.account.records_lost += u64::from(self.records_lost_before);
    }
}

fn clamp_u32(ns: i64) -> u32 {
    ns.clamp(0, i64::from(u32::MAX)) as u32
}
