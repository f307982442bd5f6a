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
