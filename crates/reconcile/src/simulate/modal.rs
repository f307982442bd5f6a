//! A chain of linear blocks under a piecewise-constant input, exactly, as a sum of first-order modes.
//!
//! Every linear block of the chain (lag, creep, resonance, relaxation, bubble, leak, the plant) is kept as zeros, poles and a
//! gain. The product is split into partial fractions once per parameter set; then a sample costs one multiply-add per mode. That
//! makes thousands of simulations of a minute of record affordable.

use cellpos_plant::Zpk;
use nalgebra::Complex;

pub(super) type C = Complex<f64>;

/// Whether any pole is too fast for a step for the slope to be smooth inside it.
pub(crate) fn has_fast_pole(zpk: &Zpk, step_s: f64) -> bool {
    zpk.poles.iter().any(|p| p.norm() * step_s > 0.8)
}

/// Moves poles that (nearly) coincide apart by a relative 1e-4, so that partial fractions exist.
fn separate(poles: &mut [C]) {
    for _ in 0..8 {
        let mut moved = false;
        for i in 0..poles.len() {
            for j in 0..i {
                let scale = poles[i].norm().max(poles[j].norm()).max(1e-6);
                if (poles[i] - poles[j]).norm() < 3e-5 * scale {
                    if poles[i].im == 0.0 {
                        poles[i] -= C::new(1e-4 * scale, 0.0);
                        moved = true;
                    } else if poles[i].im * poles[j].im > 0.0 {
                        // Keep conjugate symmetry: shift by a real amount; the conjugate meets its twin in the same way.
                        poles[i] -= C::new(1e-4 * scale, 0.0);
                        moved = true;
                    }
                }
            }
        }
        if !moved {
            break;
        }
    }
}

#[derive(Debug, Clone, Copy)]
struct Mode {
    p: C,
    a: C,
    b: C,
    weight: C,
    slope: C,
}

/// Four first-order modes with states scaled so that the input enters each with weight 1. Unused modes do nothing.
#[derive(Debug, Clone, Copy, Default)]
struct Four {
    /// Decay over a step.
    a: [f64; 4],
    /// Weight in the position.
    w: [f64; 4],
    /// Weight in the slope.
    s: [f64; 4],
    /// Pole \[rad/s\] and drive over a step of the state as it was before scaling.
    p: [f64; 4],
    b: [f64; 4],
}

impl Four {
    /// Position and slope that the states give, lane by lane, and on to the next step.
    #[inline(always)]
    fn step(&self, z: &mut [f64; 4], u: f64, y: &mut [f64; 4], v: &mut [f64; 4]) {
        for i in 0..4 {
            y[i] += self.w[i] * z[i];
            v[i] += self.s[i] * z[i];
            z[i] = self.a[i] * z[i] + u;
        }
    }
}

/// States that a step takes on together.
pub(super) enum Group {
    /// Decays of real modes; an input enters with weight 1.
    Eight([f64; 8]),
    Four([f64; 4]),
    /// Decay and drive of a complex mode: real part and imaginary part.
    Pair(C, C),
}

fn sum(x: [f64; 4]) -> f64 {
    (x[0] + x[1]) + (x[2] + x[3])
}

/// `(exp(p t) - 1)/p`: the response of a mode after `t` to a constant input of 1.
pub(super) fn driven(p: C, t: f64) -> C {
    let x = p * t;
    if x.norm() < 1e-5 {
        (C::new(1.0, 0.0) + x * 0.5) * t
    } else {
        (x.exp() - 1.0) / p
    }
}

/// The same chain, discretised for one step length.
#[derive(Debug, Clone)]
pub(crate) struct Modal {
    real: Vec<Four>,
    complex: Vec<Mode>,
    /// Direct path of a biproper chain.
    pub direct: f64,
    /// Slope per unit input right after a step of the input.
    slope_direct: f64,
}

/// Positions and slopes on a grid. `pos[j]` is taken just before the input of step j acts.
#[derive(Debug, Clone, Default)]
pub(crate) struct Trace {
    pub pos: Vec<f64>,
    pub jump: Vec<f64>,
    pub start_slope: Vec<f64>,
    pub end_slope: Vec<f64>,
}

impl Trace {
    /// Empty, with room for this number of steps.
    fn clear(&mut self, steps: usize) {
        for part in [
            &mut self.pos,
            &mut self.jump,
            &mut self.start_slope,
            &mut self.end_slope,
        ] {
            part.clear();
            part.reserve(steps);
        }
    }

    /// Adds another motion times a factor.
    pub(super) fn add(&mut self, other: &Self, factor: f64) {
        let add =
            |a: &mut [f64], b: &[f64]| a.iter_mut().zip(b).for_each(|(a, b)| *a += factor * b);
        add(&mut self.pos, &other.pos);
        add(&mut self.jump, &other.jump);
        add(&mut self.start_slope, &other.start_slope);
        add(&mut self.end_slope, &other.end_slope);
    }

    /// Takes the jumps of a grid of steps for the smooth line that they stand for: cubics whose slopes are those of the neighbours.
    pub(super) fn smooth(&mut self, h: f64) {
        let n = self.pos.len();
        let at = |k: usize| {
            self.pos
                .get(k.min(n.saturating_sub(1)))
                .copied()
                .unwrap_or(0.0)
        };
        let slopes: Vec<f64> = (0..=n)
            .map(|j| 0.5 * (at(j + 1) - at(j.saturating_sub(1))) / h)
            .collect();
        self.jump.fill(0.0);
        self.start_slope.copy_from_slice(&slopes[..n]);
        self.end_slope.copy_from_slice(&slopes[1..]);
    }
}

impl Modal {
    /// Partial fractions of a proper transfer function, held-input recursion of step `h`.
    pub(super) fn new(zpk: &Zpk, h: f64) -> Self {
        let mut poles = zpk.poles.clone();
        separate(&mut poles);
        let proper = zpk.zeros.len() < poles.len();
        let direct = if proper { 0.0 } else { zpk.gain };
        let mut real = Vec::new();
        let mut lane = 4;
        let mut complex = Vec::new();
        let mut slope_direct = 0.0;
        for (i, &p) in poles.iter().enumerate() {
            if p.im < 0.0 {
                continue;
            }
            let mut r = zpk
                .zeros
                .iter()
                .fold(C::new(zpk.gain, 0.0), |a, z| a * (p - z));
            for (j, q) in poles.iter().enumerate() {
                if j != i {
                    r /= p - q;
                }
            }
            if p.im > 0.0 {
                r *= 2.0;
            }
            let a = (p * h).exp();
            let b = driven(p, h);
            slope_direct += r.re;
            if p.im == 0.0 {
                if lane == 4 {
                    real.push(Four::default());
                    lane = 0;
                }
                if let Some(four) = real.last_mut() {
                    four.a[lane] = a.re;
                    four.w[lane] = r.re * b.re;
                    four.s[lane] = (r * p).re * b.re;
                    four.p[lane] = p.re;
                    four.b[lane] = b.re;
                    lane += 1;
                }
            } else {
                complex.push(Mode {
                    p,
                    a,
                    b,
                    weight: r,
                    slope: r * p,
                });
            }
        }
        Self {
            real,
            complex,
            direct,
            slope_direct,
        }
    }

    /// The states that a step takes on together, in order.
    pub(super) fn groups(&self) -> impl Iterator<Item = Group> {
        let (twos, one) = self.real.as_chunks::<2>();
        let both = |[one, other]: &[Four; 2]| {
            let mut a = [0.0; 8];
            a[..4].copy_from_slice(&one.a);
            a[4..].copy_from_slice(&other.a);
            Group::Eight(a)
        };
        let real = twos.iter().map(both);
        let real = real.chain(one.iter().map(|four| Group::Four(four.a)));
        real.chain(self.complex.iter().map(|m| Group::Pair(m.a, m.b)))
    }

    pub(super) fn states(&self) -> usize {
        4 * self.real.len() + 2 * self.complex.len()
    }

    /// Adds the weights of the states in something that is linear in the motion, from what that sees of a mode with a pole.
    pub(super) fn add_state_weights(&self, seen: impl Fn(C) -> C, weights: &mut [f64]) {
        let (of_real, of_complex) = weights.split_at_mut(4 * self.real.len());
        for (four, weights) in self.real.iter().zip(of_real.chunks_exact_mut(4)) {
            for (i, weight) in weights
                .iter_mut()
                .enumerate()
                .filter(|(i, _)| four.b[*i] != 0.0)
            {
                *weight += four.w[i] * seen(C::new(four.p[i], 0.0)).re;
            }
        }
        for (m, weights) in self.complex.iter().zip(of_complex.chunks_exact_mut(2)) {
            let w = m.weight * seen(m.p);
            weights[0] += w.re;
            weights[1] -= w.im;
        }
    }

    /// Sum over the modes of what is seen of each times its residue.
    pub(super) fn residues(&self, seen: impl Fn(C) -> C) -> f64 {
        let lanes = self
            .real
            .iter()
            .flat_map(|four| (0..4).map(move |i| (four, i)));
        let used = lanes.filter(|(four, i)| four.b[*i] != 0.0);
        let real = used.map(|(four, i)| four.w[i] / four.b[i] * seen(C::new(four.p[i], 0.0)).re);
        let complex = self.complex.iter().map(|m| (m.weight * seen(m.p)).re);
        real.sum::<f64>() + complex.sum::<f64>()
    }

    /// Positions with jumps and slopes, for what acts on the motion inside a step (adhesion, delay, exposure).
    ///
    /// A sample has `fine` steps. If the input is constant over the sample, the modes advance by whole samples.
    pub(super) fn trace(&self, u: &[f64], fine: usize, t: &mut Trace) {
        t.clear(u.len());
        let before = std::iter::once(&0.0).chain(u);
        let jumps = u.iter().zip(before).map(|(u, before)| u - before);
        t.jump.extend(jumps.map(|step| self.direct * step));
        let last = match fine {
            4 => self.held::<4, 8>(u, t),
            10 => self.held::<10, 20>(u, t),
            _ => self.steps(u, t),
        };
        // The slope at the end of a step is that at the start of the next, without the immediate effect of the next input.
        let next = t.start_slope.iter().zip(u).skip(1).zip(u);
        let change =
            |((slope, after), u): ((&f64, &f64), &f64)| slope + self.slope_direct * (u - after);
        t.end_slope.extend(next.map(change));
        if let Some(u) = u.last() {
            t.end_slope.push(last + self.slope_direct * u);
        }
        if !self.complex.is_empty() {
            self.add_complex(u, t);
        }
    }

    /// Position and slopes of the real modes and of the direct path, `FINE` steps at once; `BOTH` is twice that. Returns the slope that the
    /// real modes give at the end.
    fn held<const FINE: usize, const BOTH: usize>(&self, u: &[f64], t: &mut Trace) -> f64 {
        // What a state at the start of a sample, and an input of 1 over it, give at each of its steps: position, then slope.
        let mut of_state = vec![[[0.0; BOTH]; 4]; self.real.len()];
        let mut of_input = [0.0; BOTH];
        let mut far = self.real.clone();
        for ((four, tables), far) in self.real.iter().zip(&mut of_state).zip(&mut far) {
            for (i, table) in tables.iter_mut().enumerate() {
                let (mut decay, mut drive) = (1.0, 0.0);
                for k in 0..FINE {
                    table[k] = four.w[i] * decay;
                    table[FINE + k] = four.s[i] * decay;
                    of_input[k] += four.w[i] * drive;
                    of_input[FINE + k] += four.s[i] * drive;
                    drive = four.a[i] * drive + 1.0;
                    decay *= four.a[i];
                }
                far.a[i] = decay;
                far.b[i] = drive;
            }
        }
        let mut states = vec![[0.0; 4]; self.real.len()];
        let mut before = 0.0;
        for piece in u.chunks(FINE) {
            let first = piece[0];
            if piece.len() == FINE && piece.iter().all(|u| *u == first) {
                let mut out = of_input.map(|x| x * first);
                for ((tables, far), z) in of_state.iter().zip(&far).zip(&mut states) {
                    for (i, (table, z)) in tables.iter().zip(z).enumerate() {
                        for (out, x) in out.iter_mut().zip(table) {
                            *out += x * *z;
                        }
                        *z = far.a[i] * *z + far.b[i] * first;
                    }
                }
                let straight = self.slope_direct * first;
                out[0] += self.direct * before;
                out[1..FINE]
                    .iter_mut()
                    .for_each(|y| *y += self.direct * first);
                t.pos.extend_from_slice(&out[..FINE]);
                t.start_slope
                    .extend(out[FINE..].iter().map(|v| v + straight));
                before = first;
                continue;
            }
            for &u in piece {
                let (pos, slope) = self.step(&mut states, u, before);
                t.pos.push(pos);
                t.start_slope.push(slope);
                before = u;
            }
        }
        self.slope_of(&states)
    }

    /// The same, one step at a time.
    fn steps(&self, u: &[f64], t: &mut Trace) -> f64 {
        let mut states = vec![[0.0; 4]; self.real.len()];
        let mut before = 0.0;
        t.pos.resize(u.len(), 0.0);
        t.start_slope.resize(u.len(), 0.0);
        for ((&u, pos), slope) in u.iter().zip(&mut t.pos).zip(&mut t.start_slope) {
            (*pos, *slope) = self.step(&mut states, u, before);
            before = u;
        }
        self.slope_of(&states)
    }

    /// Position and slope of the real modes and of the direct path at the start of a step, and the states on to the next.
    #[inline(always)]
    fn step(&self, states: &mut [[f64; 4]], u: f64, before: f64) -> (f64, f64) {
        let (mut y, mut v) = ([0.0; 4], [0.0; 4]);
        for (four, z) in self.real.iter().zip(states) {
            four.step(z, u, &mut y, &mut v);
        }
        (
            self.direct * before + sum(y),
            self.slope_direct * u + sum(v),
        )
    }

    /// Slope that the real modes give.
    fn slope_of(&self, states: &[[f64; 4]]) -> f64 {
        let of = |(four, z): (&Four, &[f64; 4])| (0..4).map(|i| four.s[i] * z[i]).sum::<f64>();
        self.real.iter().zip(states).map(of).sum()
    }

    fn add_complex(&self, u: &[f64], t: &mut Trace) {
        for m in &self.complex {
            let mut z = C::new(0.0, 0.0);
            let rows = t.pos.iter_mut().zip(&mut t.start_slope);
            for ((&u, (y, v)), end) in u.iter().zip(rows).zip(&mut t.end_slope) {
                *y += m.weight.re * z.re - m.weight.im * z.im;
                *v += m.slope.re * z.re - m.slope.im * z.im;
                z = m.a * z + m.b * u;
                *end += m.slope.re * z.re - m.slope.im * z.im;
            }
        }
    }

    /// The mean of the output over each step, for a smooth signal that goes into a nonlinear block next.
    pub(super) fn means(&self, u: &[f64]) -> Vec<f64> {
        let mut t = Trace::default();
        self.trace(u, 1, &mut t);
        let n = u.len();
        (0..n)
            .map(|j| {
                let start = t.pos[j] + t.jump[j];
                let end = if j + 1 < n { t.pos[j + 1] } else { start };
                0.5 * (start + end)
            })
            .collect()
    }
}
