//! The search under noise that depends on its results: a floor that a better fit lowers, a zero flow that moves.

use crate::data::coloured::NoiseKind;
use crate::data::estimate::error_of;
use crate::data::floor::{Floor, refined};
use crate::data::noise::NoiseModel;
use crate::fit::catalogue::{self, Part};
use crate::fit::context::{Context, Fit, WhiteEvidence, freedom_of};
use crate::problem::Problem;
use crate::search::cost::{penalised_cost, threshold_of};
use crate::search::effort::Effort;
use crate::search::found::Found;
use crate::search::sequential::{alike, search};
use crate::thresholds::NUMBER;
use crate::units::Scales;
use crate::verdict::jumps::Jumps;
use crate::verdict::late_frames::LateFrames;
use crate::verdict::wandering::{Wandering, prior_of, suspected};
use cellpos_plant::effects::Scope;
use cellpos_plant::{Effect, Model};

/// In twice the log-likelihood: another estimate of the zero flow changes nothing that decides.
pub(super) const SETTLED: f64 = 1.0;

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

/// What comes by chance, beside a set.
#[derive(Default)]
pub(crate) struct ByChance {
    pub jumps: Option<Jumps>,
    pub late: Option<LateFrames>,
    pub wandering: Option<Wandering>,
}

impl Searching<'_> {
    /// What a fit of a problem needs; `trusted` increments told its noise.
    pub(super) fn context<'a>(&self, problem: &'a Problem, trusted: usize) -> Context<'a> {
        Context {
            problem,
            scope: self.scope,
            fixed: [self.fixed, &problem.mean].concat(),
            variants: catalogue::variants(self.own_effects),
            free_gain: self.free_gain,
            white: WhiteEvidence::of(self.model, trusted, problem),
            floor_error: error_of(trusted),
            quantised: problem.quantised,
            scales: self.scales.clone(),
        }
    }

    pub(super) fn effects(&self, fit: &Fit) -> Vec<Effect> {
        fit.parts.iter().map(|p| p.effect(&self.scope)).collect()
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
            let noise = problem.noise;
            round += 1;
            // A floor that was measured is not talked down by a fit that has numbers to spare.
            let last = round >= 2
                || found.cut_short
                || !floor.source.is_known()
                // The likelihood tells a walk from white noise, no more.
                || self.kind == NoiseKind::White
                || noise.coloured.is_some();
            if last {
                return Searched { found, problem };
            }
            // The residual of a good fit tells the noise better than a short rest does: its size, and how much of it is a walk. One that is
            // larger by more than the error of the floor is a misfit.
            let (residual, _) = ctx.residual(&found.fit);
            let next = refined(&noise, |noise| problem.unlikelihood(noise, &residual));
            let changes = next.innovation_um() / noise.innovation_um() - 1.0;
            let settled = problem.unlikelihood(&noise, &residual)
                - problem.unlikelihood(&next, &residual)
                < SETTLED;
            let error = if floor.rows > 0 {
                error_of(floor.rows)
            } else {
                0.0
            };
            if changes > error || settled {
                return Searched { found, problem };
            }
            problem = problem.with_noise(next);
            start = Some(found.fit);
        }
    }

    /// Searches, and once more beside what comes by chance, if anything does: frames that are late, jumps of the bead.
    pub(super) fn beside_chance(
        &self,
        problem: Problem,
        floor: &Floor,
        effort: Effort,
        progress: &mut dyn FnMut(&str),
    ) -> (Searched, ByChance) {
        let first = self.under_noise(problem.clone(), floor, effort, &mut *progress);
        if problem.base.free_start || self.free_gain || !floor.source.is_known() {
            return (first, ByChance::default());
        }
        let (late, problem, searched) =
            self.beside_late_frames((first, problem), floor, effort, &mut *progress);
        let (jumps, problem, searched) =
            self.beside_jumps((searched, problem), floor, effort, &mut *progress);
        // A path with jumps is slow, too: what is left without them decides.
        let (wandering, searched) =
            self.beside_wandering((searched, problem), floor, effort, &mut *progress);
        let by_chance = ByChance {
            jumps,
            late,
            wandering,
        };
        (searched, by_chance)
    }

    /// Searches once more with a flow that wanders by more than that of a rig, if that is more probable.
    fn beside_wandering(
        &self,
        (searched, problem): (Searched, Problem),
        floor: &Floor,
        effort: Effort,
        progress: &mut dyn FnMut(&str),
    ) -> (Option<Wandering>, Searched) {
        let ctx = self.context(&searched.problem, 0);
        if !ctx.integrates() || !suspected(&ctx, &searched.found.fit) {
            return (None, searched);
        }
        progress("the flow wanders: once more with that noise");
        let mut next = problem;
        next.wanders = true;
        let again = self.under_noise(next, floor, effort, progress);
        let cost = |s: &Searched| self.cost(&s.problem, &s.found.fit);
        let gain = cost(&searched) - cost(&again);
        let ctx = self.context(&again.problem, 0);
        match Wandering::of(&ctx, &again.found.fit, gain).filter(|w| w.gain > NUMBER) {
            Some(wandering) => (Some(wandering), again),
            None => (None, searched),
        }
    }

    /// Searches once more with frames that are late by random times, if there are any and that is more probable.
    fn beside_late_frames(
        &self,
        (mut searched, problem): (Searched, Problem),
        floor: &Floor,
        effort: Effort,
        progress: &mut dyn FnMut(&str),
    ) -> (Option<LateFrames>, Problem, Searched) {
        const MOST_ROUNDS: usize = 3;
        let cost = |s: &Searched| self.cost(&s.problem, &s.found.fit);
        let (mut known, mut beside): (Option<LateFrames>, _) = (None, problem.clone());
        let mut without = None;
        for _ in 0..MOST_ROUNDS {
            let ctx = self.context(&searched.problem, 0);
            let found = LateFrames::find(&ctx, &searched.found.fit, known.as_ref());
            let Some((late, speeds)) = found else {
                return match without {
                    Some(without) => (None, problem, without),
                    None => (None, problem, searched),
                };
            };
            if known.as_ref().is_some_and(|known| late.agrees(known)) {
                known = Some(late);
                break;
            }
            progress("frames are late by random times: once more with that noise");
            let price = if known.is_none() { NUMBER } else { 0.0 };
            let mut least = cost(&searched) - price;
            let mut better = None;
            for late in late.possible() {
                let noise = (late.sd_s, late.mean());
                let next = problem.clone().with_late_frames(noise, &speeds);
                let again = self.under_noise(next.clone(), floor, effort, &mut *progress);
                if cost(&again) < least {
                    least = cost(&again);
                    better = Some((late, next, again));
                }
            }
            let Some((late, next, again)) = better else {
                break;
            };
            (known, beside) = (Some(late), next);
            let before = std::mem::replace(&mut searched, again);
            without.get_or_insert(before);
        }
        (known, beside, searched)
    }

    /// Searches once more with the position open where it jumps: the jumps of a bead, if there are any.
    fn beside_jumps(
        &self,
        (mut searched, problem): (Searched, Problem),
        floor: &Floor,
        effort: Effort,
        progress: &mut dyn FnMut(&str),
    ) -> (Option<Jumps>, Problem, Searched) {
        const MOST_ROUNDS: usize = 3;
        let (mut jumps, mut open) = (None, problem.clone());
        for _ in 0..MOST_ROUNDS {
            let ctx = self.context(&searched.problem, 0);
            let more = Jumps::find(&ctx, &searched.found.fit);
            if more.count() == 0 {
                break;
            }
            let all = more.and(jumps.clone().unwrap_or_default());
            if !all.are_an_effect(&ctx, &searched.found.fit) {
                break;
            }
            progress(&format!(
                "the bead jumps in {} rows: once more without",
                all.count()
            ));
            open = problem
                .clone()
                .open_at(|record| all.rows_of(record).collect());
            jumps = Some(all);
            searched = self.under_noise(open.clone(), floor, effort, &mut *progress);
        }
        if let Some(jumps) = &mut jumps {
            jumps.measure(&self.context(&searched.problem, 0), &searched.found.fit);
        }
        (jumps, open, searched)
    }

    /// Searches under the noise of the rig: a zero flow that moves, or, if that is more probable, one that stands still.
    ///
    /// In a closed loop a zero flow and a slow effect of the response explain much the same motion, and the zero flow is always
    /// there. So the search begins with one. Each set gives another estimate of it, until that settles.
    pub(super) fn under_noise(
        &self,
        problem: Problem,
        floor: &Floor,
        effort: Effort,
        progress: &mut dyn FnMut(&str),
    ) -> Searched {
        const MOST_ROUNDS: usize = 3;
        let base = &problem.base;
        let rests = base.free_start || self.free_gain || !self.context(&problem, 0).integrates();
        if rests || problem.noise.coloured.is_some() || !floor.source.is_known() {
            return self.search(problem, floor, effort, None, progress);
        }
        let median = prior_of(&problem).median(&problem.noise);
        let beside = problem.clone().with_noise(median);
        let mut moving = self.search(beside, floor, effort, None, &mut *progress);
        // The first set was found with the errors of the model as they show without it, and part of it may stand for the difference.
        if problem.has_errors() && !moving.found.cut_short && !moving.found.fit.parts.is_empty() {
            progress("once more with the model's stated error beside the set");
            let next = moving.problem.beside(&self.effects(&moving.found.fit));
            let start = Some(moving.found.fit);
            moving = self.search(next, floor, effort, start, &mut *progress);
        }
        for _ in 0..MOST_ROUNDS {
            if moving.found.cut_short {
                return moving;
            }
            let mut weighed = self.settled_zero_flow(
                &moving.problem,
                &moving.found.fit,
                f64::INFINITY,
                effort.threads,
            );
            if let Some(exchanged) = self.weigh_rivals(&mut moving, &weighed, effort.threads) {
                weighed = exchanged;
            }
            if let Some(smaller) = self.weigh_smaller(&weighed, effort.threads) {
                weighed = smaller;
            }
            if weighed.cost > self.cost(&moving.problem, &moving.found.fit) - SETTLED {
                break;
            }
            let set = weighed.fit.parts.clone();
            moving = self.search(
                weighed.problem,
                floor,
                effort,
                Some(weighed.fit),
                &mut *progress,
            );
            // The zero flow was estimated next to this very set.
            if alike(&moving.found.fit.parts, &set) {
                break;
            }
        }
        progress("looking further without a zero flow that moves");
        let noise = NoiseModel {
            zero_flow: None,
            ..moving.problem.noise
        };
        let problem = problem.beside(&self.effects(&moving.found.fit));
        let problem = problem.with_noise(noise);
        let start = self
            .context(&problem, 0)
            .refit(&moving.found.fit, &problem.all(), 8);
        let besides = self.cost(&problem, &start) - start.chi2;
        let effort = Effort {
            to_beat: self.cost(&moving.problem, &moving.found.fit) - besides + SETTLED,
            ..effort
        };
        let still = self.search(problem, floor, effort, Some(start), &mut *progress);
        // An effect that is found next to a moving zero flow is there without one, too: else a leak may stand for both. A search that was cut
        // short may not have weighed its rivals.
        let keeps = moving
            .found
            .fit
            .parts
            .iter()
            .all(|p| still.found.fit.has(p.id()));
        let cost = |s: &Searched| self.cost(&s.problem, &s.found.fit);
        match keeps && !still.found.cut_short && cost(&still) < cost(&moving) {
            true => still,
            false => moving,
        }
    }

    /// Twice the negative log-likelihood of a set under a problem's noise, with the price of the zero flow and of the set.
    pub(super) fn cost(&self, problem: &Problem, fit: &Fit) -> f64 {
        let (residual, _) = self.context(problem, 0).residual(fit);
        fit.chi2
            + self.prices(problem, fit)
            + problem.log_determinant()
            + prior_of(problem).price(&problem.noise, |noise| {
                problem.unlikelihood(noise, &residual)
            })
    }

    /// The prices of a set: those of a search and, for each part, what any addition must gain.
    pub(super) fn prices(&self, problem: &Problem, fit: &Fit) -> f64 {
        let records = problem.records.len();
        let dearer = |p: &Part| {
            threshold_of(p.variant(), records) - NUMBER * freedom_of(p.variant(), records) as f64
        };
        penalised_cost(&self.context(problem, 0), fit) - fit.chi2
            + fit.parts.iter().map(dearer).sum::<f64>().max(0.0)
    }
}
