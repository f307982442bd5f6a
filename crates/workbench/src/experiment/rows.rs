//! The ticks of a run as an evenly sampled record, and the segments in it.

use crate::experiment::exciting::SETTLE_TICKS;
use crate::experiment::lateness::{age_ns, is_new_frame, lateness, median, with_new_frame};
use cellpos_ident::experiment::{RecordedSegment, Span};
use cellpos_ident::late_commands::{Arrival, as_if_on_time};
use cellpos_runtime::{Grid, TickFlags, TickRecord};
use cellpos_vision::Decision;

/// Localisation noise that vision reported in these ticks, um RMS.
pub(crate) fn fix_noise_um(ticks: &[TickRecord]) -> Option<f64> {
    let (sum, count) = ticks
        .iter()
        .map(|tick| tick.variance_um2)
        .filter(|variance| variance.is_finite())
        .fold((0.0, 0u64), |(sum, count), variance| {
            (sum + variance, count + 1)
        });
    (count > 0).then(|| (sum / count as f64).max(0.0).sqrt())
}

/// Whether a frame came at this tick but showed no reliable bead.
fn is_unseen(tick: &TickRecord) -> bool {
    let came = tick.verdict != 255 && !tick.flags.has(TickFlags::TIMER);
    came && !tick.measured_um.is_finite()
}

/// Whether a tick's frame, new by its id, shows the picture before it, pixel by pixel: the camera delivered one twice.
fn repeats_picture(tick: &TickRecord) -> bool {
    is_unseen(tick) && tick.decision == Decision::Stale as u8
}

/// Gives a row whose frame repeats the picture before it the position before it, so that repeats can be counted.
fn repeat_before(bead_um: &mut [f64], row: usize) {
    if row > 0 && row < bead_um.len() {
        bead_um[row] = bead_um[row - 1];
    }
}

/// Frames that arrived together with a tick's frame and were not used: late, for example after a stall of the camera, but not dropped.
fn frames_passed_over(tick: &TickRecord) -> usize {
    match is_new_frame(tick) {
        true => usize::from(tick.drained).saturating_sub(1),
        false => 0,
    }
}

/// Spans that are over.
pub(crate) fn ended_spans(ticks: &[TickRecord], spans: &[Span]) -> usize {
    let is_running = |t: &&TickRecord| t.is_running();
    let (Some(first), Some(last)) = (ticks.iter().find(is_running), ticks.last()) else {
        return 0;
    };
    let since = usize::try_from(last.seq.saturating_sub(first.seq)).unwrap_or(0);
    let over = |span: &&Span| SETTLE_TICKS + span.start + span.rows < since;
    spans.iter().filter(over).count()
}

/// The rows of a run since the loop was closed.
pub struct Delivered {
    /// Commanded displacement, um.
    pub pzt_um: Vec<f64>,
    /// Bead position, um; NaN without one. A picture that came twice repeats the position before.
    pub bead_um: Vec<f64>,
    /// Whether a row's frame came but showed no reliable bead.
    pub unseen: Vec<bool>,
    /// From the exposure of each row's frame to its command, s; NaN for a row whose frame did not come in time.
    pub frame_age_s: Vec<f64>,
    /// Rows whose command came half a row late or more, or never.
    pub late_command: Vec<bool>,
    /// Standard deviation of the motion to each row that late commands leave open, um; NaN where nobody knows when they came, empty if
    /// none was late.
    pub late_motion_um: Vec<f64>,
}

impl Delivered {
    /// The rows without the first ones, in which the loop brings the bead to its target. There the commands may be larger than any of the
    /// experiment, and the commands before them are not known.
    pub(crate) fn since_caught(&self) -> Self {
        const CAUGHT: usize = SETTLE_TICKS / 2;
        fn tail<T: Copy>(all: &[T]) -> Vec<T> {
            all.iter().skip(CAUGHT).copied().collect()
        }
        Self {
            pzt_um: tail(&self.pzt_um),
            bead_um: tail(&self.bead_um),
            unseen: tail(&self.unseen),
            frame_age_s: tail(&self.frame_age_s),
            late_command: tail(&self.late_command),
            late_motion_um: tail(&self.late_motion_um),
        }
    }
}

/// Ticks as rows of an evenly sampled record, by frame id: a tick that never came is a row without a position.
pub(crate) struct Rows {
    /// Command of each row, um.
    pub(crate) input: Vec<f64>,
    /// Position of each row, um, as if all commands had been on time; NaN without one.
    pub(crate) output: Vec<f64>,
    usable: Vec<bool>,
    /// The command of this row came half a row late or more, or never: the machine stalled.
    late: Vec<bool>,
    /// When it came is not known.
    unknown: Vec<bool>,
    /// Standard deviation of the motion to each row that late commands leave open, um.
    late_motion_um: Vec<f64>,
    /// The frame came too late, or without a reliable bead.
    pub(crate) unseen: Vec<bool>,
    /// The frame came in time and showed no reliable bead.
    without_bead: Vec<bool>,
    /// The frame repeats the picture before it.
    repeated: Vec<bool>,
    /// Age that each row's frame has if its command is on time, ns; `None` if it was not.
    ages_ns: Vec<Option<i64>>,
    /// Usual age of a frame at its tick, in rows.
    usual_age_periods: f64,
    /// Row of each tick since the loop was closed.
    of_tick: Vec<usize>,
}

/// Mean of the known ages, s.
fn mean_s(ages_ns: &[Option<i64>]) -> Option<f64> {
    let known = ages_ns.iter().flatten();
    let (sum_ns, count) = known.fold((0, 0), |(sum, count), ns| (sum + ns, count + 1));
    (count > 0).then(|| 1e-9 * sum_ns as f64 / f64::from(count))
}

impl Rows {
    /// From the exposure of each row's frame to its command, s; NaN for a row whose frame did not come in time.
    pub(crate) fn frame_age_s(&self) -> Vec<f64> {
        let seconds = |age: &Option<i64>| age.map_or(f64::NAN, |ns| 1e-9 * ns as f64);
        self.ages_ns.iter().map(seconds).collect()
    }

    pub(crate) fn of(ticks: &[TickRecord], period_ns: i64) -> Self {
        let mut rows = Self {
            input: Vec::new(),
            output: Vec::new(),
            usable: Vec::new(),
            late: Vec::new(),
            unknown: Vec::new(),
            late_motion_um: Vec::new(),
            unseen: Vec::new(),
            without_bead: Vec::new(),
            repeated: Vec::new(),
            ages_ns: Vec::new(),
            usual_age_periods: 0.0,
            of_tick: Vec::new(),
        };
        let closed = ticks
            .iter()
            .position(TickRecord::is_running)
            .unwrap_or(ticks.len());
        let usual_ns = median(with_new_frame(&ticks[closed..]).map(age_ns)).unwrap_or(0);
        let lateness = lateness(&ticks[closed..], period_ns);
        rows.usual_age_periods = usual_ns.max(0) as f64 / period_ns as f64;
        let (mut first_id, mut arrivals) = (None, Vec::new());
        // The clock plays the excitation, so a tick's place in it is its number on the clock's grid.
        let grid = Grid::new(ticks.first().map_or(0, |t| t.time_ns), period_ns);
        let first_index = ticks.get(closed).map_or(0, |t| grid.index(t.time_ns));
        for (tick, late) in ticks[closed..].iter().zip(lateness) {
            let has = |flag| tick.flags.has(flag);
            let new_frame = is_new_frame(tick);
            let next = rows.input.len();
            let exposed = if new_frame {
                let first = *first_id.get_or_insert(tick.frame_id.saturating_sub(next as u64));
                usize::try_from(tick.frame_id.saturating_sub(first)).unwrap_or(next)
            } else {
                next
            };
            // A late frame overwrites the command of a timer tick that has already taken its row.
            let row = exposed.clamp(next.saturating_sub(1), next + 10_000);
            // In a row without a tick the command before it was held. A value between it and the next would depend on the next, which
            // answers the noise of these rows.
            while rows.input.len() <= row {
                let held_um = rows.input.last().copied().unwrap_or(tick.command_um);
                rows.input.push(held_um);
                rows.output.push(f64::NAN);
                rows.usable.push(true);
                rows.late.push(true);
                rows.unknown.push(true);
                rows.unseen.push(false);
                rows.without_bead.push(false);
                rows.repeated.push(false);
                rows.ages_ns.push(None);
            }
            let age_ns = age_ns(tick);
            let on_time = 2 * (age_ns - usual_ns).abs() < period_ns;
            arrivals.extend(late.map(|late| Arrival {
                row: row as f64 + late.at_board_ns as f64 / period_ns as f64,
                um: tick.command_um,
            }));
            rows.late[row] = late.is_none_or(|late| 2 * late.at_board_ns.abs() >= period_ns);
            // When the board had a command of a stall, only the board can tell.
            let late = late.filter(|late| late.told || !rows.late[row]);
            rows.unknown[row] = late.is_none();
            let seen = new_frame && !has(TickFlags::LOST);
            // The row's command stands as if on time.
            rows.ages_ns[row] =
                (late.filter(|_| seen && on_time)).map(|late| age_ns - late.handed_over_ns);
            rows.input[row] = tick.command_um;
            // The same holds for a frame.
            let seen = seen && (on_time || late.is_some());
            if let Some(output) = rows.output.get_mut(exposed).filter(|_| seen) {
                *output = tick.measured_um;
            }
            rows.unseen[row] = is_unseen(tick) || new_frame && !seen;
            rows.without_bead[row] = is_unseen(tick);
            rows.repeated[row] = repeats_picture(tick);
            rows.unseen[row.saturating_sub(frames_passed_over(tick))..row].fill(true);
            rows.usable[row] = tick.is_controlled();
            // If a tick was skipped or its record was lost, the next tick takes its place.
            let at = usize::try_from(grid.index(tick.time_ns) - first_index).unwrap_or(0);
            rows.of_tick.resize(at.max(rows.of_tick.len()), row);
            rows.of_tick.push(row);
        }
        let on_time = as_if_on_time(
            &rows.input,
            &rows.output,
            &arrivals,
            &rows.unknown,
            rows.usual_age_periods,
        );
        (rows.output, rows.late_motion_um) = (on_time.position_um, on_time.open_um);
        let open = rows.late_motion_um.iter_mut().zip(&rows.unknown);
        open.filter(|(_, unknown)| **unknown)
            .for_each(|(um, _)| *um = f64::NAN);
        if rows.late_motion_um.iter().all(|um| *um == 0.0) {
            rows.late_motion_um.clear();
        }
        rows
    }

    /// The rows of a record, with the positions as the camera delivered them.
    pub(crate) fn delivered(self) -> Delivered {
        let frame_age_s = self.frame_age_s();
        let mut bead_um = self.output;
        for row in (0..bead_um.len()).filter(|row| self.repeated[*row]) {
            repeat_before(&mut bead_um, row);
        }
        Delivered {
            pzt_um: self.input,
            bead_um,
            unseen: self.unseen,
            frame_age_s,
            late_command: self.late,
            late_motion_um: self.late_motion_um,
        }
    }

    /// Mean time from the middle of an exposure to its tick, s; `None` if no frame came in time.
    pub(crate) fn age_s(&self) -> Option<f64> {
        mean_s(&self.ages_ns)
    }

    /// A segment, or the reason why the stretch is not one.
    pub(crate) fn segment(
        &self,
        span: &Span,
        lost_frames: usize,
    ) -> Result<RecordedSegment, Spoilt> {
        let row_of = |tick: usize| {
            let row = self.of_tick.get(SETTLE_TICKS + tick).copied();
            row.ok_or(Spoilt::NotRun)
        };
        let (start, from) = (row_of(span.start)?, row_of(span.start + span.settle)?);
        let end = row_of(span.start + span.rows)?;
        let (Some(output), Some(usable)) =
            (self.output.get(start..end), self.usable.get(start..end))
        else {
            return Err(Spoilt::NotRun);
        };
        // A bead out of view: most of the frames without a position came and showed none. Of a machine that stalls they did not come.
        let out_of_view = |rows: std::ops::Range<usize>| {
            let bare = &self.without_bead[start + rows.start..start + rows.end];
            2 * bare.iter().filter(|bare| **bare).count() > bare.len()
        };
        // In a freeze the bead does not follow the excitation: a short one is a gap as any other.
        let output: Vec<f64> = (output.iter().zip(usable))
            .map(|(um, usable)| if *usable { *um } else { f64::NAN })
            .collect();
        let mut gap = 0;
        for (row, um) in output.iter().enumerate() {
            gap = if um.is_finite() { 0 } else { gap + 1 };
            if gap >= lost_frames {
                let at = row + 1 - gap;
                let frozen = usable[at..=row].iter().position(|usable| !usable);
                return Err(match frozen.map(|after| at + after) {
                    // The rows before a freeze show its reason.
                    Some(frozen) => Spoilt::Frozen {
                        at: frozen,
                        out_of_view: out_of_view(at..frozen),
                    },
                    None => Spoilt::Unseen {
                        at,
                        rows: gap,
                        out_of_view: out_of_view(at..row + 1),
                    },
                });
            }
        }
        let input = self.input[start..end].to_vec();
        let steps = output[from - start..].windows(2);
        let shown = (steps.clone().zip(&self.late[from..]))
            .filter(|(pair, late)| !**late && pair.iter().all(|um| um.is_finite()))
            .count();
        // The fit leaves out a block that lost half of its steps: with five eighths of all, a quarter of the blocks remain at least.
        if 8 * shown < 5 * steps.len() {
            return Err(Spoilt::Thin {
                lost: 1.0 - shown as f64 / steps.len() as f64,
            });
        }
        Ok(RecordedSegment {
            index: span.index,
            from: from - start,
            age_s: mean_s(&self.ages_ns[from..end]),
            input,
            output,
        })
    }
}

/// Why a stretch of a run is not a segment; rows are counted from its start.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Spoilt {
    /// The run ended before it did.
    NotRun,
    /// The loop was frozen.
    Frozen {
        /// First row of that.
        at: usize,
        /// The bead had left the view.
        out_of_view: bool,
    },
    /// No position for long.
    Unseen {
        /// First row without one.
        at: usize,
        /// Rows without one.
        rows: usize,
        /// The bead had left the view.
        out_of_view: bool,
    },
    /// Too few steps from one position to the next are left.
    Thin {
        /// Share of them that is missing or shows a late command.
        lost: f64,
    },
}

impl Spoilt {
    /// Whether the bead left the view: a smaller amplitude may keep it there. What the machine spoilt, none would have kept.
    pub(crate) fn is_out_of_view(self) -> bool {
        matches!(
            self,
            Self::Frozen {
                out_of_view: true,
                ..
            } | Self::Unseen {
                out_of_view: true,
                ..
            }
        )
    }

    /// The reason in words, for rows `period_s` apart.
    pub(crate) fn words(self, period_s: f64) -> String {
        let s = |rows: usize| rows as f64 * period_s;
        match self {
            Self::NotRun => "the run ended before it did".to_string(),
            Self::Frozen { at, .. } => format!("the loop was frozen after {:.2} s", s(at)),
            Self::Unseen { at, rows, .. } => {
                format!("no position for {:.2} s after {:.2} s", s(rows), s(at))
            }
            Self::Thin { lost } => format!(
                "{:.0} % of its frames showed no reliable bead, were lost or {:.2} ms late, or had late commands: look at the \
                 picture (cellpos camera) and at the machine (cellpos doctor)",
                100.0 * lost,
                // Half a period.
                500.0 * period_s
            ),
        }
    }
}

#[cfg(test)]
#[path = "rows_tests.rs"]
mod tests;
