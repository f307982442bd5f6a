//! The noise floor, from the data: rest records and the scatter between periods, before any model is believed.

use crate::data::Record;
use crate::noise::{Noise, increment_moments};
use std::f64::consts::TAU;

/// Estimates both noises from residuals of the null model.
///
/// A rest record shows the noise itself (lines at the mains frequency and a drift taken off); of a record whose command
/// repeats, the difference of successive periods cancels every response that repeats. The smallest of these rules: a
/// misfit can only add. Without either, increments of the residuals are all there is: then the second answer, the number of
/// increments that can be trusted, is 0.
pub(crate) fn estimate(
    records: &[Record],
    present: &[Vec<bool>],
    residuals: &[Vec<f64>],
) -> (Noise, usize) {
    let mut found: Vec<(f64, f64, usize, f64)> = Vec::new();
    let mut fallback: Vec<(f64, f64, usize, f64)> = Vec::new();
    for ((r, present), e) in records.iter().zip(present).zip(residuals) {
        let (c0, c1, n, good) = if r.is_rest() {
            let clean = without_lines(e, present, r.sample_s);
            let (c0, c1, n) = increment_moments(&clean, &without_jumps(&clean, present));
            (c0, c1, n, true)
        } else if let Some(p) = r.period_rows() {
            let from = if r.rows() >= 4 * p { 2 * p } else { p };
            let rows = from..r.rows();
            let d: Vec<f64> = rows.clone().map(|k| e[k] - e[k - p]).collect();
            let ok: Vec<bool> = rows.map(|k| present[k] && present[k - p]).collect();
            let clean = without_lines(&d, &ok, r.sample_s);
            let (c0, c1, n) = increment_moments(&clean, &without_jumps(&clean, &ok));
            (0.5 * c0, 0.5 * c1, n, true)
        } else {
            let (c0, c1, n) = increment_moments(e, present);
            (c0, c1, n, false)
        };
        if n < 200 {
            continue;
        }
        let sigma = Noise::from_increments(c0, c1).innovation_um();
        if good {
            found.push((c0, c1, n, sigma))
        } else {
            fallback.push((c0, c1, n, sigma))
        }
    }
    let trusted = !found.is_empty();
    let pool = if found.is_empty() { fallback } else { found };
    let Some(least) = pool.iter().map(|f| f.3).min_by(f64::total_cmp) else {
        return (
            Noise::new(0.33, records.first().map_or(1e-3, |r| r.sample_s), 0.03),
            0,
        );
    };
    let (mut c0, mut c1, mut n) = (0.0, 0.0, 0.0);
    for f in pool.iter().filter(|f| f.3 <= 1.03 * least) {
        c0 += f.0 * f.2 as f64;
        c1 += f.1 * f.2 as f64;
        n += f.2 as f64;
    }
    (
        Noise::from_increments(c0 / n, c1 / n),
        if trusted { n as usize } else { 0 },
    )
}

/// From the innovations' own model: increments of the raw residuals of a fit that is believed.
pub(crate) fn from_residuals(present: &[Vec<bool>], residuals: &[Vec<f64>]) -> Noise {
    let (mut c0, mut c1, mut n) = (0.0, 0.0, 0.0);
    for (p, e) in present.iter().zip(residuals) {
        let (a, b, m) = increment_moments(e, p);
        c0 += a * m as f64;
        c1 += b * m as f64;
        n += m as f64;
    }
    if n == 0.0 {
        Noise::new(0.33, 1e-3, 0.03)
    } else {
        Noise::from_increments(c0 / n, c1 / n)
    }
}

/// Rows that count, without those after an increment of more than six standard deviations (by the median of their sizes):
/// a bead that jumps is no noise, and must not raise the floor under which its jumps would then hide.
fn without_jumps(e: &[f64], present: &[bool]) -> Vec<bool> {
    let mut sizes: Vec<f64> = (1..e.len())
        .filter(|&k| present[k] && present[k - 1])
        .map(|k| (e[k] - e[k - 1]).abs())
        .collect();
    if sizes.is_empty() {
        return present.to_vec();
    }
    let middle = sizes.len() / 2;
    let (_, median, _) = sizes.select_nth_unstable_by(middle, f64::total_cmp);
    let limit = 6.0 * 1.4826 * *median;
    (0..e.len())
        .map(|k| {
            let jumps = k > 0 && limit > 0.0 && (e[k] - e[k - 1]).abs() > limit;
            present[k] && !jumps
        })
        .collect()
}

/// Takes lines at 50 and 60 Hz and their second harmonics off.
fn without_lines(e: &[f64], present: &[bool], sample_s: f64) -> Vec<f64> {
    let mut clean = e.to_vec();
    for hz in [50.0, 60.0, 100.0, 120.0] {
        if hz * sample_s > 0.45 {
            continue;
        }
        // On increments, where the walk does not leak into the line.
        let (mut ss, mut cc, mut sc, mut se, mut ce) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for k in 1..clean.len() {
            if present[k] && present[k - 1] {
                let w = TAU * hz * sample_s;
                let (s1, c1) = (w * k as f64).sin_cos();
                let (s0, c0) = (w * (k - 1) as f64).sin_cos();
                let (s, c, d) = (s1 - s0, c1 - c0, clean[k] - clean[k - 1]);
                ss += s * s;
                cc += c * c;
                sc += s * c;
                se += s * d;
                ce += c * d;
            }
        }
        let det = ss * cc - sc * sc;
        if det > 1e-12 {
            let (a, b) = ((cc * se - sc * ce) / det, (ss * ce - sc * se) / det);
            for (k, v) in clean.iter_mut().enumerate() {
                let (s, c) = (TAU * hz * sample_s * k as f64).sin_cos();
                *v -= a * s + b * c;
            }
        }
    }
    clean
}
