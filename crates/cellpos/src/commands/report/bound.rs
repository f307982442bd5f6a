//! The bound that Brownian motion sets to the error.

use super::ticks::Ticks;
use cellpos_control::design::bound_rms_um;
use cellpos_record::RunMeta;

/// What Brownian motion, delay and localisation noise leave to the best controller while holding.
#[derive(Debug)]
pub struct Bound {
    pub diffusion_um2_per_s: f64,
    pub rms_um: f64,
}

impl Bound {
    /// The bound of a run, if its run.toml says enough.
    pub fn of(meta: Option<&RunMeta>, ticks: &Ticks) -> Option<Self> {
        let meta = meta?;
        let at = |path: &[&str]| -> Option<f64> {
            let (first, rest) = path.split_first()?;
            let mut value = meta.config.get(*first)?;
            for key in rest {
                value = value.get(*key)?;
            }
            value.as_float()
        };
        let diffusion_um2_per_s = cellpos_session::recorded::diffusion_of_run_um2_per_s(meta)?;
        let delay_s = at(&["timing", "camera_delay_ms"])? * 1e-3;
        let period_s = at(&["timing", "period_us"])? * 1e-6;
        Some(Self {
            diffusion_um2_per_s,
            rms_um: bound_rms_um(diffusion_um2_per_s, ticks.noise_um(), delay_s, period_s),
        })
    }
}
