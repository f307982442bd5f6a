//! Least-squares fit of sines plus polynomial drift to a record, block by block.
//!
//! A bare FFT puts `v/(pi f)` of a drift `v` into every bin, whatever the record's length; here the drift has separate regressors. The
//! noise of a freely diffusing bead is a random walk, so its increments are white, and least squares on them is the best linear estimate.
//! The fit uses increments and converts the phasors back exactly (`Y = dY/(1 - e^(-jw))`). Over rows without a bead (`NaN`) one longer
//! increment is fitted. Otherwise the bead's motion there would be missing from the output and not from the input, and a loop without a
//! position gives other commands. Not for records whose input is not periodic.

use nalgebra::{Complex, DMatrix, DVector};

/// In which form the noise of a signal is closest to white.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Whitening {
    /// Fit the samples themselves: white measurement noise.
    Levels,
    /// Fit the differences of neighbouring samples: a random walk.
    Increments,
}

/// What to fit besides the sines.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ToneFit {
    /// Degree of the drift polynomial in each block: 0 an offset, 1 a steady drift, 2 a drift that changes steadily.
    pub drift_degree: usize,
    /// The form in which the noise is white.
    pub whitening: Whitening,
}

impl Default for ToneFit {
    fn default() -> Self {
        Self {
            drift_degree: 2,
            whitening: Whitening::Increments,
        }
    }
}

/// Phasors of one block: the signal holds `Re(phasor e^(j 2 pi f k T))` with `k` counted from the start of the record.
#[derive(Debug, Clone, PartialEq)]
pub struct BlockPhasors {
    /// One phasor per frequency, in the signal's unit (peak amplitude).
    pub phasors: Vec<Complex<f64>>,
    /// Drift polynomial (of increments, if they are fitted), constant first, over -1 to 1 from the block's first row to its end.
    pub drift: Vec<f64>,
    /// Variance of each phasor, `E|error|^2`, for white rows (levels or increments) of variance 1. A block of few periods does not part a
    /// sine from drift and from the other sines, so it is more than `4 / rows`.
    pub spread: Vec<f64>,
    /// Degrees of freedom of `|error|^2` of each phasor: 2 if both quadratures are as uncertain, nearly 1 if drift hides one.
    pub freedom: Vec<f64>,
    /// Residual variance per real row (levels or increments), unit^2.
    pub residual_variance: f64,
    /// Rows that took part.
    pub rows: usize,
}

/// Fits `frequencies_hz` and drift to rows `from..to` of `signal`; `None` if too few rows hold a value, or if the block is too short
/// to separate the frequencies.
pub fn fit_block(
    signal: &[f64],
    from: usize,
    to: usize,
    period_s: f64,
    frequencies_hz: &[f64],
    fit: ToneFit,
) -> Option<BlockPhasors> {
    let to = to.min(signal.len());
    let increments = fit.whitening == Whitening::Increments;
    let first = if increments { from + 1 } else { from };
    let drift_columns = if increments {
        fit.drift_degree
    } else {
        fit.drift_degree + 1
    };
    let columns = 2 * frequencies_hz.len() + drift_columns;
    let angles: Vec<f64> = frequencies_hz
        .iter()
        .map(|f| 2.0 * std::f64::consts::PI * f * period_s)
        .collect();
    let middle = 0.5 * (from + to) as f64;
    let half = (0.5 * to.saturating_sub(from) as f64).max(1.0);

    let mut normal = DMatrix::<f64>::zeros(columns, columns);
    let mut right = DVector::<f64>::zeros(columns);
    let mut sum_squares = 0.0;
    let mut rows = 0usize;
    // Regressors of the rows since the last one with a value: an increment over a gap is the sum of its rows' increments.
    let mut row = vec![0.0; columns];
    let mut since = 0;
    let mut last = if increments {
        signal.get(from).copied().unwrap_or(f64::NAN)
    } else {
        0.0
    };
    let mut rotors: Vec<Complex<f64>> = angles
        .iter()
        .map(|a| Complex::from_polar(1.0, (a * first as f64) % (2.0 * std::f64::consts::PI)))
        .collect();
    let steps: Vec<Complex<f64>> = angles
        .iter()
        .map(|&a| Complex::from_polar(1.0, a))
        .collect();
    for (k, &level) in signal.iter().enumerate().take(to).skip(first) {
        for (i, r) in rotors.iter().enumerate() {
            row[2 * i] += r.re;
            row[2 * i + 1] += r.im;
        }
        let x = (k as f64 - middle) / half;
        for d in 0..drift_columns {
            row[2 * angles.len() + d] += x.powi(d as i32);
        }
        since += 1;
        let value = level - last;
        if value.is_finite() {
            // The variance of a walk grows by the row.
            let weight = 1.0 / f64::from(since);
            for (i, &a) in row.iter().enumerate() {
                right[i] += weight * a * value;
                for (j, &b) in row[..=i].iter().enumerate() {
                    normal[(i, j)] += weight * a * b;
                }
            }
            sum_squares += weight * value * value;
            rows += 1;
        }
        // Levels that are missing are left out; so are rows before the first value.
        if !increments || value.is_finite() || !last.is_finite() {
            row.fill(0.0);
            since = 0;
            if increments {
                last = level;
            }
        }
        for (r, s) in rotors.iter_mut().zip(&steps) {
            *r *= s;
        }
    }
    if rows < columns + 2 {
        return None;
    }
    normal.fill_upper_triangle_with_lower_triangle();
    let diagonal_floor = 1e-9 * rows as f64;
    let factor = normal.cholesky()?;
    if (0..columns).any(|i| factor.l_dirty()[(i, i)].powi(2) < diagonal_floor * 1e-3) {
        return None;
    }
    let solved = factor.solve(&right);
    let explained = solved.dot(&right);
    let (spread, freedom) = certainty(&factor.inverse(), &angles, increments);
    let phasors = angles
        .iter()
        .enumerate()
        .map(|(i, &angle)| {
            let phasor = Complex::new(solved[2 * i], -solved[2 * i + 1]);
            if increments {
                phasor / (1.0 - Complex::from_polar(1.0, -angle))
            } else {
                phasor
            }
        })
        .collect();
    Some(BlockPhasors {
        phasors,
        spread,
        freedom,
        drift: solved.iter().skip(2 * angles.len()).copied().collect(),
        residual_variance: ((sum_squares - explained) / (rows - columns) as f64).max(0.0),
        rows,
    })
}

/// [`BlockPhasors::spread`] and [`BlockPhasors::freedom`] from the inverse of the normal matrix.
fn certainty(inverse: &DMatrix<f64>, angles: &[f64], increments: bool) -> (Vec<f64>, Vec<f64>) {
    let of = |(i, &angle): (usize, &f64)| {
        let at = |row: usize, column: usize| inverse[(2 * i + row, 2 * i + column)];
        let both = at(0, 0) + at(1, 1);
        let squares = at(0, 0).powi(2) + at(1, 1).powi(2) + 2.0 * at(0, 1).powi(2);
        let power = match increments {
            true => (1.0 - Complex::from_polar(1.0, -angle)).norm_sqr(),
            false => 1.0,
        };
        (both / power, both * both / squares)
    };
    angles.iter().enumerate().map(of).unzip()
}

/// Cuts `rows` into at most `most` blocks. Each holds a whole number of periods of `frequency_hz`, as nearly as rows allow, and at least
/// `min_periods`. Returns the blocks' borders (one more than blocks).
pub fn block_borders(
    from: usize,
    to: usize,
    period_s: f64,
    frequency_hz: f64,
    min_periods: f64,
    most: usize,
) -> Vec<usize> {
    let rows = to.saturating_sub(from) as f64;
    let per_period = 1.0 / (frequency_hz * period_s);
    let periods = rows / per_period;
    let blocks = ((periods / min_periods).floor() as usize)
        .min(most)
        .min((rows / 24.0) as usize)
        .max(1);
    // Whole periods per block, if that loses little of the record.
    let per_block = (periods / blocks as f64).floor().max(1.0) * per_period;
    let length = if per_block * blocks as f64 > 0.9 * rows {
        per_block
    } else {
        rows / blocks as f64
    };
    (0..=blocks)
        .map(|i| from + (i as f64 * length).round().min(rows) as usize)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const TWO_PI: f64 = 2.0 * std::f64::consts::PI;

    fn record(n: usize, f: &[(f64, Complex<f64>)], drift_um_per_s: f64) -> Vec<f64> {
        (0..n)
            .map(|k| {
                let t = k as f64 * 1e-3;
                let tones: f64 = f
                    .iter()
                    .map(|(f, a)| (a * Complex::from_polar(1.0, TWO_PI * f * t)).re)
                    .sum();
                3.0 + drift_um_per_s * t + 0.4 * t * t + tones
            })
            .collect()
    }

    #[test]
    fn sines_over_drift_are_recovered_exactly_from_levels_and_from_increments() {
        let truth = [
            (7.3, Complex::new(1.0, -0.4)),
            (120.0, Complex::new(-0.02, 0.05)),
        ];
        let signal = record(1500, &truth, 10.0);
        for whitening in [Whitening::Levels, Whitening::Increments] {
            let fit = ToneFit {
                drift_degree: 2,
                whitening,
            };
            let block = fit_block(&signal, 100, 1337, 1e-3, &[7.3, 120.0], fit).unwrap();
            for (found, (_, expected)) in block.phasors.iter().zip(&truth) {
                assert!(
                    (found - expected).norm() < 1e-9,
                    "{found} against {expected}"
                );
            }
            assert!(block.residual_variance < 1e-10);
        }
    }

    #[test]
    fn over_rows_without_a_bead_there_is_one_increment() {
        let truth = [(5.0, Complex::new(0.7, 0.1))];
        let mut signal = record(1000, &truth, -3.0);
        for k in (0..1000).step_by(37) {
            signal[k] = f64::NAN;
        }
        let block = fit_block(&signal, 0, 1000, 1e-3, &[5.0], ToneFit::default()).unwrap();
        assert!((block.phasors[0] - truth[0].1).norm() < 1e-9);
        // 999 increments; the two about each missing row inside become one, and those at the first and the last row are lost.
        assert_eq!(block.rows, 999 - 26 - 2);
    }

    #[test]
    fn frequencies_that_a_block_cannot_tell_apart_are_refused() {
        let signal = record(60, &[(5.0, Complex::new(1.0, 0.0))], 0.0);
        assert_eq!(
            fit_block(&signal, 0, 60, 1e-3, &[5.0, 5.000_1], ToneFit::default()),
            None
        );
    }

    #[test]
    fn blocks_hold_whole_periods() {
        let borders = block_borders(200, 5200, 1e-3, 2.0, 1.0, 20);
        assert_eq!(borders.len(), 11);
        assert!(borders.windows(2).all(|w| w[1] - w[0] == 500));
    }
}
