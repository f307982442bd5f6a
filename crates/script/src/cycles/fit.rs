//! Least squares over one cycle: a sine at the cycle's frequency with offset and slope, and an exponential recovery.

use super::minimum::minimum;
use nalgebra::{Matrix3, Matrix4, Vector3, Vector4};
use std::f64::consts::TAU;

/// Sums for two signals fitted with `mean + slope x + a cos + b sin` over one cycle.
///
/// Drift leaks into a bare Fourier sum (a drift v adds v/(pi f) to every bin); with the slope in the fit it does not.
/// Samples may be missing anywhere.
#[derive(Debug, Clone, Default)]
pub(super) struct SineFit {
    samples: u64,
    normal: Matrix4<f64>,
    commanded: Vector4<f64>,
    reached: Vector4<f64>,
}

/// Amplitude and phase of both signals.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Sines {
    /// Amplitude of the commanded signal.
    pub(super) commanded: f64,
    /// Amplitude of the reached signal.
    pub(super) reached: f64,
    /// Lag of the reached signal, degrees of a cycle.
    pub(super) lag_deg: f64,
    /// Slope of reached minus commanded over the whole cycle.
    pub(super) slope_per_cycle: f64,
}

impl SineFit {
    /// Takes a sample at a phase in cycles.
    pub(super) fn add(&mut self, phase: f64, commanded: f64, reached: f64) {
        let (sin, cos) = (TAU * phase).sin_cos();
        let basis = Vector4::new(1.0, phase - 0.5, cos, sin);
        self.samples += 1;
        self.normal += basis * basis.transpose();
        self.commanded += basis * commanded;
        self.reached += basis * reached;
    }

    /// The fit; None if the samples are too few or too badly spread.
    pub(super) fn solve(&self) -> Option<Sines> {
        if self.samples < 6 {
            return None;
        }
        // Scaled so that a well-sampled cycle has a determinant near 0.01 whatever the number of samples.
        let scaled = self.normal / self.samples as f64;
        if scaled.determinant() < 1e-4 {
            return None;
        }
        // Fit the reference, which is periodic and known, without a slope: the corners of a triangle would look like one. Fit the
        // error, which contains the drift, with a slope, and add it.
        let pick = [0, 2, 3];
        let periodic = Matrix3::from_fn(|i, j| scaled[(pick[i], pick[j])]);
        let rhs = self.commanded / self.samples as f64;
        let r = periodic
            .cholesky()?
            .solve(&Vector3::from_fn(|i, _| rhs[pick[i]]));
        let e = scaled
            .cholesky()?
            .solve(&((self.reached - self.commanded) / self.samples as f64));
        let (r, y) = ([r[1], r[2]], [r[1] + e[2], r[2] + e[3]]);
        // a cos + b sin = A sin(2 pi phase + angle), with angle = atan2(a, b).
        let lag_deg = (r[0].atan2(r[1]) - y[0].atan2(y[1])).to_degrees();
        Some(Sines {
            commanded: r[0].hypot(r[1]),
            reached: y[0].hypot(y[1]),
            lag_deg: lag_deg - 360.0 * (lag_deg / 360.0).round(),
            slope_per_cycle: e[1],
        })
    }
}

/// Time constant of a relaxation `end + height exp(-t / constant)`, by least squares in all three; the first two are solved
/// exactly for each constant. None if the data do not fall, or the constant exceeds their length.
pub(super) fn recovery_s(points: &[(f64, f64)]) -> Option<f64> {
    let first = points.first()?;
    let last = points.last()?;
    let span_s = last.0 - first.0;
    if points.len() < 8 || span_s <= 0.0 || first.1 <= last.1 {
        return None;
    }
    let cost = |log_constant: f64| -> f64 {
        let constant_s = log_constant.exp();
        let n = points.len() as f64;
        let (mut sx, mut sy, mut sxx, mut sxy, mut syy) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for (time_s, value) in points {
            let x = (-(time_s - first.0) / constant_s).exp();
            let y = value - last.1;
            sx += x;
            sy += y;
            sxx += x * x;
            sxy += x * y;
            syy += y * y;
        }
        let (cxx, cxy, cyy) = (sxx - sx * sx / n, sxy - sx * sy / n, syy - sy * sy / n);
        if cxx > 0.0 {
            cyy - cxy * cxy / cxx
        } else {
            cyy
        }
    };
    let (low, high) = ((span_s * 1e-3).ln(), (span_s * 3.0).ln());
    minimum(low, high, 24, cost).map(f64::exp)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn amplitude_and_lag_are_exact_whatever_drift_and_gaps() {
        let mut fit = SineFit::default();
        for k in 0..100 {
            if k % 7 == 3 || (40..60).contains(&k) {
                continue;
            }
            let phase = f64::from(k) / 100.0;
            let r = 0.3 + 2.0 * (TAU * phase).sin();
            let y = -0.1 + 5.0 * phase + 1.8 * (TAU * phase - 30f64.to_radians()).sin();
            fit.add(phase, r, y);
        }
        let sines = fit.solve().unwrap();
        assert!((sines.commanded - 2.0).abs() < 1e-9, "{sines:?}");
        assert!((sines.reached - 1.8).abs() < 1e-9);
        assert!((sines.lag_deg - 30.0).abs() < 1e-7);
        assert!((sines.slope_per_cycle - 5.0).abs() < 1e-8);
    }

    #[test]
    fn a_cycle_that_was_hardly_seen_gives_no_amplitude() {
        let mut fit = SineFit::default();
        for k in 0..20 {
            fit.add(f64::from(k) / 400.0, 1.0, 1.0);
        }
        assert_eq!(fit.solve(), None);
        assert_eq!(SineFit::default().solve(), None);
    }

    #[test]
    fn the_time_constant_of_a_relaxation_is_found_also_when_it_is_cut_off() {
        for constant in [0.05, 0.16, 0.37] {
            let points: Vec<(f64, f64)> = (0..500)
                .map(|k| f64::from(k) * 1e-3)
                .map(|t| (t + 7.0, 10.0 + 20.0 * (-t / constant).exp()))
                .collect();
            let found = recovery_s(&points).unwrap();
            assert!(
                (found / constant - 1.0).abs() < 1e-3,
                "{found} for {constant}"
            );
        }
        let rising: Vec<(f64, f64)> = (0..100).map(|k| (f64::from(k), f64::from(k))).collect();
        assert_eq!(recovery_s(&rising), None);
        let straight: Vec<(f64, f64)> = (0..100).map(|k| (f64::from(k), -f64::from(k))).collect();
        assert_eq!(
            recovery_s(&straight),
            None,
            "a straight line has no time constant"
        );
    }
}
