//! The scheduler: runs the threads' rounds on separate clocks, in any order.

use super::*;

/// How a run went.
pub(super) struct Ran {
    /// `None`: control died.
    pub(super) end: Option<ControlEnd>,
    pub(super) commands: Option<CommandAccount>,
    pub(super) io_error: Option<RunError>,
    pub(super) report: RecorderReport,
    /// News of the recorder at the operator's end of the loop.
    pub(super) fault: Option<RecorderFault>,
    pub(super) records: Vec<TickRecord>,
    pub(super) events: Vec<Event>,
    pub(super) outputs: Vec<(i64, f64)>,
    /// Where the board stood when it was armed, and some seconds after the end, um.
    pub(super) stood_um: f64,
    pub(super) applied_um: f64,
}

/// The threads of a run, and the time of the next round of each.
pub(super) struct Scheduler<'a> {
    pub(super) faults: &'a Faults,
    pub(super) dice: Dice,
    pub(super) start_ns: i64,
    pub(super) rig: Shelf,
    /// Of camera, control, actuator and recorder: no two threads are at the same instant.
    pub(super) clocks: &'a [Clock; 4],
    pub(super) next_ns: [i64; 4],
    pub(super) shared: &'a Shared,
    pub(super) operator: &'a Operator,
    pub(super) seeing: Option<Seeing<'a>>,
    /// Results of the camera thread, until the time at which they were ready.
    pub(super) seen: Consumer<Measurement>,
    pub(super) on_its_way: VecDeque<Measurement>,
    pub(super) to_control: Option<Producer<Measurement>>,
    pub(super) controlling: Option<Controlling<'a, Counting>>,
    pub(super) end: Option<ControlEnd>,
    pub(super) acting: Option<Acting<'a>>,
    pub(super) io_error: Option<RunError>,
    pub(super) recorder: Recorder<'a, Sink>,
    pub(super) recorded: bool,
}

impl Scheduler<'_> {
    pub(super) fn dies(&self, thread: Thread, now_ns: i64) -> bool {
        matches!(self.faults.dies, Some((t, ns)) if t == thread && now_ns >= self.start_ns + ns)
    }

    pub(super) fn wakes_after(&mut self, now_ns: i64) -> i64 {
        now_ns + self.dice.within(5_000, 60_000)
    }

    /// Runs whatever comes next; false when all threads have ended.
    pub(super) fn step(&mut self, longest_ns: i64, asks: &[(i64, Request)]) -> bool {
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
        if let Some([from_ns, to_ns]) = self.faults.peers.board_thread_stalls_ns
            && who == 2
            && (self.start_ns + from_ns..self.start_ns + to_ns).contains(&due_ns)
        {
            self.next_ns[2] = self.start_ns + to_ns;
            return true;
        }
        let late_ns = if self.dice.hits(self.faults.stall) {
            self.dice.within(0, self.faults.stall_ns)
        } else {
            0
        };
        let stalled = (self.faults.peers.stall_ns).filter(|[from_ns, to_ns]| {
            who == 1 && (self.start_ns + from_ns..self.start_ns + to_ns).contains(&due_ns)
        });
        let late_ns = stalled.map_or(late_ns, |[_, to_ns]| self.start_ns + to_ns - due_ns);
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

    pub(super) fn camera(&mut self, clock: &Clock) {
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

    pub(super) fn control(&mut self, clock: &Clock) {
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

    pub(super) fn actuator(&mut self, clock: &Clock) {
        let now_ns = clock.now_ns();
        let dead = self.dies(Thread::Line, now_ns);
        let deaf = (self.faults.deaf).is_some_and(|ns| now_ns >= self.start_ns + ns);
        {
            let mut rig = at(&self.rig, now_ns);
            rig.line_is_dead |= dead;
            rig.is_deaf |= deaf;
        }
        self.next_ns[2] = now_ns + MS;
        if self.acting.as_mut().is_some_and(Acting::round) {
            self.io_error = self.acting.take().and_then(Acting::finish);
            self.shared.stop.store(true, Ordering::Release);
            self.next_ns[2] = i64::MAX;
        }
    }

    pub(super) fn recorder(&mut self, clock: &Clock) {
        let now_ns = clock.now_ns();
        if let Some((from_ns, until_ns)) = self.faults.hangs
            && (from_ns..until_ns).contains(&(now_ns - self.start_ns))
        {
            self.next_ns[3] = self.start_ns + until_ns;
            return;
        }
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

pub(super) type HostBoard = BoardHost<MisbehavingLine<Line>>;

/// A rig whose board is armed, with the displacement at which it stands.
pub(super) fn armed(seed: u64, faults: &Faults, clock: &Clock) -> (Shelf, HostBoard, f64) {
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
        is_deaf: false,
    }));
    let line = Line {
        rig: Arc::clone(&rig),
        clock: clock.clone(),
        answers: Answers::new(&faults.peers, seed),
    };
    // Sound until the run has begun.
    let line = MisbehavingLine::new(line, clock.clone(), LineFaults::default(), seed);
    let mut board = BoardHost::connect(line, clock.clone()).expect("a board");
    board.count_from(faults.first.2);
    let limits = file().limits;
    let request = |session| ArmRequest {
        session,
        park_um: limits.park_um,
        limits: [limits.low_um, limits.high_um, limits.slew_um_per_s],
        watchdog_ms: Some(100),
        hold_watchdog_ms: None,
    };
    if faults.peers.forgets_ns.is_some() {
        // The session that it will remember.
        board.arm(&request(4710)).expect("armed");
        board.disarm().expect("disarmed");
    }
    let armed = board.arm(&request(4711)).expect("armed");
    (rig, board, armed.applied_um)
}

/// A sink that keeps everything, on a disk with these faults.
fn sink(faults: &Faults, start_ns: i64, clock: &Clock) -> Sink {
    let at = |(from_ns, until_ns): (i64, i64)| (start_ns + from_ns, start_ns + until_ns);
    Sink {
        records: Vec::new(),
        events: Vec::new(),
        clock: clock.clone(),
        disk: faults.disk.map(at),
        unconfirmed: faults.unconfirmed.map(at),
        dies_at_ns: match faults.dies {
            Some((Thread::Recorder, ns)) => Some(start_ns + ns),
            _ => None,
        },
    }
}

/// The positions of the rig's bead, through a camera with these faults.
fn source(seed: u64, faults: &Faults, rig: &Shelf, clock: &Clock) -> Source {
    Source {
        rig: Arc::clone(rig),
        clock: clock.clone(),
        faults: faults.clone(),
        dice: Dice::new(seed ^ 0x1234),
        frames: 0,
        skipped: false,
        queue: VecDeque::new(),
    }
}

/// A run of `periods` with these faults.
pub(super) fn run(seed: u64, periods: u64, faults: &Faults, asks: &[(i64, Request)]) -> Ran {
    let clocks: [Clock; 4] = std::array::from_fn(|_| Clock::virtual_at(0));
    let [camera_clock, control_clock, actuator_clock, recorder_clock] = &clocks;
    let (rig, mut board, stands_um) = armed(seed, faults, actuator_clock);
    let start_ns = actuator_clock.now_ns();
    board.port_mut().misbehave(faults.line.from(start_ns));
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
    let core = core(reference, stands_um).counted_from(faults.first.0);
    let (ticker, ends) = Ticker::new(core, None, control_clock.clone(), start_ns, sizes);
    let (seen_in, seen) = RingBuffer::new(1024);
    let mut sink = sink(faults, start_ns, recorder_clock);
    let mut statistics = Statistics::default();
    let feed = ends.feed;
    let (shared, operator) = (Shared::default(), Operator::default());
    let mut source = source(seed, faults, &rig, camera_clock);
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
        acting: Some(Acting::new(&mut board, ends.orders, ends.heard)),
        io_error: None,
        recorder: Recorder::new(feed, &mut sink, &mut statistics, &shared.pulse),
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
        commands: board.account(),
        io_error,
        report,
        fault: operator.recorder_fault(),
        records: sink.records,
        events: sink.events,
        stood_um: stands_um,
        applied_um: rig.emulated.applied_um(),
        outputs: std::mem::take(&mut rig.outputs),
    }
}
