//! What the increments of a bead sum to, before a pulse and in it.

/// Sums for the fit of increments `y` by `drift * time + ratio * x`, each with a variance that grows with its time.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Sums {
    pub(super) count: f64,
    pub(super) ticks: f64,
    pub(super) x: f64,
    pub(super) y: f64,
    pub(super) xx: f64,
    pub(super) xy: f64,
    pub(super) yy: f64,
}

impl Sums {
    pub(super) fn add(&mut self, ticks: f64, x: f64, y: f64) {
        self.count += 1.0;
        self.ticks += ticks;
        self.x += x;
        self.y += y;
        self.xx += x * x / ticks;
        self.xy += x * y / ticks;
        self.yy += y * y / ticks;
    }
}

/// Increments of a bead at rest, and their products with a square wave of the doublet's period and with the same a quarter later.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Rest {
    count: f64,
    y: f64,
    waves: [f64; 2],
    products: [f64; 2],
}

impl Rest {
    pub(super) fn add(&mut self, waves: [f64; 2], y: f64) {
        self.count += 1.0;
        self.y += y;
        for (k, wave) in waves.into_iter().enumerate() {
            self.waves[k] += wave;
            self.products[k] += wave * y;
        }
    }

    /// Variance per tick of what moves the bead as the doublet does: that of all increments if they are independent.
    pub(super) fn variance(&self) -> f64 {
        let mean = self.y / self.count.max(1.0);
        let [a, b] = [0, 1].map(|k| self.products[k] - mean * self.waves[k]);
        (a * a + b * b) / (2.0 * self.count.max(1.0))
    }
}
