//! Amplitude, phase and pixel of an error periodic in position, by the exact filter of the position.
//!
//! The fit of `evaluate` takes the position from the neighbouring rows. Those rows have the error and the walk in them. If the
//! slope of the error is some tenths, a value read from them is blurred and bent, and the amplitude becomes too small. Here
//! nothing is linearised. The density of the walk at each row is carried on a grid (Bucy and Senne 1971, Automatica 7:287,
//! point-mass filter). It is convolved with the step of the walk and multiplied by the likelihood `y - a sin(2 pi x/p) - b cos(2
//! pi x/p)` of the row. The normalising factors are the likelihood of the record, whose derivatives row by row give the scoring
//! steps and the covariance.

use crate::data::noise::NoiseModel;
use crate::fit::context::{Context, Fit};
use crate::fit::position_error::{Locking, Numbers};
use cellpos_plant::effects::Role;
use nalgebra::Matrix5;
use std::f64::consts::TAU;

/// One record without everything else that is known: `seen = walk + error(path + walk) + noise`.
struct Track {
    path_um: Vec<f64>,
    seen_um: Vec<f64>,
    present: Vec<bool>,
}

/// Most points of the grid. Beyond it one noise is so small compared with the other that this kind of filter is wrong.
const MOST_POINTS: usize = 600;

/// Grid and tables for one pixel and one pair of noises.
struct Grid {
    step_um: f64,
    /// Points on each side of the middle.
    half: usize,
    kernel: Vec<f64>,
    /// Sine and cosine of the angle of each point from the middle.
    turn: Vec<[f64; 2]>,
    inverse_white: f64,
}

impl Grid {
    /// `None` where the grid would have too many points.
    fn new(noise: &NoiseModel, wave_um: [f64; 2], pixel_um: f64) -> Option<Self> {
        let (q, r) = (noise.walk_um2, noise.white_um2);
        let step_um = (0.4 * q.sqrt().min(r.sqrt())).min(pixel_um / 24.0);
        let ahead = 0.5 * (q + (q * q + 4.0 * q * r).sqrt());
        let half = ((5.5 * ahead.sqrt() + wave_um[0].hypot(wave_um[1])) / step_um).ceil() as usize;
        if 2 * half + 1 > MOST_POINTS {
            return None;
        }
        let reach = (5.0 * q.sqrt() / step_um).ceil() as i64;
        let kernel: Vec<f64> = (-reach..=reach)
            .map(|i| (-0.5 * (i as f64 * step_um).powi(2) / q).exp())
            .collect();
        let sum: f64 = kernel.iter().sum();
        let turn = (0..=2 * half)
            .map(|i| {
                let (s, c) = (TAU * (i as f64 - half as f64) * step_um / pixel_um).sin_cos();
                [s, c]
            })
            .collect();
        Some(Self {
            step_um,
            half,
            kernel: kernel.into_iter().map(|k| k / sum).collect(),
            turn,
            inverse_white: 1.0 / r,
        })
    }

    /// Log-likelihood of each row of a record, up to a constant; 0 where nothing was seen, and at the start.
    fn rows(&self, track: &Track, [a, b]: [f64; 2], pixel_um: f64) -> Vec<f64> {
        let points = 2 * self.half + 1;
        let reach = self.kernel.len() / 2;
        let mut density = vec![0.0; points];
        // Room on both sides for the reach of the kernel and a shift of the middle.
        let pad = points + reach;
        let mut wide = vec![0.0; points + 2 * pad];
        let mut middle: Option<i64> = None;
        let mut out = vec![0.0; track.seen_um.len()];
        let mut mean_um = 0.0;
        for (k, out) in out.iter_mut().enumerate() {
            if let Some(at) = middle {
                let next = (mean_um / self.step_um).round() as i64;
                let shift = (next - at).clamp(-(points as i64), points as i64);
                wide[pad..pad + points].copy_from_slice(&density);
                density.fill(0.0);
                let from = (pad as i64 + shift) as usize - reach;
                for (i, w) in self.kernel.iter().enumerate() {
                    for (d, x) in density.iter_mut().zip(&wide[from + i..]) {
                        *d += w * x;
                    }
                }
                middle = Some(at + shift);
            }
            if !track.present[k] {
                continue;
            }
            let seen = track.seen_um[k];
            let first_seen = middle.is_none();
            let at = *middle.get_or_insert_with(|| {
                density.fill(1.0);
                (seen / self.step_um).round() as i64
            });
            let centre = at as f64 * self.step_um;
            let (s0, c0) = (TAU * (track.path_um[k] + centre) / pixel_um).sin_cos();
            let (along, across) = (a * c0 - b * s0, a * s0 + b * c0);
            let (mut sum, mut first) = (0.0, 0.0);
            for (i, (d, [s, c])) in density.iter_mut().zip(&self.turn).enumerate() {
                let x = (i as f64 - self.half as f64) * self.step_um;
                let e = seen - centre - x - across * c - along * s;
                *d *= (-0.5 * e * e * self.inverse_white).exp();
                sum += *d;
                first += *d * x;
            }
            if sum > 1e-200 {
                if !first_seen {
                    *out = sum.ln() + 0.5 * self.inverse_white.ln();
                }
                let scale = 1.0 / sum;
                density.iter_mut().for_each(|d| *d *= scale);
                mean_um = centre + first * scale;
            } else {
                // Beyond the window: the bead is searched for again.
                middle = None;
            }
        }
        out
    }
}

/// Refines part `index` of a fit; `None` if that is no periodic error or the grid would be too large.
pub(crate) fn refine(
    ctx: &Context<'_>,
    fit: &Fit,
    index: usize,
    threads: usize,
) -> Option<Locking> {
    let part = fit.parts.get(index)?;
    if part.variant().role != Role::Position {
        return None;
    }
    let at = fit.parts[..index]
        .iter()
        .filter(|p| p.variant().role == Role::Position)
        .count();
    let tracks = tracks(ctx, fit, at);
    let noise = &ctx.problem.noise;
    let pixel = part.natural()[0];
    let sharpness = noise.sharpness(pixel);
    let mut x = Numbers::new(
        fit.positions[at][0] / sharpness,
        fit.positions[at][1] / sharpness,
        pixel.ln(),
        noise.walk_um2.ln(),
        noise.white_um2.max(1e-3 * noise.walk_um2).ln(),
    );
    let rows = |x: &Numbers| -> Option<Vec<Vec<f64>>> {
        let (wave, pixel) = ([x[0], x[1]], x[2].exp());
        let noise = NoiseModel {
            walk_um2: x[3].exp(),
            white_um2: x[4].exp(),
            coloured: None,
            zero_flow: None,
        };
        let grid = Grid::new(&noise, wave, pixel)?;
        Some(cellpos_numeric::parallel::map(&tracks, threads, |t| {
            grid.rows(t, wave, pixel)
        }))
    };
    // Over the whole way of the bead the phase of the wave must not turn by more than a little.
    let way = tracks
        .iter()
        .flat_map(|t| &t.path_um)
        .fold(1.0f64, |m, p| m.max(p.abs()));
    let reach = [
        0.2 * pixel,
        0.2 * pixel,
        0.4 * pixel / (TAU * way),
        0.5,
        0.5,
    ];
    // One-sided differences: their error is proportional to the step.
    let steps = reach.map(|r| 2e-3 * r);
    let total = |rows: &[Vec<f64>]| rows.iter().flatten().sum::<f64>();
    let mut now = rows(&x)?;
    let mut covariance = Matrix5::zeros();
    for _ in 0..8 {
        let mut nudged = Vec::with_capacity(steps.len());
        for (i, step) in steps.iter().enumerate() {
            let mut y = x;
            y[i] += step;
            nudged.push(rows(&y)?);
        }
        let (mut score, mut information) = (Numbers::zeros(), Matrix5::zeros());
        for (r, base) in now.iter().enumerate() {
            for (k, base) in base.iter().enumerate() {
                let g = Numbers::from_fn(|i, _| (nudged[i][r][k] - base) / steps[i]);
                score += g;
                information += g * g.transpose();
            }
        }
        covariance = information.try_inverse()?;
        let mut step = covariance * score;
        // Beyond its reach a tangent knows nothing.
        let long = (0..reach.len())
            .map(|i| (step[i] / reach[i]).abs())
            .fold(1.0, f64::max);
        step /= long;
        let (before, mut moved) = (total(&now), false);
        for _ in 0..6 {
            let y = x + step;
            let there = rows(&y)?;
            if total(&there) > before {
                (x, now, moved) = (y, there, true);
                break;
            }
            step *= 0.4;
        }
        if !moved || total(&now) - before < 0.01 {
            break;
        }
    }
    Some(Locking {
        pixel_um: x[2].exp(),
        wave_um: [x[0], x[1]],
        covariance,
    })
}

/// The records without the other effects of the fit.
fn tracks(ctx: &Context<'_>, fit: &Fit, at: usize) -> Vec<Track> {
    let mut bare = fit.clone();
    for (i, p) in bare.positions.iter_mut().enumerate() {
        if i == at {
            *p = [0.0; 2];
        }
    }
    let (residual, sim) = ctx.residual(&bare);
    let effects = ctx.effects(&fit.parts);
    ctx.problem
        .records
        .iter()
        .zip(residual.into_iter().zip(sim))
        .map(|(r, (mut seen_um, path_um))| {
            let (mut edge, mut y) = (Vec::new(), Vec::new());
            ctx.simulate(r, &effects, fit.offset_um, &mut y, Some(&mut edge));
            for (seen, edge) in seen_um.iter_mut().zip(&edge) {
                *seen -= fit.soft * edge;
            }
            Track {
                path_um,
                seen_um,
                present: r.present.clone(),
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::row_noise::RowNoise;

    /// A walk seen with noise through an error of known size.
    fn track(noise: &NoiseModel, amplitude_um: f64, pixel_um: f64, rows: usize) -> Track {
        let mut random = cellpos_numeric::Random::new(1);
        let mut normal = || random.normal();
        let path_um: Vec<f64> = (0..rows).map(|k| 2.0 * (0.013 * k as f64).sin()).collect();
        let mut walk = 0.0;
        let seen_um = path_um
            .iter()
            .map(|path| {
                walk += noise.walk_um2.sqrt() * normal();
                walk + amplitude_um * (TAU * (path + walk) / pixel_um).sin()
                    + noise.localisation_um() * normal()
            })
            .collect();
        Track {
            path_um,
            seen_um,
            present: (0..rows).map(|k| k % 97 != 5).collect(),
        }
    }

    #[test]
    fn without_an_error_the_filter_on_the_grid_is_the_kalman_filter() {
        let noise = NoiseModel::new(0.33, 1e-3, 0.03);
        let t = track(&noise, 0.0, 0.25, 3000);
        let grid = Grid::new(&noise, [0.0; 2], 0.25).unwrap();
        let rows = grid.rows(&t, [0.0; 2], 0.25);
        let w = crate::data::whitener::Whitener::new(&noise, &t.present, &RowNoise::default());
        let mut e = vec![0.0; 3000];
        w.apply(&t.seen_um, &mut e);
        // The constants cancel between rows of the steady state.
        let exact = |k: usize| -0.5 * e[k] * e[k] - w.sigma_um(k).unwrap().ln();
        let worst = (100..3000)
            .filter(|k| w.counts(*k))
            .map(|k| ((rows[k] - rows[104]) - (exact(k) - exact(104))).abs())
            .fold(0.0, f64::max);
        assert!(worst < 1e-3, "{worst}");
    }

    #[test]
    fn the_likelihood_peaks_at_the_amplitude_that_made_the_records() {
        let noise = NoiseModel::new(0.33, 1e-3, 0.03);
        let (pixel, amplitude) = (0.25, 0.025);
        let t = track(&noise, amplitude, pixel, 20_000);
        let of = |a: f64| -> f64 {
            let grid = Grid::new(&noise, [a, 0.0], pixel).unwrap();
            grid.rows(&t, [a, 0.0], pixel).iter().sum()
        };
        let step = 0.002;
        let (low, middle, high) = (of(amplitude - step), of(amplitude), of(amplitude + step));
        let curvature = (2.0 * middle - low - high) / (step * step);
        let peak = amplitude + 0.5 * (high - low) / step / curvature;
        let error = 1.0 / curvature.sqrt();
        assert!(error < 0.04 * amplitude, "{error}");
        assert!((peak - amplitude).abs() < 3.0 * error, "{peak} +- {error}");
    }
}
