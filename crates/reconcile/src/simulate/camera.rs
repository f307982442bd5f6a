//! Bead and camera blocks: what acts on the motion, and how the frames sample it.

use super::modal::Trace;
use cellpos_plant::effects::{Block, Piece};
use std::ops::Range;

/// Properties of the frames.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Frames {
    pub(super) skew: f64,
    pub(super) delay_s: f64,
    pub(super) exposure_s: f64,
}

impl Frames {
    pub(super) fn are_plain(&self, sampling: &Sampling) -> bool {
        self.skew == 0.0 && self.delay_s == 0.0 && self.exposure_s == 0.0 && sampling.is_plain()
    }

    /// From and until when a frame that did not wait is exposed, from the instant of its row on an even clock \[s\]. Several windows are
    /// averaged; equal ends are an instant.
    pub(super) fn windows(&self, sampling: &Sampling) -> Vec<(f64, f64)> {
        let known = sampling.exposure_s;
        // A held command bends the path within an exposure. Its mean is therefore integrated, not taken from single points. Without bends
        // by the inner mean: two points by Gauss in each half.
        let near = known * (0.25 - 0.25 / 3f64.sqrt());
        let far = known * (0.25 + 0.25 / 3f64.sqrt());
        let middles: &[f64] = match (known > 0.0, self.exposure_s > 0.0) {
            (true, false) => {
                return vec![(-0.5 * known - self.delay_s, 0.5 * known - self.delay_s)];
            }
            (true, true) => &[-far, -near, near, far],
            (false, _) => &[0.0],
        };
        let window = |middle: &f64| {
            let until = middle - self.delay_s;
            (until - self.exposure_s, until)
        };
        middles.iter().map(window).collect()
    }
}

/// The row, counted backwards from the frame's own, whose edge a frame close behind it does not show.
///
/// A frame close behind an edge shows the share of the edge, as a frame equally close in front of it does. Otherwise the sum of squares
/// would have a cliff at a delay of whole frames, and a fit that starts there would take no step.
pub(super) fn on_edge(frames: Frames, sampling: &Sampling, sample_s: f64) -> Option<usize> {
    let late = frames.delay_s / sample_s;
    let even = frames.skew == 0.0 && frames.exposure_s == 0.0 && sampling.is_plain();
    near_whole(late).filter(|w| even && late < *w as f64)
}

/// When the frames of a record were exposed, beyond what effects say.
#[derive(Debug, Clone, Default)]
pub(crate) struct Sampling {
    /// Exposure about the middle of each frame, if it is known \[s\].
    pub exposure_s: f64,
    pub waits: Waits,
    /// The command of a row answers its frame: a clock that runs ahead takes no frame after it.
    pub answered: bool,
}

/// How much older each frame is at its command than the frames that did not wait for it, in steps of the stamps' jitter.
#[derive(Debug, Clone, Default)]
pub(crate) struct Waits {
    pub step_s: f64,
    /// Steps of each row, 327 rows of time at most; empty: no frame waited.
    pub of_row: Vec<i16>,
}

impl Waits {
    #[inline]
    pub(super) fn steps(&self, row: usize) -> i16 {
        self.of_row.get(row).copied().unwrap_or(0)
    }

    /// Stretches of a number of rows that waited equally long, and their steps.
    pub(super) fn runs(&self, rows: usize) -> Vec<(Range<usize>, i16)> {
        let known = &self.of_row[..rows.min(self.of_row.len())];
        let mut runs = Vec::new();
        let mut start = 0;
        for run in known.chunk_by(|a, b| a == b) {
            runs.push((start..start + run.len(), run[0]));
            start += run.len();
        }
        if start < rows {
            runs.push((start..rows, 0));
        }
        runs
    }

    /// Wait of a row \[s\].
    #[inline]
    pub(crate) fn of_row_s(&self, row: usize) -> f64 {
        f64::from(self.steps(row)) * self.step_s
    }
}

impl Sampling {
    /// End of a window, from the instant of its row \[s\]. It is `at` on the camera's clock and `even` on an even one. A frame that a command
    /// answers ends before the command.
    pub(super) fn not_ahead(&self, at: f64, even: f64) -> f64 {
        match self.answered {
            true => at.min(even.max(0.0)),
            false => at,
        }
    }

    pub(super) fn is_plain(&self) -> bool {
        self.exposure_s == 0.0 && self.waits.of_row.is_empty()
    }
}

/// A block on a trace, step by step.
pub(crate) fn advance(t: &mut Trace, block: &mut dyn Block, h: f64) {
    let n = t.pos.len();
    let mut before = t.pos.first().copied().unwrap_or(0.0);
    for j in 0..n {
        let start = t.pos[j] + t.jump[j];
        let (a, b) = (t.start_slope[j], t.end_slope[j]);
        let end = t
            .pos
            .get(j + 1)
            .copied()
            .unwrap_or(start + 0.5 * (a + b) * h);
        let input = Piece {
            start,
            end,
            integral: h * (0.5 * (start + end) + h / 12.0 * (a - b)),
            speed_start: a,
            speed_end: b,
        };
        let out = block.advance(j as f64 * h, h, input);
        t.pos[j] = before;
        t.jump[j] = out.start - before;
        t.start_slope[j] = out.speed_start;
        t.end_slope[j] = out.speed_end;
        before = out.end;
    }
}

/// Positions at the frames: clock skew, delay, waits and exposure on a trace with `fine` steps per sample.
pub(crate) fn sample(
    t: &Trace,
    (frames, sampling): (Frames, &Sampling),
    h: f64,
    fine: usize,
    rows: usize,
    y: &mut Vec<f64>,
) {
    y.clear();
    y.reserve(rows);
    if frames.are_plain(sampling) {
        y.extend(t.pos.iter().step_by(fine));
        return;
    }
    let path = Path { t, h };
    let sample_s = h * fine as f64;
    let windows = frames.windows(sampling);
    if let ([window], 0.0) = (windows.as_slice(), frames.skew)
        && window.0 < window.1
    {
        path.means(*window, &sampling.waits, (fine, rows), y);
        return;
    }
    // The end of a window on the camera's clock.
    let at = |k: usize, until: f64| {
        let row_s = k as f64 * sample_s;
        let ahead_s = row_s * frames.skew - sampling.waits.of_row_s(k);
        row_s + sampling.not_ahead(until + ahead_s, until)
    };
    let edge = on_edge(frames, sampling, sample_s);
    y.extend((0..rows).map(|k| {
        let seen = |(from, until): &(f64, f64)| {
            let until_s = at(k, *until);
            if from < until {
                return path.mean(until_s - (until - from), until_s);
            }
            let shown = edge
                .and_then(|w| k.checked_sub(w))
                .filter(|edge| path.step_of(until_s).0 == edge * fine)
                .map_or(0.0, |edge| t.jump[edge * fine]);
            path.position(until_s) - shown
        };
        windows.iter().map(seen).sum::<f64>() / windows.len() as f64
    }));
}

/// The whole number of frames to which a delay (in frames) is so close that the frames are at the edges of the command.
pub(crate) fn near_whole(frames: f64) -> Option<usize> {
    const NEAR: f64 = 0.06;
    let whole = frames.round();
    ((frames - whole).abs() <= NEAR).then_some(whole as usize)
}

/// The position as a function of time: a cubic in every step, jumps between them.
struct Path<'a> {
    t: &'a Trace,
    h: f64,
}

/// Integral of a cubic over a part of its step, in steps. These are the weights of [`Path::step`]: start, rise, and the slopes at both
/// ends times the step.
#[inline]
fn area(part: f64) -> [f64; 4] {
    const THIRD: f64 = 1.0 / 3.0;
    let (square, cube) = (part * part, part * part * part);
    let fourth = 0.25 * square * square;
    [
        part,
        cube - 2.0 * fourth,
        0.5 * square - 2.0 * THIRD * cube + fourth,
        fourth - THIRD * cube,
    ]
}

/// [`area`] of a whole step.
const WHOLE: [f64; 4] = [1.0, 0.5, 1.0 / 12.0, -1.0 / 12.0];

impl Path<'_> {
    /// Start of step j, its rise, and its slopes times the step.
    #[inline]
    fn step(&self, j: usize) -> [f64; 4] {
        let t = self.t;
        let start = t.pos[j] + t.jump[j];
        let (a, b) = (t.start_slope[j] * self.h, t.end_slope[j] * self.h);
        let rise = match t.pos.get(j + 1) {
            Some(end) => end - start,
            None => 0.5 * (a + b),
        };
        [start, rise, a, b]
    }

    #[inline]
    fn step_of(&self, at: f64) -> (usize, f64) {
        // Limits from the left: a command that acts at the very instant is not seen yet.
        let x = at / self.h;
        let behind = x - 1e-7;
        let mut j = behind as usize;
        j -= usize::from(j > 0 && behind == j as f64);
        j = j.min(self.t.pos.len() - 1);
        (j, (x - j as f64).max(0.0))
    }

    #[inline]
    fn position(&self, at: f64) -> f64 {
        if at <= 1e-7 * self.h {
            return self.t.pos[0];
        }
        let (j, f) = self.step_of(at);
        let [start, rise, a, b] = self.step(j);
        if f > 1.0 {
            // Past the record's end: go on straight.
            return start + rise + (f - 1.0) * b;
        }
        start + f * (a + f * (3.0 * rise - 2.0 * a - b + f * (a + b - 2.0 * rise)))
    }

    /// Mean between two instants.
    fn mean(&self, from: f64, to: f64) -> f64 {
        let rest = self.t.pos[0];
        if to <= 0.0 {
            return rest;
        }
        // Before the record the bead stood still.
        let before = from.min(0.0) * rest;
        let window = Window::new(self.step_of(from.max(0.0)), self.step_of(to));
        (window.sum(self, 0) * self.h - before) / (to - from)
    }

    /// Means between two instants about every row, earlier by its wait, of `fine` steps to a row.
    fn means(
        &self,
        (from, to): (f64, f64),
        waits: &Waits,
        (fine, rows): (usize, usize),
        y: &mut Vec<f64>,
    ) {
        let row_s = self.h * fine as f64;
        let least = waits.of_row.iter().copied().min().unwrap_or(0);
        let most = waits.of_row.iter().copied().max().unwrap_or(0);
        // Where a window lies depends on its row's wait alone: each is laid out once, at a row that has it all behind it.
        let reach_s = f64::from(most) * waits.step_s - from;
        let at = (reach_s / row_s).ceil().max(0.0) as usize + 1;
        let mut laid_out: Vec<Option<Window>> = Vec::new();
        laid_out.resize_with(usize::from(most.abs_diff(least)) + 1, || None);
        y.extend((0..rows).map(|k| {
            let mid = k as f64 * row_s - waits.of_row_s(k);
            let alone = || self.mean(mid + from, mid + to);
            let Some(later) = k.checked_sub(at).filter(|_| at < rows) else {
                return alone();
            };
            let of_wait = &mut laid_out[usize::from(waits.steps(k).abs_diff(least))];
            let window = of_wait.get_or_insert_with(|| {
                let mid = at as f64 * row_s - waits.of_row_s(k);
                Window::new(self.step_of(mid + from), self.step_of(mid + to))
            });
            match window.last + later * fine < self.t.pos.len() {
                true => window.sum(self, later * fine) * self.h / (to - from),
                false => alone(),
            }
        }));
    }
}

/// From a point of one step to a point of the same or a later one.
struct Window {
    first: usize,
    last: usize,
    /// Weights of the first step, and of the last one if it is another.
    begun: [f64; 4],
    end: [f64; 4],
}

impl Window {
    fn new((first, since): (usize, f64), (last, until): (usize, f64)) -> Self {
        let (before, end) = (area(since), area(until.min(1.5)));
        let until_end = if first == last { end } else { WHOLE };
        Self {
            first,
            last,
            begun: [0, 1, 2, 3].map(|i| until_end[i] - before[i]),
            end,
        }
    }

    /// Integral over it and a number of steps later, in steps.
    #[inline]
    fn sum(&self, path: &Path<'_>, later: usize) -> f64 {
        let of = |weights: &[f64; 4], j: usize| {
            let [start, rise, a, b] = path.step(j);
            (weights[0] * start + weights[1] * rise) + (weights[2] * a + weights[3] * b)
        };
        let (first, last) = (self.first + later, self.last + later);
        let mut sum = of(&self.begun, first);
        if first < last {
            for j in first + 1..last {
                sum += of(&WHOLE, j);
            }
            sum += of(&self.end, last);
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_exposure_that_straddles_a_bend_shows_the_mean_of_the_path() {
        // At rest up to row 4, then 2 um in each row: the mean over half a row about the bend is 2 um times 1/2 (1/4)^2/(1/2) rows.
        let rows = 8;
        let slope: Vec<f64> = (0..rows).map(|k| if k < 4 { 0.0 } else { 2.0 }).collect();
        let path = Trace {
            pos: (0..rows).map(|k| 2.0 * (k as f64 - 4.0).max(0.0)).collect(),
            jump: vec![0.0; rows],
            start_slope: slope.clone(),
            end_slope: slope,
        };
        let sampling = Sampling {
            exposure_s: 0.5,
            ..Sampling::default()
        };
        let mut y = Vec::new();
        let mut at_bend = |frames: Frames| {
            sample(&path, (frames, &sampling), 1.0, 1, rows, &mut y);
            y[4]
        };
        let shown = at_bend(Frames::default());
        assert!((shown - 0.125).abs() < 1e-12, "{shown}");
        // With an averaging that is short beside it, the same to a part of that.
        let averaged = at_bend(Frames {
            exposure_s: 1e-3,
            ..Frames::default()
        });
        assert!((averaged - 0.125).abs() < 2e-3, "{averaged}");
    }

    #[test]
    fn a_frame_that_its_command_answers_was_taken_before_it() {
        let rows = 8;
        let slope = vec![1.0; rows];
        let path = Trace {
            pos: (0..rows).map(|k| k as f64).collect(),
            jump: vec![0.0; rows],
            start_slope: slope.clone(),
            end_slope: slope,
        };
        let ahead = Frames {
            skew: 0.1,
            delay_s: 0.25,
            exposure_s: 0.0,
        };
        let mut y = Vec::new();
        for (answered, expected) in [(false, 5.25), (true, 5.0)] {
            let sampling = Sampling {
                answered,
                ..Sampling::default()
            };
            sample(&path, (ahead, &sampling), 1.0, 1, rows, &mut y);
            // Behind its row only once the clock has made up for the delay.
            assert!((y[2] - 1.95).abs() < 1e-9, "{y:?}");
            assert!((y[5] - expected).abs() < 1e-9, "{y:?}");
        }
    }

    #[test]
    fn the_mean_between_two_instants_is_that_of_the_positions_between_them() {
        let of = |f: fn(f64) -> f64| -> Vec<f64> { (0..50).map(|k| f(f64::from(k))).collect() };
        let t = Trace {
            pos: of(|k| (0.7 * k).sin()),
            jump: of(|k| (0.3 * k).cos()),
            start_slope: of(|k| 40.0 * (1.1 * k).sin()),
            end_slope: of(|k| 30.0 * (1.3 * k).cos()),
        };
        let h = 1e-3;
        let path = Path { t: &t, h };
        for (from, to) in [
            (0.2, 0.7),
            (3.1, 3.9),
            (7.6, 8.3),
            (9.25, 14.5),
            (-2.0, 1.5),
        ] {
            let parts = 700_000;
            let at = |k: i32| h * (from + (to - from) * (f64::from(k) + 0.5) / f64::from(parts));
            let sum: f64 = (0..parts).map(|k| path.position(at(k))).sum();
            let (mean, dense) = (path.mean(from * h, to * h), sum / f64::from(parts));
            assert!(
                (mean - dense).abs() < 1e-5,
                "{from} to {to}: {mean} {dense}"
            );
        }
        assert_eq!(path.mean(-2.0 * h, -h), t.pos[0]);
        // The same about every row, of one step or of five.
        for (from, to) in [
            (-0.2, 0.3),
            (-2.7, -2.2),
            (-2.25, -1.75),
            (-6.0, 0.0),
            (0.4, 1.7),
        ] {
            for fine in [1, 5] {
                let mut means = Vec::new();
                let waits = Waits {
                    step_s: 0.1 * h,
                    of_row: (0..50 / fine as i16).map(|k| k % 7 - 1).collect(),
                };
                path.means((from * h, to * h), &waits, (fine, 50 / fine), &mut means);
                assert_eq!(means.len(), 50 / fine);
                for (k, mean) in means.iter().enumerate() {
                    let at = (k * fine) as f64 - waits.of_row_s(k) / h;
                    let alone = path.mean((at + from) * h, (at + to) * h);
                    assert!(
                        (mean - alone).abs() < 1e-9,
                        "{from} to {to}, {k}: {mean} {alone}"
                    );
                }
            }
        }
    }
}
