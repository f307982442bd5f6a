//! The loops that the tests close.

use cellpos_control::*;

/// Of the paper's plant, with two samples of delay and the default limits.
pub(crate) fn config(controller: ControllerConfig) -> LoopConfig {
    LoopConfig {
        model: LoopModel::eq6(2e-3),
        estimator: EstimatorConfig::default(),
        controller,
        limits: Limits::default(),
    }
}

/// With a solver, and the PI that stands in for it.
pub(crate) fn mpc(solver: SolverKind) -> ControllerConfig {
    ControllerConfig::Mpc(
        Mpc {
            solver,
            ..Mpc::default()
        },
        Pi::new(0.46, 19.5),
    )
}

/// First seed of a long table: `FIRST_SEED`, so that it can be run on seeds that nobody has seen.
pub(crate) fn first_seed() -> u64 {
    let given = std::env::var("FIRST_SEED").ok();
    given.map_or(0, |seed| seed.parse().expect("FIRST_SEED is a number"))
}
