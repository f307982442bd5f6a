//! Does the bead follow the commands, or is the loop itself what drives it away, as one whose sign is wrong does?
//!
//! Two hypotheses are weighed: the bead goes with the commands, or against them with the same gain. In both an unknown flow
//! carries it, which walks, steps, or grows at a rate. Each is a Kalman filter of position, flow, its change, and gain; their
//! likelihoods are compared from the time on at which the second began to be the better one (Page's test). A flow that rises
//! makes the error grow as a wrong sign does, but it does not do so in proportion to the commands for long.
//!
//! Limit: a flow of more than 2 um that rises within 40 ms (1 % to 99 %) grows just as a loop with a wrong sign does, and can be taken
//! for one.

use cellpos_control::{EstimatorConfig, LoopModel, flow_step_log_density};

/// Natural logarithm of the odds that are asked for, chosen among drawn flows: the beginning of a rise looks like a wrong sign, and
/// a wrong sign is to be told before the bead is 10 um away at 1 kHz.
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
/// A flow starts to change as often as it steps, so often in a second.
const CHANGES_PER_S: f64 = 0.01;
/// Delays in which a flow that grows at its fastest grows by a factor e: 5 ms. A loop with a wrong sign does in 8 ms, the solution
/// of s = 0.43 / T exp(-s T) with the delay T of 2.5 ms and the usual margins.
const GROWTH_DELAYS: f64 = 2.0;
/// A flow that has begun to change drives the bead as this displacement does, to the order of magnitude, um.
const CHANGE_UM: f64 = 1.0;
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
    /// Sign of the gain.
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
        self.p[3][3] += (1.0 - kept * kept) * GAIN_SD * GAIN_SD;
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

    fn against(self) -> Self {
        Self {
            quiet: self.quiet.against(),
            restless: self.restless.against(),
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

/// The watch over a loop that runs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Following {
    /// Way of the bead for a displacement of 1 um in a tick, um; 0 where the plant is too slow to be watched.
    gain: f64,
    noise: Noise,
    /// What the zero flow at the start is uncertain by, as a way in a tick, um.
    start_um: f64,
    /// Ticks from a command to the fix that shows it.
    delay: usize,
    /// Newest commands first, um, and how many there are.
    commands_um: [f64; COMMANDS],
    known: usize,
    mean_um: f64,
    mean_share: f64,
    /// The bead that goes with the commands, the one that goes against them, and the evidence for that; none until a fix is known.
    beliefs: Option<(Belief, Belief, f64)>,
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
        let growth = (sample_s / (GROWTH_DELAYS * (delay_s + 0.5 * sample_s))).min(1.0);
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
            start_um: gain * config.neutral_initial_um,
            delay: delay as usize + 1,
            commands_um: [0.0; COMMANDS],
            known: 0,
            mean_um: 0.0,
            mean_share: (sample_s / MEAN_S).min(1.0),
            beliefs: None,
            since_fix: 0.0,
        }
    }

    /// The ticks before do not count: the loop did not run, the bead was held by something, or what stood at the PZT is not known.
    pub(super) fn clear(&mut self) {
        self.known = 0;
        self.beliefs = None;
    }

    /// Takes in a tick: position and variance of the fix, if one came on time, um, and the command, um, which shows one delay later.
    /// True when the loop drives the bead away.
    pub(super) fn step(&mut self, fix: Option<(f64, f64)>, command_um: f64) -> bool {
        if self.gain == 0.0 {
            return false;
        }
        self.commands_um.copy_within(..COMMANDS - 1, 1);
        self.commands_um[0] = command_um;
        self.known = (self.known + 1).min(COMMANDS);
        let newest = self.commands_um.get(self.delay..self.delay + 2);
        let Some(&[now_um, before_um]) = newest.filter(|_| self.known > self.delay + 1) else {
            self.mean_um = command_um;
            return false;
        };
        self.since_fix += 1.0;
        let shift_um = self.mean_share * (now_um - self.mean_um);
        self.mean_um += shift_um;
        let driven_um = self.gain * (now_um - self.mean_um);
        let doubt_um = DELAY_ERROR * self.gain * (now_um - before_um);
        if let Some((with, against, _)) = &mut self.beliefs {
            for belief in [with, against] {
                belief.advance(driven_um, doubt_um, self.gain * shift_um, &self.noise);
            }
        }
        let Some((position_um, variance_um2)) = fix else {
            return false;
        };
        let ticks = std::mem::take(&mut self.since_fix).max(1.0);
        let Some((with, against, evidence)) = &mut self.beliefs else {
            let with = Belief::of(Path::at(position_um, variance_um2, self.start_um));
            self.beliefs = Some((with, with.against(), 0.0));
            return false;
        };
        let likely = with.correct(position_um, variance_um2, ticks, &self.noise);
        *evidence += against.correct(position_um, variance_um2, ticks, &self.noise) - likely;
        if *evidence <= 0.0 {
            (*against, *evidence) = (with.against(), 0.0);
        }
        *evidence > EVIDENCE
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::test_noise::noise;

    /// What a loop meets, as functions of time.
    struct World<'a> {
        seed: u64,
        /// Gain over the model's at a time.
        gain_ratio: &'a dyn Fn(f64) -> f64,
        axis: f64,
        rate_hz: f64,
        zero_flow: &'a dyn Fn(f64) -> f64,
        reference: &'a dyn Fn(f64) -> f64,
        seconds: f64,
    }

    impl Default for World<'_> {
        fn default() -> Self {
            Self {
                seed: 1,
                gain_ratio: &|_| 1.0,
                axis: 1.0,
                rate_hz: 1000.0,
                zero_flow: &|_| 20.0,
                reference: &|_| 0.0,
                seconds: 11.0,
            }
        }
    }

    /// When it was told, s, and how far the bead was, um.
    type Told = (f64, f64);

    /// A proportional loop with an integral on an integrator.
    fn told(world: &World<'_>) -> Option<Told> {
        let mut state = world.seed;
        let dt = 1.0 / world.rate_hz;
        let model = LoopModel {
            sample_time_s: dt,
            ..LoopModel::integrator(380.0 * world.axis, 2e-3)
        };
        let config = EstimatorConfig::default();
        let mut following = Following::new(&config, &model, 2e-3);
        let late = (2e-3 * world.rate_hz).round() as usize;
        let (mut bead_um, mut zero_um, mut command_um) = (0.0, 20.0, 20.0_f64);
        let mut seen = std::collections::VecDeque::from(vec![0.0; late + 1]);
        for k in 0..(world.seconds * world.rate_hz) as u64 {
            let t = k as f64 * dt;
            let pushed_um = command_um - (world.zero_flow)(t);
            bead_um += world.axis * (world.gain_ratio)(t) * 380.0 * dt * pushed_um
                + (0.66 * dt).sqrt() * noise(&mut state);
            seen.push_back(bead_um);
            seen.pop_front();
            let fix_um = seen[0] + 0.015 * noise(&mut state);
            let reference_um = (world.reference)(t);
            let error_um = world.axis * (fix_um - reference_um);
            zero_um -= 8.0 * dt * error_um;
            command_um = (zero_um - 0.4 * error_um).clamp(0.0, 40.0);
            let fix = Some((fix_um, 0.015_f64.powi(2)));
            if following.step(fix, command_um) {
                return Some((t, error_um));
            }
        }
        None
    }

    #[test]
    fn a_sign_that_flips_is_told_while_the_bead_is_in_the_picture() {
        for rate_hz in [1000.0, 2000.0, 5000.0] {
            for (gain, axis) in [(1.0, 1.0), (1.4, -1.0), (2.0, 1.0)] {
                for seed in 1..=10 {
                    let told = told(&World {
                        seed,
                        axis,
                        rate_hz,
                        gain_ratio: &|t| if t < 3.0 { gain } else { -gain },
                        seconds: 3.5,
                        ..World::default()
                    });
                    let in_time =
                        told.is_some_and(|(s, um)| (3.0..3.12).contains(&s) && um.abs() < 12.0);
                    assert!(in_time, "gain {gain}, {rate_hz} Hz, seed {seed}: {told:?}");
                }
            }
        }
    }

    /// A flow that rises there and back every 2 s, from 1 % to 99 % in that time.
    fn logistic(um: f64, rise_s: f64) -> impl Fn(f64) -> f64 {
        move |t: f64| {
            let p = (t % 2.0) - 1.0;
            let since = (p.abs() - 0.5) * 9.2 / rise_s;
            20.0 + um / (1.0 + since.exp())
        }
    }

    /// A flow that goes to 2 um and back every second, with a time constant.
    fn relaxes(tau_s: f64) -> impl Fn(f64) -> f64 {
        move |t: f64| {
            let since_s = t % 1.0;
            let decays = 2.0 * (-since_s / tau_s).exp();
            if t % 2.0 < 1.0 {
                22.0 - decays
            } else {
                20.0 + decays
            }
        }
    }

    #[test]
    fn half_to_twice_the_gain_and_flows_that_step_drift_or_rise_are_followed() {
        let [fast, middle, slow] = [0.005, 0.02, 0.08].map(relaxes);
        let [small, large] = [(2.6, 0.1), (-5.0, 0.1)].map(|(um, s)| logistic(um, s));
        let flows: [&dyn Fn(f64) -> f64; 10] = [
            &|_| 20.0,
            &|t| 20.0 + 0.2 * t,
            &|t| 10.0 + 6.0 * (t % 4.0 - 2.0).abs(),
            &|t| 20.0 + 0.3 * (t.floor() % 2.0),
            &|t| 20.0 + 2.6 * (t.floor() % 2.0),
            &fast,
            &middle,
            &slow,
            &small,
            &large,
        ];
        for seed in 1..=2 {
            for gain in [0.5, 1.0, 2.0] {
                for (n, zero_flow) in flows.into_iter().enumerate() {
                    for hz in [0.0, 1.0, 20.0] {
                        let at = told(&World {
                            seed,
                            gain_ratio: &|_| gain,
                            zero_flow,
                            reference: &|t| 5.0 * (std::f64::consts::TAU * hz * t).sin(),
                            seconds: 6.0,
                            ..World::default()
                        });
                        assert_eq!(at, None, "flow {n}, gain {gain}, {hz} Hz, seed {seed}");
                    }
                }
            }
        }
    }
}
