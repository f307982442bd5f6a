//! What is worth a fit, and what lines and waves would gain.

use crate::dot::dot;
use crate::fit::catalogue::Part;
use crate::fit::context::{Context, Fit};
use crate::mask::Mask;
use cellpos_plant::effects::Role;
use std::f64::consts::TAU;

/// One candidate that may be worth a fit.
#[derive(Debug, Clone)]
pub(crate) struct Suspect {
    pub part: Part,
    /// Expected fall of the sum of squares.
    pub score: f64,
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

/// Gain of a line of a frequency, and of its multiples, with their own amplitudes and phases in every record.
pub(crate) fn lines_score(ctx: &Context<'_>, fit: &Fit, part: &Part, mask: &Mask) -> f64 {
    let Role::Line { harmonics } = part.variant().role else {
        return 0.0;
    };
    let hz = part.natural()[0];
    let of = |times: usize| line_score(ctx, fit, times as f64 * hz, mask);
    (1..=harmonics).map(of).sum()
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
