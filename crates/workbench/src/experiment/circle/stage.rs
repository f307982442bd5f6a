//! One step of the circle: a controller designed on a model, its margins there and on the truth, and a run with it.

use super::margins::{AMPLITUDES_UM, LoopMargins, Response, margins};
use crate::experiment::on_rig::OnRig;
use cellpos_control::LinearLaw;
use cellpos_control::design::DesignPlant;
use cellpos_plant::Model;
use cellpos_plant::effects::{self, Action};
use cellpos_runtime::{EndRule, Event, Life, RunSink, Statistics, TickRecord, Timing};
use cellpos_session::setup::{self, Prepared, ReferenceSpec};
use cellpos_session::{EndKind, Failure, Rig, RigFile};
use serde::Serialize;

/// What is tracked.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Motion {
    /// Half of peak to peak, um.
    pub amplitude_um: f64,
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Duration of the hold, and of the sine, s.
    pub duration_s: f64,
}

/// What a run gave.
#[derive(Debug, Clone, Serialize)]
pub struct Tracked {
    /// State at the end, in words.
    pub state: &'static str,
    /// How it ended, in sentences.
    pub ended: String,
    /// RMS of measured position less reference after 2 s, nm.
    pub rms_measured_nm: Option<f64>,
    /// RMS of true position less reference after 2 s, nm; emulated rigs only.
    pub rms_true_nm: Option<f64>,
    /// Mean squares of the error over tenths of a second, or periods of a slower sine, nm^2 (of the true error if known).
    #[serde(skip)]
    pub pieces_nm2: Vec<f64>,
    /// The last half second: time, s, and error (true error if known), um.
    #[serde(skip)]
    pub trace: (Vec<f64>, Vec<f64>),
}

/// One step.
#[derive(Debug, Clone, Serialize)]
pub struct Stage {
    /// Which.
    pub name: &'static str,
    /// Ids of the model's effects.
    pub effects: Vec<&'static str>,
    /// Delay from the middle of an exposure to its tick in the loop's set-up, ms.
    pub delay_ms: f64,
    /// Proportional gain of a PI, um of PZT per um of bead.
    pub kp_um_per_um: Option<f64>,
    /// Integral gain of a PI, 1/s.
    pub ki_per_s: Option<f64>,
    /// Amplitude of the motion to which the margins apply, um.
    pub margins_at_um: f64,
    /// Margins on the model that it was designed on.
    pub predicted: Option<LoopMargins>,
    /// Margins on the truth; emulated rigs only.
    #[serde(rename = "true")]
    pub real: Option<LoopMargins>,
    /// Holding still.
    pub hold: Option<Tracked>,
    /// Following the sine.
    pub sine: Option<Tracked>,
    /// The reason why no controller could be designed on this model.
    pub problem: Option<String>,
    /// Response of the model.
    #[serde(skip)]
    pub response: Response,
}

impl Stage {
    /// Whether both runs ended as asked.
    pub fn ran(&self) -> bool {
        let running = Life::Running.name();
        let is_running = |t: &Option<Tracked>| t.as_ref().is_some_and(|t| t.state == running);
        is_running(&self.hold) && is_running(&self.sine)
    }
}

/// The model with this delay from the middle of an exposure to the tick as its only delay. The delay includes that of the average
/// over the exposure. Its roll-off (4 % at 300 Hz for half a millisecond) is above a loop's band.
pub fn with_delay(mut model: Model, delay_s: f64) -> Model {
    model
        .effects
        .retain(|e| !matches!(e.id(), "time-delay" | "exposure-averaging"));
    model.with_effect(effects::time_delay(delay_s))
}

/// The linear model for the design of a controller. A gain replaces each effect without a transfer function. It is the largest
/// gain between the amplitude of holding and ten times that, so that a dead zone does not raise the controller's gain.
fn designable(model: &Model, sample_s: f64) -> Result<Model, Failure> {
    /// Frequency of the comparison, Hz: about the crossover of a loop with these delays.
    const AT_HZ: f64 = 20.0;
    let mut linear = model.clone();
    linear.effects.retain(|e| match e.act() {
        // One pole is one pole, wherever it sits.
        Action::Linear(zpk) => zpk.zeros.is_empty() && zpk.poles.len() < 2,
        Action::Delay(_) | Action::Exposure(_) => true,
        _ => e.id() == "flow-drift",
    });
    if linear.effects.len() == model.effects.len() {
        return Ok(linear);
    }
    let gain = |m: &Model, amplitude_um: f64| -> Result<f64, Failure> {
        let response = Response::of(m, amplitude_um, sample_s)?;
        let nearest = (0..response.hz.len()).min_by(|&i, &j| {
            let off = |k: usize| (response.hz[k] / AT_HZ).ln().abs();
            off(i).total_cmp(&off(j))
        });
        Ok(nearest.map_or(f64::NAN, |i| response.value[i].norm()))
    };
    let mut factor = 0.0_f64;
    for amplitude_um in AMPLITUDES_UM {
        factor = factor.max(gain(model, amplitude_um)? / gain(&linear, amplitude_um)?);
    }
    if factor.is_finite() {
        // The range of gain that a loop must tolerate anyway.
        let factor = factor.clamp(0.5, 2.0);
        linear.plant = linear.plant.scaled(factor).map_err(Failure::input)?;
    }
    Ok(linear)
}

/// Designs a controller on `model` (which contains its delay), computes margins on it and on the truth, and runs the rig.
pub fn run(
    name: &'static str,
    model: Model,
    controller: &str,
    rig: &OnRig,
    truth: Option<&Model>,
    motion: Motion,
) -> Result<Stage, Failure> {
    let sample_s = rig.file.timing.period_us * 1e-6;
    let delay_ms = model
        .effect("time-delay")
        .and_then(|e| e.get("delay_s"))
        .map_or(rig.file.timing.camera_delay_ms, |delay_s| delay_s * 1e3);
    let timing = Timing {
        camera_delay_ms: delay_ms,
        ..rig.file.timing
    };
    let response = Response::of(&model, AMPLITUDES_UM[0], sample_s)?;
    let mut stage = Stage {
        name,
        effects: model.ordered_effects().iter().map(|e| e.id()).collect(),
        delay_ms,
        kp_um_per_um: None,
        ki_per_s: None,
        margins_at_um: AMPLITUDES_UM[0],
        predicted: None,
        real: None,
        hold: None,
        sine: None,
        problem: None,
        response,
    };
    // There may be no controller for a fitted model: that is a finding, not a reason to stop.
    let (prepared, law) = match designed(&model, controller, &timing, rig.file.frame_s(), sample_s)
    {
        Ok(designed) => designed,
        Err(Failure::BadInput(why)) => {
            stage.problem = Some(why.to_string());
            return Ok(stage);
        }
        Err(failure) => return Err(failure),
    };
    if matches!(law, LinearLaw::Pi { .. }) {
        stage.kp_um_per_um = Some(prepared.controller.pi.kp_um_per_um);
        stage.ki_per_s = Some(prepared.controller.pi.ki_per_s);
    }
    for amplitude_um in AMPLITUDES_UM {
        let at = |model: &Model| weighed(model, amplitude_um, &law, sample_s);
        stage.margins_at_um = amplitude_um;
        stage.predicted = at(&model)?;
        stage.real = truth.map(at).transpose()?.flatten();
        // A dead zone has no crossover at motion that it swallows.
        if stage.predicted.is_some() && (truth.is_none() || stage.real.is_some()) {
            break;
        }
    }
    let hold = ReferenceSpec::Hold { position_um: 0.0 };
    let sine = ReferenceSpec::Sine {
        centre_um: 0.0,
        amplitude_um: motion.amplitude_um,
        frequency_hz: motion.frequency_hz,
        fade_s: cellpos_session::cyclic::FADE_S,
    };
    let track = |reference| tracked(prepared.clone(), rig, timing, reference, motion.duration_s);
    stage.hold = Some(track(hold)?);
    stage.sine = Some(track(sine)?);
    Ok(stage)
}

/// Margins of a law on a model, by its response.
fn weighed(
    model: &Model,
    amplitude_um: f64,
    law: &LinearLaw,
    sample_s: f64,
) -> Result<Option<LoopMargins>, Failure> {
    let linear = designable(model, sample_s)?;
    let plant = DesignPlant::from_model(&linear, None, sample_s).map_err(Failure::input)?;
    let exact = cellpos_control::design::margins(&plant, law).map_err(Failure::input)?;
    let response = Response::of(model, amplitude_um, sample_s)?;
    Ok(margins(&response, law, sample_s, exact.stable))
}

fn designed(
    model: &Model,
    controller: &str,
    timing: &Timing,
    frame_s: f64,
    sample_s: f64,
) -> Result<(Prepared, LinearLaw), Failure> {
    let linear = designable(model, sample_s)?;
    let prepared = Prepared {
        controller: setup::controller(controller, &linear, timing, frame_s)?,
        model: linear,
    };
    let delay_s = prepared.controller.delay_ms * 1e-3;
    let plant = DesignPlant::from_model(&prepared.model, Some(delay_s), sample_s)
        .map_err(Failure::input)?;
    let loop_model = plant.loop_model().map_err(Failure::input)?;
    // The loop itself refuses a controller that only seems valid.
    prepared
        .controller
        .loop_config(&prepared.model)
        .map_err(Failure::input)?;
    let law = prepared
        .controller
        .controller_config()
        .linear(&prepared.controller.estimator, &loop_model)
        .map_err(Failure::input)?;
    Ok((prepared, law))
}

/// Keeps the errors.
struct Errors(Vec<(f64, f64)>);

impl RunSink for Errors {
    fn tick(&mut self, t: &TickRecord) {
        let position_um = if t.true_um.is_finite() {
            t.true_um
        } else {
            t.estimate_um
        };
        self.0
            .push((t.time_ns as f64 * 1e-9, position_um - t.target_um));
    }
    fn event(&mut self, _: &Event) {}
    fn progress(&mut self, _: &Statistics) {}
}

/// Mean squares of errors after two seconds, nm^2, over pieces of this length.
fn pieces_nm2(errors: &[(f64, f64)], piece_s: f64, period_s: f64) -> Vec<f64> {
    let from_s = errors.first().map_or(0.0, |first| first.0) + 2.0;
    let counted: Vec<f64> = (errors.iter().filter(|(time_s, _)| *time_s >= from_s))
        .map(|(_, um)| 1e6 * um * um)
        .collect();
    let rows = ((piece_s / period_s).round() as usize).max(1);
    (counted.chunks_exact(rows))
        .map(|piece| piece.iter().sum::<f64>() / rows as f64)
        .collect()
}

fn tracked(
    mut prepared: Prepared,
    on: &OnRig,
    timing: Timing,
    reference: ReferenceSpec,
    duration_s: f64,
) -> Result<Tracked, Failure> {
    let piece_s = match reference {
        ReferenceSpec::Sine { frequency_hz, .. } => (1.0 / frequency_hz).max(0.1),
        _ => 0.1,
    };
    let file = RigFile {
        timing,
        ..on.file.clone()
    };
    let mut rig = Rig::open(file, on.options())?;
    rig.fit(&mut prepared);
    let setup = rig.set_up(prepared, reference)?;
    let end = EndRule {
        ticks: Some((duration_s * 1e6 / timing.period_us).round() as u64),
        ..EndRule::default()
    };
    let core = setup.core()?;
    let armed = rig.arm(&setup, core, Errors(Vec::new()), end)?;
    let finished = armed.start()?.wait()?;
    if finished.ended.kind == EndKind::Operator {
        return Err(finished
            .ended
            .failure("the finished part is in the run folder"));
    }
    let errors = finished.sink.0;
    let last = errors
        .len()
        .saturating_sub((5e5 / timing.period_us) as usize);
    Ok(Tracked {
        state: finished.summary.state.name(),
        ended: finished.ended.to_string(),
        rms_measured_nm: finished.summary.rms_measured_nm,
        rms_true_nm: finished.summary.rms_true_nm,
        pieces_nm2: pieces_nm2(&errors, piece_s, timing.period_us * 1e-6),
        trace: errors[last..].iter().copied().unzip(),
    })
}
