//! Screening: what would each candidate gain at each of its starting values, without a full fit.
//!
//! One simulation per starting value gives a direction in the space of innovations; projected against the tangents of
//! the present fit it says how much the sum of squares falls when the candidate is scaled best and all else refitted.

use crate::catalogue::{Kind, VARIANTS};
use crate::fit::{Context, Fit, Part};
use crate::linear::{Tangents, dot};
use crate::parallel;
use crate::problem::Mask;
use std::f64::consts::TAU;

/// One candidate that may be worth a fit.
#[derive(Debug, Clone)]
pub(crate) struct Lead {
    pub part: Part,
    /// Expected fall of the sum of squares.
    pub score: f64,
}

/// The best start of every variant not excluded, best first.
pub(crate) fn screen(
    ctx: &Context<'_>,
    fit: &Fit,
    tangents: &Tangents,
    mask: &Mask,
    threads: usize,
    allowed: impl Fn(usize) -> bool,
) -> Vec<Lead> {
    let mut jobs: Vec<Part> = Vec::new();
    for (i, v) in VARIANTS.iter().enumerate() {
        if allowed(i) && v.kind != Kind::Position {
            jobs.extend((v.starts)(&ctx.scope).iter().map(|s| Part::new(i, s)));
        }
    }
    let sim = ctx.simulated(&fit.parts);
    let scores = parallel::map(&jobs, threads, |part| match part.variant().kind {
        Kind::Line => line_score(ctx, fit, part.natural()[0], mask),
        _ => {
            let mut parts = fit.parts.clone();
            parts.push(part.clone());
            let moved = ctx.simulated(&parts);
            let d: Vec<Vec<f64>> = ctx
                .problem
                .records
                .iter()
                .zip(moved.iter().zip(&sim))
                .map(|(r, (m, s))| {
                    let d: Vec<f64> = m.iter().zip(s).map(|(m, s)| fit.gain * (s - m)).collect();
                    let mut w = vec![0.0; d.len()];
                    r.whitener.apply(&d, &mut w);
                    w
                })
                .collect();
            let g = tangents.gain(&d, &fit.innovations, mask);
            if g.scale > 0.02 { g.score } else { 0.0 }
        }
    });
    let mut best: Vec<Option<Lead>> = VARIANTS.iter().map(|_| None).collect();
    for (part, score) in jobs.into_iter().zip(scores) {
        let slot = &mut best[part.variant];
        if slot.as_ref().is_none_or(|l| l.score < score) {
            *slot = Some(Lead { part, score });
        }
    }
    if let Some(v) = VARIANTS.iter().position(|v| v.kind == Kind::Position)
        && allowed(v)
        && let Some(lead) = pixel_scan(ctx, fit, v, mask, threads)
    {
        best[v] = Some(lead);
    }
    let mut leads: Vec<Lead> = best.into_iter().flatten().collect();
    leads.sort_by(|a, b| {
        b.score
            .total_cmp(&a.score)
            .then(a.part.variant.cmp(&b.part.variant))
    });
    leads
}

/// Gain of two columns together.
fn pair_score(s: &[f64], c: &[f64], e: &[f64]) -> f64 {
    let (ss, cc, sc) = (dot(s, s), dot(c, c), dot(s, c));
    let (se, ce) = (dot(s, e), dot(c, e));
    let det = ss * cc - sc * sc;
    if det <= 1e-9 * ss * cc || det.is_nan() {
        return 0.0;
    }
    (cc * se * se - 2.0 * sc * se * ce + ss * ce * ce) / det
}

/// Gain of a line of a frequency with its own amplitude and phase in every record.
pub(crate) fn line_score(ctx: &Context<'_>, fit: &Fit, hz: f64, mask: &Mask) -> f64 {
    ctx.problem
        .records
        .iter()
        .enumerate()
        .map(|(i, r)| {
            let n = r.u.len();
            let (mut s, mut c) = (vec![0.0; n], vec![0.0; n]);
            for k in 0..n {
                (s[k], c[k]) = (TAU * hz * k as f64 * ctx.problem.base.sample_s).sin_cos();
            }
            let (mut ws, mut wc) = (vec![0.0; n], vec![0.0; n]);
            r.whitener.apply(&s, &mut ws);
            r.whitener.apply(&c, &mut wc);
            mask[i]
                .iter()
                .map(|m| {
                    pair_score(
                        &ws[m.clone()],
                        &wc[m.clone()],
                        &fit.innovations[i][m.clone()],
                    )
                })
                .sum::<f64>()
        })
        .sum()
}

/// Most rows of a block of the pixel scan, and the fewest worth a phase of their own.
const BLOCK: (usize, usize) = (1000, 12);

/// Rows of the pixel scan in all: enough to see a hundredth of a pixel without spending the whole record.
const SCAN_ROWS: usize = 24_000;

/// Most distance travelled in a block \[um\]: what the grid of wave numbers resolves.
const SPAN_UM: f64 = 7.0;

/// Rows before a block that the whitening filter needs to run in.
const RUN_IN: usize = 12;

/// Blocks `(record, from, to)` in which the bead stays within a few micrometres but moves enough to tell a pixel.
fn pixel_blocks(positions: &[Vec<f64>], mask: &Mask) -> Vec<(usize, usize, usize)> {
    let mut blocks = Vec::new();
    for (i, p) in positions.iter().enumerate() {
        for range in &mask[i] {
            let mut from = range.start;
            while from < range.end {
                let (mut low, mut high) = (p[from], p[from]);
                let mut to = from + 1;
                while to < range.end && to - from < BLOCK.0 {
                    let (a, b) = (low.min(p[to]), high.max(p[to]));
                    if b - a > SPAN_UM {
                        break;
                    }
                    (low, high) = (a, b);
                    to += 1;
                }
                if to - from >= BLOCK.1 && high - low > 0.3 {
                    blocks.push((i, from, to));
                }
                from = to;
            }
        }
    }
    let rows: usize = blocks.iter().map(|b| b.2 - b.1).sum();
    let stride = rows.div_ceil(SCAN_ROWS).max(1);
    blocks.into_iter().step_by(stride).collect()
}

/// Looks for an error periodic in position over pixel sizes of 0.05..1.5 um: first over blocks in which the bead stays
/// within a few micrometres (each with its own phase, so that a coarse grid does), then over everything.
///
/// Positions are predictions from the rows before: with smoothed ones a row's own noise would be in its position, and
/// noise would look like an error that depends on position.
fn pixel_scan(
    ctx: &Context<'_>,
    fit: &Fit,
    variant: usize,
    mask: &Mask,
    threads: usize,
) -> Option<Lead> {
    let (residual, sim) = ctx.residual(fit);
    let positions: Vec<Vec<f64>> = ctx
        .problem
        .records
        .iter()
        .zip(residual.iter().zip(&sim))
        .map(|(r, (e, s))| {
            r.whitener
                .predict(e)
                .iter()
                .zip(s)
                .map(|(w, s)| w + s)
                .collect()
        })
        .collect();
    let blocks = pixel_blocks(&positions, mask);
    if blocks.len() < 3 {
        return None;
    }
    let step = 1.0 / 14.0;
    let waves: Vec<f64> = (0..((20.0 - 0.66) / step) as usize)
        .map(|i| 0.66 + step * i as f64)
        .collect();
    let score_at = |q: f64, i: usize, from: usize, to: usize| {
        let r = &ctx.problem.records[i];
        let start = from.saturating_sub(RUN_IN);
        let (s, c): (Vec<f64>, Vec<f64>) = positions[i][start..to]
            .iter()
            .map(|p| (TAU * q * p).sin_cos())
            .unzip();
        let n = to - from;
        let (mut ws, mut wc) = (vec![0.0; n], vec![0.0; n]);
        r.whitener.apply_range(&s, start, from, to, &mut ws);
        r.whitener.apply_range(&c, start, from, to, &mut wc);
        (ws, wc)
    };
    let coarse = parallel::map(&waves, threads, |&q| {
        blocks
            .iter()
            .map(|&(i, from, to)| {
                let (s, c) = score_at(q, i, from, to);
                pair_score(&s, &c, &fit.innovations[i][from..to])
            })
            .sum::<f64>()
    });
    let n = blocks.len() as f64;
    let (best, &top) = coarse
        .iter()
        .enumerate()
        .max_by(|a, b| a.1.total_cmp(b.1))?;
    // Without an error the sum is chi-square with 2n degrees of freedom, scaled by what else is left over: the scan
    // itself tells its middle; it has about 270 trials.
    let mut sorted = coarse.clone();
    sorted.sort_by(f64::total_cmp);
    let middle = sorted[sorted.len() / 2].max(2.0 * n);
    if top < middle * (1.0 + 5.0 / n.sqrt()) {
        return None;
    }
    let all_rows: Vec<(usize, std::ops::Range<usize>)> = mask
        .iter()
        .enumerate()
        .flat_map(|(i, ranges)| ranges.iter().map(move |r| (i, r.clone())))
        .collect();
    let centre = waves[best];
    // Common phase over all records: the resolution is one over the whole distance travelled.
    let fine: Vec<f64> = (-75..=75)
        .map(|i| centre + step * f64::from(i) / 50.0)
        .collect();
    let scores = parallel::map(&fine, threads, |&q| {
        let (mut s, mut c, mut e) = (Vec::new(), Vec::new(), Vec::new());
        for (i, r) in &all_rows {
            let (ws, wc) = score_at(q, *i, r.start, r.end);
            s.extend(ws);
            c.extend(wc);
            e.extend_from_slice(&fit.innovations[*i][r.clone()]);
        }
        pair_score(&s, &c, &e)
    });
    let (best, &score) = scores
        .iter()
        .enumerate()
        .max_by(|a, b| a.1.total_cmp(b.1))?;
    // About 40,000 trials, two degrees of freedom.
    if score < 45.0 {
        return None;
    }
    Some(Lead {
        part: Part::new(variant, &[1.0 / fine[best]]),
        score,
    })
}
