//! Where the null model fails, in sentences.

use crate::fit::context::{Context, Fit};
use crate::problem::Prepared;
use crate::thresholds::THRESHOLDS;
use crate::units::figure;
use crate::verdict::jumps::MOST_OF_ROWS;
use crate::verdict::map::{DiscrepancyMap, MapRow};

/// Sentences about where the null model fails.
pub(crate) fn sentences(
    ctx: &Context<'_>,
    fit: &Fit,
    map: &DiscrepancyMap,
    floor_known: bool,
) -> Vec<String> {
    let records = &ctx.problem.records;
    let flagged: Vec<&MapRow> = map
        .rows
        .iter()
        .take(records.len())
        .filter(|r| r.cells.iter().any(|c| c.flagged))
        .collect();
    if flagged.is_empty() {
        return vec![match floor_known {
            true => "nowhere: every record, band and third of the time is at the noise floor",
            false => "nowhere more than elsewhere: no record, band or third of the time stands out, and how much of it is noise is not known",
        }
        .to_owned()];
    }
    let mut out = vec![span(records, map, &flagged), response(map)];
    out.extend(course(&map.rows[records.len()..]));
    out.extend(jumps(ctx, fit));
    out.extend(largest(ctx, map));
    out
}

/// At which frequencies, in which records.
fn span(records: &[Prepared], map: &DiscrepancyMap, flagged: &[&MapRow]) -> String {
    let edges = &map.edges_hz;
    let bands = edges.len() - 1;
    let mut hit = vec![false; bands];
    for r in flagged {
        for (b, hit) in hit.iter_mut().enumerate() {
            *hit |= r.cells[b].flagged;
        }
    }
    let first = hit.iter().position(|h| *h);
    let last = hit.iter().rposition(|h| *h);
    let span = match (first, last) {
        (Some(0), Some(l)) if l + 1 == bands => "at all frequencies".to_owned(),
        (Some(0), Some(l)) => format!("below {} Hz", edges[l + 1]),
        (Some(f), Some(l)) if l + 1 == bands => format!("above {} Hz", edges[f]),
        (Some(f), Some(l)) => format!("between {} and {} Hz", edges[f], edges[l + 1]),
        _ => "spread over all frequencies".to_owned(),
    };
    let names = if flagged.len() == records.len() {
        "in every record".to_owned()
    } else {
        format!(
            "in {}",
            flagged
                .iter()
                .map(|r| r.name.as_str())
                .collect::<Vec<_>>()
                .join(", ")
        )
    };
    let rest = records
        .iter()
        .position(|r| r.rest)
        .map(|i| map.rows[i].cells.iter().any(|c| c.flagged));
    let rest = match rest {
        Some(true) => ", at rest too",
        Some(false) => ", not at rest",
        None => "",
    };
    format!("{span}, {names}{rest}")
}

/// Whether the mean response is off in gain or in phase.
fn response(map: &DiscrepancyMap) -> String {
    let (mut gain, mut phase) = (Vec::new(), Vec::new());
    for r in map.ratios.iter().filter(|r| r.is_supported()) {
        let g = 10f64.powf(r.gain_db / 20.0) - 1.0;
        if g.abs() > (5.0 * r.error).max(0.01) {
            gain.push((r.hz, r.gain_db));
        }
        if r.phase_deg.to_radians().abs() > (5.0 * r.error).max(0.01) {
            phase.push((r.hz, r.phase_deg));
        }
    }
    let widest = |v: &[(f64, f64)]| {
        v.iter()
            .copied()
            .max_by(|a, b| a.1.abs().total_cmp(&b.1.abs()))
    };
    match (widest(&gain), widest(&phase)) {
        (Some(g), Some(p)) => format!(
            "gain and phase: measured over simulated reaches {:+.2} dB at {:.1} Hz and {:+.1} deg at {:.1} Hz",
            g.1, g.0, p.1, p.0
        ),
        (Some(g), None) => format!(
            "gain only: measured over simulated reaches {:+.2} dB at {:.1} Hz",
            g.1, g.0
        ),
        (None, Some(p)) => format!(
            "phase only: measured lies {:+.1} deg from simulated at {:.1} Hz",
            p.1, p.0
        ),
        (None, None) => {
            "not in the mean response to the command (neither gain nor phase)".to_owned()
        }
    }
}

/// How the excess goes in time, from its thirds.
fn course(thirds: &[MapRow]) -> Option<String> {
    let excess: Vec<f64> = thirds
        .iter()
        .map(|r| r.cells[0].rms_um.powi(2) - r.cells[0].floor_um.powi(2))
        .collect();
    if let [a, _, c] = excess[..] {
        let most = a.max(c);
        if most > 0.0 {
            // Less than a thousandth counts as zero: a ratio to it would be a ratio to noise.
            let next_to_none = |part: f64, of: f64| part < 1e-3 * of;
            return Some(if a > 0.5 * c && c > 0.5 * a {
                "from the start and evenly in time".to_owned()
            } else if next_to_none(a, c) {
                "growing in time: the last third of the records has excess, the first next to none"
                    .to_owned()
            } else if next_to_none(c, a) {
                "fading in time: the first third of the records has excess, the last next to none"
                    .to_owned()
            } else if c > a {
                format!(
                    "growing in time: the last third of the records has {:.1} times the excess of the first",
                    c / a
                )
            } else {
                format!(
                    "fading in time: the first third of the records has {:.1} times the excess of the last",
                    a / c
                )
            });
        }
    }
    None
}

/// Single rows: jumps, which no response and no line makes.
fn jumps(ctx: &Context<'_>, fit: &Fit) -> Option<String> {
    let (mut jumps, mut energy, mut most) = (0usize, 0.0, (0.0f64, 0usize, 0usize));
    for (i, e) in fit.innovations.iter().enumerate() {
        for (k, e) in e.iter().enumerate() {
            if e.abs() > THRESHOLDS.jump_sd {
                jumps += 1;
                energy += e * e;
                if e.abs() > most.0 {
                    most = (e.abs(), i, k);
                }
            }
        }
    }
    let excess = fit.chi2 - fit.count as f64;
    let several = jumps >= THRESHOLDS.faults_least && MOST_OF_ROWS * jumps < fit.count;
    if several && energy > 0.5 * excess {
        return Some(format!(
            "in single rows: {jumps} jumps hold {:.0} % of the excess, the largest of about {} in {} at {:.3} s",
            100.0 * (energy / excess).min(1.0),
            ctx.scales.told(most.0 * ctx.problem.noise.innovation_um()),
            ctx.problem.records[most.1].name,
            most.2 as f64 * ctx.problem.base.sample_s,
        ));
    }
    None
}

/// The record with the largest excess, with its stroke.
fn largest(ctx: &Context<'_>, map: &DiscrepancyMap) -> Option<String> {
    let mut by_stroke: Vec<(f64, f64, &str)> = (ctx.problem.records)
        .iter()
        .zip(&map.rows)
        .filter(|(r, _)| !r.rest)
        .map(|(r, m)| {
            let rms = (r.u.iter().map(|u| u * u).sum::<f64>() / r.u.len() as f64).sqrt();
            let c = &m.cells[map.edges_hz.len() - 1];
            (
                (c.rms_um.powi(2) - c.floor_um.powi(2)).max(0.0).sqrt(),
                rms,
                r.name.as_str(),
            )
        })
        .collect();
    by_stroke.sort_by(|a, b| b.0.total_cmp(&a.0));
    if let Some((excess, rms, name)) = by_stroke.first()
        && *excess > 0.0
    {
        return Some(format!(
            "largest in {name}: {} RMS of innovation beyond the floor at {} {} RMS of command",
            ctx.scales.told(*excess),
            figure(ctx.scales.input(*rms)),
            ctx.scales.input_unit()
        ));
    }
    None
}
