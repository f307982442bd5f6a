//! The control law of MPC: a plan each tick; without one the previous plan, then PI.

use super::clarabel_qp::{ClarabelQp, Side};
use super::condensed::{BLOCKS, Condensed, HORIZON, Mpc, SolverKind};
use super::feasible;
use crate::active_set::{ABSENT, QpEnd, QpVectors, ROWS, Stop, VARS, WorkingSet};
use crate::deviation::DEVIATION;
use crate::error::BuildError;
use crate::feedforward::{FeedForward, Reach};
use crate::law::{ControlLaw, LawInput, LawOutput, SolverReport, SolverStatus, SolverTerms};
use crate::limits::Limits;
use crate::loop_model::LoopModel;
use crate::lqg::deviation;
use crate::pi::{Pi, PiLaw, PiState};
use std::time::Instant;

/// Ticks for which a previous plan may be followed.
const PLAN_MOST: usize = 10;

/// The feed-forward plan of a tick, within range and slew.
pub(super) struct ReferencePlan {
    command: [f64; HORIZON],
    /// Position of the model on it less the reference, after each tick.
    error: [f64; HORIZON],
    reference: [f64; HORIZON],
}

/// The law for one plant and its limits.
#[derive(Debug, Clone)]
pub struct MpcLaw {
    config: Mpc,
    pub(super) condensed: Condensed,
    pub(super) forward: FeedForward,
    pi: PiLaw,
    reach: Reach,
}

/// State of the law: previous plan, warm start, the fallback's state and the solver's workspace.
#[derive(Debug)]
pub struct MpcState {
    feed_forward_um: f64,
    pi: PiState,
    /// Newest plan: commands less the feed-forward.
    plan_um: [f64; HORIZON],
    /// Corrections of the newest plan.
    corrections: [f64; VARS],
    /// Ticks of the plan already used; `HORIZON` without a plan.
    used: usize,
    working: WorkingSet,
    clarabel: Option<Box<ClarabelQp>>,
}

impl MpcState {
    /// Drops the previous plan.
    fn forget(&mut self) {
        self.used = HORIZON;
        self.corrections = [0.0; VARS];
        self.working = WorkingSet::default();
    }
}

impl MpcLaw {
    /// The law for a plant, with `pi` as the last fallback.
    ///
    /// # Errors
    /// A value out of range, a Riccati equation without solution, a solver that cannot be set up.
    pub fn new(
        config: &Mpc,
        pi: Pi,
        model: &LoopModel,
        limits: &Limits,
    ) -> Result<Self, BuildError> {
        let condensed = Condensed::new(config, model)?;
        let this = Self {
            config: *config,
            condensed,
            forward: FeedForward::new(model)?,
            pi: PiLaw::new(pi, model.sample_time_s)?,
            reach: Reach::of(limits, model.sample_time_s),
        };
        if config.solver == SolverKind::Clarabel {
            ClarabelQp::new(&this.condensed.matrices, this.sides())?;
        }
        Ok(this)
    }

    /// The sides of rows that a problem of this loop can reach.
    fn sides(&self) -> Vec<Side> {
        let both = |row: usize| [true, false].map(|upper| Side { row, upper });
        // Commands within the range are never further apart than it is wide.
        let slew = self.reach.move_um < self.reach.high_um - self.reach.low_um;
        let mut sides: Vec<Side> = (0..VARS).flat_map(both).collect();
        if slew {
            sides.extend((VARS..2 * VARS).flat_map(both));
        }
        for (upper, bound) in [
            (true, self.config.view_high_um),
            (false, self.config.view_low_um),
        ] {
            if bound.is_some() {
                sides.extend((2 * VARS..ROWS).map(|row| Side { row, upper }));
            }
        }
        sides
    }

    /// One solve: its end, iterations and active rows.
    pub(super) fn solve(
        &self,
        state: &mut MpcState,
        v: &QpVectors,
        stop: Stop,
    ) -> (QpEnd, u16, u16) {
        let Some(clarabel) = &mut state.clarabel else {
            let (end, iterations) = self.condensed.matrices.solve(v, &mut state.working, stop);
            let active = u16::try_from(state.working.len()).unwrap_or(u16::MAX);
            return (end, iterations, active);
        };
        match self.condensed.matrices.without_rows(v) {
            (w, true) => (QpEnd::Solved(w), 0, 0),
            (_, false) => clarabel.solve(v, stop),
        }
    }

    /// The command of this tick, or `None` when there is no plan to follow.
    fn plan(&self, state: &mut MpcState, input: &LawInput) -> (Option<f64>, SolverReport) {
        let neutral = input.estimate.neutral_um;
        let reference = self.reference_plan(input);
        let deviation = deviation(&input.estimate.now, &input.on_path);
        let vectors = self.vectors(input, &deviation, &reference);
        let (from, stop) = match input.solver {
            SolverTerms::Until(deadline) => (
                Some(Instant::now()),
                Stop {
                    deadline: Some(deadline),
                    iterations: None,
                },
            ),
            SolverTerms::Recorded(SolverStatus::Feasible, iterations) => (
                None,
                Stop {
                    deadline: None,
                    iterations: Some(u16::from(iterations)),
                },
            ),
            SolverTerms::Unlimited | SolverTerms::Recorded(..) => (None, Stop::default()),
        };
        // No plan by order: a fault to be got over, or the record of one.
        let gave_up = matches!(
            input.solver,
            SolverTerms::Recorded(SolverStatus::PreviousPlan | SolverStatus::FallbackPi, _)
        );
        let (end, iterations, active) = if gave_up {
            (QpEnd::GaveUp, 0, 0)
        } else {
            self.solve(state, &vectors, stop)
        };
        let chosen = match end {
            QpEnd::Solved(w) => Some((w, SolverStatus::Solved)),
            QpEnd::Stopped(w) => {
                let (free, _) = self.condensed.matrices.without_rows(&vectors);
                let points = [w, free, state.corrections, [0.0; VARS]];
                feasible::best(&self.condensed.matrices, &vectors, points)
                    .map(|w| (w, SolverStatus::Feasible))
            }
            QpEnd::Infeasible | QpEnd::GaveUp => None,
        };
        let solve_ns = from.map_or(0, |from| {
            u32::try_from(from.elapsed().as_nanos()).unwrap_or(u32::MAX)
        });
        let report = |status| SolverReport {
            status,
            iterations,
            active,
            solve_ns,
        };
        if let Some((w, status)) = chosen {
            let corrections = BLOCKS
                .iter()
                .zip(&w)
                .flat_map(|(length, w)| std::iter::repeat_n(w, *length));
            for (slot, w) in state.plan_um.iter_mut().zip(corrections) {
                *slot = neutral + w;
            }
            state.used = 1;
            state.corrections = w;
            return (Some(state.plan_um[0]), report(status));
        }
        // The next tick starts cold, whether the solver ran here or a record says how it ended.
        state.working = WorkingSet::default();
        let planned = state
            .plan_um
            .get(state.used)
            .copied()
            .filter(|_| state.used <= PLAN_MOST);
        state.used = (state.used + 1).min(HORIZON);
        let status = if planned.is_some() {
            SolverStatus::PreviousPlan
        } else {
            SolverStatus::FallbackPi
        };
        (planned, report(status))
    }

    /// Feed-forward along the preview, kept within range and slew; the first command is the loop's.
    pub(super) fn reference_plan(&self, input: &LawInput) -> ReferencePlan {
        let reach = self
            .reach
            .about_neutral(input.estimate.neutral_um, input.tuning.gain);
        let mut on = input.on_path;
        let mut plan = ReferencePlan {
            command: [0.0; HORIZON],
            error: [0.0; HORIZON],
            reference: [0.0; HORIZON],
        };
        for i in 0..HORIZON {
            let next = input.preview(i);
            let command = if i == 0 {
                input.feed_forward_um
            } else {
                (self.forward).within(&on, |ahead| input.preview(i + ahead), &reach)
            };
            self.forward.drive(&mut on, command);
            plan.command[i] = command;
            plan.reference[i] = next;
            plan.error[i] = self.forward.position(&on) - next;
        }
        plan
    }

    pub(super) fn vectors(
        &self,
        input: &LawInput,
        s: &[f64; DEVIATION],
        reference: &ReferencePlan,
    ) -> QpVectors {
        let reach = self
            .reach
            .about_neutral(input.estimate.neutral_um, input.tuning.gain);
        let neutral = input.estimate.neutral_um;
        let mut v = QpVectors {
            linear: [0.0; VARS],
            low: [-ABSENT; ROWS],
            high: [ABSENT; ROWS],
        };
        for (b, slot) in v.linear.iter_mut().enumerate() {
            let state: f64 = self.condensed.from_state[b]
                .iter()
                .zip(s)
                .map(|(f, s)| f * s)
                .sum();
            // The law follows the reference as far as range and slew allow: their restriction is no error.
            *slot = state;
        }
        let mut start = 0;
        let mut before = input.previous_um - neutral;
        for (b, length) in BLOCKS.iter().enumerate() {
            let commands = &reference.command[start..start + length];
            let (least, most) = commands
                .iter()
                .fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), c| {
                    (l.min(*c), h.max(*c))
                });
            v.low[b] = reach.low_um - least;
            v.high[b] = reach.high_um - most;
            // The first block starts from the last command, the others from the reference's last move.
            let jump = commands[0] - before;
            v.low[VARS + b] = -reach.move_um - jump;
            v.high[VARS + b] = reach.move_um - jump;
            start += length;
            before = reference.command[start - 1];
            let at = start - 1;
            let free: f64 = self.condensed.free[b]
                .iter()
                .zip(s)
                .map(|(f, s)| f * s)
                .sum();
            let centre = reference.reference[at] + reference.error[at];
            // A bead that is out of view must not make the problem infeasible: it may stay where it would be.
            if let Some(high) = self.config.view_high_um {
                v.high[2 * VARS + b] = (high - centre).max(free);
            }
            if let Some(low) = self.config.view_low_um {
                v.low[2 * VARS + b] = (low - centre).min(free);
            }
        }
        v
    }
}

impl ControlLaw for MpcLaw {
    type State = MpcState;

    fn start(&self, command_um: f64) -> MpcState {
        let clarabel = match self.config.solver {
            // It could be set up when the law was made.
            SolverKind::Clarabel => ClarabelQp::new(&self.condensed.matrices, self.sides())
                .ok()
                .map(Box::new),
            SolverKind::ActiveSet => None,
        };
        MpcState {
            feed_forward_um: 0.0,
            pi: self.pi.start(command_um),
            plan_um: [0.0; HORIZON],
            corrections: [0.0; VARS],
            used: HORIZON,
            working: WorkingSet::default(),
            clarabel,
        }
    }

    fn step(&self, state: &mut MpcState, input: &LawInput) -> LawOutput {
        state.feed_forward_um = input.feed_forward_um;
        let fallback = self.pi.step(&mut state.pi, input);
        if input.estimate.stuck {
            state.forget();
            return fallback;
        }
        let (plan_um, solver) = self.plan(state, input);
        LawOutput {
            wish_um: plan_um.unwrap_or(fallback.wish_um),
            solver,
        }
    }

    fn applied(&self, state: &mut MpcState, _input: &LawInput, _wish_um: f64, applied_um: f64) {
        self.pi.track(&mut state.pi, applied_um);
    }

    fn rescale(&self, state: &mut MpcState, ratio: f64) {
        state.plan_um.iter_mut().for_each(|um| *um *= ratio);
        state.corrections.iter_mut().for_each(|um| *um *= ratio);
        self.pi.rescale(&mut state.pi, ratio);
    }

    fn shift(&self, state: &mut MpcState, by_um: f64) {
        state.plan_um.iter_mut().for_each(|um| *um += by_um);
        self.pi.shift(&mut state.pi, by_um);
    }

    fn follow(&self, state: &mut MpcState, input: &LawInput, command_um: f64) {
        state.forget();
        self.pi.follow(&mut state.pi, input, command_um);
    }

    fn preview_len(&self) -> usize {
        HORIZON
    }

    fn columns(&self) -> &'static [&'static str] {
        &["mpc_feed_forward_um", "mpc_fallback_integral_um"]
    }

    fn record(&self, state: &MpcState, out: &mut [f32]) {
        let values = [state.feed_forward_um, state.pi.integral_um];
        for (out, value) in out.iter_mut().zip(values) {
            *out = value as f32;
        }
    }
}
