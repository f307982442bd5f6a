//! The states of modes from row to row.

use std::collections::VecDeque;

/// States at the start of one row after another.
pub(super) struct Walk<const N: usize> {
    states: [f64; N],
    row: usize,
    /// Those of the rows before, as many as the waits differ by.
    recent: VecDeque<[f64; N]>,
    most_recent: usize,
    /// Rows that have inputs.
    inputs: usize,
}

impl<const N: usize> Walk<N> {
    /// From rest, through `inputs` rows, with the states of as many rows kept as `most_recent`.
    pub(super) fn new(inputs: usize, most_recent: usize) -> Self {
        Self {
            states: [0.0; N],
            row: 0,
            recent: VecDeque::new(),
            most_recent,
            inputs,
        }
    }

    /// Adds the weighted states of the rows from one on, one to each frame. Behind the record the last ones stay.
    pub(super) fn read<'x>(
        &mut self,
        (weights, from): (&[f64; N], usize),
        x: impl Iterator<Item = &'x [f64]> + Clone,
        on: impl Fn(&mut [f64; N], f64),
        seen: &mut [f64],
    ) {
        let next = |z: &mut [f64; N], inputs: &[f64]| inputs.iter().for_each(|u| on(z, *u));
        let from = from.min(self.inputs);
        while self.row > from
            && let Some(before) = self.recent.pop_back()
        {
            self.states = before;
            self.row -= 1;
        }
        for inputs in x.clone().skip(self.row).take(from.saturating_sub(self.row)) {
            self.keep();
            next(&mut self.states, inputs);
        }
        let (inside, behind) = seen.split_at_mut(seen.len().min(self.inputs - self.row));
        let (plain, last) = inside.split_at_mut(inside.len().saturating_sub(self.most_recent));
        if !plain.is_empty() {
            self.recent.clear();
        }
        let mut z = self.states;
        for (seen, inputs) in plain.iter_mut().zip(x.clone().skip(self.row)) {
            *seen += weighted(weights, &z);
            next(&mut z, inputs);
        }
        self.states = z;
        self.row += plain.len();
        for (seen, inputs) in last.iter_mut().zip(x.skip(self.row)) {
            *seen += weighted(weights, &self.states);
            self.keep();
            next(&mut self.states, inputs);
        }
        for seen in behind {
            *seen += weighted(weights, &self.states);
        }
    }

    /// The states go on to the next row.
    fn keep(&mut self) {
        self.row += 1;
        self.recent.push_back(self.states);
        if self.recent.len() > self.most_recent {
            self.recent.pop_front();
        }
    }
}

#[inline(always)]
fn weighted<const N: usize>(weights: &[f64; N], states: &[f64; N]) -> f64 {
    // Two sums, so that pairs are added at once.
    let mut sums = [0.0; 2];
    for (w, z) in weights
        .as_chunks::<2>()
        .0
        .iter()
        .zip(states.as_chunks::<2>().0)
    {
        sums[0] += w[0] * z[0];
        sums[1] += w[1] * z[1];
    }
    sums[0] + sums[1]
}

/// Real modes on by a step.
#[inline(always)]
pub(super) fn decay<const N: usize>(a: &[f64; N], z: &mut [f64; N], u: f64) {
    z.iter_mut().zip(a).for_each(|(z, a)| *z = a * *z + u);
}
