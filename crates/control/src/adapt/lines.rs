//! Lines (a pump, the mains) that are taken out of every series before the regression.
//!
//! A line is answered by the loop and cannot be told from motion that a gain made. Taken out of the fixes and of the model's
//! motion by one and the same narrow notch it leaves the gain as it is: what is lost is two hertz in five hundred. The notch follows
//! the line's frequency.

use super::window::MEMBERS;
use std::f64::consts::PI;

/// Lines at once.
pub(super) const LINES: usize = 4;
/// Fixes, motions of the model for each delay, and the drift taken off.
pub(super) const SERIES: usize = MEMBERS + 2;
/// Width of a notch: part of an error that is taken up in a tick, and the most of it over the frequency.
const PART: f64 = 0.0126;
const PART_OF_RAD: f64 = 0.25;
/// Ticks in which a notch that is new finds its line.
pub(super) const SETTLING_TICKS: u16 = 300;
/// A line is gone where the notch has held no more than so many times what noise leaves in it, for so many ticks.
const GONE: f64 = 5.0;
const GONE_TICKS: f64 = 1000.0;

/// A notch for all series.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Notch {
    rad: f64,
    /// Cosine and sine of it.
    turn: [f64; 2],
    ticks: f64,
    /// The line in each series: its value now and a quarter turn later.
    held: [[f64; 2]; SERIES],
    /// Mean square of the line in what is left, um^2.
    strength_um2: f64,
}

/// The notches in force.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Lines {
    notches: [Option<Notch>; LINES],
}

impl Notch {
    fn new(rad: f64) -> Self {
        let (sin, cos) = rad.sin_cos();
        Self {
            rad,
            turn: [cos, sin],
            ticks: 0.0,
            held: [[0.0; 2]; SERIES],
            strength_um2: 0.0,
        }
    }

    fn part(&self) -> f64 {
        let last = PART.min(PART_OF_RAD * self.rad);
        last.max(2.0 / (self.ticks + 8.0))
    }

    /// Takes the line out of the series.
    fn step(&mut self, values: &mut [f64; SERIES], gain: f64, member: usize) {
        self.ticks += 1.0;
        let ([cos, sin], part) = (self.turn, self.part());
        let mut drift = [0.0; 2];
        for (k, (value, held)) in values.iter_mut().zip(&mut self.held).enumerate() {
            let (re, im) = (cos * held[0] - sin * held[1], sin * held[0] + cos * held[1]);
            let error = *value - re;
            *held = [re + part * error, im];
            *value = error;
            // Of two series the one with more of the line tells its frequency.
            let size = re * re + im * im;
            if (k == 0 || k == member + 1) && size > drift[1] {
                drift = [-part * error * im / size, size];
            }
        }
        if self.ticks > 20.0 {
            let to = (self.rad + 0.125 * part * drift[0].clamp(-0.1, 0.1)).clamp(1e-3, PI - 1e-3);
            self.rad = to;
            let (sin, cos) = to.sin_cos();
            self.turn = [cos, sin];
        }
        let (y, p) = (self.held[0], self.held[member + 1]);
        let left = [y[0] - gain * p[0], y[1] - gain * p[1]];
        let size = left[0] * left[0] + left[1] * left[1];
        self.strength_um2 += (size - self.strength_um2) / self.ticks.min(GONE_TICKS);
    }

    /// A tick in which nothing is seen.
    fn coast(&mut self) {
        let [cos, sin] = self.turn;
        for held in &mut self.held {
            *held = [cos * held[0] - sin * held[1], sin * held[0] + cos * held[1]];
        }
    }

    fn is_gone(&self, noise_um2: f64) -> bool {
        self.ticks > 2.0 * GONE_TICKS && self.strength_um2 < GONE * self.part() * noise_um2
    }
}

impl Lines {
    pub const NONE: Self = Self {
        notches: [None; LINES],
    };

    /// How many there are.
    pub fn count(&self) -> usize {
        self.notches.iter().flatten().count()
    }

    /// One more, at a frequency in rad a sample. `false` where there is no room.
    pub fn take_out(&mut self, rad: f64) -> bool {
        let Some(place) = self.notches.iter_mut().find(|n| n.is_none()) else {
            return false;
        };
        *place = Some(Notch::new(rad));
        true
    }

    /// A tick in which nothing is seen.
    pub fn coast(&mut self) {
        self.notches.iter_mut().flatten().for_each(Notch::coast);
    }

    /// Takes all lines out of the series; `gain` and `member` are those in force, `noise_um2` what is left without lines.
    pub fn step(&mut self, values: &mut [f64; SERIES], gain: f64, member: usize, noise_um2: f64) {
        for place in &mut self.notches {
            let Some(notch) = place else { continue };
            notch.step(values, gain, member);
            if notch.is_gone(noise_um2) {
                *place = None;
            }
        }
    }
}
