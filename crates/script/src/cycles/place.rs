//! Places in the plan: of a frame, and of a cycle's begin and end.

use crate::plan::Cycle;
use cellpos_runtime::Stage;

/// A place in the plan at which a position was exposed.
#[derive(Debug, Clone, Copy)]
pub(super) struct Place {
    pub(super) plan_ns: i64,
    pub(super) target_um: f64,
    pub(super) stage: Stage,
    pub(super) exposed_ns: i64,
    /// Whether the tick has its own frame.
    pub(super) fresh: bool,
}

/// Start and end of a cycle by the plan, ns.
pub(super) fn bounds_ns(cycle: &Cycle) -> (i64, i64) {
    let ns = |s: f64| (s * 1e9).round() as i64;
    (ns(cycle.start_s), ns(cycle.start_s + cycle.duration_s))
}
