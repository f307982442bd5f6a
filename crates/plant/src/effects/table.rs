//! The table of all effects in the order of the chain, and the effects registered by other crates.

use super::{Effect, EffectError, EffectKind};
use std::sync::{PoisonError, RwLock};

/// The effects of this crate. Within a place, the order here is the order in which they act.
static TABLE: [&dyn EffectKind; 31] = [
    &super::saturation::Saturation,
    &super::slew_limit::SlewLimit,
    &super::driver_lag::DriverLag,
    &super::pzt_hysteresis::PztHysteresis,
    &super::pzt_creep::PztCreep,
    &super::pzt_resonance::PztResonance,
    &super::backlash::Backlash,
    &super::stiffening::Stiffening,
    &super::pdms_relaxation::PdmsRelaxation,
    &super::bubble::Bubble,
    &super::leak::Leak,
    &super::gain_error::GainError,
    &super::gain_drift::GainDrift,
    &super::gain_swing::GainSwing,
    &super::valve_asymmetry::ValveAsymmetry,
    &super::flow_drift::FlowDrift,
    &super::flow_wander::FlowWander,
    &super::wall_adhesion::WallAdhesion,
    &super::stick_slip::StickSlip,
    &super::clock_skew::ClockSkew,
    &super::camera_shake::CameraShake,
    &super::time_delay::TimeDelay,
    &super::exposure_averaging::ExposureAveraging,
    &super::lens_distortion::LensDistortion,
    &super::jumps::Jumps,
    &super::frame_jitter::FrameJitter,
    &super::pump_pulsation::PumpPulsation,
    &super::mains_hum::MainsHum,
    &super::pixel_locking::PixelLocking,
    &super::frame_drops::FrameDrops,
    &super::frame_repeats::FrameRepeats,
];

/// Effects from other crates, in the order of their registration.
static REGISTERED: RwLock<Vec<&'static dyn EffectKind>> = RwLock::new(Vec::new());

/// The effects of the catalogue, without those that a program has registered.
pub fn built_in() -> impl Iterator<Item = &'static dyn EffectKind> {
    TABLE.iter().copied()
}

/// All effects that are known: the table, then those registered.
pub fn all() -> Vec<&'static dyn EffectKind> {
    let more = REGISTERED.read().unwrap_or_else(PoisonError::into_inner);
    TABLE.iter().copied().chain(more.iter().copied()).collect()
}

/// The ids of all known effects.
pub fn ids() -> Vec<&'static str> {
    all().iter().map(|k| k.spec().id).collect()
}

/// The effect of an id.
pub fn find(id: &str) -> Option<&'static dyn EffectKind> {
    all().into_iter().find(|k| k.spec().id == id)
}

impl Effect {
    /// An effect of a known id, in its first form, from parameters by name; those left out have their defaults.
    ///
    /// # Errors
    /// An unknown id or parameter, a value out of range, a required parameter that is missing.
    pub fn of(id: &str, parameters: &[(&str, f64)]) -> Result<Self, EffectError> {
        let kind = find(id).ok_or_else(|| EffectError::UnknownEffect {
            id: id.to_owned(),
            known: ids(),
        })?;
        Self::of_kind(kind, parameters)
    }
}

/// Rank of an effect among all; an unknown one acts last at its place.
pub(super) fn position(id: &str) -> usize {
    if let Some(i) = TABLE.iter().position(|k| k.spec().id == id) {
        return i;
    }
    let more = REGISTERED.read().unwrap_or_else(PoisonError::into_inner);
    TABLE.len() + more.iter().take_while(|k| k.spec().id != id).count()
}

/// Makes an effect of another crate known to model files, simulation and search, for the life of the process.
///
/// # Errors
/// [`EffectError::Taken`] if another effect has that id. Registering the same effect again is no error.
pub fn register(kind: &'static dyn EffectKind) -> Result<(), EffectError> {
    let id = kind.spec().id;
    let taken = || EffectError::Taken { id };
    if TABLE.iter().any(|k| k.spec().id == id) {
        return Err(taken());
    }
    let mut more = REGISTERED.write().unwrap_or_else(PoisonError::into_inner);
    match more.iter().find(|k| k.spec().id == id) {
        Some(known) if std::ptr::addr_eq(*known, kind) => Ok(()),
        Some(_) => Err(taken()),
        None => {
            more.push(kind);
            Ok(())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_is_in_the_order_of_the_chain_with_every_field_filled_in() {
        let mut last = None;
        for kind in TABLE {
            let spec = kind.spec();
            assert!(last <= Some(spec.place), "{} stands too late", spec.id);
            last = Some(spec.place);
            assert!(
                !spec.equation.is_empty() && !spec.signature.is_empty(),
                "{}: equation or signature missing",
                spec.id
            );
            assert!(!spec.separate_by.is_empty(), "{}: separate_by", spec.id);
            for other in spec.confused_with.iter().chain(spec.inseparable_from) {
                assert!(find(other).is_some(), "{}: {other} is no effect", spec.id);
            }
            for other in spec.inseparable_from {
                let back = find(other).map(|k| k.spec().inseparable_from);
                assert!(
                    back.is_some_and(|b| b.contains(&spec.id)),
                    "{} and {other}",
                    spec.id
                );
            }
            assert_eq!(TABLE.iter().filter(|k| k.spec().id == spec.id).count(), 1);
            for c in kind.candidates() {
                for p in c.params {
                    assert!(p.lower < p.upper, "{}: {}", spec.id, p.name);
                }
            }
        }
    }

    #[test]
    fn every_start_of_a_search_is_an_effect_within_its_bounds() {
        let scope = super::super::Scope {
            working_point_um: 4.0,
            low_um: 2.0,
            high_um: 6.0,
            stroke_um: 2.0,
            travel_um: 10.0,
            sample_s: 1e-3,
            length_s: 16.0,
            sampled_input: false,
            per_unit: [1.0, 1.0],
        };
        for kind in TABLE {
            for (i, c) in kind.candidates().iter().enumerate() {
                for start in kind.starts(i, &scope) {
                    assert_eq!(start.len(), c.params.len(), "{}", kind.spec().id);
                    let natural: Vec<f64> = start
                        .iter()
                        .zip(c.params)
                        .map(|(v, p)| p.natural(p.coordinate(*v)))
                        .collect();
                    let effect = kind.build(i, &natural, &scope);
                    assert!(effect.validate().is_ok(), "{effect:?}");
                    assert_eq!(effect.id(), kind.spec().id);
                }
            }
        }
    }
}
