//! Model predictive control: condensed, move-blocked, with preview, range, slew and field of view.
//!
//! The plan is `u_i = n + u_ref,i + w_b(i)`: the feed-forward command of the previewed reference, kept within range and
//! slew, plus corrections `w` that are constant over blocks. Penalised are the error to the path of that
//! command, the correction and its moves (that is `du - du_ref`), so that a fast reference is not biased; neutral makes it offset-free.
//! A solver out of time leaves a point that is brought within the limits, and the best such point at hand is followed. On an
//! infeasible problem the previous plan goes on, shifted; then PI.

mod clarabel_qp;
mod condensed;
mod feasible;
mod law;
mod problems;

pub use condensed::{HORIZON, Mpc, SolverKind};
pub use law::{MpcLaw, MpcState};
pub use problems::TimedSolve;
