//! The bound that Brownian motion sets to the error.

use super::ticks::Ticks;
use cellpos_control::design::bound_rms_um;
use cellpos_record::RunMeta;
use cellpos_runtime::Hold;
use std::f64::consts::PI;

/// What Brownian motion, delay and localisation noise leave to the best controller while holding.
#[derive(Debug)]
pub struct Bound {
    pub diffusion_um2_per_s: f64,
    pub rms_um: f64,
    /// Time in which a displacement cannot yet be answered, s.
    blind_s: f64,
    period_s: f64,
}

/// Diffusion of the bead, um^2/s, delay of the camera and period of the loop, s, as a run.toml has them.
fn loop_of(meta: &RunMeta) -> Option<(f64, f64, f64)> {
    let timing = meta.config.get("timing")?;
    let at = |key: &str| timing.get(key)?.as_float();
    let diffusion_um2_per_s = cellpos_session::recorded::diffusion_of_run_um2_per_s(meta)?;
    Some((
        diffusion_um2_per_s,
        at("camera_delay_ms")? * 1e-3,
        at("period_us")? * 1e-6,
    ))
}

/// How well the bead of a run is to be held, if its run.toml says enough.
pub fn hold_of(meta: &RunMeta) -> Option<Hold> {
    let (diffusion_um2_per_s, delay_s, period_s) = loop_of(meta)?;
    Some(Hold::new(diffusion_um2_per_s, delay_s, period_s))
}

impl Bound {
    /// The bound of a run, if its run.toml says enough.
    pub fn of(meta: Option<&RunMeta>, ticks: &Ticks) -> Option<Self> {
        let (diffusion_um2_per_s, delay_s, period_s) = loop_of(meta?)?;
        Some(Self {
            diffusion_um2_per_s,
            rms_um: bound_rms_um(diffusion_um2_per_s, ticks.noise_um(), delay_s, period_s),
            blind_s: delay_s + period_s,
            period_s,
        })
    }

    /// One-sided amplitude density, nm/rtHz: the walk of the blind time, `4 D T^2 sinc^2(f T)`, and the estimate's own
    /// variance (the rest of the bound) spread evenly up to half the sampling rate.
    pub fn nm_per_rthz(&self, hz: f64) -> f64 {
        let x = PI * hz * self.blind_s;
        let sinc = if x == 0.0 { 1.0 } else { x.sin() / x };
        let walk = 4.0 * self.diffusion_um2_per_s * (self.blind_s * sinc).powi(2);
        let rest = self.rms_um * self.rms_um - 2.0 * self.diffusion_um2_per_s * self.blind_s;
        (walk + rest.max(0.0) * 2.0 * self.period_s).sqrt() * 1e3
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bounds_density_holds_the_bounds_variance() {
        let bound = Bound {
            diffusion_um2_per_s: 0.33,
            rms_um: bound_rms_um(0.33, 0.02, 2e-3, 1e-3),
            blind_s: 3e-3,
            period_s: 1e-3,
        };
        // To 500 Hz, which leaves a few percent of the walk beyond.
        let sum: f64 = (0..5000)
            .map(|k| bound.nm_per_rthz(f64::from(k) * 0.1 + 0.05).powi(2) * 0.1)
            .sum();
        let rms = bound.rms_um * 1e3;
        assert!(
            (sum.sqrt() / rms - 1.0).abs() < 0.05,
            "{} {rms}",
            sum.sqrt()
        );
    }
}
