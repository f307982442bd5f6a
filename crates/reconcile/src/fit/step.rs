//! A step of a descent: normal equations, damping, bounds.

use crate::fit::context::{Context, Fit, freedom_of};
use crate::fit::evaluate::State;
use crate::fit::linear::{Columns, normal_equations};
use crate::mask::Mask;
use cellpos_plant::effects::Role;
use nalgebra::{DMatrix, DVector};

/// Precision with which a weight of a play operator keeps its value in one step of a fit. It is negligible if the operator moves
/// in a record. It is no information: a weight that no record moves may have any value.
const WEIGHT_PRECISION: f64 = 100.0;

/// Largest free factor on the base model's gain.
pub(crate) const GAIN_RANGE: f64 = 20.0;

/// Normal equations of a step.
pub(crate) struct Linear {
    pub normal: DMatrix<f64>,
    /// The same with what holds a number in its place.
    held: DMatrix<f64>,
    gradient: DVector<f64>,
}

/// Takes a number out of normal equations: a step leaves it where it is.
fn hold(normal: &mut DMatrix<f64>, gradient: &mut DVector<f64>, number: usize) {
    normal.row_mut(number).fill(0.0);
    normal.column_mut(number).fill(0.0);
    gradient[number] = 0.0;
}

impl Context<'_> {
    /// The normal equations at a state, with what holds a number in its place.
    pub(crate) fn linear(
        &self,
        fit: &Fit,
        state: &State,
        (n, columns): (usize, &[Columns]),
        mask: &Mask,
        still: Option<usize>,
    ) -> Linear {
        let (normal, mut gradient) = normal_equations(n, columns, &state.innovations, mask);
        // Operators wider than any swing of the records never move: their weights keep their values.
        let mut held = normal.clone();
        let mut at = 0;
        for p in &fit.parts {
            for (j, q) in p.variant().params.iter().enumerate() {
                if q.name == "weights" {
                    held[(at + j, at + j)] += WEIGHT_PRECISION;
                }
            }
            at += freedom_of(p.variant(), self.problem.records.len());
        }
        if let Some(still) = still {
            hold(&mut held, &mut gradient, still);
        }
        Linear {
            normal,
            held,
            gradient,
        }
    }

    /// The first of several steps, each damped more, that leads down.
    pub(crate) fn step_down(
        &self,
        (fit, state): (&Fit, &State),
        linear: &Linear,
        lambda: &mut f64,
        trials: usize,
        mask: &Mask,
    ) -> Option<(Fit, State)> {
        for _ in 0..trials {
            let Some(trial) = self.within_bounds(fit, linear, *lambda) else {
                *lambda *= 10.0;
                continue;
            };
            let trial_state = self.state(&trial, mask);
            if trial_state.chi2 < state.chi2 {
                *lambda = (*lambda * 0.2).max(1e-9);
                return Some((trial, trial_state));
            }
            // A step that changes next to nothing: converged.
            if trial_state.chi2 - state.chi2 < 1e-3 {
                break;
            }
            *lambda = (*lambda * 8.0).max(1e-6);
        }
        None
    }

    /// The damped step of the normal equations. A number at a bound that the step would leave stays there, and the others take the step
    /// that is best beside it.
    fn within_bounds(&self, fit: &Fit, linear: &Linear, lambda: f64) -> Option<Fit> {
        let (mut held, mut gradient) = (linear.held.clone(), linear.gradient.clone());
        for i in 0..held.nrows() {
            let own = held[(i, i)];
            held[(i, i)] += lambda * own + 1e-12 + if own == 0.0 { 1.0 } else { 0.0 };
        }
        let before = self.numbers(fit);
        loop {
            let step = held.clone().cholesky()?.solve(&(-&gradient));
            let trial = self.stepped(fit, &step);
            let after = self.numbers(&trial);
            let stuck = |i: usize| {
                let moved = after[i] - before[i];
                gradient[i] != 0.0 && moved * step[i] <= 1e-9 * step[i] * step[i]
            };
            let Some(stuck) = (0..step.len()).find(|&i| stuck(i)) else {
                return Some(trial);
            };
            hold(&mut held, &mut gradient, stuck);
            held[(stuck, stuck)] = 1.0;
        }
    }

    /// All numbers of a fit, in the order of its columns.
    pub(crate) fn numbers(&self, fit: &Fit) -> DVector<f64> {
        let mut all = Vec::new();
        let (mut lines, mut positions) = (fit.lines.iter(), fit.positions.iter());
        for part in &fit.parts {
            all.extend_from_slice(&part.theta);
            match part.variant().role {
                Role::Chain => {}
                Role::Line { .. } => {
                    all.extend(lines.next().into_iter().flatten().flatten().flatten())
                }
                Role::Position => all.extend(positions.next().into_iter().flatten()),
            }
        }
        all.extend(self.has_free_offset(&fit.parts).then_some(fit.offset_um));
        all.push(fit.soft);
        all.extend(self.free_gain.then_some(fit.gain));
        DVector::from_vec(all)
    }

    /// A fit moved by a step, within the bounds of its numbers.
    fn stepped(&self, fit: &Fit, step: &DVector<f64>) -> Fit {
        let mut t = fit.clone();
        let records = self.problem.records.len();
        let mut next = 0;
        let (mut line, mut position) = (0, 0);
        for part in &mut t.parts {
            let v = part.variant();
            match v.role {
                Role::Chain => {
                    for (x, p) in part.theta.iter_mut().zip(v.params) {
                        // A logarithm that wants to move more than a factor of four is not in its linear range.
                        let d = if p.log {
                            step[next].clamp(-1.4, 1.4)
                        } else {
                            step[next]
                        };
                        *x += d;
                        next += 1;
                    }
                    part.keep_within_bounds();
                }
                Role::Line { harmonics } => {
                    let p = &v.params[0];
                    part.theta[0] =
                        p.coordinate(p.natural(part.theta[0] + step[next].clamp(-0.05, 0.05)));
                    let waves = t.lines[line].iter_mut().flatten().flatten();
                    for (x, step) in waves.zip(step.iter().skip(next + 1)) {
                        *x += step;
                    }
                    next += 1 + 2 * harmonics * records;
                    line += 1;
                }
                Role::Position => {
                    let p = &v.params[0];
                    part.theta[0] =
                        p.coordinate(p.natural(part.theta[0] + step[next].clamp(-0.02, 0.02)));
                    t.positions[position][0] += step[next + 1];
                    t.positions[position][1] += step[next + 2];
                    next += 3;
                    position += 1;
                }
            }
        }
        if self.has_free_offset(&fit.parts) {
            // The rig rested somewhere within its commands.
            let most_um = self.scope.stroke_um;
            t.offset_um = (t.offset_um + step[next]).clamp(-most_um, most_um);
            next += 1;
        }
        t.soft = (t.soft + step[next]).clamp(self.problem.soft.0, self.problem.soft.1);
        if self.free_gain {
            t.gain = (t.gain + step[next + 1]).clamp(0.05, GAIN_RANGE);
        }
        t
    }
}
