//! What the page is told of a run before it begins.

use crate::connect;
use crate::rig::Rig;
use crate::setup::Setup;
use cellpos_control::ADAPT_COLUMNS;
use cellpos_control::design::bound_rms_um;
use cellpos_live::Hello;
use std::f64::consts::PI;

/// What the page says of the run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Page {
    /// Its name.
    pub name: String,
    /// What runs, in a few words.
    pub subtitle: String,
    /// Whether the operator may set the target.
    pub steered: bool,
    /// Whether a script says where the bead is to be.
    pub script: bool,
    /// Whether notes are kept with the run.
    pub notes: bool,
}

/// What rig and set-up say of a run.
pub(super) fn hello(rig: &Rig, setup: &Setup, page: &Page) -> Hello {
    let source = rig.source();
    let diffusion = connect::diffusion_um2_per_s(rig.file(), &setup.model);
    Hello {
        view_um: source.field_um,
        pictures: source.width_px > 0,
        ..hello_of(setup, diffusion, page)
    }
}

/// What set-up and diffusion coefficient (um^2/s) say of a run.
pub(super) fn hello_of(setup: &Setup, diffusion: f64, page: &Page) -> Hello {
    let limits = setup.controller.limits;
    let timing = &setup.config.timing;
    let period_s = timing.period_us * 1e-6;
    let delay_s = timing.camera_delay_ms * 1e-3;
    Hello {
        name: page.name.clone(),
        subtitle: page.subtitle.clone(),
        period_us: timing.period_us,
        range_um: [limits.low_um, limits.high_um],
        slew_um_per_s: limits.slew_um_per_s,
        budget_us: timing.budget_us,
        bound_nm: (diffusion > 0.0).then(|| 1e3 * bound_rms_um(diffusion, 0.0, delay_s, period_s)),
        bound_spectrum: lowest_spectrum(diffusion, delay_s + period_s, 0.5 / period_s),
        adaptation_at: adaptation_at(setup),
        steered: page.steered,
        script: page.script,
        notes: page.notes,
        ..Hello::default()
    }
}

/// Where in the law's columns those of adaptation begin.
fn adaptation_at(setup: &Setup) -> Option<usize> {
    let law = setup.law().ok()?;
    let first = ADAPT_COLUMNS.first()?;
    law.columns().iter().position(|name| name == first)
}

/// Amplitude spectral density (nm/sqrt(Hz), one-sided) of the lowest possible error: Brownian motion of the last `blind_s`
/// seconds, which no command could answer yet, up to `end_hz`. Its square integrates to 2 D times `blind_s`.
fn lowest_spectrum(diffusion_um2_per_s: f64, blind_s: f64, end_hz: f64) -> Vec<[f64; 2]> {
    const POINTS: usize = 300;
    if diffusion_um2_per_s.is_nan() || diffusion_um2_per_s <= 0.0 {
        return vec![];
    }
    let low_hz = 0.5_f64.min(0.1 * end_hz);
    (0..=POINTS)
        .map(|n| {
            let hz = low_hz * (end_hz / low_hz).powf(n as f64 / POINTS as f64);
            let per_s = PI * hz;
            let density = 4.0 * diffusion_um2_per_s * ((per_s * blind_s).sin() / per_s).powi(2);
            [hz, 1e3 * density.sqrt()]
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_lowest_spectrum_integrates_to_the_lowest_error() {
        let (diffusion, blind_s) = (0.33, 3e-3);
        let spectrum = lowest_spectrum(diffusion, blind_s, 50_000.0);
        let below = spectrum[0][0] * spectrum[0][1].powi(2);
        let squares: f64 = spectrum
            .windows(2)
            .map(|pair| 0.5 * (pair[1][0] - pair[0][0]) * (pair[0][1].powi(2) + pair[1][1].powi(2)))
            .sum();
        let rms_nm = (squares + below).sqrt();
        let bound_nm = 1e3 * bound_rms_um(diffusion, 0.0, 2e-3, 1e-3);
        assert!(
            (rms_nm / bound_nm - 1.0).abs() < 0.02,
            "{rms_nm} {bound_nm}"
        );
        assert!(lowest_spectrum(0.0, blind_s, 500.0).is_empty());
    }
}
