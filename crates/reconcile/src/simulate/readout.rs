//! What the frames show of a linear chain, exactly and without a fine grid.
//!
//! A frame is the mean of the motion over its exposure, or the position at one instant. Both are linear in the states of the modes at the
//! start of a row and in the inputs from there on. The weights depend on the frame's wait alone: they are laid out once for each wait.

use super::camera::{Frames, Sampling, on_edge};
use super::modal::{C, Group, Modal, driven};
use super::walk::{Walk, decay};
use std::ops::Range;

/// An instant this close behind the edge of a step (in steps) does not see the step yet.
const AT_EDGE: f64 = 1e-7;

/// Frames of all rows of a record.
pub(super) struct Readout<'a> {
    sampling: &'a Sampling,
    /// From and until when a frame that did not wait is exposed, from the instant of its row \[s\]. Several are averaged; equal ends are
    /// an instant.
    windows: Vec<(f64, f64)>,
    /// The step, from the row's first, whose edge a frame close behind it does not show.
    edge: Option<isize>,
    step_s: f64,
    /// Steps of a row.
    fine: usize,
}

/// How a frame depends on the states at the start of a row, and on the inputs from there on.
struct Weights {
    /// That row, from the frame's own.
    row: isize,
    states: Vec<f64>,
    inputs: Vec<f64>,
}

/// Rows whose frames waited equally long, and the place of their weights.
struct Run {
    rows: Range<usize>,
    weights: usize,
}

impl<'a> Readout<'a> {
    pub(super) fn new(
        (frames, sampling): (Frames, &'a Sampling),
        step_s: f64,
        fine: usize,
    ) -> Self {
        let edge = on_edge(frames, sampling, step_s * fine as f64);
        Self {
            sampling,
            windows: frames.windows(sampling),
            edge: edge.map(|rows| -((rows * fine) as isize)),
            step_s,
            fine,
        }
    }

    /// Adds the part of a chain in the frames, under an input that is constant in every step.
    pub(super) fn add(&self, modal: &Modal, x: &[f64], y: &mut [f64]) {
        let mut laid_out: Vec<(i16, Weights)> = Vec::new();
        let mut runs: Vec<Run> = Vec::new();
        for (rows, wait) in self.sampling.waits.runs(y.len()) {
            let known = laid_out.iter().position(|(w, _)| *w == wait);
            let weights = known.unwrap_or_else(|| {
                let wait_s = self.sampling.waits.of_row_s(rows.start);
                laid_out.push((wait, self.weights(modal, wait_s)));
                laid_out.len() - 1
            });
            runs.push(Run { rows, weights });
        }
        let weights: Vec<Weights> = laid_out.into_iter().map(|(_, weights)| weights).collect();
        for run in &runs {
            self.add_inputs(&weights[run.weights], x, run.rows.clone(), y);
        }
        let mut lane = 0;
        for group in modal.groups() {
            let of_group = (lane, weights.as_slice(), runs.as_slice());
            lane += match group {
                Group::Eight(a) => self.add_states(of_group, |z, u| decay(&a, z, u), x, y),
                Group::Four(a) => self.add_states(of_group, |z, u| decay(&a, z, u), x, y),
                Group::Pair(a, b) => {
                    let on = |z: &mut [f64; 2], u: f64| {
                        let next = a * C::new(z[0], z[1]) + b * u;
                        *z = [next.re, next.im];
                    };
                    self.add_states(of_group, on, x, y)
                }
            };
        }
    }

    /// Adds the part of a group of states, the first of which is number `lane`, and which go on by `on` from step to step. Returns how many
    /// they are.
    fn add_states<const N: usize>(
        &self,
        (lane, weights, runs): (usize, &[Weights], &[Run]),
        on: impl Fn(&mut [f64; N], f64),
        x: &[f64],
        y: &mut [f64],
    ) -> usize {
        let rows = || weights.iter().map(|w| w.row);
        let (Some(first), Some(last)) = (rows().min(), rows().max()) else {
            return N;
        };
        let inputs = x.chunks_exact(self.fine).len();
        let mut walk = Walk::<N>::new(inputs, first.abs_diff(last));
        for Run {
            rows,
            weights: place,
        } in runs
        {
            let Weights { row, states, .. } = &weights[*place];
            let mut w = [0.0; N];
            w.copy_from_slice(&states[lane..lane + N]);
            // Before the record the bead stood still.
            let begin = row.min(&0).unsigned_abs().clamp(rows.start, rows.end);
            let seen = &mut y[begin..rows.end];
            if seen.is_empty() {
                continue;
            }
            let from = begin.saturating_add_signed(*row);
            match self.fine {
                1 => walk.read((&w, from), x.iter().map(std::slice::from_ref), &on, seen),
                fine => walk.read((&w, from), x.chunks_exact(fine), &on, seen),
            }
        }
        N
    }

    /// Adds the part of the inputs since the start of the row that the weights count from.
    fn add_inputs(&self, weights: &Weights, x: &[f64], rows: Range<usize>, y: &mut [f64]) {
        let Weights { row, inputs, .. } = weights;
        // Rows whose inputs are all in the record.
        let behind = (x.len() + self.fine).saturating_sub(inputs.len()) / self.fine;
        let begin = row.min(&0).unsigned_abs().clamp(rows.start, rows.end);
        let end = behind.saturating_add_signed(-row).clamp(begin, rows.end);
        for k in (rows.start..begin).chain(end..rows.end) {
            let first = (k as isize + row) * self.fine as isize;
            y[k] += across_an_end(inputs, first, x);
        }
        if begin < end {
            let first = begin.saturating_add_signed(*row) * self.fine;
            for (l, w) in inputs.iter().enumerate() {
                let (x, y) = (&x[first + l..], &mut y[begin..end]);
                match self.fine {
                    1 => y.iter_mut().zip(x).for_each(|(y, x)| *y += w * x),
                    fine => {
                        (y.iter_mut().zip(x.iter().step_by(fine))).for_each(|(y, x)| *y += w * x)
                    }
                }
            }
        }
    }

    /// Weights of a frame that waited.
    fn weights(&self, modal: &Modal, wait_s: f64) -> Weights {
        let (h, row_s) = (self.step_s, self.step_s * self.fine as f64);
        let share = 1.0 / self.windows.len() as f64;
        let mut moved: Vec<(f64, f64)> = self.windows.clone();
        for (from, until) in &mut moved {
            let at = self.sampling.not_ahead(*until - wait_s, *until);
            *from += at - *until;
            *until = at;
        }
        let earliest = moved
            .iter()
            .fold(f64::INFINITY, |least, (from, _)| least.min(*from));
        // The step before an edge takes part, and the one that an instant at the edge of a row still belongs to.
        let before = if self.edge.is_some() { h } else { AT_EDGE * h };
        let row = ((earliest - before) / row_s).floor();
        for (from, until) in &mut moved {
            *from -= row * row_s;
            *until -= row * row_s;
        }
        let latest = moved
            .iter()
            .fold(0.0_f64, |most, (_, until)| most.max(*until));
        let seen_steps = (latest / h - AT_EDGE).ceil().max(1.0) as usize;
        let mut weights = Weights {
            row: row as isize,
            states: vec![0.0; modal.states()],
            inputs: vec![0.0; seen_steps],
        };
        for (from, until) in moved {
            let seen = Seen { from, until, h };
            modal.add_state_weights(|p| seen.of_state(p) * share, &mut weights.states);
            for (l, input) in weights.inputs.iter_mut().enumerate() {
                let begin = l as f64 * h;
                *input += share * modal.direct * seen.of_direct(begin);
                *input += share * modal.residues(|p| seen.of_input(p, begin));
            }
        }
        if let Some(edge) = self.edge {
            // A frame in the step behind it shows the input before the edge.
            let at = edge - weights.row * self.fine as isize;
            if let [.., before, behind] = weights.inputs.as_mut_slice()
                && at + 1 == seen_steps as isize
            {
                *before += modal.direct;
                *behind -= modal.direct;
            }
        }
        weights
    }
}

/// Inputs times their weights where they begin before the record, or end behind it: rest before, the last command behind.
fn across_an_end(weights: &[f64], first: isize, x: &[f64]) -> f64 {
    let at = |l: usize| usize::try_from(first + l as isize).ok();
    let input = |l: usize| at(l).map_or(0.0, |at| x.get(at).or(x.last()).copied().unwrap_or(0.0));
    let terms = weights.iter().enumerate();
    terms.map(|(l, w)| w * input(l)).sum()
}

/// What one window, from the start of a row, sees of a mode.
struct Seen {
    from: f64,
    until: f64,
    h: f64,
}

impl Seen {
    /// Mean over the window from the integral up to a time, or the value at the instant.
    fn mean(&self, integral: impl Fn(f64) -> C, value: impl Fn(f64) -> C) -> C {
        if self.until > self.from {
            (integral(self.until) - integral(self.from)) / (self.until - self.from)
        } else {
            value(self.until)
        }
    }

    /// Of a state of 1 at the start of the row.
    fn of_state(&self, p: C) -> C {
        self.mean(|t| driven(p, t), |t| (p * t).exp())
    }

    /// Of an input of 1 in the step that begins at a time.
    fn of_input(&self, p: C, begin: f64) -> C {
        let integral = |t: f64| {
            let inside = twice_driven(p, (t - begin).clamp(0.0, self.h));
            match t - begin - self.h {
                rest if rest > 0.0 => inside + driven(p, self.h) * driven(p, rest),
                _ => inside,
            }
        };
        let value = |t: f64| {
            let inside = driven(p, (t - begin).clamp(0.0, self.h));
            match t - begin - self.h {
                rest if rest > 0.0 => inside * (p * rest).exp(),
                _ => inside,
            }
        };
        self.mean(integral, value)
    }

    /// Of the direct path of that input.
    fn of_direct(&self, begin: f64) -> f64 {
        let inside = |t: f64| (t - begin).clamp(0.0, self.h);
        if self.until > self.from {
            return (inside(self.until) - inside(self.from)) / (self.until - self.from);
        }
        let at = (self.until - begin) / self.h;
        f64::from(u8::from(at > AT_EDGE && at <= 1.0 + AT_EDGE))
    }
}

/// Integral of [`driven`] over time.
fn twice_driven(p: C, t: f64) -> C {
    let x = p * t;
    if x.norm() < 1e-3 {
        (C::new(0.5, 0.0) + x * (1.0 / 6.0) + x * x * (1.0 / 24.0)) * (t * t)
    } else {
        (driven(p, t) - t) / p
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulate::camera::{Waits, sample};
    use crate::simulate::modal::Trace;
    use cellpos_plant::Zpk;

    const ROW_S: f64 = 1e-3;
    const ROWS: usize = 300;

    /// A chain with a direct path, six real poles (one that integrates) and a complex pair.
    fn chain() -> Zpk {
        let pole = |re: f64, im: f64| C::new(re, im);
        Zpk {
            poles: vec![
                pole(0.0, 0.0),
                pole(-2.0, 0.0),
                pole(-30.0, 0.0),
                pole(-80.0, 0.0),
                pole(-200.0, 0.0),
                pole(-350.0, 0.0),
                pole(-40.0, 400.0),
                pole(-40.0, -400.0),
            ],
            zeros: [-5.0, -11.0, -50.0, -90.0, -150.0, -220.0, -300.0, -500.0]
                .map(|re| pole(re, 0.0))
                .to_vec(),
            gain: 0.7,
        }
    }

    /// Commands that rest and jump, `fine` steps to a row; in the second half of a row they differ from the first.
    fn command(fine: usize) -> Vec<f64> {
        let at = |k: usize| ((k * 7919) % 101) as f64 / 101.0 - 0.3;
        let steps = (0..ROWS).flat_map(|k| (0..fine).map(move |j| (k / 3, 2 * j / fine)));
        steps.map(|(k, half)| at(2 * k + half)).collect()
    }

    /// The same command on a grid so fine that cubics between its points are exact to 1e-8.
    fn on_a_fine_grid(x: &[f64], fine: usize, (frames, sampling): (Frames, &Sampling)) -> Vec<f64> {
        let finer = 48 / fine;
        let x: Vec<f64> = x
            .iter()
            .flat_map(|u| std::iter::repeat_n(*u, finer))
            .collect();
        let h = ROW_S / 48.0;
        let (mut t, mut y) = (Trace::default(), Vec::new());
        Modal::new(&chain(), h).trace(&x, 48, &mut t);
        sample(&t, (frames, sampling), h, 48, ROWS, &mut y);
        y
    }

    #[test]
    fn frames_of_modes_are_those_of_the_motion_on_a_fine_grid() {
        // Waits that rise, fall by more than a row, and are shorter than none.
        let waits = Waits {
            step_s: 1e-5,
            of_row: (0..ROWS as i16).map(|k| (k / 7) * 37 % 260 - 40).collect(),
        };
        let kinds = [
            (0.0, 0.0),
            (2.1e-3, 0.0),
            (2e-3, 0.0),
            (1.9e-3, 0.0),
            (0.4e-3, 0.8e-3),
            (0.0, 2.4e-3),
        ];
        for (delay_s, exposure_s) in kinds {
            let frames = Frames {
                skew: 0.0,
                delay_s,
                exposure_s,
            };
            for (known_s, waits) in [
                (0.0, Waits::default()),
                (0.0, waits.clone()),
                (0.5e-3, Waits::default()),
                (0.5e-3, waits.clone()),
            ] {
                let sampling = Sampling {
                    exposure_s: known_s,
                    waits,
                    answered: false,
                };
                for fine in [1, 4] {
                    let x = command(fine);
                    let expected = on_a_fine_grid(&x, fine, (frames, &sampling));
                    let h = ROW_S / fine as f64;
                    let mut y = vec![0.0; ROWS];
                    Readout::new((frames, &sampling), h, fine).add(
                        &Modal::new(&chain(), h),
                        &x,
                        &mut y,
                    );
                    // Behind the record the two go on differently.
                    for k in 0..ROWS - 2 {
                        let off = (y[k] - expected[k]).abs();
                        assert!(off < 1e-6, "{frames:?} {known_s} {fine}, row {k}: {off}");
                    }
                }
            }
        }
    }

    #[test]
    fn rows_before_the_first_command_and_behind_the_last_rest_and_stay() {
        let sampling = Sampling::default();
        let frames = Frames {
            delay_s: 5.5 * ROW_S,
            ..Frames::default()
        };
        let readout = Readout::new((frames, &sampling), ROW_S, 1);
        let direct = Zpk {
            poles: Vec::new(),
            zeros: Vec::new(),
            gain: 2.0,
        };
        let mut y = vec![0.0; 8];
        readout.add(&Modal::new(&direct, ROW_S), &[1.0; 8], &mut y);
        assert_eq!(y, [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0, 2.0]);
        // A record of fewer rows than the delay has.
        let mut y = vec![0.0; 3];
        readout.add(&Modal::new(&chain(), ROW_S), &[1.0; 3], &mut y);
        assert_eq!(y, [0.0; 3]);
        // Frames of the next row: the last command holds.
        let early = Frames {
            delay_s: -2.5 * ROW_S,
            ..Frames::default()
        };
        let mut y = vec![0.0; 4];
        Readout::new((early, &sampling), ROW_S, 1).add(
            &Modal::new(&direct, ROW_S),
            &[1.0, 2.0, 3.0, 4.0],
            &mut y,
        );
        assert_eq!(y, [6.0, 8.0, 8.0, 8.0]);
    }
}
