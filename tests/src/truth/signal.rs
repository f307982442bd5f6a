//! Signals within a step of the integrator, and what integrates them.

/// A signal in one step of the integrator: its value right after the step's start, its mean, its value at the end.
#[derive(Debug, Clone, Copy)]
pub(super) struct Through {
    pub start: f64,
    pub mean: f64,
    pub end: f64,
}

impl Through {
    pub(super) fn held(x: f64) -> Self {
        Self {
            start: x,
            mean: x,
            end: x,
        }
    }

    /// Through something without dynamics, which may remember the way it went.
    pub(super) fn map(self, mut f: impl FnMut(f64) -> f64) -> Self {
        if self.start == self.end {
            return Self::held(f(self.end));
        }
        let start = f(self.start);
        let mean = f(self.mean);
        let end = f(self.end);
        Self { start, mean, end }
    }

    pub(super) fn plus(self, factor: f64, other: Self) -> Self {
        Self {
            start: self.start + factor * other.start,
            mean: self.mean + factor * other.mean,
            end: self.end + factor * other.end,
        }
    }
}

/// A first-order lag by the implicit midpoint rule, in parts of a step that are short against its time.
pub(super) fn low_pass(z: &mut f64, x: Through, h: f64, tau: f64) -> Through {
    let start = *z;
    let parts = (20.0 * h / tau).ceil().clamp(1.0, 64.0);
    let w = 0.5 * h / (tau * parts);
    let mut sum = 0.0;
    for _ in 0..parts as usize {
        let old = *z;
        *z = (old * (1.0 - w) + 2.0 * w * x.mean) / (1.0 + w);
        sum += 0.5 * (old + *z);
    }
    Through {
        start,
        mean: sum / parts,
        end: *z,
    }
}

pub(super) fn rk4(s: [f64; 2], h: f64, f: impl Fn([f64; 2]) -> [f64; 2]) -> [f64; 2] {
    let add = |a: [f64; 2], b: [f64; 2], c: f64| [a[0] + c * b[0], a[1] + c * b[1]];
    let a = f(s);
    let b = f(add(s, a, 0.5 * h));
    let c = f(add(s, b, 0.5 * h));
    let d = f(add(s, c, h));
    [
        s[0] + h / 6.0 * (a[0] + 2.0 * b[0] + 2.0 * c[0] + d[0]),
        s[1] + h / 6.0 * (a[1] + 2.0 * b[1] + 2.0 * c[1] + d[1]),
    ]
}
