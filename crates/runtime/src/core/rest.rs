//! Where the flow stands still, for a PZT that has to stop while no bead tells.
//!
//! The newest estimate of the zero flow may be what went wrong: it winds up while the bead is followed badly, and a fix that is not the
//! bead's throws it far off. So two hypotheses are weighed, the zero flow of the quiet time before and the newest one. Each predicts how
//! far the bead goes from fix to fix. When the fixes speak for the newest, it takes the place of the other at once.

use cellpos_control::LoopFlags;

/// Time over which the quiet zero flow is averaged, s: the estimate itself is an average over 0.14 s with the usual walk of the zero flow,
/// and what is longer than that would only be older.
const QUIET_S: f64 = 0.1;
/// Natural logarithm of the odds at which the newest estimate takes the place of the quiet one. A flow that steps 0.01 times in a second
/// does so in one tick of 1 ms with a chance of e^-11.5.
const EVIDENCE: f64 = 12.0;
/// Standard deviations that a fix may be off its prediction and count for the average.
const AGREES_SIGMA: f64 = 3.0;

/// A fix as both hypotheses see it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Seen {
    /// Off its prediction with the zero flow of the tick before, um.
    pub innovation_um: f64,
    /// Variance of that where nothing but the bead's walk and the noise of the fix moves it, um^2.
    pub variance_um2: f64,
    /// The newest zero flow before and after the fix, um.
    pub newest_um: [f64; 2],
    /// Way of the bead in a tick for 1 um of PZT, um.
    pub gain: f64,
}

/// The zero flow of the last quiet time, and what speaks for the newest.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Rest {
    quiet_um: f64,
    evidence: f64,
    /// Ticks since a fix was used.
    since_fix: f64,
}

impl Rest {
    pub(super) fn new(zero_flow_um: f64) -> Self {
        Self {
            quiet_um: zero_flow_um,
            evidence: 0.0,
            since_fix: 0.0,
        }
    }

    /// `ticks` have passed.
    pub(super) fn wait(&mut self, ticks: u64) {
        self.since_fix += ticks as f64;
    }

    /// Takes in a fix.
    pub(super) fn step(&mut self, seen: &Seen, flags: LoopFlags, sample_s: f64) {
        if flags.coasting || flags.gated || flags.stuck {
            return;
        }
        let ticks = std::mem::take(&mut self.since_fix).max(1.0);
        let [before_um, after_um] = seen.newest_um;
        let newest_um2 = seen.innovation_um.powi(2);
        let way_um = seen.gain * ticks * (self.quiet_um - before_um);
        let quiet_um2 = (seen.innovation_um + way_um).powi(2);
        let evidence = 0.5 * (quiet_um2 - newest_um2) / seen.variance_um2;
        if evidence.is_finite() {
            self.evidence = (self.evidence + evidence).max(0.0);
        }
        if self.evidence > EVIDENCE {
            (self.quiet_um, self.evidence) = (before_um, 0.0);
        } else if newest_um2 < AGREES_SIGMA * AGREES_SIGMA * seen.variance_um2 {
            let share = (sample_s / QUIET_S).min(1.0);
            self.quiet_um += share * (after_um - self.quiet_um);
        }
    }

    /// The zero flow has moved by a known amount, um.
    pub(super) fn shift(&mut self, by_um: f64) {
        self.quiet_um += by_um;
    }

    /// The zero flow to stop at, um.
    pub(super) fn zero_flow_um(&self) -> f64 {
        self.quiet_um
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A bead with a displacement of 1 um held, and fixes that show how far it goes in a tick.
    fn stops(fixes: impl IntoIterator<Item = ([f64; 2], f64)>) -> f64 {
        let mut rest = Rest::new(20.0);
        for (newest_um, innovation_um) in fixes {
            let seen = Seen {
                innovation_um,
                variance_um2: 1e-3,
                newest_um,
                gain: 0.38,
            };
            rest.wait(1);
            rest.step(&seen, LoopFlags::default(), 1e-3);
        }
        rest.zero_flow_um()
    }

    #[test]
    fn a_flow_that_stepped_is_believed_once_two_fixes_went_with_it() {
        // The fix that shows the step is as far off for both; the one after it goes with the newest alone.
        assert_eq!(stops([([20.0, 22.6], -0.99)]), 20.0);
        let on_its_way = [([20.0, 22.6], -0.99), ([22.6, 22.5], 0.03)];
        assert_eq!(stops(on_its_way), 22.6);
    }

    #[test]
    fn a_fix_that_was_not_the_bead_s_leaves_the_pzt_where_it_was() {
        let thrown = [
            ([20.0, 22.6], -0.99),
            ([22.6, 21.0], 0.99),
            ([21.0, 20.4], 0.38),
        ];
        assert!((stops(thrown) - 20.0).abs() < 0.01);
    }

    #[test]
    fn a_zero_flow_that_wanders_is_followed() {
        let wandering = (0..1000).map(|_| ([20.1, 20.1], 0.02));
        assert!((stops(wandering) - 20.1).abs() < 1e-3);
    }
}
