//! Screening: what would each candidate gain at each of its starting values, without a full fit.
//!
//! One simulation per starting value gives a direction in the space of innovations; projected against the tangents of
//! the present fit it says how much the sum of squares falls when the candidate is scaled best and all else refitted.

use crate::catalogue::{Part, Variant};
use crate::dot::dot;
use crate::fit::{Context, Fit};
use crate::linear::Tangents;
use crate::parallel;
use crate::pixel::pixel_scan;
use crate::problem::Mask;
use cellpos_plant::effects::Role;
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
    allowed: impl Fn(Variant) -> bool,
) -> Vec<Lead> {
    let mut jobs: Vec<Part> = Vec::new();
    for v in &ctx.variants {
        if allowed(*v) && v.candidate().role != Role::Position {
            jobs.extend(v.starts(&ctx.scope));
        }
    }
    let sim = ctx.simulated(&fit.parts, mask);
    let scores = parallel::map(&jobs, threads, |part| match part.variant().role {
        Role::Line => line_score(ctx, fit, part.natural()[0], mask),
        _ => {
            let mut parts = fit.parts.clone();
            parts.push(part.clone());
            let moved = ctx.simulated(&parts, mask);
            let d: Vec<Vec<f64>> = ctx
                .problem
                .records
                .iter()
                .zip(moved.iter().zip(&sim))
                .map(|(r, (m, s))| {
                    let d: Vec<f64> = m.iter().zip(s).map(|(m, s)| fit.gain * (s - m)).collect();
                    let mut w = vec![0.0; d.len()];
                    r.whiten(&d, &mut w);
                    w
                })
                .collect();
            let g = tangents.gain(&d, &fit.innovations, mask);
            if g.scale > 0.02 { g.score } else { 0.0 }
        }
    });
    let mut best: Vec<Lead> = Vec::new();
    for (part, score) in jobs.into_iter().zip(scores) {
        match best.iter_mut().find(|l| l.part.variant == part.variant) {
            Some(lead) if lead.score < score => *lead = Lead { part, score },
            Some(_) => {}
            None => best.push(Lead { part, score }),
        }
    }
    if let Some(v) = ctx
        .variants
        .iter()
        .find(|v| v.candidate().role == Role::Position)
        && allowed(*v)
        && let Some(lead) = pixel_scan(ctx, fit, *v, mask, threads)
    {
        best.push(lead);
    }
    // A stable sort: what gains the same comes in the order of the table.
    best.sort_by(|a, b| b.score.total_cmp(&a.score));
    best
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
            r.whiten(&s, &mut ws);
            r.whiten(&c, &mut wc);
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
