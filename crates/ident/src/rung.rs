//! The models of the ladder, their parameter vectors, and what a fit of them gives.

use crate::ladder_model::LadderModel;
use nalgebra::DMatrix;

/// A model of the ladder.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Rung {
    /// `K e^(-sL)/s`: gain and delay.
    Integrator,
    /// With a pole-zero pair.
    PoleZeroPair,
    /// With the pair and the far zero (a feedthrough).
    FarZero,
    /// All of Eq. (4): with the slow pole too.
    Eq4,
}

impl Rung {
    /// All rungs, lowest first.
    pub const ALL: [Rung; 4] = [
        Rung::Integrator,
        Rung::PoleZeroPair,
        Rung::FarZero,
        Rung::Eq4,
    ];

    /// Real parameters.
    pub fn parameters(self) -> usize {
        match self {
            Rung::Integrator => 2,
            Rung::PoleZeroPair => 4,
            Rung::FarZero => 6,
            Rung::Eq4 => 7,
        }
    }

    /// The model as a formula.
    pub fn formula(self) -> &'static str {
        match self {
            Rung::Integrator => "K e^(-sL)/s",
            Rung::PoleZeroPair => "K (1 + s/z)/(s (1 + s/p)) e^(-sL)",
            Rung::FarZero => "K (1 + s/z)(1 + s/f)/(s (1 + s/p)) e^(-sL)",
            Rung::Eq4 => "K (1 + s/z)(1 + s/f)/((s + q)(1 + s/p)) e^(-sL), Eq. (4)",
        }
    }
}

/// Index of each parameter in a parameter vector: `ln K`, effective delay (ms), `ln z`, `ln p`, far lead (ms),
/// share of the feedthrough one row later, slow pole (rad/s).
pub mod index {
    /// `ln` of the integrator gain in 1/s.
    pub const LN_GAIN: usize = 0;
    /// Delay less the far zero's lead, ms.
    pub const EFFECTIVE_DELAY_MS: usize = 1;
    /// `ln` of the pair's zero in rad/s.
    pub const LN_ZERO: usize = 2;
    /// `ln` of the pair's pole in rad/s.
    pub const LN_POLE: usize = 3;
    /// Lead of the far zero, ms.
    pub const FAR_LEAD_MS: usize = 4;
    /// Share of the feedthrough that shows one row later (a nuisance, see the model).
    pub const FEEDTHROUGH_SHARE: usize = 5;
    /// Slow pole, rad/s.
    pub const SLOW_POLE: usize = 6;
}

/// A delay measured otherwise (an LED test), used as a further datum.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DelayPrior {
    /// Measured delay from the command to the middle of the exposure, s.
    pub delay_s: f64,
    /// Its standard deviation, s.
    pub sd_s: f64,
    /// Half of its 95 % interval, s: not 1.96 standard deviations where its error is not normal.
    pub half95_s: f64,
}

/// One rung fitted.
#[derive(Debug, Clone, PartialEq)]
pub struct RungFit {
    /// Which model.
    pub rung: Rung,
    /// The fitted model.
    pub model: LadderModel,
    /// The parameter vector, see [`index`].
    pub parameters: Vec<f64>,
    /// Covariance of the parameter vector, already multiplied by `scale`.
    pub covariance: DMatrix<f64>,
    /// Weighted sum of squares (about the degrees of freedom for a right model).
    pub chi2: f64,
    /// Real data less parameters.
    pub dof: f64,
    /// Corrected Akaike criterion, lower is better.
    pub aicc: f64,
    /// Weighted sum of squares per real datum on blocks that the fit has not seen; about 1 plus the fit's own share
    /// for a right model.
    pub held_out: f64,
    /// Probability that the step from the rung below is by chance (1 for the lowest).
    pub step_p_value: f64,
    /// Whether the iteration converged.
    pub converged: bool,
}

/// The ladder fitted and a rung chosen.
#[derive(Debug, Clone, PartialEq)]
pub struct LadderFit {
    /// Every rung that the number of points allows, lowest first.
    pub rungs: Vec<RungFit>,
    /// Index of the chosen rung in `rungs`.
    pub chosen: usize,
    /// Factor on variances because residuals exceed the noise (1 where they do not).
    pub scale: f64,
    /// Degrees of freedom for intervals.
    pub interval_dof: f64,
}

impl LadderFit {
    /// The chosen rung.
    pub fn best(&self) -> &RungFit {
        &self.rungs[self.chosen]
    }
}

/// The model that a parameter vector stands for.
pub fn model_of(x: &[f64], rung: Rung) -> LadderModel {
    let mut model =
        LadderModel::integrator(x[index::LN_GAIN].exp(), x[index::EFFECTIVE_DELAY_MS] * 1e-3);
    if rung >= Rung::PoleZeroPair {
        model.zero_rad_per_s = x[index::LN_ZERO].exp();
        model.pole_rad_per_s = x[index::LN_POLE].exp();
    }
    if rung >= Rung::FarZero {
        model.far_lead_s = x[index::FAR_LEAD_MS] * 1e-3;
        model.delay_s += model.far_lead_s;
        model.feedthrough_share = Some(x[index::FEEDTHROUGH_SHARE]);
    }
    if rung >= Rung::Eq4 {
        model.slow_pole_rad_per_s = x[index::SLOW_POLE];
    }
    model
}
