//! Fit of the model ladder to a frequency response, and the choice of the rung that the data support.
//!
//! Complex, weighted least squares on what the record shows (hold, delay and exposure inside the model, not taken off
//! the data). Rungs: integrator with delay; with a pole-zero pair; with the far zero; full Eq. (4). A higher rung is
//! taken only when an F-test rejects the lower one (1 %), AICc falls, and the fit to one half of the blocks predicts
//! the other half better. What a parameter is worth is told by [`crate::verdict`].

use nalgebra::{Complex, DMatrix};

use crate::error::IdentError;
use crate::frequency_response::FrequencyPoint;
use crate::ladder_model::LadderModel;
use crate::least_squares::{Minimum, covariance, minimise};
use crate::sampled::Sampling;
use crate::stats::f_exceeds;

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

/// What the ladder is fitted to.
#[derive(Debug, Clone)]
pub struct LadderProblem<'a> {
    points: &'a [FrequencyPoint],
    sampling: Sampling,
    prior: Option<DelayPrior>,
    weights: Vec<f64>,
    /// By how much the two weak bounds (share, lead) are moved, in their standard deviations.
    bounds_moved: [f64; 2],
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

/// Finite-difference steps of the parameter vector.
const STEPS: [f64; 7] = [1e-5, 1e-5, 1e-4, 1e-4, 1e-5, 1e-4, 1e-4];

/// What is known of the far zero's lead before any fit: about zero, to this part of a sampling period. A lead of a
/// period or more would be a second delay.
const LEAD_SD_PERIODS: f64 = 0.3;

/// What is known of the feedthrough's share one row later: between 0 and 1.
const SHARE_MIDDLE_SD: (f64, f64) = (0.5, 0.5);

impl<'a> LadderProblem<'a> {
    /// A problem from points with variances.
    ///
    /// # Errors
    /// [`IdentError::TooFewPoints`] below two points, [`IdentError::OutOfRange`] for a variance that is not positive.
    pub fn new(
        points: &'a [FrequencyPoint],
        sampling: Sampling,
        prior: Option<DelayPrior>,
    ) -> Result<Self, IdentError> {
        if points.len() < 2 {
            return Err(IdentError::TooFewPoints {
                points: points.len(),
                parameters: 2,
                needed: 2,
            });
        }
        let bad = points
            .iter()
            .map(|p| p.variance)
            .find(|v| !(v.is_finite() && *v > 0.0));
        if let Some(value) = bad {
            return Err(IdentError::OutOfRange {
                key: "variance",
                value,
                unit: "1",
                expected: "a positive variance per point (record at least two periods, with noise)",
            });
        }
        let weights = points.iter().map(|p| (2.0 / p.variance).sqrt()).collect();
        Ok(Self {
            points,
            sampling,
            prior,
            weights,
            bounds_moved: [0.0; 2],
        })
    }

    fn rows(&self) -> usize {
        2 * self.points.len() + 3
    }

    fn residuals(&self, data: &[Complex<f64>], model: &LadderModel, out: &mut [f64]) {
        let sampler = model.sampler(self.sampling);
        for (i, (p, y)) in self.points.iter().zip(data).enumerate() {
            let e = (y - sampler.response(p.frequency_hz)) * self.weights[i];
            out[2 * i] = e.re;
            out[2 * i + 1] = e.im;
        }
        let last = 2 * self.points.len();
        out[last] = self
            .prior
            .map_or(0.0, |prior| (model.delay_s - prior.delay_s) / prior.sd_s);
        // Behind a hold the lead trades exactly with the delay, and the share with the lead: without these two weak
        // bounds the directions would be open.
        let (middle, sd) = SHARE_MIDDLE_SD;
        let [share_moved, lead_moved] = self.bounds_moved;
        (out[last + 1], out[last + 2]) = match model.feedthrough_share {
            Some(share) => (
                (share - middle) / sd - share_moved,
                model.far_lead_s / (LEAD_SD_PERIODS * self.sampling.period_s) - lead_moved,
            ),
            None => (0.0, 0.0),
        };
    }

    /// Weighted sum of squares of `data` about `model`, without the delay prior.
    pub fn chi2(&self, data: &[Complex<f64>], model: &LadderModel) -> f64 {
        let mut out = vec![0.0; self.rows()];
        self.residuals(data, model, &mut out);
        out[..2 * self.points.len()].iter().map(|r| r * r).sum()
    }

    /// The same problem with another delay prior.
    pub fn with_prior(mut self, prior: Option<DelayPrior>) -> Self {
        self.prior = prior;
        self
    }

    /// The same problem with the weak bounds on the feedthrough's share and on the far zero's lead moved, in their
    /// standard deviations: what is known beforehand is uncertain too, and a replicate of the fit draws it anew.
    pub fn with_bounds_moved(mut self, share_and_lead: [f64; 2]) -> Self {
        self.bounds_moved = share_and_lead;
        self
    }

    /// The points fitted.
    pub fn points(&self) -> &[FrequencyPoint] {
        self.points
    }

    /// How the record was sampled.
    pub fn sampling(&self) -> Sampling {
        self.sampling
    }

    /// The measured responses.
    pub fn data(&self) -> Vec<Complex<f64>> {
        self.points.iter().map(|p| p.response).collect()
    }

    /// Fits `data` on `rung` from one start; parameters in `fixed` keep their value.
    pub fn fit_from(
        &self,
        data: &[Complex<f64>],
        rung: Rung,
        start: &[f64],
        fixed: Option<(usize, f64)>,
    ) -> Minimum {
        let n = rung.parameters();
        let free: Vec<usize> = (0..n)
            .filter(|&i| fixed.is_none_or(|(f, _)| f != i))
            .collect();
        let mut base = start[..n].to_vec();
        if let Some((i, value)) = fixed {
            base[i] = value;
        }
        let expand = |x: &[f64]| {
            let mut full = base.clone();
            for (&i, v) in free.iter().zip(x) {
                full[i] = *v;
            }
            full
        };
        let x0: Vec<f64> = free.iter().map(|&i| base[i]).collect();
        let steps: Vec<f64> = free.iter().map(|&i| STEPS[i]).collect();
        let mut found = minimise(&x0, &steps, self.rows(), |x, out| {
            self.residuals(data, &model_of(&expand(x), rung), out);
        });
        found.parameters = expand(&found.parameters);
        found
    }

    /// Gain and delay that start the iteration: the delay by a grid, since phase wraps.
    fn first_guess(&self, data: &[Complex<f64>]) -> [f64; 2] {
        let mut best = (f64::INFINITY, [0.0, 0.0]);
        let period_ms = self.sampling.period_s * 1e3;
        let fastest = self
            .points
            .iter()
            .map(|p| p.frequency_hz)
            .fold(0.0, f64::max);
        let step = (100.0 / fastest.max(1e-9)).min(period_ms);
        let mut delay_ms = -2.0 * period_ms;
        while delay_ms <= 20.0 * period_ms {
            let unit = LadderModel::integrator(1.0, delay_ms * 1e-3).partial_fractions();
            let (mut cross, mut power) = (0.0, 0.0);
            for ((p, y), w) in self.points.iter().zip(data).zip(&self.weights) {
                let h = unit.sampled_response(p.frequency_hz, delay_ms * 1e-3, self.sampling);
                // Relative weights with a ceiling: the start must not hang on one very precise line.
                let weight = (w * y.norm()).min(100.0) / y.norm();
                cross += weight * weight * (y * h.conj()).re;
                power += weight * weight * h.norm_sqr();
            }
            let cost = -cross * cross.abs() / power;
            if cross > 0.0 && cost < best.0 {
                best = (cost, [(cross / power).ln(), delay_ms]);
            }
            delay_ms += step;
        }
        best.1
    }

    /// The best fit of `rung` over several starts, the rung below included.
    fn fit_rung(
        &self,
        data: &[Complex<f64>],
        rung: Rung,
        below: Option<&[f64]>,
    ) -> Option<Minimum> {
        let [ln_gain, delay_ms] = self.first_guess(data);
        let mut starts: Vec<Vec<f64>> = Vec::new();
        let mut extend = |base: &[f64], tail: &[f64]| {
            let mut x = base.to_vec();
            x.extend_from_slice(tail);
            starts.push(x);
        };
        match (rung, below) {
            (Rung::Integrator, _) | (_, None) => {
                extend(&[ln_gain, delay_ms], &[0.0; 5][..rung.parameters() - 2])
            }
            (Rung::PoleZeroPair, Some(x)) => {
                let (low, high) = self.band_rad_per_s();
                for share in [0.2, 0.4, 0.6, 0.8] {
                    let centre = low.ln() + share * (high / low).ln();
                    for lead in [0.15, -0.15] {
                        extend(x, &[centre + lead, centre - lead]);
                    }
                }
            }
            (Rung::FarZero, Some(x)) => {
                // First with the lead held: where the delay crosses half a sample the feedthrough moves to another
                // row at once, and a long first step would cross into the wrong one.
                for share in [0.03, 0.1, 0.3] {
                    let lead_ms = share * self.sampling.period_s * 1e3;
                    let mut start = x.to_vec();
                    start.extend([lead_ms, 0.5]);
                    let held =
                        self.fit_from(data, rung, &start, Some((index::FAR_LEAD_MS, lead_ms)));
                    if held.parameters.iter().all(|v| v.is_finite()) {
                        extend(&held.parameters, &[]);
                    }
                }
            }
            (Rung::Eq4, Some(x)) => {
                for slow in [0.0, 0.5] {
                    extend(x, &[slow]);
                }
            }
        }
        let sane = |m: &Minimum| {
            m.chi2.is_finite()
                && m.parameters
                    .iter()
                    .chain(m.jacobian.iter())
                    .all(|v| v.is_finite())
        };
        let fits = starts
            .iter()
            .map(|s| self.fit_from(data, rung, s, None))
            .filter(sane);
        fits.min_by(|a, b| a.chi2.total_cmp(&b.chi2))
    }

    fn band_rad_per_s(&self) -> (f64, f64) {
        let hz = self.points.iter().map(|p| p.frequency_hz);
        let (low, high) = hz.fold((f64::INFINITY, 0.0f64), |(a, b), f| (a.min(f), b.max(f)));
        (
            2.0 * std::f64::consts::PI * low,
            2.0 * std::f64::consts::PI * high,
        )
    }

    /// Fits every rung that the points allow, lowest first.
    fn fit_rungs(&self, data: &[Complex<f64>]) -> Vec<(Rung, Minimum)> {
        let mut out: Vec<(Rung, Minimum)> = Vec::new();
        for rung in Rung::ALL {
            if 2 * self.points.len() <= rung.parameters() {
                break;
            }
            let below = out.last().map(|(_, m)| m.parameters.clone());
            let Some(found) = self.fit_rung(data, rung, below.as_deref()) else {
                break;
            };
            out.push((rung, found));
        }
        out
    }

    /// Weighted squares per datum of each rung on the half of the blocks that it has not seen (both ways, averaged).
    fn held_out(&self, full: &[(Rung, Minimum)]) -> Vec<f64> {
        let half = |parity: usize| -> Vec<Complex<f64>> {
            self.points
                .iter()
                .map(|p| {
                    let mine: Vec<_> = p.block_errors.iter().skip(parity).step_by(2).collect();
                    let count = mine.len().max(1) as f64;
                    p.response + mine.into_iter().sum::<Complex<f64>>() / count
                })
                .collect()
        };
        let (even, odd) = (half(0), half(1));
        let n = 2.0 * self.points.len() as f64;
        full.iter()
            .map(|(rung, m)| {
                [(&even, &odd), (&odd, &even)]
                    .iter()
                    .map(|(fit, test)| {
                        let found = self.fit_from(fit, *rung, &m.parameters, None);
                        // Half the blocks: twice the variance.
                        0.25 * self.chi2(test, &model_of(&found.parameters, *rung)) / n
                    })
                    .sum()
            })
            .collect()
    }

    /// Fits the ladder and chooses a rung.
    ///
    /// # Errors
    /// [`IdentError::NoFit`] when not even the integrator converges.
    pub fn fit(&self) -> Result<LadderFit, IdentError> {
        let data = self.data();
        let fits = self.fit_rungs(&data);
        let held_out = self.held_out(&fits);
        let n = 2.0 * self.points.len() as f64;
        let variance_dof = self
            .points
            .iter()
            .map(|p| p.variance_dof)
            .fold(f64::INFINITY, f64::min);
        let from_scatter = self
            .points
            .iter()
            .all(|p| p.variance_dof <= 2.0 * p.block_errors.len() as f64);
        let interval_dof = if from_scatter {
            self.points.iter().map(|p| p.variance_dof).sum()
        } else {
            variance_dof
        };
        // Weights that are themselves estimated from few blocks make intervals too short by this factor.
        let weight_noise = if from_scatter && variance_dof > 2.5 {
            variance_dof / (variance_dof - 2.0)
        } else {
            1.0
        };
        let best_reduced = fits
            .iter()
            .map(|(r, m)| m.chi2 / (n - r.parameters() as f64))
            .fold(f64::INFINITY, f64::min);
        let scale = best_reduced.max(1.0) * weight_noise;
        let mut rungs: Vec<RungFit> = Vec::new();
        for ((rung, m), held_out) in fits.into_iter().zip(held_out) {
            let k = rung.parameters() as f64;
            let step_p_value = rungs.last().map_or(1.0, |below| {
                let gained =
                    (below.chi2 - m.chi2).max(0.0) / (k - below.rung.parameters() as f64) / scale;
                f_exceeds(
                    gained,
                    k - below.rung.parameters() as f64,
                    interval_dof.min(1e4),
                )
            });
            let correction = if n - k - 1.0 > 0.0 {
                2.0 * k * (k + 1.0) / (n - k - 1.0)
            } else {
                f64::INFINITY
            };
            rungs.push(RungFit {
                rung,
                model: model_of(&m.parameters, rung),
                covariance: covariance(&m.jacobian) * scale,
                chi2: m.chi2,
                dof: n - k,
                aicc: m.chi2 / scale + 2.0 * k + correction,
                held_out,
                step_p_value,
                converged: m.converged,
                parameters: m.parameters,
            });
        }
        if !rungs.first().is_some_and(|r| r.converged) {
            return Err(IdentError::NoFit {
                what: "an integrator with delay",
                reason: "no start led to a minimum",
            });
        }
        let mut chosen = 0;
        for i in 1..rungs.len() {
            let (low, high) = (&rungs[chosen], &rungs[i]);
            let more = (high.rung.parameters() - low.rung.parameters()) as f64;
            let gained = (low.chi2 - high.chi2).max(0.0) / more / scale;
            let p_value = f_exceeds(gained, more, interval_dof.min(1e4));
            // Eq. (1)-(3) are passive: a rung that explains more with an unstable pole has found something else.
            let passive = high.model.slow_pole_rad_per_s >= 0.0;
            if p_value < 0.01 && high.aicc < low.aicc && high.held_out < low.held_out && passive {
                chosen = i;
            }
        }
        Ok(LadderFit {
            rungs,
            chosen,
            scale,
            interval_dof,
        })
    }
}
