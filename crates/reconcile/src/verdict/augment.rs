//! What was found, as a model.

use crate::data::floor::Floor;
use crate::fit::context::{Context, Fit};
use crate::simulate::near_whole;
use crate::units::figure;
use crate::verdict::result::{Effect as NamedEffect, Verdict};
use cellpos_plant::effects::{Action, Role};
use cellpos_plant::{Effect, Model};

/// Key of the provenance of a model whose noise has a part that `[noise]` has no word for.
pub(crate) const COLOURED: &str = "noise.coloured";

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
    match part.variant().role {
        Role::Chain => {
            let effect = part.effect(&ctx.scope);
            let Action::Delay(delay_s) = effect.act() else {
                return Some(effect);
            };
            let mut whole = part.clone();
            whole.theta[0] = part.variant().params[0].coordinate(without_edge(ctx, fit, delay_s));
            Some(whole.effect(&ctx.scope))
        }
        Role::Line { harmonics } => {
            let line = &fit.lines[fit.nth_of_role(index)];
            let [a, b] = line.first()?.first().copied()?;
            let um = ctx.mean_wave_um(line, 1);
            // Amplitude and phase are no parameters of the fit: the form of the effect has them in addition to the frequency.
            let effect = part.effect(&ctx.scope).with_parameter("um", um);
            let effect =
                effect.and_then(|e| e.with_parameter("phase_deg", b.atan2(a).to_degrees()));
            if harmonics > 1 && um > 0.0 {
                let second = ctx.mean_wave_um(line, 2) / um;
                return effect.and_then(|e| e.with_parameter("second", second)).ok();
            }
            effect.ok()
        }
        Role::Position => {
            let exact = fit.locking.get(index).copied().flatten();
            let ([a, b], pixel_um, amplitude) = match exact {
                Some(l) => (l.wave_um, l.pixel_um, l.amplitude_px().0),
                None => {
                    let [a, b] = fit.positions[fit.nth_of_role(index)];
                    let sharp = ctx.problem.noise.sharpness(v[0]);
                    ([a, b], v[0], a.hypot(b) / (v[0] * sharp))
                }
            };
            let phase_deg = b.atan2(a).to_degrees();
            let mut own = part.clone();
            own.theta[0] = part.variant().params[0].coordinate(pixel_um);
            own.effect(&ctx.scope)
                // Beyond half a pixel the positions would fold: no model has that.
                .with_parameter("amplitude", amplitude.min(0.5))
                .and_then(|e| e.with_parameter("phase_deg", phase_deg))
                .ok()
        }
    }
}

/// Adds the fitted effects to those of the base model: a delay to the present delay, a factor to the factor. There is only one
/// exposure.
fn add(effects: &mut Vec<Effect>, found: Effect) {
    let Some(old) = effects.iter_mut().find(|e| e.id() == found.id()) else {
        effects.push(found);
        return;
    };
    match found.kind().combined(old, &found) {
        Some(one) => *old = one,
        None => effects.push(found),
    }
}

/// The model with what was found, its intervals and where they come from.
pub(crate) fn augment(
    model: &Model,
    ctx: &Context<'_>,
    fit: &Fit,
    counted: &[Effect],
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
    // Without a floor there is no noise to write.
    let noise = cellpos_plant::Noise {
        diffusion_um2_per_s: ctx
            .problem
            .noise
            .diffusion_um2_per_s(ctx.problem.base.sample_s)
            / ctx.scales.per_unit()[1].powi(2),
        localisation_um: ctx.scales.output(ctx.problem.noise.localisation_um()),
    };
    if floor.source.is_known() {
        out.noise = noise;
    }
    if ctx.scales.is_of_records() {
        out.provenance
            .insert(Model::UNITS.to_owned(), ctx.scales.words());
    }
    out.provenance
        .insert("noise".to_owned(), floor.source.words().to_owned());
    if let Some(c) = ctx.problem.noise.coloured {
        let words = format!(
            "{} RMS with a correlation time of {} s, beside the noise stated",
            ctx.scales.told(c.variance_um2.sqrt()),
            figure(c.time_rows * ctx.problem.base.sample_s)
        );
        out.provenance.insert(COLOURED.to_owned(), words);
    } else {
        out.provenance.remove(COLOURED);
    }
    if verdict.names() {
        for i in 0..fit.parts.len() {
            if let Some(e) = effect_of(ctx, fit, i) {
                add(&mut out.effects, ctx.scales.effect_out(&e));
            }
        }
        for e in counted {
            out.effects.push(ctx.scales.effect_out(e));
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

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_plant::effects;

    #[test]
    fn a_delay_found_beside_a_delay_is_added_to_it() {
        let mut all = vec![effects::time_delay(2e-3), effects::gain_error(0.5)];
        add(&mut all, effects::time_delay(0.5e-3));
        add(&mut all, effects::gain_error(1.2));
        add(&mut all, effects::backlash(0.1));
        add(&mut all, effects::backlash(0.2));
        let ids: Vec<&str> = all.iter().map(Effect::id).collect();
        assert_eq!(ids, ["time-delay", "gain-error", "backlash", "backlash"]);
        assert!((all[0].scalar(0) - 2.5e-3).abs() < 1e-12);
        assert!((all[1].scalar(0) - 0.6).abs() < 1e-12);
    }
}
