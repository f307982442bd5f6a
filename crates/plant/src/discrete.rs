//! Exact zero-order-hold discretisation in the strictly proper form of the sampling convention.
//!
//! Row k of a record holds the displacement commanded from `t_k` on and the position just BEFORE that command takes effect, so
//! `y_k = C x_k + D u_(k-1)`. This form is minimum phase. The other form of the biproper Eq. (6), with `D u_k`, has a zero at z =
//! -19.3 at 1 ms and must never be inverted.

use crate::error::PlantError;
use crate::modal::{Zpk, residues, separate};
use crate::phi::phi;
use crate::transfer::TransferFunction;
use cellpos_numeric::units::{Hertz, Seconds};
use nalgebra::{Complex, DMatrix, DVector, RowDVector};
use std::f64::consts::TAU;

/// One mode over one sample: `z+ = pole z + early u_(k-m-1) + late u_(k-m)`, `y = Re(weight z)`.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Mode {
    pole: Complex<f64>,
    early: Complex<f64>,
    late: Complex<f64>,
    /// Residue, doubled for the one kept of a conjugate pair.
    weight: Complex<f64>,
    real: bool,
}

/// A plant under a zero-order hold, with any delay, in whole samples or not, at its input or output (which is equivalent).
///
/// Input: displacement from the working point \[um\]; output: bead position \[um\]. Configuration only: the state is
/// a [`DiscreteState`].
#[derive(Debug, Clone, PartialEq)]
pub struct DiscretePlant {
    sample_s: f64,
    delay_s: f64,
    whole: usize,
    modes: Vec<Mode>,
    feedthrough: f64,
}

/// The state of a [`DiscretePlant`]: its modes, and the commands that the delay still holds.
#[derive(Debug, Clone, PartialEq)]
pub struct DiscreteState {
    modes: Vec<Complex<f64>>,
    /// `whole + 1` commands: `u_(k-1)` first, then older ones.
    past: Vec<f64>,
}

impl DiscretePlant {
    /// Discretises a plant exactly for a command held over `sample`, delayed by `delay`.
    ///
    /// # Errors
    /// A sample time outside 1 us..10 s, a delay outside 0..1000 samples.
    pub fn new(
        plant: &TransferFunction,
        sample: Seconds,
        delay: Seconds,
    ) -> Result<Self, PlantError> {
        let (h, d) = (sample.value(), delay.value());
        let range = |name, value: f64, lower, upper| {
            if value.is_finite() && value >= lower && value <= upper {
                Ok(())
            } else {
                Err(PlantError::OutOfRange {
                    name,
                    value,
                    unit: "s",
                    lower,
                    upper,
                })
            }
        };
        range("sample time", h, 1e-6, 10.0)?;
        range("delay", d, 0.0, 1000.0 * h)?;
        // A delay that is a whole number of samples up to rounding counts as one.
        let samples = d / h;
        let nearest = samples.round();
        let (whole, fraction) = if (samples - nearest).abs() < 1e-9 {
            (nearest as usize, 0.0)
        } else {
            (samples.floor() as usize, d - samples.floor() * h)
        };
        let mut zpk = Zpk::of(plant);
        separate(&mut zpk.poles);
        let (feedthrough, r) = residues(&zpk);
        let modes = zpk
            .poles
            .iter()
            .zip(&r)
            .filter(|(p, _)| p.im >= 0.0)
            .map(|(&p, &r)| {
                let rest = h - fraction;
                Mode {
                    pole: (p * h).exp(),
                    early: (p * rest).exp() * phi(p * fraction).one * fraction,
                    late: phi(p * rest).one * rest,
                    weight: if p.im == 0.0 { r } else { r * 2.0 },
                    real: p.im == 0.0,
                }
            })
            .collect();
        Ok(Self {
            sample_s: h,
            delay_s: d,
            whole,
            modes,
            feedthrough,
        })
    }

    /// Number of states of the strictly proper form: modes and `1 + floor(delay / sample)` past commands.
    pub fn order(&self) -> usize {
        self.modes
            .iter()
            .map(|m| if m.real { 1 } else { 2 })
            .sum::<usize>()
            + self.whole
            + 1
    }

    /// At rest at the working point, with all past commands at `command_um` from the working point.
    pub fn state(&self, command_um: f64) -> DiscreteState {
        DiscreteState {
            modes: vec![Complex::new(0.0, 0.0); self.modes.len()],
            past: vec![command_um; self.whole + 1],
        }
    }

    /// The bead position \[um\] at the present sample, just before the next command takes effect.
    pub fn output_um(&self, state: &DiscreteState) -> f64 {
        let direct = state.past.last().copied().unwrap_or(0.0);
        self.modes
            .iter()
            .zip(&state.modes)
            .map(|(m, z)| m.weight.re * z.re - m.weight.im * z.im)
            .sum::<f64>()
            + self.feedthrough * direct
    }

    /// Holds a command \[um from the working point\] for one sample. Allocates nothing and cannot panic.
    pub fn step(&self, state: &mut DiscreteState, command_um: f64) {
        // past: [u_(k-1), .., u_(k-m-1)]; u_(k-m) is the one before the last, or the new command when m = 0.
        let n = state.past.len();
        let early = state.past.last().copied().unwrap_or(0.0);
        let late = n
            .checked_sub(2)
            .and_then(|i| state.past.get(i).copied())
            .unwrap_or(command_um);
        for (m, z) in self.modes.iter().zip(&mut state.modes) {
            *z = m.pole * *z + m.early * early + m.late * late;
        }
        state.past.rotate_right(1);
        if let Some(newest) = state.past.first_mut() {
            *newest = command_um;
        }
    }

    /// The frequency response from the held command to the sampled position, `G_d(exp(j w T))`.
    pub fn response(&self, frequency: Hertz) -> Complex<f64> {
        self.at(Complex::from_polar(
            1.0,
            TAU * frequency.value() * self.sample_s,
        ))
    }

    /// The pulse transfer function at a complex z.
    pub fn at(&self, z: Complex<f64>) -> Complex<f64> {
        let shift = z.inv().powu(self.whole as u32);
        let mut sum = z.inv() * self.feedthrough;
        for m in &self.modes {
            let input = m.early * z.inv() + m.late;
            if m.real {
                sum += m.weight * input / (z - m.pole);
            } else {
                let conjugate = m.early.conj() * z.inv() + m.late.conj();
                sum += (m.weight * input / (z - m.pole)
                    + m.weight.conj() * conjugate / (z - m.pole.conj()))
                    * 0.5;
            }
        }
        sum * shift
    }

    /// Matrices of `X_(k+1) = A X_k + B u_k`, `y_k = C X_k` with `X = [modes; u_(k-1); ..; u_(k-m-1)]`.
    ///
    /// Real modal form with the modes scaled evenly between B and C; for Kalman filters, LQ design and MPC.
    pub fn matrices(&self) -> (DMatrix<f64>, DVector<f64>, RowDVector<f64>) {
        let n = self.order();
        let modal = n - self.whole - 1;
        let mut a = DMatrix::zeros(n, n);
        let mut b = DVector::zeros(n);
        let mut c = RowDVector::zeros(n);
        let oldest = n - 1;
        let mut row = 0;
        for m in &self.modes {
            let input = (m.early + m.late).norm();
            let scale = if input > 0.0 {
                (m.weight.norm() / input).sqrt()
            } else {
                1.0
            };
            let scale = if scale > 0.0 && scale.is_finite() {
                scale
            } else {
                1.0
            };
            let mut put_input = |row: usize, early: f64, late: f64| {
                a[(row, oldest)] += scale * early;
                if self.whole == 0 {
                    b[row] += scale * late;
                } else {
                    a[(row, oldest - 1)] += scale * late;
                }
            };
            put_input(row, m.early.re, m.late.re);
            if m.real {
                a[(row, row)] = m.pole.re;
                c[row] = m.weight.re / scale;
                row += 1;
            } else {
                put_input(row + 1, m.early.im, m.late.im);
                a[(row, row)] = m.pole.re;
                a[(row, row + 1)] = -m.pole.im;
                a[(row + 1, row)] = m.pole.im;
                a[(row + 1, row + 1)] = m.pole.re;
                c[row] = m.weight.re / scale;
                c[row + 1] = -m.weight.im / scale;
                row += 2;
            }
        }
        b[modal] = 1.0;
        for i in modal + 1..n {
            a[(i, i - 1)] = 1.0;
        }
        c[oldest] += self.feedthrough;
        (a, b, c)
    }
}
