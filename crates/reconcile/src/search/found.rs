//! What a search found: a set of effects, and what else could stand in the place of each.

use crate::fit::catalogue::Part;
use crate::fit::context::{Context, Fit};

/// A set with the rivals met on the way.
#[derive(Debug, Clone)]
pub(crate) struct Found {
    pub fit: Fit,
    pub null: Fit,
    /// Sum of squares after each step, with the set of that step.
    pub steps: Vec<(Vec<&'static str>, f64)>,
    /// For each effect of the set: rivals in its stead, id and sum of squares of the joint refit. Shorter than the set: they were not
    /// weighed.
    pub rivals: Vec<Vec<Rival>>,
    /// The search ended because its work was done up, not because nothing more was to be found.
    pub cut_short: bool,
}

/// Another candidate in place of a named one.
#[derive(Debug, Clone)]
pub(crate) struct Rival {
    pub id: &'static str,
    pub chi2: f64,
    pub part: Part,
    /// Whether one of its numbers is at the end of its range, or may have any value in it.
    pub is_limit: bool,
}

/// Rounds of the fit of a rival beside a smaller set.
const ROUNDS: usize = 12;

impl Found {
    /// Reduces the set to some of its effects, with their fit. A rival was weighed beside all of them, so it is fitted again.
    pub(crate) fn keep(&mut self, ctx: &Context<'_>, kept: &[usize], fit: Fit, threads: usize) {
        let mut stays = Vec::new();
        for (place, i) in kept.iter().enumerate() {
            let rivals = self.rivals.get(*i).map_or(&[][..], Vec::as_slice);
            stays.push(cellpos_numeric::parallel::map(rivals, threads, |rival| {
                let mut parts = fit.parts.clone();
                parts[place] = rival.part.clone();
                let beside = ctx.fit_from(parts, Some(fit.soft), &ctx.problem.all(), ROUNDS);
                Rival {
                    chi2: beside.chi2,
                    part: beside.parts[place].clone(),
                    ..rival.clone()
                }
            }));
        }
        if self.rivals.len() >= self.fit.parts.len() {
            self.rivals = stays;
        } else {
            self.rivals.clear();
        }
        self.fit = fit;
    }

    /// The set without one of its effects, as [`Found::keep`].
    pub(crate) fn lose(&mut self, ctx: &Context<'_>, lost: usize, fit: Fit, threads: usize) {
        let kept: Vec<usize> = (0..self.fit.parts.len()).filter(|i| *i != lost).collect();
        self.keep(ctx, &kept, fit, threads);
    }
}
