//! Ticks whose commands were handed over late, and how late.

use cellpos_runtime::{TickFlags, TickRecord};

pub(crate) fn is_new_frame(tick: &TickRecord) -> bool {
    !tick.flags.has(TickFlags::TIMER) && !tick.flags.has(TickFlags::STALE)
}

pub(crate) fn with_new_frame(ticks: &[TickRecord]) -> impl Iterator<Item = &TickRecord> {
    ticks.iter().filter(|tick| is_new_frame(tick))
}

/// How old a tick's frame is, by its own stamp, ns.
pub(crate) fn age_ns(tick: &TickRecord) -> i64 {
    tick.time_ns - tick.mid_exposure_ns
}

/// The median, which a stall does not shift; `None` of an empty list.
pub(crate) fn median(values: impl Iterator<Item = i64>) -> Option<i64> {
    let mut values: Vec<i64> = values.collect();
    values.sort_unstable();
    values.get(values.len() / 2).copied()
}

/// How much later than usual the command of each tick was handed over, ns. Usual is counted from the exposure of the newest frame, as the
/// median of a second, in which clocks drift by a negligible amount. `None` before the first frame.
pub(crate) fn lateness_ns(ticks: &[TickRecord], period_ns: i64) -> Vec<Option<i64>> {
    const SECOND: usize = 1000;
    let handed_over_ns = |tick: &TickRecord| age_ns(tick) + i64::from(tick.compute_ns);
    let mut late_ns = Vec::with_capacity(ticks.len());
    // When the command of the newest frame was due, and that frame's tick.
    let mut due = None;
    for (second, ticks) in ticks.chunks(SECOND).enumerate() {
        let usual_ns = median(with_new_frame(ticks).map(handed_over_ns)).unwrap_or(0);
        for (tick, index) in ticks.iter().zip(SECOND * second..) {
            let came_ns = tick.time_ns + i64::from(tick.compute_ns);
            if is_new_frame(tick) {
                due = Some((tick.mid_exposure_ns + usual_ns, index));
            }
            late_ns
                .push(due.map(|(due_ns, of)| came_ns - due_ns - (index - of) as i64 * period_ns));
        }
    }
    late_ns
}
