//! Mid-ranging (valve position control): a slow actuator without end returns a fast short one to the middle of its stroke.
//!
//! The bead's velocity is `K (u + g y - n)`: `u` is the PZT, `y` the slow partner's output (pressure, pump, reservoir height), `g` its
//! gain in um of PZT per um of its own scale. A move of the partner is therefore a known move of the zero flow, `-g dy`. It is handed to
//! the loop as such ([`crate::LoopInput::zero_flow_shift_um`]), so that estimator, law and PZT go along with it and the bead does not
//! notice. Not for a partner that stands alone: that is an actuator like any other.

use crate::error::{BuildError, check};
use crate::limits::Limits;
use serde::{Deserialize, Serialize};

/// Commands of the partner that may be on their way.
const PENDING: usize = 64;

/// Time constant of mid-ranging over the partner's lag, delay and half its period: the phase that these cost at its crossover is a tenth
/// of a radian, whatever the gain's error up to a factor of five.
const SLOWER: f64 = 10.0;

/// Rate at which the zero flow may move unpredicted and shift a held bead by less than 5 nm, um/s. The estimator follows a ramp `r` of the
/// zero flow with 0.13 s (sqrt(2 D) over K times its walk), the loop with 5 ms: 428/s x 0.13 s x 0.005 s x r = 5 nm.
const UNPREDICTED_UM_PER_S: f64 = 0.018;

/// Relative error of the partner's model that is always reckoned with: lag and delay of a device are not constant to better than this.
const LEAST_ERROR: f64 = 0.05;

/// Periods without a report after which the partner counts as lost: a program's watchdog acts after as many.
const SILENT_PERIODS: u32 = 5;

/// The slow partner as the loop knows it. Displacements are um of its own scale unless said otherwise.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PartnerConfig {
    /// Time between two commands, ms.
    pub period_ms: f64,
    /// Smallest command, um.
    pub low_um: f64,
    /// Largest command, um.
    pub high_um: f64,
    /// Its slew limit, um/s.
    pub slew_um_per_s: f64,
    /// Gain: um of PZT displacement that have the effect of 1 um of the partner.
    pub gain: f64,
    /// Half width of the gain's 95 % interval.
    pub gain_ci95: f64,
    /// Lag (63 % of a step), ms.
    pub lag_ms: f64,
    /// Dead time before it, ms.
    pub delay_ms: f64,
    /// Step of its converter, counted from `low_um`, um; 0: finer than matters.
    #[serde(default)]
    pub step_um: f64,
    /// Displacement to which the PZT is returned, um.
    pub mid_um: f64,
    /// Planned moves instead of mid-ranging, for identification.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub probe: Option<Probe>,
}

/// A square wave of the partner about its present displacement; the loop does not know of it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Probe {
    /// Half of peak to peak, um.
    pub amplitude_um: f64,
    /// Time up, and time down, s.
    pub half_period_s: f64,
}

/// Input of a tick of the partner.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PartnerInput {
    /// Ticks since the last step, 1 or more.
    pub steps: u64,
    /// Its newest report, if one came: displacement (um), and whether it takes commands.
    pub report: Option<(f64, bool)>,
    /// Command of the PZT in force, um.
    pub pzt_um: f64,
    /// The bead is held: the partner may move.
    pub held: bool,
}

/// Output of a step.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PartnerOutput {
    /// Command to hand over now, um.
    pub command_um: Option<f64>,
    /// By how much the zero flow moves with the partner up to the coming period, um of PZT.
    pub shift_um: f64,
}

/// State of the partner.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum PartnerStatus {
    /// Not heard yet.
    #[default]
    Waiting,
    /// Takes commands.
    Follows,
    /// Takes commands and is at an end of its range.
    AtLimit,
    /// Silent, parked or not obeying: the PZT is alone.
    Lost,
}

/// Configuration of mid-ranging for one sample time. Immutable; the state is apart.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Partner {
    config: PartnerConfig,
    sample_s: f64,
    period_ticks: u32,
    delay_ticks: u32,
    /// Part of the way to its input that the output goes in a tick, and in half a tick.
    share: f64,
    half_share: f64,
    /// Largest change per period, um, and largest change of that.
    most_um: f64,
    more_um: f64,
    /// Part of the way to its target that it goes in a period.
    approach: f64,
}

/// State of a [`Partner`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PartnerState {
    status: PartnerStatus,
    /// Commands, newest first, um, and ticks since the newest.
    commands_um: [f64; PENDING],
    age: u32,
    /// Where it is to be, between two steps of its converter, um, and the change of that with the newest command.
    wanted_um: f64,
    move_um: f64,
    output_um: f64,
    /// Effect on the zero flow in the middle of the last period, um of PZT.
    effect_um: f64,
    applied_um: f64,
    /// Ticks without a report, and ticks for which the reports are off the commands.
    silent: u32,
    off: u32,
    /// Where a probe began, um, and its ticks.
    base_um: f64,
    probed: u64,
}

impl Default for PartnerState {
    fn default() -> Self {
        Self {
            status: PartnerStatus::Waiting,
            commands_um: [f64::NAN; PENDING],
            age: 0,
            wanted_um: f64::NAN,
            move_um: 0.0,
            output_um: f64::NAN,
            effect_um: 0.0,
            applied_um: f64::NAN,
            silent: 0,
            off: 0,
            base_um: f64::NAN,
            probed: 0,
        }
    }
}

impl PartnerState {
    /// How it is.
    pub fn status(&self) -> PartnerStatus {
        self.status
    }

    /// Newest command, um; NaN before the first report.
    pub fn command_um(&self) -> f64 {
        self.commands_um[0]
    }

    /// Displacement in its last report, um; NaN before the first report.
    pub fn applied_um(&self) -> f64 {
        self.applied_um
    }

    /// Its effect on the flow now, um of PZT.
    pub fn effect_um(&self) -> f64 {
        self.effect_um
    }

    fn rest_at(&mut self, um: f64) {
        self.commands_um = [um; PENDING];
        (self.wanted_um, self.move_um) = (um, 0.0);
    }
}

impl Partner {
    /// Mid-ranging for a PZT with these limits, at this sample time.
    ///
    /// # Errors
    /// [`BuildError`] naming the value that cannot be.
    pub fn new(config: PartnerConfig, limits: &Limits, sample_s: f64) -> Result<Self, BuildError> {
        let c = &config;
        let longest_ms = (PENDING - 2) as f64 * c.period_ms;
        let inside = (limits.low_um..=limits.high_um).contains(&c.mid_um);
        for (name, unit, value, good, must) in [
            (
                "period_ms",
                "ms",
                c.period_ms,
                (1e3 * sample_s..=10_000.0).contains(&c.period_ms),
                "one period of the loop to 10000 ms",
            ),
            (
                "low_um",
                "um",
                c.low_um,
                c.low_um.abs() <= 2000.0,
                "-2000 to 2000 um",
            ),
            (
                "high_um",
                "um",
                c.high_um,
                c.high_um > c.low_um && c.high_um <= 2000.0,
                "above low_um, at most 2000 um",
            ),
            (
                "slew_um_per_s",
                "um/s",
                c.slew_um_per_s,
                c.slew_um_per_s > 0.0,
                "positive",
            ),
            (
                "gain",
                "",
                c.gain,
                c.gain.abs() > 1e-6 && c.gain.abs() < 1e6,
                "not zero: cellpos rig partner measures it",
            ),
            (
                "gain_ci95",
                "",
                c.gain_ci95,
                c.gain_ci95 >= 0.0,
                "0 or more",
            ),
            (
                "lag_ms",
                "ms",
                c.lag_ms,
                (0.0..=60_000.0).contains(&c.lag_ms),
                "0 to 60000 ms",
            ),
            (
                "delay_ms",
                "ms",
                c.delay_ms,
                (0.0..=longest_ms).contains(&c.delay_ms),
                "0 to 62 periods of the partner",
            ),
            ("mid_um", "um", c.mid_um, inside, "within [limits]"),
        ] {
            check(name, unit, value, good && value.is_finite(), must)?;
        }
        let ticks = |ms: f64| (ms * 1e-3 / sample_s).round() as u32;
        let share = |s: f64| match c.lag_ms {
            0.0 => 1.0,
            ms => -(-s / (ms * 1e-3)).exp_m1(),
        };
        let period_s = c.period_ms * 1e-3;
        let time_s = SLOWER * ((c.lag_ms + c.delay_ms) * 1e-3 + 0.5 * period_s);
        let error = (c.gain_ci95 / c.gain.abs()).max(LEAST_ERROR);
        let unseen_um_per_s = UNPREDICTED_UM_PER_S / error / c.gain.abs();
        let most_um = unseen_um_per_s.min(c.slew_um_per_s) * period_s;
        Ok(Self {
            sample_s,
            period_ticks: ticks(c.period_ms).max(1),
            delay_ticks: ticks(c.delay_ms),
            share: share(sample_s),
            half_share: share(0.5 * sample_s),
            most_um,
            more_um: most_um * (period_s / time_s).min(1.0),
            approach: (period_s / time_s).min(1.0),
            config,
        })
    }

    /// One tick.
    pub fn step(&self, state: &mut PartnerState, input: &PartnerInput) -> PartnerOutput {
        let steps = u32::try_from(input.steps).unwrap_or(u32::MAX);
        self.hear(state, input, steps);
        if !state.output_um.is_finite() {
            return PartnerOutput::default();
        }
        state.age = state.age.saturating_add(steps);
        if input.held {
            state.probed = state.probed.saturating_add(input.steps);
        }
        let command_um = (state.age >= self.period_ticks).then(|| {
            let wanted_um = self.next_um(state, input);
            state.move_um = wanted_um - state.wanted_um;
            state.wanted_um = wanted_um;
            let next_um = self.on_step(wanted_um);
            state.commands_um.rotate_right(1);
            state.commands_um[0] = next_um;
            state.age = 0;
            next_um
        });
        let before_um = state.effect_um;
        let into_um = self.in_force_um(state);
        // After a gap the partner stood still for most of it: its lag is over when the gap is as long as this.
        const MOST_STEPS: u32 = 10_000;
        for _ in 1..steps.min(MOST_STEPS) {
            state.output_um += self.share * (into_um - state.output_um);
        }
        let middle_um = state.output_um + self.half_share * (into_um - state.output_um);
        state.output_um += self.share * (into_um - state.output_um);
        state.effect_um = self.config.gain * middle_um;
        PartnerOutput {
            command_um,
            shift_um: if self.config.probe.is_some() {
                0.0
            } else {
                before_um - state.effect_um
            },
        }
    }

    /// Takes in a report, or its absence.
    fn hear(&self, state: &mut PartnerState, input: &PartnerInput, steps: u32) {
        let periods = |n: u32| n.saturating_mul(self.period_ticks);
        let Some((applied_um, takes_commands)) = input.report.filter(|(um, _)| um.is_finite())
        else {
            state.silent = state.silent.saturating_add(steps);
            // At the start the devices are armed one after the other.
            let patience = if state.status == PartnerStatus::Waiting {
                10
            } else {
                1
            };
            if state.silent > periods(patience * SILENT_PERIODS) {
                self.lose(state);
            }
            return;
        };
        state.silent = 0;
        state.applied_um = applied_um;
        // As far off as it may go in three periods, or a thousandth of its range: a converter of ten bits.
        let range_um = self.config.high_um - self.config.low_um;
        let allowed_um = (3.0 * self.most_um).max(1e-3 * range_um);
        let off = state.status == PartnerStatus::Follows
            && (applied_um - state.commands_um[0]).abs() > allowed_um;
        state.off = if off && self.config.probe.is_none() {
            state.off.saturating_add(steps)
        } else {
            0
        };
        if !takes_commands || state.off > periods(10 * SILENT_PERIODS) {
            self.lose(state);
        } else if matches!(state.status, PartnerStatus::Waiting | PartnerStatus::Lost) {
            state.rest_at(applied_um);
            state.status = PartnerStatus::Follows;
            if !state.output_um.is_finite() {
                state.output_um = applied_um;
                state.effect_um = self.config.gain * applied_um;
                state.base_um = applied_um;
            }
        }
    }

    /// From here on it counts as being at its last known displacement.
    fn lose(&self, state: &mut PartnerState) {
        if state.status != PartnerStatus::Lost {
            state.status = PartnerStatus::Lost;
            state.off = 0;
            state.rest_at(state.applied_um);
        }
    }

    /// The next command, um.
    fn next_um(&self, state: &mut PartnerState, input: &PartnerInput) -> f64 {
        let now_um = state.wanted_um;
        let PartnerConfig {
            low_um, high_um, ..
        } = self.config;
        if state.status == PartnerStatus::Lost || (self.config.probe.is_some() && !input.held) {
            return now_um;
        }
        if let Some(probe) = self.config.probe {
            let half_ticks = (probe.half_period_s / self.sample_s).max(1.0);
            // The first half waits: what the bead does alone is seen too.
            let half = (state.probed as f64 / half_ticks) as u64;
            let sign = [0.0, 1.0, -1.0][if half == 0 {
                0
            } else {
                2 - (half % 2) as usize
            }];
            let most_um = self.config.slew_um_per_s * self.config.period_ms * 1e-3;
            let wanted_um = state.base_um + sign * probe.amplitude_um;
            return wanted_um
                .clamp(now_um - most_um, now_um + most_um)
                .clamp(low_um, high_um);
        }
        // Where it would have to stand for the PZT to be at the middle with the same flow.
        let flow_um = input.pzt_um + state.effect_um;
        let target_um = (flow_um - self.config.mid_um) / self.config.gain;
        let usable = input.held && target_um.is_finite();
        let wanted_um = if usable {
            self.approach * (target_um - now_um)
        } else {
            0.0
        };
        let wanted_um = wanted_um.clamp(-self.most_um, self.most_um);
        let move_um = wanted_um.clamp(state.move_um - self.more_um, state.move_um + self.more_um);
        let next_um = (now_um + move_um).clamp(low_um, high_um);
        state.status = if next_um != now_um + move_um {
            PartnerStatus::AtLimit
        } else {
            PartnerStatus::Follows
        };
        next_um
    }

    /// The nearest step of its converter, um: the exact output is then known.
    fn on_step(&self, um: f64) -> f64 {
        let PartnerConfig {
            low_um, step_um, ..
        } = self.config;
        if step_um > 0.0 {
            low_um + ((um - low_um) / step_um).round() * step_um
        } else {
            um
        }
    }

    /// The command whose effect begins to show now, um.
    fn in_force_um(&self, state: &PartnerState) -> f64 {
        let back = self
            .delay_ticks
            .saturating_sub(state.age)
            .div_ceil(self.period_ticks);
        let last = state.commands_um[PENDING - 1];
        state
            .commands_um
            .get(back as usize)
            .copied()
            .unwrap_or(last)
    }
}

#[cfg(test)]
#[path = "partner_tests.rs"]
mod tests;
