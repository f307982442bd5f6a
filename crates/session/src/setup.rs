//! Everything that determines the commands of a run. The run folder holds it, and a replay reads it back.

use crate::Failure;
use crate::cyclic::LearnSpec;
use crate::exciting::Exciting;
pub use crate::prepared::Prepared;
use cellpos_control::design::{
    DesignPlant, DesignRequest, PiSearch, Requested, default_lead, design, margins,
    predicted_density_um,
};
use cellpos_control::{
    Controller, ControllerConfig, ControllerFile, ControllerKind, Limits, Lqg, Mpc, Partner,
    PartnerConfig, Profile, Shape,
};
use cellpos_ident::experiment::Turn;
use cellpos_plant::Model;
use cellpos_runtime::{
    ArmingConfig, Core, Learners, ReferenceGenerator, ReferenceInput, ReferenceOutput, Steered,
    Timing,
};
use cellpos_script::{Follower, Plan, Script};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

/// The bead's reference.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum ReferenceSpec {
    /// Go to a position and hold it.
    Hold {
        /// Position, um.
        position_um: f64,
    },
    /// A sine about a position.
    Sine {
        /// Position in the middle, um.
        centre_um: f64,
        /// Half of peak to peak, um.
        amplitude_um: f64,
        /// Frequency, Hz.
        frequency_hz: f64,
        /// Time over which it comes in, s.
        fade_s: f64,
    },
    /// Follow a script.
    Script {
        /// Its file, for messages.
        file: String,
        /// Its text.
        text: String,
        /// Time of the plan at which the session begins, s.
        from_s: f64,
        /// Time that the script ran in the sessions before, s; left out: as long as the plan says.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        ran_s: Option<f64>,
        /// Length of the cell at the start of the run, um, for a resumed session.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        first_length_um: Option<f64>,
        /// Texts of the waveforms that it names.
        #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
        waveforms: BTreeMap<String, String>,
    },
    /// Hold at 0 um with an excitation of the command on top.
    Excitation {
        /// The segments planned.
        plan: cellpos_ident::experiment::Plan,
        /// The segments to play, in order.
        todo: Vec<Turn>,
    },
}

/// The reference generator of a loop: a position, or a script.
#[derive(Debug, Clone)]
pub enum AnyReference {
    /// A position that the operator may move.
    Hold(Steered),
    /// A function of time.
    Profile(Profile),
    /// A script.
    Script(Box<Follower>),
    /// An excitation of the command.
    Exciting(Box<Exciting>),
}

impl ReferenceGenerator for AnyReference {
    fn step(&mut self, input: &ReferenceInput, preview_um: &mut [f64]) -> ReferenceOutput {
        match self {
            Self::Hold(steered) => steered.step(input, preview_um),
            Self::Profile(profile) => ReferenceGenerator::step(profile, input, preview_um),
            Self::Script(follower) => follower.step(input, preview_um),
            Self::Exciting(exciting) => exciting.step(input, preview_um),
        }
    }

    fn excitation_um(&self) -> f64 {
        match self {
            Self::Exciting(exciting) => exciting.excitation_um(),
            Self::Hold(_) | Self::Profile(_) | Self::Script(_) => 0.0,
        }
    }

    fn finished(&self) -> bool {
        match self {
            Self::Hold(_) | Self::Profile(_) => false,
            Self::Script(follower) => follower.finished(),
            Self::Exciting(exciting) => exciting.finished(),
        }
    }
}

impl ReferenceSpec {
    /// The script, if it is one, read and laid out.
    pub fn script(&self) -> Result<Option<(Script, Plan)>, Failure> {
        let Self::Script {
            file,
            text,
            waveforms,
            ..
        } = self
        else {
            return Ok(None);
        };
        let load = |name: &str| {
            waveforms
                .get(name)
                .cloned()
                .ok_or_else(|| "is not kept with the run".to_string())
        };
        let script = Script::parse_with(text, file, &load).map_err(Failure::input)?;
        let plan = Plan::new(&script).map_err(Failure::input)?;
        Ok(Some((script, plan)))
    }

    fn generator(&self, timing: &Timing) -> Result<AnyReference, Failure> {
        let delay_ticks = (timing.camera_delay_ms * 1e3 / timing.period_us).round() as usize;
        Ok(match self {
            Self::Hold { position_um } => AnyReference::Hold(Steered::new(*position_um)),
            Self::Sine {
                centre_um,
                amplitude_um,
                frequency_hz,
                fade_s,
            } => AnyReference::Profile(Profile::Wave {
                shape: Shape::Sine,
                centre_um: *centre_um,
                amplitude_um: *amplitude_um,
                frequency_hz: *frequency_hz,
                fade_s: *fade_s,
            }),
            Self::Script {
                from_s,
                ran_s,
                first_length_um,
                ..
            } => {
                let plan = self.script()?.map(|(_, plan)| Arc::new(plan));
                let plan = plan.unwrap_or_else(|| unreachable!("a script has a plan"));
                let follower = Follower::new(plan, *from_s, delay_ticks)
                    .with_elapsed(*ran_s)
                    .with_first_length(*first_length_um);
                AnyReference::Script(Box::new(follower))
            }
            Self::Excitation { plan, todo } => {
                AnyReference::Exciting(Box::new(Exciting::new(plan, todo)))
            }
        })
    }
}

/// A loop before it is built.
#[derive(Debug, Clone, PartialEq)]
pub struct Setup {
    /// The plant that the controller assumes.
    pub model: Model,
    /// Controller, estimator and limits.
    pub controller: ControllerFile,
    /// The rest.
    pub config: SetupConfig,
}

/// The part of a [`Setup`] without a separate file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SetupConfig {
    /// PZT displacement at the start, um.
    pub displacement_um: f64,
    /// First estimate of neutral, um.
    pub neutral_um: f64,
    /// The bead's reference.
    pub reference: ReferenceSpec,
    /// Times and counts of the loop.
    pub timing: Timing,
    /// Silence after which the board is asked to hold zero flow, ms.
    #[serde(default = "default_watchdog_ms")]
    pub watchdog_ms: u16,
    /// The check before the loop is closed.
    pub arming: ArmingConfig,
    /// The slow partner of the PZT, if there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub partner: Option<PartnerConfig>,
    /// Learning over cycles, if it is on.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub learn: Option<LearnSpec>,
    /// Learning on the periodic motions of a script.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub motions: Vec<MotionSpec>,
}

/// Of a record without the key: the board's own.
fn default_watchdog_ms() -> u16 {
    20
}

/// The predicted amplitude density of the measured error, one-sided, in two parts whose squares add.
#[derive(Debug, Clone, PartialEq)]
pub struct Predicted {
    /// From Brownian motion, nm/sqrt(Hz).
    pub walk_nm: Vec<f64>,
    /// From localisation noise, per nm RMS, 1/sqrt(Hz).
    pub per_noise: Vec<f64>,
}

impl Predicted {
    /// Both, nm/sqrt(Hz), with this localisation noise, nm RMS.
    pub fn with_noise_nm(&self, noise_nm: f64) -> Vec<f64> {
        let parts = self.walk_nm.iter().zip(&self.per_noise);
        parts
            .map(|(walk, fix)| walk.hypot(fix * noise_nm))
            .collect()
    }
}

/// Learning on a periodic motion of a script.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MotionSpec {
    /// Number of the motion in the plan.
    pub motion: u16,
    /// The motion in words.
    pub name: String,
    /// How it is learned.
    pub learn: LearnSpec,
}

impl Setup {
    /// Builds the loop with the reference of the set-up, and the learning on it.
    ///
    /// # Errors
    /// An invalid value; the error names it.
    pub fn core(&self) -> Result<Core<AnyReference>, Failure> {
        let core = self.core_with(self.law()?)?;
        let sample_s = self.config.timing.period_us * 1e-6;
        if let Some(learn) = &self.config.learn {
            return Ok(core.with_learning(learn.learning(sample_s)?));
        }
        let mut learners = Vec::new();
        for spec in &self.config.motions {
            let number = usize::from(spec.motion);
            learners.resize(learners.len().max(number + 1), None);
            learners[number] = Some(spec.learn.learning(sample_s)?);
        }
        Ok(core.with_learners(Learners::new(learners)))
    }

    /// The control law of the set-up.
    ///
    /// # Errors
    /// A controller that does not fit the model.
    pub fn law(&self) -> Result<Controller, Failure> {
        let config = self
            .controller
            .loop_config(&self.model)
            .map_err(Failure::input)?;
        Controller::new(config).map_err(Failure::input)
    }

    /// Builds the loop with the reference of the set-up and another control law ([`Controller::with_law`]), without
    /// learning.
    ///
    /// # Errors
    /// An invalid value; the error names it.
    pub fn core_with(&self, law: Controller) -> Result<Core<AnyReference>, Failure> {
        let sample_s = self.config.timing.period_us * 1e-6;
        let plant =
            DesignPlant::from_model(&self.model, Some(self.controller.delay_ms * 1e-3), sample_s)
                .map_err(Failure::input)?;
        let partner = self
            .config
            .partner
            .map(|config| Partner::new(config, &law.settings().limits, sample_s));
        let partner = partner.transpose().map_err(Failure::input)?;
        let core = Core::with_controller(
            law,
            self.config.reference.generator(&self.config.timing)?,
            self.config.timing,
            self.config.arming,
            &plant.plant,
            [self.config.displacement_um, self.config.neutral_um],
        )
        .map_err(Failure::input)?
        .with_watchdog_ms(self.config.watchdog_ms);
        Ok(match partner {
            Some(partner) => core.with_partner(partner),
            None => core,
        })
    }

    /// The spectrum that the loop's linear model predicts for the measured error of a hold, at each frequency, Hz. `None`: nothing
    /// diffuses, the law has no linear form, or the loop is unstable on the model.
    pub fn predicted_density(&self, diffusion_um2_per_s: f64, hz: &[f64]) -> Option<Predicted> {
        let sample_s = self.config.timing.period_us * 1e-6;
        let delay_s = self.controller.delay_ms * 1e-3;
        let mut plant = DesignPlant::from_model(&self.model, Some(delay_s), sample_s).ok()?;
        let config = self.controller.loop_config(&self.model).ok()?;
        let law = (config.controller).linear(&config.estimator, &config.model);
        let law = law.ok()?;
        if !margins(&plant, &law).is_ok_and(|margins| margins.stable) {
            return None;
        }
        let mut of = |diffusion: f64, fix: f64| {
            (plant.diffusion_um2_per_s, plant.fix_noise_um) = (diffusion, fix);
            predicted_density_um(&plant, &law, hz).ok()
        };
        Some(Predicted {
            walk_nm: of(Some(diffusion_um2_per_s).filter(|d| *d > 0.0)?, 0.0)?
                .into_iter()
                .map(|um| um * 1e3)
                .collect(),
            per_noise: of(0.0, 1.0)?,
        })
    }
}

/// The loop delay of a rig, s. It is the sum of the camera path (`camera_delay_ms`: from the middle of an exposure to the tick that uses
/// it), the path of a command to the bead, measured with the model, and half a period of hold. This is the only definition; controllers
/// are designed for it.
pub fn loop_delay_s(model: &Model, timing: &Timing) -> f64 {
    timing.camera_delay_ms * 1e-3 + command_delay_s(model) + 0.5e-6 * timing.period_us
}

/// Delay from a command to its effect on the bead, s: line, board and amplifier. 0 if the model does not state it.
pub(crate) fn command_delay_s(model: &Model) -> f64 {
    let beyond_s = |delay_s: f64| Some(delay_s - model.frame_age_s?);
    model
        .camera_delay_s
        .and_then(beyond_s)
        .unwrap_or(0.0)
        .max(0.0)
}

/// Whether two delays differ so much that a warning is given. All comparisons of delays ask this, so that no advice contradicts another.
pub(crate) fn delays_differ(one_ms: f64, other_ms: f64, timing: &Timing) -> bool {
    /// As a fraction of the period: half a period costs a controller some degrees of margin.
    const WORTH_SAYING: f64 = 0.3;
    (one_ms - other_ms).abs() > WORTH_SAYING * timing.period_us * 1e-3
}

/// Remedy if the age of frames at their ticks differs from the rig file. `found_ms` comes from the frames' stamps: from the middle of an
/// exposure to the tick that used it. Every measurement of this key has this definition.
pub fn camera_delay_advice(found_ms: f64, timing: &Timing) -> Option<String> {
    let configured_ms = timing.camera_delay_ms;
    delays_differ(found_ms, configured_ms, timing).then(|| {
        format!(
            "frames are {found_ms:.2} ms old when they are used (middle of the exposure to the tick), rig.toml says {configured_ms} ms: \
             write [timing] camera_delay_ms = {found_ms:.2} and design the controller again"
        )
    })
}

/// The warning if a model was measured with frames of another age than the rig file states or, if the model does not state that age, with
/// another delay.
pub fn model_delay_warning(model: &Model, timing: &Timing) -> Option<String> {
    let (measured_ms, rig_ms) = (model.camera_delay_s? * 1e3, timing.camera_delay_ms);
    if let Some(age_s) = model.frame_age_s {
        return camera_delay_advice(age_s * 1e3, timing);
    }
    delays_differ(measured_ms, rig_ms, timing).then(|| {
        format!(
            "the model has a delay of {measured_ms:.2} ms from a command to the tick that uses its picture, rig.toml says camera_delay_ms = {rig_ms}: run cellpos identify again, which separates the two parts of that delay"
        )
    })
}

/// The default law of a run. It holds 15 % closer than PI and follows a script's fast motions. It keeps the bead through steps of the
/// flow as well as MPC, with less time per tick.
pub const DEFAULT_LAW: &str = "lqg";

/// A controller by name (`pi`, `lead`: gains found for the model and the delay; `lqg`, `mpc`: the weights of
/// the path) or from a controller.toml. The camera has a frame each `frame_s`, s.
pub fn controller(
    name: &str,
    model: &Model,
    timing: &Timing,
    frame_s: f64,
) -> Result<ControllerFile, Failure> {
    let sample_s = timing.period_us * 1e-6;
    let loop_delay_s = loop_delay_s(model, timing);
    let Some(kind) = ControllerKind::from_name(name) else {
        if !name.ends_with(".toml") {
            return Err(Failure::bad_input(
                format!("--controller {name}: not a controller"),
                "write pi, lead, lqg, mpc, or the path of a controller.toml",
            ));
        }
        let file = ControllerFile::load(Path::new(name)).map_err(Failure::input)?;
        if delays_differ(file.delay_ms, loop_delay_s * 1e3, timing) {
            return Err(Failure::bad_input(
                format!(
                    "{name}: it is for a loop delay of {} ms, but the rig has {} ms",
                    file.delay_ms,
                    loop_delay_s * 1e3
                ),
                format!(
                    "design it again: cellpos design --delay {}ms",
                    loop_delay_s * 1e3
                ),
            ));
        }
        return Ok(file);
    };
    // The PI gains found below serve LQG and MPC as the fallback.
    let lead = (kind == ControllerKind::Lead).then(|| default_lead(loop_delay_s));
    let plant =
        DesignPlant::from_model(model, Some(loop_delay_s), sample_s).map_err(Failure::input)?;
    let request = DesignRequest {
        plant,
        controller: Requested::SearchPi(PiSearch {
            lead,
            ..PiSearch::default()
        }),
        setpoint_weight: None,
        command_limits: Limits::default(),
        estimator: None,
        limits: Default::default(),
    };
    let report = design(&request).map_err(Failure::input)?;
    let ControllerConfig::Pi(pi) = report.controller else {
        unreachable!("a search for PI gains gives PI gains")
    };
    let mut file = ControllerFile::from_pi(pi, loop_delay_s);
    file.controller = kind;
    file.lqg = Lqg::for_path(&request.plant, frame_s);
    file.mpc = Mpc::for_path(&request.plant, frame_s);
    file.sample_time_ms = sample_s * 1e3;
    if let Some(config) = &report.config {
        file.estimator = config.estimator;
    }
    file.estimator.adapt = kind.adapts();
    Ok(file)
}

/// The tighter of two sets of limits; park as in the first.
pub fn within(limits: Limits, other: [f64; 3]) -> Limits {
    let [low_um, high_um, slew_um_per_s] = other;
    let low_um = limits.low_um.max(low_um);
    let high_um = limits.high_um.min(high_um);
    Limits {
        low_um,
        high_um,
        slew_um_per_s: limits.slew_um_per_s.min(slew_um_per_s),
        park_um: limits
            .park_um
            .clamp(low_um.min(high_um), high_um.max(low_um)),
    }
}
