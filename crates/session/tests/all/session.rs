//! A session from open to finished, on the emulated rig, with devices in between that misbehave and record their calls.

use cellpos_control::{ControlLaw, Controller, LawInput, LawOutput};
use cellpos_emulator::EmulatedRig;
use cellpos_plant::Model;
use cellpos_rig::{
    Actuator, ActuatorError, ActuatorInfo, ActuatorReport, ActuatorState, ArmRequest, CameraError,
    Clock, Measurement, PositionSource, SourceInfo,
};
use cellpos_runtime::life::Refusal;
use cellpos_runtime::{EndRule, Event, NoSink, Request, RunSink, Statistics, TickRecord};
use cellpos_session::rig_file::{ClockKind, Frames};
use cellpos_session::setup::{ReferenceSpec, Setup};
use cellpos_session::{EndKind, Options, Rig, RigFile};
use std::sync::{Arc, Mutex};
use std::time::Duration;

type Log = Arc<Mutex<Vec<&'static str>>>;

/// What the board in between does with the answer to `arm`.
type Answer = fn(&mut ActuatorReport);

struct Board {
    inner: Box<dyn Actuator>,
    log: Log,
    answer: Answer,
}

impl Board {
    fn told(&self, what: &'static str) {
        let mut log = self.log.lock().expect("no test panics with it");
        if log.last() != Some(&what) {
            log.push(what);
        }
    }
}

impl Actuator for Board {
    fn info(&self) -> ActuatorInfo {
        self.inner.info()
    }
    fn arm(&mut self, session: &ArmRequest) -> Result<ActuatorReport, ActuatorError> {
        self.told("arm");
        let mut report = self.inner.arm(session)?;
        (self.answer)(&mut report);
        Ok(report)
    }
    fn command(&mut self, um: f64, neutral_um: f64, us: u64) -> Result<(), ActuatorError> {
        self.told("command");
        self.inner.command(um, neutral_um, us)
    }
    fn freeze(&mut self) -> Result<(), ActuatorError> {
        self.told("freeze");
        self.inner.freeze()
    }
    fn park(&mut self) -> Result<(), ActuatorError> {
        self.told("park");
        self.inner.park()
    }
    fn disarm(&mut self) -> Result<(), ActuatorError> {
        self.told("disarm");
        self.inner.disarm()
    }
    fn poll(&mut self) -> Result<Option<ActuatorReport>, ActuatorError> {
        self.inner.poll()
    }
}

/// Positions that are changed on their way.
struct Changed<P> {
    inner: P,
    change: fn(&mut Measurement),
}

impl<P: PositionSource> PositionSource for Changed<P> {
    fn next(&mut self, deadline_ns: i64) -> Result<Option<Measurement>, CameraError> {
        let mut next = self.inner.next(deadline_ns)?;
        if let Some(measurement) = &mut next {
            (self.change)(measurement);
        }
        Ok(next)
    }
    fn info(&self) -> SourceInfo {
        self.inner.info()
    }
}

fn rig(clock: ClockKind, change: fn(&mut Measurement), answer: Answer) -> (Rig, Log) {
    rig_with(clock, true, change, answer)
}

/// Locked memory is the whole process's: only one test of this program asks for real time.
fn rig_with(
    clock: ClockKind,
    best_effort: bool,
    change: fn(&mut Measurement),
    answer: Answer,
) -> (Rig, Log) {
    let file = RigFile::default();
    let options = Options {
        clock,
        frames: Frames::Off,
        best_effort,
    };
    let time = match clock {
        ClockKind::Real => Clock::Real,
        ClockKind::Virtual => Clock::virtual_at(0),
    };
    let model = Model::load("eq6").expect("built in");
    let emulated = EmulatedRig::new(file.board, &file.emulator, &model, time.clone())
        .expect("the default rig");
    let log = Log::default();
    let board = Board {
        inner: Box::new(emulated.actuator().expect("it answers")),
        log: Arc::clone(&log),
        answer,
    };
    let source = Changed {
        inner: emulated.positions(),
        change,
    };
    let rig = Rig::with_devices(file, options, Box::new(source), Box::new(board), time);
    (rig.expect("the nominal model"), log)
}

fn set_up(rig: &mut Rig) -> Setup {
    let prepared = rig.prepare("eq6", "pi").expect("a PI for Eq. (6)");
    let hold = ReferenceSpec::Hold { position_um: 0.0 };
    rig.set_up(prepared, hold).expect("the PZT stands")
}

fn ticks(ticks: u64) -> EndRule {
    EndRule {
        ticks: Some(ticks),
        ..EndRule::default()
    }
}

fn told(log: &Log) -> Vec<&'static str> {
    log.lock().expect("no test panics with it").clone()
}

#[test]
fn nothing_reaches_the_board_before_it_is_armed_and_the_run_ends_disarmed() {
    let (mut rig, log) = rig(ClockKind::Virtual, |_| {}, |_| {});
    let setup = set_up(&mut rig);
    let core = setup.core().expect("a loop");
    assert_eq!(told(&log), [""; 0], "set up, and nothing armed yet");
    let armed = rig.arm(&setup, core, NoSink, ticks(500)).ok();
    assert_eq!(told(&log), ["arm"]);
    let finished = armed.expect("armed").start().and_then(|run| run.wait());
    let finished = finished.expect("a run");
    assert_eq!(finished.ended.kind, EndKind::Done, "{}", finished.ended);
    assert_eq!(told(&log), ["arm", "command", "freeze", "disarm"]);
}

#[test]
fn what_holds_an_armed_board_disarms_it_when_it_is_dropped() {
    let (mut rig, log) = rig(ClockKind::Virtual, |_| {}, |_| {});
    let setup = set_up(&mut rig);
    let core = setup.core().expect("a loop");
    drop(rig.arm(&setup, core, NoSink, ticks(500)));
    assert_eq!(told(&log), ["arm", "freeze", "disarm"]);
}

#[test]
fn an_answer_to_arm_that_is_not_this_session_armed_is_refused_and_disarmed() {
    let answers: [(Answer, &str); 3] = [
        (|r| r.state = ActuatorState::Safe, "Safe"),
        (|r| r.session = r.session.wrapping_add(1), "session"),
        (|r| r.applied_um += 0.5, "the PZT moved"),
    ];
    for (answer, word) in answers {
        let (mut rig, log) = rig(ClockKind::Virtual, |_| {}, answer);
        let setup = set_up(&mut rig);
        let core = setup.core().expect("a loop");
        let Err(not_armed) = rig.arm(&setup, core, NoSink, ticks(500)) else {
            panic!("armed all the same");
        };
        let text = not_armed.failure.text();
        assert!(text.contains(word), "{text}");
        assert_eq!(told(&log), ["arm", "freeze", "disarm"], "{text}");
    }
}

/// A control law with a defect.
#[derive(Debug, Clone)]
struct Broken;

impl ControlLaw for Broken {
    type State = u32;

    fn start(&self, _: f64) -> u32 {
        0
    }

    fn step(&self, ticks: &mut u32, input: &LawInput) -> LawOutput {
        *ticks += 1;
        assert!(*ticks < 100, "a defect");
        LawOutput::wish(input.estimate.neutral_um)
    }
}

#[test]
fn a_panic_in_the_loop_is_an_error_and_the_board_is_disarmed() {
    for clock in [ClockKind::Virtual, ClockKind::Real] {
        let (mut rig, log) = rig(clock, |_| {}, |_| {});
        let setup = set_up(&mut rig);
        let parts = setup.law().expect("a law").settings().with(Broken);
        let law = Controller::with_law(parts).expect("columns");
        let core = setup.core_with(law).expect("a loop");
        let armed = rig.arm(&setup, core, NoSink, ticks(3000)).ok();
        let ended = armed.expect("armed").start().and_then(|run| run.wait());
        let failure = ended.err().expect("it panicked").text();
        assert!(failure.contains("panicked"), "{failure}");
        let last = told(&log).last().copied();
        assert!(matches!(last, Some("disarm" | "park")), "{last:?}");
    }
}

#[test]
fn a_running_loop_that_is_dropped_is_parked() {
    let (mut rig, log) = rig(ClockKind::Real, |_| {}, |_| {});
    let setup = set_up(&mut rig);
    let core = setup.core().expect("a loop");
    let armed = rig.arm(&setup, core, NoSink, EndRule::default()).ok();
    let running = armed.expect("armed").start().expect("a thread");
    std::thread::sleep(Duration::from_millis(50));
    drop(running);
    let log = told(&log);
    assert!(matches!(log.last(), Some(&("park" | "disarm"))), "{log:?}");
}

#[test]
fn a_wrong_sign_and_no_bead_end_with_different_words_and_different_advice() {
    let end = |change: fn(&mut Measurement)| {
        let (mut rig, _) = rig(ClockKind::Virtual, change, |_| {});
        let setup = set_up(&mut rig);
        let core = setup.core().expect("a loop");
        let armed = rig.arm(&setup, core, NoSink, ticks(4000)).ok();
        let finished = armed.expect("armed").start().and_then(|run| run.wait());
        finished.expect("a run").ended
    };
    let sign = end(|m| m.position_um = -m.position_um);
    assert_eq!(sign.kind, EndKind::ArmingRefused);
    assert_eq!(sign.refusal, Some(Refusal::WrongSign), "{sign}");
    assert!(sign.to_do.contains("`sign`"), "{sign}");
    let nobody = end(|m| {
        m.position_um = f64::NAN;
        m.verdict = cellpos_vision::FixQuality::NoSignal;
    });
    assert_eq!(nobody.kind, EndKind::ArmingRefused);
    assert_eq!(nobody.refusal, Some(Refusal::NoBead), "{nobody}");
    assert!(nobody.to_do.contains("into view"), "{nobody}");
}

#[test]
fn old_frames_on_a_machine_that_gives_no_priority_are_first_laid_to_the_machine() {
    let old = |m: &mut Measurement| {
        if m.frame_id > 700 {
            m.mid_exposure_ns -= 50_000_000;
        }
    };
    let end = |clock| {
        let (mut rig, _) = rig(clock, old, |_| {});
        let setup = set_up(&mut rig);
        let core = setup.core().expect("a loop");
        let armed = rig.arm(&setup, core, NoSink, ticks(20_000)).ok();
        let finished = armed.expect("armed").start().and_then(|run| run.wait());
        finished.expect("a run").ended
    };
    let (busy, camera) = (
        "this machine may have been busy",
        "check the camera's buffers",
    );
    let real = end(ClockKind::Real);
    assert_eq!(real.kind, EndKind::Safe, "{real}");
    if real.reason == Some(cellpos_runtime::life::SafeReason::StaleFrames) {
        assert!(real.to_do.starts_with(busy), "{real}");
        assert!(real.to_do.contains(camera), "{real}");
    }
    let ideal = end(ClockKind::Virtual);
    assert!(ideal.to_do.starts_with(camera), "{ideal}");
}

/// Scheduling policy of the calling thread by number: 0 ordinary, 1 FIFO.
fn policy() -> Option<u32> {
    let stat = std::fs::read_to_string("/proc/thread-self/stat").ok()?;
    // Fields are counted from behind the name, which may hold anything; the 41st is the policy.
    let rest = stat.rsplit_once(')')?.1;
    rest.split_whitespace().nth(38)?.parse().ok()
}

fn locked_kb() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmLck:"))?;
    line.split_whitespace().next()?.parse().ok()
}

/// Which policies the recorder's thread had.
#[derive(Default)]
struct Policies(Vec<Option<u32>>);

impl RunSink for Policies {
    fn tick(&mut self, _: &TickRecord) {
        self.0.push(policy());
    }
    fn event(&mut self, _: &Event) {}
    fn progress(&mut self, _: &Statistics) {}
}

#[test]
fn real_time_rights_and_locked_memory_end_with_the_run_and_nobody_inherits_them() {
    let before = (policy(), locked_kb());
    let (mut rig, _) = rig_with(ClockKind::Real, false, |_| {}, |_| {});
    for run in 0..2 {
        let setup = set_up(&mut rig);
        let core = setup.core().expect("a loop");
        let armed = rig.arm(&setup, core, Policies::default(), ticks(100)).ok();
        let finished = armed.expect("armed").start().and_then(|run| run.wait());
        let finished = finished.expect("a run");
        if finished.conditions.policy != "SCHED_FIFO" {
            println!("not tested: this machine grants no SCHED_FIFO");
            return;
        }
        assert!(!finished.sink.0.is_empty());
        assert!(
            finished.sink.0.iter().all(|policy| *policy == Some(0)),
            "run {run}: the recorder ran in real time"
        );
        assert_eq!((policy(), locked_kb()), before, "run {run}: the caller");
        let spawned = std::thread::spawn(policy).join().expect("it ends");
        assert_eq!(spawned, Some(0), "run {run}: a thread made afterwards");
        rig = finished.rig;
    }
}

#[test]
fn the_operator_of_a_rig_stops_the_next_run_on_it_and_not_the_one_after() {
    let (mut rig, _) = rig(ClockKind::Virtual, |_| {}, |_| {});
    let mut kinds = Vec::new();
    for asked in [true, false] {
        if asked {
            rig.operator().ask(Request::Freeze);
        }
        let setup = set_up(&mut rig);
        let core = setup.core().expect("a loop");
        let armed = rig.arm(&setup, core, NoSink, ticks(3000)).ok();
        let finished = armed.expect("armed").start().and_then(|run| run.wait());
        let finished = finished.expect("a run");
        kinds.push(finished.ended.kind);
        rig = finished.rig;
    }
    assert_eq!(kinds, [EndKind::Operator, EndKind::Done]);
}

/// A sink that stands for half a second in each five hundredth record, as a disk does that takes so long for a sync.
struct SlowDisk {
    records: u64,
}

impl RunSink for SlowDisk {
    fn tick(&mut self, _: &TickRecord) {
        if self.records.is_multiple_of(500) {
            std::thread::sleep(Duration::from_millis(500));
        }
        self.records += 1;
    }
    fn event(&mut self, _: &Event) {}
    fn progress(&mut self, _: &Statistics) {}
}

#[test]
fn a_disk_of_half_a_second_a_write_starts_and_ends_as_asked() {
    let (mut rig, log) = rig(ClockKind::Real, |_| {}, |_| {});
    let setup = set_up(&mut rig);
    let core = setup.core().expect("a loop");
    let sink = SlowDisk { records: 0 };
    let armed = rig.arm(&setup, core, sink, ticks(2000));
    let armed = armed.unwrap_or_else(|not| panic!("{}", not.failure.text()));
    let finished = armed
        .start()
        .and_then(cellpos_session::Running::wait)
        .unwrap_or_else(|failure| panic!("{}", failure.text()));
    assert_eq!(finished.ended.kind, EndKind::Done, "{}", finished.ended);
    let summary = &finished.summary;
    assert_eq!(summary.records_lost, 0, "{summary:?}");
    assert_eq!(finished.sink.records, summary.counts.ticks, "{summary:?}");
    assert_eq!(told(&log).last(), Some(&"disarm"));
}
