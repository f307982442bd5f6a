//! Whether something holds the bead, and how fast it may move while that is so and just after.

use super::{Estimator, EstimatorState, Fix, HISTORY, STUCK_AVERAGE};

/// Evidence, natural logarithm of the odds, from which a bead that does not follow is taken to be held: a free one seems to be
/// still so well once in e^8 times, and tries a hundred times a second.
const HELD_EVIDENCE: f64 = 8.0;
/// Evidence below which it is not: one that is held passes it in two or three fixes, and has had a dozen by then.
const WALKS_EVIDENCE: f64 = 1.0;
/// Largest evidence that is kept, so that a bead that comes free is noticed.
const MOST_EVIDENCE: f64 = 25.0;

/// A bead that is held stays where it is; one that is not walks. A Kalman filter of one number for either, from the same fix on.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct StillBead {
    /// Position and variance of a bead that is held, um.
    held: [f64; 2],
    /// Those of one that walks.
    walks: [f64; 2],
    /// Evidence that it is held, natural logarithm of the odds, 0 or more.
    evidence: f64,
}

impl StillBead {
    /// Takes a fix in, after a walk of that variance.
    fn weigh(&mut self, fix: &Fix, walk_um2: f64) {
        let noise_um2 = fix.variance_um2.max(1e-12);
        let likely = |[position_um, variance_um2]: &mut [f64; 2], least_um2: f64| {
            let spread_um2 = *variance_um2 + noise_um2;
            let off_um = fix.position_um - *position_um;
            *position_um += *variance_um2 / spread_um2 * off_um;
            *variance_um2 = (*variance_um2 * noise_um2 / spread_um2).max(least_um2);
            -0.5 * (off_um * off_um / spread_um2 + spread_um2.ln())
        };
        self.walks[1] += walk_um2;
        // What holds it may creep.
        let held = likely(&mut self.held, STUCK_AVERAGE * noise_um2);
        let walks = likely(&mut self.walks, 0.0);
        self.evidence = (self.evidence + held - walks).min(MOST_EVIDENCE);
        if self.evidence <= 0.0 {
            let at = [fix.position_um, noise_um2];
            *self = Self {
                held: at,
                walks: at,
                evidence: 0.0,
            };
        }
    }
}

/// Speed granted in these ticks, over that of a stuck bead.
const RELEASED_SPEED: f64 = 2.0;

impl Estimator {
    /// Sum of the logarithms of the odds that the bead does not move against that it moves half as far as predicted, never
    /// below 0. A gain of a quarter is the watershed: a bead twice as slow as the model is not taken for stuck. Nothing is
    /// forgotten, for a bead held near its target, where next to no motion is predicted, lets neutral run away slowly,
    /// and that takes as long to show. A bead that does not follow and walks is not held: its actuator clips, or is off. One
    /// that has moved, if only by its Brownian motion, is not stuck: that ends the verdict at once.
    pub(super) fn weigh_stuck(
        &self,
        state: &mut EstimatorState,
        innovation_um: f64,
        motion_um: f64,
        fix: &Fix,
    ) {
        let variance_um2 = fix.variance_um2;
        let still_um = if state.stuck {
            innovation_um
        } else {
            innovation_um + motion_um
        };
        let walk_um2 = 2.0 * self.config.diffusion_um2_per_s * self.model.sample_time_s;
        state.still.weigh(fix, walk_um2);
        let noise_um2 = walk_um2 + 2.0 * variance_um2;
        let moved = still_um * still_um
            > if state.stuck {
                25.0 * variance_um2
            } else {
                9.0 * noise_um2
            };
        if state.stuck && moved {
            state.stuck_evidence = 0.0;
            state.stuck = false;
            return;
        }
        // One fix decides little: an outlier or a jolt must not make a verdict. But nothing that is held moves, however
        // badly the motion fits the prediction: an unknown lag turns a fast motion to and fro about.
        const MOST: f64 = 2.0;
        // A bead that does not walk is off the prediction by the noise of its fixes alone, if it follows: next to its target, where the
        // commands are small, that tells in tenths of a second what a walk would hide for seconds.
        let walks = state.still.evidence <= HELD_EVIDENCE;
        let off_um2 = 2.0 * variance_um2 + if walks { walk_um2 } else { 0.0 };
        let odds = if moved {
            -MOST
        } else {
            let odds = motion_um * (0.25 * motion_um - still_um) / (2.0 * off_um2.max(1e-12));
            odds.clamp(-MOST, MOST)
        };
        state.stuck_evidence = (state.stuck_evidence + odds).clamp(0.0, MOST_EVIDENCE);
        let [apart, held] = if state.stuck {
            [3.0, 0.0]
        } else {
            [12.0, HELD_EVIDENCE]
        };
        state.stuck = state.stuck_evidence > apart && state.still.evidence > held;
        if state.stuck_evidence >= MOST_EVIDENCE && state.still.evidence < WALKS_EVIDENCE {
            // Neither does it follow nor is it held: the flow has stepped by too little to be seen in one fix.
            state.stuck_evidence = 0.0;
            state.stepped_ticks = HISTORY as u8;
            state.doubt_neutral();
        }
    }

    /// Largest distance of the command from neutral that keeps to the speed granted, um.
    pub(super) fn authority_um(&self, state: &EstimatorState) -> f64 {
        let granted_um = self.config.stuck_speed_um_per_tick;
        let speed_um = match (state.stuck, state.released_ticks) {
            (true, _) => granted_um,
            (false, 1..) => RELEASED_SPEED * granted_um,
            (false, 0) => return f64::INFINITY,
        };
        speed_um / self.tick.gain.abs().max(1e-12)
    }
}
