//! Model predictive control: condensed, move-blocked, with preview, range, slew and field of view.
//!
//! The plan is `u_i = n + u_ref,i + w_b(i)`: the feed-forward command of the previewed reference, kept within range and
//! slew, plus corrections `w` that are constant over blocks. Penalised are the error to the reference, the correction
//! and its moves (that is `du - du_ref`), so that a fast reference is not biased; neutral makes it offset-free.
//! On a missed deadline or an infeasible problem the previous plan goes on, shifted; then PI.

mod clarabel_qp;

use crate::active_set::{ABSENT, QpEnd, QpMatrices, QpVectors, ROWS, VARS, WorkingSet};
use crate::control_loop::{ControlLoop, Prepared};
use crate::error::{BuildError, check};
use crate::feedback::{DEVIATION, Deviation, Feedback, check_effort};
use crate::limits::Limits;
use crate::loop_io::{LoopInput, SolverReport, SolverStatus, SolverTerms};
use crate::loop_model::LoopModel;
use crate::riccati::lq_feedback;
use clarabel_qp::ClarabelQp;
use nalgebra::{DMatrix, RowDVector};
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Ticks that the plan looks ahead.
pub const HORIZON: usize = 40;
/// Ticks of each block.
const BLOCKS: [usize; VARS] = [1, 1, 1, 1, 1, 2, 2, 3, 4, 6, 8, 10];
/// Ticks for which a previous plan may be followed.
const PLAN_MOST: usize = 10;

/// Which QP solver runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SolverKind {
    /// Interior point, crate clarabel: small allocations each tick, and some forty times the time of the other.
    Clarabel,
    /// Dual active set, warm-started, without allocation.
    #[default]
    ActiveSet,
}

/// Configuration of MPC.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Mpc {
    /// Weight of the motion that a correction causes in a tick, relative to the position error.
    pub effort: f64,
    /// The same for the change of the correction from block to block.
    pub move_effort: f64,
    /// Solver.
    pub solver: SolverKind,
    /// Lower end of the field of view, um of bead.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub view_low_um: Option<f64>,
    /// Upper end of the field of view, um of bead.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub view_high_um: Option<f64>,
}

impl Default for Mpc {
    fn default() -> Self {
        Self {
            effort: 3.0,
            move_effort: 0.1,
            solver: SolverKind::default(),
            view_low_um: None,
            view_high_um: None,
        }
    }
}

/// The condensed problem: matrices of the QP and the maps to its vectors.
#[derive(Debug, Clone)]
pub(crate) struct Condensed {
    pub matrices: QpMatrices,
    /// Linear term per deviation state.
    from_state: [[f64; DEVIATION]; VARS],
    /// Linear term per error of the kept-in-limits reference command at each tick.
    from_error: Box<[[f64; HORIZON]; VARS]>,
    /// Free motion of the error at the end of each block, per deviation state.
    free: [[f64; DEVIATION]; VARS],
}

impl Mpc {
    /// Checks every value.
    ///
    /// # Errors
    /// [`BuildError::OutOfRange`] naming the key.
    pub fn validate(&self) -> Result<(), BuildError> {
        check_effort(self.effort)?;
        check(
            "move_effort",
            "",
            self.move_effort,
            (0.0..=1e4).contains(&self.move_effort),
            "0 to 10000",
        )?;
        let low = self.view_low_um.unwrap_or(-ABSENT);
        check("view_low_um", "um", low, true, "finite")?;
        let high = self.view_high_um.unwrap_or(ABSENT);
        check(
            "view_high_um",
            "um",
            high,
            high > low,
            "larger than view_low_um",
        )
    }

    /// The law without active constraints and with a reference at rest.
    ///
    /// # Errors
    /// A value out of range, or a Riccati equation without solution.
    pub fn feedback(&self, model: &LoopModel) -> Result<Feedback, BuildError> {
        let condensed = Condensed::new(self, model)?;
        let linear = DMatrix::from_fn(VARS, DEVIATION, |i, j| condensed.from_state[i][j]);
        let w = condensed
            .matrices
            .unconstrained(&linear)
            .ok_or(BuildError::NoConvergence {
                what: "the condensed problem",
            })?;
        Ok(Feedback {
            gains: std::array::from_fn(|j| -w[(0, j)]),
        })
    }
}

impl Condensed {
    fn new(mpc: &Mpc, model: &LoopModel) -> Result<Self, BuildError> {
        mpc.validate()?;
        let d = Deviation::new(model);
        let scale = d.b[0] * d.b[0];
        let (_, terminal) = lq_feedback(&d.a, &d.b, &(d.c.transpose() * &d.c), mpc.effort * scale)?;
        let ends: Vec<usize> = BLOCKS
            .iter()
            .scan(0, |end, length| {
                *end += length;
                Some(*end)
            })
            .collect();
        // s_i = power s_0 + effect w
        let mut power = DMatrix::<f64>::identity(DEVIATION, DEVIATION);
        let mut effect = DMatrix::<f64>::zeros(DEVIATION, VARS);
        let mut hessian = DMatrix::<f64>::zeros(VARS, VARS);
        let mut linear = DMatrix::<f64>::zeros(VARS, DEVIATION);
        let mut from_error = Box::new([[0.0; HORIZON]; VARS]);
        let mut free = [[0.0; DEVIATION]; VARS];
        let mut rows = DMatrix::<f64>::zeros(ROWS, VARS);
        let mut block = 0;
        for i in 0..HORIZON {
            if i >= ends[block] {
                block += 1;
            }
            power = &d.a * power;
            effect = &d.a * effect;
            for k in 0..DEVIATION {
                effect[(k, block)] += d.b[k];
            }
            let (along, still): (RowDVector<f64>, RowDVector<f64>) =
                (&d.c * &effect, &d.c * &power);
            hessian += 2.0 * along.transpose() * &along;
            linear += 2.0 * along.transpose() * &still;
            for (row, value) in from_error.iter_mut().zip(along.iter()) {
                row[i] = 2.0 * value;
            }
            hessian[(block, block)] += 2.0 * mpc.effort * scale;
            if i + 1 == ends[block] {
                free[block] = std::array::from_fn(|k| still[k]);
                rows.row_mut(2 * VARS + block).copy_from(&along);
            }
        }
        hessian += 2.0 * effect.transpose() * &terminal * &effect;
        linear += 2.0 * effect.transpose() * &terminal * &power;
        for b in 0..VARS {
            rows[(b, b)] = 1.0;
            rows[(VARS + b, b)] = 1.0;
            let weight = 2.0 * mpc.move_effort * scale;
            hessian[(b, b)] += weight;
            if b > 0 {
                rows[(VARS + b, b - 1)] = -1.0;
                hessian[(b - 1, b - 1)] += weight;
                hessian[(b, b - 1)] -= weight;
                hessian[(b - 1, b)] -= weight;
            } else {
                // The correction before the plan is the last element of the deviation state.
                linear[(0, DEVIATION - 1)] -= weight;
            }
        }
        let matrices = QpMatrices::new(hessian, rows).ok_or(BuildError::NoConvergence {
            what: "the condensed problem",
        })?;
        Ok(Self {
            matrices,
            from_state: std::array::from_fn(|i| std::array::from_fn(|j| linear[(i, j)])),
            from_error,
            free,
        })
    }
}

/// The feed-forward plan of a tick, within range and slew.
struct ReferencePlan {
    command: [f64; HORIZON],
    /// Position of the model on it less the reference, after each tick.
    error: [f64; HORIZON],
    reference: [f64; HORIZON],
}

/// Workspace of MPC: solver, previous plan, warm start.
#[derive(Debug)]
pub(crate) struct MpcWorkspace {
    config: Mpc,
    condensed: Condensed,
    clarabel: Option<ClarabelQp>,
    working: WorkingSet,
    plan_um: [f64; HORIZON],
    /// Ticks of the plan already used; `HORIZON` when there is none.
    used: usize,
    most_move_um: f64,
}

impl MpcWorkspace {
    pub(crate) fn new(mpc: &Mpc, model: &LoopModel, limits: &Limits) -> Result<Self, BuildError> {
        let condensed = Condensed::new(mpc, model)?;
        let clarabel = match mpc.solver {
            SolverKind::Clarabel => Some(ClarabelQp::new(&condensed.matrices)?),
            SolverKind::ActiveSet => None,
        };
        Ok(Self {
            config: *mpc,
            condensed,
            clarabel,
            working: WorkingSet::default(),
            plan_um: [0.0; HORIZON],
            used: HORIZON,
            most_move_um: limits.slew_um_per_s * model.sample_time_s,
        })
    }

    /// Drops the previous plan.
    pub(crate) fn forget(&mut self) {
        self.used = HORIZON;
        self.working = WorkingSet::default();
    }

    /// The command of this tick, or `None` when there is no plan to follow.
    pub(crate) fn plan(
        &mut self,
        control: &ControlLoop,
        input: &LoopInput,
        prepared: &mut Prepared,
        previous_um: f64,
    ) -> (Option<f64>, SolverReport) {
        let limits = &control.config().limits;
        let neutral = prepared.estimate.neutral_um;
        let reference = self.reference_plan(control, input, prepared, limits);
        let vectors = self.vectors(prepared, &reference, limits, previous_um);
        let (from, deadline) = match input.solver {
            SolverTerms::Until(deadline) => (Some(Instant::now()), Some(deadline)),
            SolverTerms::Unlimited | SolverTerms::Recorded(_) => (None, None),
        };
        let gave_up = matches!(
            input.solver,
            SolverTerms::Recorded(SolverStatus::PreviousPlan | SolverStatus::FallbackPi)
        );
        let (end, iterations, active) = match &mut self.clarabel {
            _ if gave_up => (QpEnd::GaveUp, 0, 0),
            Some(solver) => solver.solve(&vectors, deadline),
            // No deadline: its iterations are bounded, and it ends the same way in a replay.
            None => {
                let (mut end, iterations) =
                    self.condensed.matrices.solve(&vectors, &mut self.working);
                if gave_up && matches!(end, QpEnd::Solved(_)) {
                    // Too late by order: a fault to be got over, or the record of one.
                    self.working = WorkingSet::default();
                    end = QpEnd::GaveUp;
                }
                let active = u16::try_from(self.working.len()).unwrap_or(u16::MAX);
                (end, iterations, active)
            }
        };
        let solve_ns = from.map_or(0, |from| {
            u32::try_from(from.elapsed().as_nanos()).unwrap_or(u32::MAX)
        });
        if let QpEnd::Solved(w) = end {
            let mut tick = 0;
            for (length, w) in BLOCKS.iter().zip(&w) {
                for _ in 0..*length {
                    self.plan_um[tick] = neutral + reference.command[tick] + w;
                    tick += 1;
                }
            }
            self.used = 1;
            return (
                Some(self.plan_um[0]),
                SolverReport {
                    status: SolverStatus::Solved,
                    iterations,
                    active,
                    solve_ns,
                },
            );
        }
        // The next tick starts cold, whether the solver ran here or a record says how it ended.
        self.working = WorkingSet::default();
        let planned = self
            .plan_um
            .get(self.used)
            .copied()
            .filter(|_| self.used <= PLAN_MOST);
        self.used = (self.used + 1).min(HORIZON);
        let status = if planned.is_some() {
            SolverStatus::PreviousPlan
        } else {
            SolverStatus::FallbackPi
        };
        (
            planned,
            SolverReport {
                status,
                iterations,
                active,
                solve_ns,
            },
        )
    }

    /// Feed-forward along the preview, kept within range and slew; the model on the reference follows what was kept.
    fn reference_plan(
        &self,
        control: &ControlLoop,
        input: &LoopInput,
        prepared: &mut Prepared,
        limits: &Limits,
    ) -> ReferencePlan {
        let neutral = prepared.estimate.neutral_um;
        let mut state = prepared.on_reference;
        let mut plan = ReferencePlan {
            command: [0.0; HORIZON],
            error: [0.0; HORIZON],
            reference: [0.0; HORIZON],
        };
        for i in 0..HORIZON {
            let next = control.preview(input, prepared.reference_um, i);
            let last = state.last_um;
            let wanted = control.forward.wanted(&state, next);
            let command = wanted
                .clamp(last - self.most_move_um, last + self.most_move_um)
                .clamp(limits.low_um - neutral, limits.high_um - neutral);
            control.forward.drive(&mut state, command);
            plan.command[i] = command;
            plan.reference[i] = next;
            plan.error[i] = control.forward.position(&state) - next;
            if i == 0 {
                prepared.set_feed_forward(command, state);
            }
        }
        plan
    }

    fn vectors(
        &self,
        prepared: &Prepared,
        reference: &ReferencePlan,
        limits: &Limits,
        previous_um: f64,
    ) -> QpVectors {
        let neutral = prepared.estimate.neutral_um;
        let s = &prepared.deviation;
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
            let error: f64 = self.condensed.from_error[b]
                .iter()
                .zip(&reference.error)
                .map(|(f, e)| f * e)
                .sum();
            *slot = state + error;
        }
        let mut start = 0;
        let mut before = previous_um - neutral;
        for (b, length) in BLOCKS.iter().enumerate() {
            let commands = &reference.command[start..start + length];
            let (least, most) = commands
                .iter()
                .fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), c| {
                    (l.min(*c), h.max(*c))
                });
            v.low[b] = limits.low_um - neutral - least;
            v.high[b] = limits.high_um - neutral - most;
            // The first block starts from the last command, the others from the reference's last move.
            let jump = commands[0] - before;
            v.low[VARS + b] = -self.most_move_um - jump;
            v.high[VARS + b] = self.most_move_um - jump;
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
