//! The search under noise that depends on its results: a floor that a better fit lowers, a zero flow that moves.

use crate::data::coloured::NoiseKind;
use crate::data::estimate::error_of;
use crate::data::floor::{Floor, refined};
use crate::data::flow_loss::FlowLoss;
use crate::data::noise::NoiseModel;
use crate::fit::catalogue::{self, Part};
use crate::fit::context::{Context, Fit, WhiteEvidence, freedom_of};
use crate::problem::Problem;
use crate::search::cost::{penalised_cost, threshold_of};
use crate::search::effort::Effort;
use crate::search::found::Found;
use crate::search::sequential::{alike, search, within};
use crate::thresholds::NUMBER;
use crate::units::Scales;
use crate::verdict::jumps::Jumps;
use crate::verdict::late_frames::LateFrames;
use crate::verdict::wandering::{Wandering, prior_of, suspected};
use cellpos_plant::effects::{Action, Place, Scope};
use cellpos_plant::{Effect, Model};

/// In twice the log-likelihood: another estimate of the zero flow changes nothing that decides.
const SETTLED: f64 = 1.0;

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

    fn effects(&self, fit: &Fit) -> Vec<Effect> {
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
            let mut weighed = self.settled_zero_flow(&moving.problem, &moving.found.fit);
            if let Some(exchanged) = self.weigh_rivals(&mut moving, &weighed) {
                weighed = exchanged;
            }
            if let Some(smaller) = self.weigh_smaller(&weighed) {
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
            to_beat: self.cost(&moving.problem, &moving.found.fit) - besides,
            ..effort
        };
        let still = self.search(problem, floor, effort, Some(start), &mut *progress);
        // An effect that is found next to a moving zero flow is there without one, too: else a leak may stand for both.
        let keeps = moving
            .found
            .fit
            .parts
            .iter()
            .all(|p| still.found.fit.has(p.id()));
        let cost = |s: &Searched| self.cost(&s.problem, &s.found.fit);
        match keeps && cost(&still) < cost(&moving) {
            true => still,
            false => moving,
        }
    }

    /// Weighs the rivals of a set, each under the noise that it leaves itself: the model's stated error acts beside it, and it leaves another
    /// zero flow. `own` is the set under its noise. The best set with a rival in it that is more probable than `own`.
    ///
    /// Under the noise of the set a rival has to explain what that noise takes up.
    fn weigh_rivals(&self, searched: &mut Searched, own: &Weighed) -> Option<Weighed> {
        let Searched { found, problem } = searched;
        let unpriced = |w: &Weighed| w.cost - self.prices(&w.problem, &w.fit);
        let (here, reach) = (unpriced(own), within(&found.fit));
        let mut best: Option<Weighed> = None;
        for (place, rivals) in found.rivals.iter_mut().enumerate() {
            let id = found.fit.parts[place].id();
            for rival in rivals {
                if rival.id == id || rival.chi2 - found.fit.chi2 > reach {
                    continue;
                }
                let mut parts = found.fit.parts.clone();
                parts[place] = rival.part.clone();
                let ctx = self.context(problem, 0);
                let fit = ctx.fit_from(parts, Some(found.fit.soft), &problem.all(), 8);
                let weighed = self.with_zero_flow(problem, &fit, f64::INFINITY);
                rival.chi2 = found.fit.chi2 + unpriced(&weighed) - here;
                rival.part = weighed.fit.parts[place].clone();
                if weighed.cost < best.as_ref().unwrap_or(own).cost {
                    best = Some(weighed);
                }
            }
        }
        best
    }

    /// Weighs a set without each of its parts, each under the noise that it leaves itself: a small part may stand for the path of a zero
    /// flow. Any may where the flow does not pass the chip linearly, because there a zero flow in the noise is no zero flow. The best set
    /// that is more probable.
    fn weigh_smaller(&self, own: &Weighed) -> Option<Weighed> {
        let bends = |e: &Effect| {
            let in_chip = matches!(e.kind().spec().place, Place::Chip | Place::Bead);
            in_chip && matches!(e.act(), Action::Block(_))
        };
        let count = own.fit.parts.len();
        if count < 2 {
            return None;
        }
        let any = self.effects(&own.fit).iter().any(bends);
        let most = own.fit.chi2 + within(&own.fit);
        let ctx = self.context(&own.problem, 0);
        let all = own.problem.all();
        let without = (0..count).map(|i| ctx.fit_without(&own.fit, i, &all, 8));
        let weighed = (without.filter(|fit| any || fit.chi2 < most))
            .map(|fit| self.with_zero_flow(&own.problem, &fit, own.cost));
        weighed
            .min_by(|a, b| a.cost.total_cmp(&b.cost))
            .filter(|best| best.cost < own.cost)
    }

    /// A set with the zero flow that it leaves, each fitted to the other until neither changes.
    fn settled_zero_flow(&self, problem: &Problem, fit: &Fit) -> Weighed {
        const MOST_ROUNDS: usize = 3;
        let mut best = self.with_zero_flow(problem, fit, f64::INFINITY);
        for _ in 1..MOST_ROUNDS {
            let next = self.with_zero_flow(&best.problem, &best.fit, f64::INFINITY);
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
    /// stated error acts beside the set. What cannot become cheaper than `to_beat` is not followed to the end.
    fn with_zero_flow(&self, problem: &Problem, fit: &Fit, to_beat: f64) -> Weighed {
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
        let estimate = |loss: Option<FlowLoss>| {
            let begun = problem.noise.with_loss(loss);
            let noise =
                prior_of(&problem).estimate(&begun, |noise| problem.unlikelihood(noise, &left));
            weighed(problem.clone().with_noise(noise), fit)
        };
        // A zero flow ahead of the chip passes through it, one behind it does not. Before the records are seen both are as likely.
        let mut best = estimate(None);
        if let Some(loss) = problem.flow_loss(&effects) {
            let ahead = estimate(Some(loss));
            if ahead.cost < best.cost {
                best = ahead;
            }
        }
        for _ in 0..MOST_PATHS {
            let left = residual(&best.problem, &best.fit);
            let next = weighed(best.problem.clone().with_flow(&left), &best.fit);
            let gained = best.cost - next.cost;
            if gained < SETTLED {
                break;
            }
            best = next;
            if best.cost - gained > to_beat {
                break;
            }
        }
        best
    }

    /// Twice the negative log-likelihood of a set under a problem's noise, with the price of the zero flow and of the set.
    fn cost(&self, problem: &Problem, fit: &Fit) -> f64 {
        let (residual, _) = self.context(problem, 0).residual(fit);
        fit.chi2
            + self.prices(problem, fit)
            + problem.log_determinant()
            + prior_of(problem).price(&problem.noise, |noise| {
                problem.unlikelihood(noise, &residual)
            })
    }

    /// The prices of a set: those of a search and, for each part, what any addition must gain.
    fn prices(&self, problem: &Problem, fit: &Fit) -> f64 {
        let records = problem.records.len();
        let dearer = |p: &Part| {
            threshold_of(p.variant(), records) - NUMBER * freedom_of(p.variant(), records) as f64
        };
        penalised_cost(&self.context(problem, 0), fit) - fit.chi2
            + fit.parts.iter().map(dearer).sum::<f64>().max(0.0)
    }
}

/// A set with the noise that it leaves, and their joint cost.
struct Weighed {
    problem: Problem,
    fit: Fit,
    cost: f64,
}
