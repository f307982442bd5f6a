//! What a zero flow that moves does to the bead.

use crate::data::flow_loss::FlowLoss;

/// The velocity that a zero flow gives to the bead: a first-order Gauss-Markov process about that of the working point. A time longer
/// than the records is a walk, and with a large variance an offset.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct ZeroFlow {
    /// Variance of the motion in a row that it makes \[um^2\].
    pub motion_um2: f64,
    /// Its correlation time \[rows\].
    pub time_rows: f64,
    /// Standard deviation of a steady change of the motion from row to row, different in each record \[um\].
    pub drift_um: f64,
    /// Its loss in the chip, if it enters ahead of that.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub loss: Option<FlowLoss>,
}

impl ZeroFlow {
    /// What is left of a velocity a row later.
    pub(crate) fn keep(&self) -> f64 {
        (-1.0 / self.time_rows).exp()
    }

    /// Variance gained in a row.
    pub(super) fn fresh_um2(&self) -> f64 {
        -(-2.0 / self.time_rows).exp_m1() * self.motion_um2
    }

    /// Mean square of its path over `rows`, about the mean or, with `ramp`, about its regression line \[um^2\].
    pub fn path_um2(&self, rows: f64, ramp: bool) -> f64 {
        // A constant velocity is a ramp: n^2/12 about its mean. A velocity that walks by q a row makes q n^3/30, and q n^3/420
        // about the line. One without memory is a walk of 2 V T a row. The true motion is below each bound.
        let walk = 2.0 * self.motion_um2 * self.time_rows * rows;
        let changes = self.fresh_um2() * rows.powi(3);
        if ramp {
            (walk / 15.0).min(changes / 420.0)
        } else {
            (walk / 6.0).min(self.motion_um2 * rows * rows / 12.0)
        }
    }
}

/// Where a zero flow takes a bead in a record.
#[derive(Debug, Clone)]
pub(crate) struct FlowPaths {
    /// Of one that is off by one motion in a row \[um\].
    pub off: Vec<f64>,
    /// Of one that drifts by one motion in a row in every row, and is right in the middle of the record \[um\].
    pub drift: Vec<f64>,
}

impl FlowPaths {
    /// With the path of one that is off; that of a drift is its sum, whatever the plant.
    pub(crate) fn new(off: Vec<f64>) -> Self {
        let middle = 0.5 * (off.len() as f64 - 1.0);
        let mut sum = 0.0;
        let drift = off.iter().map(|y| {
            let at = sum + 0.5 * y - middle * y;
            sum += y;
            at
        });
        Self {
            drift: drift.collect(),
            off,
        }
    }
}
