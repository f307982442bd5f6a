//! Does the bead follow the commands, or is the loop itself what drives it away, as one whose sign is wrong does?
//!
//! Three hypotheses are weighed: the bead goes with the commands, against them with the same gain, or does not feel them, as when an
//! amplifier clips. In each an unknown flow carries it, which walks, steps, or grows at a rate. Each is a Kalman filter of position,
//! flow, its change, and gain; the likelihoods of the second and third are compared with that of the first from the time on at which
//! they began to be the better ones (Page's test). A flow that rises makes the error grow as a wrong sign does, but it does not do so
//! in proportion to the commands for long. Commands that cancel a flow look as if neither moved the bead: one that does not feel
//! them is looked for only while it goes further and further away.
//!
//! While the loop pushes, a wrong sign and a flow that rises look alike. In a pause they do not: with the PZT at the zero flow of
//! before, a bead whose sign is wrong stops, and a flow carries it on. So a wrong sign is told after a pause of a few ticks only.
//!
//! A picture that shakes and an actuator that rings move the bead in no hypothesis of these. A wrong sign must then predict the motion
//! better than its mere size does.
//!
//! An actuator may clip close to zero flow. The loop then still holds the bead, but more loosely. The dither shows the clip: see
//! [`one_sided`].
//!
//! Limit: a flow of more than 2 um that rises within 40 ms (1 % to 99 %) grows just as a loop with a wrong sign does, and can be taken
//! for one.

mod belief;
mod one_sided;

use crate::keeping::Hold;
use belief::{Belief, Noise, Path};
use cellpos_control::{EstimatorConfig, LoopModel};
use one_sided::{Moved, OneSided};

/// Natural logarithm of the odds that are asked for. Where a model is exact, Page's test is wrong once in e^32 ticks, 2,500 years at 1 kHz;
/// e^20 would do for a year. The rest is for flows that rise as no model here does: evidence of a wrong sign grows with the square of an
/// error that grows e-fold in 8 ms, so that it costs 4 ms ln(32 / 20) = 2 ms.
const EVIDENCE: f64 = 32.0;
/// Evidence of a wrong sign at which the loop pauses, its PZT at the zero flow of before: there the bead stops if the sign is wrong, and a
/// flow goes on. The rest of the evidence is what it costs the flow to stop at just that time, e^15 by [`cellpos_control::flow_step_log_density`].
/// In a hold it comes about once in e^16 ticks, 2.5 h, and costs 60 nm.
const PAUSE_EVIDENCE: f64 = 0.5 * EVIDENCE;
/// Time in which what was learnt of the gain is forgotten, s: a hold tells it to 10 % in that time, for commands answer the walk.
const GAIN_MEMORY_S: f64 = 1.0;
/// Time over which commands are averaged, to count them from there, s: a hundred delays.
const MEAN_S: f64 = 0.25;
/// Time over which the mean square of the bead's motion in a tick is taken, s. One that grows e-fold in 8 ms is then six times its mean,
/// sqrt(0.15 / 0.004), which speaks against a mere shake.
const SHAKE_S: f64 = 0.15;
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

/// What the bead does instead of following.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Instead {
    /// It goes against the commands.
    Against,
    /// It does not feel them.
    Adrift,
    /// It feels those on one side of zero flow only, and is held.
    OneSided,
}

/// A pause of the loop: where its PZT rests, um, ticks since it began, and the evidence before its command showed.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Pause {
    rest_um: f64,
    ticks: usize,
    evidence: f64,
}

impl Pause {
    /// It lasts until its command, which takes `delay` ticks to show, has shown for as long again.
    fn is_over(&self, delay: usize) -> bool {
        self.ticks >= 2 * delay
    }
}

/// A hypothesis beside the usual one, and how much likelier it is, natural logarithm of the odds.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Rival {
    belief: Belief,
    evidence: f64,
    /// Zero flow of the quiet time before it began to be the likelier one, um.
    zero_flow_um: f64,
    /// The pause that was made for it.
    pause: Option<Pause>,
}

impl Rival {
    fn of(belief: Belief, zero_flow_um: f64) -> Self {
        Self {
            belief,
            evidence: 0.0,
            zero_flow_um,
            pause: None,
        }
    }

    /// Whether a pause for it is over, and whether the hypothesis is refuted; a command takes `delay` ticks to show.
    fn judge_pause(&mut self, delay: usize) -> (bool, bool) {
        let unlikely = self.evidence <= 0.0;
        let Some(pause) = &mut self.pause else {
            return (false, unlikely);
        };
        if pause.ticks <= delay {
            pause.evidence = self.evidence;
        }
        let over = pause.is_over(delay);
        // A bead that went on in the pause is carried by a flow.
        (over, unlikely || over && self.evidence <= pause.evidence)
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
    /// Its random part.
    pub dither_um: f64,
    /// Its part that a periodic flow cancels, so that the bead does not follow it.
    pub cancel_um: f64,
    /// Zero flow of the last quiet time.
    pub zero_flow_um: f64,
}

/// The watch over a loop that runs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Following {
    /// Way of the bead for a displacement of 1 um in a tick, um; 0 where the plant is too slow to be watched.
    gain: f64,
    noise: Noise,
    hold: Hold,
    /// Uncertainty of the zero flow at the start, as a way in a tick, um.
    start_um: f64,
    /// Age of fixes in ticks: whole ones, and the part of one.
    age: (usize, f64),
    /// Ticks from a command to the fix that shows it, and those after which the distance of a bead that is away tells something.
    delay: usize,
    away_ticks: f64,
    /// Newest commands first, um, and how many there are.
    commands_um: [f64; COMMANDS],
    known: usize,
    dithers_um: [f64; COMMANDS],
    /// The commands without what a periodic flow cancels: the bead follows these.
    follows_um: [f64; COMMANDS],
    one_sided: OneSided,
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
        let age = (delay_s / sample_s).clamp(0.0, (COMMANDS - 4) as f64);
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
            age: (age as usize, age.fract()),
            delay: age.ceil() as usize + 1,
            away_ticks: AWAY_DELAYS * delay_and_hold_s / sample_s,
            commands_um: [0.0; COMMANDS],
            known: 0,
            dithers_um: [0.0; COMMANDS],
            follows_um: [0.0; COMMANDS],
            one_sided: OneSided::new(sample_s),
            mean_um: 0.0,
            mean_share: (sample_s / MEAN_S).min(1.0),
            shake_share: (sample_s / SHAKE_S).min(1.0),
            beliefs: None,
            since_fix: 0.0,
        }
    }

    /// Where the PZT is to rest while a pause tells whether the bead goes against the commands, um.
    pub(super) fn pause_um(&self) -> Option<f64> {
        let pause = self.beliefs.as_ref()?.against.pause?;
        (!pause.is_over(self.delay)).then_some(pause.rest_um)
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
            dither_um: self.dithers_um[0],
            cancel_um: self.commands_um[0] - self.follows_um[0],
            zero_flow_um: f64::NAN,
        });
    }

    /// The displacement that moved the bead from the last fix to that of this tick, in the mean, and its change with a tick of delay, um:
    /// unless fixes are a whole number of ticks old, the command changed meanwhile. `None` while too few commands are known.
    fn shown_um(&self, commands_um: &[f64; COMMANDS]) -> Option<(f64, f64)> {
        let (whole, part) = self.age;
        let newest = commands_um.get(whole + 1..whole + 3);
        let &[now_um, before_um] = newest.filter(|_| self.known > whole + 2)? else {
            return None;
        };
        let change_um = before_um - now_um;
        Some((now_um + part * change_um, change_um))
    }

    fn remember(&mut self, seen: &Seen) {
        for (past_um, newest_um) in [
            (&mut self.commands_um, seen.command_um),
            (&mut self.dithers_um, seen.dither_um),
            (&mut self.follows_um, seen.command_um - seen.cancel_um),
        ] {
            past_um.copy_within(..COMMANDS - 1, 1);
            past_um[0] = newest_um;
        }
        self.known = (self.known + 1).min(COMMANDS);
    }

    /// Takes in a tick. Gives what the bead does instead of following the commands, and the displacement at which it rested before, um.
    pub(super) fn step(&mut self, seen: &Seen) -> Option<(Instead, f64)> {
        if self.gain == 0.0 {
            return None;
        }
        self.remember(seen);
        let Some((commanded_um, change_um)) = self.shown_um(&self.commands_um) else {
            self.mean_um = self.follows_um[0];
            return None;
        };
        let (now_um, _) = self.shown_um(&self.follows_um)?;
        self.since_fix += 1.0;
        let shift_um = self.mean_share * (now_um - self.mean_um);
        self.mean_um += shift_um;
        let driven_um = self.gain * (now_um - self.mean_um);
        let doubt_um = DELAY_ERROR * self.gain * change_um;
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
            if let Some(pause) = &mut against.pause {
                pause.ticks = pause.ticks.saturating_add(1);
            }
        }
        let (dithered_um, _) = self.shown_um(&self.dithers_um)?;
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
        if ticks == 1.0 {
            self.one_sided.step(&Moved {
                bead_um: position_um - beliefs.before_um,
                usual_um2: beliefs.motion_um2,
                dither_um: self.gain * dithered_um,
                above: commanded_um - dithered_um > zero_flow_um,
            });
        }
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
        let (paused, refuted) = beliefs.against.judge_pause(self.delay);
        if refuted {
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
        let evidence = against.evidence.min(*beyond_shake);
        if evidence > PAUSE_EVIDENCE.max(adrift.evidence) {
            let rest_um = against.zero_flow_um;
            if against.pause.is_none() {
                against.pause = Some(Pause {
                    rest_um,
                    ticks: 0,
                    evidence: against.evidence,
                });
            } else if evidence > EVIDENCE && paused {
                return Some((Instead::Against, rest_um));
            }
        }
        if adrift.evidence > EVIDENCE && beliefs.compared.2 {
            return Some((Instead::Adrift, adrift.zero_flow_um));
        }
        (self.one_sided.told()).then_some((Instead::OneSided, zero_flow_um))
    }
}

#[cfg(test)]
mod tests;
