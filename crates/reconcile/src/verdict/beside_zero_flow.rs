//! A set and the zero flow that it leaves, weighed together: the set of a search, its rivals, and smaller ones.

use crate::data::flow_loss::FlowLoss;
use crate::fit::context::{Context, Fit};
use crate::problem::Problem;
use crate::search::found::Rival;
use crate::search::sequential::within;
use crate::verdict::searching::{SETTLED, Searched, Searching};
use crate::verdict::wandering::prior_of;
use cellpos_numeric::parallel;
use cellpos_plant::effects::{Action, Place};

/// A set with the noise that it leaves, and their joint cost.
pub(super) struct Weighed {
    pub problem: Problem,
    pub fit: Fit,
    pub cost: f64,
}

impl Weighed {
    /// The cost up to which another set may still decide something.
    fn most(&self) -> f64 {
        self.cost + within(&self.fit)
    }
}

/// Whether any of the effects acts on the flow that passes the chip in another way than linearly.
fn acts_on_flow(ctx: &Context<'_>, fit: &Fit) -> bool {
    ctx.effects(&fit.parts).iter().any(|e| {
        let in_chip = matches!(e.kind().spec().place, Place::Chip | Place::Bead);
        in_chip && matches!(e.act(), Action::Block(_))
    })
}

impl Searching<'_> {
    /// Weighs the rivals of a set, each under the noise that it leaves itself: the model's stated error acts together with it, and it leaves another
    /// zero flow. `own` is the set under its noise. The best set with a rival in it that is more probable than `own`.
    ///
    /// Under the noise of the set a rival has to explain what that noise takes up.
    pub(super) fn weigh_rivals(
        &self,
        searched: &mut Searched,
        own: &Weighed,
        threads: usize,
    ) -> Option<Weighed> {
        let Searched { found, problem } = searched;
        let unpriced = |w: &Weighed| w.cost - self.prices(&w.problem, &w.fit);
        let (here, reach) = (unpriced(own), within(&found.fit));
        let fit = &found.fit;
        let most = own.most();
        let mut rivals: Vec<(usize, &mut Rival)> = (found.rivals.iter_mut().enumerate())
            .flat_map(|(place, rivals)| rivals.iter_mut().map(move |rival| (place, rival)))
            .filter(|(place, rival)| {
                rival.id != fit.parts[*place].id() && rival.chi2 - fit.chi2 <= reach
            })
            .collect();
        let weighed = parallel::map(&rivals, threads, |(place, rival)| {
            let mut parts = fit.parts.clone();
            parts[*place] = rival.part.clone();
            let ctx = self.context(problem, 0);
            let fit = ctx.fit_from(parts, Some(fit.soft), &problem.all(), 8);
            self.settled_zero_flow(problem, &fit, most, threads)
        });
        for ((place, rival), weighed) in rivals.iter_mut().zip(&weighed) {
            rival.chi2 = fit.chi2 + unpriced(weighed) - here;
            rival.part = weighed.fit.parts[*place].clone();
        }
        (weighed.into_iter())
            .min_by(|a, b| a.cost.total_cmp(&b.cost))
            .filter(|best| best.cost < own.cost)
    }

    /// Weighs a set without each of its parts, each under the noise that it leaves itself: a small part may stand for the path of a zero
    /// flow. Any may where the flow does not pass the chip linearly, because there a zero flow in the noise is no zero flow. The best set
    /// that is more probable.
    pub(super) fn weigh_smaller(&self, own: &Weighed, threads: usize) -> Option<Weighed> {
        let count = own.fit.parts.len();
        if count < 2 {
            return None;
        }
        let ctx = self.context(&own.problem, 0);
        let any = acts_on_flow(&ctx, &own.fit);
        let most = own.fit.chi2 + within(&own.fit);
        let all = own.problem.all();
        let parts: Vec<usize> = (0..count).collect();
        let weighed = parallel::map(&parts, threads, |part| {
            let fit = ctx.fit_without(&own.fit, *part, &all, 8);
            (any || fit.chi2 < most)
                .then(|| self.settled_zero_flow(&own.problem, &fit, own.most(), threads))
        });
        (weighed.into_iter().flatten())
            .min_by(|a, b| a.cost.total_cmp(&b.cost))
            .filter(|best| best.cost < own.cost)
    }

    /// A set with the zero flow that it leaves, each fitted to the other until neither changes. A set that stays above a cost of `most` is not
    /// followed to the end.
    pub(super) fn settled_zero_flow(
        &self,
        problem: &Problem,
        fit: &Fit,
        most: f64,
        threads: usize,
    ) -> Weighed {
        const MOST_ROUNDS: usize = 3;
        let mut best = self.with_zero_flow(problem, fit, most, threads);
        for _ in 1..MOST_ROUNDS {
            if best.cost > most {
                break;
            }
            let next = self.with_zero_flow(&best.problem, &best.fit, most, threads);
            let gained = best.cost - next.cost;
            if gained > 0.0 {
                best = next;
            }
            if gained < SETTLED {
                break;
            }
        }
        best
    }

    /// A set fitted again with the most probable zero flow of its residuals: in the noise, and below what acts on the flow. The model's
    /// stated error acts together with the set. A set that cannot come down to a cost of `most` is not followed to the end.
    fn with_zero_flow(&self, problem: &Problem, fit: &Fit, most: f64, threads: usize) -> Weighed {
        /// A path gains half as much as the previous one: all that follow gain as much as it.
        const MOST_PATHS: usize = 12;
        let residual = |problem: &Problem, fit: &Fit| self.context(problem, 0).residual(fit).0;
        let weighed = |problem: Problem, fit: &Fit| {
            let fit = self.context(&problem, 0).refit(fit, &problem.all(), 8);
            Weighed {
                cost: self.cost(&problem, &fit),
                problem,
                fit,
            }
        };
        let left = residual(problem, fit);
        let effects = self.effects(fit);
        let problem = problem.clone().beside(&effects);
        // A zero flow ahead of the chip passes through it, one behind it does not. Before the records are seen both are as likely.
        let places: Vec<Option<FlowLoss>> = [None]
            .into_iter()
            .chain(problem.flow_loss(&effects).map(Some))
            .collect();
        let by_place = parallel::map(&places, threads, |loss| {
            let begun = problem.noise.with_loss(*loss);
            let noise =
                prior_of(&problem).estimate(&begun, |noise| problem.unlikelihood(noise, &left));
            weighed(problem.clone().with_noise(noise), fit)
        });
        let best = by_place
            .into_iter()
            .min_by(|a, b| a.cost.total_cmp(&b.cost));
        let Some(mut best) = best else {
            return weighed(problem, fit);
        };
        // The path of a flow on which nothing acts is noise alone.
        if !acts_on_flow(&self.context(&best.problem, 0), &best.fit) {
            let left = residual(&best.problem, &best.fit);
            best.problem = best.problem.with_flow(&left, &vec![Vec::new(); left.len()]);
            return best;
        }
        for _ in 0..MOST_PATHS {
            let left = residual(&best.problem, &best.fit);
            let stops = self.context(&best.problem, 0).stops(&best.fit);
            let next = weighed(best.problem.clone().with_flow(&left, &stops), &best.fit);
            let gained = best.cost - next.cost;
            if gained < SETTLED {
                break;
            }
            best = next;
            if best.cost - gained > most {
                break;
            }
        }
        best
    }
}
