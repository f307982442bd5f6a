//! Where the flow stands still, for a PZT that has to stop while no bead tells.
//!
//! The newest estimate of the zero flow follows a flow that changes fast: it is known less well than a quiet flow allows, and it may be what
//! went wrong, for a fix that is not the bead's throws it far off. So two hypotheses are weighed. In one the zero flow walks as that of a
//! rig at rest: a Kalman filter for this walk averages over 1 s. The other is the newest estimate. Each predicts how far the bead goes from
//! fix to fix. When the fixes speak for the newest, the quiet filter starts again from it.

use cellpos_control::{LoopFlags, ZERO_FLOW_WALK_UM_PER_SQRT_S};

/// Natural logarithm of the odds at which the newest estimate takes the place of the quiet one. A flow that steps 0.01 times in a second
/// does so in one tick of 1 ms with a chance of e^-11.5.
const EVIDENCE: f64 = 12.0;
/// Standard deviations that a fix may be off the prediction of the newest estimate and count for the quiet one.
const AGREES_SIGMA: f64 = 3.0;

/// A zero flow and how well it is known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ZeroFlow {
    pub um: f64,
    pub variance_um2: f64,
}

/// A fix as both hypotheses see it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Seen {
    /// Off its prediction with the newest zero flow, um.
    pub innovation_um: f64,
    /// Variance of the bead's walk in a tick, and that of the fix, um^2.
    pub walk_um2: f64,
    pub fix_um2: f64,
    /// The newest zero flow before the fix.
    pub newest: ZeroFlow,
    /// Way of the bead in a tick for 1 um of PZT, um.
    pub gain: f64,
}

/// The zero flow of a quiet rig, and what speaks for the newest.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Rest {
    quiet: ZeroFlow,
    evidence: f64,
    /// Ticks since a fix was used.
    since_fix: f64,
}

impl Rest {
    pub(super) fn new(zero_flow: ZeroFlow) -> Self {
        Self {
            quiet: zero_flow,
            evidence: 0.0,
            since_fix: 0.0,
        }
    }

    /// `ticks` of `sample_s` have passed.
    pub(super) fn wait(&mut self, ticks: u64, sample_s: f64) {
        let ticks = ticks as f64;
        self.since_fix += ticks;
        self.quiet.variance_um2 += ZERO_FLOW_WALK_UM_PER_SQRT_S.powi(2) * sample_s * ticks;
    }

    /// Takes in a fix.
    pub(super) fn step(&mut self, seen: &Seen, flags: LoopFlags) {
        if flags.stuck {
            // No flow moves a bead that is held.
            self.since_fix = 0.0;
            return;
        }
        if flags.coasting || flags.gated {
            return;
        }
        let ticks = std::mem::take(&mut self.since_fix).max(1.0);
        let way = seen.gain * ticks;
        let walk_um2 = seen.walk_um2 * ticks;
        let newest_um2 = seen.innovation_um.powi(2);
        let off_um = |quiet: &ZeroFlow| seen.innovation_um + way * (quiet.um - seen.newest.um);
        let evidence = 0.5 * (off_um(&self.quiet).powi(2) - newest_um2) / (walk_um2 + seen.fix_um2);
        if evidence.is_finite() {
            self.evidence = (self.evidence + evidence).max(0.0);
        }
        if self.evidence > EVIDENCE || self.quiet.variance_um2 > seen.newest.variance_um2 {
            (self.quiet, self.evidence) = (seen.newest, 0.0);
        }
        if newest_um2 < AGREES_SIGMA * AGREES_SIGMA * (walk_um2 + seen.fix_um2) {
            // The noise of a fix is taken back by the next: what is left of the mean over many is the walk.
            let ZeroFlow { um, variance_um2 } = self.quiet;
            let share = variance_um2 * way / (variance_um2 * way * way + walk_um2);
            self.quiet = ZeroFlow {
                um: um - share * off_um(&self.quiet),
                variance_um2: (1.0 - share * way) * variance_um2,
            };
        }
    }

    /// The zero flow has moved by a known amount, um.
    pub(super) fn shift(&mut self, by_um: f64) {
        self.quiet.um += by_um;
    }

    /// The zero flow to stop at.
    pub(super) fn zero_flow(&self) -> ZeroFlow {
        self.quiet
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn known(um: f64, sd_um: f64) -> ZeroFlow {
        ZeroFlow {
            um,
            variance_um2: sd_um * sd_um,
        }
    }

    fn fix(newest: ZeroFlow, innovation_um: f64) -> Seen {
        Seen {
            innovation_um,
            walk_um2: 7e-4,
            fix_um2: 3e-4,
            newest,
            gain: 0.38,
        }
    }

    /// A bead with a displacement of 1 um held, and fixes that show how far it goes in a tick.
    fn stops(fixes: impl IntoIterator<Item = (f64, f64)>) -> f64 {
        let mut rest = Rest::new(known(20.0, 2e-3));
        for (newest_um, innovation_um) in fixes {
            rest.wait(1, 1e-3);
            rest.step(
                &fix(known(newest_um, 4e-3), innovation_um),
                LoopFlags::default(),
            );
        }
        rest.zero_flow().um
    }

    #[test]
    fn a_flow_that_stepped_is_believed_once_two_fixes_went_with_it() {
        // The fix that shows the step is as far off for both; the one after it goes with the newest alone.
        assert_eq!(stops([(20.0, -0.99)]), 20.0);
        let on_its_way = [(20.0, -0.99), (22.6, 0.03)];
        assert!((stops(on_its_way) - 22.6).abs() < 1e-3);
    }

    #[test]
    fn a_fix_that_was_not_the_bead_s_leaves_the_pzt_where_it_was() {
        let thrown = [(20.0, -0.99), (22.6, 0.99), (21.0, 0.38)];
        assert!((stops(thrown) - 20.0).abs() < 0.01);
    }

    #[test]
    fn a_zero_flow_that_wanders_is_followed() {
        let wandering = (0..3000).map(|_| (20.1, 0.0));
        assert!((stops(wandering) - 20.1).abs() < 0.01);
    }
}
