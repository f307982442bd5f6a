//! The bound that Brownian motion sets to the error.

use super::ticks::Ticks;
use cellpos_record::{RunMeta, RunReader};
use cellpos_report::{Emphasis, Report};
use cellpos_runtime::Hold;
use cellpos_session::connect;
use cellpos_session::recorded::{self, diffusion_of_run_um2_per_s};

/// What Brownian motion, delay and localisation noise leave to the best controller while holding.
#[derive(Debug)]
pub(super) struct Bound {
    pub diffusion_um2_per_s: f64,
    pub rms_um: f64,
}

/// How well the bead of a run is to be held, if its run.toml says enough.
pub(super) fn hold_of(meta: &RunMeta) -> Option<Hold> {
    let timing = meta.config.get("timing")?;
    let at = |key: &str| timing.get(key)?.as_float();
    Some(Hold::new(
        diffusion_of_run_um2_per_s(meta)?,
        at("camera_delay_ms")? * 1e-3,
        at("period_us")? * 1e-6,
    ))
}

impl Bound {
    /// Whether the run held below it by more than chance.
    pub(super) fn is_beaten(&self, ticks: &Ticks) -> bool {
        ticks.rms_um().is_some_and(|um| {
            let reached_um = (um.powi(2) - ticks.noise_um().powi(2)).max(0.0).sqrt();
            connect::is_beaten(self.rms_um, reached_um, ticks.counted_s())
        })
    }

    /// The bound, if it can be one; a note on the page if the run held below it.
    pub(super) fn unbeaten(self, ticks: &Ticks, page: &mut Report) -> Option<Self> {
        if !self.is_beaten(ticks) {
            return Some(self);
        }
        page.note(
            Emphasis::Warning,
            &format!(
                "The run held below what its model says is possible, {:.1} nm: the model's diffusion ({:.3} um2/s) or delay is too large. \
                 Identify the plant again.",
                1e3 * self.rms_um,
                self.diffusion_um2_per_s
            ),
        );
        None
    }

    /// The bound of a run, with the delay that it measured, if its run.toml says enough.
    pub(super) fn of(run: &RunReader, ticks: &Ticks) -> Option<Self> {
        let meta = run.meta().ok()?;
        let setup = recorded::setup(run).ok()?;
        let diffusion_um2_per_s = diffusion_of_run_um2_per_s(meta)?;
        let half_period_ms = 0.5e-3 * setup.config.timing.period_us;
        let used_ms = match &meta.end {
            Some(end) => end
                .summary
                .get("exposure_to_command_us")
                .and_then(|frames| {
                    let loop_delay_ms = end.summary.get("loop_delay_ms")?.as_float()?;
                    (frames.get("max")?.as_float()? > 0.0).then_some(loop_delay_ms)
                }),
            // Of a run without an end: from its rows.
            None => ticks.age_ms().map(|ms| ms + half_period_ms),
        };
        let delay_s = connect::delay_of_run_s(&setup, used_ms);
        Some(Self {
            diffusion_um2_per_s,
            rms_um: connect::bound_of_um(&setup, diffusion_um2_per_s, ticks.noise_um(), delay_s),
        })
    }
}
