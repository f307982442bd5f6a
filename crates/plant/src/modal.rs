//! Partial-fraction (modal) form: every pole is separate, so that poles many decades apart do not disturb one another.

use crate::transfer::TransferFunction;
use nalgebra::Complex;

/// Zeros, poles \[rad/s\] and gain: `gain prod(s - z) / prod(s - p)`. Complex roots are present with their conjugates.
#[derive(Debug, Clone, PartialEq)]
pub struct Zpk {
    /// Zeros, rad/s.
    pub zeros: Vec<Complex<f64>>,
    /// Poles, rad/s.
    pub poles: Vec<Complex<f64>>,
    /// Leading coefficient.
    pub gain: f64,
}

fn real(x: f64) -> Complex<f64> {
    Complex::new(x, 0.0)
}

impl Zpk {
    /// The factor 1.
    pub fn one() -> Self {
        Self {
            zeros: Vec::new(),
            poles: Vec::new(),
            gain: 1.0,
        }
    }

    /// Of a transfer function.
    pub fn of(g: &TransferFunction) -> Self {
        Self {
            zeros: g.zeros(),
            poles: g.poles(),
            gain: g.num()[0] / g.den()[0],
        }
    }

    /// First-order low-pass `w / (s + w)`.
    pub fn low_pass(w: f64) -> Self {
        Self {
            zeros: Vec::new(),
            poles: vec![real(-w)],
            gain: w,
        }
    }

    /// First-order high-pass `s / (s + w)`.
    pub fn high_pass(w: f64) -> Self {
        Self {
            zeros: vec![real(0.0)],
            poles: vec![real(-w)],
            gain: 1.0,
        }
    }

    /// Second-order low-pass `w^2 / (s^2 + 2 zeta w s + w^2)` of a frequency in Hz and a damping ratio.
    pub fn resonance(frequency_hz: f64, damping: f64) -> Self {
        let w = std::f64::consts::TAU * frequency_hz;
        let poles = if damping < 1.0 {
            let im = w * (1.0 - damping * damping).sqrt();
            vec![
                Complex::new(-damping * w, im),
                Complex::new(-damping * w, -im),
            ]
        } else {
            let fast = -w * (damping + (damping * damping - 1.0).sqrt());
            vec![real(fast), real(w * w / fast)]
        };
        Self {
            zeros: Vec::new(),
            poles,
            gain: w * w,
        }
    }

    /// `(1 + (1 + strength) time s) / (1 + time s)`.
    pub fn relaxation(time_s: f64, strength: f64) -> Self {
        Self {
            zeros: vec![real(-1.0 / (time_s * (1.0 + strength)))],
            poles: vec![real(-1.0 / time_s)],
            gain: 1.0 + strength,
        }
    }

    /// The product of two.
    pub fn series(mut self, other: &Self) -> Self {
        self.zeros.extend_from_slice(&other.zeros);
        self.poles.extend_from_slice(&other.poles);
        self.gain *= other.gain;
        self
    }

    /// Value at a complex frequency, rad/s.
    pub fn at(&self, s: Complex<f64>) -> Complex<f64> {
        // Factors are taken alternately so that neither product overflows.
        let mut value = Complex::new(self.gain, 0.0);
        let n = self.zeros.len().max(self.poles.len());
        for i in 0..n {
            if let Some(z) = self.zeros.get(i) {
                value *= s - z;
            }
            if let Some(p) = self.poles.get(i) {
                value /= s - p;
            }
        }
        value
    }
}

/// Poles closer together than this part of their size are moved apart symmetrically. The error of the response is about
/// the square of this part; the residues of a closer pair would lose as many digits as the pair is close.
const SPLIT: f64 = 3e-5;
/// Poles slower than this \[rad/s\] (four months) count as zero in the test of how close they are.
const SLOWEST: f64 = 1e-7;

/// Moves coinciding poles apart, conjugate pairs alike, keeping their mean.
pub(crate) fn separate(poles: &mut [Complex<f64>]) {
    let n = poles.len();
    let mut order: Vec<usize> = (0..n).filter(|&i| poles[i].im >= 0.0).collect();
    order.sort_by(|&i, &j| {
        poles[i]
            .re
            .total_cmp(&poles[j].re)
            .then(poles[i].im.total_cmp(&poles[j].im))
    });
    let mut used = vec![false; n];
    for k in 0..order.len() {
        let first = order[k];
        if used[first] {
            continue;
        }
        let scale = poles[first].norm().max(SLOWEST);
        let cluster: Vec<usize> = order[k..]
            .iter()
            .copied()
            .filter(|&j| !used[j] && (poles[j] - poles[first]).norm() < SPLIT * scale)
            .collect();
        for &j in &cluster {
            used[j] = true;
        }
        if cluster.len() < 2 {
            continue;
        }
        let mean: Complex<f64> =
            cluster.iter().map(|&j| poles[j]).sum::<Complex<f64>>() / cluster.len() as f64;
        // Three or more poles lose digits with the square of their distance, so they are moved further apart.
        let distance = if cluster.len() > 2 {
            10.0 * SPLIT
        } else {
            SPLIT
        };
        for (m, &j) in cluster.iter().enumerate() {
            let old = poles[j];
            let shift = distance * scale * (m as f64 - 0.5 * (cluster.len() - 1) as f64);
            let new = mean + shift;
            if old.im > 0.0
                && let Some(partner) = poles.iter().position(|p| *p == old.conj())
            {
                poles[partner] = new.conj();
            }
            poles[j] = new;
        }
    }
}

/// `d + sum r_i / (s - p_i)`: the residues of a function whose poles are distinct, in the order of its poles.
pub(crate) fn residues(g: &Zpk) -> (f64, Vec<Complex<f64>>) {
    let d = if g.zeros.len() == g.poles.len() {
        g.gain
    } else {
        0.0
    };
    let residues = (0..g.poles.len())
        .map(|i| {
            let p = g.poles[i];
            let mut others = g.poles.clone();
            others.remove(i);
            Zpk {
                zeros: g.zeros.clone(),
                poles: others,
                gain: g.gain,
            }
            .at(p)
        })
        .collect();
    (d, residues)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn partial_fractions_give_back_eq_6() {
        let g = TransferFunction::eq6();
        let zpk = Zpk::of(&g);
        let (d, r) = residues(&zpk);
        for f in [0.001, 0.1, 2.0, 20.0, 300.0, 5000.0] {
            let s = Complex::new(0.0, std::f64::consts::TAU * f);
            let sum: Complex<f64> = zpk
                .poles
                .iter()
                .zip(&r)
                .map(|(p, r)| r / (s - p))
                .sum::<Complex<f64>>()
                + d;
            assert!((sum - g.at(s)).norm() < 1e-11 * g.at(s).norm());
        }
    }

    #[test]
    fn a_triple_pole_keeps_its_response_to_a_millionth() {
        let exact = TransferFunction::new(vec![1.0], vec![1.0, 30.0, 300.0, 1000.0]).unwrap();
        let mut zpk = Zpk {
            zeros: vec![],
            poles: vec![Complex::new(-10.0, 0.0); 3],
            gain: 1.0,
        };
        separate(&mut zpk.poles);
        let (d, r) = residues(&zpk);
        assert_eq!(d, 0.0);
        for w in [0.1, 10.0, 100.0] {
            let s = Complex::new(0.0, w);
            let sum: Complex<f64> = zpk.poles.iter().zip(&r).map(|(p, r)| r / (s - p)).sum();
            assert!((sum - exact.at(s)).norm() < 1e-6 * exact.at(s).norm());
        }
    }
}
