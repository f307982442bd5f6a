//! The rig of these tests, and its faults.

use super::*;
use cellpos_numeric::Random;

/// Numbers for the scheduler and the faults.
#[derive(Debug, Clone)]
pub(super) struct Dice(Random);

impl Dice {
    pub(super) fn new(seed: u64) -> Self {
        Self(Random::new(seed))
    }

    pub(super) fn next(&mut self) -> u64 {
        self.0.bits() >> 11
    }

    pub(super) fn part(&mut self) -> f64 {
        self.0.uniform()
    }

    pub(super) fn hits(&mut self, probability: f64) -> bool {
        self.part() < probability
    }

    pub(super) fn within(&mut self, least_ns: i64, most_ns: i64) -> i64 {
        least_ns + (self.part() * (most_ns - least_ns) as f64) as i64
    }
}

/// What goes wrong, and how often.
#[derive(Debug, Clone)]
pub(super) struct Faults {
    pub(super) lost: f64,
    pub(super) doubled: f64,
    /// Delays of frames, from and up to, ns.
    pub(super) jitter_ns: (i64, i64),
    pub(super) stale: f64,
    pub(super) future: f64,
    /// The exposure is late for its time of arrival: the camera path is shorter than the loop's setting.
    pub(super) early: f64,
    /// The camera keeps its frames from a time on, and delivers them at once at another, ns.
    pub(super) burst: Option<(i64, i64)>,
    /// Number of the first tick, of the first frame and of the first command.
    pub(super) first: (u64, u64, u32),
    /// The camera restarts its count at this frame.
    pub(super) restarts_at: Option<u64>,
    pub(super) vision_ns: (i64, i64),
    /// From, until, and how long each frame takes in between, ns.
    pub(super) vision_slow: Option<(i64, i64, i64)>,
    /// Probability that a thread is not run for a while, and how long, ns.
    pub(super) stall: f64,
    pub(super) stall_ns: i64,
    /// A tick that takes long.
    pub(super) slow_tick: f64,
    pub(super) slow_tick_ns: i64,
    /// The disk takes nothing for so long, from a time on, ns.
    pub(super) disk: Option<(i64, i64)>,
    /// The recorder's thread does not come back from a write for so long, from a time on, ns.
    pub(super) hangs: Option<(i64, i64)>,
    /// The disk takes what is written and confirms nothing from a time on until another, ns.
    pub(super) unconfirmed: Option<(i64, i64)>,
    /// The board hears no command any more from a time on, ns; it is heard all the same.
    pub(super) deaf: Option<i64>,
    pub(super) dies: Option<(Thread, i64)>,
    /// What goes wrong on the line to the board; its times count from the start of the run.
    pub(super) line: LineFaults,
    /// What board and camera do of themselves.
    pub(super) peers: Peers,
    pub(super) camera_hz: f64,
    /// Frames are sound until then, ns.
    pub(super) calm_ns: i64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Thread {
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
            early: 0.0,
            burst: None,
            first: (0, 70_000, 0),
            restarts_at: None,
            vision_ns: (100_000, 150_000),
            vision_slow: None,
            stall: 0.0,
            stall_ns: 0,
            slow_tick: 0.0,
            slow_tick_ns: 0,
            disk: None,
            hangs: None,
            unconfirmed: None,
            deaf: None,
            dies: None,
            line: LineFaults::default(),
            peers: Peers::default(),
            camera_hz: 1000.0,
            calm_ns: 0,
        }
    }
}

impl Faults {
    /// Some of everything, as the seed has it.
    pub(super) fn any(dice: &mut Dice, duration_ns: i64) -> Self {
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
            early: maybe(dice, 0.3, 0.5),
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
        if dice.hits(0.1) {
            let from_ns = dice.within(0, duration_ns);
            faults.hangs = Some((from_ns, from_ns + dice.within(1, 5000 * MS)));
        }
        if dice.hits(0.1) {
            let from_ns = dice.within(0, duration_ns);
            faults.unconfirmed = Some((from_ns, from_ns + dice.within(1, 10_000 * MS)));
        }
        if dice.hits(0.2) {
            let from_ns = dice.within(0, duration_ns);
            faults.burst = Some((from_ns, from_ns + dice.within(1, 300 * MS)));
        }
        if dice.hits(0.1) {
            faults.deaf = Some(dice.within(0, duration_ns));
        }
        if dice.hits(0.3) {
            faults.line = LineFaults {
                stalls_per_s: maybe(dice, 0.5, 3.0),
                part: maybe(dice, 0.5, 0.2),
                byte_loss: maybe(dice, 0.5, 1e-3),
                ..LineFaults::default()
            };
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
pub(super) struct Rig {
    pub(super) emulated: RigInABox,
    /// Each step of the output: when, ns, and to where, um.
    pub(super) outputs: Vec<(i64, f64)>,
    pub(super) line_is_dead: bool,
    pub(super) is_deaf: bool,
}

impl Rig {
    pub(super) fn advance(&mut self, now_ns: i64) {
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

    pub(super) fn look(&mut self) {
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

pub(super) type Shelf = Arc<Mutex<Rig>>;

pub(super) fn at(rig: &Shelf, now_ns: i64) -> MutexGuard<'_, Rig> {
    let mut rig = rig.lock().expect("no thread of a test panics with it");
    rig.advance(now_ns);
    rig
}

#[derive(Clone)]
pub(super) struct Line {
    pub(super) rig: Shelf,
    pub(super) clock: Clock,
    pub(super) answers: Answers,
}

impl Port for Line {
    fn name(&self) -> &str {
        "line"
    }

    fn write_some(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let now_ns = self.clock.now_ns();
        let mut rig = at(&self.rig, now_ns);
        if rig.line_is_dead {
            return Err(std::io::ErrorKind::BrokenPipe.into());
        }
        if rig.is_deaf {
            return Ok(bytes.len());
        }
        let now_ns = now_ns.max(rig.emulated.now_ns());
        rig.emulated.receive(bytes, now_ns);
        rig.look();
        Ok(bytes.len())
    }

    fn read_available(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let now_ns = self.clock.now_ns();
        let mut rig = at(&self.rig, now_ns);
        if rig.line_is_dead {
            return Err(std::io::ErrorKind::BrokenPipe.into());
        }
        let mut sent = [0; 512];
        loop {
            let length = rig.emulated.transmit(&mut sent);
            if length == 0 {
                break;
            }
            self.answers.sent(&sent[..length], now_ns);
        }
        Ok(self.answers.take(buffer, now_ns))
    }
}

/// A camera with vision behind it that takes its time, and what goes wrong in both.
pub(super) struct Source {
    pub(super) rig: Shelf,
    pub(super) clock: Clock,
    pub(super) faults: Faults,
    pub(super) dice: Dice,
    pub(super) frames: u64,
    /// Whether the last frame of a camera at half its rate was not made.
    pub(super) skipped: bool,
    /// When each frame arrives, in order.
    pub(super) queue: VecDeque<(i64, Measurement)>,
}

impl Source {
    pub(super) fn arrive(&mut self, at_ns: i64, measurement: Measurement) {
        let place = self.queue.partition_point(|(ns, _)| *ns <= at_ns);
        self.queue.insert(place, (at_ns, measurement));
    }

    pub(super) fn pump(&mut self) {
        let now_ns = self.clock.now_ns();
        loop {
            let mut rig = at(&self.rig, now_ns);
            let Some(fix) = rig.emulated.world_mut().take_position() else {
                break;
            };
            drop(rig);
            let halved = (self.faults.peers.half_the_rate_ns)
                .is_some_and(|(from, until)| (from..until).contains(&fix.info.delivery_ns));
            self.skipped = halved && !self.skipped;
            if self.skipped {
                continue;
            }
            let n = self.frames;
            self.frames += 1;
            let mut m = Measurement {
                frame_id: match self.faults.restarts_at {
                    Some(first) if n >= first => n - first,
                    _ => self.faults.first.1.wrapping_add(n),
                },
                mid_exposure_ns: self.faults.peers.stamp_ns(fix.info.mid_exposure_ns),
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
            if self.dice.hits(self.faults.early) {
                m.mid_exposure_ns += self.dice.within(MS / 2, 3 * MS / 2);
            }
            let (least, most) = self.faults.jitter_ns;
            let mut arrives_ns = fix.info.delivery_ns + self.dice.within(least, most);
            if let Some((from_ns, until_ns)) = self.faults.burst
                && (from_ns..until_ns).contains(&arrives_ns)
            {
                arrives_ns = until_ns;
            }
            let arrives_ns = self.faults.peers.arrival_ns(arrives_ns);
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
        let takes_ns = self.dice.within(least, most);
        let slow = self
            .faults
            .vision_slow
            .filter(|(from_ns, until_ns, _)| (*from_ns..*until_ns).contains(&now_ns));
        let ready_ns = now_ns + slow.map_or(takes_ns, |(_, _, ns)| ns);
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
            exposure_s: 0.0,
            field_um: [-50.0, 50.0],
        }
    }
}

/// Counts the steps that it is led through, and follows them with a slow sine: its plan is right only where every period of
/// the clock reaches it.
pub(super) struct Counting {
    pub(super) steps: u64,
    pub(super) clock: Clock,
    pub(super) dice: Dice,
    pub(super) slow_tick: f64,
    pub(super) slow_tick_ns: i64,
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

pub(super) struct Sink {
    pub(super) records: Vec<TickRecord>,
    pub(super) events: Vec<Event>,
    pub(super) clock: Clock,
    pub(super) disk: Option<(i64, i64)>,
    pub(super) unconfirmed: Option<(i64, i64)>,
    pub(super) dies_at_ns: Option<i64>,
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
    fn unconfirmed(&self) -> Unconfirmed {
        let now_ns = self.clock.now_ns();
        let waits = |(from, until): &(i64, i64)| (*from..*until).contains(&now_ns);
        let Some((from_ns, _)) = self.unconfirmed.filter(waits) else {
            return Unconfirmed::default();
        };
        Unconfirmed {
            since: std::time::Duration::from_nanos((now_ns - from_ns).unsigned_abs()),
            rows: ((now_ns - from_ns) / MS).unsigned_abs(),
        }
    }
    fn is_ready(&self) -> bool {
        let now_ns = self.clock.now_ns();
        self.disk
            .is_none_or(|(from, until)| !(from..until).contains(&now_ns))
    }
}
