//! What a zero flow that moves does to the bead.

/// The velocity that a zero flow gives to the bead: a first-order Gauss-Markov process about that of the working point. A time longer
/// than the records is a walk, and with a large variance an offset.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct ZeroFlow {
    /// Variance of the motion in a row that it makes \[um^2\].
    pub motion_um2: f64,
    /// Its correlation time \[rows\].
    pub time_rows: f64,
    /// Standard deviation of a steady change of the motion from row to row, different in each record \[um\]; 0: no drift.
    pub drift_um: f64,
}

impl ZeroFlow {
    /// What is left of a velocity a row later.
    pub(super) fn keep(&self) -> f64 {
        (-1.0 / self.time_rows).exp()
    }

    /// Variance gained in a row.
    pub(super) fn fresh_um2(&self) -> f64 {
        -(-2.0 / self.time_rows).exp_m1() * self.motion_um2
    }

    /// Whether it drifts as well.
    pub fn drifts(&self) -> bool {
        self.drift_um > 0.0
    }

    /// Mean square of its path over `rows`, about the mean or, with `ramp`, about its regression line \[um^2\].
    pub fn path_um2(&self, rows: f64, ramp: bool) -> f64 {
        // A velocity kept for good is a ramp, n^2/12 about its mean; one that walks by q a row makes q n^3/30 and q n^3/420 about the
        // line; one forgotten at once is a walk of 2 V T a row. What it is in truth is below each of them.
        let walk = 2.0 * self.motion_um2 * self.time_rows * rows;
        let changes = self.fresh_um2() * rows.powi(3);
        if ramp {
            (walk / 15.0).min(changes / 420.0)
        } else {
            (walk / 6.0).min(self.motion_um2 * rows * rows / 12.0)
        }
    }
}

/// The path of a motion that changes by one from row to row.
pub(crate) fn parabola(rows: usize) -> Vec<f64> {
    let of = |k: usize| 0.5 * (k as f64 - 0.5 * (rows as f64 - 1.0)).powi(2);
    (0..rows).map(of).collect()
}
