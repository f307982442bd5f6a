//! One evaluation of a set of parts: innovations, and their derivatives by every free number.

use crate::fit::catalogue::Part;
use crate::fit::context::{Context, Fit};
use crate::fit::linear::{Columns, sum_squares};
use crate::mask::Mask;
use cellpos_plant::effects::{FitParameter, Role};
use std::f64::consts::TAU;

/// Step of the numeric derivative by the working point: a tenth of the uncertainty that a loop has of it \[um\].
const OFFSET_STEP_UM: f64 = 5e-4;

/// One evaluation of the model.
pub(crate) struct State {
    pub sim: Vec<Vec<f64>>,
    /// The same with the lines that shake it, as the pixels see it.
    pub path: Vec<Vec<f64>>,
    /// Raw residual, without the share of the edge.
    pub residual: Vec<Vec<f64>>,
    pub innovations: Vec<Vec<f64>>,
    /// Whitened edges.
    pub soft: Vec<Vec<f64>>,
    pub chi2: f64,
}

impl Context<'_> {
    pub(crate) fn state(&self, fit: &Fit, mask: &Mask) -> State {
        let effects = self.effects(&fit.parts);
        let (mut sim, mut soft, mut edges) = (Vec::new(), Vec::new(), Vec::new());
        for (r, ranges) in self.problem.records.iter().zip(mask) {
            let mut y = Vec::new();
            // A record that does not count costs nothing.
            if ranges.is_empty() {
                sim.push(Vec::new());
                soft.push(Vec::new());
                edges.push(Vec::new());
                continue;
            }
            let mut edge = Vec::new();
            self.simulate(r, &effects, fit.offset_um, &mut y, Some(&mut edge));
            if fit.gain != 1.0 {
                y.iter_mut().for_each(|y| *y *= fit.gain);
            }
            sim.push(y);
            let mut w = vec![0.0; edge.len()];
            if edge.iter().any(|e| *e != 0.0) {
                r.whiten(&edge, &mut w);
            }
            soft.push(w);
            edges.push(edge);
        }
        let mut residual = Vec::with_capacity(sim.len());
        let mut innovations = Vec::with_capacity(sim.len());
        let mut path = sim.clone();
        for (i, (r, s)) in self.problem.records.iter().zip(&mut path).enumerate() {
            if s.is_empty() {
                residual.push(Vec::new());
                innovations.push(Vec::new());
                continue;
            }
            let mut e: Vec<f64> = r.y.iter().zip(&*s).map(|(y, s)| y - s).collect();
            // The noise is estimated from the residual; the share of the edge is not.
            for (e, edge) in e.iter_mut().zip(&edges[i]) {
                *e -= fit.soft * edge;
            }
            for (p, amplitudes) in fit.line_parts().zip(&fit.lines) {
                for (harmonic, [a, b]) in (1..).zip(&amplitudes[i]) {
                    if *a != 0.0 || *b != 0.0 {
                        let hz = f64::from(harmonic) * p.natural()[0];
                        self.rotate(hz, e.len(), |k, sin, cos| {
                            let line = a * sin + b * cos;
                            e[k] -= line;
                            s[k] += line;
                        });
                    }
                }
            }
            for (p, [a, b]) in fit.position_parts().zip(&fit.positions) {
                if *a == 0.0 && *b == 0.0 {
                    continue;
                }
                let pixel = p.natural()[0];
                // Once to take the error off the neighbours that tell the position, once in earnest.
                let mut straight = e.clone();
                for _ in 0..2 {
                    let walk = r.whitener.around(&straight);
                    for k in 0..e.len() {
                        let (sin, cos) = (TAU * (s[k] + walk[k]) / pixel).sin_cos();
                        straight[k] = e[k] - a * sin - b * cos;
                    }
                }
                e = straight;
            }
            let mut w = vec![0.0; e.len()];
            r.whiten(&e, &mut w);
            residual.push(e);
            innovations.push(w);
        }
        let chi2 = sum_squares(&innovations, mask);
        State {
            sim,
            path,
            residual,
            innovations,
            soft,
            chi2,
        }
    }

    /// Calls `f(k, sin, cos)` of a line at every row.
    fn rotate(&self, hz: f64, rows: usize, mut f: impl FnMut(usize, f64, f64)) {
        for k in 0..rows {
            let (s, c) = (TAU * hz * k as f64 * self.problem.base.sample_s).sin_cos();
            f(k, s, c);
        }
    }

    /// Columns of a line: of its frequency, which is common, then sine and cosine of each multiple, which are each record's own. The
    /// next free place.
    fn add_line_columns(
        &self,
        part: &Part,
        waves: &[Vec<[f64; 2]>],
        mask: &Mask,
        first: usize,
        columns: &mut [Columns],
    ) -> usize {
        let hz = part.natural()[0];
        let mut next = first + 1;
        for (i, (r, waves)) in self.problem.records.iter().zip(waves).enumerate() {
            let n = r.u.len();
            let mut whitened = |at: usize, d: &[f64]| {
                let mut w = vec![0.0; n];
                r.whiten(d, &mut w);
                columns[i].push((at, w));
            };
            let counted = !mask[i].is_empty();
            let mut of_hz = vec![0.0; n];
            for (times, [a, b]) in (1_u32..).map(f64::from).zip(waves) {
                if counted {
                    let (mut of_a, mut of_b) = (vec![0.0; n], vec![0.0; n]);
                    self.rotate(times * hz, n, |k, s, c| {
                        let time_s = k as f64 * self.problem.base.sample_s;
                        of_hz[k] -= TAU * times * time_s * (a * c - b * s);
                        (of_a[k], of_b[k]) = (-s, -c);
                    });
                    whitened(next, &of_a);
                    whitened(next + 1, &of_b);
                }
                next += 2;
            }
            if of_hz.iter().any(|d| *d != 0.0) {
                whitened(first, &of_hz);
            }
        }
        next
    }

    /// Whitened derivative columns of the innovations at a state.
    pub(crate) fn columns(&self, fit: &Fit, state: &State, mask: &Mask) -> (usize, Vec<Columns>) {
        let records = &self.problem.records;
        let counted = |i: usize| !mask[i].is_empty();
        let mut columns: Vec<Columns> = records.iter().map(|_| Vec::new()).collect();
        let mut next = 0;
        let (mut line, mut position) = (0, 0);
        for (index, part) in fit.parts.iter().enumerate() {
            match part.variant().role {
                Role::Chain => {
                    for (j, p) in part.variant().params.iter().enumerate() {
                        let (parts, step) = nudged(&fit.parts, index, j, p);
                        let moved = self.simulated(&parts, fit.offset_um, mask);
                        for (i, r) in records.iter().enumerate().filter(|(i, _)| counted(*i)) {
                            let d: Vec<f64> = moved[i]
                                .iter()
                                .zip(&state.sim[i])
                                .map(|(a, b)| (b - fit.gain * a) / step)
                                .collect();
                            let mut c = vec![0.0; d.len()];
                            r.whiten(&d, &mut c);
                            columns[i].push((next, c));
                        }
                        next += 1;
                    }
                }
                Role::Line { .. } => {
                    next = self.add_line_columns(part, &fit.lines[line], mask, next, &mut columns);
                    line += 1;
                }
                Role::Position => {
                    let pixel = part.natural()[0];
                    let [a, b] = fit.positions[position];
                    for (i, r) in records.iter().enumerate().filter(|(i, _)| counted(*i)) {
                        let n = r.u.len();
                        let walk = r.whitener.around(&state.residual[i]);
                        let mut d = [vec![0.0; n], vec![0.0; n], vec![0.0; n]];
                        for k in 0..n {
                            let angle = TAU * (state.path[i][k] + walk[k]) / pixel;
                            let (s, c) = angle.sin_cos();
                            d[0][k] = angle * (a * c - b * s);
                            d[1][k] = -s;
                            d[2][k] = -c;
                        }
                        for (j, d) in d.iter().enumerate() {
                            let mut w = vec![0.0; n];
                            r.whiten(d, &mut w);
                            if j > 0 || a != 0.0 || b != 0.0 {
                                columns[i].push((next + j, w));
                            }
                        }
                    }
                    next += 3;
                    position += 1;
                }
            }
        }
        if self.has_free_offset(&fit.parts) {
            self.add_offset_columns(fit, state, mask, next, &mut columns);
            next += 1;
        }
        // Without a direct path there is no share of the edge: the number is 0, and no column is needed.
        let (low, high) = self.problem.soft;
        for (columns, soft) in columns.iter_mut().zip(&state.soft).filter(|_| low < high) {
            columns.push((next, soft.iter().map(|s| -s).collect()));
        }
        next += 1;
        if self.free_gain {
            // The weights of the play operators contain a gain.
            if !fit.parts.iter().any(|p| p.variant().holds_gain()) {
                for ((columns, sim), r) in columns.iter_mut().zip(&state.sim).zip(records) {
                    if sim.is_empty() {
                        continue;
                    }
                    let d: Vec<f64> = sim.iter().map(|s| -s / fit.gain).collect();
                    let mut c = vec![0.0; d.len()];
                    r.whiten(&d, &mut c);
                    columns.push((next, c));
                }
            }
            next += 1;
        }
        (next, columns)
    }

    /// Adds the derivative by the working point, as number `index`.
    fn add_offset_columns(
        &self,
        fit: &Fit,
        state: &State,
        mask: &Mask,
        index: usize,
        columns: &mut [Columns],
    ) {
        let moved = self.simulated(&fit.parts, fit.offset_um + OFFSET_STEP_UM, mask);
        for (i, r) in self.problem.records.iter().enumerate() {
            if mask[i].is_empty() {
                continue;
            }
            let d: Vec<f64> = moved[i]
                .iter()
                .zip(&state.sim[i])
                .map(|(a, b)| (b - fit.gain * a) / OFFSET_STEP_UM)
                .collect();
            columns[i].push((index, r.whitened(&d)));
        }
    }
}

/// The parts with one parameter moved by its step, towards the inside of its bounds.
fn nudged(parts: &[Part], index: usize, j: usize, p: &FitParameter) -> (Vec<Part>, f64) {
    let mut parts = parts.to_vec();
    let x = parts[index].theta[j];
    let mut step = p.step
        * if p.log {
            1.0
        } else {
            (x.abs() / (50.0 * p.step)).clamp(1.0, 10.0)
        };
    parts[index].theta[j] = x + step;
    // Another of the numbers may be its bound.
    let mut within = parts[index].clone();
    within.keep_within_bounds();
    if (within.theta[j] - x) * step < (1.0 - 1e-6) * step * step {
        step = -step;
        parts[index].theta[j] = x + step;
    }
    (parts, step)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::catalogue;

    #[test]
    fn a_number_beyond_what_another_allows_comes_back_and_has_a_derivative_there() {
        let variants = catalogue::variants(&[]);
        let part = |id: &str, name: &str, values: &[f64]| {
            let of_name = |v: &&catalogue::Variant| v.id() == id && v.candidate().name == name;
            let mut part = Part::new(*variants.iter().find(of_name).unwrap(), values);
            part.keep_within_bounds();
            part
        };
        // Beyond beta; a stop above the break; the end of a range below its start.
        let cases = [
            (part("pzt-hysteresis", "bouc-wen", &[0.2, 1.5, 1.8]), 2, 1.5),
            (part("stick-slip", "", &[20.0, 30.0]), 1, 20.0),
            (part("saturation", "", &[19.0, 18.0]), 1, 19.001),
        ];
        for (part, j, bound) in cases {
            let values = part.natural();
            assert!((values[j] - bound).abs() < 1e-9 * bound, "{values:?}");
            let p = &part.variant().params[j];
            let (moved, step) = nudged(std::slice::from_ref(&part), 0, j, p);
            let moved = p.coordinate(moved[0].natural()[j]) - part.theta[j];
            assert!((moved / step - 1.0).abs() < 1e-6, "{moved} {step}");
        }
    }
}
