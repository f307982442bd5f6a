//! The plant as state feedback sees it: the deviation of the bead from the model that is driven along the reference.
//!
//! State: `(q, x_1, x_2, u_(k-1) - n)`, each less that of the model on the reference.

use crate::loop_model::{LoopModel, MODES};
use nalgebra::{DMatrix, DVector, RowDVector};

/// Length of the deviation state.
pub(crate) const DEVIATION: usize = MODES + 2;

/// Plant of the deviation state over one tick: `s' = A s + B (u - n)`, `y - r = C s`.
#[derive(Debug, Clone)]
pub(crate) struct Deviation {
    pub a: DMatrix<f64>,
    pub b: DVector<f64>,
    pub c: RowDVector<f64>,
}

impl Deviation {
    pub(crate) fn new(model: &LoopModel) -> Self {
        let ts = model.sample_time_s;
        let mut a = DMatrix::zeros(DEVIATION, DEVIATION);
        let mut b = DVector::zeros(DEVIATION);
        let mut c = RowDVector::zeros(DEVIATION);
        (a[(0, 0)], b[0], c[0]) = (1.0, model.gain_per_s * ts, 1.0);
        for (i, mode) in model.modes.iter().enumerate() {
            if mode.pole_rad_per_s < 0.0 {
                let decay = (mode.pole_rad_per_s * ts).exp();
                a[(i + 1, i + 1)] = decay;
                b[i + 1] = (decay - 1.0) / mode.pole_rad_per_s;
                c[i + 1] = mode.residue_per_s;
            }
        }
        b[DEVIATION - 1] = 1.0;
        c[DEVIATION - 1] = model.feedthrough;
        Self { a, b, c }
    }

    /// Motion of the bead by the next tick after a command of 1 um, um.
    pub(crate) fn moved_um(&self) -> f64 {
        (&self.c * &self.b)[0]
    }

    /// The motion by which a command's cost is measured, um for 1 um: that of a bare integrator in a tick, or behind a lag
    /// the part of it that comes by the next tick. The rest comes later and costs the error, not the command.
    pub(crate) fn costed_um(&self) -> f64 {
        self.moved_um().abs().min(self.b[0].abs())
    }
}
