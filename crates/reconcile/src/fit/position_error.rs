//! An error of the camera that is periodic in the position, with its uncertainty.

use nalgebra::{Matrix5, Vector5};

/// Fitted numbers: `a`, `b`, `ln p`, and the logarithms of both noises. An error that depends on position looks like white noise
/// to an estimate that ignores it, and the blur of the positions follows from the noises.
pub(super) type Numbers = Vector5<f64>;

/// An error `a sin(2 pi x/p) + b cos(2 pi x/p)` with the covariance of its [`Numbers`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Locking {
    pub pixel_um: f64,
    /// Sine and cosine \[um\].
    pub wave_um: [f64; 2],
    pub(super) covariance: Matrix5<f64>,
}

impl Locking {
    /// Amplitude in pixels and its standard error.
    pub(crate) fn amplitude_px(&self) -> (f64, f64) {
        let [a, b] = self.wave_um;
        let size = a.hypot(b).max(1e-12);
        let slope = Numbers::new(a / size, b / size, -size, 0.0, 0.0) / self.pixel_um;
        let variance = (slope.transpose() * self.covariance * slope).x;
        (size / self.pixel_um, variance.max(0.0).sqrt())
    }

    /// Standard error of the logarithm of the pixel.
    pub(crate) fn log_pixel_error(&self) -> f64 {
        self.covariance[(2, 2)].max(0.0).sqrt()
    }
}
