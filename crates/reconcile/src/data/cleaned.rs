//! What is no noise in a record that shows nothing else: jumps, and lines at the mains.

use crate::thresholds::THRESHOLDS;
use std::f64::consts::TAU;

/// Rows that count, without those after an increment of more than `jump_sd` standard deviations (by the median of their sizes). A bead
/// that jumps is no noise: its jumps must not raise the floor that would then hide them.
pub(super) fn without_jumps(e: &[f64], present: &[bool]) -> Vec<bool> {
    let mut sizes: Vec<f64> = (1..e.len())
        .filter(|&k| present[k] && present[k - 1])
        .map(|k| (e[k] - e[k - 1]).abs())
        .collect();
    if sizes.is_empty() {
        return present.to_vec();
    }
    let middle = sizes.len() / 2;
    let (_, median, _) = sizes.select_nth_unstable_by(middle, f64::total_cmp);
    let limit = THRESHOLDS.jump_sd * 1.4826 * *median;
    (0..e.len())
        .map(|k| {
            let jumps = k > 0 && limit > 0.0 && (e[k] - e[k - 1]).abs() > limit;
            present[k] && !jumps
        })
        .collect()
}

/// Takes lines at 50 and 60 Hz and their second harmonics off; and how many numbers were fitted for that.
pub(super) fn without_lines(e: &[f64], present: &[bool], sample_s: f64) -> (Vec<f64>, usize) {
    let (mut clean, mut fitted) = (e.to_vec(), 0);
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
            fitted += 2;
            let (a, b) = ((cc * se - sc * ce) / det, (ss * ce - sc * se) / det);
            for (k, v) in clean.iter_mut().enumerate() {
                let (s, c) = (TAU * hz * sample_s * k as f64).sin_cos();
                *v -= a * s + b * c;
            }
        }
    }
    (clean, fitted)
}

/// Variance and lag-1 covariance of increments over runs of present frames, and how many increments.
pub(crate) fn increment_moments(r: &[f64], present: &[bool]) -> (f64, f64, usize) {
    let (mut c0, mut c1, mut n0, mut n1, mut mean) = (0.0, 0.0, 0usize, 0usize, 0.0);
    let valid = |k: usize| k >= 1 && present[k] && present[k - 1];
    for k in 1..r.len() {
        if valid(k) {
            mean += r[k] - r[k - 1];
            n0 += 1;
        }
    }
    if n0 == 0 {
        return (0.0, 0.0, 0);
    }
    mean /= n0 as f64;
    for k in 1..r.len() {
        if valid(k) {
            let d = r[k] - r[k - 1] - mean;
            c0 += d * d;
            if valid(k - 1) {
                c1 += d * (r[k - 1] - r[k - 2] - mean);
                n1 += 1;
            }
        }
    }
    (
        c0 / n0 as f64,
        if n1 > 0 { c1 / n1 as f64 } else { 0.0 },
        n0,
    )
}
