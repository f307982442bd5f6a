//! Step and disturbance figures, from the running loop itself (estimator, controller, limits) without noise.

use crate::controller::{Controller, LoopConfig};
use crate::design::plant::DesignPlant;
use crate::error::BuildError;
use crate::loop_io::LoopInput;
use crate::reference::Reference;
use crate::simulation::{RigConfig, SimulatedRig};
use cellpos_plant::{DiscretePlant, PlantError, Seconds};
use thiserror::Error;

/// Why a simulation cannot be set up.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum SetUpError {
    /// The plant.
    #[error(transparent)]
    Plant(#[from] PlantError),
    /// The loop.
    #[error(transparent)]
    Loop(#[from] BuildError),
}

/// Figures of a reference step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepFigures {
    /// Size of the step, um.
    pub size_um: f64,
    /// From 10 % to 90 %, s.
    pub rise_s: f64,
    /// Largest excess, percent of the step.
    pub overshoot_percent: f64,
    /// After this the error stays below 5 % of the step, s; infinite if it does not settle.
    pub settling_5_percent_s: f64,
    /// After this the error stays below 2 % of the step, s; infinite if it does not settle.
    pub settling_2_percent_s: f64,
    /// Largest command change per tick, um.
    pub largest_move_um: f64,
}

/// Figures of a sudden flow drift while holding.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DisturbanceFigures {
    /// Drift that sets in, um/s.
    pub drift_um_per_s: f64,
    /// Largest error, um.
    pub peak_um: f64,
    /// After this the error stays below 10 % of its peak, s; infinite if it does not.
    pub recovery_s: f64,
    /// Error at the end of the simulation (4 s), um.
    pub steady_error_um: f64,
}

const SETTLE_TICKS: usize = 1000;

fn rig(plant: &DesignPlant) -> Result<SimulatedRig, PlantError> {
    SimulatedRig::new(RigConfig {
        plant: plant.plant.clone(),
        sample_time_s: plant.sample_time_s,
        delay_s: plant.delay_s,
        neutral_um: plant.neutral_um,
        diffusion_um2_per_s: 0.0,
        fix_noise_um: 0.0,
        seed: 0,
    })
}

/// A noise-free run.
pub(crate) struct NoiseFree {
    /// True position at each tick, um.
    pub(crate) position_um: Vec<f64>,
    /// Command from each tick on, um.
    command_um: Vec<f64>,
    /// Largest command change per tick, um.
    largest_move_um: f64,
}

/// Follows `reference(k)` at each tick, with a drift from `SETTLE_TICKS` on.
pub(crate) fn noise_free(
    plant: &DesignPlant,
    config: &LoopConfig,
    ticks: usize,
    drift_um_per_s: f64,
    reference: impl Fn(usize) -> f64,
) -> Result<NoiseFree, SetUpError> {
    let mut controller = Controller::new(*config)?;
    let mut rig = rig(plant)?;
    controller.start(plant.neutral_um, plant.neutral_um);
    let mut preview = vec![0.0; controller.preview_len()];
    let mut last = controller.previous_command_um();
    let mut run = NoiseFree {
        position_um: Vec::with_capacity(ticks),
        command_um: Vec::with_capacity(ticks),
        largest_move_um: 0.0,
    };
    for k in 0..SETTLE_TICKS + ticks {
        if k == SETTLE_TICKS {
            rig.drift_um_per_s = drift_um_per_s;
        }
        let tick = k.saturating_sub(SETTLE_TICKS);
        let active = k >= SETTLE_TICKS;
        let at = |t: usize| if active { reference(t) } else { 0.0 };
        for (ahead, slot) in preview.iter_mut().enumerate() {
            *slot = at(tick + ahead + 1);
        }
        if active {
            run.position_um.push(rig.true_um());
        }
        let input = LoopInput {
            measurement: Some(rig.measure()),
            reference_um: at(tick),
            preview_um: &preview,
            ..LoopInput::default()
        };
        let out = controller.step(&input);
        if active {
            run.command_um.push(out.command_um);
            run.largest_move_um = run.largest_move_um.max((out.command_um - last).abs());
        }
        last = out.command_um;
        rig.advance(out.command_um);
    }
    Ok(run)
}

fn settled_after(errors: impl Iterator<Item = f64>, band: f64, sample_time_s: f64) -> f64 {
    let (mut count, mut last_outside) = (0usize, None);
    for (k, e) in errors.enumerate() {
        count = k + 1;
        if e.abs() > band || !e.is_finite() {
            last_outside = Some(k);
        }
    }
    match last_outside {
        None => 0.0,
        Some(k) if k + 1 >= count => f64::INFINITY,
        Some(k) => (k + 1) as f64 * sample_time_s,
    }
}

/// Response to a step of the reference, noise-free, through the loop's limits. The reference steps unannounced.
///
/// # Errors
/// A plant or a loop that cannot be built.
pub fn step_figures(
    plant: &DesignPlant,
    config: &LoopConfig,
    size_um: f64,
) -> Result<StepFigures, SetUpError> {
    let run = noise_free(plant, config, 2000, 0.0, |_| size_um)?;
    let (y, ts) = (run.position_um, plant.sample_time_s);
    let first = |level: f64| {
        y.iter()
            .position(|&p| p / size_um >= level)
            .map_or(f64::INFINITY, |k| k as f64 * ts)
    };
    let highest = y
        .iter()
        .map(|p| p / size_um)
        .fold(f64::NEG_INFINITY, f64::max);
    let settled =
        |part: f64| settled_after(y.iter().map(|p| p - size_um), part * size_um.abs(), ts);
    Ok(StepFigures {
        size_um,
        rise_s: first(0.9) - first(0.1),
        overshoot_percent: 100.0 * (highest - 1.0).max(0.0),
        settling_5_percent_s: settled(0.05),
        settling_2_percent_s: settled(0.02),
        largest_move_um: run.largest_move_um,
    })
}

/// Figures of a periodic motion in full swing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CycleFigures {
    /// Half of peak to peak of the reference, um.
    pub amplitude_um: f64,
    /// RMS error, um.
    pub rms_um: f64,
    /// Largest command change per tick, um.
    pub largest_move_um: f64,
}

/// Error along a periodic reference at and between ticks, noise-free, through the loop's limits. After `from_s` the reference is in full swing for a
/// second or three periods before the error of a second or three periods more is taken.
///
/// # Errors
/// A plant or a loop that cannot be built.
pub fn cycle_figures(
    plant: &DesignPlant,
    config: &LoopConfig,
    reference: &dyn Reference,
    from_s: f64,
    frequency_hz: f64,
) -> Result<CycleFigures, SetUpError> {
    // A motion of minutes is followed by any law; so much of it is simulated.
    const LONGEST_S: f64 = 20.0;
    let ts = plant.sample_time_s;
    let span_s = (3.0 / frequency_hz).clamp(1.0, LONGEST_S);
    let ticks = |s: f64| (s / ts).round() as usize;
    let wish_um = |k: f64| reference.at_um(k * ts);
    let all = ticks(from_s + 2.0 * span_s);
    let run = noise_free(plant, config, all, 0.0, |k| wish_um(k as f64))?;
    // A command that is held moves the bead between ticks as it likes: positions half a tick before each.
    let between = DiscretePlant::new(&plant.plant, Seconds(ts), Seconds(0.5 * ts))?;
    let mut state = between.state(0.0);
    let half_before = run.command_um.iter().map(|um| {
        let before_um = between.output_um(&state);
        between.step(&mut state, um - plant.neutral_um);
        before_um
    });
    let from = ticks(from_s + span_s).max(1);
    let (mut low_um, mut high_um, mut squares) = (f64::INFINITY, f64::NEG_INFINITY, 0.0);
    for (k, half_before_um) in half_before.enumerate().skip(from) {
        let off_um = |tick: usize| run.position_um[tick] - wish_um(tick as f64);
        let (begin, end) = (off_um(k - 1), off_um(k));
        let middle = half_before_um - wish_um(k as f64 - 0.5);
        // Mean square of the parabola through the three.
        squares += (4.0 * (begin * begin + end * end + 4.0 * middle * middle)
            + 4.0 * middle * (begin + end)
            - 2.0 * begin * end)
            / 30.0;
        for um in [wish_um(k as f64), wish_um(k as f64 - 0.5)] {
            (low_um, high_um) = (low_um.min(um), high_um.max(um));
        }
    }
    Ok(CycleFigures {
        amplitude_um: 0.5 * (high_um - low_um).max(0.0),
        rms_um: (squares / (all - from).max(1) as f64).sqrt(),
        largest_move_um: run.largest_move_um,
    })
}

/// Response to a drift that sets in while the loop holds, noise-free.
///
/// # Errors
/// A plant or a loop that cannot be built.
pub fn disturbance_figures(
    plant: &DesignPlant,
    config: &LoopConfig,
    drift_um_per_s: f64,
) -> Result<DisturbanceFigures, SetUpError> {
    let y = noise_free(plant, config, 4000, drift_um_per_s, |_| 0.0)?.position_um;
    let peak_um = y.iter().fold(0.0_f64, |m, p| m.max(p.abs()));
    Ok(DisturbanceFigures {
        drift_um_per_s,
        peak_um,
        recovery_s: settled_after(y.iter().copied(), 0.1 * peak_um, plant.sample_time_s),
        steady_error_um: y.last().copied().unwrap_or(f64::NAN),
    })
}
