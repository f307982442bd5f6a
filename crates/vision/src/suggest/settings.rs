//! Settings of the localiser for a learnt profile.

use crate::config::{LocaliserConfig, MAX_WINDOW_PX, Polarity};
use crate::reach;
use crate::smooth::{Learnt, Parametric};
use crate::template::{ProfileSpec, TABLE_KNOTS};

/// Share of its extreme that a profile has at the bead's radius: that of a Gaussian at twice its standard deviation.
const AT_RADIUS: f64 = 0.135;
/// Share of a table in which it goes to zero.
pub(super) const FADE: f64 = 4.0 / (TABLE_KNOTS - 1) as f64;

/// Settings for a learnt profile.
pub(super) fn settings(
    learnt: &Learnt,
    parametric: Parametric,
    reach_px: f64,
    snr: f64,
) -> Option<LocaliserConfig> {
    if !learnt.deviates {
        let spec = match parametric {
            Parametric::Gaussian(sigma_px) => ProfileSpec::Gaussian {
                sigma_px: rounded(sigma_px, 1e3),
            },
            Parametric::Ring(edge_px) => ProfileSpec::Ring {
                edge_px: rounded(edge_px, 1e3),
            },
        };
        let mut config = LocaliserConfig::new(spec);
        if learnt.value(0.0) < learnt.value(reach_px) {
            config.polarity = Polarity::Dark;
        }
        return Some(config);
    }
    let knot_px = reach_px / (TABLE_KNOTS - 1) as f64;
    let profile: [f64; TABLE_KNOTS] = core::array::from_fn(|k| learnt.value(k as f64 * knot_px));
    let outer = &profile[TABLE_KNOTS * 5 / 6..];
    let floor = outer.iter().sum::<f64>() / outer.len() as f64;
    let extreme = profile.iter().map(|v| v - floor).fold(0.0_f64, |best, v| {
        if v.abs() > best.abs() { v } else { best }
    });
    if extreme == 0.0 {
        return None;
    }
    let mut values = profile.map(|v| (v - floor) / extreme);
    for (k, v) in values.iter_mut().enumerate() {
        let fade = ((TABLE_KNOTS - 1 - k) as f64 / 4.0).min(1.0);
        *v *= fade;
    }
    let radius_px = (core_knots(&values) * knot_px).max(1.0);
    let value = |r_px: f64| values[((r_px / knot_px).round() as usize).min(TABLE_KNOTS - 1)];
    let extent_px = reach::extent_px(value, reach_px, snr);
    let spec = ProfileSpec::Table {
        radius_px: rounded(radius_px, 100.0),
        knot_px: rounded(knot_px, 1e4),
        values: values.map(|v| rounded(v, 1e4)),
    };
    let mut config = LocaliserConfig::new(spec);
    let whole = 2 * extent_px.ceil() as usize + 1;
    config.window_px = whole.clamp(config.window_px, MAX_WINDOW_PX);
    config.polarity = if extreme > 0.0 {
        Polarity::Bright
    } else {
        Polarity::Dark
    };
    Some(config)
}

/// Distance at which a profile first falls to [`AT_RADIUS`] of its extreme, outwards from there, in knots.
fn core_knots(values: &[f64; TABLE_KNOTS]) -> f64 {
    let size = |k: usize| values.get(k).map_or(0.0, |v| v.max(0.0));
    let extreme = (0..TABLE_KNOTS).max_by(|a, b| size(*a).total_cmp(&size(*b)));
    let first = (extreme.unwrap_or(0)..TABLE_KNOTS - 1).find(|k| size(k + 1) < AT_RADIUS);
    first.map_or(TABLE_KNOTS as f64, |k| {
        k as f64 + (size(k) - AT_RADIUS) / (size(k) - size(k + 1))
    })
}

pub(super) fn rounded(v: f64, per_unit: f64) -> f64 {
    (v * per_unit).round() / per_unit
}
