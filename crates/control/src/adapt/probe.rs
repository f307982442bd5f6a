//! Whether what the motion tells of the gain is the plant's: a small motion of one's own decides.
//!
//! In a closed loop the command answers whatever shakes the bead. A disturbance of the right colour (a slow flow, a pump) is by nature
//! no different from a gain that fell or rose, for any estimate from fixes and commands alone. A motion that was chosen
//! without regard to the fixes is: what of the fixes goes with it is the plant's gain, whatever else shakes the bead (it is an
//! instrument, in the sense of instrumental variables). So where the estimate leaves what was last confirmed the bead
//! is moved to and fro by a third of its own wandering in a tick, at random, until it is clear which of the two it is.

use super::motion::Motion;
use super::window::{Finding, MEMBERS, NOMINAL};

/// Distance (of logarithms) of an estimate from what was confirmed at which it is put to the test, the same in standard
/// uncertainties, and for so many ticks.
const TEST_AT: f64 = 0.06;
const TEST_SDS: f64 = 2.5;
const TEST_TICKS: u16 = 200;
/// Motion, standard deviations of the noise of a tick, and ticks that it stays on a side at least.
const SIZE: f64 = 0.3;
const STAY_TICKS: u32 = 2;
/// Motion (squares over the variance of the noise) that is remembered.
const MEMORY: f64 = 1500.0;
/// Uncertainty of the logarithm at which it is decided, and standard uncertainties that decide.
const DECIDE_SD: f64 = 0.03;
const DECIDE: f64 = 2.0;
/// The same for a decision before that.
const EARLY_SD: f64 = 0.2;
const EARLY: f64 = 4.0;
const AGREES: f64 = 1.5;
const NEAR: f64 = 0.08;
/// What a test that is no better than this says lets the tuning go further, to so many standard uncertainties from it.
const LEAST_SD: f64 = 0.4;
const LEAST_SDS: f64 = 2.5;
/// Ticks of a test before it says anything.
const FEW_TICKS: u32 = 50;
/// Ticks of a test before anything is decided, and doubt of an estimate that is worth a decision.
const LEAST_TICKS: u32 = 500;
const WORTH_SD: f64 = 0.06;
/// How far below what was confirmed the tuning may go meanwhile (Ms is 2.0 where the estimate was wrong).
const BOLD: f64 = 0.28;
/// How far above it (1.4 times), and the gain (1.3, as a logarithm) that it may go to in any case.
const CAUTIOUS: f64 = 0.34;
const ENOUGH: f64 = 0.26;
/// Ticks after which it goes further all the same: a line is found in less.
const PATIENCE_TICKS: u16 = 1500;
/// How far an estimate may leave its mean over the test (of logarithms), where it is less than the uncertainty of that, for the
/// test to say anything of it.
const SHIFT: f64 = 0.05;
/// The same for a correction that goes on.
const ANOTHER: f64 = 0.1;
/// Estimated delay, samples, below which the instrument begins a sample earlier.
const EARLIER: f64 = -0.1;
/// Uncertainty of the logarithm with which a test states a gain by itself; with which it corrects one.
const STATED_SD: f64 = 0.1;
const CORRECTS_SD: f64 = 0.08;
/// The same with which it goes before an estimate that it surely contradicts.
const LEADS_SD: f64 = 0.12;
/// What a disturbance that is not white adds to that uncertainty where it is stated.
const COLOURED: f64 = 1.5;
/// A disturbance that makes no more than this of the gain is over.
const OVER: f64 = 0.05;
/// Doubt of a gain that was confirmed: what is less is not put to the test.
const CONFIRMED_SD: f64 = 0.035;

/// What is known of the estimate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) enum Standing {
    /// As it was confirmed, or near it.
    #[default]
    Confirmed,
    /// Being put to the test.
    Tested,
    /// Off because of a disturbance, and put right; the test goes on.
    Corrected,
}

/// State of the test.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Probe {
    pub standing: Standing,
    /// Logarithm of the gain that was confirmed.
    confirmed: f64,
    /// Doubt of it, of the logarithm.
    doubt: f64,
    away: u16,
    /// Ticks in a row in which the estimate was above [`Probe::enough`].
    pub above: u16,
    /// By how much the logarithm of the estimate is put right, and how well that is known.
    correction: (f64, f64),
    instrument: Motion,
    /// The command that is added, um, its side, and a shift register for the next.
    pub command_um: f64,
    /// The one before, which a tick that never comes holds.
    pub given_um: f64,
    /// The one that is to be given, um, and in how many ticks.
    pending_um: f64,
    wait: u32,
    side: f64,
    bits: u32,
    ticks: u32,
    /// The member at which the instrument begins, and its value there a tick ago.
    begins: usize,
    before_um: f64,
    /// Sums of the instrument with the fixes and with what the estimate makes of the commands.
    with_fixes: f64,
    with_model: f64,
    /// The second without the gain that was estimated in each tick.
    with_motion: f64,
    /// Sums of the instrument's square with that of the fixes, with both, and with that of the model.
    squares: [f64; 3],
    /// How far the estimate has left its mean over these sums.
    shift: f64,
}

/// What a test is told of a tick.
pub(super) struct Trial {
    /// What was not to be foreseen of the fix and of the model, um, and the gain that was estimated.
    pub seen_um: f64,
    pub moved_um: f64,
    pub gain: f64,
    /// The same of the instrument, for each delay, um.
    pub instrument_um: [f64; MEMBERS],
    /// Estimated delay beyond the design's, samples.
    pub delay: f64,
    /// A move may fall into two samples: it takes a whole one, and the loop undoes it.
    pub spreads: bool,
    pub noise_um2: f64,
}

impl Probe {
    pub fn new() -> Self {
        Self {
            standing: Standing::Confirmed,
            confirmed: 0.0,
            doubt: CONFIRMED_SD,
            away: 0,
            above: 0,
            correction: (0.0, 0.0),
            instrument: Motion::start(0.0),
            command_um: 0.0,
            given_um: 0.0,
            pending_um: 0.0,
            wait: 0,
            side: 0.0,
            bits: 0x2545_f491,
            ticks: 0,
            begins: NOMINAL,
            before_um: 0.0,
            with_fixes: 0.0,
            with_model: 0.0,
            with_motion: 0.0,
            squares: [0.0; 3],
            shift: 0.0,
        }
    }

    /// Whether the bead is being moved.
    pub fn is_on(&self) -> bool {
        self.standing != Standing::Confirmed
    }

    /// The instrument, where the bead is being moved.
    pub fn instrument(&mut self) -> Option<&mut Motion> {
        self.is_on().then_some(&mut self.instrument)
    }

    /// How far the test has moved the bead, um, where the gain is the model's.
    pub fn moved_um(&self) -> f64 {
        if self.is_on() {
            self.instrument.now_um()
        } else {
            0.0
        }
    }

    /// Whether the estimate is off what was confirmed.
    fn is_off(&self, log_gain: f64, sd: f64) -> bool {
        (log_gain - self.confirmed).abs() > TEST_AT.max(TEST_SDS * sd)
    }

    /// What may be stated of the gain where the estimate is this: its logarithm and standard uncertainty. While the estimate is tested
    /// that is what the test says by itself.
    pub fn stated(&self, log_gain: f64, sd: f64) -> Option<(f64, f64)> {
        let usable = match self.standing {
            Standing::Confirmed => !self.is_off(log_gain, sd),
            Standing::Tested => false,
            Standing::Corrected => self.shift < SHIFT.max(self.correction.1),
        };
        if usable {
            // What is stated is all of the correction.
            let rest = self.correction.0 - self.surely();
            return Some((log_gain + rest, sd.hypot(self.doubt)));
        }
        let sure = |found: &(f64, f64)| found.1 < STATED_SD;
        let long = self.is_on() && self.ticks > LEAST_TICKS;
        let (log_gain, sd) = self.alone().filter(|_| long).filter(sure)?;
        Some((log_gain, COLOURED * sd))
    }

    /// Whether a tuning is that which was confirmed, as far as it is told of.
    pub fn is_near(&self, log_gain: f64) -> bool {
        (log_gain - self.confirmed).abs() < 1.5 * TEST_AT
    }

    /// Least logarithm of the gain that the tuning may go to.
    pub fn least(&self) -> f64 {
        match self.standing {
            Standing::Confirmed => self.confirmed - BOLD,
            Standing::Tested => {
                let most = |(alone, sd): (f64, f64)| alone + LEAST_SDS * sd;
                let known = self.alone().filter(|found| found.1 < LEAST_SD);
                (self.confirmed - BOLD).min(known.map_or(self.confirmed, most))
            }
            Standing::Corrected => f64::NEG_INFINITY,
        }
    }

    /// The most that it may go to. What shakes the bead all of a sudden and a plant of more gain look alike at first: a plant of twice the
    /// design's gain is held well enough from here, and the rest of the way has time until the test has told, or until a line would
    /// have been found.
    pub fn most(&self) -> f64 {
        let most = self.enough();
        if self.above >= PATIENCE_TICKS {
            return f64::INFINITY;
        }
        match self.standing {
            Standing::Confirmed => most,
            Standing::Tested => {
                let least = |(alone, sd): (f64, f64)| alone - LEAST_SDS * sd;
                let long = self.ticks > LEAST_TICKS;
                let known = (self.alone()).filter(|found| long && found.1 < LEAST_SD);
                known.map_or(most, |found| most.max(least(found)))
            }
            Standing::Corrected => f64::INFINITY,
        }
    }

    fn enough(&self) -> f64 {
        (self.confirmed + CAUTIOUS).max(ENOUGH)
    }

    /// Logarithm of the gain that was confirmed.
    pub fn confirmed(&self) -> f64 {
        self.confirmed
    }

    /// What has been found so far does not count: the estimate begins anew.
    pub fn begin_anew(&mut self) {
        self.ticks = 0;
        self.with_fixes = 0.0;
        self.with_model = 0.0;
        self.with_motion = 0.0;
        self.squares = [0.0; 3];
    }

    /// The part of the correction that is in force: a test that is looked at again and again is now and then off by chance, and
    /// only what is surely wrong is put right.
    fn surely(&self) -> f64 {
        let (wrong, doubt) = self.correction;
        (wrong.abs() - doubt).max(0.0) * wrong.signum()
    }

    /// Gain and standard uncertainty as they are put right; both are those of the logarithm.
    fn corrected(&self, log_gain: f64, sd: f64) -> (f64, f64) {
        match self.standing {
            Standing::Corrected => (log_gain + self.surely(), sd.hypot(self.correction.1)),
            Standing::Tested => {
                // An estimate that is still on its way is slower than the test.
                let surely = |found: &(f64, f64)| {
                    let off = (found.0 - log_gain).abs();
                    let moving = self.ticks > LEAST_TICKS && self.shift > SHIFT;
                    moving && found.1 < LEADS_SD && off > DECIDE * found.1
                };
                self.alone().filter(surely).unwrap_or((log_gain, sd))
            }
            Standing::Confirmed => (log_gain, sd),
        }
    }

    /// An estimate as its test leaves it; `driven` where the reference moves the bead, which confirms by itself.
    pub fn judged(&mut self, found: Finding, driven: bool) -> Finding {
        let log_gain = found.log_gain();
        self.above = if log_gain > self.enough() {
            self.above.saturating_add(1)
        } else {
            0
        };
        self.judge(log_gain, found.log_sd(), driven);
        let (right, sd) = self.corrected(log_gain, found.log_sd());
        if right == log_gain {
            return found;
        }
        Finding {
            gain: right.exp(),
            gain_sd: sd * right.exp(),
            ..found
        }
    }

    /// What the estimate leads to; `driven` where the reference moves the bead, which confirms by itself.
    fn judge(&mut self, log_gain: f64, sd: f64, driven: bool) {
        if driven && self.standing != Standing::Corrected {
            self.confirm(log_gain, 0.0);
            return;
        }
        if self.with_motion > 0.0 && self.with_model > 0.0 {
            self.shift = (log_gain - (self.with_model / self.with_motion).ln()).abs();
        }
        match self.standing {
            Standing::Confirmed => {
                self.away = if self.is_off(log_gain, sd) {
                    self.away + 1
                } else {
                    0
                };
                if self.away >= TEST_TICKS {
                    *self = Self {
                        standing: Standing::Tested,
                        confirmed: self.confirmed,
                        doubt: self.doubt,
                        above: self.above,
                        bits: self.bits,
                        ..Self::new()
                    };
                }
            }
            Standing::Tested => {
                if sd < WORTH_SD && self.ticks > LEAST_TICKS {
                    self.decide(log_gain);
                }
            }
            Standing::Corrected if self.shift > ANOTHER => {
                // Not what was corrected: the plant, or another disturbance.
                self.standing = Standing::Tested;
                self.begin_anew();
            }
            Standing::Corrected => {
                let long = self.ticks > LEAST_TICKS;
                let still =
                    |found: &(f64, f64)| long && found.1 < CORRECTS_SD && self.shift < SHIFT;
                if let Some(found) = self.found().filter(still) {
                    self.correction = found;
                    if found.1 < DECIDE_SD && found.0.abs() < OVER {
                        self.confirm(log_gain, found.0);
                    }
                }
            }
        }
    }

    /// By how much the estimate is to be put right, and the standard uncertainty of that; logarithms.
    fn found(&self) -> Option<(f64, f64)> {
        // Of a few ticks nothing is left beside the fit, and nothing is known of how well it is.
        let usable = self.ticks > FEW_TICKS
            && self.with_motion > 0.0
            && self.with_model > 0.0
            && self.with_fixes > 0.02 * self.with_model;
        usable.then(|| {
            // By the gain that the test itself finds: beside a wrong one a disturbance may leave less.
            let gain = self.with_fixes / self.with_motion;
            let [seen, both, moved] = self.squares;
            let left = (seen - 2.0 * gain * both + gain * gain * moved).max(0.0);
            let sd = left.sqrt() / self.with_fixes;
            ((self.with_fixes / self.with_model).ln(), sd)
        })
    }

    /// Logarithm of the gain by the test alone, and its standard uncertainty.
    fn alone(&self) -> Option<(f64, f64)> {
        let (wrong, sd) = self.found()?;
        let mean = self.with_model / self.with_motion;
        (mean > 0.0).then(|| (mean.ln() + wrong, sd))
    }

    fn decide(&mut self, log_gain: f64) {
        let (Some((alone, sd)), Some(found)) = (self.alone(), self.found()) else {
            return;
        };
        if sd > EARLY_SD {
            return;
        }
        let (off, wrong) = ((alone - self.confirmed).abs(), (alone - log_gain).abs());
        let sure = sd < DECIDE_SD;
        if wrong < (AGREES * sd).min(NEAR) && (sure || off > EARLY * sd) {
            self.confirm(log_gain, wrong);
        } else if self.shift < SHIFT && sd < CORRECTS_SD {
            if wrong > if sure { DECIDE } else { EARLY } * sd {
                self.standing = Standing::Corrected;
                self.correction = found;
            } else if sure {
                self.confirm(log_gain, wrong);
            }
        }
    }

    /// Confirms an estimate that the test found off by `wrong`, which is no more than may be by chance.
    fn confirm(&mut self, log_gain: f64, wrong: f64) {
        self.standing = Standing::Confirmed;
        self.confirmed = log_gain;
        self.doubt = CONFIRMED_SD.max(0.7 * wrong.abs());
        self.away = 0;
        self.hush();
        self.correction = (0.0, 0.0);
    }

    /// One tick of the test.
    pub fn learn(&mut self, trial: &Trial) {
        let Trial {
            seen_um,
            moved_um,
            gain,
            delay,
            spreads,
            noise_um2,
            ..
        } = *trial;
        // What moves the bead falls into this sample and the next, wherever in between the delay is: the sum of two ticks holds
        // all of it, and a delay that is off by a part of a sample is not taken for a gain.
        let begins = if spreads {
            NOMINAL as f64 + 2.0 * (delay - EARLIER).floor()
        } else {
            // Over well before the exposure, wherever in between it was.
            NOMINAL as f64
        };
        let begins = begins.max(0.0) as usize;
        let now_um = trial.instrument_um[begins.min(MEMBERS - 1)];
        if begins != self.begins {
            self.begins = begins;
            self.begin_anew();
        }
        let instrument_um = if spreads {
            now_um + self.before_um
        } else {
            now_um
        };
        self.before_um = now_um;
        let keep = 1.0 - (instrument_um * instrument_um / noise_um2 / MEMORY).min(0.02);
        self.with_fixes = keep * self.with_fixes + instrument_um * seen_um;
        self.with_model = keep * self.with_model + instrument_um * gain * moved_um;
        self.with_motion = keep * self.with_motion + instrument_um * moved_um;
        let (seen, moved) = (instrument_um * seen_um, instrument_um * moved_um);
        let products = [seen * seen, seen * moved, moved * moved];
        for (sum, product) in self.squares.iter_mut().zip(products) {
            *sum = keep * keep * *sum + product;
        }
    }

    /// A tick on: what is due becomes the command.
    pub fn tick(&mut self) {
        self.command_um = 0.0;
        if self.wait > 0 {
            self.wait -= 1;
        } else {
            self.command_um = std::mem::take(&mut self.pending_um);
        }
    }

    /// No test while the loop does not control the bead.
    pub fn hush(&mut self) {
        (self.command_um, self.pending_um, self.wait) = (0.0, 0.0, 0);
    }

    /// The next command, to be given after `wait` ticks, where a step of `step_um` moves the bead by a standard deviation of the noise
    /// from fix to fix.
    pub fn next(&mut self, step_um: f64, wait: u32) {
        if !self.is_on() {
            return;
        }
        self.ticks = self.ticks.wrapping_add(1);
        if !self.ticks.is_multiple_of(STAY_TICKS) {
            return;
        }
        // Galois' shift register of 32 bits, x^32 + x^22 + x^2 + x + 1.
        let bit = self.bits & 1;
        self.bits = (self.bits >> 1) ^ (0x8020_0003 * bit);
        let side = if bit == 1 { SIZE } else { -SIZE };
        self.pending_um += (side - self.side) * step_um;
        self.wait = wait;
        self.side = side;
    }
}
