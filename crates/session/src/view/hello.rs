//! Data of a run for the page before it begins.

use crate::rig::Rig;
use crate::setup::Setup;
use cellpos_control::ADAPT_COLUMNS;
use cellpos_live::Hello;

/// Text of the page about the run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Page {
    /// Its name.
    pub name: String,
    /// The run in a few words.
    pub subtitle: String,
    /// Whether the operator may set the target.
    pub steered: bool,
    /// Whether a script sets the target.
    pub script: bool,
    /// Whether notes are kept with the run.
    pub notes: bool,
}

/// The page's data of a run, from rig and set-up.
pub(super) fn hello(rig: &Rig, setup: &Setup, page: &Page) -> Hello {
    let source = rig.source();
    let diffusion = crate::fit::diffusion_um2_per_s(rig.file(), &setup.model);
    Hello {
        view_um: source.field_um,
        pictures: source.width_px > 0,
        cell: rig.file().follows_a_cell(),
        ..hello_of(setup, diffusion, page)
    }
}

/// The page's data of a run, from set-up and diffusion coefficient (um^2/s).
pub(super) fn hello_of(setup: &Setup, diffusion: f64, page: &Page) -> Hello {
    let limits = setup.controller.limits;
    let timing = &setup.config.timing;
    Hello {
        name: page.name.clone(),
        subtitle: page.subtitle.clone(),
        period_us: timing.period_us,
        range_um: [limits.low_um, limits.high_um],
        slew_um_per_s: limits.slew_um_per_s,
        budget_us: timing.budget_us,
        predicted_spectrum: predicted_spectrum(setup, diffusion),
        adaptation_at: adaptation_at(setup),
        steered: page.steered,
        script: page.script,
        notes: page.notes,
        ..Hello::default()
    }
}

/// Index of the first column of adaptation among the law's columns.
fn adaptation_at(setup: &Setup) -> Option<usize> {
    let law = setup.law().ok()?;
    let first = ADAPT_COLUMNS.first()?;
    law.columns().iter().position(|name| name == first)
}

/// The spectrum that the loop's linear model predicts for the measured error of a hold (see [`Hello::predicted_spectrum`]), up to half
/// the sampling rate. Empty for a law without a linear form, a model without noise, or a loop that is unstable on the model.
fn predicted_spectrum(setup: &Setup, diffusion_um2_per_s: f64) -> Vec<[f64; 3]> {
    const POINTS: usize = 200;
    let end_hz = 0.5e6 / setup.config.timing.period_us;
    let low_hz = 0.5_f64.min(0.1 * end_hz);
    let hz: Vec<f64> = (0..POINTS)
        .map(|n| low_hz * (end_hz / low_hz).powf(n as f64 / POINTS as f64))
        .collect();
    let Some(prediction) = setup.predicted_density(diffusion_um2_per_s, &hz) else {
        return vec![];
    };
    let parts = prediction.walk_nm.iter().zip(&prediction.per_noise);
    hz.iter()
        .zip(parts)
        .map(|(hz, (walk, fix))| [*hz, *walk, *fix])
        .collect()
}
