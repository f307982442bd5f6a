//! The paper's mechanical model, Eq. (1)-(3), and the coefficients of Eq. (4) that follow from it.
//!
//! Tests check Eq. (4) against a numeric solution of (1)-(3). (A9) and (A10) are corrected here: the printed (A10) has
//! `(2 z^2 w)^2` instead of `(2 z w)^2`, an error of 24.8 dB at 10 Hz.

use cellpos_plant::{Complex, Hertz, PlantError, TransferFunction};
use std::f64::consts::TAU;

/// The parameters of Eq. (1)-(3), in SI units.
///
/// (1) `A1 x1 = Ac xc + A2 x2`, (2) `p Ac = M xc'' + c xc' + k xc`, (3) `p A2 = m x2'' + c2 x2' + k2 x2`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PhysicalParameters {
    /// A1, cross-section of the syringe that the PZT pushes, m^2.
    pub(crate) a1_m2: f64,
    /// A2, cross-section of the microchannel, m^2.
    pub(crate) a2_m2: f64,
    /// Ac, cross-section of the virtual piston that represents the compliant walls, m^2.
    pub(crate) ac_m2: f64,
    /// M, mass of the virtual piston, kg.
    pub(crate) wall_mass_kg: f64,
    /// c, its damping, N s/m.
    pub(crate) wall_damping_n_s_per_m: f64,
    /// k, its stiffness, N/m.
    pub(crate) wall_stiffness_n_per_m: f64,
    /// m, mass of the fluid in the channel, kg.
    pub(crate) fluid_mass_kg: f64,
    /// c2, viscous resistance of the channel, N s/m.
    pub(crate) channel_damping_n_s_per_m: f64,
    /// k2, stiffness at the channel's outlet, N/m.
    pub(crate) outlet_stiffness_n_per_m: f64,
}

/// The coefficients of Eq. (4): `alpha (s^2 + 2 z1 w1 s + w1^2) / (s^2 + 2 z2 w2 s + w2^2)`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct SecondOrder {
    /// alpha, um/um.
    pub(crate) alpha: f64,
    /// zeta 1, damping ratio of the zeros.
    pub(crate) zeta1: f64,
    /// omega 1, rad/s.
    pub(crate) omega1_rad_per_s: f64,
    /// zeta 2, damping ratio of the poles.
    pub(crate) zeta2: f64,
    /// omega 2, rad/s.
    pub(crate) omega2_rad_per_s: f64,
}

/// Why the five coefficients of Eq. (4) do not determine the nine parameters of Eq. (1)-(3).
///
/// Only four ratios follow from a measured transfer function. Three changes leave Eq. (4) the same: a common factor on
/// all forces (M, c, k, m, c2, k2), a change of Ac with m, c2, k2 that keeps `(Ac/A2)^2 (m, c2, k2)`, and a common
/// factor on A1 and A2.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub(crate) enum NotIdentifiable {
    /// The gain alpha is larger than the geometry allows: the fluid's mass would have to be negative.
    #[error(
        "alpha = {alpha} is larger than A1/A2 = {area_ratio}: by Eq. (A6) the fluid's mass would be negative; check the two cross-sections"
    )]
    NegativeMass {
        /// alpha, um/um.
        alpha: f64,
        /// A1/A2.
        area_ratio: f64,
    },
    /// The static gain is larger than the geometry allows: the outlet's stiffness would have to be negative.
    #[error(
        "the static gain alpha w1^2/w2^2 = {static_gain} is larger than A1/A2 = {area_ratio}: by Eq. (A5) the outlet's stiffness would be negative; the slow pole is not identifiable from 2..300 Hz and may be wrong"
    )]
    NegativeOutletStiffness {
        /// alpha w1^2 / w2^2.
        static_gain: f64,
        /// A1/A2.
        area_ratio: f64,
    },
    /// The channel's resistance would have to be negative.
    #[error("the coefficients give the channel a negative resistance c2")]
    NegativeDamping,
    /// A given area or mass is not positive.
    #[error("{name} = {value} {unit}: it must be positive and finite")]
    NotPositive {
        /// The quantity.
        name: &'static str,
        /// Its value.
        value: f64,
        /// Its unit.
        unit: &'static str,
    },
}

impl PhysicalParameters {
    /// `r = (Ac/A2)^2`.
    pub(crate) fn area_ratio_squared(&self) -> f64 {
        (self.ac_m2 / self.a2_m2).powi(2)
    }

    /// Eq. (4): the coefficients that follow from (1)-(3).
    pub(crate) fn second_order(&self) -> SecondOrder {
        let r = self.area_ratio_squared();
        let (mass, stiffness) = (
            self.wall_mass_kg + r * self.fluid_mass_kg,
            self.wall_stiffness_n_per_m + r * self.outlet_stiffness_n_per_m,
        );
        let wall = self.wall_mass_kg * self.wall_stiffness_n_per_m;
        SecondOrder {
            alpha: self.a1_m2 * self.wall_mass_kg / (self.a2_m2 * mass),
            zeta1: self.wall_damping_n_s_per_m / (2.0 * wall.sqrt()),
            omega1_rad_per_s: (self.wall_stiffness_n_per_m / self.wall_mass_kg).sqrt(),
            zeta2: (self.wall_damping_n_s_per_m + r * self.channel_damping_n_s_per_m)
                / (2.0 * (mass * stiffness).sqrt()),
            omega2_rad_per_s: (stiffness / mass).sqrt(),
        }
    }

    /// Eq. (A4), the transfer function without damping ratios, which do not exist for k2 = k = 0.
    ///
    /// # Errors
    /// Parameters that make no plant, for example a wall without mass, damping and stiffness.
    pub(crate) fn transfer_function(&self) -> Result<TransferFunction, PlantError> {
        let r = self.area_ratio_squared();
        let gain = self.a1_m2 / self.a2_m2;
        TransferFunction::new(
            vec![
                gain * self.wall_mass_kg,
                gain * self.wall_damping_n_s_per_m,
                gain * self.wall_stiffness_n_per_m,
            ],
            vec![
                self.wall_mass_kg + r * self.fluid_mass_kg,
                self.wall_damping_n_s_per_m + r * self.channel_damping_n_s_per_m,
                self.wall_stiffness_n_per_m + r * self.outlet_stiffness_n_per_m,
            ],
        )
    }

    /// Eq. (A5): the gain towards zero frequency, `(A1/A2) k / (k + r k2)`.
    pub(crate) fn low_frequency_limit(&self) -> f64 {
        let r = self.area_ratio_squared();
        self.a1_m2 / self.a2_m2 * self.wall_stiffness_n_per_m
            / (self.wall_stiffness_n_per_m + r * self.outlet_stiffness_n_per_m)
    }

    /// Eq. (A6): the gain towards infinite frequency, `(A1/A2) M / (M + r m)`.
    pub(crate) fn high_frequency_limit(&self) -> f64 {
        let r = self.area_ratio_squared();
        self.a1_m2 / self.a2_m2 * self.wall_mass_kg / (self.wall_mass_kg + r * self.fluid_mass_kg)
    }

    /// A numeric solution of Eq. (1)-(3) at a frequency: X2/X1 from the three linear equations in Xc, X2 and p,
    /// without Eq. (4). `None` if they are singular.
    pub(crate) fn solve(&self, frequency: Hertz) -> Option<Complex<f64>> {
        let s = Complex::new(0.0, TAU * frequency.value());
        let wall = s * s * self.wall_mass_kg
            + s * self.wall_damping_n_s_per_m
            + self.wall_stiffness_n_per_m;
        let channel = s * s * self.fluid_mass_kg
            + s * self.channel_damping_n_s_per_m
            + self.outlet_stiffness_n_per_m;
        let real = |v: f64| Complex::new(v, 0.0);
        // The unknowns are volumes (Ac Xc and A2 X2), so that the rows have one order of magnitude.
        let compliance_wall = wall / (self.ac_m2 * self.ac_m2);
        let compliance_channel = channel / (self.a2_m2 * self.a2_m2);
        let scale = compliance_wall.norm().max(compliance_channel.norm());
        if scale == 0.0 {
            return None;
        }
        let matrix = nalgebra::Matrix3::new(
            real(1.0),
            real(1.0),
            real(0.0),
            -compliance_wall / scale,
            real(0.0),
            real(1.0),
            real(0.0),
            -compliance_channel / scale,
            real(1.0),
        );
        let right = nalgebra::Vector3::new(real(self.a1_m2), real(0.0), real(0.0));
        let solution = matrix.lu().solve(&right)?;
        Some(solution[1] / self.a2_m2)
    }

    /// The parameters that produce these coefficients, for a given geometry and wall mass. The five coefficients do not
    /// determine A1, A2, Ac and one force scale (here M): see [`NotIdentifiable`].
    ///
    /// # Errors
    /// Areas or a mass that are not positive, and coefficients that no passive rig of this geometry has.
    pub(crate) fn from_second_order(
        coefficients: &SecondOrder,
        a1_m2: f64,
        a2_m2: f64,
        ac_m2: f64,
        wall_mass_kg: f64,
    ) -> Result<Self, NotIdentifiable> {
        for (name, value, unit) in [
            ("A1", a1_m2, "m^2"),
            ("A2", a2_m2, "m^2"),
            ("Ac", ac_m2, "m^2"),
            ("M", wall_mass_kg, "kg"),
            ("alpha", coefficients.alpha, "um/um"),
            ("omega 1", coefficients.omega1_rad_per_s, "rad/s"),
            ("omega 2", coefficients.omega2_rad_per_s, "rad/s"),
        ] {
            if !(value.is_finite() && value > 0.0) {
                return Err(NotIdentifiable::NotPositive { name, value, unit });
            }
        }
        let c = coefficients;
        let area_ratio = a1_m2 / a2_m2;
        let r = (ac_m2 / a2_m2).powi(2);
        // Rounding may make a difference slightly negative if the true value is zero.
        let slack = |difference: f64, of: f64| {
            if difference.abs() < 1e-12 * of.abs() {
                0.0
            } else {
                difference
            }
        };
        let mass = area_ratio * wall_mass_kg / c.alpha;
        let fluid_mass = slack(mass - wall_mass_kg, mass) / r;
        if fluid_mass < 0.0 {
            return Err(NotIdentifiable::NegativeMass {
                alpha: c.alpha,
                area_ratio,
            });
        }
        let stiffness = wall_mass_kg * c.omega1_rad_per_s.powi(2);
        let total_stiffness = mass * c.omega2_rad_per_s.powi(2);
        let outlet = slack(total_stiffness - stiffness, total_stiffness) / r;
        if outlet < 0.0 {
            return Err(NotIdentifiable::NegativeOutletStiffness {
                static_gain: c.alpha * (c.omega1_rad_per_s / c.omega2_rad_per_s).powi(2),
                area_ratio,
            });
        }
        let damping = 2.0 * c.zeta1 * c.omega1_rad_per_s * wall_mass_kg;
        let total_damping = 2.0 * c.zeta2 * c.omega2_rad_per_s * mass;
        let channel = slack(total_damping - damping, total_damping) / r;
        if channel < 0.0 {
            return Err(NotIdentifiable::NegativeDamping);
        }
        Ok(Self {
            a1_m2,
            a2_m2,
            ac_m2,
            wall_mass_kg,
            wall_damping_n_s_per_m: damping,
            wall_stiffness_n_per_m: stiffness,
            fluid_mass_kg: fluid_mass,
            channel_damping_n_s_per_m: channel,
            outlet_stiffness_n_per_m: outlet,
        })
    }
}

impl SecondOrder {
    /// The coefficients that the paper lists with Eq. (6). They are rounded: `2 z1 w1` is 20343 (20261.5 in Eq. (6)),
    /// `2 z2 w2` is 75.46 (76.3 in Eq. (6)). Use [`TransferFunction::eq6`].
    pub(crate) const PAPER_ROUNDED: Self = Self {
        alpha: 0.01872,
        zeta1: 7.7,
        omega1_rad_per_s: 1321.0,
        zeta2: 104.8,
        omega2_rad_per_s: 0.36,
    };

    /// The coefficients of a second-order biproper transfer function; `None` for another shape, or if `w1` or `w2` is
    /// not real and positive.
    pub(crate) fn from_transfer_function(g: &TransferFunction) -> Option<Self> {
        let ([b2, b1, b0], [a2, a1, a0]) = (g.num(), g.den()) else {
            return None;
        };
        let (w1, w2) = ((b0 / b2).sqrt(), (a0 / a2).sqrt());
        if !(w1 > 0.0 && w2 > 0.0) {
            return None;
        }
        Some(Self {
            alpha: b2 / a2,
            zeta1: b1 / b2 / (2.0 * w1),
            omega1_rad_per_s: w1,
            zeta2: a1 / a2 / (2.0 * w2),
            omega2_rad_per_s: w2,
        })
    }

    /// Eq. (4) as a transfer function.
    ///
    /// # Errors
    /// Coefficients that are not finite, or alpha zero.
    pub(crate) fn transfer_function(&self) -> Result<TransferFunction, PlantError> {
        let (w1, w2) = (self.omega1_rad_per_s, self.omega2_rad_per_s);
        TransferFunction::new(
            vec![
                self.alpha,
                self.alpha * 2.0 * self.zeta1 * w1,
                self.alpha * w1 * w1,
            ],
            vec![1.0, 2.0 * self.zeta2 * w2, w2 * w2],
        )
    }

    /// Eq. (A10), corrected: `|G|` at a frequency, with `(2 z w)^2` in the middle terms.
    pub(crate) fn gain(&self, frequency: Hertz) -> f64 {
        let w2 = (TAU * frequency.value()).powi(2);
        let term = |zeta: f64, omega: f64| {
            w2 * w2 + ((2.0 * zeta * omega).powi(2) - 2.0 * omega * omega) * w2 + omega.powi(4)
        };
        self.alpha
            * (term(self.zeta1, self.omega1_rad_per_s) / term(self.zeta2, self.omega2_rad_per_s))
                .sqrt()
    }
}
