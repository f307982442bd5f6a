//! One run of the table, and how it went by the truth.

use super::law::Proportional;
use cellpos_control::Controller;
use cellpos_emulator::{FaultEvent, FaultKind};
use cellpos_runtime::{EndRule, Event, RunSink, Statistics, TickFlags, TickRecord};
use cellpos_session::rig_file::{ClockKind, Frames};
use cellpos_session::setup::ReferenceSpec;
use cellpos_session::{Finished, Options, Rig, RigFile};
use std::fmt;

/// Speed with which a flow begins for a zero flow that is 1 um off, Eq. (6), 1/s: a row is named by it.
pub(super) const GAIN_PER_S: f64 = 379.3;
/// Answer of the user's own law, um of PZT for 1 um.
pub(super) const OWN_KP: f64 = 0.4;
/// Where the bead rests before a step of the flow, um; it wanders by some nm.
const ZERO_FLOW_UM: f64 = 20.0;
/// Start of the first event, and its errors count from there, s.
pub(super) const EVENT_S: f64 = 2.6;
const FROM_NS: i64 = 2_550_000_000;

/// Events around a held bead.
#[derive(Debug, Clone)]
pub(super) struct Row {
    pub law: &'static str,
    pub rate_hz: f64,
    pub pixel_um: f64,
    /// A second bead that far away from the beginning, um.
    pub second_um: Option<f64>,
    /// Speed of the flow that steps, um/s.
    pub flow_um_per_s: f64,
    pub events: Vec<(FaultKind, f64)>,
    /// Start of the first, s.
    pub at_s: f64,
    /// They come so often, and begin so far apart, s.
    pub times: usize,
    pub every_s: f64,
    /// Further ones, once: what, start and duration, s.
    pub beside: Vec<(FaultKind, f64, f64)>,
    /// Contrast over the usual one, whose signal to noise is 50.
    pub contrast: f64,
    /// Rise of the zero flow, um/s.
    pub ramp_um_per_s: f64,
    pub clip_um: f64,
    /// The rig has none of the imperfections of a real one: the limits of the table are those of such a rig.
    pub ideal: bool,
    pub seconds: f64,
    /// Time without a bead after which the run ends, s.
    pub lost_s: f64,
    pub frames: Frames,
    /// Gain of the rig over that of the model.
    pub gain: f64,
}

impl Row {
    fn quiet(law: &'static str) -> Self {
        Self {
            law,
            rate_hz: 1000.0,
            pixel_um: 0.1,
            second_um: None,
            flow_um_per_s: 0.0,
            events: Vec::new(),
            at_s: EVENT_S,
            times: 1,
            every_s: 0.0,
            beside: Vec::new(),
            contrast: 1.0,
            ramp_um_per_s: 1e-3,
            clip_um: 40.0,
            ideal: true,
            seconds: 4.0,
            lost_s: 1.0,
            frames: Frames::On,
            gain: 1.0,
        }
    }

    /// The flow steps, and back after 0.7 s.
    pub(super) fn step(law: &'static str, flow_um_per_s: f64) -> Self {
        Self {
            flow_um_per_s,
            events: vec![(FaultKind::FlowStep, 0.7)],
            ..Self::quiet(law)
        }
    }

    /// The same with its events so often, with 0.35 s for the bead to come to rest after each.
    pub(super) fn again(mut self, times: usize) -> Self {
        let longest_s = self.events.iter().map(|event| event.1).fold(0.0, f64::max);
        self.every_s = longest_s + 0.35;
        self.times = times;
        self.seconds = EVENT_S + times as f64 * self.every_s;
        self
    }

    /// A fault by its name in rig.toml, for a time.
    pub(super) fn event(law: &'static str, kind: &str, for_s: f64) -> Self {
        let kind = toml::Value::String(kind.to_owned()).try_into();
        Self {
            events: vec![(kind.expect("a kind of fault"), for_s)],
            ..Self::quiet(law)
        }
    }

    /// A fault that lasts until the run ends, before the bead counts as lost.
    pub(super) fn to_the_end(law: &'static str, kind: &str) -> Self {
        Self {
            seconds: 3.2,
            ..Self::event(law, kind, 9.0)
        }
    }

    /// The amplifier gives no more than this, um.
    pub(super) fn clipped(law: &'static str, clip_um: f64) -> Self {
        Self {
            clip_um,
            events: vec![(FaultKind::ClipAmplifier, 9.0)],
            seconds: 6.0,
            ..Self::quiet(law)
        }
    }

    /// The gain changes its sign.
    pub(super) fn flipped(law: &'static str) -> Self {
        Self {
            seconds: 3.8,
            ..Self::event(law, "gain-flip", 9.0)
        }
    }

    pub(super) fn has(&self, kind: FaultKind) -> bool {
        self.events.iter().any(|event| event.0 == kind)
    }

    /// Whether the bead is not seen for a time.
    pub(super) fn is_blind(&self) -> bool {
        let blind = [
            FaultKind::StallCamera,
            FaultKind::FrozenPicture,
            FaultKind::DropFrames,
            FaultKind::StaleFrames,
            FaultKind::LoseBead,
        ];
        self.events.iter().any(|(kind, _)| blind.contains(kind))
    }

    /// Whether the bead goes from a picture that goes on, or is not seen until the end: nobody can say then that it was kept.
    pub(super) fn ends_unseen(&self) -> bool {
        let ends = |&(_, for_s): &(FaultKind, f64)| EVENT_S + for_s > self.seconds;
        self.is_blind() && (self.has(FaultKind::LoseBead) || self.events.iter().any(ends))
    }

    pub(super) fn flow_step_um(&self) -> f64 {
        self.flow_um_per_s / GAIN_PER_S
    }

    fn file(&self, seed: u64) -> RigFile {
        let mut file = RigFile::default();
        let period_us = 1e6 / self.rate_hz;
        file.timing.period_us = period_us;
        file.timing.budget_us = 0.5 * period_us;
        file.timing.solver_us = 0.17 * period_us;
        file.timing.coast_ticks = (20e3 / period_us) as u32;
        file.timing.lost_ticks = (self.lost_s * 1e6 / period_us) as u32;
        let world = &mut file.emulator;
        world.seed = seed;
        world.rate_hz = self.rate_hz;
        world.exposure_ms = world.exposure_ms.min(0.5e3 / self.rate_hz);
        world.pixel_um = self.pixel_um;
        world.ideal = self.ideal;
        world.zero_flow_wander_um = Some(6e-3);
        world.zero_flow_drift_um_per_s = Some(self.ramp_um_per_s);
        world.contrast_grey *= self.contrast;
        world.faults.flow_step_um = self.flow_step_um();
        world.faults.clip_um = self.clip_um;
        if self.gain != 1.0 {
            world.model = plant(self.gain);
        }
        if let Some(um) = self.second_um {
            world.faults.second_bead_um = um;
            world.faults.event.push(FaultEvent {
                kind: FaultKind::SecondBead,
                at_s: 0.0,
                for_s: None,
            });
            file.near_um = Some(0.0);
        }
        let once = self.beside.iter().map(|&(kind, at_s, for_s)| FaultEvent {
            kind,
            at_s,
            for_s: Some(for_s),
        });
        file.emulator.faults.event.extend(once);
        for (kind, for_s) in &self.events {
            let again = (0..self.times).map(|k| FaultEvent {
                kind: *kind,
                at_s: self.at_s + k as f64 * self.every_s,
                for_s: Some(*for_s),
            });
            file.emulator.faults.event.extend(again);
        }
        file
    }

    /// Delay of this loop with half a tick of hold, and a tick, s.
    pub(super) fn delay_and_tick_s(&self) -> (f64, f64) {
        let tick_s = 1.0 / self.rate_hz;
        (2e-3 + 0.5 * tick_s, tick_s)
    }
}

impl fmt::Display for Row {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let beside = self
            .second_um
            .map_or_else(|| "alone".to_owned(), |um| format!("beside {um} um"));
        let events: Vec<String> = self
            .events
            .iter()
            .map(|(kind, for_s)| format!("{kind:?} {for_s} s"))
            .collect();
        write!(
            f,
            "{:>4} {:>5} Hz {:.2} um/px {beside:>13} {:>6.0} um/s {}",
            self.law,
            self.rate_hz,
            self.pixel_um,
            self.flow_um_per_s,
            events.join(", ")
        )
    }
}

/// The file of the plant of Eq. (6) with another gain.
fn plant(gain: f64) -> String {
    let path = format!("{}/keeping-{gain}.toml", env!("CARGO_TARGET_TMPDIR"));
    let num = [0.01872, 379.29528, 32_667.167_52].map(|value| value * gain);
    let text =
        format!("working_point_um = 20.0\n\n[plant]\nnum = {num:?}\nden = [1.0, 76.3, 0.13]\n");
    std::fs::write(&path, text).expect("a file");
    path
}

#[derive(Default)]
struct Ticks(Vec<TickRecord>);

impl RunSink for Ticks {
    fn tick(&mut self, record: &TickRecord) {
        self.0.push(*record);
    }
    fn event(&mut self, _: &Event) {}
    fn progress(&mut self, _: &Statistics) {}
}

/// How a run went.
#[derive(Debug)]
pub(super) struct Held {
    pub state: String,
    pub why: Option<String>,
    pub as_asked: bool,
    pub ended: String,
    /// Largest true distance from the target from each event on, um.
    pub furthest_um: Vec<f64>,
    /// RMS of the true distance over the ticks whose errors count, and the one that the run states, nm.
    pub true_rms_nm: f64,
    pub stated_rms_nm: f64,
    /// Share within five standard deviations, true and as stated, percent.
    pub true_held_percent: f64,
    pub stated_held_percent: f64,
    /// Time after the event with the PZT more than 1 um off the zero flow of before, ms.
    pub pzt_off_ms: f64,
    /// Longest time without a break further off than that, ms.
    pub longest_away_ms: f64,
    pub other_beads: u64,
    /// At the end another bead was being held.
    pub changed: bool,
}

impl Held {
    /// Largest true distance from the target after any event, um.
    pub(super) fn worst_um(&self) -> f64 {
        self.furthest_um.iter().copied().fold(0.0, f64::max)
    }

    pub(super) const HEAD: &'static str =
        "row | worst um, RMS nm true (stated), held % true (stated), away ms, state";
}

impl fmt::Display for Held {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{:.2} | {:.1} ({:.1}) | {:.2} ({:.2}) | {:.0} | {}{}",
            self.worst_um(),
            self.true_rms_nm,
            self.stated_rms_nm,
            self.true_held_percent,
            self.stated_held_percent,
            self.longest_away_ms,
            self.state,
            self.why
                .as_deref()
                .map_or_else(String::new, |why| format!(": {why}"))
        )
    }
}

/// Runs a row, holding at 0 um.
pub(super) fn hold(row: &Row, seed: u64) -> Held {
    let finished = finish(row, seed, ReferenceSpec::Hold { position_um: 0.0 });
    judged(
        row,
        &finished.sink.0,
        &finished.summary,
        finished.ended.as_asked(),
        finished.ended.to_string(),
    )
}

/// The ticks of a row, holding at 0 um.
pub(super) fn ticks(row: &Row, seed: u64) -> Vec<TickRecord> {
    let reference = ReferenceSpec::Hold { position_um: 0.0 };
    finish(row, seed, reference).sink.0
}

/// The ticks of a row whose bead is to follow a script.
pub(super) fn follow(row: &Row, seed: u64, text: String) -> Vec<TickRecord> {
    let script = ReferenceSpec::Script {
        file: "steps.toml".to_owned(),
        text,
        from_s: 0.0,
        ran_s: None,
        first_length_um: None,
        waveforms: std::collections::BTreeMap::new(),
    };
    finish(row, seed, script).sink.0
}

fn finish(row: &Row, seed: u64, reference: ReferenceSpec) -> Finished<Ticks> {
    let options = Options {
        clock: ClockKind::Virtual,
        frames: row.frames,
        best_effort: true,
    };
    let mut rig = Rig::open(row.file(seed), options).expect("an emulated rig");
    let own = row.law == "own";
    let prepared = rig.prepare("eq6", if own { "lqg" } else { row.law });
    let setup = rig
        .set_up(prepared.expect("a law"), reference)
        .expect("a set-up");
    let core = if own {
        let config = setup
            .controller
            .loop_config(&setup.model)
            .expect("a configuration");
        let law = config.with(Proportional {
            kp_um_per_um: OWN_KP,
        });
        setup.core_with(Controller::with_law(law).expect("a loop"))
    } else {
        setup.core()
    };
    let end = EndRule {
        ticks: Some((row.seconds * row.rate_hz) as u64),
        ..EndRule::default()
    };
    let armed = rig.arm(&setup, core.expect("a core"), Ticks::default(), end);
    let finished = armed
        .ok()
        .expect("armed")
        .start()
        .and_then(|run| run.wait());
    finished.expect("a run")
}

fn judged(
    row: &Row,
    ticks: &[TickRecord],
    summary: &cellpos_runtime::Summary,
    as_asked: bool,
    ended: String,
) -> Held {
    let kept = &summary.kept;
    let within_um = kept.held_within_nm.expect("a hold") * 1e-3;
    let off_um = |t: &TickRecord| (t.true_um - t.target_um).abs();
    let after = || {
        ticks
            .iter()
            .filter(|t| t.time_ns > FROM_NS && t.is_running())
    };
    assert!(
        after().all(|t| off_um(t).is_finite()),
        "the truth of every tick"
    );
    let closed_ns = ticks
        .iter()
        .find(|t| t.is_running())
        .map_or(0, |t| t.time_ns);
    let counted = || after_of(ticks, closed_ns + 2_000_000_000);
    let n = counted().count().max(1) as f64;
    let squares: f64 = counted().map(|t| off_um(t).powi(2)).sum();
    let held = counted().filter(|t| off_um(t) <= within_um).count() as f64;
    let mut furthest_um = vec![0.0_f64; row.times];
    for t in after() {
        let since_s = (t.time_ns - FROM_NS) as f64 * 1e-9;
        let event = if row.times > 1 {
            (since_s / row.every_s) as usize
        } else {
            0
        };
        if let Some(um) = furthest_um.get_mut(event) {
            *um = um.max(off_um(t));
        }
    }
    let (mut away_ns, mut since_ns) = (0, None);
    for t in after() {
        if off_um(t) > within_um {
            let from_ns = *since_ns.get_or_insert(t.time_ns);
            away_ns = away_ns.max(t.time_ns - from_ns);
        } else {
            since_ns = None;
        }
    }
    let tick_ms = ticks.windows(2).last().map_or(0.0, |pair| {
        (pair[1].time_ns - pair[0].time_ns) as f64 * 1e-6
    });
    let pzt_off = |t: &&TickRecord| (t.applied_um - ZERO_FLOW_UM).abs() > 1.0;
    let pzt_off = ticks.iter().filter(|t| t.time_ns > FROM_NS).filter(pzt_off);
    let seen: Vec<&TickRecord> = after().filter(|t| t.measured_um.is_finite()).collect();
    let changed = seen.iter().rev().take(20).any(|t| {
        // The fix is of two milliseconds ago: a bead that is held has not gone far since.
        (t.measured_um - t.true_um).abs() > 1.0 && !t.flags.has(TickFlags::STALE)
    });
    Held {
        state: summary.state.name().to_owned(),
        why: kept.why.map(|why| {
            let word = serde_json::to_value(why).expect("a word");
            word.as_str().unwrap_or_default().to_owned()
        }),
        as_asked,
        ended,
        furthest_um,
        true_rms_nm: (squares / n).sqrt() * 1e3,
        stated_rms_nm: kept.rms_nm.unwrap_or(f64::NAN),
        true_held_percent: 100.0 * held / n,
        stated_held_percent: kept.held_percent.unwrap_or(f64::NAN),
        pzt_off_ms: pzt_off.count() as f64 * tick_ms,
        longest_away_ms: away_ns as f64 * 1e-6,
        other_beads: kept.other_beads,
        changed,
    }
}

fn after_of(ticks: &[TickRecord], from_ns: i64) -> impl Iterator<Item = &TickRecord> {
    ticks
        .iter()
        .filter(move |t| t.time_ns >= from_ns && t.is_running())
}
