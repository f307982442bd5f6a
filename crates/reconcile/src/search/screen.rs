//! Screening: what would each candidate gain at each of its starting values, without a full fit.
//!
//! One simulation per starting value gives a direction in the space of innovations. Projected against the tangents of the present
//! fit, it gives the fall of the sum of squares for the best scale of the candidate, with everything else refitted.

use crate::fit::catalogue::{Part, Variant};
use crate::fit::context::{Context, Fit};
use crate::fit::linear::Tangents;
use crate::mask::Mask;
use crate::search::lines::line_starts;
use crate::search::pixel::pixel_scan;
use crate::search::suspect::{Suspect, lines_score};
use cellpos_plant::effects::Role;

/// The best start of every variant not excluded, in each band of its frequency; best first.
pub(crate) fn screen(
    ctx: &Context<'_>,
    fit: &Fit,
    tangents: &Tangents,
    mask: &Mask,
    threads: usize,
    allowed: impl Fn(Variant) -> bool,
) -> Vec<Suspect> {
    let starting = |v: &Variant| allowed(*v) && v.candidate().role != Role::Position;
    let starting: Vec<Variant> = ctx.variants.iter().copied().filter(starting).collect();
    // A line begins where it stands out.
    let is_line = |v: &&Variant| matches!(v.candidate().role, Role::Line { .. });
    let elsewhere = starting.iter().filter(|v| !is_line(v));
    let mut jobs: Vec<Part> = elsewhere.flat_map(|v| v.starts(&ctx.scope)).collect();
    let sim = ctx.simulated(&fit.parts, fit.offset_um, mask);
    jobs.extend(line_starts(ctx, fit, &starting, mask, &sim));
    let scores = cellpos_numeric::parallel::map(&jobs, threads, |part| match part.variant().role {
        Role::Line { .. } => lines_score(ctx, fit, part, mask),
        _ => {
            let d = ctx.change(fit, &sim, part, mask);
            let g = tangents.gain(&d, &fit.innovations, mask);
            if g.scale > 0.02 { g.score } else { 0.0 }
        }
    });
    let mut best: Vec<Suspect> = Vec::new();
    for (part, score) in jobs.into_iter().zip(scores) {
        let valley = |part: &Part| (part.variant, part.band(ctx.problem.base.sample_s));
        match best.iter_mut().find(|l| valley(&l.part) == valley(&part)) {
            Some(lead) if lead.score < score => *lead = Suspect { part, score },
            Some(_) => {}
            None => best.push(Suspect { part, score }),
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
