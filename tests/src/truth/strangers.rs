//! Effects of a memory or a chance of their own: some of the catalogue, and those that no equation of it fits.

use super::random::Random;
use super::signal::{Through, low_pass, rk4};
use std::f64::consts::TAU;

/// A stranger, in addition to those of [`Hidden`](super::Hidden).
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Stranger {
    /// A bead stuck until the flow is faster than the first speed, free until it is slower than the second \[um/s\].
    StickSlip(f64, f64),
    /// A flow that wanders: an Ornstein-Uhlenbeck process of this RMS \[um/s\] and time \[s\].
    FlowWander(f64, f64),
    /// A pump: a line with a second harmonic. Hz, um, part of the harmonic.
    Pulsation(f64, f64, f64),
    /// Every frame late by another time, up to this one \[s\].
    FrameJitter(f64),
    /// A driver that answers nothing below this command \[um\], either way from rest.
    DeadZone(f64),
    /// Outflow that resists more the faster it is: by this part at 1 um of command, growing with the square.
    Turbulence(f64),
    /// A picture whose scale grows with the square of the distance from its middle \[1/um^2\].
    CurvedLens(f64),
    /// A driver faster upward than downward. Hz upward, ratio.
    UnequalLag(f64, f64),
    /// A line that the piezo does not answer to. Hz, depth.
    Notch(f64, f64),
    /// A gain that changes at random times between 1 and this much more; mean time \[s\].
    Telegraph(f64, f64),
    /// A part of the command seen in the picture \[um per um\].
    Crosstalk(f64),
    /// Frames stamped early and late by a sine of this size \[s\], period \[s\].
    ClockWander(f64, f64),
    /// A gain that follows the command's own mean over a while. 1/um, s.
    Volterra(f64, f64),
    /// Rows whose command is not carried out. Rate.
    MissedCommands(f64),
}

impl Stranger {
    /// Those of the catalogue, at sizes about the middle of what matters.
    pub const KNOWN: [Self; 5] = [
        Self::StickSlip(30.0, 8.0),
        Self::FlowWander(6.0, 1.5),
        Self::Pulsation(5.3, 0.4, 0.3),
        Self::FrameJitter(0.0005),
        Self::CurvedLens(1e-4),
    ];

    /// The others, likewise.
    pub const FOREIGN: [Self; 9] = [
        Self::DeadZone(0.12),
        Self::Turbulence(0.05),
        Self::UnequalLag(300.0, 2.0),
        Self::Notch(70.0, 0.6),
        Self::Telegraph(0.12, 3.0),
        Self::Crosstalk(0.02),
        Self::ClockWander(0.0006, 4.0),
        Self::Volterra(0.15, 0.1),
        Self::MissedCommands(0.01),
    ];

    /// The id of the vocabulary, or `outside`.
    pub fn id(self) -> &'static str {
        match self {
            Self::StickSlip(..) => "stick-slip",
            Self::FlowWander(..) => "flow-wander",
            Self::Pulsation(..) => "pump-pulsation",
            Self::FrameJitter(_) => "frame-jitter",
            Self::CurvedLens(_) => "lens-distortion",
            _ => "outside",
        }
    }

    /// Parameters whose equation is that of the catalogue.
    pub fn parameters(self) -> Vec<(&'static str, f64)> {
        match self {
            Self::StickSlip(start, stop) => {
                vec![("break_um_per_s", start), ("stop_um_per_s", stop)]
            }
            Self::FlowWander(rms, time) => vec![("um_per_s", rms), ("time_s", time)],
            Self::Pulsation(hz, um, second) => vec![("hz", hz), ("um", um), ("second", second)],
            Self::FrameJitter(up_to) => vec![("up_to_s", up_to)],
            Self::CurvedLens(c) => vec![("per_um2", c)],
            _ => Vec::new(),
        }
    }

    /// The same kind, its size times a factor.
    pub fn times(self, f: f64) -> Self {
        match self {
            Self::StickSlip(a, b) => Self::StickSlip(a * f, b * f),
            Self::FlowWander(v, t) => Self::FlowWander(v * f, t),
            Self::Pulsation(hz, um, second) => Self::Pulsation(hz * f, um * f, second),
            Self::FrameJitter(s) => Self::FrameJitter(s * f),
            Self::DeadZone(um) => Self::DeadZone(um * f),
            Self::Turbulence(c) => Self::Turbulence(c * f),
            Self::CurvedLens(c) => Self::CurvedLens(c * f),
            Self::UnequalLag(hz, ratio) => Self::UnequalLag(hz / f, ratio),
            Self::Notch(hz, depth) => Self::Notch(hz * f, depth),
            Self::Telegraph(c, s) => Self::Telegraph(c * f, s),
            Self::Crosstalk(c) => Self::Crosstalk(c * f),
            Self::ClockWander(s, period) => Self::ClockWander(s * f, period),
            Self::Volterra(c, s) => Self::Volterra(c * f, s),
            Self::MissedCommands(p) => Self::MissedCommands(p * f),
        }
    }
}

/// Memory and random numbers of strangers.
#[derive(Debug)]
pub(super) struct Odd {
    random: Random,
    stuck: bool,
    wander: f64,
    lag: f64,
    mean: f64,
    notch: [f64; 2],
    high: bool,
    held: f64,
    row: usize,
}

impl Odd {
    pub(super) fn new(random: Random) -> Self {
        Self {
            random,
            stuck: true,
            wander: 0.0,
            lag: 0.0,
            mean: 0.0,
            notch: [0.0; 2],
            high: false,
            held: 0.0,
            row: usize::MAX,
        }
    }

    /// What leaves a stranger ahead of the plant in a step of row `row`.
    pub(super) fn step(&mut self, stranger: Stranger, x: Through, row: usize, h: f64) -> Through {
        match stranger {
            Stranger::DeadZone(c) => x.map(|x| x - x.clamp(-c, c)),
            Stranger::UnequalLag(hz, ratio) => {
                let slower = if x.mean < self.lag { ratio } else { 1.0 };
                low_pass(&mut self.lag, x, h, slower / (TAU * hz))
            }
            Stranger::Notch(hz, depth) => {
                let w = TAU * hz;
                let old = self.notch;
                // The removed band: damping 0.3.
                let f = |r: [f64; 2]| [r[1], w * w * (x.mean - r[0]) - 0.6 * w * r[1]];
                self.notch = rk4(old, h, f);
                let band = |r: [f64; 2]| 0.6 * r[1] / w;
                let taken = Through {
                    start: band(old),
                    mean: 0.5 * (band(old) + band(self.notch)),
                    end: band(self.notch),
                };
                x.plus(-depth, taken)
            }
            Stranger::Volterra(c, tau) => {
                let slow = low_pass(&mut self.mean, x, h, tau);
                x.map(|x| x * (1.0 + c * slow.mean))
            }
            Stranger::MissedCommands(p) => {
                if row != self.row {
                    self.row = row;
                    if row == 0 || self.random.uniform() >= p {
                        self.held = x.end;
                    }
                }
                Through::held(self.held)
            }
            _ => x,
        }
    }

    /// The bead's jump and speed behind a stranger.
    pub(super) fn behind(&mut self, stranger: Stranger, jump: f64, v: f64, h: f64) -> (f64, f64) {
        match stranger {
            Stranger::StickSlip(start, stop) => {
                self.stuck = v.abs() < if self.stuck { start } else { stop };
                (jump, if self.stuck { 0.0 } else { v })
            }
            Stranger::FlowWander(rms, time) => {
                let keep = (-h / time).exp();
                let fresh = (1.0 - keep * keep).sqrt() * self.random.normal();
                self.wander = keep * self.wander + rms * fresh;
                (jump, v + self.wander)
            }
            Stranger::Telegraph(c, time) => {
                if self.random.uniform() < h / time {
                    self.high = !self.high;
                }
                let gain = if self.high { 1.0 + c } else { 1.0 };
                (gain * jump, gain * v)
            }
            _ => (jump, v),
        }
    }
}

/// Resistance to the plant's outflow beyond the part proportional to speed, relative to that part.
pub(super) fn turbulence(c: f64, outflow: f64) -> f64 {
    c * outflow * outflow
}
