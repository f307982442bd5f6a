//! Rational transfer functions in s \[rad/s\], and Eq. (6), the nominal plant.

use crate::error::PlantError;
use crate::roots;
use cellpos_numeric::units::{Decibels, Degrees, Hertz};
use nalgebra::Complex;
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;

/// The largest degree of a plant's denominator.
pub const MAX_ORDER: usize = 12;

/// A rational transfer function with real coefficients, from PZT displacement \[um\] to bead position \[um\].
///
/// Coefficients run from the highest power of s \[rad/s\] down. The numerator's degree is at most the denominator's: a
/// static gain, a strictly proper and a biproper function are all allowed.
///
/// ```
/// use cellpos_plant::{Hertz, TransferFunction};
/// let g = TransferFunction::eq6();
/// assert!((g.gain_db(Hertz(10.0)).value() - 16.26).abs() < 0.01);
/// assert!((g.phase_deg(Hertz(10.0)).value() + 93.30).abs() < 0.02);
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Coefficients", into = "Coefficients")]
pub struct TransferFunction {
    num: Vec<f64>,
    den: Vec<f64>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Coefficients {
    num: Vec<f64>,
    den: Vec<f64>,
}

impl TryFrom<Coefficients> for TransferFunction {
    type Error = PlantError;
    fn try_from(c: Coefficients) -> Result<Self, PlantError> {
        Self::new(c.num, c.den)
    }
}

impl From<TransferFunction> for Coefficients {
    fn from(g: TransferFunction) -> Self {
        Self {
            num: g.num,
            den: g.den,
        }
    }
}

impl TransferFunction {
    /// A transfer function from its coefficients, highest power of s \[rad/s\] first. Leading zeros are dropped.
    ///
    /// # Errors
    /// Coefficients that are not finite, a denominator or numerator of zeros only (such a plant cannot be moved), a
    /// numerator of higher degree than the denominator, and more than [`MAX_ORDER`] poles.
    pub fn new(num: Vec<f64>, den: Vec<f64>) -> Result<Self, PlantError> {
        let num = trimmed("num", num)?;
        let den = trimmed("den", den)?;
        if num.len() > den.len() {
            return Err(PlantError::Improper {
                num: num.len() - 1,
                den: den.len() - 1,
            });
        }
        if den.len() - 1 > MAX_ORDER {
            return Err(PlantError::TooManyPoles {
                degree: den.len() - 1,
                max: MAX_ORDER,
            });
        }
        Ok(Self { num, den })
    }

    /// Eq. (6): `0.01872 (s^2 + 20261.5 s + 1745041) / (s^2 + 76.3 s + 0.13)`, the nominal plant.
    pub fn eq6() -> Self {
        let alpha = 0.01872;
        Self {
            num: vec![alpha, alpha * 20261.5, alpha * 1_745_041.0],
            den: vec![1.0, 76.3, 0.13],
        }
    }

    /// The integrator `K/s` with the velocity gain K \[1/s\]: 1 um of displacement moves the bead at K um/s.
    ///
    /// # Errors
    /// A gain that is zero or not finite.
    pub fn integrator(velocity_gain_per_s: f64) -> Result<Self, PlantError> {
        Self::new(vec![velocity_gain_per_s], vec![1.0, 0.0])
    }

    /// Numerator, highest power of s \[rad/s\] first.
    pub fn num(&self) -> &[f64] {
        &self.num
    }

    /// Denominator, highest power of s \[rad/s\] first.
    pub fn den(&self) -> &[f64] {
        &self.den
    }

    /// Number of poles.
    pub fn order(&self) -> usize {
        self.den.len() - 1
    }

    /// Number of poles minus number of zeros; 0 for a biproper function.
    pub fn relative_degree(&self) -> usize {
        self.den.len() - self.num.len()
    }

    /// The same function with its gain multiplied.
    ///
    /// # Errors
    /// A factor that is zero or not finite.
    pub fn scaled(&self, factor: f64) -> Result<Self, PlantError> {
        Self::new(
            self.num.iter().map(|c| c * factor).collect(),
            self.den.clone(),
        )
    }

    /// The series connection of two functions.
    ///
    /// # Errors
    /// More than [`MAX_ORDER`] poles in all, or an overflow.
    pub fn series(&self, other: &Self) -> Result<Self, PlantError> {
        Self::new(
            roots::multiply(&self.num, &other.num),
            roots::multiply(&self.den, &other.den),
        )
    }

    /// The value at a complex frequency s \[rad/s\].
    pub fn at(&self, s: Complex<f64>) -> Complex<f64> {
        roots::evaluate(&self.num, s) / roots::evaluate(&self.den, s)
    }

    /// The frequency response at a frequency, um of bead per um of displacement (Eq. (A9) in general form).
    pub fn response(&self, frequency: Hertz) -> Complex<f64> {
        self.at(Complex::new(0.0, TAU * frequency.value()))
    }

    /// The gain at a frequency.
    pub fn gain_db(&self, frequency: Hertz) -> Decibels {
        Decibels(20.0 * self.response(frequency).norm().log10())
    }

    /// The phase at a frequency, in -180..180 deg.
    pub fn phase_deg(&self, frequency: Hertz) -> Degrees {
        Degrees(self.response(frequency).arg().to_degrees())
    }

    /// The poles \[rad/s\], by magnitude. Complex ones come in exact conjugate pairs.
    pub fn poles(&self) -> Vec<Complex<f64>> {
        roots::roots(&self.den)
    }

    /// The zeros \[rad/s\], by magnitude. Complex ones come in exact conjugate pairs.
    pub fn zeros(&self) -> Vec<Complex<f64>> {
        roots::roots(&self.num)
    }

    /// `w |G(jw)|` at a frequency: the velocity gain K \[1/s\] of the integrator that has the same gain there.
    pub fn velocity_gain_at(&self, frequency: Hertz) -> f64 {
        TAU * frequency.value() * self.response(frequency).norm()
    }
}

fn trimmed(which: &'static str, coefficients: Vec<f64>) -> Result<Vec<f64>, PlantError> {
    for (index, &value) in coefficients.iter().enumerate() {
        if !value.is_finite() {
            return Err(PlantError::NotFinite {
                which,
                index,
                value,
            });
        }
    }
    match coefficients.iter().position(|&c| c != 0.0) {
        None => Err(PlantError::Empty { which }),
        Some(first) => Ok(coefficients[first..].to_vec()),
    }
}

/// Eq. (5) as printed, `63/s`, taken literally: 16 dB below the plant that it describes. Kept to show the difference.
pub const EQ5_LITERAL_PER_S: f64 = 63.0;

/// Eq. (5) as meant: 63 is |G| at 1 Hz, so the plant is 63/f with f in Hz, that is `2 pi 63 / s` = 396/s.
pub const EQ5_VELOCITY_GAIN_PER_S: f64 = TAU * 63.0;

/// A velocity gain that is probably Eq. (5)'s 63 taken literally: the value, and the probably intended one.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error(
    "a velocity gain of {given_per_s}/s is within {percent:.1} % of 63, the number printed in Eq. (5): that is the gain at 1 Hz, 63/f with f in Hz; with s in rad/s the plant is 2 pi 63 / s = {meant_per_s:.0}/s. A controller designed on 63/s has 6.3 times too much loop gain"
)]
pub struct ProbablyPerHertz {
    /// The gain as given, 1/s.
    pub given_per_s: f64,
    /// The gain probably meant, 2 pi times as large, 1/s.
    pub meant_per_s: f64,
    /// How far the given gain is from 63, percent.
    pub percent: f64,
}

/// Recognises a velocity gain K \[1/s\] within 5 % of 63 as Eq. (5) taken literally.
///
/// ```
/// let hint = cellpos_plant::probably_per_hertz(63.0).unwrap();
/// assert_eq!(hint.meant_per_s.round(), 396.0);
/// assert!(cellpos_plant::probably_per_hertz(396.0).is_none());
/// ```
pub fn probably_per_hertz(velocity_gain_per_s: f64) -> Option<ProbablyPerHertz> {
    let percent = 100.0 * (velocity_gain_per_s.abs() / EQ5_LITERAL_PER_S - 1.0).abs();
    (percent <= 5.0).then_some(ProbablyPerHertz {
        given_per_s: velocity_gain_per_s,
        meant_per_s: TAU * velocity_gain_per_s,
        percent,
    })
}
