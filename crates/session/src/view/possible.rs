//! The lowest possible error of a run for page and screen: of the run so far, and at its end the figure of terminal and report.

use super::tail::Tail;
use crate::connect::{Reached, bound_of_run_nm};
use crate::setup::Setup;
use cellpos_runtime::TickRecord;

/// Set-up of a run, and the age of its frames as measured so far.
pub(super) struct Possible {
    setup: Setup,
    diffusion_um2_per_s: f64,
    /// From the middle of an exposure to the command computed from it.
    delays: Tail,
    newest_frame: u64,
}

impl Possible {
    /// `None` without Brownian motion: then no error is the lowest possible.
    pub(super) fn new(setup: &Setup, diffusion_um2_per_s: f64) -> Option<Self> {
        (diffusion_um2_per_s > 0.0).then(|| Self {
            setup: setup.clone(),
            diffusion_um2_per_s,
            delays: Tail::new(),
            newest_frame: 0,
        })
    }

    /// Measures the age of a tick's frame, if the tick has a new one.
    pub(super) fn count(&mut self, record: &TickRecord) {
        if record.frame_id == self.newest_frame {
            return;
        }
        self.newest_frame = record.frame_id;
        let handed_ns = record.time_ns + i64::from(record.compute_ns);
        if let Ok(ns) = u32::try_from(handed_ns - record.mid_exposure_ns) {
            self.delays.add(ns);
        }
    }

    /// Of the run so far, nm.
    pub(super) fn so_far_nm(&self, fix_noise_nm: f64) -> Option<f64> {
        let half_period_ms = 0.5e-3 * self.setup.config.timing.period_us;
        let loop_delay_ms = (self.delays.median_us()).map(|us| us * 1e-3 + half_period_ms);
        self.of(&Reached {
            fix_noise_nm,
            loop_delay_ms,
            rms_true_nm: None,
            rms_measured_nm: None,
            duration_s: 0.0,
        })
    }

    /// Of a run with these figures, nm.
    pub(super) fn of(&self, run: &Reached) -> Option<f64> {
        bound_of_run_nm(&self.setup, self.diffusion_um2_per_s, run)
    }
}
