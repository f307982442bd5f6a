//! Residual of the records for given poles and delay, with everything linear solved for.

use super::form::Form;
use super::response::{Grid, driven, free};
use super::types::Series;
use crate::sampled::Hold;
use nalgebra::{DMatrix, DVector};

/// Slowest and fastest pole of the search: radians over the longest stretch, and radians per row.
const SLOWEST: f64 = 0.02;
const FASTEST: f64 = 8.0;

/// One stretch of a record, ready to be fitted.
#[derive(Debug, Clone)]
struct Stretch {
    held: [Grid; 2],
    output: Vec<f64>,
    /// Rows that count: the record holds their output and the input that acts on it.
    counts: Vec<bool>,
}

/// Records, or parts of records.
#[derive(Debug, Clone)]
pub(super) struct Data {
    stretches: Vec<Stretch>,
    /// Rows that count.
    pub rows: usize,
    /// Rows of the longest stretch.
    pub longest: usize,
    /// RMS of the output about the mean of its stretch.
    pub output_rms: f64,
}

/// Everything linear, solved for.
#[derive(Debug, Clone)]
pub(super) struct Solved {
    /// Numerator, highest power of s first, time in rows.
    pub numerator: Vec<f64>,
    /// Residual row by row, divided by the RMS of the output.
    pub residual: Vec<f64>,
    /// Slope of the output that the input does not explain, output unit per row; mean over the stretches (integrating plants).
    pub ramp: f64,
}

impl Data {
    /// Cuts at most `most` rows out of the records, in stretches spread over all of them. The first `skipped` rows of a stretch give only
    /// the input, for the delay to reach back to.
    pub(super) fn new(records: &[Series], hold: Hold, most: usize, skipped: usize) -> Self {
        let all: usize = records.iter().map(|r| r.input.len()).sum();
        let share = (most as f64 / all.max(1) as f64).min(1.0);
        let mut stretches = Vec::new();
        for r in records {
            let grids = [false, true].map(|direct| Grid::new(&r.input, hold, direct));
            let n = r.input.len();
            // Take stretches at the beginning, the middle and the end of a long record.
            let pieces = if share < 0.99 {
                3.min(n / 500).max(1)
            } else {
                1
            };
            let rows = ((n as f64 * share) as usize / pieces).clamp(1, n);
            for piece in 0..pieces {
                let from = match pieces {
                    1 => 0,
                    _ => piece * (n - rows) / (pieces - 1),
                };
                stretches.push(Stretch::new(r, &grids, from, rows, skipped));
            }
        }
        Self::of(stretches)
    }

    fn of(stretches: Vec<Stretch>) -> Self {
        let (mut rows, mut square) = (0, 0.0);
        for s in &stretches {
            let seen: Vec<f64> = s.seen().map(|(_, y)| y).collect();
            let mean = seen.iter().sum::<f64>() / seen.len().max(1) as f64;
            rows += seen.len();
            square += seen.iter().map(|y| (y - mean).powi(2)).sum::<f64>();
        }
        Self {
            longest: stretches.iter().map(|s| s.output.len()).max().unwrap_or(1),
            stretches,
            rows,
            output_rms: (square / rows.max(1) as f64).sqrt().max(f64::MIN_POSITIVE),
        }
    }

    /// Only the first or the last half of each stretch; the fit must predict the other half.
    pub(super) fn half(&self, last: bool, delay: f64) -> Self {
        // The delayed input of these rows is before the cut, so they do not count.
        let late = if last { delay.ceil() as usize + 1 } else { 0 };
        let cut = |s: &Stretch| {
            let n = s.output.len();
            let range = if last { n / 2..n } else { 0..n / 2 };
            let counts = s.counts[range.clone()].iter().enumerate();
            Stretch {
                held: [0, 1].map(|i: usize| s.held[i].part(range.start, range.len())),
                counts: counts.map(|(k, counts)| *counts && k >= late).collect(),
                output: s.output[range].to_vec(),
            }
        };
        Self::of(self.stretches.iter().map(cut).collect())
    }

    /// `theta` holds the logarithm of one real pole if their number is odd, then the logarithms of the two coefficients of each pair,
    /// then the delay. Time in rows.
    pub(super) fn denominator(&self, form: &Form, theta: &[f64]) -> Vec<f64> {
        let (low, high) = self.log_range();
        let at = |v: f64, power: f64| (v.clamp(power * low, power * high)).exp();
        let mut out = vec![1.0];
        let (single, pairs) = theta[..form.free_poles()].split_at(form.free_poles() % 2);
        for v in single {
            out = times(&out, &[1.0, at(*v, 1.0)]);
        }
        for pair in pairs.chunks(2) {
            // A pair's damping may be as small as the record shows, however fast it is.
            out = times(&out, &[1.0, at(pair[0], 1.0), at(pair[1], 2.0)]);
        }
        if form.integrating {
            out.push(0.0);
        }
        out
    }

    fn log_range(&self) -> (f64, f64) {
        ((SLOWEST / self.longest as f64).ln(), FASTEST.ln())
    }

    /// Whether a pole is at an end of the search range.
    pub(super) fn at_bound(&self, form: &Form, theta: &[f64]) -> bool {
        let (low, high) = self.log_range();
        let n = form.free_poles();
        theta[..n].iter().enumerate().any(|(i, &v)| {
            let squared = i >= n % 2 && (i - n % 2) % 2 == 1;
            let power = if squared { 2.0 } else { 1.0 };
            v <= power * low + 0.05 || v >= power * high - 0.05
        })
    }

    /// Solves for the linear parameters; None if the records do not determine them.
    pub(super) fn solve(
        &self,
        form: &Form,
        theta: &[f64],
        numerator: Option<&[f64]>,
    ) -> Option<Solved> {
        let denominator = self.denominator(form, theta);
        let delay = theta.get(form.free_poles()).copied().unwrap_or(0.0);
        self.solve_at(form, &denominator, delay, numerator)
    }

    /// As [`Data::solve`], for a given denominator. A given `numerator` is kept; only the starts are solved for.
    pub(super) fn solve_at(
        &self,
        form: &Form,
        denominator: &[f64],
        delay: f64,
        numerator: Option<&[f64]>,
    ) -> Option<Solved> {
        let n = form.order;
        let zeros = form.zeros.unwrap_or(n.saturating_sub(1)).min(n);
        let shared = zeros + 1;
        let own = n + 1;
        let columns: Vec<(Vec<Vec<f64>>, &Stretch)> = self
            .stretches
            .iter()
            .map(|s| (s.columns(form, denominator, delay, zeros), s))
            .collect();
        let free_gain = numerator.is_none();
        let width = if free_gain { shared } else { 0 } + own * columns.len();
        let mut gram = DMatrix::zeros(width, width);
        let mut right = DVector::zeros(width);
        let first = if free_gain { 0 } else { shared };
        for (index, (columns, s)) in columns.iter().enumerate() {
            let place = |i: usize| match i.checked_sub(shared) {
                None => i,
                Some(own_i) => shared - first + own * index + own_i,
            };
            let target = s.target(columns, numerator);
            for i in first..columns.len() {
                right[place(i)] += s.dot(&columns[i], &target);
                for j in first..=i {
                    let v = s.dot(&columns[i], &columns[j]);
                    gram[(place(i), place(j))] += v;
                    if i != j {
                        gram[(place(j), place(i))] += v;
                    }
                }
            }
        }
        let x = solved(gram, &right)?;
        let numerator: Vec<f64> = match numerator {
            Some(given) => given.to_vec(),
            // Columns go from s^0 up, coefficients from the highest power down.
            None => (0..shared).rev().map(|i| x[i]).collect(),
        };
        let mut residual = Vec::with_capacity(self.rows);
        let mut ramp = 0.0;
        for (index, (columns, s)) in columns.iter().enumerate() {
            let target = s.target(columns, Some(&numerator));
            let from = shared - first + own * index;
            for (k, counts) in s.counts.iter().enumerate() {
                if *counts {
                    let start: f64 = (0..own).map(|i| x[from + i] * columns[shared + i][k]).sum();
                    residual.push((target[k] - start) / self.output_rms);
                }
            }
            ramp += x[from + n] / self.stretches.len() as f64;
        }
        let finite = residual.iter().all(|v| v.is_finite());
        finite.then_some(Solved {
            numerator,
            residual,
            ramp,
        })
    }
}

impl Stretch {
    fn new(r: &Series, grids: &[Grid; 2], from: usize, rows: usize, skipped: usize) -> Self {
        let output = r.output[from..from + rows].to_vec();
        let skipped = skipped.min(rows / 4);
        Self {
            held: [0, 1].map(|i: usize| grids[i].part(from, rows)),
            counts: (output.iter().enumerate())
                .map(|(k, y)| k >= skipped && y.is_finite())
                .collect(),
            output,
        }
    }

    fn seen(&self) -> impl Iterator<Item = (usize, f64)> + '_ {
        let counted = self.counts.iter().enumerate().filter(|(_, c)| **c);
        counted.map(|(k, _)| (k, self.output[k]))
    }

    fn dot(&self, a: &[f64], b: &[f64]) -> f64 {
        (a.iter().zip(b).zip(&self.counts))
            .map(|((a, b), counts)| if *counts { a * b } else { 0.0 })
            .sum()
    }

    /// Responses to the input, then to each start, then the sensor's zero (or, of an integrating plant, a ramp).
    fn columns(&self, form: &Form, denominator: &[f64], delay: f64, zeros: usize) -> Vec<Vec<f64>> {
        let n = form.order;
        let direct = zeros == n;
        let mut all = driven(denominator, delay, &self.held[usize::from(direct)]);
        if direct {
            // s^n / A is the input minus the lower powers of A.
            let mut top = all[n].clone();
            for (i, column) in all[..n].iter().enumerate() {
                for (t, c) in top.iter_mut().zip(column) {
                    *t -= denominator[n - i] * c;
                }
            }
            all[n] = top;
        }
        all.truncate(zeros + 1);
        let rows = self.output.len();
        all.extend(free(denominator, rows));
        all.push(match form.integrating {
            true => (0..rows).map(|k| k as f64).collect(),
            false => vec![1.0; rows],
        });
        all
    }

    /// The output minus the numerator's response to the input.
    fn target(&self, columns: &[Vec<f64>], numerator: Option<&[f64]>) -> Vec<f64> {
        let mut out: Vec<f64> = (self.output.iter().zip(&self.counts))
            .map(|(y, counts)| if *counts { *y } else { 0.0 })
            .collect();
        for (b, column) in numerator.unwrap_or(&[]).iter().rev().zip(columns) {
            for (out, c) in out.iter_mut().zip(column) {
                *out -= b * c;
            }
        }
        out
    }
}

/// Product of two polynomials, highest power first.
pub(super) fn times(a: &[f64], b: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; a.len() + b.len() - 1];
    for (i, x) in a.iter().enumerate() {
        for (j, y) in b.iter().enumerate() {
            out[i + j] += x * y;
        }
    }
    out
}

/// Solves the normal equations. Unobservable parameters (a slow start next to the sensor's zero) remain zero.
fn solved(gram: DMatrix<f64>, right: &DVector<f64>) -> Option<DVector<f64>> {
    let scale: Vec<f64> = (0..gram.nrows())
        .map(|i| match gram[(i, i)] {
            v if v > 0.0 => 1.0 / v.sqrt(),
            _ => 0.0,
        })
        .collect();
    let scaled = DMatrix::from_fn(gram.nrows(), gram.ncols(), |i, j| {
        gram[(i, j)] * scale[i] * scale[j]
    });
    if !scaled.iter().all(|v| v.is_finite()) {
        return None;
    }
    let eigen = scaled.symmetric_eigen();
    let rhs = DVector::from_fn(right.len(), |i, _| right[i] * scale[i]);
    let mut along = eigen.eigenvectors.transpose() * rhs;
    for (a, value) in along.iter_mut().zip(eigen.eigenvalues.iter()) {
        *a = if *value > 1e-11 { *a / value } else { 0.0 };
    }
    let x = eigen.eigenvectors * along;
    Some(DVector::from_fn(x.len(), |i, _| x[i] * scale[i]))
}
