//! Adaptation: gain and delay of the plant, estimated while the loop runs, and what of them comes into force.
//!
//! **Estimate.** The commands drive the model, undisturbed, beside the loop. Its position at the time of each fix, for each of a
//! few delays ([`window::DELAYS`]), and the fix itself go through one and the same filter: that which makes white noise of
//! Brownian motion, drift and localisation noise. What is left of the fix is then the gain times what is left of the model's
//! position, and white noise; gain and delay are a linear regression and a comparison of sums of squares. Nothing has to be
//! added to the command for that: a loop that holds a bead answers its Brownian motion in every tick, and an answer is
//! independent of the noise that comes after it. A second of hold at 1 kHz tells the gain to some 5 %.
//!
//! **What shakes the bead** and is neither Brownian motion nor drift is answered as well, and the answer would pass for a gain. Lines
//! (a pump, the mains) are found and taken out of all series ([`spectrum`], [`lines`]). Of a disturbance of many frequencies
//! no estimate from fixes and commands alone can say whether it is one; so where the estimate leaves what was last
//! confirmed a small motion of the loop's own decides ([`probe`]), and nothing is stated or told before.
//!
//! **Memory.** Old ticks are forgotten by the excitation of new ones, so that nothing is forgotten at rest. A slow window
//! holds ten times what a fast one does; where they surely differ the plant has changed, and the slow one begins anew from
//! the fast.
//!
//! **In force.** See [`supervisor`]. The law itself is not made again: a plant of `g` times the gain is the plant of the design
//! for displacements counted in units of `1/g`, so that estimator, feedback, feed-forward and the plan of MPC stay those of the
//! design, in other units; the delay changes the estimator, of which there is one for each, and the gains of PI.

mod learn;
mod lines;
mod motion;
mod probe;
mod spectrum;
mod supervisor;
mod whiten;
mod window;

use crate::error::BuildError;
use crate::estimator::{Estimator, EstimatorConfig, Fix};
use crate::loop_model::LoopModel;
use lines::Lines;
use motion::Motion;
use probe::{Probe, Standing};
use serde::Serialize;
use spectrum::{Bank, Lineup};
use supervisor::Force;
pub use supervisor::{AdaptMode, AdaptNews};
use whiten::{Covariance, Track, Whitener};
use window::{DELAYS, Finding, MEMBERS, NOMINAL, Window};

/// Names of the columns that adaptation adds to a law's own in the record.
pub const ADAPT_COLUMNS: [&str; 5] = [
    "adapt_gain",
    "adapt_delay_samples",
    "adapt_gain_estimate",
    "adapt_gain_sd",
    "adapt_mode",
];

/// Excitation held by the slow and the fast window.
const SLOW: f64 = 1500.0;
const FAST: f64 = 250.0;
/// Shortest memories of the two, ticks: a large motion would be forgotten in a few, and the gain never known better than that.
const SLOW_TICKS: f64 = 400.0;
const FAST_TICKS: f64 = 40.0;
/// Standard uncertainties by which the two must differ for a plant that has changed; noise variances, for its delay.
const CHANGED: f64 = 4.5;
const CHANGED_DELAY: f64 = 24.0;
/// Part of the stated uncertainty of the gain that stays, whatever is found.
const LEAST_DOUBT: f64 = 0.1;
/// Times the stated wandering of neutral for which the filter makes white noise of it: a real flow wanders more.
const WANDERS: f64 = 2.0;

/// A reference that moves by more than this part of the noise a tick drives the model by itself: what is left is then no noise.
const DRIVEN: f64 = 0.3;
const DRIVEN_TICKS: f64 = 200.0;
/// Ticks after a new line in which nothing is told.
const NEW_LINE_TICKS: u16 = 1500;
/// Doubt of a delay, samples, where commands come in bursts between two fixes: from one burst to the next it makes no difference.
const BURSTS: f64 = 0.25;
/// Doubt of a gain (of its logarithm) that counts in these ticks.
const NEW_LINE_SD: f64 = 0.1;

/// The tuning in force, as a law is told of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tuning {
    /// Gain of the plant over the design's. Displacements that a law is given, and those that it answers, are of the PZT
    /// times this; so are limits of displacement that it keeps by itself.
    pub gain: f64,
    /// Loop delay (with the half sample of hold) over the design's.
    pub delay: f64,
}

impl Default for Tuning {
    /// That of the design.
    fn default() -> Self {
        Self {
            gain: 1.0,
            delay: 1.0,
        }
    }
}

/// Where adaptation stands.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Adaptation {
    /// Gain in force, over the design's.
    pub gain: f64,
    /// Delay in force beyond the design's, samples.
    pub delay_samples: f64,
    /// Estimated gain over the model's, and its standard uncertainty; `None` before there was motion enough.
    pub gain_estimate: Option<[f64; 2]>,
    /// Estimated delay beyond the design's and its standard uncertainty, samples.
    pub delay_estimate_samples: Option<[f64; 2]>,
    /// What the supervisor does.
    pub mode: AdaptMode,
    /// A change worth telling of, in this tick.
    #[serde(skip)]
    pub news: Option<AdaptNews>,
}

/// Adaptation for one model. Immutable; the state is apart and `Copy`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Adapter {
    estimators: [Option<Estimator>; MEMBERS],
    nominal: Estimator,
    whitener: Whitener,
    bank: Bank,
    /// Whole and fractional samples of the design's delay.
    delay_samples: f64,
    /// Ticks from one fix to the next, and those in a row that may be without one.
    interval: f64,
    planned_gap: u32,
    exposure_ticks: f64,
    /// Command that moves the bead by a standard deviation of the noise of a tick, um.
    probe_um: f64,
}

/// State of the adaptation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdaptState {
    /// The model, driven with the commands.
    model: Motion,
    seen: Option<Track>,
    /// Of the filter of all series, and ticks since the exposure of the last fix that it took.
    covariance: Covariance,
    since_fix: f64,
    /// Ticks in a row without a fix.
    silent: u32,
    slow: Window,
    fast: Window,
    /// Squares of what is left, and its products with that of the tick before.
    white: [f64; 2],
    left_um: f64,
    /// Mean squares of what is left, now and usually, um^2, and the ticks that they are of.
    now_um2: f64,
    usual_um2: f64,
    ticks: f64,
    outliers: u8,
    /// Notches at the lines of a disturbance, the search for more, and ticks in which a new one settles.
    lines: Lines,
    lineup: Lineup,
    settling: u16,
    /// Ticks since the newest of them.
    since_line: u16,
    /// The test of what is estimated.
    probe: Probe,
    /// Mean square of the steps of the reference, um^2, and where it was.
    driven_um2: f64,
    reference_um: f64,
    /// Gain and member of the newest finding.
    believed: (f64, usize),
    /// The newest finding.
    found: Option<Finding>,
    force: Force,
    news: Option<AdaptNews>,
}

/// What the adapter is told of a tick.
pub(crate) struct Told {
    /// The fix that came, whether or not it was used.
    pub fix: Option<Fix>,
    /// Command that takes effect now, um of PZT.
    pub command_um: f64,
    /// The law decides, and nothing holds the bead.
    pub free: bool,
    /// Where the bead is to be, um.
    pub reference_um: f64,
}

/// What became of a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Lesson {
    /// Something was learned.
    Learned,
    /// There was nothing to learn from, or it was of no use.
    Nothing,
    /// No fix was to come.
    Between,
}

impl Adapter {
    /// For a model and the noise of its estimator.
    ///
    /// # Errors
    /// As [`Estimator::new`].
    pub fn new(config: EstimatorConfig, model: LoopModel) -> Result<Self, BuildError> {
        let ts = model.sample_time_s;
        let walk_um2 = 2.0 * config.diffusion_um2_per_s * ts;
        let wander = WANDERS * config.neutral_walk_um_per_sqrt_s.max(0.01);
        let drift_um2 = (wander * model.gain_per_s * ts).powi(2) * ts;
        let fix_um2 = config.fix_noise_um.powi(2);
        let whitener = Whitener::new(walk_um2, drift_um2, fix_um2, config.ticks_per_fix)?;
        let moves = model.feedthrough + model.fast_gain_per_s() * ts;
        Ok(Self {
            probe_um: (whitener.noise_um2.sqrt() / moves).clamp(-0.5, 0.5),
            estimators: DELAYS.map(|extra| delayed(config, model, extra)),
            nominal: Estimator::new(config, model)?,
            whitener,
            bank: Bank::default(),
            delay_samples: model.delay_samples(),
            interval: config.ticks_per_fix,
            planned_gap: config.planned_gap(),
            exposure_ticks: config.exposure_ms * 1e-3 / ts,
        })
    }

    /// Nothing known, the design in force, everything at rest at a command, um.
    pub fn start(&self, command_um: f64) -> AdaptState {
        AdaptState {
            model: Motion::start(command_um),
            seen: None,
            covariance: self.whitener.settled(),
            since_fix: 0.0,
            silent: 0,
            slow: Window::new(FAST, SLOW, SLOW_TICKS),
            fast: Window::new(FAST, FAST, FAST_TICKS),
            white: [0.0; 2],
            left_um: 0.0,
            now_um2: 0.0,
            usual_um2: 0.0,
            ticks: 0.0,
            outliers: 0,
            lines: Lines::NONE,
            lineup: Lineup::NONE,
            settling: 0,
            since_line: u16::MAX,
            probe: Probe::new(),
            driven_um2: 0.0,
            reference_um: f64::NAN,
            believed: (1.0, NOMINAL),
            found: None,
            force: Force::default(),
            news: None,
        }
    }

    fn usable(&self) -> [bool; MEMBERS] {
        self.estimators.map(|one| one.is_some())
    }

    /// The estimator of the delay in force.
    pub fn estimator(&self, state: &AdaptState) -> &Estimator {
        self.estimators
            .get(state.force.member)
            .and_then(Option::as_ref)
            .unwrap_or(&self.nominal)
    }

    /// The tuning in force.
    pub fn tuning(&self, state: &AdaptState) -> Tuning {
        let design = self.delay_samples + 0.5;
        Tuning {
            gain: state.force.log_gain.exp(),
            delay: (design + DELAYS[state.force.member]) / design,
        }
    }

    /// How uncertain the gain in force is, as a part of `stated`: two standard uncertainties of the estimate and what is in force
    /// beside it. All of it while nothing is known or anything is in doubt.
    pub fn gain_doubt(&self, state: &AdaptState, stated: f64) -> f64 {
        let sure = matches!(state.force.mode, AdaptMode::Agreeing | AdaptMode::Moving);
        let Some(found) = state.found.filter(|found| sure && found.gain > 0.0) else {
            return 1.0;
        };
        let off = (found.gain.ln() - state.force.log_gain).abs();
        ((off + 2.0 * found.log_sd()) / stated.max(1e-3)).clamp(LEAST_DOUBT, 1.0)
    }

    /// What is to be added to the command of this tick to put the estimate to the test, um.
    pub fn probe_um(&self, state: &AdaptState) -> f64 {
        state.probe.command_um
    }

    /// How far the test has moved the bead from where it is to be, um. A loop as fast as its camera is left to undo it: the frames see
    /// it before. One that is faster would have undone it before the next frame, and is not told of it.
    pub fn moved_um(&self, state: &AdaptState) -> f64 {
        if self.is_faster() {
            state.probe.moved_um() * state.force.log_gain.exp()
        } else {
            0.0
        }
    }

    /// Where it stands.
    pub fn adaptation(&self, state: &AdaptState) -> Adaptation {
        let found = state.found;
        Adaptation {
            gain: state.force.log_gain.exp(),
            delay_samples: DELAYS[state.force.member],
            gain_estimate: found
                .and_then(|f| state.probe.stated(f.log_gain(), f.log_sd()))
                .map(|(log_gain, sd)| [log_gain.exp(), sd * log_gain.exp()]),
            delay_estimate_samples: found.map(|f| {
                let least = if self.is_faster() { BURSTS } else { 0.0 };
                [f.delay, f.delay_sd.max(least)]
            }),
            mode: match (state.force.mode, state.probe.standing) {
                (AdaptMode::Agreeing | AdaptMode::Moving, Standing::Tested) => AdaptMode::Testing,
                (AdaptMode::Agreeing | AdaptMode::Moving, Standing::Corrected) => {
                    AdaptMode::Disturbed
                }
                (mode, _) => mode,
            },
            news: state.news.map(|news| news.in_ticks(self.interval)),
        }
    }

    /// Variance of what is left, um^2: at least a quarter of what the noise alone would leave. Of a plant that has just
    /// changed the slow window fits nothing.
    fn left_um2(&self, state: &AdaptState) -> f64 {
        let (expected, usable) = (self.whitener.noise_um2, self.usable());
        let of = |window: &Window| window.residual_um2(&usable);
        let least = [of(&state.slow), of(&state.fast)]
            .into_iter()
            .flatten()
            .fold(f64::INFINITY, f64::min);
        if least.is_finite() {
            least.max(0.25 * expected)
        } else {
            expected
        }
    }

    /// The same for an interval: more where it is not white.
    fn noise_um2(&self, state: &AdaptState) -> f64 {
        let [rr, rr1] = state.white;
        let rho = if rr > 0.0 { (rr1 / rr).abs() } else { 0.0 };
        let coloured = if rho > 0.1 {
            ((1.0 + rho) / (1.0 - rho).max(0.05)).min(20.0)
        } else {
            1.0
        };
        coloured * self.left_um2(state)
    }

    fn finding(&self, window: &Window, state: &AdaptState) -> Option<Finding> {
        window.finding(&self.usable(), self.noise_um2(state))
    }

    /// After the command of a tick: learns from the fix, and moves the tuning where it may. The tuning that it leaves is that
    /// of the next tick.
    pub fn step(&self, state: &mut AdaptState, told: &Told) {
        let lesson = self.learn(state, told.fix.filter(|_| told.free));
        state.probe.given_um = state.probe.command_um;
        self.drive(state, told.command_um);
        state.news = None;
        if told.free && lesson == Lesson::Between {
            // Everything else goes by the fixes.
            state.probe.tick();
            return;
        }
        let step_um = told.reference_um - state.reference_um;
        if step_um.is_finite() {
            state.driven_um2 += (step_um * step_um - state.driven_um2) / DRIVEN_TICKS;
        }
        state.reference_um = told.reference_um;
        if !told.free {
            state.force.pause();
            state.probe.hush();
            return;
        }
        if lesson == Lesson::Learned {
            self.compare(state);
            // After a new line little is known at first, and the line may not be out of it altogether.
            let enough =
                |f: &Finding| state.since_line > NEW_LINE_TICKS || f.log_sd() < NEW_LINE_SD;
            let found = self.finding(&state.slow, state).filter(enough);
            state.believed = found.map_or(state.believed, |f| (f.gain.max(0.0), f.best));
            let driven = state.driven_um2 > DRIVEN * self.whitener.noise_um2;
            let found = found.map(|found| state.probe.judged(found, driven));
            state.found = found;
            let range = [state.probe.least(), state.probe.most()];
            if found.is_none() && state.since_line <= NEW_LINE_TICKS {
                state.probe.above = 0;
                state.force.back_to(state.probe.confirmed());
            }
            if (state.force).follow(found.as_ref(), &self.usable(), range) {
                state.found = None;
                state.slow = Window::new(FAST, SLOW, SLOW_TICKS);
                state.fast = Window::new(FAST, FAST, FAST_TICKS);
            }
        } else {
            state.force.pause();
        }
        state.since_line = state.since_line.saturating_add(1);
        let confirmed = state.probe.standing == Standing::Confirmed
            && state.probe.is_near(state.force.log_gain);
        if state.since_line <= NEW_LINE_TICKS {
            state.force.hush();
        } else if confirmed || state.force.mode == AdaptMode::Retreating {
            state.news = state.force.news();
        }
        let louder = (self.left_um2(state) / self.whitener.noise_um2).sqrt();
        let size_um = self.probe_um * louder.clamp(1.0, 2.0) / state.believed.0.clamp(0.4, 2.5);
        state.probe.next(size_um, self.until_before_exposure(state));
        state.probe.tick();
    }

    /// Whether there are two ticks at least from fix to fix.
    fn is_faster(&self) -> bool {
        self.interval >= 2.0
    }

    /// Ticks that a move of the test waits: in a loop that is faster than its camera it is over before a frame is exposed, with a tick
    /// to spare for a delay that is not quite known.
    fn until_before_exposure(&self, state: &AdaptState) -> u32 {
        let delay = self.delay_samples + DELAYS[state.force.member];
        // The exposures to come, in ticks from now; what is decided now is given in the next tick at the earliest.
        let first = (-delay - state.since_fix + state.since_fix.floor()).rem_euclid(self.interval);
        let soonest = if self.is_faster() { 3.0 } else { 2.0 };
        let mut exposed = first;
        while exposed < soonest {
            exposed += self.interval;
        }
        (exposed - soonest) as u32
    }

    /// A tick that never came: the command was held.
    pub fn skip(&self, state: &mut AdaptState, command_um: f64) {
        self.learn(state, None);
        self.drive(state, command_um);
    }

    /// The model one tick on.
    fn drive(&self, state: &mut AdaptState, command_um: f64) {
        let probe_um = state.probe.given_um;
        let probing = (state.probe.instrument())
            .is_none_or(|instrument| instrument.drive(&self.nominal, probe_um));
        if !state.model.drive(&self.nominal, command_um) || !probing {
            let force = state.force;
            *state = self.start(command_um);
            state.force = force;
        }
    }

    /// Where the two windows surely differ the plant has changed: the slow one begins anew from the fast.
    fn compare(&self, state: &mut AdaptState) {
        let pair = self
            .finding(&state.fast, state)
            .zip(self.finding(&state.slow, state));
        let Some((fast, slow)) = pair else {
            return;
        };
        let off = (fast.gain - slow.gain).abs();
        let gain = off > CHANGED * fast.gain_sd.hypot(slow.gain_sd);
        let delay = fast.worse[slow.best] > CHANGED_DELAY;
        if gain || delay {
            state.slow = state.slow.taken_from(&state.fast);
            if state.probe.standing == Standing::Tested {
                state.probe.begin_anew();
            }
        }
    }

    /// The values of [`ADAPT_COLUMNS`].
    pub fn record(&self, state: &AdaptState, out: &mut [f32]) {
        let now = self.adaptation(state);
        let [gain, sd] = now.gain_estimate.unwrap_or([f64::NAN; 2]);
        let values = [now.gain, now.delay_samples, gain, sd];
        for (out, value) in out.iter_mut().zip(values) {
            *out = value as f32;
        }
        if let Some(out) = out.get_mut(values.len()) {
            *out = f32::from(now.mode as u8);
        }
    }
}

/// The estimator for so many more samples of delay; `None` where there is none.
fn delayed(config: EstimatorConfig, model: LoopModel, extra: f64) -> Option<Estimator> {
    let delay_s = model.delay_s + extra * model.sample_time_s;
    if delay_s < -1e-9 {
        return None;
    }
    Estimator::new(config, LoopModel { delay_s, ..model }).ok()
}

/// Checks that nominal is where it is said to be.
const _: () = assert!(DELAYS[NOMINAL] == 0.0);
