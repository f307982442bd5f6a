//! A group of adjoining linear blocks, advanced exactly for inputs that are straight lines.

use crate::effects::Piece;
use crate::modal::{Zpk, residues, separate};
use crate::phi::phi;
use nalgebra::Complex;

/// Propagator of one mode over a piece of one length.
#[derive(Debug, Clone, Copy)]
struct Step<T> {
    decay: T,
    hold: T,
    ramp: T,
    area_hold: T,
    area_ramp: T,
}

#[derive(Debug, Clone, Copy)]
struct RealMode {
    pole: f64,
    weight: f64,
    tap: f64,
}

#[derive(Debug, Clone, Copy)]
struct ComplexMode {
    pole: Complex<f64>,
    weight: Complex<f64>,
    tap: Complex<f64>,
}

/// Propagators of all modes for one length of time.
#[derive(Debug, Clone)]
struct Slot {
    h_s: f64,
    real: Vec<Step<f64>>,
    complex: Vec<Step<Complex<f64>>>,
}

/// Number of lengths with kept propagators: a sample, its pieces around delay and exposure, and sub-steps.
const SLOTS: usize = 6;

/// Modes in partial-fraction form with an output and, part of the way through, the tap of the PZT displacement.
#[derive(Debug, Clone)]
pub(crate) struct LinearGroup {
    real: Vec<RealMode>,
    complex: Vec<ComplexMode>,
    direct: f64,
    tap_direct: f64,
    weight_sum: f64,
    x: Vec<f64>,
    z: Vec<Complex<f64>>,
    slots: Vec<Slot>,
    next: usize,
    last_input: f64,
    last_slope: f64,
}

impl LinearGroup {
    /// A group from its zeros, poles and gain; `tap` is its leading part, whose output is the PZT displacement.
    pub(crate) fn new(mut whole: Zpk, tap: Option<&Zpk>) -> Self {
        separate(&mut whole.poles);
        let (direct, weights) = residues(&whole);
        let (tap_direct, tap_weights) = match tap {
            None => (0.0, Vec::new()),
            Some(tap) => residues(&Zpk {
                zeros: tap.zeros.clone(),
                // The leading poles of the whole, after coinciding poles were moved apart.
                poles: whole.poles[..tap.poles.len()].to_vec(),
                gain: tap.gain,
            }),
        };
        let (mut real, mut complex) = (Vec::new(), Vec::new());
        for (i, &pole) in whole.poles.iter().enumerate() {
            let tap = tap_weights
                .get(i)
                .copied()
                .unwrap_or(Complex::new(0.0, 0.0));
            if pole.im == 0.0 {
                real.push(RealMode {
                    pole: pole.re,
                    weight: weights[i].re,
                    tap: tap.re,
                });
            } else if pole.im > 0.0 {
                complex.push(ComplexMode {
                    pole,
                    weight: weights[i] * 2.0,
                    tap: tap * 2.0,
                });
            }
        }
        let unit = Complex::new(0.0, 0.0);
        let slot = Slot {
            h_s: -1.0,
            real: vec![
                Step {
                    decay: 0.0,
                    hold: 0.0,
                    ramp: 0.0,
                    area_hold: 0.0,
                    area_ramp: 0.0
                };
                real.len()
            ],
            complex: vec![
                Step {
                    decay: unit,
                    hold: unit,
                    ramp: unit,
                    area_hold: unit,
                    area_ramp: unit
                };
                complex.len()
            ],
        };
        Self {
            weight_sum: real.iter().map(|m| m.weight).sum::<f64>()
                + complex.iter().map(|m| m.weight.re).sum::<f64>(),
            x: vec![0.0; real.len()],
            z: vec![unit; complex.len()],
            real,
            complex,
            direct,
            tap_direct,
            slots: vec![slot; SLOTS],
            next: 0,
            last_input: 0.0,
            last_slope: 0.0,
        }
    }

    /// The fastest pole's magnitude \[rad/s\] among those with a share in the output.
    pub(crate) fn fastest(&self) -> f64 {
        let real = self.real.iter().map(|m| m.pole.abs());
        let complex = self.complex.iter().map(|m| m.pole.norm());
        real.chain(complex).fold(0.0, f64::max)
    }

    fn state_output(&self) -> f64 {
        let mut sum = 0.0;
        for (m, x) in self.real.iter().zip(&self.x) {
            sum += m.weight * x;
        }
        for (m, z) in self.complex.iter().zip(&self.z) {
            sum += m.weight.re * z.re - m.weight.im * z.im;
        }
        sum
    }

    fn state_speed(&self) -> f64 {
        let mut sum = 0.0;
        for (m, x) in self.real.iter().zip(&self.x) {
            sum += m.weight * m.pole * x;
        }
        for (m, z) in self.complex.iter().zip(&self.z) {
            sum += (m.weight * m.pole * z).re;
        }
        sum
    }

    /// Position and slope if the input jumps to this value now.
    pub(crate) fn at_input(&self, input: f64) -> (f64, f64) {
        (
            self.state_output() + self.direct * input,
            self.state_speed() + self.weight_sum * input,
        )
    }

    /// Position and slope `h_s` later if this input is held. Changes no state.
    pub(crate) fn ahead(&mut self, h_s: f64, input: f64) -> (f64, f64) {
        let index = self.slot(h_s);
        let (mut position, mut speed) = (self.direct * input, self.weight_sum * input);
        if let Some(slot) = self.slots.get(index) {
            for ((m, s), x) in self.real.iter().zip(&slot.real).zip(&self.x) {
                let x = s.decay * x + s.hold * input;
                position += m.weight * x;
                speed += m.weight * m.pole * x;
            }
            for ((m, s), z) in self.complex.iter().zip(&slot.complex).zip(&self.z) {
                let z = s.decay * z + s.hold * input;
                position += (m.weight * z).re;
                speed += (m.weight * m.pole * z).re;
            }
        }
        (position, speed)
    }

    /// The slope of the output now, um/s.
    pub(crate) fn speed(&self) -> f64 {
        self.state_speed() + self.weight_sum * self.last_input + self.direct * self.last_slope
    }

    /// The tapped signal now, um.
    pub(crate) fn tapped(&self) -> f64 {
        let mut sum = self.tap_direct * self.last_input;
        for (m, x) in self.real.iter().zip(&self.x) {
            sum += m.tap * x;
        }
        for (m, z) in self.complex.iter().zip(&self.z) {
            sum += m.tap.re * z.re - m.tap.im * z.im;
        }
        sum
    }

    /// Index of the propagators for a length, computed unless they are kept. Allocates nothing.
    fn slot(&mut self, h_s: f64) -> usize {
        if let Some(found) = self.slots.iter().position(|s| s.h_s == h_s) {
            return found;
        }
        let index = self.next;
        self.next = (self.next + 1) % SLOTS;
        if let Some(slot) = self.slots.get_mut(index) {
            slot.h_s = h_s;
            for (m, step) in self.real.iter().zip(&mut slot.real) {
                let f = phi(Complex::new(m.pole * h_s, 0.0));
                *step = Step {
                    decay: f.exp.re,
                    hold: h_s * f.one.re,
                    ramp: h_s * f.two.re,
                    area_hold: h_s * h_s * f.two.re,
                    area_ramp: h_s * h_s * f.three.re,
                };
            }
            for (m, step) in self.complex.iter().zip(&mut slot.complex) {
                let f = phi(m.pole * h_s);
                *step = Step {
                    decay: f.exp,
                    hold: f.one * h_s,
                    ramp: f.two * h_s,
                    area_hold: f.two * (h_s * h_s),
                    area_ramp: f.three * (h_s * h_s),
                };
            }
        }
        index
    }

    /// Advances over a piece. `want` says whether integral and slopes are needed.
    pub(crate) fn advance(&mut self, h_s: f64, input: Piece, want: bool) -> Piece {
        let rise = input.end - input.start;
        self.last_input = input.end;
        self.last_slope = input.speed_end;
        if h_s <= 0.0 {
            self.last_input = input.start;
            let value = self.state_output() + self.direct * input.start;
            return Piece {
                start: value,
                end: value,
                ..Piece::default()
            };
        }
        let start = self.state_output() + self.direct * input.start;
        let speed_start = if want {
            self.state_speed() + self.weight_sum * input.start + self.direct * input.speed_start
        } else {
            0.0
        };
        let index = self.slot(h_s);
        let mut integral = 0.0;
        let Some(slot) = self.slots.get(index) else {
            return Piece::default();
        };
        let modes = self.real.iter().zip(&slot.real).zip(&mut self.x);
        for ((m, s), x) in modes {
            if want {
                integral +=
                    m.weight * (s.hold * *x + s.area_hold * input.start + s.area_ramp * rise);
            }
            *x = s.decay * *x + s.hold * input.start + s.ramp * rise;
        }
        let modes = self.complex.iter().zip(&slot.complex).zip(&mut self.z);
        for ((m, s), z) in modes {
            if want {
                let area = s.hold * *z + s.area_hold * input.start + s.area_ramp * rise;
                integral += (m.weight * area).re;
            }
            *z = s.decay * *z + s.hold * input.start + s.ramp * rise;
        }
        Piece {
            start,
            end: self.state_output() + self.direct * input.end,
            integral: integral + self.direct * input.integral,
            speed_start,
            speed_end: if want { self.speed() } else { 0.0 },
        }
    }
}
