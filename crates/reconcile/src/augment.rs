//! What was found, as parameters with intervals and as a model file.

use crate::catalogue::{Kind, VARIANTS};
use crate::fit::{Context, Fit};
use crate::frames::FrameCounts;
use crate::predict::{Block, PLAY_LEVELS, domains, near_whole};
use crate::result::{Effect as NamedEffect, Interval, Verdict};
use cellpos_plant::{Effect, Hysteresis, Model};
use std::collections::BTreeMap;

/// Place of an effect in the chain.
pub(crate) fn place_of(id: &str) -> &'static str {
    match id {
        "driver-lag" | "slew-limit" | "saturation" => "driver",
        "pzt-hysteresis" | "pzt-creep" | "pzt-resonance" | "backlash" => "pzt",
        "pdms-relaxation" | "bubble" | "leak" => "chip",
        "gain-error" => "bead/camera",
        "gain-drift" | "wall-adhesion" | "flow-drift" => "bead",
        _ => "camera",
    }
}

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
                unit: unit_of(p.name).to_owned(),
            },
        );
    }
    match part.variant().kind {
        Kind::Line => {
            let line = fit.parts[..index]
                .iter()
                .filter(|p| p.variant().kind == Kind::Line)
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
        Kind::Position => {
            let at = fit.parts[..index]
                .iter()
                .filter(|p| p.variant().kind == Kind::Position)
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
        Kind::Chain => {}
    }
    out
}

fn unit_of(name: &str) -> &'static str {
    match name {
        "bandwidth_hz" | "frequency_hz" | "hz" => "Hz",
        "rate_um_per_s" | "speed_um_per_s" | "um_per_s" => "um/s",
        "low_um" | "high_um" | "width_um" | "pixel_um" | "um" => "um",
        "beta_per_um" | "gamma_per_um" | "quadratic_per_um" => "1/um",
        "time_s" | "lag_s" | "delay_s" | "exposure_s" => "s",
        "corner_rad_per_s" => "rad/s",
        "dissolution_per_s" | "per_s" => "1/s",
        "ppm" => "ppm",
        _ => "",
    }
}

/// Play operators that stand for an exponential density of thresholds, as a model file holds them.
pub(crate) fn exponential_play(fraction: f64, width_um: f64) -> Hysteresis {
    let (radii, shares) = domains();
    let thresholds = std::iter::once(0.0).chain(radii.map(|r| r * width_um));
    let weights = std::iter::once(1.0 - fraction).chain(shares.map(|s| s * fraction));
    Hysteresis::Play {
        thresholds_um: thresholds.collect(),
        weights: weights.collect(),
        quadratic_per_um: 0.0,
    }
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
    let before = |kind| {
        fit.parts[..index]
            .iter()
            .filter(|p| p.variant().kind == kind)
            .count()
    };
    Some(match (part.variant().build)(&v, &ctx.scope) {
        Block::Saturation { low_um, high_um } => Effect::Saturation { low_um, high_um },
        Block::SlewLimit { rate } => Effect::SlewLimit {
            rate_um_per_s: rate,
        },
        Block::DriverLag { .. } => Effect::DriverLag { bandwidth_hz: v[0] },
        Block::BoucWen {
            fraction,
            beta,
            gamma,
        } => Effect::PztHysteresis(Hysteresis::BoucWenExplicit {
            fraction,
            beta_per_um: beta,
            gamma_per_um: gamma,
        }),
        Block::Play {
            stroke_um,
            weights,
            quadratic,
        } => Effect::PztHysteresis(Hysteresis::Play {
            thresholds_um: PLAY_LEVELS.iter().map(|l| l * stroke_um).collect(),
            weights: weights.to_vec(),
            quadratic_per_um: quadratic,
        }),
        Block::Domains { fraction, width_um } => {
            Effect::PztHysteresis(exponential_play(fraction, width_um))
        }
        Block::Creep { g } => Effect::PztCreep { per_decade: g },
        Block::Resonance { zeta, .. } => Effect::PztResonance {
            frequency_hz: v[0],
            damping: zeta,
        },
        Block::Backlash { width_um } => Effect::Backlash { width_um },
        Block::Relaxation { time_s, strength } => Effect::PdmsRelaxation { time_s, strength },
        Block::Bubble { lag_s, dissolution } => Effect::Bubble {
            lag_s,
            dissolution_per_s: dissolution,
        },
        Block::Leak { corner } => Effect::Leak {
            corner_rad_per_s: corner,
        },
        Block::Gain { factor } => Effect::GainError { factor },
        Block::GainDrift { per_s } => Effect::GainDrift { per_s },
        Block::FlowDrift { um_per_s } => Effect::FlowDrift { um_per_s },
        Block::Adhesion { um_per_s } => Effect::WallAdhesion {
            speed_um_per_s: um_per_s,
        },
        Block::ClockSkew { .. } => Effect::ClockSkew { ppm: v[0] },
        Block::Delay { s } => Effect::TimeDelay {
            delay_s: without_edge(ctx, fit, s),
        },
        Block::Exposure { s } => Effect::ExposureAveraging { exposure_s: s },
        Block::Hum { hz } => {
            let line = &fit.lines[before(Kind::Line)];
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
            Effect::MainsHum {
                hz,
                um,
                phase_deg: b.atan2(a).to_degrees(),
            }
        }
        Block::PixelLocking { .. } if matches!(fit.locking.get(index), Some(Some(_))) => {
            let exact = fit.locking.get(index).copied().flatten()?;
            let [a, b] = exact.wave_um;
            Effect::PixelLocking {
                pixel_um: exact.pixel_um,
                amplitude: exact.amplitude_px().0,
                phase_deg: b.atan2(a).to_degrees(),
            }
        }
        Block::PixelLocking { pixel_um } => {
            let [a, b] = fit.positions[before(Kind::Position)];
            Effect::PixelLocking {
                pixel_um,
                amplitude: a.hypot(b) / (pixel_um * ctx.problem.noise.sharpness(pixel_um)),
                phase_deg: b.atan2(a).to_degrees(),
            }
        }
    })
}

/// The model with what was found, its intervals and where they come from.
pub(crate) fn augment(
    model: &Model,
    ctx: &Context<'_>,
    fit: &Fit,
    frames: &FrameCounts,
    named: &[NamedEffect],
    verdict: Verdict,
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
    out.noise.diffusion_um2_per_s = ctx
        .problem
        .noise
        .diffusion_um2_per_s(ctx.problem.base.sample_s);
    out.noise.localisation_um = ctx.problem.noise.localisation_um();
    if verdict != Verdict::Unknown {
        for i in 0..fit.parts.len() {
            if let Some(e) = effect_of(ctx, fit, i) {
                out.effects
                    .retain(|old| old.id() != e.id() || !VARIANTS.iter().any(|v| v.id == old.id()));
                out.effects.push(e);
            }
        }
        if frames.drops_named() {
            out.effects.push(Effect::FrameDrops {
                rate: frames.drop_rate(),
            });
        }
        if frames.repeats_named() {
            out.effects.push(Effect::FrameRepeats {
                rate: frames.repeat_rate(),
            });
        }
        for e in named {
            for (name, p) in &e.parameters {
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
