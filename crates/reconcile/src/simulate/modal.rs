//! A chain of linear blocks under a piecewise-constant input, exactly, as a sum of first-order modes.
//!
//! Every linear block of the chain (lag, creep, resonance, relaxation, bubble, leak, the plant) is kept as zeros, poles
//! and a gain; the product is split into partial fractions once per parameter set, after which a sample costs one
//! multiply-add per mode. That is what makes thousands of simulations of a minute of record affordable.

use cellpos_plant::Zpk;
use nalgebra::Complex;

type C = Complex<f64>;

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
                        // Keep conjugate symmetry: shift by a real amount, the conjugate meets its own twin likewise.
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
    a: C,
    b: C,
    weight: C,
    slope: C,
}

/// The same chain, discretised for one step length.
#[derive(Debug, Clone)]
pub(crate) struct Modal {
    real: Vec<[f64; 4]>,
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
    /// Adds another motion.
    pub fn add(&mut self, other: &Self) {
        let add = |a: &mut [f64], b: &[f64]| a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
        add(&mut self.pos, &other.pos);
        add(&mut self.jump, &other.jump);
        add(&mut self.start_slope, &other.start_slope);
        add(&mut self.end_slope, &other.end_slope);
    }

    /// Takes the jumps of a grid of steps for the straight line that they stand for.
    pub fn straighten(&mut self, h: f64) {
        let n = self.pos.len();
        for j in 0..n {
            let slope = match self.pos.get(j + 1) {
                Some(next) => (next - self.pos[j]) / h,
                None => 0.0,
            };
            self.jump[j] = 0.0;
            self.start_slope[j] = slope;
            self.end_slope[j] = slope;
        }
    }
}

/// Decay, drive and weight of four modes.
fn columns(four: &[[f64; 4]]) -> ([f64; 4], [f64; 4], [f64; 4]) {
    let column = |j: usize| std::array::from_fn(|i| four[i][j]);
    (column(0), column(1), column(2))
}

impl Modal {
    /// Partial fractions of a proper transfer function, held-input recursion of step `h`.
    pub fn new(zpk: &Zpk, h: f64) -> Self {
        let mut poles = zpk.poles.clone();
        separate(&mut poles);
        let proper = zpk.zeros.len() < poles.len();
        let direct = if proper { 0.0 } else { zpk.gain };
        let mut real = Vec::new();
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
            let x = p * h;
            let a = x.exp();
            let b = if x.norm() < 1e-5 {
                (C::new(1.0, 0.0) + x * 0.5) * h
            } else {
                (a - 1.0) / p
            };
            slope_direct += r.re;
            if p.im == 0.0 {
                real.push([a.re, b.re, r.re, (r * p).re]);
            } else {
                complex.push(Mode {
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

    /// Positions just before each input acts: `y_k = C x_k + D u_(k-1)`, from rest.
    pub fn run(&self, u: &[f64], y: &mut Vec<f64>) {
        y.clear();
        y.resize(u.len(), 0.0);
        if self.direct != 0.0 {
            for k in 1..u.len() {
                y[k] = self.direct * u[k - 1];
            }
        }
        // Four at a time: each waits for its own last value only.
        let mut fours = self.real.chunks_exact(4);
        for four in &mut fours {
            let (a, b, w) = columns(four);
            let mut z = [0.0; 4];
            for (y, &u) in y.iter_mut().zip(u) {
                let mut sum = 0.0;
                for i in 0..4 {
                    sum += w[i] * z[i];
                    z[i] = a[i] * z[i] + b[i] * u;
                }
                *y += sum;
            }
        }
        for &[a, b, w, _] in fours.remainder() {
            let mut z = 0.0;
            for (y, &u) in y.iter_mut().zip(u) {
                *y += w * z;
                z = a * z + b * u;
            }
        }
        for m in &self.complex {
            let mut z = C::new(0.0, 0.0);
            for (y, &u) in y.iter_mut().zip(u) {
                *y += m.weight.re * z.re - m.weight.im * z.im;
                z = m.a * z + m.b * u;
            }
        }
    }

    /// Positions with jumps and slopes, for what acts on the motion inside a step (adhesion, delay, exposure).
    pub fn trace(&self, u: &[f64], t: &mut Trace) {
        let n = u.len();
        t.pos.clear();
        t.pos.resize(n, 0.0);
        t.jump.clear();
        t.jump.reserve(n);
        let mut before = 0.0;
        for (k, &u) in u.iter().enumerate() {
            t.pos[k] = self.direct * before;
            t.jump.push(self.direct * (u - before));
            before = u;
        }
        // Slope of the modes at the start of each step, and of what would be the next.
        let mut slope = vec![0.0; n + 1];
        let mut fours = self.real.chunks_exact(4);
        for four in &mut fours {
            let (a, b, w) = columns(four);
            let s: [f64; 4] = std::array::from_fn(|i| four[i][3]);
            let mut z = [0.0; 4];
            for ((&u, y), v) in u.iter().zip(&mut t.pos).zip(&mut slope) {
                let (mut sum, mut rise) = (0.0, 0.0);
                for i in 0..4 {
                    sum += w[i] * z[i];
                    rise += s[i] * z[i];
                    z[i] = a[i] * z[i] + b[i] * u;
                }
                *y += sum;
                *v += rise;
            }
            slope[n] += (0..4).map(|i| s[i] * z[i]).sum::<f64>();
        }
        for &[a, b, w, s] in fours.remainder() {
            let mut z = 0.0;
            for ((&u, y), v) in u.iter().zip(&mut t.pos).zip(&mut slope) {
                *y += w * z;
                *v += s * z;
                z = a * z + b * u;
            }
            slope[n] += s * z;
        }
        for m in &self.complex {
            let mut z = C::new(0.0, 0.0);
            for ((&u, y), v) in u.iter().zip(&mut t.pos).zip(&mut slope) {
                *y += m.weight.re * z.re - m.weight.im * z.im;
                *v += m.slope.re * z.re - m.slope.im * z.im;
                z = m.a * z + m.b * u;
            }
            slope[n] += m.slope.re * z.re - m.slope.im * z.im;
        }
        let straight = |(u, v): (&f64, &f64)| self.slope_direct * u + v;
        t.start_slope.clear();
        t.start_slope.extend(u.iter().zip(&slope).map(straight));
        t.end_slope.clear();
        t.end_slope.extend(u.iter().zip(&slope[1..]).map(straight));
    }

    /// The mean of the output over each step, for a smooth signal that goes into a nonlinear block next.
    pub fn means(&self, u: &[f64]) -> Vec<f64> {
        let mut t = Trace::default();
        self.trace(u, &mut t);
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
