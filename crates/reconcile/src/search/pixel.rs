//! Looks for an error periodic in the bead's POSITION: pixels of 0.05..1.5 um.
//!
//! The gain of a sine of the position is an inner product with the innovations. The transpose of the whitening filter turns it
//! into a Fourier transform over the positions: all pixel sizes at once, all records in phase.

use crate::fit::catalogue::{Part, Variant};
use crate::fit::context::{Context, Fit};
use crate::mask::Mask;
use crate::problem::Prepared;
use crate::search::cost::threshold_of_waves;
use crate::search::suspect::{Suspect, pair_score};
use cellpos_numeric::fft;
use std::f64::consts::TAU;

/// Width of a bin of positions \[um\]: a fifth of the smallest pixel.
const BIN_UM: f64 = 0.01;

/// Wave numbers looked at \[1/um\].
const WAVES: (f64, f64) = (0.66, 20.0);

/// Most bins: a bead that travels further than 20 mm is not looked at.
const MOST_BINS: usize = 1 << 21;

/// The best pixel size, if any stands out.
///
/// Positions come from the rows around each row: with the row itself in them its own noise would look like an error that
/// depends on position.
pub(crate) fn pixel_scan(
    ctx: &Context<'_>,
    fit: &Fit,
    variant: Variant,
    mask: &Mask,
    threads: usize,
) -> Option<Suspect> {
    let records = &ctx.problem.records;
    let (residual, sim) = ctx.residual(fit);
    let around = |(r, (e, s)): (&Prepared, (&Vec<f64>, &Vec<f64>))| -> Vec<f64> {
        let walk = r.whitener.around(e);
        walk.iter().zip(s).map(|(w, s)| w + s).collect()
    };
    let positions: Vec<Vec<f64>> = records
        .iter()
        .zip(residual.iter().zip(&sim))
        .map(around)
        .collect();
    let (low, high) = positions
        .iter()
        .flatten()
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), p| {
            (a.min(*p), b.max(*p))
        });
    let span = high - low;
    if !span.is_finite() || span < 1.0 || span / BIN_UM > MOST_BINS as f64 / 2.0 {
        return None;
    }
    let mut density = density(ctx, fit, &positions, (low, span), mask);
    let bins = density.len();
    let transform = fft::forward(&mut density);
    let step = 1.0 / (bins as f64 * BIN_UM);
    let columns = |q: f64| columns(ctx, fit, &positions, q, mask);
    // Energy of a unit sine after the filter, smooth in the wave number.
    let knots: Vec<f64> = (0..9)
        .map(|i| WAVES.0 * (WAVES.1 / WAVES.0).powf(f64::from(i) / 8.0))
        .collect();
    let energy = cellpos_numeric::parallel::map(&knots, threads, |&q| {
        let (s, c, _) = columns(q);
        0.5 * (s.iter().chain(&c).map(|x| x * x).sum::<f64>())
    });
    let energy_at = |q: f64| {
        let x = ((q / WAVES.0).ln() / (WAVES.1 / WAVES.0).ln() * 8.0).clamp(0.0, 7.999);
        let (i, f) = (x as usize, x.fract());
        energy[i] + f * (energy[i + 1] - energy[i])
    };
    let (from, to) = (
        (WAVES.0 / step).ceil() as usize,
        ((WAVES.1 / step) as usize).min(transform.len() - 1),
    );
    let scores: Vec<f64> = (from..to)
        .map(|j| {
            let q = j as f64 * step;
            // Linear shares between two bins blur a wave by sinc^2.
            let x = std::f64::consts::PI * q * BIN_UM;
            let blur = (x.sin() / x).powi(2);
            transform[j].norm_sqr() / (blur * blur * energy_at(q).max(1e-9))
        })
        .collect();
    let (best, top, middle) = peak(&scores, from)?;
    let least = threshold_of_waves(scores.len());
    if top < 0.7 * least * middle {
        return None;
    }
    let centre = (best + from) as f64 * step;
    let fine: Vec<f64> = (-8..=8)
        .map(|i| centre + step * f64::from(i) / 8.0)
        .collect();
    let gains = cellpos_numeric::parallel::map(&fine, threads, |&q| {
        let (s, c, e) = columns(q);
        pair_score(&s, &c, &e)
    });
    let (best, &score) = gains.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1))?;
    if score < least * middle {
        return None;
    }
    Some(Suspect {
        part: Part::new(variant, &[1.0 / fine[best]]),
        score,
    })
}

/// Innovations by position: what each row's error pulls at the place where the bead was.
fn density(
    ctx: &Context<'_>,
    fit: &Fit,
    positions: &[Vec<f64>],
    (low, span): (f64, f64),
    mask: &Mask,
) -> Vec<f64> {
    let bins = ((2.0 * span / BIN_UM) as usize + 2).next_power_of_two();
    let mut density = vec![0.0; bins];
    for (i, r) in ctx.problem.records.iter().enumerate() {
        let mut weights = vec![0.0; r.u.len()];
        for range in &mask[i] {
            weights[range.clone()].copy_from_slice(&fit.innovations[i][range.clone()]);
        }
        for (p, z) in positions[i].iter().zip(r.whitener.transpose(&weights)) {
            let x = (p - low) / BIN_UM;
            let (j, f) = (x as usize, x.fract());
            density[j] += (1.0 - f) * z;
            density[j + 1] += f * z;
        }
    }
    density
}

/// Whitened sine and cosine of a wave number along the positions, with the innovations, of all rows that count.
fn columns(
    ctx: &Context<'_>,
    fit: &Fit,
    positions: &[Vec<f64>],
    q: f64,
    mask: &Mask,
) -> (Vec<f64>, Vec<f64>, Vec<f64>) {
    let (mut s, mut c, mut e) = (Vec::new(), Vec::new(), Vec::new());
    for (i, r) in ctx.problem.records.iter().enumerate() {
        let (sin, cos): (Vec<f64>, Vec<f64>) =
            positions[i].iter().map(|p| (TAU * q * p).sin_cos()).unzip();
        let (mut ws, mut wc) = (vec![0.0; sin.len()], vec![0.0; sin.len()]);
        r.whiten(&sin, &mut ws);
        r.whiten(&cos, &mut wc);
        for range in &mask[i] {
            s.extend_from_slice(&ws[range.clone()]);
            c.extend_from_slice(&wc[range.clone()]);
            e.extend_from_slice(&fit.innovations[i][range.clone()]);
        }
    }
    (s, c, e)
}

/// The highest score with its index, and the middle of its neighbourhood as a factor on chance, at least 1.
fn peak(scores: &[f64], from: usize) -> Option<(usize, f64, f64)> {
    let (best, &top) = scores
        .iter()
        .enumerate()
        .max_by(|a, b| a.1.total_cmp(b.1))?;
    // The rest of the residual is smooth in the wave number, so the sine must also exceed its neighbourhood.
    let wide = ((best + from) / 5).max(50);
    let mut around: Vec<f64> =
        scores[best.saturating_sub(wide)..(best + wide).min(scores.len())].to_vec();
    around.sort_by(f64::total_cmp);
    // Median of chi-square with two degrees of freedom.
    let middle = (around[around.len() / 2] / (2.0 * std::f64::consts::LN_2)).max(1.0);
    Some((best, top, middle))
}
