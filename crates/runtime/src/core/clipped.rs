//! Does the bead follow the commands on both sides of zero flow? An amplifier that clips, a supply that is too low, a PZT at its
//! stop: the bead goes where the flow takes it, and the commands grow.
//!
//! Two filters follow the bead for either side of zero flow. In the first, commands on that side drive it by half the model's gain,
//! the least that the loop is made for; in the second, not at all. Both learn a velocity and its change, so that no flow, however it
//! steps or drifts, speaks for the second. The ratio of their likelihoods counts once the bead has been away from its reference, on
//! the side to which those commands would not let it go, for longer than any loop takes to bring it back.

use crate::keeping::Hold;
use cellpos_control::{EstimatorConfig, LoopModel};

/// Share of the model's gain in the first filter.
const LEAST_GAIN: f64 = 0.5;
/// Natural logarithm of the odds that are asked for, and what one fix adds at most: an outlier must not decide.
const EVIDENCE: f64 = 20.0;
const MOST_PER_FIX: f64 = 0.3;
/// Standard deviations of an innovation that both filters take for a step of the flow.
const STEP_SIGMA: f64 = 5.0;
/// Time in which the filters learn a velocity, s: ten delays, so that an answer to the commands is not learnt as flow.
const LEARNING_S: f64 = 0.025;
/// Time over which the distance from the reference is averaged, and for which it must have been too large, s. The slowest integral
/// of a law here is through in 0.15 s.
const AVERAGE_S: f64 = 0.05;
const AWAY_S: f64 = 0.1;
/// Share of a fix in the innovations' variance.
const VARIANCE_SHARE: f64 = 0.002;
/// Ways in which commands push the bead.
const SIDES: [f64; 2] = [1.0, -1.0];
/// Commands remembered: their way to a fix takes the camera's delay.
const COMMANDS: usize = 64;
/// Share of the model's speed that may be its slow modes': a plant that answers later shows nothing within the time of learning.
const SLOW_SHARE: f64 = 0.5;

/// Position, velocity and its change, um and ticks.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Path {
    position: f64,
    velocity: f64,
    change: f64,
}

impl Path {
    fn advance(&mut self, driven_um: f64) {
        self.position += self.velocity + driven_um;
        self.velocity += self.change;
    }

    fn correct(&mut self, innovation_um: f64, gains: [f64; 3]) {
        self.position += gains[0] * innovation_um;
        self.velocity += gains[1] * innovation_um;
        self.change += gains[2] * innovation_um;
    }
}

/// The watch over a loop that runs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Clipped {
    /// Way of the bead per um and tick, um; 0 where the plant is too slow to be watched.
    gain: f64,
    sample_s: f64,
    hold: Hold,
    /// Ticks from a command to the fix that shows it.
    delay: usize,
    /// Newest commands first, um, and how many there are.
    commands_um: [f64; COMMANDS],
    known: usize,
    /// Zero flow while the bead was last where it should be, um.
    zero_flow_um: f64,
    /// Gains of the filters at a fix.
    gains: [f64; 3],
    variance_um2: f64,
    /// For either of [`SIDES`]: with them, without them, and the evidence for the latter.
    sides: [([Path; 2], f64); 2],
    started: bool,
    since_fix: f64,
    error_um: f64,
    away_s: f64,
    told: bool,
}

impl Clipped {
    /// For an estimator and a plant, and fixes that are `delay_s` old, of a bead that is to be held so well.
    pub(super) fn new(config: &EstimatorConfig, model: &LoopModel, delay_s: f64) -> Self {
        let sample_s = model.sample_time_s;
        let delay = (delay_s / sample_s)
            .round()
            .clamp(0.0, (COMMANDS - 2) as f64);
        let slow: f64 = model.modes.iter().map(|mode| mode.residue_per_s).sum();
        let quick = slow.abs() < SLOW_SHARE * model.gain_per_s.abs();
        // A walk seen with noise: the steady gain of its Kalman filter. The velocity is critically damped.
        let walk = 2.0 * config.diffusion_um2_per_s * sample_s * config.ticks_per_fix.max(1.0);
        let noise = config.fix_noise_um.powi(2);
        let spread = 0.5 * (walk + (walk * walk + 4.0 * walk * noise).sqrt());
        let learning = (sample_s / LEARNING_S).min(0.5);
        Self {
            gain: if quick {
                (model.gain_per_s + slow) * sample_s
            } else {
                0.0
            },
            sample_s,
            hold: Hold::new(config.diffusion_um2_per_s, delay_s, sample_s),
            delay: delay as usize + 1,
            commands_um: [0.0; COMMANDS],
            known: 0,
            zero_flow_um: f64::NAN,
            gains: [
                (spread / (spread + noise)).max(learning),
                learning,
                0.25 * learning * learning,
            ],
            variance_um2: (spread + noise).max(1e-12),
            sides: [([Path::default(); 2], 0.0); 2],
            started: false,
            since_fix: 0.0,
            error_um: 0.0,
            away_s: 0.0,
            told: false,
        }
    }

    /// Whether it was found that the bead does not follow.
    pub(super) fn is_told(&self) -> bool {
        self.told
    }

    /// The ticks before do not count: the loop did not run, the bead was held by something, or what stood at the PZT is not known.
    pub(super) fn clear(&mut self) {
        (self.known, self.started) = (0, false);
        (self.error_um, self.away_s) = (0.0, 0.0);
    }

    /// Takes in a tick: position and variance of the fix, if one came on time, and reference, command and zero flow, um. Gives
    /// once the level beyond which the bead does not follow, um.
    pub(super) fn step(
        &mut self,
        fix: Option<(f64, f64)>,
        reference_um: f64,
        command_um: f64,
        zero_flow_um: f64,
    ) -> Option<f64> {
        if self.gain == 0.0 || self.told {
            return None;
        }
        self.commands_um.copy_within(..COMMANDS - 1, 1);
        self.commands_um[0] = command_um;
        self.known = (self.known + 1).min(COMMANDS);
        if self.known <= self.delay {
            return None;
        }
        if self.away_s == 0.0 || self.zero_flow_um.is_nan() {
            self.zero_flow_um = zero_flow_um;
        }
        let in_force_um = self.commands_um.get(self.delay).copied()?;
        let pushed_um = self.gain * (in_force_um - self.zero_flow_um);
        self.since_fix += 1.0;
        for (side, (paths, _)) in SIDES.into_iter().zip(&mut self.sides) {
            let in_doubt_um = side * (side * pushed_um).max(0.0);
            let certain_um = pushed_um - in_doubt_um;
            let [with, without] = paths;
            with.advance(certain_um + LEAST_GAIN * in_doubt_um);
            without.advance(certain_um);
        }
        let (position_um, variance_um2) = fix?;
        let limit_um = self.hold.limit_um(variance_um2);
        let share = (self.since_fix * self.sample_s / AVERAGE_S).min(1.0);
        self.error_um += share * (position_um - reference_um - self.error_um);
        if self.error_um.abs() > limit_um {
            self.away_s += self.since_fix * self.sample_s;
        } else {
            self.away_s = 0.0;
        }
        self.weigh(position_um)
    }

    fn weigh(&mut self, position_um: f64) -> Option<f64> {
        let ticks = std::mem::take(&mut self.since_fix).max(1.0);
        if !std::mem::replace(&mut self.started, true) {
            for (paths, evidence) in &mut self.sides {
                *evidence = 0.0;
                for path in paths {
                    *path = Path {
                        position: position_um,
                        ..Path::default()
                    };
                }
            }
            return None;
        }
        let step_um = STEP_SIGMA * self.variance_um2.sqrt();
        let mut least_um2 = f64::INFINITY;
        let mut level_um = None;
        for (side, (paths, evidence)) in SIDES.into_iter().zip(&mut self.sides) {
            let off = paths.map(|path| position_um - path.position);
            let stepped = off.iter().all(|um| um.abs() > step_um);
            let gains = if stepped {
                [1.0, 1.0 / ticks, 0.0]
            } else {
                self.gains
            };
            for (path, um) in paths.iter_mut().zip(off) {
                path.correct(um, gains);
            }
            let [with, without] = off.map(|um| um * um);
            least_um2 = least_um2.min(with).min(without);
            // Its commands push the bead this way, and it is away the other way.
            let away = self.away_s > 0.0 && side * self.error_um < 0.0;
            if !away {
                *evidence = 0.0;
            } else if !stepped {
                let odds = (with - without) / (2.0 * self.variance_um2);
                *evidence = (*evidence + odds.clamp(-MOST_PER_FIX, MOST_PER_FIX)).max(0.0);
            }
            if *evidence > EVIDENCE && self.away_s >= AWAY_S {
                level_um = Some(self.zero_flow_um);
            }
        }
        if least_um2 < step_um * step_um {
            self.variance_um2 += VARIANCE_SHARE * (least_um2 - self.variance_um2);
        }
        self.told = level_um.is_some();
        level_um
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::test_noise::noise;

    /// What a loop meets, as functions of time.
    struct World<'a> {
        seed: u64,
        /// Gain over the model's; its sign is that of the axis.
        gain_ratio: f64,
        axis: f64,
        zero_flow: &'a dyn Fn(f64) -> f64,
        /// Displacements that the actuator gives, um.
        range: &'a dyn Fn(f64) -> [f64; 2],
        reference: &'a dyn Fn(f64) -> f64,
        seconds: f64,
    }

    /// A proportional loop with an integral on an integrator; gives when a clip was told, s.
    fn told(world: &World<'_>) -> Option<f64> {
        let mut state = world.seed;
        let model = LoopModel::integrator(380.0 * world.axis, 2e-3);
        let config = EstimatorConfig::default();
        let mut clipped = Clipped::new(&config, &model, 2e-3);
        let (mut bead_um, mut zero_um, mut command_um) = (0.0, 20.0, 20.0_f64);
        let mut seen = [0.0; 3];
        for k in 0..(world.seconds * 1e3) as u64 {
            let t = k as f64 * 1e-3;
            let [low_um, high_um] = (world.range)(t);
            let pushed_um = command_um.clamp(low_um, high_um) - (world.zero_flow)(t);
            bead_um += world.axis * world.gain_ratio * 0.38 * pushed_um + 0.026 * noise(&mut state);
            seen.rotate_left(1);
            seen[2] = bead_um;
            let fix_um = seen[0] + 0.015 * noise(&mut state);
            let reference_um = (world.reference)(t);
            let error_um = world.axis * (fix_um - reference_um);
            zero_um -= 0.008 * error_um;
            command_um = zero_um - 0.4 * error_um;
            let fix = Some((fix_um, 0.015_f64.powi(2)));
            if clipped
                .step(fix, reference_um, command_um, zero_um)
                .is_some()
            {
                return Some(t);
            }
        }
        None
    }

    #[test]
    fn an_actuator_that_clips_near_zero_flow_is_told_within_seconds() {
        let worlds = [19.9, 19.98, 19.995].map(|um| (um, -1.0)).into_iter();
        for (level_um, side) in worlds.chain([20.1, 20.02, 20.005].map(|um| (um, 1.0))) {
            for (seed, axis) in [(1, 1.0), (2, -1.0), (3, 1.0)] {
                let range = |t: f64| match (t > 3.0, side < 0.0) {
                    (false, _) => [0.0, 40.0],
                    (true, true) => [0.0, level_um],
                    (true, false) => [level_um, 40.0],
                };
                let told_s = told(&World {
                    seed,
                    gain_ratio: 1.0,
                    axis,
                    zero_flow: &|_| 20.0,
                    range: &range,
                    reference: &|_| 0.0,
                    seconds: 11.0,
                });
                let soon = told_s.is_some_and(|s| (3.0..9.0).contains(&s));
                assert!(soon, "{level_um} um, seed {seed}: {told_s:?}");
            }
        }
    }

    #[test]
    fn half_to_twice_the_gain_and_flows_that_step_drift_or_rise_are_no_clip() {
        let rises = |tau: f64| {
            move |t: f64| {
                let p = t % 2.0;
                let (since, from, to) = if p < 1.0 {
                    (p, 20.0, 22.0)
                } else {
                    (p - 1.0, 22.0, 20.0)
                };
                to + (from - to) * (-since / tau).exp()
            }
        };
        let [fast, middle, slow] = [0.005, 0.02, 0.08].map(rises);
        let flows: [&dyn Fn(f64) -> f64; 8] = [
            &|_| 20.0,
            &|t| 20.0 + 0.2 * t,
            &|t| 20.0 + 6.0 * t,
            &|t| 20.0 + 0.3 * (t.floor() % 2.0),
            &|t| 20.0 + 2.6 * (t.floor() % 2.0),
            &fast,
            &middle,
            &slow,
        ];
        for seed in 1..=3 {
            for gain_ratio in [0.5, 1.0, 2.0] {
                for (n, zero_flow) in flows.into_iter().enumerate() {
                    for hz in [0.0, 1.0, 20.0] {
                        let at = told(&World {
                            seed,
                            gain_ratio,
                            axis: 1.0,
                            zero_flow,
                            range: &|_| [-400.0, 400.0],
                            reference: &|t| 5.0 * (std::f64::consts::TAU * hz * t).sin(),
                            seconds: 20.0,
                        });
                        assert_eq!(at, None, "flow {n}, gain {gain_ratio}, {hz} Hz");
                    }
                }
            }
        }
    }
}
