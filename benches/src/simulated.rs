//! The controllers of the tables, on the rig at the level of positions.

use cellpos_control::design::{DesignPlant, PiSearch, default_lead, search_pi};
use cellpos_control::*;

/// Every controller as `cellpos track --controller NAME` has it.
///
/// # Panics
/// No gains for the nominal plant: a defect.
pub fn controllers() -> Vec<(&'static str, ControllerConfig)> {
    let plant = DesignPlant::eq6(2.5e-3);
    let searched = |lead| {
        let search = PiSearch {
            lead,
            ..PiSearch::default()
        };
        search_pi(&plant, search)
            .ok()
            .flatten()
            .expect("gains exist at 2.5 ms")
    };
    let pi = searched(None);
    let mpc = |solver| {
        ControllerConfig::Mpc(
            Mpc {
                solver,
                ..Mpc::default()
            },
            pi,
        )
    };
    vec![
        ("pi", ControllerConfig::Pi(pi)),
        (
            "lead",
            ControllerConfig::Pi(searched(Some(default_lead(2.5e-3)))),
        ),
        ("lqg", ControllerConfig::Lqg(Lqg::default())),
        ("mpc, clarabel", mpc(SolverKind::Clarabel)),
        ("mpc, active set", mpc(SolverKind::ActiveSet)),
    ]
}

/// The loop of a controller with everything else at its default.
pub fn loop_config(controller: ControllerConfig) -> LoopConfig {
    LoopConfig {
        model: LoopModel::eq6(2e-3),
        estimator: EstimatorConfig::default(),
        controller,
        limits: Limits::default(),
    }
}

/// A tick of a simulated run, as it is seen from outside.
#[derive(Debug, Clone, Copy)]
pub struct Seen {
    /// Number of the tick.
    pub tick: u64,
    /// True position, um.
    pub true_um: f64,
    /// True position less reference, um.
    pub error_um: f64,
    /// What the loop gave.
    pub output: LoopOutput,
}

/// Runs a controller along a profile, with a fix every few ticks as its estimator expects, and with learning if a learner is
/// given. `before` may change the rig at each tick, `each` sees the result. Returns the learner.
///
/// # Panics
/// A rig or a controller that cannot be built: a defect.
pub fn run(
    config: LoopConfig,
    rig: RigConfig,
    profile: &Profile,
    learner: Option<&Learner>,
    ticks: u64,
    mut before: impl FnMut(u64, &mut SimulatedRig),
    mut each: impl FnMut(Seen),
) -> Option<LearnedTable> {
    let ts = config.model.sample_time_s;
    let late = (rig.delay_s - config.model.delay_s) / ts;
    let age_ticks = rig.delay_s / ts;
    let every = config.estimator.ticks_per_fix.round() as u64;
    let mut rig = SimulatedRig::new(rig).expect("a sound rig");
    let mut controller = Controller::new(config).expect("a sound controller");
    controller.start(20.0, 20.0);
    let mut preview = vec![0.0; controller.preview_len()];
    let mut learning = learner.map(|learner| CycleLearning::new(learner.clone(), learner.start()));
    for tick in 0..ticks {
        before(tick, &mut rig);
        let time_s = tick as f64 * ts;
        let reference_um = profile.at_um(time_s);
        fill_preview(profile, tick, ts, &mut preview);
        let true_um = rig.true_um();
        let mut fix = rig.measure();
        // A frame says by its time stamp how old it is.
        fix.offset_samples = late;
        let input = LoopInput {
            measurement: tick.is_multiple_of(every).then_some(fix),
            reference_um,
            preview_um: &preview,
            learned_um: learning.as_mut().map_or(0.0, |learning| {
                learning.addition_um(profile.phase(time_s), reference_um)
            }),
            feed_forward_gain: learning.as_ref().and_then(CycleLearning::feed_forward_gain),
            ..LoopInput::default()
        };
        let output = controller.step(&input);
        if let Some(learning) = &mut learning {
            let seen = input.measurement.map(|fix| (fix.position_um, age_ticks));
            learning.learn(seen, &output.driven);
        }
        rig.advance(output.command_um);
        each(Seen {
            tick,
            true_um,
            error_um: true_um - reference_um,
            output,
        });
    }
    learning.map(|learning| learning.table())
}

/// Root of the mean of the squares; NaN of nothing.
pub fn rms(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, n) = values.fold((0.0, 0.0), |(s, n), v| (s + v * v, n + 1.0));
    (sum / n).sqrt()
}

/// A sine about 0 um that comes in over `fade_s`.
pub fn sine(amplitude_um: f64, frequency_hz: f64, fade_s: f64) -> Profile {
    Profile::Wave {
        shape: Shape::Sine,
        centre_um: 0.0,
        amplitude_um,
        frequency_hz,
        fade_s,
    }
}
