//! PI control with set-point weight, back-calculation anti-windup and an optional lead on the proportional path.
//!
//! `u = I + kp Lead(b r - y) + ki Ts/2 (r - y)`, `I += ki Ts (r - y) + (u_limited - u_requested) Ts / Tt`: the integral by
//! Tustin's rule, whose phase is that of the continuous one. The weight b is for jumps of the reference that were not known in advance;
//! motion that the loop feeds forward needs none.
//! Gains: `kp` in um of PZT per um of bead, `ki` in 1/s (um of PZT per um of bead and second).

use crate::error::{BuildError, check};
use crate::law::{ControlLaw, FAR_UM, LawInput, LawOutput};
use crate::tuning::Tuning;
use serde::{Deserialize, Serialize};

/// A lead `(1 + s/wz) / (1 + s/wp)` with `wz < wp`, discretised by Tustin's rule.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Lead {
    /// Zero, Hz.
    pub zero_hz: f64,
    /// Pole, Hz.
    pub pole_hz: f64,
}

impl Lead {
    /// Coefficients of `out = b0 x + w`, `w' = b1 x - a1 out` for a sample time: `(b0, b1, a1)`.
    pub(crate) fn coefficients(&self, sample_time_s: f64) -> (f64, f64, f64) {
        let (wz, wp) = (
            std::f64::consts::TAU * self.zero_hz,
            std::f64::consts::TAU * self.pole_hz,
        );
        let (cz, cp) = (2.0 / (sample_time_s * wz), 2.0 / (sample_time_s * wp));
        (
            (1.0 + cz) / (1.0 + cp),
            (1.0 - cz) / (1.0 + cp),
            (1.0 - cp) / (1.0 + cp),
        )
    }
}

/// Configuration of a PI controller.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pi {
    /// Proportional gain, um of PZT per um of bead.
    pub kp: f64,
    /// Integral gain, 1/s.
    pub ki_per_s: f64,
    /// Weight b of the reference in the proportional path, 0..1.
    pub setpoint_weight: f64,
    /// Time constant of the anti-windup back-calculation, s.
    pub tracking_time_s: f64,
    /// Optional lead on the proportional path.
    pub lead: Option<Lead>,
}

impl Pi {
    /// Set-point weight by default: a 10 um step on Eq. (6) settles to 5 % within 60 ms with less than 15 % overshoot.
    pub const DEFAULT_SETPOINT_WEIGHT: f64 = 0.7;

    /// A PI controller with the default set-point weight and a tracking time of half the integral time.
    pub fn new(kp: f64, ki_per_s: f64) -> Self {
        let tracking_time_s = if ki_per_s > 0.0 {
            0.5 * kp / ki_per_s
        } else {
            1.0
        };
        Self {
            kp,
            ki_per_s,
            setpoint_weight: Self::DEFAULT_SETPOINT_WEIGHT,
            tracking_time_s,
            lead: None,
        }
    }

    /// Checks every value.
    ///
    /// # Errors
    /// [`BuildError::OutOfRange`] naming the key.
    pub fn validate(&self) -> Result<(), BuildError> {
        check("kp", "um/um", self.kp, self.kp.abs() < 1e6, "finite")?;
        check(
            "ki_per_s",
            "1/s",
            self.ki_per_s,
            self.ki_per_s.abs() < 1e9,
            "finite",
        )?;
        let b_ok = (0.0..=1.0).contains(&self.setpoint_weight);
        check("setpoint_weight", "", self.setpoint_weight, b_ok, "0 to 1")?;
        check(
            "tracking_time_s",
            "s",
            self.tracking_time_s,
            self.tracking_time_s > 0.0,
            "positive",
        )?;
        if let Some(lead) = &self.lead {
            check(
                "lead_zero_hz",
                "Hz",
                lead.zero_hz,
                lead.zero_hz > 0.0,
                "positive",
            )?;
            check(
                "lead_pole_hz",
                "Hz",
                lead.pole_hz,
                lead.pole_hz > lead.zero_hz,
                "larger than lead_zero_hz",
            )?;
        }
        Ok(())
    }
}

/// State of a PI controller.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PiState {
    /// Integral part I, um of PZT.
    pub integral_um: f64,
    /// Memory of the lead, um of bead.
    pub lead_um: f64,
    /// Proportional part of this tick, um of PZT.
    pub proportional_um: f64,
}

/// The PI law: coefficients for one sample time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PiLaw {
    config: Pi,
    lead: Option<(f64, f64, f64)>,
    sample_time_s: f64,
    integral_per_tick: f64,
    tracking_per_tick: f64,
}

impl PiLaw {
    /// The law of a configuration.
    ///
    /// # Errors
    /// As [`Pi::validate`].
    pub fn new(config: Pi, sample_time_s: f64) -> Result<Self, BuildError> {
        config.validate()?;
        Ok(Self {
            config,
            lead: config.lead.map(|l| l.coefficients(sample_time_s)),
            sample_time_s,
            integral_per_tick: config.ki_per_s * sample_time_s,
            tracking_per_tick: (sample_time_s / config.tracking_time_s).min(1.0),
        })
    }

    /// The proportional part, um of PZT; advances the lead's memory.
    fn proportional(&self, state: &mut PiState, reference_um: f64, bead_um: f64, input: &LawInput) {
        let (fed_um, tuning) = (input.fed_um, &input.tuning);
        let error = self.config.setpoint_weight * (reference_um - fed_um) - (bead_um - fed_um);
        let shaped = match self.lead_of(tuning) {
            Some((b0, b1, a1)) => {
                let out = b0 * error + state.lead_um;
                state.lead_um = b1 * error - a1 * out;
                out
            }
            None => error,
        };
        state.proportional_um = self.config.kp / tuning.delay * shaped;
    }

    /// Coefficients of the lead for the delay in force: all times of the loop go with it.
    fn lead_of(&self, tuning: &Tuning) -> Option<(f64, f64, f64)> {
        if tuning.delay == 1.0 {
            return self.lead;
        }
        let lead = self.config.lead?;
        let slower = Lead {
            zero_hz: lead.zero_hz / tuning.delay,
            pole_hz: lead.pole_hz / tuning.delay,
        };
        Some(slower.coefficients(self.sample_time_s))
    }

    /// Integral gain per tick for the delay in force.
    fn integral_per_tick(&self, tuning: &Tuning) -> f64 {
        self.integral_per_tick / (tuning.delay * tuning.delay)
    }

    /// Makes the next proportional + integral output equal to `command_um` (bumpless return to control).
    pub(crate) fn track(&self, state: &mut PiState, command_um: f64) {
        state.integral_um = command_um - state.proportional_um;
        Self::sound(state, command_um);
    }

    /// A state that nothing can have is put at rest at the command in force.
    fn sound(state: &mut PiState, command_um: f64) {
        if !(state.integral_um.abs() < FAR_UM && state.lead_um.abs() < FAR_UM) {
            *state = PiState {
                integral_um: command_um,
                ..PiState::default()
            };
        }
    }
}

impl ControlLaw for PiLaw {
    type State = PiState;

    fn start(&self, command_um: f64) -> PiState {
        PiState {
            integral_um: command_um,
            ..PiState::default()
        }
    }

    fn step(&self, state: &mut PiState, input: &LawInput) -> LawOutput {
        self.proportional(state, input.reference_um, input.bead_um, input);
        let growth_um = if input.hold() {
            0.0
        } else {
            0.5 * self.integral_per_tick(&input.tuning) * (input.reference_um - input.bead_um)
        };
        LawOutput::wish(state.proportional_um + (state.integral_um + growth_um))
    }

    /// Integrates and back-calculates.
    fn applied(&self, state: &mut PiState, input: &LawInput, wish_um: f64, applied_um: f64) {
        let growth = if input.hold() {
            0.0
        } else {
            self.integral_per_tick(&input.tuning) * (input.reference_um - input.bead_um)
        };
        state.integral_um +=
            growth + (applied_um - wish_um) * self.tracking_per_tick / input.tuning.delay;
        Self::sound(state, applied_um);
    }

    /// While something else decides, PI follows as if the reference were where the bead is: the way from there to the
    /// reference is then a step like any other once PI takes over, not an offset for the integrator alone.
    fn follow(&self, state: &mut PiState, input: &LawInput, command_um: f64) {
        self.proportional(state, input.bead_um, input.bead_um, input);
        self.track(state, command_um);
    }

    fn rescale(&self, state: &mut PiState, ratio: f64) {
        state.integral_um *= ratio;
    }

    fn shift(&self, state: &mut PiState, by_um: f64) {
        state.integral_um += by_um;
    }

    fn columns(&self) -> &'static [&'static str] {
        if self.lead.is_some() {
            &["pi_integral_um", "pi_lead_um"]
        } else {
            &["pi_integral_um"]
        }
    }

    fn record(&self, state: &PiState, out: &mut [f32]) {
        for (out, value) in out.iter_mut().zip([state.integral_um, state.lead_um]) {
            *out = value as f32;
        }
    }
}
