//! The ticks of a run as an evenly sampled record, and the segments in it.

use crate::experiment::exciting::SETTLE_TICKS;
use cellpos_ident::analogue;
use cellpos_ident::experiment::{RecordedSegment, Span};
use cellpos_runtime::{Grid, TickFlags, TickRecord};

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
pub fn is_unseen(tick: &TickRecord) -> bool {
    let came = tick.verdict != 255 && !tick.flags.has(TickFlags::TIMER);
    came && !tick.measured_um.is_finite()
}

/// Frames that arrived together with a tick's frame and were not used: late, for example after a stall of the camera, but not dropped.
pub fn frames_passed_over(tick: &TickRecord) -> usize {
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

/// Ticks as rows of an evenly sampled record, by frame id: a tick that never came is a row without a position.
pub(crate) struct Rows {
    /// Command of each row, um, as if it had been on time.
    pub(crate) input: Vec<f64>,
    pub(crate) output: Vec<f64>,
    usable: Vec<bool>,
    /// There was no tick at this row: the command before it was held.
    skipped: Vec<bool>,
    /// The command of this row's tick came too late to stand as if on time, or never.
    late: Vec<bool>,
    /// The frame came too late, or without a reliable bead.
    pub(crate) unseen: Vec<bool>,
    /// The frame came in time and showed no reliable bead.
    without_bead: Vec<bool>,
    /// Age that each row's frame has if its command is on time, ns; `None` if it was not.
    ages_ns: Vec<Option<i64>>,
    /// Usual age of a frame at its tick, in rows.
    usual_age_periods: f64,
    /// Row of each tick since the loop was closed.
    of_tick: Vec<usize>,
}

/// How much later than usual the command of each tick was handed over, counted from the exposure of its frame, ns. Usual is the median of
/// a second, in which clocks drift by a negligible amount. A tick without a frame comes when the frame is overdue.
fn lateness_ns(ticks: &[TickRecord]) -> Vec<i64> {
    const SECOND: usize = 1000;
    let handed_over_ns = |tick: &TickRecord| age_ns(tick) + i64::from(tick.compute_ns);
    let mut late_ns = Vec::with_capacity(ticks.len());
    for ticks in ticks.chunks(SECOND) {
        let usual_ns = median(with_new_frame(ticks).map(handed_over_ns)).unwrap_or(0);
        late_ns.extend(ticks.iter().map(|tick| match is_new_frame(tick) {
            true => handed_over_ns(tick) - usual_ns,
            false => i64::MAX,
        }));
    }
    late_ns
}

/// Lateness from which a command counts as late, ns: a tenth of a period, or more on a machine where too few commands would remain. A
/// command can be moved within the band of the rows only: at 0.3 of the sampling rate a tenth of a period turns the first image of the
/// held command, the fastest part of a record, by 36 degrees.
fn tolerated_ns(late_ns: &[i64], period_ns: i64) -> i64 {
    let known = late_ns.iter().filter(|&&ns| ns != i64::MAX);
    let mut sorted: Vec<i64> = known.map(|ns| ns.saturating_abs()).collect();
    sorted.sort_unstable();
    // Without the two rows that may show a late command three steps from row to row are lost: at most a tenth of all.
    let most_ns = sorted.get(sorted.len() * 29 / 30).copied().unwrap_or(0);
    most_ns.max(period_ns / 10)
}

/// Commands that begin with their rows, for commands `held_um` that were handed over `late` rows after that. A command is a step at its
/// time, and a step between two rows acts within the band of the rows as those that interpolate it.
fn as_if_on_time(held_um: &[f64], late: &[f64]) -> Vec<f64> {
    let mut steps_um = vec![0.0; held_um.len()];
    let first_um = held_um.first().copied().unwrap_or(0.0);
    let mut before_um = first_um;
    for (row, (um, late)) in held_um.iter().zip(late).enumerate() {
        let whole = late.floor();
        let weights = analogue::weights(late - whole);
        let begin = row as i64 + whole as i64 + 1 - weights.len() as i64 / 2;
        for (weight, to) in weights.into_iter().zip(begin..) {
            // A step before the first row acts in it.
            if let Some(step_um) = steps_um.get_mut(to.max(0) as usize) {
                *step_um += weight * (um - before_um);
            }
        }
        before_um = *um;
    }
    let sum = |um: &mut f64, step_um: f64| {
        *um += step_um;
        Some(*um)
    };
    steps_um.into_iter().scan(first_um, sum).collect()
}

/// Upper limit of the delay from a command to its effect, in periods: at 1 kHz over USB or a serial line, with the lateness of a tick
/// included.
const LINE_PERIODS: f64 = 1.0;

fn is_new_frame(tick: &TickRecord) -> bool {
    !tick.flags.has(TickFlags::TIMER) && !tick.flags.has(TickFlags::STALE)
}

fn with_new_frame(ticks: &[TickRecord]) -> impl Iterator<Item = &TickRecord> {
    ticks.iter().filter(|tick| is_new_frame(tick))
}

/// How old the frame of a tick is, by its own stamp, ns; `None` for a tick without a new frame.
pub fn frame_age_ns(tick: &TickRecord) -> Option<i64> {
    is_new_frame(tick).then(|| age_ns(tick))
}

/// How old a tick's frame is, by its own stamp, ns.
fn age_ns(tick: &TickRecord) -> i64 {
    tick.time_ns - tick.mid_exposure_ns
}

/// The median, which a stall does not shift; `None` of an empty list.
fn median(values: impl Iterator<Item = i64>) -> Option<i64> {
    let mut values: Vec<i64> = values.collect();
    values.sort_unstable();
    values.get(values.len() / 2).copied()
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
            skipped: Vec::new(),
            late: Vec::new(),
            unseen: Vec::new(),
            without_bead: Vec::new(),
            ages_ns: Vec::new(),
            usual_age_periods: 0.0,
            of_tick: Vec::new(),
        };
        let closed = ticks
            .iter()
            .position(TickRecord::is_running)
            .unwrap_or(ticks.len());
        let usual_ns = median(with_new_frame(&ticks[closed..]).map(age_ns)).unwrap_or(0);
        let late_ns = lateness_ns(&ticks[closed..]);
        let tolerated_ns = tolerated_ns(&late_ns, period_ns);
        // Counted from the mean, the lateness of what stands as if on time moves the images of the held commands both ways.
        let in_time = |ns: &&i64| ns.saturating_abs() <= tolerated_ns;
        let (sum_ns, count) =
            (late_ns.iter().filter(in_time)).fold((0, 0), |(sum, count), ns| (sum + ns, count + 1));
        let mean_late_ns = sum_ns / count.max(1);
        rows.usual_age_periods = usual_ns.max(0) as f64 / period_ns as f64;
        let (mut first_id, mut late_periods) = (None, Vec::new());
        // The clock plays the excitation, so a tick's place in it is its number on the clock's grid.
        let grid = Grid::new(ticks.first().map_or(0, |t| t.time_ns), period_ns);
        let first_index = ticks.get(closed).map_or(0, |t| grid.index(t.time_ns));
        for (tick, late_ns) in ticks[closed..].iter().zip(late_ns) {
            let has = |flag| tick.flags.has(flag);
            let new_frame = is_new_frame(tick);
            let next = rows.input.len();
            let row = if new_frame {
                let first = *first_id.get_or_insert(tick.frame_id.saturating_sub(next as u64));
                usize::try_from(tick.frame_id.saturating_sub(first)).unwrap_or(next)
            } else {
                next
            };
            // A late frame overwrites the row that a timer tick has already taken.
            let row = row.clamp(next.saturating_sub(1), next + 10_000);
            while rows.input.len() <= row {
                let held_um = rows.input.last().copied().unwrap_or(tick.command_um);
                rows.input.push(held_um);
                rows.output.push(f64::NAN);
                rows.usable.push(true);
                rows.skipped.push(true);
                rows.late.push(true);
                rows.unseen.push(false);
                rows.without_bead.push(false);
                rows.ages_ns.push(None);
                late_periods.push(0.0);
            }
            let age_ns = age_ns(tick);
            // A frame half a period off the usual age belongs to another row.
            let on_time =
                new_frame && !has(TickFlags::LOST) && 2 * (age_ns - usual_ns).abs() < period_ns;
            let late = late_ns.abs() > tolerated_ns;
            let late_ns = late_ns.saturating_sub(mean_late_ns);
            rows.skipped[row] = false;
            rows.late[row] = late;
            // No position shows the moment at which a late one acted: for those that are left, it was on time.
            late_periods[row] = match late {
                true => 0.0,
                false => late_ns as f64 / period_ns as f64,
            };
            // The row's command stands as if on time.
            rows.ages_ns[row] = (on_time && !late).then_some(age_ns - late_ns);
            rows.input[row] = tick.command_um;
            rows.output[row] = if on_time { tick.measured_um } else { f64::NAN };
            rows.unseen[row] = is_unseen(tick);
            rows.without_bead[row] = is_unseen(tick);
            rows.unseen[row.saturating_sub(frames_passed_over(tick))..row].fill(true);
            rows.usable[row] = tick.is_controlled();
            // If a tick was skipped or its record was lost, the next tick takes its place.
            let at = usize::try_from(grid.index(tick.time_ns) - first_index).unwrap_or(0);
            rows.of_tick.resize(at.max(rows.of_tick.len()), row);
            rows.of_tick.push(row);
        }
        rows.input = as_if_on_time(&rows.input, &late_periods);
        rows
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
        if let Some(at) = usable.iter().position(|usable| !usable) {
            let shown = output[..at].iter().rposition(|um| um.is_finite());
            let out_of_view = out_of_view(shown.map_or(0, |row| row + 1)..at);
            return Err(Spoilt::Frozen { at, out_of_view });
        }
        let mut gap = 0;
        for (row, um) in output.iter().enumerate() {
            gap = if um.is_finite() { 0 } else { gap + 1 };
            if gap >= lost_frames {
                let at = row + 1 - gap;
                return Err(Spoilt::Unseen {
                    at,
                    rows: gap,
                    out_of_view: out_of_view(at..row + 1),
                });
            }
        }
        let (mut input, mut output) = (self.input[start..end].to_vec(), output.to_vec());
        for row in (start..end).filter(|&row| self.late[row]) {
            if self.skipped[row] {
                input[row - start] = f64::NAN;
            }
            for shown in self
                .acts_at(row)
                .filter(|shown| (start..end).contains(shown))
            {
                output[shown - start] = f64::NAN;
            }
        }
        let steps = output[from - start..].windows(2);
        let shown = (steps.clone())
            .filter(|pair| pair.iter().all(|um| um.is_finite()))
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

    /// The rows whose positions first show the command of `row`. Without these rows no increment of the record contains the moment at
    /// which the command acted; later rows show only its result.
    fn acts_at(&self, row: usize) -> std::ops::RangeInclusive<usize> {
        let age = self.usual_age_periods;
        row + age.floor() as usize + 1..=row + (age + LINE_PERIODS).floor() as usize + 1
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
                "{:.0} % of its frames were lost or late, or their commands were: this machine does not keep the loop's time \
                 (cellpos doctor)",
                100.0 * lost
            ),
        }
    }
}

#[cfg(test)]
#[path = "rows_tests.rs"]
mod tests;
