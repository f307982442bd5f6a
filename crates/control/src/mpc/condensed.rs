//! The configuration of MPC, and the condensed problem that follows from it and the plant.

use crate::active_set::{ABSENT, QpMatrices, ROWS, VARS};
use crate::deviation::{DEVIATION, Deviation};
use crate::error::{BuildError, check};
use crate::loop_model::LoopModel;
use crate::lqg::{Feedback, check_effort};
use crate::riccati::lq_feedback;
use nalgebra::{DMatrix, RowDVector};
use serde::{Deserialize, Serialize};

/// Ticks that the plan looks ahead.
pub const HORIZON: usize = 40;
/// Ticks of each block.
pub(super) const BLOCKS: [usize; VARS] = [1, 1, 1, 1, 1, 2, 2, 3, 4, 6, 8, 10];

/// Which QP solver runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SolverKind {
    /// Interior point, crate clarabel: small allocations each tick, and some forty times the time of the other.
    Clarabel,
    /// Dual active set, warm-started, without allocation.
    #[default]
    ActiveSet,
}

/// Configuration of MPC.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Mpc {
    /// Weight of the motion that a correction causes in a tick, relative to the position error.
    pub effort: f64,
    /// The same for the change of the correction from block to block.
    pub move_effort: f64,
    /// Solver.
    pub solver: SolverKind,
    /// Lower end of the field of view, um of bead.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub view_low_um: Option<f64>,
    /// Upper end of the field of view, um of bead.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub view_high_um: Option<f64>,
}

impl Default for Mpc {
    fn default() -> Self {
        Self {
            effort: 3.8,
            move_effort: 0.13,
            solver: SolverKind::default(),
            view_low_um: None,
            view_high_um: None,
        }
    }
}

/// The condensed problem: matrices of the QP and the maps to its vectors.
#[derive(Debug, Clone)]
pub(super) struct Condensed {
    pub matrices: QpMatrices,
    /// Linear term per deviation state.
    pub from_state: [[f64; DEVIATION]; VARS],
    /// Free motion of the error at the end of each block, per deviation state.
    pub free: [[f64; DEVIATION]; VARS],
}

impl Mpc {
    /// Checks every value.
    ///
    /// # Errors
    /// [`BuildError::OutOfRange`] naming the key.
    pub fn validate(&self) -> Result<(), BuildError> {
        check_effort(self.effort)?;
        check(
            "move_effort",
            "",
            self.move_effort,
            (0.0..=1e4).contains(&self.move_effort),
            "0 to 10000",
        )?;
        let low = self.view_low_um.unwrap_or(-ABSENT);
        check("view_low_um", "um", low, true, "finite")?;
        let high = self.view_high_um.unwrap_or(ABSENT);
        check(
            "view_high_um",
            "um",
            high,
            high > low,
            "larger than view_low_um",
        )
    }

    /// The law without active constraints and with a reference at rest.
    ///
    /// # Errors
    /// A value out of range, or a Riccati equation without solution.
    pub fn feedback(&self, model: &LoopModel) -> Result<Feedback, BuildError> {
        let condensed = Condensed::new(self, model)?;
        let linear = DMatrix::from_fn(VARS, DEVIATION, |i, j| condensed.from_state[i][j]);
        let w = condensed
            .matrices
            .unconstrained(&linear)
            .ok_or(BuildError::NoConvergence {
                what: "the condensed problem",
            })?;
        Ok(Feedback {
            gains: std::array::from_fn(|j| -w[(0, j)]),
        })
    }
}

impl Condensed {
    pub(super) fn new(mpc: &Mpc, model: &LoopModel) -> Result<Self, BuildError> {
        mpc.validate()?;
        let d = Deviation::new(model);
        let scale = d.costed_um().powi(2);
        let (_, terminal) = lq_feedback(&d.a, &d.b, &(d.c.transpose() * &d.c), mpc.effort * scale)?;
        let ends: Vec<usize> = BLOCKS
            .iter()
            .scan(0, |end, length| {
                *end += length;
                Some(*end)
            })
            .collect();
        // s_i = power s_0 + effect w
        let mut power = DMatrix::<f64>::identity(DEVIATION, DEVIATION);
        let mut effect = DMatrix::<f64>::zeros(DEVIATION, VARS);
        let mut hessian = DMatrix::<f64>::zeros(VARS, VARS);
        let mut linear = DMatrix::<f64>::zeros(VARS, DEVIATION);
        let mut free = [[0.0; DEVIATION]; VARS];
        let mut rows = DMatrix::<f64>::zeros(ROWS, VARS);
        let mut block = 0;
        for i in 0..HORIZON {
            if i >= ends[block] {
                block += 1;
            }
            power = &d.a * power;
            effect = &d.a * effect;
            for k in 0..DEVIATION {
                effect[(k, block)] += d.b[k];
            }
            let (along, still): (RowDVector<f64>, RowDVector<f64>) =
                (&d.c * &effect, &d.c * &power);
            hessian += 2.0 * along.transpose() * &along;
            linear += 2.0 * along.transpose() * &still;
            hessian[(block, block)] += 2.0 * mpc.effort * scale;
            if i + 1 == ends[block] {
                free[block] = std::array::from_fn(|k| still[k]);
                rows.row_mut(2 * VARS + block).copy_from(&along);
            }
        }
        hessian += 2.0 * effect.transpose() * &terminal * &effect;
        linear += 2.0 * effect.transpose() * &terminal * &power;
        for b in 0..VARS {
            rows[(b, b)] = 1.0;
            rows[(VARS + b, b)] = 1.0;
            let weight = 2.0 * mpc.move_effort * scale;
            hessian[(b, b)] += weight;
            if b > 0 {
                rows[(VARS + b, b - 1)] = -1.0;
                hessian[(b - 1, b - 1)] += weight;
                hessian[(b, b - 1)] -= weight;
                hessian[(b - 1, b)] -= weight;
            } else {
                // The correction before the plan is the last element of the deviation state.
                linear[(0, DEVIATION - 1)] -= weight;
            }
        }
        let matrices = QpMatrices::new(hessian, rows).ok_or(BuildError::NoConvergence {
            what: "the condensed problem",
        })?;
        Ok(Self {
            matrices,
            from_state: std::array::from_fn(|i| std::array::from_fn(|j| linear[(i, j)])),
            free,
        })
    }
}
