//! Coloured noise of a sensor: a first-order Gauss-Markov process together with walk and white noise. It is fitted by likelihood
//! to rows of noise alone, and believed only if it leaves white innovations.
//!
//! A walk in its stead would swallow every slow error of a model of a static sensor; white noise alone would call the slow noise
//! an error. Not for lines: a line is no noise, and a fit that leaves one is refused.

use crate::data::noise::{Coloured, NoiseModel};
use crate::data::row_noise::RowNoise;
use crate::data::whitener::Whitener;
use cellpos_numeric::fft;

/// Which noise the records are taken to have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum NoiseKind {
    /// A walk and white noise; coloured noise where the model states no diffusion and the likelihood asks for it.
    #[default]
    Auto,
    /// A walk and white noise: a bead.
    Walk,
    /// Coloured and white noise, and a walk only where the likelihood asks for it.
    Coloured,
    /// White noise alone: whatever is slow is an error of the model.
    White,
}

/// Least gain of coloured noise over a walk in twice the log-likelihood: two numbers, beyond chance, and a margin because no noise
/// is exactly of either kind.
const WORTH: f64 = 30.0;
/// Least gain of a walk next to coloured noise.
const WORTH_OF_WALK: f64 = 15.0;
/// Largest ordinate of the periodogram of white innovations, in units of its mean: one in 10^13 each.
const LINE: f64 = 30.0;
/// Rows that are looked at.
const MOST_ROWS: usize = 12_000;
/// Times with which a descent begins \[rows\].
const STARTS: [f64; 4] = [3.0, 12.0, 50.0, 250.0];

/// Noise seen alone: differences of equal parts of a record, or a record at rest; and which rows count.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Alone<'a> {
    pub values: &'a [f64],
    pub counts: &'a [bool],
    /// Variance of the noise in parts of that of the values: 1/2 of a difference.
    pub share: f64,
}

/// Twice the negative log-likelihood of noise of a shape, its size set free, and that size (of a white variance of 1).
fn cost(alone: &Alone<'_>, shape: &NoiseModel) -> (f64, f64) {
    let w = Whitener::new(shape, alone.counts, &RowNoise::default());
    let mut e = vec![0.0; alone.values.len()];
    w.apply(alone.values, &mut e);
    let n = w.count().max(1) as f64;
    let size = (e.iter().map(|e| e * e).sum::<f64>() / n).max(1e-300);
    (n * size.ln() + w.log_determinant(), size)
}

/// A shape: white variance 1, logarithms of the other variances over it; `None` without them.
#[derive(Debug, Clone, Copy)]
struct Shape {
    walk: Option<f64>,
    /// Variance and time \[rows\].
    coloured: Option<(f64, f64)>,
}

impl Shape {
    fn noise(self) -> NoiseModel {
        NoiseModel {
            walk_um2: self.walk.map_or(0.0, f64::exp),
            white_um2: 1.0,
            zero_flow: None,
            coloured: self.coloured.map(|(variance, rows)| Coloured {
                variance_um2: variance.exp(),
                time_rows: rows.exp(),
            }),
        }
    }

    /// The neighbours of a step, as far as they differ from white noise and from a level.
    fn neighbours(self, step: f64, most_rows: f64) -> Vec<Self> {
        let mut all = Vec::new();
        for way in [-step, step] {
            if let Some(walk) = self.walk {
                let walk = Some((walk + way).clamp(-20.0, 12.0));
                all.push(Self { walk, ..self });
            }
            if let Some((variance, rows)) = self.coloured {
                let other = |v: f64, r: f64| Self {
                    coloured: Some((v.clamp(-12.0, 12.0), r.clamp(0.0, most_rows.ln()))),
                    ..self
                };
                all.push(other(variance + way, rows));
                all.push(other(variance, rows + way));
            }
        }
        all
    }
}

/// Descends from a shape by steps that become smaller.
fn descend(alone: &Alone<'_>, mut shape: Shape) -> (Shape, f64) {
    // A time longer than a third of what is seen is a walk.
    let most_rows = (alone.values.len() as f64 / 3.0).max(2.0);
    let (mut least, _) = cost(alone, &shape.noise());
    let mut step = 1.6;
    while step > 0.02 {
        let best = shape
            .neighbours(step, most_rows)
            .into_iter()
            .map(|s| (s, cost(alone, &s.noise()).0))
            .min_by(|a, b| a.1.total_cmp(&b.1));
        match best {
            Some((s, c)) if c < least - 1e-3 => (shape, least) = (s, c),
            _ => step *= 0.5,
        }
    }
    (shape, least)
}

/// The best shape with coloured noise and no walk: a descent from the best of some shapes.
fn coloured(alone: &Alone<'_>) -> Option<(Shape, f64)> {
    let shapes = STARTS.iter().flat_map(|rows| {
        [-2.0, 0.0, 2.0].map(|variance| Shape {
            walk: None,
            coloured: Some((variance, rows.ln())),
        })
    });
    shapes
        .map(|s| (s, cost(alone, &s.noise()).0))
        .min_by(|a, b| a.1.total_cmp(&b.1))
        .map(|(s, _)| descend(alone, s))
}

/// Whether the innovations under a noise hold no line: the periodogram of white ones has none above its mean times [`LINE`].
fn is_white(alone: &Alone<'_>, noise: &NoiseModel) -> bool {
    let mut e = vec![0.0; alone.values.len()];
    Whitener::new(noise, alone.counts, &RowNoise::default()).apply(alone.values, &mut e);
    let powers: Vec<f64> = fft::forward(&mut e)
        .iter()
        .skip(1)
        .map(|x| x.norm_sqr())
        .collect();
    let mean = powers.iter().sum::<f64>() / powers.len().max(1) as f64;
    powers.iter().all(|p| *p < LINE * mean)
}

/// The noise of a kind that is seen alone: what `walk` (a walk and white noise) comes to where its likelihood asks for another.
pub(crate) fn choose(kind: NoiseKind, walk: NoiseModel, alone: &Alone<'_>) -> NoiseModel {
    let n = alone.values.len().min(MOST_ROWS);
    let alone = Alone {
        values: &alone.values[..n],
        counts: &alone.counts[..n],
        ..*alone
    };
    let sized = |shape: Shape| {
        let noise = shape.noise();
        let size = cost(&alone, &noise).1 * alone.share;
        noise.scaled(size)
    };
    let white = Shape {
        walk: None,
        coloured: None,
    };
    match kind {
        NoiseKind::Walk => return walk,
        NoiseKind::White => return sized(white),
        NoiseKind::Auto | NoiseKind::Coloured => {}
    }
    let ratio = (walk.walk_um2 / walk.white_um2.max(1e-300)).max(1e-12).ln();
    let from_walk = descend(
        &alone,
        Shape {
            walk: Some(ratio),
            coloured: None,
        },
    );
    let Some(without) = coloured(&alone) else {
        return walk;
    };
    let with = descend(
        &alone,
        Shape {
            walk: Some(-6.0),
            ..without.0
        },
    );
    let best = if with.1 < without.1 - WORTH_OF_WALK {
        with
    } else {
        without
    };
    let asked = kind == NoiseKind::Coloured;
    if !asked && best.1 > from_walk.1 - WORTH {
        return walk;
    }
    let noise = sized(best.0);
    if asked || is_white(&alone, &noise) {
        noise
    } else {
        walk
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Coloured noise of a variance and a time, white noise of 1, a walk, and a line, the same each time.
    fn series(n: usize, [variance, rows, walk, line]: [f64; 4], seed: u64) -> Vec<f64> {
        let mut random = cellpos_numeric::Random::new(seed);
        let keep = (-1.0 / rows).exp();
        let (mut c, mut m) = (variance.sqrt() * random.normal(), 0.0);
        (0..n)
            .map(|k| {
                c = keep * c + (variance * (1.0 - keep * keep)).sqrt() * random.normal();
                m += walk.sqrt() * random.normal();
                7.0 + m + c + random.normal() + line * (0.23 * k as f64).sin()
            })
            .collect()
    }

    fn chosen(values: &[f64], kind: NoiseKind) -> NoiseModel {
        let counts = vec![true; values.len()];
        let (c0, c1, _) = crate::data::cleaned::increment_moments(values, &counts);
        let alone = Alone {
            values,
            counts: &counts,
            share: 1.0,
        };
        choose(kind, NoiseModel::from_increments(c0, c1), &alone)
    }

    #[test]
    fn coloured_noise_is_found_with_its_size_and_time() {
        let noise = chosen(&series(12_000, [4.0, 40.0, 0.0, 0.0], 3), NoiseKind::Auto);
        let c = noise.coloured.expect("coloured");
        // 12000 rows are 150 times of 40: the variance is known to 12 % each way; three such errors.
        assert!((c.variance_um2 / 4.0).ln().abs() < 0.4, "{noise:?}");
        assert!((c.time_rows / 40.0).ln().abs() < 0.4, "{noise:?}");
        assert!((noise.white_um2 - 1.0).abs() < 0.1, "{noise:?}");
        assert!(noise.walk_um2 < 1e-12, "{noise:?}");
    }

    #[test]
    fn a_walk_with_white_noise_stays_one() {
        for seed in 1..4 {
            let noise = chosen(&series(3000, [0.0, 5.0, 0.7, 0.0], seed), NoiseKind::Auto);
            assert!(noise.coloured.is_none(), "{noise:?}");
        }
    }

    #[test]
    fn a_line_is_no_coloured_noise() {
        let values = series(8000, [0.0, 5.0, 0.01, 2.0], 9);
        assert!(chosen(&values, NoiseKind::Auto).coloured.is_none());
    }

    #[test]
    fn white_noise_alone_has_the_variance_of_the_values() {
        let values = series(8000, [0.0, 5.0, 0.0, 0.0], 5);
        let noise = chosen(&values, NoiseKind::White);
        assert!((noise.white_um2 - 1.0).abs() < 0.06, "{noise:?}");
        assert!(noise.walk_um2 == 0.0 && noise.coloured.is_none());
    }
}
