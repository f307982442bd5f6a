//! The fit of one form: starts, the search over poles and delay, and intervals.

use super::design::{Data, Solved};
use super::form::Form;
use super::types::BaseFit;
use crate::least_squares::{covariance, minimise};
use crate::rational::{RationalFit, roots};
use nalgebra::DMatrix;

/// Delays from which the search begins, rows.
const DELAYS: [f64; 15] = [
    0.0, 0.5, 1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 17.0, 23.0, 30.0, 40.0, 55.0, 75.0, 100.0,
];

/// Damping ratios from which a pair of poles begins.
const DAMPINGS: [f64; 2] = [0.08, 0.7];

fn sum_of_squares(solved: &Solved) -> f64 {
    solved.residual.iter().map(|e| e * e).sum()
}

/// Poles and delay, and their residual.
#[derive(Debug, Clone)]
pub(super) struct Found {
    pub theta: Vec<f64>,
    pub left: f64,
}

/// Descends from a start.
pub(super) fn descend(data: &Data, form: &Form, start: &[f64], most_delay: f64) -> Option<Found> {
    let n = form.free_poles();
    let bounded = |theta: &[f64]| {
        let mut theta = theta.to_vec();
        if let Some(delay) = theta.get_mut(n) {
            *delay = delay.abs().min(most_delay);
        }
        theta
    };
    if start.is_empty() {
        let left = sum_of_squares(&data.solve(form, start, None)?);
        return Some(Found {
            theta: Vec::new(),
            left,
        });
    }
    data.solve(form, start, None)?;
    // A negative delay counts as its absolute value, so that the search does not end at an edge.
    let fill = |theta: &[f64], out: &mut [f64]| match data.solve(form, &bounded(theta), None) {
        Some(solved) => out.copy_from_slice(&solved.residual),
        None => out.fill(1.0),
    };
    let found = minimise(start, &vec![1e-5; start.len()], data.rows, fill);
    let theta = bounded(&found.parameters);
    let left = sum_of_squares(&data.solve(form, &theta, None)?);
    left.is_finite().then_some(Found { theta, left })
}

/// Delays that may be tried on these records, rows.
pub(super) fn most_delay(longest: usize) -> f64 {
    (longest as f64 / 8.0).min(120.0)
}

/// Starts of a form, from the best lower orders if known.
fn starts(data: &Data, form: &Form, below: &[Option<Found>]) -> Vec<Vec<f64>> {
    let n = form.free_poles();
    let poles = |order: usize| {
        let of = below.get(order).and_then(Option::as_ref);
        of.map(|found| found.theta[..order].to_vec())
    };
    let slow = 4.0 / data.longest as f64;
    let rates = |count: usize| {
        (0..count).map(move |i| slow * (3.0 / slow).powf(i as f64 / (count - 1) as f64))
    };
    let mut out: Vec<Vec<f64>> = Vec::new();
    match n {
        0 => out.push(Vec::new()),
        1 => out.extend(rates(9).map(|rate| vec![rate.ln()])),
        _ => {
            if let Some(lower) = poles(n - 2) {
                for w in rates(9) {
                    for damping in DAMPINGS {
                        let mut theta = lower.clone();
                        theta.extend([(2.0 * damping * w).ln(), 2.0 * w.ln()]);
                        out.push(theta);
                    }
                }
            }
            if let Some(lower) = poles(n - 1) {
                for rate in rates(6) {
                    if n % 2 == 1 {
                        out.push([&[rate.ln()][..], &lower].concat());
                    } else {
                        let single = lower[0].exp();
                        let mut theta = lower[1..].to_vec();
                        theta.extend([(single + rate).ln(), (single * rate).ln()]);
                        out.push(theta);
                    }
                }
            }
        }
    }
    out
}

/// The best fit of a form on some rows: every start, the best three refined.
pub(super) fn search(data: &Data, form: &Form, below: &[Option<Found>]) -> Option<Found> {
    let longest = most_delay(data.longest);
    let n = form.free_poles();
    // Try further poles near the delay that the lower orders found.
    let known = |order: usize| Some(*below.get(order)?.as_ref()?.theta.get(order)?);
    let delays: Vec<f64> = match (form.delay, n) {
        (false, _) => Vec::new(),
        (true, 3..) => [known(n - 1), known(n - 2), Some(0.0)]
            .into_iter()
            .flatten()
            .collect(),
        (true, _) => DELAYS.into_iter().filter(|d| *d <= longest).collect(),
    };
    let mut tried: Vec<Found> = Vec::new();
    let mut attempt = |theta: Vec<f64>| {
        if let Some(solved) = data.solve(form, &theta, None) {
            let left = sum_of_squares(&solved);
            tried.push(Found { theta, left });
        }
    };
    for start in starts(data, form, below) {
        if delays.is_empty() {
            attempt(start);
            continue;
        }
        for delay in &delays {
            attempt([&start[..], &[*delay]].concat());
        }
    }
    tried.sort_by(|a, b| a.left.total_cmp(&b.left));
    tried.truncate(3);
    // Then scan the delay around each start.
    for found in &mut tried {
        let Some(centre) = found.theta.get(n).copied() else {
            continue;
        };
        for step in -12..=12 {
            let mut theta = found.theta.clone();
            theta[n] = (centre + f64::from(step) * (0.03 * centre).max(0.25)).clamp(0.0, longest);
            if let Some(solved) = data.solve(form, &theta, None) {
                let left = sum_of_squares(&solved);
                if left < found.left {
                    *found = Found { theta, left };
                }
            }
        }
    }
    tried
        .iter()
        .filter_map(|start| descend(data, form, &start.theta, longest))
        .min_by(|a, b| a.left.total_cmp(&b.left))
}

/// Factor by which a correlated residual widens every interval: the square root of its correlation time in rows.
fn widening(residual: &[f64]) -> f64 {
    let n = residual.len();
    let power: f64 = residual.iter().map(|e| e * e).sum();
    let mut sum = 1.0;
    for lag in 1..n / 20 {
        let product: f64 = residual.windows(lag + 1).map(|w| w[0] * w[lag]).sum();
        if product <= 0.05 * power {
            break;
        }
        sum += 2.0 * product / power;
    }
    sum.sqrt()
}

/// Whether a residual is a random walk: Durbin and Watson's ratio is far below 2.
fn is_walk(residual: &[f64]) -> bool {
    let levels: f64 = residual.iter().map(|e| e * e).sum();
    let changes: f64 = residual.windows(2).map(|w| (w[1] - w[0]).powi(2)).sum();
    levels > 0.0 && changes < 0.1 * levels
}

/// A fit as a model in seconds, with standard deviations.
pub(super) fn finished(data: &Data, form: &Form, found: &Found, rate_hz: f64) -> Option<BaseFit> {
    let solved = data.solve(form, &found.theta, None)?;
    let denominator = data.denominator(form, &found.theta);
    let delay = found.theta.get(form.free_poles()).copied().unwrap_or(0.0);
    let (n, m) = (form.order, solved.numerator.len() - 1);
    let left = sum_of_squares(&solved);
    let (sds, rows) = (
        deviations(data, form, &denominator, &solved, delay),
        data.rows as f64,
    );
    let free = form.parameters() as f64;
    let wide = widening(&solved.residual) * (left / (rows - free).max(1.0)).sqrt();
    let sd = |i: usize| sds.get(i).map_or(0.0, |v| v * wide);
    // Time in seconds from time in rows.
    let power = |i: usize| rate_hz.powi(i as i32);
    let numerator: Vec<f64> = (0..=m)
        .map(|i| solved.numerator[i] * power(n - m + i))
        .collect();
    let in_seconds: Vec<f64> = (0..=n).map(|i| denominator[i] * power(i)).collect();
    let poles = roots(&in_seconds);
    let gain = match form.integrating {
        true => solved.numerator[m] / denominator[n - 1],
        false => 0.0,
    };
    let residual_rms = (left / rows).sqrt() * data.output_rms;
    Some(BaseFit {
        form: Form {
            zeros: Some(m),
            ..*form
        },
        rest_input: (gain != 0.0).then(|| -solved.ramp / gain),
        output_rms: data.output_rms,
        residual_rms,
        held_out_rms: None,
        wanders: form.integrating && is_walk(&solved.residual),
        at_bound: data.at_bound(form, &found.theta),
        model: RationalFit {
            order: n,
            numerator_sd: (0..=m).map(|i| sd(i) * power(n - m + i)).collect(),
            denominator_sd: (0..=n)
                .map(|i| match i {
                    0 => 0.0,
                    i => sd(m + i) * power(i),
                })
                .collect(),
            delay_s: delay / rate_hz,
            delay_sd_s: if form.delay {
                sd(m + n + 1) / rate_hz
            } else {
                0.0
            },
            numerator,
            denominator: in_seconds,
            poles,
            chi2: left,
            dof: rows - free,
            aicc: rows * (left / rows).ln() + 2.0 * free,
        },
    })
}

/// Standard deviations for a residual of one per row: numerator, denominator without its first, delay.
fn deviations(
    data: &Data,
    form: &Form,
    denominator: &[f64],
    solved: &Solved,
    delay: f64,
) -> Vec<f64> {
    let m = solved.numerator.len();
    let n = form.order;
    let count = m + n + usize::from(form.delay);
    let mut jacobian = DMatrix::zeros(data.rows, count);
    for i in 0..count {
        let (mut b, mut a, mut late) = (solved.numerator.clone(), denominator.to_vec(), delay);
        let step = match i {
            i if i < m => {
                let step = 1e-4 * b.iter().fold(1e-12f64, |s, v| s.max(v.abs()));
                b[i] += step;
                step
            }
            // The pole at zero is not varied.
            i if i == m + n - 1 && form.integrating => continue,
            i if i < m + n => {
                let step = 1e-5 * a[i - m + 1].abs().max(1e-9);
                a[i - m + 1] += step;
                step
            }
            _ => {
                late += 1e-4;
                1e-4
            }
        };
        if let Some(moved) = data.solve_at(form, &a, late, Some(&b)) {
            for (k, (e, base)) in moved.residual.iter().zip(&solved.residual).enumerate() {
                jacobian[(k, i)] = (e - base) / step;
            }
        }
    }
    let inverse = covariance(&jacobian);
    (0..count)
        .map(|i| match i {
            i if i == m + n - 1 && form.integrating => 0.0,
            i => inverse[(i, i)].max(0.0).sqrt(),
        })
        .collect()
}
