//! The threads' rounds on clocks that bend: a scheduler that runs them in any order, with stalls, bursts, early, late, lost,
//! doubled and false frames, slow vision, a slow disk and threads that die. The board is the firmware's own, and every step of
//! its output is looked at.

use super::*;
use crate::arming::ArmingConfig;
use crate::core::Core;
use crate::life::{Event, Request};
use crate::recorder::{Feed, Recorder, RecorderReport};
use crate::reference::{ReferenceInput, ReferenceOutput, Stage};
use crate::replay::Replay;
use crate::run::{RunSink, close_session};
use crate::summary::Statistics;
use crate::tick_record::{TickFlags, TickRecord};
use crate::ticker::RingSizes;
use crate::timing::Timing;

use cellpos_control::{ControllerFile, Limits, Pi};
use cellpos_drivers::{BoardHost, Port};
use cellpos_emulator::{BoardConfig, RigInABox, WorldConfig};
use cellpos_plant::{Model, TransferFunction};
use cellpos_rig::{ArmRequest, CameraError, SourceInfo};
use rtrb::RingBuffer;
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard};

const MS: i64 = 1_000_000;

/// Numbers for the scheduler and the faults.
#[derive(Debug, Clone)]
struct Dice(u64);

impl Dice {
    fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1)
    }

    fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 11
    }

    fn part(&mut self) -> f64 {
        self.next() as f64 / (1_u64 << 53) as f64
    }

    fn hits(&mut self, probability: f64) -> bool {
        self.part() < probability
    }

    fn within(&mut self, least_ns: i64, most_ns: i64) -> i64 {
        least_ns + (self.part() * (most_ns - least_ns) as f64) as i64
    }
}

/// What goes wrong, and how often.
#[derive(Debug, Clone)]
struct Faults {
    lost: f64,
    doubled: f64,
    /// Delays of frames, from and up to, ns.
    jitter_ns: (i64, i64),
    stale: f64,
    future: f64,
    /// The camera counts anew at this frame.
    restarts_at: Option<u64>,
    vision_ns: (i64, i64),
    /// Probability that a thread is not run for a while, and how long, ns.
    stall: f64,
    stall_ns: i64,
    /// A tick that takes long.
    slow_tick: f64,
    slow_tick_ns: i64,
    /// The disk takes nothing for so long, from a time on, ns.
    disk: Option<(i64, i64)>,
    dies: Option<(Thread, i64)>,
    camera_hz: f64,
    /// Frames are sound until then, ns.
    calm_ns: i64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Thread {
    Camera,
    Control,
    Line,
    Recorder,
}

impl Default for Faults {
    fn default() -> Self {
        Self {
            lost: 0.0,
            doubled: 0.0,
            jitter_ns: (0, 0),
            stale: 0.0,
            future: 0.0,
            restarts_at: None,
            vision_ns: (100_000, 150_000),
            stall: 0.0,
            stall_ns: 0,
            slow_tick: 0.0,
            slow_tick_ns: 0,
            disk: None,
            dies: None,
            camera_hz: 1000.0,
            calm_ns: 0,
        }
    }
}

impl Faults {
    /// Some of everything, as the seed has it.
    fn any(dice: &mut Dice, duration_ns: i64) -> Self {
        let maybe = |dice: &mut Dice, probability: f64, most: f64| {
            if dice.hits(probability) {
                most * dice.part()
            } else {
                0.0
            }
        };
        let mut faults = Self {
            lost: maybe(dice, 0.5, 0.1),
            doubled: maybe(dice, 0.5, 1.0),
            stale: maybe(dice, 0.3, 0.1),
            future: maybe(dice, 0.3, 0.1),
            stall: maybe(dice, 0.5, 0.002),
            stall_ns: dice.within(1, 40 * MS),
            slow_tick: maybe(dice, 0.3, 0.01),
            slow_tick_ns: dice.within(1, 3 * MS),
            ..Self::default()
        };
        if dice.hits(0.5) {
            faults.jitter_ns = (0, dice.within(1, 2 * MS));
        }
        if dice.hits(0.5) {
            faults.calm_ns = 300 * MS;
        }
        if dice.hits(0.2) {
            faults.vision_ns = (100_000, dice.within(200_000, 2 * MS));
        }
        if dice.hits(0.2) {
            faults.restarts_at = Some(dice.next() % 1000);
        }
        if dice.hits(0.2) {
            let from_ns = dice.within(0, duration_ns);
            faults.disk = Some((from_ns, from_ns + dice.within(1, 20_000 * MS)));
        }
        if dice.hits(0.3) {
            let threads = [
                Thread::Camera,
                Thread::Control,
                Thread::Line,
                Thread::Recorder,
            ];
            let thread = threads[(dice.next() % 4) as usize];
            faults.dies = Some((thread, dice.within(0, duration_ns)));
        }
        let rates = [500.0, 990.0, 999.95, 1000.0, 1000.0, 1000.0, 1010.0, 2000.0];
        faults.camera_hz = rates[(dice.next() % 8) as usize];
        faults
    }
}

/// The emulated rig, and the output of its board at each step.
struct Rig {
    emulated: RigInABox,
    /// Each step of the output: when, ns, and to where, um.
    outputs: Vec<(i64, f64)>,
    line_is_dead: bool,
}

impl Rig {
    fn advance(&mut self, now_ns: i64) {
        // The box began at time 0, so that the board's clock is everybody's.
        loop {
            let step_ns = self.emulated.board().next_event_us().saturating_mul(1000);
            let step_ns = i64::try_from(step_ns).unwrap_or(i64::MAX);
            if step_ns > now_ns {
                break;
            }
            self.emulated.advance_to(step_ns);
            self.look();
        }
        self.emulated.advance_to(now_ns);
        self.look();
    }

    fn look(&mut self) {
        let um = self.emulated.applied_um();
        if self
            .outputs
            .last()
            .is_none_or(|(_, last_um)| *last_um != um)
        {
            self.outputs.push((self.emulated.now_ns(), um));
        }
    }
}

type Shelf = Arc<Mutex<Rig>>;

fn at(rig: &Shelf, now_ns: i64) -> MutexGuard<'_, Rig> {
    let mut rig = rig.lock().expect("no thread of a test panics with it");
    rig.advance(now_ns);
    rig
}

#[derive(Clone)]
struct Line {
    rig: Shelf,
    clock: Clock,
}

impl Port for Line {
    fn name(&self) -> &str {
        "line"
    }

    fn write_all(&mut self, bytes: &[u8]) -> std::io::Result<()> {
        let now_ns = self.clock.now_ns();
        let mut rig = at(&self.rig, now_ns);
        if rig.line_is_dead {
            return Err(std::io::ErrorKind::BrokenPipe.into());
        }
        let now_ns = now_ns.max(rig.emulated.now_ns());
        rig.emulated.receive(bytes, now_ns);
        rig.look();
        Ok(())
    }

    fn read_available(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let mut rig = at(&self.rig, self.clock.now_ns());
        Ok(rig.emulated.transmit(buffer))
    }
}

/// A camera with vision behind it that takes its time, and what goes wrong in both.
struct Source {
    rig: Shelf,
    clock: Clock,
    faults: Faults,
    dice: Dice,
    frames: u64,
    /// When each frame arrives, in order.
    queue: VecDeque<(i64, Measurement)>,
}

impl Source {
    fn arrive(&mut self, at_ns: i64, measurement: Measurement) {
        let place = self.queue.partition_point(|(ns, _)| *ns <= at_ns);
        self.queue.insert(place, (at_ns, measurement));
    }

    fn pump(&mut self) {
        let now_ns = self.clock.now_ns();
        loop {
            let mut rig = at(&self.rig, now_ns);
            let Some(fix) = rig.emulated.world_mut().take_position() else {
                break;
            };
            drop(rig);
            let n = self.frames;
            self.frames += 1;
            let mut m = Measurement {
                frame_id: match self.faults.restarts_at {
                    Some(first) if n >= first => n - first,
                    _ => 70_000 + n,
                },
                mid_exposure_ns: fix.info.mid_exposure_ns,
                ready_ns: 0,
                position_um: fix.x_um,
                variance_um2: fix.variance_um2,
                verdict: fix.verdict,
                track: None,
                snr: fix.snr,
                length_um: f64::NAN,
                length_sd_um: f64::NAN,
                area_sd_um2: f64::NAN,
                area_um2: f64::NAN,
                true_um: f64::NAN,
                true_pzt_um: f64::NAN,
            };
            if fix.info.delivery_ns < self.faults.calm_ns {
                self.arrive(fix.info.delivery_ns, m);
                continue;
            }
            if self.dice.hits(self.faults.lost) {
                continue;
            }
            if self.dice.hits(self.faults.stale) {
                m.mid_exposure_ns -= 6 * MS;
            }
            if self.dice.hits(self.faults.future) {
                m.mid_exposure_ns += self.dice.within(3 * MS, 3_600_000 * MS);
            }
            let (least, most) = self.faults.jitter_ns;
            let arrives_ns = fix.info.delivery_ns + self.dice.within(least, most);
            self.arrive(arrives_ns, m);
            if self.dice.hits(self.faults.doubled) {
                self.arrive(arrives_ns + MS / 2, m);
            }
        }
    }
}

impl PositionSource for Source {
    fn next(&mut self, _: i64) -> Result<Option<Measurement>, CameraError> {
        self.pump();
        let now_ns = self.clock.now_ns();
        if self.queue.front().is_none_or(|(ns, _)| *ns > now_ns) {
            return Ok(None);
        }
        let (_, mut m) = self.queue.pop_front().expect("asked above");
        let (least, most) = self.faults.vision_ns;
        let ready_ns = now_ns + self.dice.within(least, most);
        self.clock.sleep_until_ns(ready_ns);
        m.ready_ns = ready_ns;
        Ok(Some(m))
    }

    fn info(&self) -> SourceInfo {
        SourceInfo {
            name: "bent".to_string(),
            width_px: 0,
            height_px: 0,
            rate_hz: self.faults.camera_hz,
            latency_ms: 2.0,
            field_um: [-50.0, 50.0],
        }
    }
}

/// Counts the steps that it is led through, and follows them with a slow sine: its plan is right only where every period of
/// the clock reaches it.
struct Counting {
    steps: u64,
    clock: Clock,
    dice: Dice,
    slow_tick: f64,
    slow_tick_ns: i64,
}

impl ReferenceGenerator for Counting {
    fn step(&mut self, input: &ReferenceInput, preview_um: &mut [f64]) -> ReferenceOutput {
        let plan_s = self.steps as f64 * input.sample_s;
        self.steps += u64::from(input.running);
        let reference_um = 2.0 * (std::f64::consts::TAU * 3.0 * plan_s).sin();
        preview_um.fill(reference_um);
        if self.dice.hits(self.slow_tick) {
            self.clock
                .sleep_until_ns(self.clock.now_ns() + self.slow_tick_ns);
        }
        ReferenceOutput {
            reference_um,
            plan_ns: (plan_s * 1e9).round() as i64,
            stage: Stage::Running,
            phase: None,
            motion: 0,
        }
    }
}

struct Sink {
    records: Vec<TickRecord>,
    events: Vec<Event>,
    clock: Clock,
    disk: Option<(i64, i64)>,
    dies_at_ns: Option<i64>,
}

impl RunSink for Sink {
    fn tick(&mut self, record: &TickRecord) {
        if self.dies_at_ns.is_some_and(|ns| self.clock.now_ns() >= ns) {
            std::panic::resume_unwind(Box::new("the sink dies"));
        }
        self.records.push(*record);
    }
    fn event(&mut self, event: &Event) {
        self.events.push(*event);
    }
    fn progress(&mut self, _: &Statistics) {}
    fn is_ready(&self) -> bool {
        let now_ns = self.clock.now_ns();
        self.disk
            .is_none_or(|(from, until)| !(from..until).contains(&now_ns))
    }
}

/// How a run went.
struct Ran {
    /// `None`: control died.
    end: Option<ControlEnd>,
    io_error: Option<RunError>,
    report: RecorderReport,
    records: Vec<TickRecord>,
    events: Vec<Event>,
    outputs: Vec<(i64, f64)>,
    /// Where the board stood when it was armed, and some seconds after the end, um.
    stood_um: f64,
    applied_um: f64,
}

const SLEW_UM_PER_S: f64 = 600.0;

fn file() -> ControllerFile {
    let mut file = ControllerFile::from_pi(Pi::new(0.46, 19.5), 2.5e-3);
    file.limits = Limits {
        low_um: 2.0,
        high_um: 38.0,
        slew_um_per_s: SLEW_UM_PER_S,
        park_um: 2.0,
    };
    file
}

fn core<R: ReferenceGenerator>(reference: R, first_um: f64) -> Core<R> {
    Core::new(
        file().loop_config(&Model::eq6()).expect("a controller"),
        reference,
        Timing::default(),
        ArmingConfig {
            check: true,
            ..ArmingConfig::default()
        },
        &TransferFunction::eq6(),
        first_um,
        20.0,
    )
    .expect("a loop")
}

/// The threads of a run, and when each of them runs next.
struct Scheduler<'a> {
    faults: &'a Faults,
    dice: Dice,
    start_ns: i64,
    rig: Shelf,
    /// Of camera, control, actuator and recorder: no two threads are at the same instant.
    clocks: &'a [Clock; 4],
    next_ns: [i64; 4],
    shared: &'a Shared,
    operator: &'a Operator,
    seeing: Option<Seeing<'a>>,
    /// What the camera thread has found, until the time at which it was ready.
    seen: Consumer<Measurement>,
    on_its_way: VecDeque<Measurement>,
    to_control: Option<Producer<Measurement>>,
    controlling: Option<Controlling<'a, Counting>>,
    end: Option<ControlEnd>,
    acting: Option<Acting<'a>>,
    io_error: Option<RunError>,
    recorder: Recorder<'a, Sink>,
    recorded: bool,
}

impl Scheduler<'_> {
    fn dies(&self, thread: Thread, now_ns: i64) -> bool {
        matches!(self.faults.dies, Some((t, ns)) if t == thread && now_ns >= self.start_ns + ns)
    }

    fn wakes_after(&mut self, now_ns: i64) -> i64 {
        now_ns + self.dice.within(5_000, 60_000)
    }

    /// Runs whatever comes next; false when all threads have ended.
    fn step(&mut self, longest_ns: i64, asks: &[(i64, Request)]) -> bool {
        let soonest = (0..4).min_by_key(|&who| self.next_ns[who]);
        let who = soonest.expect("four threads");
        let due_ns = self.next_ns[who];
        if due_ns == i64::MAX {
            return false;
        }
        assert!(due_ns < longest_ns, "thread {who} does not end");
        if let Some(m) = self.on_its_way.pop_front_if(|m| m.ready_ns <= due_ns) {
            if let Some(ring) = &mut self.to_control {
                let _ = ring.push(m);
            }
            let wakes_ns = self.wakes_after(m.ready_ns);
            if self.controlling.is_some() {
                self.next_ns[1] = self.next_ns[1].min(wakes_ns);
            }
            return true;
        }
        for (ns, request) in asks {
            if (self.start_ns + ns..self.start_ns + ns + MS).contains(&due_ns) {
                self.operator.ask(*request);
            }
        }
        let late_ns = if self.dice.hits(self.faults.stall) {
            self.dice.within(0, self.faults.stall_ns)
        } else {
            0
        };
        let clock = self.clocks[who].clone();
        clock.sleep_until_ns(due_ns + late_ns);
        match who {
            0 => self.camera(&clock),
            1 => self.control(&clock),
            2 => self.actuator(&clock),
            _ => self.recorder(&clock),
        }
        true
    }

    fn camera(&mut self, clock: &Clock) {
        let dies = self.dies(Thread::Camera, clock.now_ns());
        let over = self.seeing.as_ref().is_none_or(Seeing::is_over);
        match &mut self.seeing {
            Some(seeing) if !over && !dies => {
                let found = seeing.round().expect("this camera does not fail");
                while let Ok(m) = self.seen.pop() {
                    self.on_its_way.push_back(m);
                }
                self.next_ns[0] = clock.now_ns() + if found { 1 } else { MS / 20 };
            }
            _ => {
                (self.seeing, self.to_control) = (None, None);
                self.next_ns[0] = i64::MAX;
            }
        }
    }

    fn control(&mut self, clock: &Clock) {
        if self.dies(Thread::Control, clock.now_ns()) {
            self.controlling = None;
        }
        let Some(mut controlling) = self.controlling.take() else {
            self.next_ns[1] = i64::MAX;
            return;
        };
        let next = controlling.round();
        let now_ns = clock.now_ns();
        self.next_ns[1] = match next {
            Next::Wait(until_ns) => self.wakes_after(until_ns.max(now_ns)),
            Next::Ticked => now_ns + 1,
            Next::Over(_) => i64::MAX,
        };
        if !matches!(next, Next::Wait(_)) && self.acting.is_some() {
            self.next_ns[2] = self.next_ns[2].min(self.wakes_after(now_ns));
        }
        match next {
            Next::Over(how) => self.end = Some(controlling.finish(how)),
            _ => self.controlling = Some(controlling),
        }
    }

    fn actuator(&mut self, clock: &Clock) {
        let now_ns = clock.now_ns();
        let dead = self.dies(Thread::Line, now_ns);
        at(&self.rig, now_ns).line_is_dead |= dead;
        self.next_ns[2] = now_ns + MS;
        if self.acting.as_mut().is_some_and(Acting::round) {
            self.io_error = self.acting.take().and_then(Acting::finish);
            self.shared.stop.store(true, Ordering::Release);
            self.next_ns[2] = i64::MAX;
        }
    }

    fn recorder(&mut self, clock: &Clock) {
        let now_ns = clock.now_ns();
        let over = self.controlling.is_none();
        let more = self.recorder.round(now_ns);
        if let Some(fault) = self.recorder.fault() {
            self.operator.unrecorded(fault);
        }
        self.recorded = over && !more;
        self.next_ns[3] = if self.recorded {
            i64::MAX
        } else {
            now_ns + 5 * MS
        };
    }
}

type HostBoard = BoardHost<Line>;

/// A rig whose board is armed, with the displacement at which it stands.
fn armed(seed: u64, faults: &Faults, clock: &Clock) -> (Shelf, HostBoard, f64) {
    let world = WorldConfig {
        seed,
        rate_hz: faults.camera_hz,
        exposure_ms: 0.2,
        ..WorldConfig::default()
    };
    let emulated = RigInABox::new(BoardConfig::default(), &world, &Model::eq6(), 0).expect("a rig");
    let rig: Shelf = Arc::new(Mutex::new(Rig {
        emulated,
        outputs: Vec::new(),
        line_is_dead: false,
    }));
    let line = Line {
        rig: Arc::clone(&rig),
        clock: clock.clone(),
    };
    let mut board = BoardHost::connect(line, clock.clone()).expect("a board");
    let limits = file().limits;
    let armed = board
        .arm(&ArmRequest {
            session: 4711,
            park_um: limits.park_um,
            limits: [limits.low_um, limits.high_um, limits.slew_um_per_s],
            watchdog_ms: Some(100),
            hold_watchdog_ms: None,
        })
        .expect("armed");
    (rig, board, armed.applied_um)
}

/// A run of `periods` with these faults.
fn run(seed: u64, periods: u64, faults: &Faults, asks: &[(i64, Request)]) -> Ran {
    let clocks: [Clock; 4] = std::array::from_fn(|_| Clock::virtual_at(0));
    let [camera_clock, control_clock, actuator_clock, recorder_clock] = &clocks;
    let (rig, mut board, stands_um) = armed(seed, faults, actuator_clock);
    let start_ns = actuator_clock.now_ns();
    for clock in &clocks {
        clock.sleep_until_ns(start_ns);
    }
    let reference = Counting {
        steps: 0,
        clock: control_clock.clone(),
        dice: Dice::new(seed ^ 0xABCD),
        slow_tick: faults.slow_tick,
        slow_tick_ns: faults.slow_tick_ns,
    };
    let sizes = RingSizes {
        records: 4096,
        ..RingSizes::default()
    };
    let core = core(reference, stands_um);
    let (ticker, ends) = Ticker::new(core, control_clock.clone(), start_ns, sizes);
    let (seen_in, seen) = RingBuffer::new(1024);
    let mut sink = Sink {
        records: Vec::new(),
        events: Vec::new(),
        clock: recorder_clock.clone(),
        disk: faults.disk.map(|(a, b)| (start_ns + a, start_ns + b)),
        dies_at_ns: match faults.dies {
            Some((Thread::Recorder, ns)) => Some(start_ns + ns),
            _ => None,
        },
    };
    let mut statistics = Statistics::default();
    let feed = Feed {
        records: ends.records,
        events: ends.events,
        learned: ends.learned,
    };
    let (shared, operator) = (Shared::default(), Operator::default());
    let mut source = Source {
        rig: Arc::clone(&rig),
        clock: camera_clock.clone(),
        faults: faults.clone(),
        dice: Dice::new(seed ^ 0x1234),
        frames: 0,
        queue: VecDeque::new(),
    };
    let rule = EndRule {
        ticks: Some(periods),
        ..EndRule::default()
    };
    let mut scheduler = Scheduler {
        faults,
        dice: Dice::new(seed),
        start_ns,
        rig: Arc::clone(&rig),
        clocks: &clocks,
        next_ns: [start_ns; 4],
        shared: &shared,
        operator: &operator,
        seeing: Some(Seeing::new(
            &mut source,
            seen_in,
            camera_clock.clone(),
            MS,
            &shared,
        )),
        seen,
        on_its_way: VecDeque::new(),
        to_control: Some(ends.measurements),
        controlling: Some(Controlling::new(
            ticker,
            control_clock.clone(),
            rule,
            &operator,
            &shared,
        )),
        end: None,
        acting: Some(Acting::new(&mut board, ends.orders, ends.reports)),
        io_error: None,
        recorder: Recorder::new(feed, &mut sink, &mut statistics),
        recorded: false,
    };
    let longest_ns = start_ns + (periods as i64 + 30_000) * MS;
    while scheduler.step(longest_ns, asks) {}
    let Scheduler {
        end,
        mut io_error,
        recorder,
        ..
    } = scheduler;
    let report = recorder.finish();
    let life = end.as_ref().map_or(Life::Safe, |end| end.life);
    let latest_ns = clocks.iter().map(Clock::now_ns).max().expect("four");
    actuator_clock.sleep_until_ns(latest_ns);
    if let Err(error) = close_session(&mut board, life, |span| actuator_clock.sleep(span)) {
        io_error.get_or_insert(error.into());
    }
    // A board that hears nothing holds for two seconds before it parks.
    let over_ns = actuator_clock.now_ns() + 4000 * MS;
    let mut rig = at(&rig, over_ns);
    Ran {
        end,
        io_error,
        report,
        records: sink.records,
        events: sink.events,
        stood_um: stands_um,
        applied_um: rig.emulated.applied_um(),
        outputs: std::mem::take(&mut rig.outputs),
    }
}

/// Nothing of what a run must keep to, whatever happens, is broken.
fn check(ran: &Ran, faults: &Faults) {
    let limits = file().limits;
    // The board's converter rounds to steps of 0.6 nm.
    let step_um = 40.0 / 65_535.0;
    for (_, um) in &ran.outputs {
        let range = limits.low_um.min(ran.stood_um) - step_um..=limits.high_um + step_um;
        assert!(range.contains(um), "{um} um");
    }
    for window in [1, 2, 5, 10, 50, 200] {
        for (from, to) in ran.outputs.iter().zip(ran.outputs.iter().skip(window)) {
            // The board's clock counts microseconds.
            let apart_s = (to.0 - from.0 + 1000) as f64 * 1e-9;
            let most_um = SLEW_UM_PER_S * apart_s + step_um * 1.001;
            assert!(
                (to.1 - from.1).abs() <= most_um,
                "{from:?} -> {to:?} in {window} steps"
            );
        }
    }
    assert!(
        (ran.applied_um - limits.park_um).abs() < 2.0 * step_um,
        "parked at {} um",
        ran.applied_um
    );
    let Some(end) = &ran.end else {
        assert_eq!(faults.dies.map(|(thread, _)| thread), Some(Thread::Control));
        return;
    };
    let kept = ran.records.len() as u64 + ran.report.records_unkept + end.account.records_lost;
    assert_eq!(
        kept, end.counts.ticks,
        "every tick is recorded or counted as lost"
    );
    // The board of these runs does what it is told.
    let blamed = [
        SafeReason::BoardForeign,
        SafeReason::BoardNotObeying,
        SafeReason::BoardNotFollowing,
    ];
    assert!(
        end.safe_reason
            .is_none_or(|reason| !blamed.contains(&reason))
    );
    assert_eq!(end.life == Life::Safe, end.safe_reason.is_some());
    assert!(end.end != End::Duration || end.safe_reason.is_none());
    if end.safe_reason != Some(SafeReason::Stalled) {
        check_plan(&ran.records);
    }
}

/// At every tick the plan is where the clock is, whatever the frames did.
fn check_plan(records: &[TickRecord]) {
    let closed = records.iter().find(|r| r.life == Life::Running as u8);
    let Some(closed) = closed else { return };
    for record in records.iter().filter(|r| r.life == Life::Running as u8) {
        let clock_ns = record.time_ns - closed.time_ns;
        assert!(
            (record.plan_ns - closed.plan_ns - clock_ns).abs() <= MS,
            "plan {} ns, clock {clock_ns} ns",
            record.plan_ns
        );
    }
}

fn replays(ran: &Ran) {
    let reference = Counting {
        steps: 0,
        clock: Clock::virtual_at(0),
        dice: Dice::new(0),
        slow_tick: 0.0,
        slow_tick_ns: 0,
    };
    let mut replay = Replay::new(core(reference, ran.stood_um));
    for record in &ran.records {
        replay.add(record);
    }
    let outcome = replay.outcome();
    assert_eq!(outcome.first_mismatch, None);
    assert_eq!(outcome.identical, ran.records.len() as u64);
}

#[test]
fn plan_and_clock_agree_within_a_thousandth_whatever_the_frames_do() {
    let doubled = Faults {
        doubled: 1.0,
        ..Faults::default()
    };
    let jitter = Faults {
        jitter_ns: (MS / 2, 2 * MS),
        calm_ns: 500 * MS,
        ..Faults::default()
    };
    let lost = Faults {
        lost: 0.05,
        ..Faults::default()
    };
    let rate = |camera_hz| Faults {
        camera_hz,
        ..Faults::default()
    };
    let cases = [doubled, jitter, lost]
        .into_iter()
        .chain([500.0, 990.0, 1010.0, 2000.0].map(rate));
    for (seed, faults) in (1..).zip(cases) {
        let ran = run(seed, 6000, &faults, &[]);
        check(&ran, &faults);
        let end = ran.end.as_ref().expect("control lives");
        assert_eq!(
            (end.end, end.safe_reason),
            (End::Duration, None),
            "{faults:?}"
        );
        let closed = |r: &&TickRecord| r.life == Life::Running as u8;
        let first = ran.records.iter().find(closed).expect("closed");
        let last = ran.records.last().expect("records");
        let clock_s = (last.time_ns - first.time_ns) as f64;
        let plan_s = (last.plan_ns - first.plan_ns) as f64;
        assert!((plan_s / clock_s - 1.0).abs() < 1e-3, "{faults:?}");
        assert!(clock_s > 5.5e9, "{faults:?}");
        replays(&ran);
    }
}

#[test]
fn a_camera_that_restarts_does_not_end_the_run() {
    let faults = Faults {
        restarts_at: Some(1000),
        ..Faults::default()
    };
    let ran = run(7, 3000, &faults, &[]);
    let end = ran.end.expect("control lives");
    assert_eq!((end.end, end.safe_reason), (End::Duration, None));
    assert_eq!((end.counts.camera_restarts, end.counts.frames_lost), (1, 0));
}

#[test]
fn frames_lost_are_counted_once_though_others_are_old() {
    let faults = Faults {
        lost: 0.05,
        stale: 0.1,
        ..Faults::default()
    };
    let ran = run(3, 6000, &faults, &[]);
    let end = ran.end.expect("control lives");
    let lost = end.counts.frames_lost as f64;
    assert!((lost / 6000.0 - 0.05).abs() < 0.01, "{lost}");
}

#[test]
fn frames_from_the_future_are_not_used_and_end_the_run_when_there_are_no_others() {
    let faults = Faults {
        future: 1.0,
        ..Faults::default()
    };
    let ran = run(3, 6000, &faults, &[]);
    check(&ran, &faults);
    let end = ran.end.expect("control lives");
    assert_eq!(end.safe_reason, Some(SafeReason::StaleFrames));
    assert!(end.counts.future >= 5);
}

#[test]
fn vision_slower_than_the_camera_ends_the_run_by_its_name() {
    let faults = Faults {
        vision_ns: (1_200_000, 1_200_000),
        ..Faults::default()
    };
    let ran = run(5, 20_000, &faults, &[]);
    check(&ran, &faults);
    let end = ran.end.as_ref().expect("control lives");
    assert_eq!(end.safe_reason, Some(SafeReason::VisionSlow));
    let told = ran.events.iter().find_map(|event| match event.kind {
        crate::life::EventKind::VisionSlowStarted {
            vision_ms,
            period_ms,
        } => Some((vision_ms, period_ms)),
        _ => None,
    });
    assert_eq!(told, Some((1.2, 1.0)));
}

#[test]
fn each_thread_that_dies_ends_the_run_by_its_name() {
    for thread in [
        Thread::Camera,
        Thread::Control,
        Thread::Line,
        Thread::Recorder,
    ] {
        let faults = Faults {
            dies: Some((thread, 500 * MS)),
            ..Faults::default()
        };
        let ran = run(11, 20_000, &faults, &[]);
        check(&ran, &faults);
        let reason = ran.end.as_ref().map(|end| end.safe_reason);
        let expected = match thread {
            Thread::Camera => Some(Some(SafeReason::CameraLost)),
            Thread::Control => None,
            Thread::Line => Some(Some(SafeReason::LinkLost)),
            Thread::Recorder => Some(Some(SafeReason::Unrecorded)),
        };
        assert_eq!(reason, expected, "{thread:?}");
        assert_eq!(ran.io_error.is_some(), thread == Thread::Line, "{thread:?}");
    }
}

#[test]
fn freeze_and_park_take_the_clocks_time_with_doubled_frames() {
    let faults = Faults {
        doubled: 1.0,
        ..Faults::default()
    };
    let ran = run(2, 20_000, &faults, &[(2000 * MS, Request::Freeze)]);
    check(&ran, &faults);
    assert_eq!(ran.end.as_ref().map(|end| end.end), Some(End::Operator));
    let frozen = |r: &&TickRecord| r.flags.has(TickFlags::FREEZE);
    let first = ran.records.iter().find(frozen).expect("frozen");
    let last = ran.records.last().expect("records");
    let frozen_ms = (last.time_ns - first.time_ns) / MS;
    assert!((frozen_ms - 500).abs() <= 2, "{frozen_ms} ms");
}

fn any_orders(seeds: std::ops::Range<u64>) {
    let periods = 1500;
    for seed in seeds {
        let mut dice = Dice::new(seed ^ 0x5EED);
        let faults = Faults::any(&mut dice, periods as i64 * MS);
        let asks: Vec<_> = (0..dice.next() % 3)
            .map(|_| {
                let asked = [
                    Request::Freeze,
                    Request::Pause,
                    Request::None,
                    Request::Park,
                ];
                let at_ns = dice.within(0, periods as i64 * MS);
                (at_ns, asked[(dice.next() % 4) as usize])
            })
            .collect();
        let outcome = std::panic::catch_unwind(|| {
            let ran = run(seed, periods, &faults, &asks);
            check(&ran, &faults);
            if ran.report.records_unkept == 0
                && ran
                    .end
                    .as_ref()
                    .is_some_and(|e| e.account.records_lost == 0)
            {
                replays(&ran);
            }
        });
        assert!(outcome.is_ok(), "seed {seed}: {faults:?}, {asks:?}");
    }
}

#[test]
fn sixty_random_orders_of_faults_break_nothing() {
    any_orders(0..60);
}

#[test]
#[ignore = "five minutes: cargo test -p cellpos-runtime --lib five_thousand -- --ignored"]
fn five_thousand_random_orders_of_faults_break_nothing() {
    any_orders(60..5060);
}
