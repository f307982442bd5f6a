//! Does the bead follow the commands, or is the loop itself what drives it away, as one whose sign is wrong does?
//!
//! Three hypotheses are weighed: the bead goes with the commands, against them with the same gain, or does not feel them, as when an
//! amplifier clips. In each an unknown flow carries it, which walks, steps, or grows at a rate. Each is a Kalman filter of position,
//! flow, its change, and gain; the likelihoods of the second and third are compared with that of the first from the time on at which
//! they began to be the better ones (Page's test). A flow that rises makes the error grow as a wrong sign does, but it does not do so
//! in proportion to the commands for long. Commands that cancel a flow look as if neither moved the bead: one that does not feel
//! them is looked for only while it goes further and further away.
//!
//! A picture that shakes and an actuator that rings move the bead in no hypothesis of these. A wrong sign must then predict the motion
//! better than its mere size does.
//!
//! Limit: a flow of more than 2 um that rises within 40 ms (1 % to 99 %) grows just as a loop with a wrong sign does, and can be taken
//! for one.

use crate::keeping::Hold;
use cellpos_control::{EstimatorConfig, LoopModel, flow_step_log_density};

/// Natural logarithm of the odds that are asked for. Where a model is exact, Page's test is wrong once in e^32 ticks, 2,500 years at 1 kHz;
/// e^20 would do for a year. The rest is for flows that rise as no model here does: evidence of a wrong sign grows with the square of an
/// error that grows e-fold in 8 ms, so that it costs 4 ms ln(32 / 20) = 2 ms.
const EVIDENCE: f64 = 32.0;
/// Standard deviation of the gain over the model's: loops are made for a half to twice of it; and its limits.
const GAIN_SD: f64 = 0.35;
const GAIN_RANGE: [f64; 2] = [0.4, 2.5];
/// What the size of the gain may change by when its sign does.
const FLIP_SD: f64 = 0.1;
/// Time in which what was learnt of the gain is forgotten, s: a hold tells it to 10 % in that time, for commands answer the walk.
const GAIN_MEMORY_S: f64 = 1.0;
/// Time over which commands are averaged, to count them from there, s: a hundred delays.
const MEAN_S: f64 = 0.25;
/// Time over which the mean square of the bead's motion in a tick is taken, s. One that grows e-fold in 8 ms is then six times its mean,
/// sqrt(0.15 / 0.004), which speaks against a mere shake.
const SHAKE_S: f64 = 0.15;
/// A flow starts to change as often as it steps, so often in a second.
const CHANGES_PER_S: f64 = 0.01;
/// Delays in which a flow that grows at its fastest grows by a factor e: 5 ms. A loop with a wrong sign does in 8 ms, the solution
/// of s = 0.43 / T exp(-s T) with the delay T of 2.5 ms and the usual margins.
const GROWTH_DELAYS: f64 = 2.0;
/// A flow that has begun to change drives the bead as this displacement does, to the order of magnitude, um.
const CHANGE_UM: f64 = 1.0;
/// A bead goes further away if twice the time brings it so much further, the shorter of them so many delays of the loop. A flow that
/// ramps brings a bead away only while the integral learns, with PI in twenty delays: 1 - e^-2 is 1.37 times 1 - e^-1. One that nothing
/// brings back goes twice as far.
const FURTHER: f64 = 1.5;
const AWAY_DELAYS: f64 = 20.0;
/// Ticks by which the delay may be wrong.
const DELAY_ERROR: f64 = 0.5;
/// Commands remembered: their way to a fix takes the camera's delay.
const COMMANDS: usize = 64;
/// Share of the model's speed that may be its slow modes': a plant that answers later is not told from a flow.
const SLOW_SHARE: f64 = 0.5;

/// Numbers that all paths share; um and ticks.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Noise {
    /// Variance of the bead's walk and of the flow's in a tick.
    walk_um2: f64,
    flow_um2: f64,
    /// Speed of a flow that has begun to change, and its growth in a tick.
    change_um: f64,
    growth: f64,
    /// Change of a flow in a tick below which it is not seen: while it grows it moves the bead by less than its walk.
    least_um: f64,
    /// What a tick leaves of what is known of the gain.
    kept: f64,
    sample_s: f64,
}

/// Position, flow, its change, and gain over the model's, with covariance.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Path {
    /// Sign of the gain; 0: the bead does not feel the commands.
    sign: f64,
    x: [f64; 4],
    p: [[f64; 4]; 4],
}

impl Path {
    fn at(position_um: f64, variance_um2: f64, flow_um: f64) -> Self {
        let mut p = [[0.0; 4]; 4];
        p[0][0] = variance_um2;
        p[1][1] = flow_um * flow_um;
        p[3][3] = GAIN_SD * GAIN_SD;
        Self {
            sign: 1.0,
            x: [position_um, 0.0, 0.0, 1.0],
            p,
        }
    }

    /// The same bead, which no longer feels the commands: it goes on as it goes, now that they drive it by `driven_um`.
    fn adrift(mut self, driven_um: f64) -> Self {
        self.add(1, 3, driven_um);
        (self.sign, self.x[3]) = (0.0, 0.0);
        for k in 0..4 {
            (self.p[3][k], self.p[k][3]) = (0.0, 0.0);
        }
        self
    }

    /// The same bead with the opposite sign of its gain.
    fn against(mut self) -> Self {
        self.sign = -1.0;
        self.x[3] = -self.x[3];
        for k in 0..3 {
            self.p[3][k] = -self.p[3][k];
            self.p[k][3] = -self.p[k][3];
        }
        self.p[3][3] += FLIP_SD * FLIP_SD;
        self
    }

    /// Displacement at which the bead rests, um; commands are counted from `mean_um`.
    fn rest_um(&self, mean_um: f64, gain: f64) -> f64 {
        mean_um - self.x[1] / (self.x[3] * gain)
    }

    /// Adds a multiple of one state to another: x' = F x, P' = F P F^T.
    fn add(&mut self, to: usize, from: usize, factor: f64) {
        self.x[to] += factor * self.x[from];
        for k in 0..4 {
            self.p[to][k] += factor * self.p[from][k];
        }
        for row in &mut self.p {
            row[to] += factor * row[from];
        }
    }

    /// One tick in which the model's bead goes `driven_um`, give or take `doubt_um`. The flow of a restless path changes.
    fn advance(&mut self, driven_um: f64, doubt_um: f64, restless: bool, noise: &Noise) {
        self.add(0, 1, 1.0);
        self.add(0, 2, 0.5);
        self.add(0, 3, driven_um);
        self.add(1, 2, 1.0);
        self.p[0][0] += noise.walk_um2 + doubt_um * doubt_um;
        self.p[1][1] += noise.flow_um2;
        if restless {
            let change_um = self.x[2].abs().max(noise.least_um) * noise.growth;
            self.p[2][2] += change_um * change_um;
        }
        let kept = noise.kept;
        self.x[3] = self.sign + kept * (self.x[3] - self.sign);
        for k in 0..4 {
            self.p[3][k] *= kept;
            self.p[k][3] *= kept;
        }
        self.p[3][3] += (1.0 - kept * kept) * (self.sign * GAIN_SD).powi(2);
    }

    /// Takes a fix in, `ticks` after the one before; gives the logarithm of its likelihood.
    fn correct(&mut self, position_um: f64, variance_um2: f64, ticks: f64, sample_s: f64) -> f64 {
        let off_um = position_um - self.x[0];
        let spread_um2 = self.p[0][0] + variance_um2;
        let quiet =
            -0.5 * (off_um * off_um / spread_um2 + (std::f64::consts::TAU * spread_um2).ln());
        let stepped = flow_step_log_density(off_um, ticks * sample_s);
        if stepped > quiet {
            // The flow is as uncertain as the step that the fix shows.
            let speed_um = off_um / ticks;
            self.p[0][0] += off_um * off_um;
            self.p[0][1] += off_um * speed_um;
            self.p[1][0] += off_um * speed_um;
            self.p[1][1] += speed_um * speed_um;
        }
        let spread_um2 = self.p[0][0] + variance_um2;
        let first = self.p[0];
        let gains = first.map(|p| p / spread_um2);
        for (x, gain) in self.x.iter_mut().zip(gains) {
            *x += gain * off_um;
        }
        for (row, gain) in self.p.iter_mut().zip(gains) {
            for (p, first) in row.iter_mut().zip(first) {
                *p -= gain * first;
            }
        }
        let [least, most] = GAIN_RANGE;
        self.x[3] = self.sign * (self.sign * self.x[3]).clamp(least, most);
        quiet.max(stepped)
    }
}

/// A hypothesis on the bead, with a flow that is quiet and with one that has begun to change.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Belief {
    quiet: Path,
    restless: Path,
    /// Logarithms of their likelihoods less that of the likelier one.
    odds: [f64; 2],
}

impl Belief {
    fn of(path: Path) -> Self {
        Self {
            quiet: path,
            restless: path,
            odds: [0.0, f64::NEG_INFINITY],
        }
    }

    fn likelier(&self) -> &Path {
        if self.odds[1] > self.odds[0] {
            &self.restless
        } else {
            &self.quiet
        }
    }

    fn against(self) -> Self {
        Self {
            quiet: self.quiet.against(),
            restless: self.restless.against(),
            ..self
        }
    }

    fn adrift(self, driven_um: f64) -> Self {
        Self {
            quiet: self.quiet.adrift(driven_um),
            restless: self.restless.adrift(driven_um),
            ..self
        }
    }

    /// Moves on by a tick; commands are counted from a displacement at which the model drives the bead `shift_um` further.
    fn advance(&mut self, driven_um: f64, doubt_um: f64, shift_um: f64, noise: &Noise) {
        for (path, restless) in [(&mut self.quiet, false), (&mut self.restless, true)] {
            path.add(1, 3, shift_um);
            path.advance(driven_um, doubt_um, restless, noise);
        }
    }

    /// Takes a fix in; gives the logarithm of its likelihood.
    fn correct(&mut self, position_um: f64, variance_um2: f64, ticks: f64, noise: &Noise) -> f64 {
        let likely =
            |path: &mut Path| path.correct(position_um, variance_um2, ticks, noise.sample_s);
        let [quiet, restless] = self.odds;
        let mut odds = [
            quiet + likely(&mut self.quiet),
            restless + likely(&mut self.restless),
        ];
        let cost = -(CHANGES_PER_S * ticks * noise.sample_s).min(1.0).ln();
        if odds[1] < odds[0] - cost {
            odds[1] = odds[0] - cost;
            self.restless = self.quiet;
            self.restless.p[1][1] += noise.change_um * noise.change_um;
            self.restless.p[2][2] += noise.least_um * noise.least_um;
        } else if odds[0] < odds[1] - cost {
            odds[0] = odds[1] - cost;
            self.quiet = self.restless;
        }
        let most = odds[0].max(odds[1]);
        self.odds = odds.map(|odds| odds - most);
        most
    }
}

/// What the bead does instead of following.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Instead {
    /// It goes against the commands.
    Against,
    /// It does not feel them.
    Adrift,
}

/// A hypothesis beside the usual one, and how much likelier it is, natural logarithm of the odds.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Rival {
    belief: Belief,
    evidence: f64,
    /// Zero flow when it began to be the likelier one, um.
    zero_flow_um: f64,
}

impl Rival {
    fn of(belief: Belief, zero_flow_um: f64) -> Self {
        Self {
            belief,
            evidence: 0.0,
            zero_flow_um,
        }
    }
}

/// What is believed of a bead.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Beliefs {
    with: Belief,
    against: Rival,
    adrift: Rival,
    /// The fix before, um, and the mean square of the motion in a tick.
    before_um: f64,
    motion_um2: f64,
    /// How much likelier a wrong sign is than that something shakes bead or picture, natural logarithm of the odds.
    beyond_shake: f64,
    /// Ticks for which the bead has been away from its reference.
    away: f64,
    /// Those at which its distance was compared last, the distance, um, and whether it was going further away.
    compared: (f64, f64, bool),
}

impl Beliefs {
    /// Logarithm of the likelihood of a fix if something shakes bead or picture: all that is known of its motion is the size.
    fn shaken(&mut self, position_um: f64, ticks: f64, share: f64) -> f64 {
        let moved_um = position_um - self.before_um;
        self.before_um = position_um;
        let spread_um2 = self.motion_um2 * ticks;
        self.motion_um2 += share * (moved_um * moved_um / ticks - self.motion_um2);
        -0.5 * (moved_um * moved_um / spread_um2 + (std::f64::consts::TAU * spread_um2).ln())
    }

    /// Takes in a distance from the reference, um, `ticks` after the one before; `shortest` is the time that tells something.
    fn watch_distance(&mut self, off_um: f64, ticks: f64, shortest: f64) {
        let (at, before_um, _) = self.compared;
        self.away += ticks;
        if at == 0.0 && self.away >= shortest {
            self.compared = (self.away, off_um, false);
        } else if at > 0.0 && self.away >= 2.0 * at {
            self.compared = (self.away, off_um, off_um > FURTHER * before_um);
        }
    }
}

/// The bead in a tick, um.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Seen {
    /// Position and variance of the fix, if one came on time.
    pub fix: Option<(f64, f64)>,
    /// Where the bead is to be.
    pub reference_um: f64,
    /// The command of this tick, which shows one delay later.
    pub command_um: f64,
    /// Estimate of the zero flow.
    pub zero_flow_um: f64,
}

/// The watch over a loop that runs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Following {
    /// Way of the bead for a displacement of 1 um in a tick, um; 0 where the plant is too slow to be watched.
    gain: f64,
    noise: Noise,
    hold: Hold,
    /// What the zero flow at the start is uncertain by, as a way in a tick, um.
    start_um: f64,
    /// Ticks from a command to the fix that shows it, and those after which the distance of a bead that is away tells something.
    delay: usize,
    away_ticks: f64,
    /// Newest commands first, um, and how many there are.
    commands_um: [f64; COMMANDS],
    known: usize,
    mean_um: f64,
    mean_share: f64,
    shake_share: f64,
    /// None until a fix is known.
    beliefs: Option<Beliefs>,
    since_fix: f64,
}

impl Following {
    /// For an estimator and a plant, and fixes that are `delay_s` old.
    pub(super) fn new(config: &EstimatorConfig, model: &LoopModel, delay_s: f64) -> Self {
        let sample_s = model.sample_time_s;
        let delay = (delay_s / sample_s)
            .round()
            .clamp(0.0, (COMMANDS - 3) as f64);
        let slow: f64 = model.modes.iter().map(|mode| mode.residue_per_s).sum();
        let quick = slow.abs() < SLOW_SHARE * model.gain_per_s.abs();
        let gain = if quick {
            (model.gain_per_s + slow) * sample_s
        } else {
            0.0
        };
        let walk_um2 = 2.0 * config.diffusion_um2_per_s * sample_s;
        let delay_and_hold_s = delay_s + 0.5 * sample_s;
        let growth = (sample_s / (GROWTH_DELAYS * delay_and_hold_s)).min(1.0);
        Self {
            gain,
            noise: Noise {
                walk_um2,
                flow_um2: (gain * config.neutral_walk_um_per_sqrt_s).powi(2) * sample_s,
                change_um: gain * CHANGE_UM,
                growth,
                least_um: walk_um2.sqrt() * growth,
                kept: (-sample_s / GAIN_MEMORY_S).exp(),
                sample_s,
            },
            hold: Hold::new(config.diffusion_um2_per_s, delay_s, sample_s),
            start_um: gain * config.neutral_initial_um,
            delay: delay as usize + 1,
            away_ticks: AWAY_DELAYS * delay_and_hold_s / sample_s,
            commands_um: [0.0; COMMANDS],
            known: 0,
            mean_um: 0.0,
            mean_share: (sample_s / MEAN_S).min(1.0),
            shake_share: (sample_s / SHAKE_S).min(1.0),
            beliefs: None,
            since_fix: 0.0,
        }
    }

    /// The ticks before do not count: the loop did not run, the bead was held by something, or what stood at the PZT is not known.
    pub(super) fn clear(&mut self) {
        self.known = 0;
        self.beliefs = None;
    }

    /// A tick that never came: the command before was held, and the bead moved on.
    pub(super) fn skip(&mut self, held_um: f64) {
        self.step(&Seen {
            fix: None,
            reference_um: f64::NAN,
            command_um: held_um,
            zero_flow_um: f64::NAN,
        });
    }

    /// Takes in a tick. Gives what the bead does instead of following the commands, and the displacement at which it then rests, um.
    pub(super) fn step(&mut self, seen: &Seen) -> Option<(Instead, f64)> {
        if self.gain == 0.0 {
            return None;
        }
        self.commands_um.copy_within(..COMMANDS - 1, 1);
        self.commands_um[0] = seen.command_um;
        self.known = (self.known + 1).min(COMMANDS);
        let newest = self.commands_um.get(self.delay..self.delay + 2);
        let Some(&[now_um, before_um]) = newest.filter(|_| self.known > self.delay + 1) else {
            self.mean_um = seen.command_um;
            return None;
        };
        self.since_fix += 1.0;
        let shift_um = self.mean_share * (now_um - self.mean_um);
        self.mean_um += shift_um;
        let driven_um = self.gain * (now_um - self.mean_um);
        let doubt_um = DELAY_ERROR * self.gain * (now_um - before_um);
        if let Some(beliefs) = &mut self.beliefs {
            let shift_um = self.gain * shift_um;
            let Beliefs {
                with,
                against,
                adrift,
                ..
            } = beliefs;
            with.advance(driven_um, doubt_um, shift_um, &self.noise);
            (against.belief).advance(driven_um, doubt_um, shift_um, &self.noise);
            adrift.belief.advance(0.0, 0.0, 0.0, &self.noise);
        }
        let (position_um, variance_um2) = seen.fix?;
        let ticks = std::mem::take(&mut self.since_fix).max(1.0);
        let zero_flow_um = seen.zero_flow_um;
        let Some(beliefs) = &mut self.beliefs else {
            let with = Belief::of(Path::at(position_um, variance_um2, self.start_um));
            self.beliefs = Some(Beliefs {
                with,
                against: Rival::of(with.against(), zero_flow_um),
                adrift: Rival::of(with.adrift(driven_um), zero_flow_um),
                before_um: position_um,
                motion_um2: self.noise.walk_um2 + 2.0 * variance_um2,
                beyond_shake: 0.0,
                away: 0.0,
                compared: (0.0, 0.0, false),
            });
            return None;
        };
        let off_um = (position_um - seen.reference_um).abs();
        let is_away = off_um > self.hold.limit_um(variance_um2);
        if is_away {
            beliefs.watch_distance(off_um, ticks, self.away_ticks);
        } else {
            (beliefs.away, beliefs.compared) = (0.0, (0.0, 0.0, false));
        }
        let likely =
            |belief: &mut Belief| belief.correct(position_um, variance_um2, ticks, &self.noise);
        let usual = likely(&mut beliefs.with);
        beliefs.adrift.evidence += likely(&mut beliefs.adrift.belief) - usual;
        let against = likely(&mut beliefs.against.belief);
        beliefs.against.evidence += against - usual;
        beliefs.beyond_shake += against - beliefs.shaken(position_um, ticks, self.shake_share);
        if beliefs.against.evidence <= 0.0 {
            beliefs.against = Rival::of(beliefs.with.against(), zero_flow_um);
            beliefs.beyond_shake = 0.0;
        }
        if beliefs.adrift.evidence <= 0.0 || !is_away {
            beliefs.adrift = Rival::of(beliefs.with.adrift(driven_um), zero_flow_um);
        }
        let Beliefs {
            against,
            adrift,
            beyond_shake,
            ..
        } = beliefs;
        if against.evidence.min(*beyond_shake) > EVIDENCE.max(adrift.evidence) {
            let path = against.belief.likelier();
            return Some((Instead::Against, path.rest_um(self.mean_um, self.gain)));
        }
        let goes = adrift.evidence > EVIDENCE && beliefs.compared.2;
        goes.then_some((Instead::Adrift, beliefs.adrift.zero_flow_um))
    }
}

#[cfg(test)]
mod tests;
