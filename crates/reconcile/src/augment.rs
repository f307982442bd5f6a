//! What was found, as parameters with intervals and as a model file.

use crate::catalogue::Part;
use crate::fit::{Context, Fit};
use crate::floor::Floor;
use crate::frames::FrameCounts;
use crate::predict::near_whole;
use crate::result::{Effect as NamedEffect, Interval, Verdict};
use cellpos_plant::effects::{self, Role};
use cellpos_plant::{Effect, Model};
use std::collections::BTreeMap;

/// Relative error of a parameter that no length of record takes away: two integrators of the same equations, a commanded edge
/// in one and in the other, agree to about a thousandth (two of these).
const NUMERIC: f64 = 5e-4;

/// Parameters of part `index` with 95 % intervals in their units.
pub(crate) fn parameters(
    ctx: &Context<'_>,
    fit: &Fit,
    index: usize,
    left_per_row: f64,
) -> BTreeMap<String, Interval> {
    let offset: usize = fit.parts[..index]
        .iter()
        .map(|p| p.variant().params.len())
        .sum();
    let part = &fit.parts[index];
    // A fit that leaves something over is less sure than its own curvature says.
    let wide = (1.0 + left_per_row.max(0.0)).sqrt();
    let mut out = BTreeMap::new();
    for (j, p) in part.variant().params.iter().enumerate() {
        let x = part.theta[j];
        let scatter = fit.covariance[(offset + j, offset + j)].max(0.0).sqrt() * wide;
        let sd = scatter.hypot(NUMERIC * if p.log { 1.0 } else { x.abs() });
        let (low, high) = (p.natural(x - 1.96 * sd), p.natural(x + 1.96 * sd));
        let name = if p.name == "weights" {
            format!("weights[{j}]")
        } else {
            p.name.to_owned()
        };
        out.insert(
            name,
            Interval {
                value: p.natural(x),
                ci95: [low, high],
                unit: unit_of(part, p.name).to_owned(),
            },
        );
    }
    match part.variant().role {
        Role::Line => {
            let line = fit.parts[..index]
                .iter()
                .filter(|p| p.variant().role == Role::Line)
                .count();
            let amplitudes: Vec<f64> = fit.lines[line].iter().map(|[a, b]| a.hypot(*b)).collect();
            let rows: f64 = ctx.problem.records.iter().map(|r| r.u.len() as f64).sum();
            let mean = ctx
                .problem
                .records
                .iter()
                .zip(&amplitudes)
                .map(|(r, a)| a * r.u.len() as f64)
                .sum::<f64>()
                / rows;
            // One record's amplitude has the error sigma sqrt(2/n) over the filter's gain at the line.
            let w = std::f64::consts::TAU * part.natural()[0] * ctx.problem.base.sample_s;
            let theta = ctx.problem.noise.white_um2 / ctx.problem.noise.innovation_um().powi(2);
            let gain =
                (2.0 * (w / 2.0).sin()) / (1.0 + theta * theta - 2.0 * theta * w.cos()).sqrt();
            let sd = ctx.problem.noise.innovation_um() * (2.0 / rows).sqrt() / gain.max(1e-6);
            // A sine and a cosine of noise have a length themselves: sd_i^2/(2 A) in the mean of each record's.
            let mean =
                (mean - 0.5 * sd * sd * fit.lines[line].len() as f64 / mean.max(1e-12)).max(0.0);
            out.insert(
                "um".to_owned(),
                Interval {
                    value: mean,
                    ci95: [mean - 1.96 * sd, mean + 1.96 * sd],
                    unit: "um".to_owned(),
                },
            );
        }
        Role::Position => {
            let at = fit.parts[..index]
                .iter()
                .filter(|p| p.variant().role == Role::Position)
                .count();
            if let Some(Some(exact)) = fit.locking.get(index) {
                let (amplitude, sd) = exact.amplitude_px();
                let factor = (1.96 * exact.log_pixel_error().hypot(NUMERIC)).exp();
                let pixel = exact.pixel_um;
                let sd = sd.hypot(NUMERIC * amplitude);
                for (name, value, low, high, unit) in [
                    ("pixel_um", pixel, pixel / factor, pixel * factor, "um"),
                    (
                        "amplitude",
                        amplitude,
                        amplitude - 1.96 * sd,
                        amplitude + 1.96 * sd,
                        "px",
                    ),
                ] {
                    out.insert(
                        name.to_owned(),
                        Interval {
                            value,
                            ci95: [low, high],
                            unit: unit.to_owned(),
                        },
                    );
                }
                return out;
            }
            let [a, b] = fit.positions[at];
            let pixel = part.natural()[0];
            let rows: f64 = ctx.problem.count(&ctx.problem.all()) as f64;
            // The fit sees the error at an uncertain position: less sharp than it is.
            let scale = pixel * ctx.problem.noise.sharpness(pixel);
            let sd = ctx.problem.noise.innovation_um() * (2.0 / rows).sqrt() / scale;
            let amplitude = a.hypot(b) / scale;
            // Positions carry the error themselves: the second order of its slope, as an error of the method.
            let bent = amplitude * (std::f64::consts::TAU * amplitude).powi(2) / 16.0;
            let sd = sd.hypot(bent);
            out.insert(
                "amplitude".to_owned(),
                Interval {
                    value: amplitude,
                    ci95: [amplitude - 1.96 * sd, amplitude + 1.96 * sd],
                    unit: "px".to_owned(),
                },
            );
        }
        Role::Chain => {}
    }
    out
}

/// Unit of a parameter; a width of operators is that of their thresholds.
fn unit_of(part: &Part, name: &str) -> &'static str {
    if name == "width_um" {
        return "um";
    }
    effects::find(part.id()).map_or("", |k| k.spec().unit(name))
}

/// A delay a hair short of whole frames, whose frames do not show the edges of the command: whole frames for a simulator,
/// which would show them.
fn without_edge(ctx: &Context<'_>, fit: &Fit, delay_s: f64) -> f64 {
    const HAIR: f64 = 0.005;
    let sample_s = ctx.problem.base.sample_s;
    let short = |frames: usize| frames as f64 - delay_s / sample_s;
    match near_whole(delay_s / sample_s) {
        Some(frames)
            if (0.0..HAIR).contains(&short(frames)) && fit.soft < 0.35 * ctx.problem.soft.1 =>
        {
            frames as f64 * sample_s
        }
        _ => delay_s,
    }
}

/// The effect of a model file for part `index`.
fn effect_of(ctx: &Context<'_>, fit: &Fit, index: usize) -> Option<Effect> {
    let part = &fit.parts[index];
    let v = part.natural();
    let before = |role| {
        fit.parts[..index]
            .iter()
            .filter(|p| p.variant().role == role)
            .count()
    };
    match part.variant().role {
        Role::Chain if part.id() == "time-delay" => {
            Some(effects::time_delay(without_edge(ctx, fit, v[0])))
        }
        Role::Chain => Some(part.effect(&ctx.scope)),
        Role::Line => {
            let line = &fit.lines[before(Role::Line)];
            let [a, b] = line.first().copied()?;
            let rows: f64 = ctx.problem.records.iter().map(|r| r.u.len() as f64).sum();
            let um = ctx
                .problem
                .records
                .iter()
                .zip(line)
                .map(|(r, [a, b])| a.hypot(*b) * r.u.len() as f64)
                .sum::<f64>()
                / rows;
            // Amplitude and phase are no parameters of the fit: the form of the effect has them beside the frequency.
            part.effect(&ctx.scope)
                .with_parameter("um", um)
                .and_then(|e| e.with_parameter("phase_deg", b.atan2(a).to_degrees()))
                .ok()
        }
        Role::Position => {
            let exact = fit.locking.get(index).copied().flatten();
            let ([a, b], pixel_um, amplitude) = match exact {
                Some(l) => (l.wave_um, l.pixel_um, l.amplitude_px().0),
                None => {
                    let [a, b] = fit.positions[before(Role::Position)];
                    let sharp = ctx.problem.noise.sharpness(v[0]);
                    ([a, b], v[0], a.hypot(b) / (v[0] * sharp))
                }
            };
            let phase_deg = b.atan2(a).to_degrees();
            Some(effects::pixel_locking(pixel_um, amplitude, phase_deg))
        }
    }
}

/// The model with what was found, its intervals and where they come from.
pub(crate) fn augment(
    model: &Model,
    ctx: &Context<'_>,
    fit: &Fit,
    frames: &FrameCounts,
    named: &[NamedEffect],
    verdict: Verdict,
    floor: &Floor,
) -> Model {
    let mut out = model.clone();
    out.name = if named.is_empty() {
        model.name.clone()
    } else {
        format!("{}-augmented", model.name)
    };
    out.covariance = None;
    if let Ok(plant) = model.plant.scaled(fit.gain) {
        out.plant = plant;
    }
    // Without a floor there is no noise to write, and numbers beyond what a model may hold are none.
    let noise = cellpos_plant::Noise {
        diffusion_um2_per_s: ctx
            .problem
            .noise
            .diffusion_um2_per_s(ctx.problem.base.sample_s),
        localisation_um: ctx.problem.noise.localisation_um(),
    };
    if floor.source.is_known() && noise.diffusion_um2_per_s < 1e4 && noise.localisation_um < 100.0 {
        out.noise = noise;
    }
    out.provenance
        .insert("noise".to_owned(), floor.source.words().to_owned());
    if verdict != Verdict::Unknown {
        for i in 0..fit.parts.len() {
            if let Some(e) = effect_of(ctx, fit, i) {
                out.effects.retain(|old| old.id() != e.id());
                out.effects.push(e);
            }
        }
        if frames.drops_named() {
            out.effects.push(effects::frame_drops(frames.drop_rate()));
        }
        if frames.repeats_named() {
            out.effects
                .push(effects::frame_repeats(frames.repeat_rate()));
        }
        for e in named {
            for (name, p) in e
                .parameters
                .iter()
                .filter(|(_, p)| p.ci95.iter().all(|v| v.is_finite()))
            {
                out.intervals.insert(format!("{}.{name}", e.id), p.ci95);
            }
        }
    }
    out.provenance
        .insert("reconcile.verdict".to_owned(), verdict.word().to_owned());
    out.provenance
        .insert("reconcile.base".to_owned(), model.name.clone());
    for e in named {
        out.provenance.insert(
            format!("reconcile.{}", e.id),
            format!(
                "p = {:.1e}, explains {:.1} % of the excess over the noise floor",
                e.p_value,
                100.0 * e.explained
            ),
        );
    }
    out
}
