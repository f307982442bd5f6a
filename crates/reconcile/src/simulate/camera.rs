//! Bead and camera blocks: what acts on the motion, and how the frames sample it.

use super::modal::Trace;
use cellpos_plant::effects::{Block, Piece};

/// Properties of the frames.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Frames {
    pub(super) skew: f64,
    pub(super) delay_s: f64,
    pub(super) exposure_s: f64,
}

/// When the frames of a record were exposed, beyond what effects say.
#[derive(Debug, Clone, Default)]
pub(crate) struct Sampling {
    /// Exposure about the middle of each frame, if it is known \[s\].
    pub exposure_s: f64,
    /// How much older each frame is at its command than the frames that did not wait for it \[s\]; empty: none waited.
    pub waits_s: Vec<f64>,
}

impl Sampling {
    pub(super) fn is_plain(&self) -> bool {
        self.exposure_s == 0.0 && self.waits_s.is_empty()
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
    let Frames {
        skew,
        delay_s: delay,
        exposure_s: exposure,
    } = frames;
    y.clear();
    y.reserve(rows);
    if skew == 0.0 && delay == 0.0 && exposure == 0.0 && sampling.is_plain() {
        y.extend(t.pos.iter().step_by(fine));
        return;
    }
    let known = sampling.exposure_s;
    let path = Path::new(t, h, exposure > 0.0 || known > 0.0);
    let sample_s = h * fine as f64;
    // A frame that close behind an edge shows the share of the edge, as one that close in front of it does. Otherwise a delay of
    // whole frames would be a cliff, and a fit on top of it takes no step.
    let whole = near_whole(delay / sample_s).filter(|_| sampling.is_plain());
    let edge = whole.filter(|w| skew == 0.0 && exposure == 0.0 && delay / sample_s < *w as f64);
    for k in 0..rows {
        let wait = sampling.waits_s.get(k).copied().unwrap_or(0.0);
        let at = k as f64 * sample_s * (1.0 + skew) - delay - wait;
        // A held command bends the path within an exposure, so points of it would not do for its mean.
        let seen = |at: f64| path.mean(at - exposure, at);
        y.push(if known > 0.0 && exposure == 0.0 {
            path.mean(at - 0.5 * known, at + 0.5 * known)
        } else if known > 0.0 {
            // Without bends by the inner mean: two points by Gauss in each half.
            let near = known * (0.25 - 0.25 / 3f64.sqrt());
            let far = known * (0.25 + 0.25 / 3f64.sqrt());
            0.25 * (seen(at - far) + seen(at - near) + seen(at + near) + seen(at + far))
        } else if exposure > 0.0 {
            seen(at)
        } else {
            let shown = edge
                .and_then(|w| k.checked_sub(w))
                .filter(|edge| path.step_of(at).0 == edge * fine)
                .map_or(0.0, |edge| t.jump[edge * fine]);
            path.position(at) - shown
        });
    }
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
    /// Integral of the position from the start to each step.
    area: Vec<f64>,
}

impl<'a> Path<'a> {
    fn new(t: &'a Trace, h: f64, with_area: bool) -> Self {
        let mut path = Self {
            t,
            h,
            area: Vec::new(),
        };
        if with_area && let Some(last) = t.pos.len().checked_sub(1) {
            // The integral of a cubic by its ends and its slopes there.
            let slopes = t.start_slope.iter().zip(&t.end_slope);
            let steps = t.pos.iter().zip(&t.pos[1..]).zip(&t.jump).zip(slopes);
            let (mut sum, part) = (0.0, h / 12.0);
            path.area.reserve(last + 1);
            path.area.extend(steps.map(|(((from, to), jump), (a, b))| {
                let before = sum;
                sum += h * (0.5 * (from + jump + to) + part * (a - b));
                before
            }));
            path.area.push(sum);
        }
        path
    }

    /// Coefficients of `c0 + c1 f + c2 f^2 + c3 f^3`, f in 0..1 of step j.
    #[inline]
    fn cubic(&self, j: usize) -> [f64; 4] {
        let t = self.t;
        let start = t.pos[j] + t.jump[j];
        let (a, b) = (t.start_slope[j] * self.h, t.end_slope[j] * self.h);
        let d = match t.pos.get(j + 1) {
            Some(end) => end - start,
            None => 0.5 * (a + b),
        };
        [start, a, 3.0 * d - 2.0 * a - b, a + b - 2.0 * d]
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
        let c = self.cubic(j);
        if f > 1.0 {
            // Past the record's end: go on straight.
            return c[0] + c[1] + c[2] + c[3] + (f - 1.0) * self.t.end_slope[j] * self.h;
        }
        c[0] + f * (c[1] + f * (c[2] + f * c[3]))
    }

    /// Integral over the part `f` of step j.
    #[inline]
    fn partial_area(&self, j: usize, f: f64) -> f64 {
        const THIRD: f64 = 1.0 / 3.0;
        let c = self.cubic(j);
        self.h * f * (c[0] + f * (0.5 * c[1] + f * (THIRD * c[2] + f * (0.25 * c[3]))))
    }

    /// Mean between two instants.
    fn mean(&self, from: f64, to: f64) -> f64 {
        (self.integral(to) - self.integral(from)) / (to - from)
    }

    #[inline]
    fn integral(&self, at: f64) -> f64 {
        if at <= 0.0 {
            return at * self.t.pos[0];
        }
        let (j, f) = self.step_of(at);
        self.area[j] + self.partial_area(j, f.min(1.5))
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
            waits_s: Vec::new(),
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
    fn the_integral_to_each_step_is_that_of_the_steps_before_it() {
        let of = |f: fn(f64) -> f64| -> Vec<f64> { (0..50).map(|k| f(f64::from(k))).collect() };
        let t = Trace {
            pos: of(|k| (0.7 * k).sin()),
            jump: of(|k| (0.3 * k).cos()),
            start_slope: of(|k| 40.0 * (1.1 * k).sin()),
            end_slope: of(|k| 30.0 * (1.3 * k).cos()),
        };
        let h = 1e-3;
        let path = Path::new(&t, h, true);
        let mut sum = 0.0;
        for (j, area) in path.area.iter().enumerate() {
            assert!((area - sum).abs() < 1e-15, "{j}: {area} {sum}");
            sum += path.partial_area(j, 1.0);
        }
        assert_eq!(path.area.len(), 50);
    }
}
