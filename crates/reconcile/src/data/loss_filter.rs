//! Gains of the Kalman filter of a zero flow that enters ahead of a chip with a loss. Its states are the walk, the zero flow, and the
//! low-pass filtered zero flow.

use crate::data::flow_loss::FlowLoss;
use crate::data::motion::ZeroFlow;
use crate::data::noise::NoiseModel;
use crate::data::row_noise::RowNoise;
use nalgebra::Matrix3;

/// Gains by row, zero where a frame is missing.
pub(super) struct Gains {
    pub walk: Vec<f64>,
    pub flow: Vec<f64>,
    pub filtered: Vec<f64>,
    pub inverse_sigma: Vec<f64>,
}

impl Gains {
    /// `present[k]`: the frame counts.
    pub(super) fn new(
        noise: &NoiseModel,
        (z, chip): (&ZeroFlow, FlowLoss),
        present: &[bool],
        rows: &RowNoise,
    ) -> Self {
        let none = || vec![0.0; present.len()];
        let mut gains = Self {
            walk: none(),
            flow: none(),
            filtered: none(),
            inverse_sigma: none(),
        };
        let step = chip.step(z.keep());
        // As a zero flow of long ago has left them.
        let mut p = Matrix3::zeros();
        p.fixed_view_mut::<2, 2>(1, 1)
            .copy_from(&chip.at_rest(z.motion_um2, z.keep()));
        let mut begun = false;
        for (k, seen) in present.iter().enumerate() {
            if k > 0 {
                p = step * p * step.transpose();
                p[(1, 1)] += z.fresh_um2();
            }
            p[(0, 0)] += noise.walk_um2 + rows.walk_um2(k);
            if !seen {
                continue;
            }
            if !begun {
                // The first frame only says where the bead is: the start is a nuisance.
                begun = true;
                gains.walk[k] = 1.0;
                p.fill_row(0, 0.0);
                p.fill_column(0, 0.0);
                p[(0, 0)] = noise.white_um2 + rows.white_um2(k);
                continue;
            }
            let s = p[(0, 0)] + noise.white_um2 + rows.white_um2(k);
            let gain = p.column(0) / s;
            p -= gain * gain.transpose() * s;
            gains.inverse_sigma[k] = 1.0 / s.sqrt();
            (gains.walk[k], gains.flow[k], gains.filtered[k]) = (gain[0], gain[1], gain[2]);
        }
        gains
    }
}
