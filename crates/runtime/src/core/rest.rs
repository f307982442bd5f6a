//! Where the flow stands still, for a PZT that has to stop while no bead tells.
//!
//! The newest estimate of the zero flow may be what went wrong: it winds up while the bead is followed badly. It counts when the
//! last fixes agreed with it; otherwise that of the last quiet time does.

use cellpos_control::LoopFlags;

/// Time over which the quiet zero flow is averaged, s: the estimate itself is an average over 0.14 s with the usual walk of the zero flow,
/// and what is longer than that would only be older.
const QUIET_S: f64 = 0.1;
/// Ticks beyond the delay for which fixes must agree with a newer estimate: one of hold, and two in which the filter learns a step.
const LEARNING_TICKS: f64 = 3.0;
/// Standard deviations that a fix may be off its prediction and agree: a quiet one is further off once in 370, and the newest estimate
/// then does not count for a few ticks.
const AGREES_SIGMA: f64 = 3.0;

/// The zero flow of the last quiet time, and how long the newest has been supported.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Rest {
    quiet_um: f64,
    agreeing: u32,
    /// Fixes in a row that must agree with a newer estimate before it counts.
    enough: u32,
}

impl Rest {
    /// For fixes that are so many ticks old.
    pub(super) fn new(zero_flow_um: f64, delay_ticks: f64) -> Self {
        Self {
            quiet_um: zero_flow_um,
            agreeing: 0,
            enough: (delay_ticks.max(0.0).round() + LEARNING_TICKS) as u32,
        }
    }

    /// Takes in the estimate of a tick with a fix that was off its prediction by `innovation_um`, whose variance is
    /// `variance_um2` where nothing but the bead's walk and the noise of the fix moves it.
    pub(super) fn step(
        &mut self,
        zero_flow_um: f64,
        innovation_um: f64,
        variance_um2: f64,
        flags: LoopFlags,
        sample_s: f64,
    ) {
        let small = innovation_um * innovation_um < AGREES_SIGMA * AGREES_SIGMA * variance_um2;
        if !small || flags.coasting || flags.gated || flags.stuck {
            self.agreeing = 0;
            return;
        }
        self.agreeing = self.agreeing.saturating_add(1);
        if self.agreeing > self.enough {
            let share = (sample_s / QUIET_S).min(1.0);
            self.quiet_um += share * (zero_flow_um - self.quiet_um);
        }
    }

    /// The zero flow has moved by a known amount, um.
    pub(super) fn shift(&mut self, by_um: f64) {
        self.quiet_um += by_um;
    }

    /// The zero flow to stop at, um, when the newest estimate is `newest_um`.
    pub(super) fn zero_flow_um(&self, newest_um: f64) -> f64 {
        if self.agreeing > self.enough && newest_um.is_finite() {
            newest_um
        } else {
            self.quiet_um
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_wound_up_while_fixes_disagreed_is_not_where_the_pzt_stops() {
        let mut rest = Rest::new(20.0, 2.0);
        let mut tick = |zero_flow_um, innovation_um| {
            rest.step(
                zero_flow_um,
                innovation_um,
                1e-3,
                LoopFlags::default(),
                1e-3,
            );
            rest.zero_flow_um(zero_flow_um)
        };
        for _ in 0..1000 {
            tick(20.1, 0.02);
        }
        assert_eq!(tick(20.11, 0.02), 20.11);
        // A step of the flow: the estimate is on its way.
        let stops_um = tick(21.0, 0.3);
        assert!((stops_um - 20.1).abs() < 0.01, "{stops_um}");
        // The fixes since then support the new one.
        for _ in 0..5 {
            assert!((tick(20.5, 0.01) - 20.1).abs() < 0.01);
        }
        assert_eq!(tick(20.5, 0.01), 20.5);
    }
}
