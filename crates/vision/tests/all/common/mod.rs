//! Frames and bounds straight from the profiles' formulas, not from the tables that the fit reads.
#![allow(dead_code)]

pub(crate) mod change;
pub(crate) mod stack;

use cellpos_vision::{Frame, PixelNoise, Pixels, RadialProfile};
use nalgebra::{Matrix4, Vector4};

/// A small generator of uniform and normal numbers (xorshift64*, Box-Muller): the same bits everywhere.
pub(crate) struct Random(pub u64);

impl Random {
    pub(crate) fn uniform(&mut self) -> f64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 11) as f64 / (1_u64 << 53) as f64
    }
    pub(crate) fn normal(&mut self) -> f64 {
        let r = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        r * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

/// Side of the square frames, px.
pub(crate) const SIDE: usize = 25;
/// Background of the frames, grey levels.
pub(crate) const BACKGROUND: f64 = 20_000.0;

/// Noise of a known standard deviation, the same in every pixel.
pub(crate) fn known_noise(sd_grey: f64) -> PixelNoise {
    PixelNoise::Known {
        read_sd_grey: sd_grey,
        shot_grey_per_electron: 0.0,
        black_level_grey: 0.0,
    }
}

/// A frame of one bead with even noise.
pub(crate) fn render(
    p: &dyn RadialProfile,
    x: f64,
    y: f64,
    amplitude: f64,
    noise: f64,
    random: &mut Random,
) -> Vec<u16> {
    let pixel = |k: usize| {
        let r = f64::hypot((k % SIDE) as f64 - x, (k / SIDE) as f64 - y);
        (BACKGROUND + amplitude * p.value(r) + noise * random.normal()).round() as u16
    };
    (0..SIDE * SIDE).map(pixel).collect()
}

/// Cramer-Rao bound of x and y (standard deviations, px) with amplitude and background unknown.
pub(crate) fn bound(p: &dyn RadialProfile, x: f64, y: f64, snr: f64) -> (f64, f64) {
    let mut information = Matrix4::zeros();
    for k in 0..SIDE * SIDE {
        let (dx, dy) = ((k % SIDE) as f64 - x, (k / SIDE) as f64 - y);
        let r = f64::hypot(dx, dy).max(1e-9);
        let slope = -snr * p.slope(r) / r;
        let g = Vector4::new(slope * dx, slope * dy, snr * p.value(r), snr);
        information += g * g.transpose();
    }
    let c = information
        .try_inverse()
        .expect("a bead carries information");
    (c[(0, 0)].sqrt(), c[(1, 1)].sqrt())
}

pub(crate) fn frame(pixels: &[u16]) -> Frame<'_> {
    Frame {
        width: SIDE,
        height: SIDE,
        pixels: Pixels::Mono16(pixels),
    }
}

/// Errors over the bound, and their mean.
#[derive(Default)]
pub(crate) struct Errors {
    n: f64,
    squared_over_bound: f64,
    sum: (f64, f64),
}

impl Errors {
    pub(crate) fn add(&mut self, (ex, ey): (f64, f64), (bx, by): (f64, f64)) {
        self.n += 1.0;
        self.squared_over_bound += 0.5 * ((ex / bx).powi(2) + (ey / by).powi(2));
        self.sum = (self.sum.0 + ex, self.sum.1 + ey);
    }
    /// RMS error over the bound.
    pub(crate) fn ratio(&self) -> f64 {
        (self.squared_over_bound / self.n).sqrt()
    }
    /// Mean error along x and y, px.
    pub(crate) fn bias(&self) -> (f64, f64) {
        (self.sum.0 / self.n, self.sum.1 / self.n)
    }
}
