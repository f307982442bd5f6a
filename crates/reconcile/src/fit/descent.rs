//! Joint fit of any set of candidates by Levenberg-Marquardt on the innovations.
//!
//! Every fit, that of the null included, also has linear nuisance parameters: the share of the newest command in a frame, and
//! (inside the whitening filter) each record's start.

use crate::fit::catalogue::Part;
use crate::fit::context::{Context, Fit, freedom_of};
use crate::fit::evaluate::State;
use crate::fit::linear::{self, Tangents, normal_equations};
use crate::fit::step::GAIN_RANGE;
use crate::fit::waves;
use crate::mask::Mask;
use cellpos_plant::effects::Role;
use nalgebra::DMatrix;

/// A fit ends if a round gains less than this, or than this share of its excess over the noise.
const STILL: f64 = 0.02;
const STILL_SHARE: f64 = 3e-6;

/// Rounds before a fit may be given up: the first ones find their damping.
const FEWEST: usize = 4;

/// Dampings that are tried with new derivatives.
const FIRST_TRIALS: usize = 8;

/// How far a fit is carried on.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Until {
    pub iterations: usize,
    /// It is given up if it cannot get below this.
    pub least_chi2: f64,
}

impl Until {
    /// To the end.
    pub(crate) fn done(iterations: usize) -> Self {
        Self {
            iterations,
            least_chi2: f64::INFINITY,
        }
    }
}

/// The covariance of an information matrix. A number that the records do not show has none: its variance is infinite, and it makes
/// no other number less sure.
fn covariance(information: &DMatrix<f64>) -> DMatrix<f64> {
    let n = information.nrows();
    let unseen: Vec<usize> = (0..n).filter(|&i| information[(i, i)] <= 0.0).collect();
    let mut regular = information.clone();
    for i in 0..n {
        regular[(i, i)] *= 1.0 + 1e-9;
    }
    for &i in &unseen {
        regular[(i, i)] = 1.0;
    }
    let mut inverse = regular
        .try_inverse()
        .unwrap_or_else(|| DMatrix::from_diagonal_element(n, n, f64::INFINITY));
    for i in unseen {
        inverse[(i, i)] = f64::INFINITY;
    }
    inverse
}

/// Logarithm of the determinant of an information matrix, with the information from the ranges of its numbers: a number that may
/// have any value in a range has the variance `range^2 / 12`.
fn log_information(mut information: DMatrix<f64>, ranges: &[f64]) -> f64 {
    for (i, range) in ranges.iter().enumerate() {
        information[(i, i)] += 12.0 / (range * range);
    }
    information.cholesky().map_or(f64::INFINITY, |c| {
        2.0 * c.l_dirty().diagonal().iter().map(|d| d.ln()).sum::<f64>()
    })
}

impl Context<'_> {
    /// Ranges of all numbers of a fit, in its coordinates. Amplitudes lie within the travel of the bead.
    fn ranges(&self, fit: &Fit, count: usize) -> Vec<f64> {
        let mut ranges = Vec::with_capacity(count);
        for part in &fit.parts {
            let v = part.variant();
            ranges.extend((v.params.iter()).map(|p| p.coordinate(p.upper) - p.coordinate(p.lower)));
            let amplitudes = freedom_of(v, self.problem.records.len()) - v.params.len();
            ranges.extend(std::iter::repeat_n(2.0 * self.scope.travel_um, amplitudes));
        }
        if self.has_free_offset(&fit.parts) {
            ranges.push(2.0 * self.scope.stroke_um);
        }
        // The share of the edge, and a free gain.
        let (low, high) = self.problem.soft;
        ranges.push((high - low).max(1e-9));
        ranges.resize(count, GAIN_RANGE);
        ranges
    }

    /// Fits a set of candidates from starting values.
    pub(crate) fn fit(&self, parts: Vec<Part>, mask: &Mask, iterations: usize) -> Fit {
        self.fit_from(parts, None, mask, iterations)
    }

    /// Carries a fit on.
    pub(crate) fn refit(&self, fit: &Fit, mask: &Mask, iterations: usize) -> Fit {
        self.run(fit.clone(), mask, Until::done(iterations), None)
    }

    /// Continues a fit with one of its numbers fixed.
    pub(crate) fn refit_with(&self, fit: &Fit, mask: &Mask, iterations: usize, held: usize) -> Fit {
        self.run(fit.clone(), mask, Until::done(iterations), Some(held))
    }

    /// Carries a fit on, as long as it may still come down to a sum of squares.
    pub(crate) fn refit_towards(&self, fit: &Fit, mask: &Mask, until: Until) -> Fit {
        self.run(fit.clone(), mask, until, None)
    }

    /// As [`Self::fit`], with the nuisances of an earlier fit as starting values where they apply.
    pub(crate) fn fit_from(
        &self,
        parts: Vec<Part>,
        soft: Option<f64>,
        mask: &Mask,
        iterations: usize,
    ) -> Fit {
        self.fit_towards(parts, soft, mask, Until::done(iterations))
    }

    /// A fit without its part `index`, fitted from its other numbers.
    pub(crate) fn fit_without(
        &self,
        fit: &Fit,
        index: usize,
        mask: &Mask,
        iterations: usize,
    ) -> Fit {
        let mut parts = fit.parts.clone();
        parts.remove(index);
        self.fit_from(parts, Some(fit.soft), mask, iterations)
    }

    /// As [`Self::fit_from`], given up where it can no longer come down to a sum of squares.
    pub(crate) fn fit_towards(
        &self,
        parts: Vec<Part>,
        soft: Option<f64>,
        mask: &Mask,
        until: Until,
    ) -> Fit {
        let records = self.problem.records.len();
        let lines = parts.iter().filter_map(|p| match p.variant().role {
            Role::Line { harmonics } => Some(vec![vec![[0.0; 2]; harmonics]; records]),
            _ => None,
        });
        let lines = lines.collect();
        let positions = parts
            .iter()
            .filter(|p| p.variant().role == Role::Position)
            .count();
        let fit = Fit {
            parts,
            soft: soft.unwrap_or(0.0),
            offset_um: 0.0,
            gain: 1.0,
            errors: [0.0; 2],
            lines,
            positions: vec![[0.0; 2]; positions],
            locking: Vec::new(),
            chi2: 0.0,
            last_gain: 0.0,
            count: self.problem.count(mask),
            innovations: Vec::new(),
            covariance: DMatrix::zeros(0, 0),
            log_information: 0.0,
            absorbed: 0.0,
        };
        self.run(fit, mask, until, None)
    }

    /// Descends; the number `still`, if any, keeps its value.
    ///
    /// Derivatives cost a simulation for each number. So they are taken again only where the steps of the last ones no longer help: in
    /// between, each step corrects them (Broyden 1965).
    fn run(&self, mut fit: Fit, mask: &Mask, until: Until, still: Option<usize>) -> Fit {
        fit.count = self.problem.count(mask);
        let mut state = self.state(&fit, mask);
        let mut lambda = 1e-3;
        let mut normal;
        let mut round = 0;
        let mut gained = 0.0;
        loop {
            let (n, mut columns) = self.columns(&fit, &state, mask);
            let mut linear = self.linear(&fit, &state, (n, &columns), mask, still);
            normal = linear.normal.clone();
            if round >= until.iterations {
                break;
            }
            round += 1;
            let count = fit.count as f64;
            let least = |state: &State| {
                let rough = (state.chi2 - count).max(0.0);
                STILL.max(STILL_SHARE * rough)
            };
            let before = state.chi2;
            let mut trials = FIRST_TRIALS;
            let most_corrections = self.simulations_of_columns(&fit);
            for correction in 0..=most_corrections {
                let Some((next, next_state)) =
                    self.step_down((&fit, &state), &linear, &mut lambda, trials, mask)
                else {
                    break;
                };
                let last = state.chi2 - next_state.chi2 < least(&next_state)
                    || correction == most_corrections;
                if !last {
                    let moved = self.numbers(&next) - self.numbers(&fit);
                    let change = [&state.innovations, &next_state.innovations];
                    linear::correct(
                        &mut columns,
                        &moved,
                        &linear.normal,
                        change.map(Vec::as_slice),
                    );
                }
                (fit, state) = (next, next_state);
                if last {
                    break;
                }
                linear = self.linear(&fit, &state, (n, &columns), mask, still);
                trials = 1;
            }
            gained = before - state.chi2;
            if gained < least(&state) {
                break;
            }
            // The steps of a descent become smaller. Even with steps as large as this one, the remaining ones would not suffice.
            let most = gained * (until.iterations - round) as f64;
            if round >= FEWEST && state.chi2 - most > until.least_chi2 {
                break;
            }
        }
        let size = normal.nrows();
        let inverse = covariance(&normal);
        fit.last_gain = gained;
        fit.innovations = if mask.iter().any(Vec::is_empty) {
            self.state(&fit, &self.problem.all()).innovations
        } else {
            state.innovations
        };
        fit.chi2 = state.chi2 + waves::unequal(&fit, &inverse);
        fit.log_information = log_information(normal.clone(), &self.ranges(&fit, size));
        let sd = |i: usize| inverse[(i, i)].max(0.0).sqrt();
        fit.errors = if self.free_gain {
            [sd(size - 2), sd(size - 1)]
        } else {
            [sd(size - 1), 0.0]
        };
        fit.covariance = self.effect_covariance(&fit, &inverse);
        fit
    }

    /// Simulations that the derivatives at a fit cost.
    fn simulations_of_columns(&self, fit: &Fit) -> usize {
        let chain = fit.parts.iter().map(Part::variant);
        let numbers: usize = (chain.filter(|v| v.role == Role::Chain))
            .map(|v| v.params.len())
            .sum();
        numbers + usize::from(self.has_free_offset(&fit.parts))
    }

    /// The rows and columns of the parts' own parameters.
    fn effect_covariance(&self, fit: &Fit, inverse: &DMatrix<f64>) -> DMatrix<f64> {
        let mut indices = Vec::new();
        let mut next = 0;
        for part in &fit.parts {
            let n = part.variant().params.len();
            indices.extend(next..next + n);
            next += freedom_of(part.variant(), self.problem.records.len());
        }
        DMatrix::from_fn(indices.len(), indices.len(), |i, j| {
            inverse[(indices[i], indices[j])]
        })
    }

    /// Tangents at a fit, for screening further candidates.
    pub(crate) fn tangents(&self, fit: &Fit, mask: &Mask) -> Tangents {
        let state = self.state(fit, mask);
        let (n, columns) = self.columns(fit, &state, mask);
        let (normal, gradient) = normal_equations(n, &columns, &state.innovations, mask);
        let mut regular = normal.clone();
        for i in 0..n {
            regular[(i, i)] +=
                1e-9 * normal[(i, i)] + if normal[(i, i)] == 0.0 { 1.0 } else { 0.0 };
        }
        let inverse = regular
            .try_inverse()
            .unwrap_or_else(|| DMatrix::identity(n, n));
        Tangents {
            columns,
            inverse,
            gradient,
        }
    }

    /// Innovations of a set with given nuisances, without fitting.
    pub(crate) fn innovations(&self, fit: &Fit, mask: &Mask) -> (Vec<Vec<f64>>, f64) {
        let s = self.state(fit, mask);
        (s.innovations, s.chi2)
    }

    /// Raw residual of a fit in the records that count under a mask; empty for the others.
    pub(crate) fn residual_under(&self, fit: &Fit, mask: &Mask) -> Vec<Vec<f64>> {
        self.state(fit, mask).residual
    }

    /// Sum of squares of a fit that the stated error of the model takes off.
    pub(crate) fn absorbed(&self, fit: &Fit, mask: &Mask) -> f64 {
        let residual = self.residual_under(fit, mask);
        let records = self.problem.records.iter().zip(&residual).zip(mask);
        let squares: f64 = records
            .filter(|(_, rows)| !rows.is_empty())
            .map(|((r, residual), rows)| {
                r.squares_without_model_errors(&self.problem.noise, residual, rows)
            })
            .sum();
        (squares - fit.chi2).max(0.0)
    }

    /// Raw residual of a fit, and its position with the lines that shake it.
    pub(crate) fn residual(&self, fit: &Fit) -> (Vec<Vec<f64>>, Vec<Vec<f64>>) {
        let s = self.state(fit, &self.problem.all());
        (s.residual, s.path)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_records_do_not_see_has_no_information_and_takes_none_from_the_rest() {
        let seen = [4.0, 1.0, 1.0, 2.0];
        let mut information = DMatrix::zeros(3, 3);
        for (at, v) in [(0, 0), (0, 2), (2, 0), (2, 2)].into_iter().zip(seen) {
            information[at] = v;
        }
        let c = covariance(&information);
        assert_eq!(c[(1, 1)], f64::INFINITY);
        // The inverse of [4 1; 1 2] is [2 -1; -1 4]/7.
        assert!((c[(0, 0)] - 2.0 / 7.0).abs() < 1e-6);
        assert!((c[(2, 2)] - 4.0 / 7.0).abs() < 1e-6);
    }
}
