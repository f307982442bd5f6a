//! Does the bead follow the commands on both sides of zero flow? An amplifier that clips just beside it pushes the bead one way only, and
//! the flow the other: the loop holds, but more loosely, and loses the bead at the next change of the flow.
//!
//! Commands answer the flow, so what the bead does under them says little. Their random part (the dither) does not: the bead's motion
//! that goes with it gives the gain, apart for commands above and below zero flow. Three hypotheses are weighed: the bead follows on both
//! sides, on one only, or on none, as it seems to when the delay changes. Page's test finds the time from which the second is better than
//! the first; since then it must be better than the third as well.

/// Natural logarithm of the odds that are asked for. Page's test on a loop that follows comes back to zero within a second, and is wrong
/// once in e^16 of such times, a hundred days. A dither that costs 1 % of a hold reaches it in 7 s.
const EVIDENCE: f64 = 16.0;
/// Time in which what was learnt of a side is forgotten, s: twice what it takes to know the gain to 25 %, which is as good as exact here.
const MEMORY_S: f64 = 30.0;
/// Ticks over which the bead's drift is averaged, to count its motion from there. Their own noise adds 1/32 to that of a tick.
const DRIFT_TICKS: f64 = 16.0;
/// A motion further off than so many standard deviations counts as so far only.
const FURTHEST: f64 = 3.0;
/// By how many standard deviations the gain of the other side may be smaller than it seems.
const DOUBT: f64 = 2.0;

/// The bead from one tick to the next, um.
pub(super) struct Moved {
    pub bead_um: f64,
    /// Mean square of that motion.
    pub usual_um2: f64,
    /// What the dither alone moves the bead of the model.
    pub dither_um: f64,
    /// Whether the command without the dither was above zero flow.
    pub above: bool,
}

/// Commands on one side of zero flow.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Side {
    /// Sums of dither times motion and of dither squared, um^2.
    moved_um2: f64,
    dithered_um2: f64,
    /// That the bead follows on the other side only, against both sides and against none, natural logarithms of the odds.
    evidence: [f64; 2],
}

impl Side {
    /// Gain over the model's, as small as it may be, and none above the model's. A tick whose dither moves the bead by next to nothing may
    /// seem to show any gain. The next tick, judged by that gain, would outweigh all others.
    fn least_gain(&self, spread_um2: f64) -> f64 {
        if self.dithered_um2 <= 0.0 {
            return 0.0;
        }
        let doubt_um2 = DOUBT * (spread_um2 * self.dithered_um2).sqrt();
        ((self.moved_um2 - doubt_um2) / self.dithered_um2).clamp(0.0, 1.0)
    }
}

/// Odds that the bead, which went `bead_um`, was not moved by the command, against a motion of `follows_um` by the command: their
/// natural logarithm.
fn odds_of_none(bead_um: f64, follows_um: f64, spread_um2: f64) -> f64 {
    follows_um * (0.5 * follows_um - bead_um) / spread_um2
}

/// The watch over both sides.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct OneSided {
    /// What a tick leaves of what is known.
    kept: f64,
    drift_um: f64,
    /// Below zero flow, and above.
    sides: [Side; 2],
}

impl OneSided {
    pub(super) fn new(sample_s: f64) -> Self {
        Self {
            kept: (-sample_s / MEMORY_S).exp(),
            drift_um: 0.0,
            sides: [Side::default(); 2],
        }
    }

    pub(super) fn step(&mut self, moved: &Moved) {
        let spread_um2 = moved.usual_um2;
        let finite = [moved.bead_um, moved.dither_um, spread_um2];
        if !finite.into_iter().all(f64::is_finite) || spread_um2 <= 0.0 {
            return;
        }
        let furthest_um = FURTHEST * spread_um2.sqrt();
        let bead_um = (moved.bead_um - self.drift_um).clamp(-furthest_um, furthest_um);
        self.drift_um += bead_um / DRIFT_TICKS;
        let [below, above] = &mut self.sides;
        let (side, other) = if moved.above {
            (above, below)
        } else {
            (below, above)
        };
        let gains = [&*other, &*side].map(|side| side.least_gain(spread_um2));
        let [none, own] =
            gains.map(|gain| odds_of_none(bead_um, gain * moved.dither_um, spread_um2));
        side.evidence[0] += none;
        if side.evidence[0] <= 0.0 {
            side.evidence = [0.0; 2];
        }
        other.evidence[1] -= own;
        side.moved_um2 = self.kept * side.moved_um2 + moved.dither_um * bead_um;
        side.dithered_um2 = self.kept * side.dithered_um2 + moved.dither_um * moved.dither_um;
    }

    /// Whether the bead follows on one side only.
    pub(super) fn told(&self) -> bool {
        let told = |side: &Side| side.evidence.iter().all(|odds| *odds > EVIDENCE);
        self.sides.iter().any(told)
    }
}
