//! Fits candidate models of rising order to a frequency response, and chooses the order that the data support.
//!
//! Complex, weighted least squares on the record's response; hold, delay and exposure are in the model, not removed from the data. The
//! candidates are an integrator with delay, then with a pole-zero pair, with two lags, with two lags and a zero, with the far zero, and
//! full Eq. (4). A higher order is chosen only if three tests agree: an F-test rejects the lower one (1 %), AICc falls, and the fit to
//! one half of the blocks predicts the other half better. The quality of a parameter comes from [`crate::identifiability`].

mod stray;

pub use crate::candidate_order::{
    CandidateFit, CandidateFits, CandidateOrder, DelayPrior, index, model_of,
};
use nalgebra::Complex;

use crate::candidate_model::CandidateModel;
use crate::error::IdentError;
use crate::frequency_response::FrequencyPoint;
use crate::least_squares::{Minimum, covariance, minimise};
use crate::sampled::Sampling;
use cellpos_numeric::statistics::f_exceeds;

/// Data of the fit.
#[derive(Debug, Clone)]
pub struct OrderSelection<'a> {
    points: &'a [FrequencyPoint],
    sampling: Sampling,
    prior: Option<DelayPrior>,
    /// Weights of the residuals along the point's response and across it, which are those of gain and phase.
    weights: Vec<[f64; 2]>,
    /// Standard deviation of each line's delay about the common one, s.
    stray_s: f64,
    /// Shift of the two weak bounds (share, lead), in their standard deviations.
    bounds_moved: [f64; 2],
    /// Orders with two lags are candidates.
    two_lags: bool,
}

/// Finite-difference steps of the parameter vector.
const STEPS: [f64; 7] = [1e-5, 1e-5, 1e-4, 1e-4, 1e-5, 1e-4, 1e-4];

/// Mean square of a residual whose weight was estimated with so many degrees of freedom: the variance of Student's t.
fn noise_of_weight(dof: f64) -> f64 {
    if dof > 2.5 { dof / (dof - 2.0) } else { 1.0 }
}

/// Prior of the far zero's lead: zero, with this part of a sampling period as standard deviation. A lead of a period or more would be a
/// second delay.
const LEAD_SD_PERIODS: f64 = 0.3;

/// Prior of the feedthrough's share one row later: between 0 and 1.
const SHARE_MIDDLE_SD: (f64, f64) = (0.5, 0.5);

impl<'a> OrderSelection<'a> {
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
        Ok(Self {
            points,
            sampling,
            prior,
            weights: stray::weights(points, 0.0),
            stray_s: 0.0,
            bounds_moved: [0.0; 2],
            two_lags: false,
        })
    }

    fn rows(&self) -> usize {
        2 * self.points.len() + 3
    }

    fn residuals(&self, data: &[Complex<f64>], model: &CandidateModel, out: &mut [f64]) {
        let sampler = model.sampler(self.sampling);
        for (i, (p, y)) in self.points.iter().zip(data).enumerate() {
            let size = p.response.norm().max(f64::MIN_POSITIVE);
            let e = (y - sampler.response(p.frequency_hz)) * (p.response.conj() / size);
            let [of_gain, of_phase] = self.weights[i];
            out[2 * i] = e.re * of_gain;
            out[2 * i + 1] = e.im * of_phase;
        }
        let last = 2 * self.points.len();
        out[last] = self
            .prior
            .map_or(0.0, |prior| (model.delay_s - prior.delay_s) / prior.sd_s);
        // Behind a hold the lead trades exactly with the delay, and the share with the lead. These two weak bounds keep both directions
        // determined.
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
    pub fn chi2(&self, data: &[Complex<f64>], model: &CandidateModel) -> f64 {
        let mut out = vec![0.0; self.rows()];
        self.residuals(data, model, &mut out);
        out[..2 * self.points.len()].iter().map(|r| r * r).sum()
    }

    /// The same problem with another delay prior.
    pub fn with_prior(mut self, prior: Option<DelayPrior>) -> Self {
        self.prior = prior;
        self
    }

    /// The same problem with or without the orders of two lags. A plant driven by a PZT has no such lags; there they would absorb an
    /// unknown effect.
    pub fn with_two_lags(mut self, two_lags: bool) -> Self {
        self.two_lags = two_lags;
        self
    }

    /// The same problem with the weak bounds (feedthrough share, far-zero lead) shifted, in standard deviations. A prior is uncertain
    /// too, so each replicate of the fit draws it again.
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

    /// Fits `data` on `order` from one start; parameters in `fixed` keep their value.
    pub fn fit_from(
        &self,
        data: &[Complex<f64>],
        order: CandidateOrder,
        start: &[f64],
        fixed: Option<(usize, f64)>,
    ) -> Minimum {
        let n = order.parameters();
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
            self.residuals(data, &model_of(&expand(x), order), out);
        });
        found.parameters = expand(&found.parameters);
        found
    }

    /// Start values of gain and delay. The delay comes from a grid, because phase wraps.
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
            let unit = CandidateModel::integrator(1.0, delay_ms * 1e-3).sampler(self.sampling);
            let (mut cross, mut power) = (0.0, 0.0);
            for ((p, y), [w, _]) in self.points.iter().zip(data).zip(&self.weights) {
                let h = unit.response(p.frequency_hz);
                // Relative weights with a ceiling: the start must not depend on one very precise line.
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

    /// The best fit of `order` over several starts; one is the result of the order below.
    fn fit_rung(
        &self,
        data: &[Complex<f64>],
        order: CandidateOrder,
        below: Option<&[f64]>,
    ) -> Option<Minimum> {
        let [ln_gain, delay_ms] = self.first_guess(data);
        let mut starts: Vec<Vec<f64>> = Vec::new();
        let mut extend = |base: &[f64], tail: &[f64]| {
            let mut x = base.to_vec();
            x.extend_from_slice(tail);
            starts.push(x);
        };
        match (order, below) {
            (CandidateOrder::Integrator, _) | (_, None) => {
                extend(&[ln_gain, delay_ms], &[0.0; 5][..order.parameters() - 2])
            }
            (CandidateOrder::PoleZeroPair, Some(x)) => {
                let (low, high) = self.band_rad_per_s();
                for share in [0.2, 0.4, 0.6, 0.8] {
                    let centre = low.ln() + share * (high / low).ln();
                    for lead in [0.15, -0.15] {
                        extend(x, &[centre + lead, centre - lead]);
                    }
                }
            }
            (CandidateOrder::TwoLags, Some(x)) => {
                let (low, high) = self.band_rad_per_s();
                let at = |share: f64| low.ln() + share * (high / low).ln();
                // The delay of the integrator's fit contains the lags.
                for (second, first) in [(0.9, 0.4), (0.9, 0.7), (0.7, 0.5), (1.1, 0.9)] {
                    extend(&[x[0], 0.0], &[at(second), at(first)]);
                }
            }
            (CandidateOrder::TwoLagsZero, Some(x)) => {
                let (low, high) = self.band_rad_per_s();
                for share in [0.3, 0.6, 0.9, 1.2] {
                    extend(x, &[low.ln() + share * (high / low).ln()]);
                }
            }
            (CandidateOrder::FarZero, Some(x)) => {
                // First with a fixed lead: when the delay crosses half a sample the feedthrough jumps to another row, and a long first
                // step could end in the wrong one.
                for share in [0.03, 0.1, 0.3] {
                    let lead_ms = share * self.sampling.period_s * 1e3;
                    let mut start = x.to_vec();
                    start.extend([lead_ms, 0.5]);
                    let held =
                        self.fit_from(data, order, &start, Some((index::FAR_LEAD_MS, lead_ms)));
                    if held.parameters.iter().all(|v| v.is_finite()) {
                        extend(&held.parameters, &[]);
                    }
                }
            }
            (CandidateOrder::Eq4, Some(x)) => {
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
            .map(|s| self.fit_from(data, order, s, None))
            .filter(sane);
        let best = fits.min_by(|a, b| a.chi2.total_cmp(&b.chi2))?;
        // The slower of two lags comes first.
        let swapped = order.two_lags()
            && best.parameters[index::LN_SECOND_POLE] < best.parameters[index::LN_POLE];
        if !swapped {
            return Some(best);
        }
        let mut start = best.parameters.clone();
        start.swap(index::LN_POLE, index::LN_SECOND_POLE);
        Some(self.fit_from(data, order, &start, None))
    }

    fn band_rad_per_s(&self) -> (f64, f64) {
        let hz = self.points.iter().map(|p| p.frequency_hz);
        let (low, high) = hz.fold((f64::INFINITY, 0.0f64), |(a, b), f| (a.min(f), b.max(f)));
        (
            2.0 * std::f64::consts::PI * low,
            2.0 * std::f64::consts::PI * high,
        )
    }

    /// Fits every order that the points allow, lowest first.
    fn fit_rungs(&self, data: &[Complex<f64>]) -> Vec<(CandidateOrder, Minimum)> {
        let mut out: Vec<(CandidateOrder, Minimum)> = Vec::new();
        for order in CandidateOrder::ALL {
            if 2 * self.points.len() <= order.parameters() {
                break;
            }
            let below = (out.iter())
                .find(|(other, _)| Some(*other) == order.below())
                .map(|(_, m)| m.parameters.clone());
            if order.two_lags() && !self.two_lags || order.below().is_some() && below.is_none() {
                continue;
            }
            if let Some(found) = self.fit_rung(data, order, below.as_deref()) {
                out.push((order, found));
            }
        }
        out
    }

    /// Weighted squares per datum of each order on the half of the blocks that it has not seen (both ways, averaged).
    fn held_out(&self, full: &[(CandidateOrder, Minimum)]) -> Vec<f64> {
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
            .map(|(order, m)| {
                [(&even, &odd), (&odd, &even)]
                    .iter()
                    .map(|(fit, test)| {
                        let found = self.fit_from(fit, *order, &m.parameters, None);
                        // Half the blocks: twice the variance.
                        0.25 * self.chi2(test, &model_of(&found.parameters, *order)) / n
                    })
                    .sum()
            })
            .collect()
    }

    /// Fits the candidates and chooses an order.
    ///
    /// # Errors
    /// [`IdentError::NoFit`] when not even the integrator converges.
    pub fn fit(&self) -> Result<CandidateFits, IdentError> {
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
        // Weights estimated from few blocks make intervals too short by this factor.
        let weight_noise = if from_scatter {
            noise_of_weight(variance_dof)
        } else {
            1.0
        };
        let best_reduced = fits
            .iter()
            .map(|(r, m)| m.chi2 / (n - r.parameters() as f64))
            .fold(f64::INFINITY, f64::min);
        let scale = best_reduced.max(1.0) * weight_noise;
        let mut orders: Vec<CandidateFit> = Vec::new();
        for ((order, m), held_out) in fits.into_iter().zip(held_out) {
            let k = order.parameters() as f64;
            let below = orders.iter().find(|o| Some(o.order) == order.below());
            let step_p_value = below.map_or(1.0, |below| {
                let gained =
                    (below.chi2 - m.chi2).max(0.0) / (k - below.order.parameters() as f64) / scale;
                f_exceeds(
                    gained,
                    k - below.order.parameters() as f64,
                    interval_dof.min(1e4),
                )
            });
            let correction = if n - k - 1.0 > 0.0 {
                2.0 * k * (k + 1.0) / (n - k - 1.0)
            } else {
                f64::INFINITY
            };
            orders.push(CandidateFit {
                order,
                model: model_of(&m.parameters, order),
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
        if !orders.first().is_some_and(|r| r.converged) {
            return Err(IdentError::NoFit {
                what: "an integrator with delay",
                reason: "no start led to a minimum",
            });
        }
        let mut chosen = 0;
        for i in 1..orders.len() {
            let (low, high) = (&orders[chosen], &orders[i]);
            let more = (high.order.parameters() - low.order.parameters()) as f64;
            // Two orders with equally many parameters are not nested: the data alone decide.
            let p_value = if more > 0.0 {
                let gained = (low.chi2 - high.chi2).max(0.0) / more / scale;
                f_exceeds(gained, more, interval_dof.min(1e4))
            } else {
                0.0
            };
            // Eq. (1)-(3) are passive, so an order with an unstable pole describes something else. A negative delay is impossible too.
            let passive = high.model.slow_pole_rad_per_s >= 0.0
                && (high.model.delay_s >= 0.0 || !high.order.two_lags());
            // Numbers that the points leave open are none to build on.
            let known = high.covariance.diagonal().iter().all(|v| v.is_finite());
            let better = p_value < 0.01 && high.aicc < low.aicc && high.held_out < low.held_out;
            if better && passive && known {
                chosen = i;
            }
        }
        Ok(CandidateFits {
            candidates: orders,
            chosen,
            scale,
            interval_dof,
        })
    }
}
