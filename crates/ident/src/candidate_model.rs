//! The candidate models as functions of physical parameters, from a bare integrator to Eq. (4).
//!
//! `G(s) = K (1 + s/z) (1 + s tau) / ((s + q) (1 + s/p)) e^(-s L)`: integrator gain `K`, pole-zero pair `z`, `p`, far zero at `-1/tau`,
//! slow pole at `-q`, delay `L`. With all parameters this is Eq. (4) with real poles and zeros (`alpha = K tau p/z`). Without the far
//! zero and with `q = 0` it is an integrator with a pole-zero pair; with `z = p` also, a bare integrator. A second lag `1/(1 + s/r)` can
//! replace far zero and slow pole. Eq. (5), read correctly, is `K = 2 pi 63 /s`. Not for resonances: see [`crate::rational`].

use nalgebra::Complex;

use crate::sampled::{Hold, PartialFractions, Sampled, Sampling};

/// Parameters of Eq. (4) with real poles and zeros, and a delay.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CandidateModel {
    /// Integrator gain `K`, bead speed per PZT displacement, 1/s.
    pub gain_per_s: f64,
    /// Zero of the pair, rad/s (a zero at `-zero_rad_per_s`).
    pub zero_rad_per_s: f64,
    /// Pole of the pair, rad/s.
    pub pole_rad_per_s: f64,
    /// Pole of a second lag, rad/s.
    pub second_pole_rad_per_s: Option<f64>,
    /// `1/far zero`, s: the lead of the far zero. 0: no far zero, no feedthrough.
    pub far_lead_s: f64,
    /// Slow pole, rad/s. 0: an integrator.
    pub slow_pole_rad_per_s: f64,
    /// Delay from the command to the middle of the exposure, s.
    pub delay_s: f64,
    /// Part of the feedthrough that a record shows one row later than the rest. `None`: as the exposure and an immediate step of the
    /// output give it. It depends on when within the exposure the output really steps. No band below half the sampling rate shows those
    /// microseconds, so a fit leaves this parameter free.
    pub feedthrough_share: Option<f64>,
}

impl CandidateModel {
    /// A bare integrator behind a delay: Eq. (5) with the correct unit.
    pub fn integrator(gain_per_s: f64, delay_s: f64) -> Self {
        Self {
            gain_per_s,
            zero_rad_per_s: 1.0,
            pole_rad_per_s: 1.0,
            second_pole_rad_per_s: None,
            far_lead_s: 0.0,
            slow_pole_rad_per_s: 0.0,
            delay_s,
            feedthrough_share: None,
        }
    }

    /// Eq. (6), the nominal plant, behind a delay.
    pub fn eq6(delay_s: f64) -> Self {
        let (alpha, b1, b0, a1, a0): (f64, f64, f64, f64, f64) =
            (0.01872, 20261.5, 1_745_041.0, 76.3, 0.13);
        let root = |b: f64, c: f64| {
            let far = 0.5 * (b + (b * b - 4.0 * c).sqrt());
            (far, c / far)
        };
        let (far_zero, zero) = root(b1, b0);
        let (pole, slow) = root(a1, a0);
        Self {
            gain_per_s: alpha * b0 / pole,
            zero_rad_per_s: zero,
            pole_rad_per_s: pole,
            second_pole_rad_per_s: None,
            far_lead_s: 1.0 / far_zero,
            slow_pole_rad_per_s: slow,
            delay_s,
            feedthrough_share: None,
        }
    }

    /// Delay minus the lead of the far zero, s. For an integrator behind a zero-order hold, delay and lead trade exactly, so the phase of
    /// a record determines only this difference.
    pub fn effective_delay_s(&self) -> f64 {
        self.delay_s - self.far_lead_s
    }

    /// The plant without its delay, as partial fractions.
    pub fn partial_fractions(&self) -> PartialFractions {
        let poles = self.poles();
        let zeros = |s: f64| {
            let zero = self.zero().map_or(1.0, |z| 1.0 + s / z);
            self.gain_per_s * zero * (1.0 + s * self.far_lead_s)
        };
        let direct = match (self.second_pole_rad_per_s, self.pair()) {
            (Some(_), _) => 0.0,
            (None, Some((z, p))) => self.gain_per_s * self.far_lead_s * p / z,
            (None, None) => self.gain_per_s * self.far_lead_s,
        };
        let slow = self.slow_pole_rad_per_s;
        let lags = |s: f64, but: Option<usize>| -> f64 {
            (poles.iter().enumerate())
                .filter(|(i, _)| Some(*i) != but)
                .map(|(_, p)| 1.0 + s / p)
                .product()
        };
        let of_slow = zeros(-slow) / lags(-slow, None);
        let of_lags = (poles.iter().enumerate()).map(|(i, &p)| {
            let residue = zeros(-p) * p / ((slow - p) * lags(-p, Some(i)));
            (Complex::from(-p), Complex::from(residue))
        });
        PartialFractions {
            direct,
            terms: std::iter::once((Complex::from(-slow), Complex::from(of_slow)))
                .chain(of_lags)
                .collect(),
        }
    }

    /// Zero and pole of the pair, unless they cancel.
    fn pair(&self) -> Option<(f64, f64)> {
        let (z, p) = (self.zero_rad_per_s, self.pole_rad_per_s);
        ((z / p - 1.0).abs() >= 1e-12).then_some((z, p))
    }

    /// The pair's zero, if there is one: a lead below a nanosecond does not count.
    fn zero(&self) -> Option<f64> {
        self.pair().map(|(z, _)| z).filter(|z| *z < 1e9)
    }

    /// The poles of lags, apart from each other.
    fn poles(&self) -> Vec<f64> {
        let pole = self.pair().map(|(_, p)| p);
        let second = self.second_pole_rad_per_s.map(|r| match pole {
            // Two equal lags have no partial fractions, so they are moved apart by 1e-4, which no record shows.
            Some(p) if (r / p - 1.0).abs() < 1e-4 => p * (1.0 + 1e-4),
            _ => r,
        });
        pole.into_iter().chain(second).collect()
    }

    /// `G(j 2 pi f)` without the delay.
    pub fn response(&self, frequency_hz: f64) -> Complex<f64> {
        self.partial_fractions().response(frequency_hz)
    }

    /// What a record sampled as `sampling` shows at `frequency_hz`, delay included.
    pub fn sampled_response(&self, frequency_hz: f64, sampling: Sampling) -> Complex<f64> {
        self.sampler(sampling).response(frequency_hz)
    }

    /// The same for many frequencies.
    pub fn sampler(&self, sampling: Sampling) -> Sampler {
        let mut fractions = self.partial_fractions();
        let late = self
            .feedthrough_share
            .filter(|_| sampling.hold == Hold::ZeroOrder)
            .map(|share| {
                let direct = std::mem::take(&mut fractions.direct);
                (direct * (1.0 - share), direct * share)
            });
        Sampler {
            smooth: fractions.sampled(self.delay_s, sampling),
            row: (self.delay_s / sampling.period_s).round(),
            period_s: sampling.period_s,
            late,
        }
    }

    /// Numerator and denominator of the plant without delay, highest power of s first, the denominator monic; of lower
    /// degree where parameters are absent.
    pub fn polynomials(&self) -> (Vec<f64>, Vec<f64>) {
        let times = |polynomial: Vec<f64>, [high, low]: [f64; 2]| -> Vec<f64> {
            let mut product = vec![0.0; polynomial.len() + 1];
            for (i, c) in polynomial.into_iter().enumerate() {
                product[i] += c * high;
                product[i + 1] += c * low;
            }
            product
        };
        let poles = self.poles();
        let scale: f64 = self.gain_per_s * poles.iter().product::<f64>();
        let mut numerator = vec![scale];
        if let Some(z) = self.zero() {
            numerator = times(numerator, [1.0 / z, 1.0]);
        }
        if self.far_lead_s != 0.0 {
            numerator = times(numerator, [self.far_lead_s, 1.0]);
        }
        let slow = vec![1.0, self.slow_pole_rad_per_s];
        let denominator = poles.into_iter().fold(slow, |d, p| times(d, [1.0, p]));
        (numerator, denominator)
    }
}

/// A [`CandidateModel`] prepared for evaluation at many frequencies.
#[derive(Debug, Clone)]
pub struct Sampler {
    smooth: Sampled,
    /// The row nearest to the delay.
    row: f64,
    period_s: f64,
    /// Feedthrough in that row and in the one after it.
    late: Option<(f64, f64)>,
}

impl Sampler {
    /// What the record shows at `frequency_hz`.
    pub fn response(&self, frequency_hz: f64) -> Complex<f64> {
        let smooth = self.smooth.response(frequency_hz);
        let Some((early, late)) = self.late else {
            return smooth;
        };
        let angle = 2.0 * std::f64::consts::PI * frequency_hz * self.period_s;
        smooth
            + Complex::from_polar(early, -angle * self.row)
            + Complex::from_polar(late, -angle * (self.row + 1.0))
    }

    /// Output rows for the rows of a held `input`, from rest at its first value on.
    pub fn record(&self, input: &[f64]) -> Vec<f64> {
        let mut output = self.smooth.record(input);
        let (early, late) = self.late.unwrap_or((0.0, 0.0));
        let row = self.row as usize;
        for (share, row) in [(early, row), (late, row + 1)] {
            for (to, value) in output.iter_mut().skip(row).zip(input) {
                *to += share * (value - input[0]);
            }
        }
        output
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn eq6_in_these_parameters_has_the_gain_and_phase_of_the_papers_frequencies() {
        let model = CandidateModel::eq6(0.0);
        let table = [
            (2.0, 30.62, -91.04),
            (5.0, 22.55, -92.33),
            (10.0, 16.26, -93.30),
            (20.0, 9.88, -92.92),
            (50.0, 1.67, -90.85),
            (100.0, -4.40, -89.13),
            (120.0, -5.99, -88.63),
            (150.0, -7.93, -87.94),
            (200.0, -10.42, -86.90),
            (300.0, -13.92, -84.97),
        ];
        for (f, gain_db, phase_deg) in table {
            let g = model.response(f);
            assert!((20.0 * g.norm().log10() - gain_db).abs() < 0.006, "{f} Hz");
            assert!((g.arg().to_degrees() - phase_deg).abs() < 0.006, "{f} Hz");
        }
        assert!((model.gain_per_s - 428.1).abs() < 0.1);
        assert!((1.0 / model.far_lead_s - 20175.0).abs() < 1.0);
    }

    #[test]
    fn polynomials_and_partial_fractions_are_the_same_plant() {
        let slow = CandidateModel {
            slow_pole_rad_per_s: 0.7,
            ..CandidateModel::eq6(0.0)
        };
        same_plant(&slow);
        let (_, denominator) = slow.polynomials();
        assert!((denominator[1] - (slow.pole_rad_per_s + 0.7)).abs() < 1e-12);
        // Two lags, without a zero and with one, apart and equal.
        for (zero_rad_per_s, second) in [(1e12, 50.0), (86.0, 50.0), (86.0, 20.0)] {
            let lags = CandidateModel {
                zero_rad_per_s,
                pole_rad_per_s: 20.0,
                second_pole_rad_per_s: Some(second),
                ..CandidateModel::integrator(428.0, 0.0)
            };
            same_plant(&lags);
            let s = Complex::new(0.0, 2.0 * std::f64::consts::PI * 7.0);
            let lag = |p: f64| 1.0 / (1.0 + s / p);
            let by_hand = 428.0 / s * (1.0 + s / zero_rad_per_s) * lag(20.0) * lag(second);
            assert!((lags.response(7.0) / by_hand - 1.0).norm() < 2e-4);
        }
    }

    fn same_plant(model: &CandidateModel) {
        let (numerator, denominator) = model.polynomials();
        let horner =
            |c: &[f64], s: Complex<f64>| c.iter().fold(Complex::from(0.0), |a, &c| a * s + c);
        for f in [0.3, 7.0, 150.0] {
            let s = Complex::new(0.0, 2.0 * std::f64::consts::PI * f);
            let ratio = horner(&numerator, s) / horner(&denominator, s);
            assert!((ratio - model.response(f)).norm() < 1e-5 * ratio.norm());
        }
    }

    #[test]
    fn behind_a_hold_the_far_zero_and_the_delay_of_an_integrator_cannot_be_told_apart() {
        let sampling = Sampling::held(1000.0);
        let plain = CandidateModel::integrator(400.0, 0.0021);
        let traded = CandidateModel {
            far_lead_s: 0.0005,
            delay_s: 0.0026,
            ..plain
        };
        for f in [2.0, 50.0, 300.0, 480.0] {
            let (a, b) = (
                plain.sampled_response(f, sampling),
                traded.sampled_response(f, sampling),
            );
            assert!((a - b).norm() < 1e-12 * a.norm());
        }
    }
}
