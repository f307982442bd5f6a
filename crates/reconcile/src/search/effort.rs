//! How hard to search.

use crate::fit::context::{Context, Fit};

/// The factor by which a search may exceed its work to weigh the rivals of its result.
const BEYOND: f64 = 2.0;

/// How hard to search.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Effort {
    pub threads: usize,
    pub max_effects: usize,
    /// Work of simulations after which no further effect is looked for.
    pub work: u64,
    /// Sum of squares that a set must come down to, to matter at all.
    pub to_beat: f64,
}

impl Effort {
    /// Whether the work is done up: nothing more is looked for.
    pub(crate) fn is_spent(&self, ctx: &Context<'_>) -> bool {
        ctx.problem.spent() > self.work
    }

    /// Whether a set cannot come down to what it has to beat, even if each effect that may still be added gains as much as the last one did.
    /// A search takes the most valuable effects first.
    pub(crate) fn is_beaten(&self, fit: &Fit, gained: f64) -> bool {
        let open = self.max_effects.saturating_sub(fit.parts.len());
        fit.chi2 - gained * open as f64 > self.to_beat
    }

    /// Whether it is so far beyond that not even the rivals of a set are weighed any more, which is then no name.
    pub(crate) fn is_over(&self, ctx: &Context<'_>) -> bool {
        ctx.problem.spent() as f64 > BEYOND * self.work as f64
    }
}
