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

/// How much later than usual a command came, ns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Late {
    /// To the line.
    pub(crate) handed_over_ns: i64,
    /// To the board: by its own report, or as if it took the usual time on the line.
    pub(crate) at_board_ns: i64,
    /// Whether the board tells when it had its commands of this second.
    pub(crate) told: bool,
}

/// How long the command of each tick was on its way to the board, ns, plus the difference of the clocks. `None` if no report tells.
fn ways_ns(ticks: &[TickRecord]) -> Vec<Option<i64>> {
    let us = |tick: &TickRecord| tick.time_ns / 1000;
    let mut ways_ns = vec![None; ticks.len()];
    for told in ticks.iter().filter(|tick| tick.obeyed_at_us.is_finite()) {
        let given_us = us(told) - told.obeyed_before_us as i64;
        let index = ticks.partition_point(|tick| us(tick) < given_us);
        if let Some(tick) = ticks.get(index).filter(|tick| us(tick) == given_us) {
            ways_ns[index] = Some(1000 * told.obeyed_at_us as i64 - handed_over_ns(tick));
        }
    }
    ways_ns
}

/// When a tick's command was handed over, ns.
fn handed_over_ns(tick: &TickRecord) -> i64 {
    tick.time_ns + i64::from(tick.compute_ns)
}

/// How late the command of each tick was. A command is due as long after the exposure of the newest frame as usual, which is the median of a
/// second: in that time clocks drift by a negligible amount. `None` before the first frame.
pub(crate) fn lateness(ticks: &[TickRecord], period_ns: i64) -> Vec<Option<Late>> {
    const SECOND: usize = 1000;
    let after_exposure_ns = |tick: &TickRecord| age_ns(tick) + i64::from(tick.compute_ns);
    let mut late = Vec::with_capacity(ticks.len());
    // When the command of the newest frame was due, and that frame's tick.
    let mut due = None;
    let mut at_board_ns = i64::MIN;
    let ways_ns = ways_ns(ticks);
    for (second, (ticks, ways_ns)) in (ticks.chunks(SECOND).zip(ways_ns.chunks(SECOND))).enumerate()
    {
        let usual_ns = median(with_new_frame(ticks).map(after_exposure_ns)).unwrap_or(0);
        let usual_way_ns = median(ways_ns.iter().copied().flatten());
        for ((tick, way_ns), index) in ticks.iter().zip(ways_ns).zip(SECOND * second..) {
            let handed_over_ns = handed_over_ns(tick);
            if is_new_frame(tick) {
                due = Some((tick.mid_exposure_ns + usual_ns, index));
            }
            let longer_ns = way_ns
                .zip(usual_way_ns)
                .map_or(0, |(way, usual)| way - usual);
            // Commands come in order: of those that waited together only the first is reported.
            at_board_ns = at_board_ns.max(handed_over_ns + longer_ns);
            late.push(due.map(|(due_ns, of)| {
                let due_ns = due_ns + (index - of) as i64 * period_ns;
                Late {
                    handed_over_ns: handed_over_ns - due_ns,
                    at_board_ns: at_board_ns - due_ns,
                    told: usual_way_ns.is_some(),
                }
            }));
        }
    }
    late
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    /// A tick each millisecond, its command handed over at once; a report of each command comes with the next tick. The board's clock is
    /// 7 s ahead, and the way takes 0.1 ms.
    fn calm(count: i64) -> Vec<TickRecord> {
        (0..count)
            .map(|k| TickRecord {
                time_ns: k * MS,
                mid_exposure_ns: k * MS - 2 * MS,
                obeyed_before_us: if k > 0 { 1000.0 } else { f64::NAN },
                obeyed_at_us: if k > 0 {
                    (7_000_100 + (k - 1) * 1000) as f64
                } else {
                    f64::NAN
                },
                ..TickRecord::unknown()
            })
            .collect()
    }

    #[test]
    fn a_command_that_waited_on_the_line_is_late_and_so_are_those_behind_it() {
        let mut ticks = calm(50);
        // The commands of ticks 20 to 22 come together 2.4 ms after the first of them. The tick 23 hears of all three, and tells the first.
        for tick in &mut ticks[21..24] {
            (tick.obeyed_before_us, tick.obeyed_at_us) = (f64::NAN, f64::NAN);
        }
        (ticks[23].obeyed_before_us, ticks[23].obeyed_at_us) = (3000.0, 7_022_500.0);
        let late_us: Vec<i64> = (lateness(&ticks, MS).into_iter().flatten())
            .inspect(|late| assert_eq!(late.handed_over_ns, 0))
            .map(|late| late.at_board_ns / 1000)
            .collect();
        let mut expected = vec![0; 50];
        (expected[20], expected[21], expected[22]) = (2400, 1400, 400);
        assert_eq!(late_us, expected);
    }

    #[test]
    fn a_board_that_reports_nothing_is_taken_to_have_a_command_when_it_was_handed_over() {
        let mut ticks = calm(50);
        for tick in &mut ticks {
            (tick.obeyed_before_us, tick.obeyed_at_us) = (f64::NAN, f64::NAN);
        }
        ticks[30].compute_ns = 300_000;
        let late: Vec<Late> = lateness(&ticks, MS).into_iter().flatten().collect();
        assert!(
            late.iter()
                .all(|late| late.handed_over_ns == late.at_board_ns)
        );
        assert_eq!(late[30].at_board_ns, 300_000);
        assert_eq!(late[31].at_board_ns, 0);
    }
}
