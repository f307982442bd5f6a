//! Screening: what would each candidate gain at each of its starting values, without a full fit.
//!
//! One simulation per starting value gives a direction in the space of innovations; projected against the tangents of
//! the present fit it says how much the sum of squares falls when the candidate is scaled best and all else refitted.

use crate::catalogue::{Kind, VARIANTS};
use crate::fit::{Context, Fit, Part};
use crate::linear::{Tangents, dot};
use crate::parallel;
use crate::pixel::pixel_scan;
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
pub(crate) fn pair_score(s: &[f64], c: &[f64], e: &[f64]) -> f64 {
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
