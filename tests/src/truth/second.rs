//! Second equations of the catalogue's effects: as others write them, or as a part that is not ideal behaves.

use super::signal::{Through, low_pass, rk4};
use std::f64::consts::TAU;

/// An effect of the vocabulary in another equation than that of [`Hidden`](super::Hidden) and of the catalogue. Numbers have the
/// same meaning.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Second {
    /// A resistor before a piezo whose capacitance rises by 5 % per um. Hz.
    CapacitiveLag(f64),
    /// A current limit that sets in gently: the rate is the limit times tanh. um/s.
    GentleSlew(f64),
    /// Clipping with a knee of 0.15 um. um.
    SoftClip(f64, f64),
    /// Coleman and Hodgdon's equation, `dh = a |dx| (x - h) + b dx`. Part that it gives.
    Duhem(f64),
    /// Creep as a power law of time, exponent 0.1. Per decade at 0.1 s.
    PowerCreep(f64),
    /// A resonance whose damping grows with speed, as in a fluid. Hz, damping at rest.
    DraggedResonance(f64, f64),
    /// Play between flanks that give way before they hold. um.
    RoundedPlay(f64),
    /// Three Maxwell branches a factor of four apart, as of a polymer. s, strength.
    SpreadRelaxation(f64, f64),
    /// A gas that is stiffer compressed than expanded, 5 % per um. s.
    GasSpring(f64),
    /// A leak whose flow rises faster than the displacement, relative per 100 um. rad/s.
    OrificeLeak(f64),
    /// The picture's scale instead of the flow's. Factor.
    Magnification(f64),
    /// A gain that rises or falls exponentially. 1/s.
    ExponentialDrift(f64),
    /// Adhesion that creeps below its threshold: `v - v0 tanh(v/v0)`. um/s.
    CreepingAdhesion(f64),
    /// A flow whose reservoir drains with a time of 100 s. um/s.
    DrainingFlow(f64),
    /// A delay that differs by up to 20 us from frame to frame. s.
    UnsteadyDelay(f64),
    /// A shutter that opens and closes through a fifth of the exposure. s.
    ShutterRamps(f64),
    /// A clock that is corrected ten times a second, wrongly. ppm.
    SteppedSkew(f64),
    /// Missing frames in bursts of four. Rate.
    DropBursts(f64),
    /// A frame delivered again, two times in a row. Rate.
    RepeatBursts(f64),
    /// Pixels with a second harmonic of a fifth. um, part.
    UnevenPixels(f64, f64),
    /// Mains with a third harmonic of 15 %. Hz, um.
    RichHum(f64, f64),
    /// A stiffness that grows as a hyperbolic sine; its cubic term is the number. 1/um^2.
    Sinh(f64),
    /// A gain that rises and falls linearly. Depth, s.
    StraightSwing(f64, f64),
    /// A valve that opens with the flow, half way at 20 um/s. Part.
    OpeningValve(f64),
    /// A stand that shakes with a damping that grows with speed. Hz, damping at rest, share.
    LooseStand(f64, f64, f64),
}

impl Second {
    /// The id of the vocabulary.
    pub fn id(&self) -> &'static str {
        match self {
            Self::CapacitiveLag(_) => "driver-lag",
            Self::GentleSlew(_) => "slew-limit",
            Self::SoftClip(..) => "saturation",
            Self::Duhem(_) => "pzt-hysteresis",
            Self::PowerCreep(_) => "pzt-creep",
            Self::DraggedResonance(..) => "pzt-resonance",
            Self::RoundedPlay(_) => "backlash",
            Self::SpreadRelaxation(..) => "pdms-relaxation",
            Self::GasSpring(_) => "bubble",
            Self::OrificeLeak(_) => "leak",
            Self::Magnification(_) => "gain-error",
            Self::ExponentialDrift(_) => "gain-drift",
            Self::CreepingAdhesion(_) => "wall-adhesion",
            Self::DrainingFlow(_) => "flow-drift",
            Self::UnsteadyDelay(_) => "time-delay",
            Self::ShutterRamps(_) => "exposure-averaging",
            Self::SteppedSkew(_) => "clock-skew",
            Self::DropBursts(_) => "frame-drops",
            Self::RepeatBursts(_) => "frame-repeats",
            Self::UnevenPixels(..) => "pixel-locking",
            Self::RichHum(..) => "mains-hum",
            Self::Sinh(_) => "stiffening",
            Self::StraightSwing(..) => "gain-swing",
            Self::OpeningValve(_) => "valve-asymmetry",
            Self::LooseStand(..) => "camera-shake",
        }
    }

    /// Numbers that mean the same in both equations.
    pub fn parameters(&self) -> Vec<(&'static str, f64)> {
        match *self {
            Self::Magnification(f) => vec![("factor", f)],
            Self::UnsteadyDelay(d) => vec![("delay_s", d)],
            Self::RichHum(hz, um) => vec![("hz", hz), ("um", um)],
            _ => Vec::new(),
        }
    }

    /// Factor of the bead's motion at a time and a speed.
    pub(super) fn gain(&self, t: f64, v: f64) -> f64 {
        match *self {
            Self::ExponentialDrift(r) => (r * t).exp(),
            Self::StraightSwing(depth, period) => {
                let p = (t / period + 0.25).fract();
                1.0 + depth * (1.0 - 4.0 * (p - 0.5).abs())
            }
            Self::OpeningValve(c) => 1.0 + c * (v / 20.0).tanh(),
            Self::CreepingAdhesion(limit) if v != 0.0 => 1.0 - limit * (v / limit).tanh() / v,
            _ => 1.0,
        }
    }

    /// What is added to the bead's speed at a time.
    pub(super) fn flow(&self, t: f64) -> f64 {
        match *self {
            Self::DrainingFlow(v) => v * (-t / 100.0).exp(),
            _ => 0.0,
        }
    }

    /// What a displaced bead loses per second.
    pub(super) fn lost(&self, bead: f64) -> f64 {
        match *self {
            Self::OrificeLeak(w) => w * bead * (1.0 + bead.abs() / 100.0),
            _ => 0.0,
        }
    }
}

/// The flanks of a play begin to take up the way at this part of the half width.
const FLANK: f64 = 0.7;

/// What the second equations remember.
#[derive(Debug, Default)]
pub(super) struct Memory {
    lag: f64,
    slew: f64,
    loop_input: f64,
    loop_lag: f64,
    voigt: [f64; 13],
    ring: [f64; 2],
    play_input: f64,
    play: f64,
    branches: [f64; 3],
    gas: f64,
    stand: [f64; 2],
}

impl Memory {
    /// What leaves an effect ahead of the plant in a step of `h` seconds.
    pub(super) fn step(&mut self, effect: Second, x: Through, h: f64) -> Through {
        match effect {
            Second::CapacitiveLag(hz) => {
                let tau = (1.0 + 0.05 * self.lag) / (TAU * hz);
                low_pass(&mut self.lag, x, h, tau)
            }
            Second::GentleSlew(rate) => {
                // 50 us to the target where nothing limits.
                let (old, reach) = (self.slew, rate * 50e-6);
                for _ in 0..4 {
                    self.slew += 0.25 * h * rate * ((x.end - self.slew) / reach).tanh();
                }
                Through {
                    start: old,
                    mean: 0.5 * (old + self.slew),
                    end: self.slew,
                }
            }
            Second::SoftClip(low, high) => x.map(|x| soft_clip(x, low - 4.0, high - 4.0)),
            Second::Duhem(part) => x.map(|x| (1.0 - part) * x + part * self.duhem(x)),
            Second::PowerCreep(g) => self.power_creep(g, x, h),
            Second::DraggedResonance(hz, zeta) => {
                let old = self.ring;
                self.ring = dragged(old, TAU * hz, zeta, x.mean, h);
                Through {
                    start: old[0],
                    mean: 0.5 * (old[0] + self.ring[0]) + h / 12.0 * (old[1] - self.ring[1]),
                    end: self.ring[0],
                }
            }
            Second::RoundedPlay(width) => x.map(|x| self.rounded_play(x, 0.5 * width)),
            Second::SpreadRelaxation(tau, strength) => {
                let mut y = x.plus(strength, x);
                for ((q, part), apart) in self
                    .branches
                    .iter_mut()
                    .zip([0.25, 0.5, 0.25])
                    .zip([0.25, 1.0, 4.0])
                {
                    let flow = low_pass(q, x, h, tau * apart);
                    y = y.plus(-strength * part, flow);
                }
                y
            }
            Second::GasSpring(tau) => {
                let tau = tau / (1.0 + 0.05 * self.gas).max(0.2);
                low_pass(&mut self.gas, x, h, tau)
            }
            Second::Sinh(c) => {
                let k = (6.0 * c).sqrt();
                x.map(|x| (k * x).sinh() / k)
            }
            _ => x,
        }
    }

    /// What a loose stand adds to the picture.
    pub(super) fn stand(&mut self, hz: f64, zeta: f64, x: Through, h: f64) -> f64 {
        let w = TAU * hz;
        self.stand = dragged(self.stand, w, zeta, x.mean, h);
        let [at, speed] = self.stand;
        x.end - at - 2.0 * zeta * drag(speed, w) * speed / w
    }

    /// Exact along a straight way: the lag behind the input tends to `(1 - b)/a` in the direction of motion.
    fn duhem(&mut self, x: f64) -> f64 {
        let (a, b) = (1.5, 0.1);
        let dx = x - self.loop_input;
        let far = dx.signum() * (1.0 - b) / a;
        if dx != 0.0 {
            self.loop_lag = far + (self.loop_lag - far) * (-a * dx.abs()).exp();
        }
        self.loop_input = x;
        x - self.loop_lag
    }

    /// Two Kelvin-Voigt elements a decade from 1 ms to 1000 s; the displacement 0.1 s after a step counts as 1.
    fn power_creep(&mut self, g: f64, x: Through, h: f64) -> Through {
        let tau = |i: usize| 10f64.powf(0.5 * i as f64 - 3.0);
        let weight = |i: usize| 0.5 * g * (tau(i) / 0.1).powf(0.1);
        let at_tenth: f64 = (0..self.voigt.len())
            .map(|i| weight(i) * (1.0 - (-0.1 / tau(i)).exp()))
            .sum();
        let mut y = x.map(|x| x * (1.0 - at_tenth));
        for (i, q) in self.voigt.iter_mut().enumerate() {
            y = y.plus(weight(i), low_pass(q, x, h, tau(i)));
        }
        y
    }

    fn rounded_play(&mut self, x: f64, half: f64) -> f64 {
        let way = x - self.play;
        let dx = x - self.play_input;
        let parts = (20.0 * dx.abs() / half).ceil().clamp(1.0, 400.0);
        let (mut gap, step) = (way - dx, dx / parts);
        if dx != 0.0 {
            for _ in 0..parts as usize {
                gap += step;
                let pushed = (gap * step.signum() / half - FLANK) / (1.0 - FLANK);
                gap -= step * pushed.clamp(0.0, 1.0);
            }
        }
        self.play_input = x;
        self.play = x - gap;
        self.play
    }
}

/// Damping of a mass in a fluid over that at rest: it doubles at 2 um of amplitude.
fn drag(speed: f64, w: f64) -> f64 {
    1.0 + speed.abs() / (2.0 * w)
}

/// One step of a mass on a spring in a fluid.
fn dragged(s: [f64; 2], w: f64, zeta: f64, x: f64, h: f64) -> [f64; 2] {
    rk4(s, h, |r| {
        let damping = 2.0 * zeta * drag(r[1], w);
        [r[1], w * w * (x - r[0]) - damping * w * r[1]]
    })
}

/// Clipping with knees: straight lines joined by the primitive of a tanh.
fn soft_clip(x: f64, low: f64, high: f64) -> f64 {
    let knee = 0.15;
    // ln(1 + e^z) without overflow.
    let soft = |z: f64| {
        if z > 30.0 { z } else { z.exp().ln_1p() }
    };
    x - knee * soft((x - high) / knee) + knee * soft((low - x) / knee)
}
