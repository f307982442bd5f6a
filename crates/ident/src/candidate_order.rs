//! The candidate models, their parameter vectors, and the result of a fit.

use crate::candidate_model::CandidateModel;
use nalgebra::DMatrix;

/// A candidate model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum CandidateOrder {
    /// `K e^(-sL)/s`: gain and delay.
    Integrator,
    /// With a pole-zero pair.
    PoleZeroPair,
    /// With two lags instead of the pair: a regulator and a tube that stretches. No far zero: such a plant never responds at
    /// once.
    TwoLags,
    /// With two lags and a zero.
    TwoLagsZero,
    /// With the pair and the far zero (a feedthrough).
    FarZero,
    /// All of Eq. (4): with the slow pole too.
    Eq4,
}

impl CandidateOrder {
    /// All orders, lowest first.
    pub const ALL: [CandidateOrder; 6] = [
        CandidateOrder::Integrator,
        CandidateOrder::PoleZeroPair,
        CandidateOrder::TwoLags,
        CandidateOrder::TwoLagsZero,
        CandidateOrder::FarZero,
        CandidateOrder::Eq4,
    ];

    /// Real parameters.
    pub fn parameters(self) -> usize {
        match self {
            CandidateOrder::Integrator => 2,
            CandidateOrder::PoleZeroPair | CandidateOrder::TwoLags => 4,
            CandidateOrder::TwoLagsZero => 5,
            CandidateOrder::FarZero => 6,
            CandidateOrder::Eq4 => 7,
        }
    }

    /// The order that this one extends by parameters.
    pub fn below(self) -> Option<Self> {
        match self {
            CandidateOrder::Integrator => None,
            CandidateOrder::PoleZeroPair | CandidateOrder::TwoLags => {
                Some(CandidateOrder::Integrator)
            }
            CandidateOrder::TwoLagsZero => Some(CandidateOrder::TwoLags),
            CandidateOrder::FarZero => Some(CandidateOrder::PoleZeroPair),
            CandidateOrder::Eq4 => Some(CandidateOrder::FarZero),
        }
    }

    /// Whether it has two lags.
    pub fn two_lags(self) -> bool {
        matches!(self, CandidateOrder::TwoLags | CandidateOrder::TwoLagsZero)
    }

    /// The model as a formula.
    pub fn formula(self) -> &'static str {
        match self {
            CandidateOrder::Integrator => "K e^(-sL)/s",
            CandidateOrder::PoleZeroPair => "K (1 + s/z)/(s (1 + s/p)) e^(-sL)",
            CandidateOrder::TwoLags => "K/(s (1 + s/p)(1 + s/r)) e^(-sL)",
            CandidateOrder::TwoLagsZero => "K (1 + s/z)/(s (1 + s/p)(1 + s/r)) e^(-sL)",
            CandidateOrder::FarZero => "K (1 + s/z)(1 + s/f)/(s (1 + s/p)) e^(-sL)",
            CandidateOrder::Eq4 => "K (1 + s/z)(1 + s/f)/((s + q)(1 + s/p)) e^(-sL), Eq. (4)",
        }
    }
}

/// Index of each parameter in a parameter vector: `ln K`, effective delay (ms), `ln z`, `ln p`, far lead (ms),
/// share of the feedthrough one row later, slow pole (rad/s). With two lags: `ln K`, effective delay (ms), `ln r`, `ln p`, `ln z`.
pub mod index {
    /// `ln` of the integrator gain in 1/s.
    pub const LN_GAIN: usize = 0;
    /// Delay minus the far zero's lead, ms.
    pub const EFFECTIVE_DELAY_MS: usize = 1;
    /// `ln` of the pair's zero in rad/s.
    pub const LN_ZERO: usize = 2;
    /// `ln` of the pair's pole in rad/s.
    pub const LN_POLE: usize = 3;
    /// `ln` of the second lag's pole in rad/s.
    pub const LN_SECOND_POLE: usize = 2;
    /// `ln` of the zero in rad/s of the order with two lags.
    pub const LN_ZERO_OF_LAGS: usize = 4;
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
    /// Half of its 95 % interval, s: not 1.96 standard deviations if its error is not normal.
    pub half95_s: f64,
    /// Most by which what was measured otherwise may differ from the delay of the record besides, s.
    pub not_accounted_s: f64,
}

/// One order fitted.
#[derive(Debug, Clone, PartialEq)]
pub struct CandidateFit {
    /// Which model.
    pub order: CandidateOrder,
    /// The fitted model.
    pub model: CandidateModel,
    /// The parameter vector, see [`index`].
    pub parameters: Vec<f64>,
    /// Covariance of the parameter vector, already multiplied by `scale`.
    pub covariance: DMatrix<f64>,
    /// Weighted sum of squares; for a correct model about the degrees of freedom.
    pub chi2: f64,
    /// Real data less parameters.
    pub dof: f64,
    /// Corrected Akaike criterion, lower is better.
    pub aicc: f64,
    /// Weighted sum of squares per real datum on blocks that the fit has not seen; for a correct model about 1 plus the fit's own
    /// share.
    pub held_out: f64,
    /// Probability that chance explains the improvement over the order below (1 for the lowest).
    pub step_p_value: f64,
    /// Whether the iteration converged.
    pub converged: bool,
}

/// The candidates fitted, and the order that was chosen.
#[derive(Debug, Clone, PartialEq)]
pub struct CandidateFits {
    /// Every order that the number of points allows, lowest first.
    pub candidates: Vec<CandidateFit>,
    /// Index of the chosen order in `orders`.
    pub chosen: usize,
    /// Factor on variances because residuals exceed the noise (else 1).
    pub scale: f64,
    /// Degrees of freedom for intervals.
    pub interval_dof: f64,
}

impl CandidateFits {
    /// The chosen order.
    pub fn best(&self) -> &CandidateFit {
        &self.candidates[self.chosen]
    }
}

/// The model of a parameter vector.
pub fn model_of(x: &[f64], order: CandidateOrder) -> CandidateModel {
    let mut model =
        CandidateModel::integrator(x[index::LN_GAIN].exp(), x[index::EFFECTIVE_DELAY_MS] * 1e-3);
    if order.two_lags() {
        model.second_pole_rad_per_s = Some(x[index::LN_SECOND_POLE].exp());
        model.pole_rad_per_s = x[index::LN_POLE].exp();
        let zero = x.get(index::LN_ZERO_OF_LAGS);
        model.zero_rad_per_s = zero.map_or(f64::INFINITY, |ln| ln.exp());
        return model;
    }
    if order >= CandidateOrder::PoleZeroPair {
        model.zero_rad_per_s = x[index::LN_ZERO].exp();
        model.pole_rad_per_s = x[index::LN_POLE].exp();
    }
    if order >= CandidateOrder::FarZero {
        model.far_lead_s = x[index::FAR_LEAD_MS] * 1e-3;
        model.delay_s += model.far_lead_s;
        model.feedthrough_share = Some(x[index::FEEDTHROUGH_SHARE]);
    }
    if order >= CandidateOrder::Eq4 {
        model.slow_pole_rad_per_s = x[index::SLOW_POLE];
    }
    model
}
