//! The search under the noise that goes with what it finds: a floor that a better fit lowers, a zero flow that moves.

use crate::data::coloured::NoiseKind;
use crate::data::floor::{Floor, from_residuals};
use crate::data::noise::NoiseModel;
use crate::data::zero_flow::Prior;
use crate::fit::catalogue::{self, Part};
use crate::fit::context::{Context, Fit, WhiteEvidence, freedom_of};
use crate::problem::Problem;
use crate::search::cost::{penalised_cost, threshold_of};
use crate::search::effort::Effort;
use crate::search::sequential::{Found, search};
use crate::thresholds::{NUMBER, THRESHOLDS};
use crate::units::Scales;
use crate::verdict::held_out;
use cellpos_plant::effects::Scope;
use cellpos_plant::{Effect, Model};

/// What every search of a reconciliation shares.
pub(super) struct Searching<'a> {
    pub model: &'a Model,
    pub scope: Scope,
    pub fixed: &'a [Effect],
    /// Ids of effects of the user's own.
    pub own_effects: &'a [&'static str],
    pub free_gain: bool,
    /// The noise that was asked for.
    pub kind: NoiseKind,
    pub scales: &'a Scales,
}

/// A set, and the records with the noise that it was found under.
pub(super) struct Searched {
    pub found: Found,
    pub problem: Problem,
}

impl Searching<'_> {
    /// What a fit of a problem needs; `trusted` increments told its noise.
    pub(super) fn context<'a>(&self, problem: &'a Problem, trusted: usize) -> Context<'a> {
        Context {
            problem,
            scope: self.scope,
            fixed: self.fixed.to_vec(),
            variants: catalogue::variants(self.own_effects),
            free_gain: self.free_gain,
            white: evidence(self.model, &problem.noise, trusted, problem),
            quantised: problem.quantised,
            scales: self.scales.clone(),
        }
    }

    /// Searches, and once more with the noise that the first set leaves.
    pub(super) fn search(
        &self,
        mut problem: Problem,
        floor: &Floor,
        effort: Effort,
        mut start: Option<Fit>,
        progress: &mut dyn FnMut(&str),
    ) -> Searched {
        let effort = Effort {
            work: problem.spent() + effort.work,
            ..effort
        };
        let mut round = 0;
        loop {
            let ctx = self.context(&problem, floor.rows);
            let found = search(&ctx, &problem.all(), effort, start.as_ref(), &mut *progress);
            // The residual of a good fit is at least as good an estimate of the noise.
            let (residual, _) = ctx.residual(&found.fit);
            let noise = problem.noise;
            let refined = NoiseModel {
                zero_flow: noise.zero_flow,
                ..from_residuals(&problem.present(), &residual)
            };
            round += 1;
            // A floor that was measured is not talked down by a fit that has numbers to spare.
            if round >= 2
                || found.cut_short
                || !floor.source.is_known()
                // Increments tell a walk from white noise, no more.
                || self.kind == NoiseKind::White
                || noise.coloured.is_some()
                || refined.innovation_um() > 0.97 * noise.innovation_um()
            {
                return Searched { found, problem };
            }
            problem = problem.with_noise(refined);
            start = Some(found.fit);
        }
    }

    /// The set with a moving zero flow, if that is more probable than the set without one.
    ///
    /// In a closed loop a zero flow and a slow effect of the response explain much the same motion. So the joint cost of both decides:
    /// parts are removed from the set one by one, each time with a new estimate of the zero flow, and the search goes on from the best.
    pub(super) fn beside_zero_flow(
        &self,
        still: Searched,
        floor: &Floor,
        effort: Effort,
        progress: &mut dyn FnMut(&str),
    ) -> Searched {
        /// Another estimate of the zero flow changes nothing that decides.
        const SETTLED: f64 = 1.0;
        const MOST_ROUNDS: usize = 3;
        let base = &still.problem.base;
        let rests = base.free_start
            || self.free_gain
            || !held_out::integrates(&self.context(&still.problem, 0));
        let sensor = still.problem.noise.coloured.is_some();
        if rests || sensor || !floor.source.is_known() {
            return still;
        }
        let least = self.cost(&still.problem, &still.found.fit);
        let Some(mut best) = self.taken_back(&still, least, effort) else {
            return still;
        };
        progress("the zero flow moves: looking further beside it");
        let mut searched = None;
        for _ in 0..MOST_ROUNDS {
            let problem = still.problem.clone().with_noise(best.noise);
            let start = Some(best.fit.clone());
            let next = self.search(problem, floor, effort, start, &mut *progress);
            let weighed = self.with_zero_flow(&next.problem, &next.found.fit);
            let cost = self.cost(&next.problem, &next.found.fit);
            searched = Some(next);
            if weighed.cost > cost - SETTLED {
                break;
            }
            best = weighed;
        }
        match searched {
            Some(s) if self.cost(&s.problem, &s.found.fit) < least => s,
            _ => still,
        }
    }

    /// The best set with a moving zero flow, or `None` if the set without one is better. Starts: the set, its first effect, and no effect,
    /// and the set without one part.
    fn taken_back(&self, still: &Searched, least: f64, effort: Effort) -> Option<Weighed> {
        let problem = &still.problem;
        let fit = &still.found.fit;
        let all = problem.all();
        let beside = |fits: &[Fit]| {
            cellpos_parallel::map(fits, effort.threads, |fit| {
                self.with_zero_flow(problem, fit)
            })
            .into_iter()
            .min_by(|a, b| a.cost.total_cmp(&b.cost))
        };
        let less = |fit: &Fit| -> Vec<Fit> {
            let indices: Vec<usize> = (0..fit.parts.len()).collect();
            cellpos_parallel::map(&indices, effort.threads, |&i| {
                let mut parts = fit.parts.clone();
                parts.remove(i);
                self.context(problem, 0)
                    .fit_from(parts, Some(fit.soft), &all, 8)
            })
        };
        let mut begin = vec![fit.clone(), still.found.null.clone()];
        if let Some(first) = fit.parts.first().filter(|_| fit.parts.len() > 2) {
            let ctx = self.context(problem, 0);
            begin.push(ctx.fit_from(vec![first.clone()], Some(fit.soft), &all, 8));
        }
        begin.extend(less(fit));
        let mut best = beside(&begin)?;
        while let Some(next) = beside(&less(&best.fit)).filter(|n| n.cost < best.cost) {
            best = next;
        }
        (best.cost < least).then_some(best)
    }

    /// A set fitted again with the most probable zero flow of its residuals.
    fn with_zero_flow(&self, problem: &Problem, fit: &Fit) -> Weighed {
        let (residual, _) = self.context(problem, 0).residual(fit);
        let noise = prior_of(problem).estimate(&problem.noise, |noise| {
            (problem.records.iter().zip(&residual))
                .map(|(r, residual)| r.unlikelihood(noise, residual))
                .sum()
        });
        let problem = problem.clone().with_noise(noise);
        let fit = self.context(&problem, 0).refit(fit, &problem.all(), 8);
        Weighed {
            noise,
            cost: self.cost(&problem, &fit),
            fit,
        }
    }

    /// Twice the negative log-likelihood of a set under a problem's noise, with the price of the noise's numbers and, for each part,
    /// what any addition must gain.
    fn cost(&self, problem: &Problem, fit: &Fit) -> f64 {
        let records = problem.records.len();
        let dearer = |p: &Part| {
            threshold_of(p.variant(), records) - NUMBER * freedom_of(p.variant(), records) as f64
        };
        penalised_cost(&self.context(problem, 0), fit)
            + fit.parts.iter().map(dearer).sum::<f64>().max(0.0)
            + problem.log_determinant()
            + prior_of(problem).price(problem.noise.zero_flow.as_ref())
    }
}

/// Prior of the zero flow of the problem's rig.
fn prior_of(problem: &Problem) -> Prior {
    Prior::new(problem.base.speed_per_um(), problem.base.sample_s)
}

/// A set with its noise, and their joint cost.
struct Weighed {
    noise: NoiseModel,
    fit: Fit,
    cost: f64,
}

fn evidence(
    model: &Model,
    noise: &NoiseModel,
    trusted: usize,
    problem: &Problem,
) -> Option<WhiteEvidence> {
    let exposure_s = problem
        .records
        .first()
        .map_or(0.0, |r| r.sampling.exposure_s);
    let model_um2 = model.noise.localisation_um.powi(2);
    if trusted < 5000 || model_um2 <= 0.0 || noise.coloured.is_some() {
        return None;
    }
    let variance = noise.walk_um2 + 2.0 * noise.white_um2;
    // Only where the walk is that of the model: else the model's noise says nothing about this rig.
    let walk = 2.0 * model.noise.diffusion_um2_per_s * problem.base.sample_s;
    if walk <= 0.0 || (noise.walk_um2 / walk - 1.0).abs() > THRESHOLDS.walk_alike {
        return None;
    }
    Some(WhiteEvidence {
        estimate_um2: noise.white_um2,
        error_um2: 1.5 * variance / (trusted as f64).sqrt(),
        // A known exposure averages a part of the walk off, as [`NoiseModel::from_increments`] says.
        model_um2: model_um2 - noise.walk_um2 * exposure_s / (6.0 * problem.base.sample_s),
        walk_um2: noise.walk_um2,
    })
}
