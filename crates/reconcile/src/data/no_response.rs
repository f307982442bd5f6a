//! The noise of a bead that is held in closed loop, where the command neither rests nor repeats: what no linear response to it explains.
//!
//! An innovation does not depend on the command before it, in a closed loop either, where the command follows the noise. So the
//! innovations of a residual, less their regression on the command of the last second, are those of the noise: every linear error of
//! the model is off. A nonlinear one stays and adds to them; it takes nothing away.

use crate::data::cleaned::increment_moments;
use crate::data::noise::NoiseModel;
use crate::data::record::Record;
use crate::data::row_noise::RowNoise;
use crate::data::whitener::Whitener;
use crate::dot::dot;
use crate::thresholds::THRESHOLDS;
use nalgebra::{DMatrix, DVector};
use std::ops::Range;

/// Rows of the command that have a number each, and the last row that has one, in a block with others: a block is a quarter as long as
/// the way to it.
const SINGLE: usize = 24;
const LAST: usize = 1000;
/// Rows that one number needs: the regression takes the share of a number from the noise, known to its own error only.
const ROWS_A_NUMBER: usize = 10;

/// How many rows ago each block of the command begins, and its length. The command of a frame's own row may follow from that frame.
fn blocks() -> Vec<(usize, usize)> {
    let mut blocks: Vec<(usize, usize)> = (1..SINGLE).map(|lag| (lag, 1)).collect();
    let mut lag = SINGLE;
    while lag < LAST {
        let rows = lag / 4;
        blocks.push((lag, rows));
        lag += rows;
    }
    blocks
}

/// A residual without what follows the command linearly, and how many numbers were fitted for that. `None` of a record too short, or with
/// values that are no numbers. Before the record the command rested where it begins.
pub(super) fn without_response(
    command_um: &[f64],
    residual_um: &[f64],
    present: &[bool],
    noise: &NoiseModel,
) -> Option<(Vec<f64>, usize)> {
    let whitener = Whitener::new(noise, present, &RowNoise::default());
    let rows = residual_um.len().min(command_um.len());
    let blocks = blocks();
    if whitener.count() < ROWS_A_NUMBER * (blocks.len() + 1) {
        return None;
    }
    let u = |k: usize, lag: usize| command_um[k.saturating_sub(lag)] - command_um[0];
    // A bead goes on with a speed: positions are sums over what the command made of it. The last column is a steady flow.
    let path = |speed: &mut dyn FnMut(usize) -> f64| -> Vec<f64> {
        let mut x = 0.0;
        (0..rows)
            .map(|k| {
                x += speed(k);
                x
            })
            .collect()
    };
    let mut columns: Vec<Vec<f64>> = (blocks.iter())
        .map(|&(first, n)| {
            // The sum over a block, from row to row.
            let mut sum = 0.0;
            path(&mut |k| {
                sum += u(k, first) - u(k, first + n);
                sum
            })
        })
        .collect();
    columns.push(path(&mut |_| 1.0));
    let white = |x: &[f64]| {
        let mut w = vec![0.0; x.len()];
        whitener.apply(x, &mut w);
        (w.iter_mut().enumerate()).for_each(|(k, w)| *w *= f64::from(u8::from(whitener.counts(k))));
        w
    };
    let e = white(&residual_um[..rows]);
    let whitened: Vec<Vec<f64>> = columns.iter().map(|c| white(c)).collect();
    // A stretch shorter than the command's blocks has columns of zeros.
    let sizes: Vec<f64> = (whitened.iter())
        .map(|w| dot(w, w).sqrt())
        .map(|size| if size > 0.0 { size } else { 1.0 })
        .collect();
    let n = columns.len();
    let normal = DMatrix::from_fn(n, n, |i, j| {
        dot(&whitened[i], &whitened[j]) / (sizes[i] * sizes[j])
    });
    let right = DVector::from_fn(n, |i, _| dot(&whitened[i], &e) / sizes[i]);
    if !normal.iter().chain(&right).all(|x| x.is_finite()) {
        return None;
    }
    // A command of few lines leaves combinations of the columns open: they are no numbers of the fit.
    const OPEN: f64 = 1e-10;
    let svd = normal.svd(true, true);
    let fitted = svd.rank(OPEN);
    let numbers = svd.solve(&right, OPEN).ok()?;
    let mut clean = residual_um.to_vec();
    for ((column, number), size) in columns.iter().zip(numbers.iter()).zip(&sizes) {
        for (v, c) in clean.iter_mut().zip(column) {
            *v -= number / size * c;
        }
    }
    Some((clean, fitted))
}

/// Stretches of a record in which the command moves the bead by less than the noise does, by the model.
pub(super) fn holds(r: &Record, e: &[f64], present: &[bool]) -> Vec<Range<usize>> {
    let block = THRESHOLDS.floor_rows;
    let mut found: Vec<Range<usize>> = Vec::new();
    for start in (0..e.len() / block).map(|i| i * block) {
        let rows = start..start + block;
        let of_steps = |path: &[f64]| increment_moments(path, &present[rows.clone()]).0;
        let noise = of_steps(&e[rows.clone()]);
        let bead = &r.bead_um[rows.clone()];
        let model: Vec<f64> = bead
            .iter()
            .zip(&e[rows.clone()])
            .map(|(y, e)| y - e)
            .collect();
        if noise == 0.0 || of_steps(&model) >= noise {
            continue;
        }
        match found.last_mut() {
            Some(before) if before.end == start => before.end = rows.end,
            _ => found.push(rows),
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_numeric::Random;

    /// A bead in a loop whose command follows from each frame and acts three rows later, with a gain that the model does not have: the
    /// residual beside a model of gain 0.4 a row.
    fn closed(rows: usize, gain: f64, seed: u64) -> (Vec<f64>, Vec<f64>) {
        let mut random = Random::new(seed);
        let (mut x, mut model) = (0.0, 0.0);
        let (mut u, mut e) = (vec![0.0; 3], Vec::new());
        for k in 0..rows {
            let late = u[u.len() - 3];
            x += gain * late + 0.026 * random.normal();
            model += 0.4 * late;
            let seen = x + 0.002 * random.normal();
            e.push(seen - model);
            u.push(0.2 * (0.03 * (k * k % 5000) as f64).sin() - 0.6 * seen);
        }
        (u[3..].to_vec(), e)
    }

    #[test]
    fn in_a_closed_loop_with_a_wrong_gain_the_noise_is_what_it_is() {
        for (gain, seed) in [(0.4, 1), (0.3, 2), (0.55, 3), (0.2, 4)] {
            let rows = 16_000;
            let (u, e) = closed(rows, gain, seed);
            let present = vec![true; rows];
            let noise = NoiseModel::new(0.33, 1e-3, 0.002);
            let (clean, fitted) = without_response(&u, &e, &present, &noise).unwrap();
            let squares: f64 = clean.windows(2).map(|w| (w[1] - w[0]).powi(2)).sum();
            let found =
                squares / (rows - fitted) as f64 / (0.026f64.powi(2) + 2.0 * 0.002f64.powi(2));
            // 16,000 squares scatter by 1.1 %.
            assert!((found - 1.0).abs() < 0.035, "{gain} {seed}: {found}");
        }
    }

    #[test]
    fn a_hold_that_is_shorter_than_the_command_is_looked_back_upon_has_its_noise() {
        let (u, e) = closed(800, 0.3, 5);
        let noise = NoiseModel::new(0.33, 1e-3, 0.002);
        let (clean, fitted) = without_response(&u, &e, &[true; 800], &noise).unwrap();
        let squares: f64 = clean.windows(2).map(|w| (w[1] - w[0]).powi(2)).sum();
        let found = squares / (800 - fitted) as f64 / (0.026f64.powi(2) + 2.0 * 0.002f64.powi(2));
        // 800 squares scatter by 5 %.
        assert!((found - 1.0).abs() < 0.15, "{found}");
        // A value that is no number ends it, too.
        let mut e = e;
        e[400] = f64::NAN;
        assert!(without_response(&u, &e, &[true; 800], &noise).is_none());
    }
}
