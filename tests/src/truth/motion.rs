//! From command to bead: Eq. (6) with what is hidden before and behind it.

use super::camera::camera;
use super::hidden::Hidden;
use super::noise::Nuisance;
use super::random::Random;
use super::relays::Relays;
use super::second::{Memory, Second};
use super::signal::{Through, low_pass, rk4};
use super::strangers::{Odd, Stranger, turbulence};
use std::f64::consts::TAU;

/// Steps per millisecond.
const FINE: usize = 64;

/// The rig.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Rig {
    /// A bead in a cell: Eq. (6), the command held through each row.
    Bead,
    /// An actuator with a sensor: a gain, the command an analogue signal that is sampled with the output.
    Actuator(f64),
}

impl Rig {
    /// The command in step `j`, from the middle of the range.
    fn command(self, u: &[f64], j: usize) -> Through {
        let (k, i) = (j / FINE, j % FINE);
        match self {
            Self::Bead => Through::held(u[k]),
            Self::Actuator(_) => {
                let next = u.get(k + 1).copied().unwrap_or(u[k]);
                let at = |i: usize| u[k] + (next - u[k]) * i as f64 / FINE as f64;
                let (start, end) = (at(i), at(i + 1));
                Through {
                    start,
                    mean: 0.5 * (start + end),
                    end,
                }
            }
        }
    }
}

/// What the hidden effects ahead of the plant remember.
struct Ahead {
    relays: Vec<Relays>,
    lag: f64,
    slew: f64,
    play: f64,
    solid: f64,
    gas: f64,
    voigt: [f64; 7],
    ring: [f64; 2],
    past: Vec<f64>,
    second: Memory,
    odd: Odd,
    stand: [f64; 2],
    /// What the camera's stand adds to the picture at the step's end.
    shake: f64,
}

impl Ahead {
    fn new(hidden: &[Hidden], random: &Random) -> Self {
        let relays = hidden.iter().filter_map(|h| match h {
            Hidden::Preisach(_, w) => Some(Relays::new(*w)),
            _ => None,
        });
        Self {
            relays: relays.collect(),
            lag: 0.0,
            slew: 0.0,
            play: 0.0,
            solid: 0.0,
            gas: 0.0,
            voigt: [0.0; 7],
            ring: [0.0; 2],
            past: Vec::new(),
            second: Memory::default(),
            odd: Odd::new(random.fork()),
            stand: [0.0; 2],
            shake: 0.0,
        }
    }

    /// The plant's input in step `j` of `h` seconds.
    fn step(&mut self, hidden: &[Hidden], mut x: Through, j: usize, h: f64) -> Through {
        for e in hidden {
            match *e {
                Hidden::Saturation(low, high) => x = x.map(|x| x.clamp(low - 4.0, high - 4.0)),
                Hidden::SlewLimit(rate) => {
                    let old = self.slew;
                    let way = (x.end - self.slew).clamp(-rate * h, rate * h);
                    self.slew += way;
                    // The ramp takes a part of the step, then rests.
                    x = Through {
                        start: old,
                        mean: self.slew - 0.5 * way * (way.abs() / (rate * h)),
                        end: self.slew,
                    };
                }
                Hidden::DriverLag(hz) => x = low_pass(&mut self.lag, x, h, 1.0 / (TAU * hz)),
                Hidden::Preisach(part, _) => {
                    // The domains that switch add to the elastic part: the gain rises with the amplitude and the loop
                    // lags, as in every measured piezo.
                    x = x.map(|x| {
                        let p = self.relays.first_mut().map_or(0.0, |r| r.follow(x));
                        (1.0 - part) * x + part * p
                    });
                }
                Hidden::Creep(g) => {
                    // One Kelvin-Voigt element per decade from 1 ms to 1000 s. The displacement 0.1 s after a step counts
                    // as 1.
                    let at_tenth: f64 =
                        (0..7).map(|i| 1.0 - (-0.1 / 10f64.powi(i - 3)).exp()).sum();
                    let mut y = x.map(|x| x * (1.0 - at_tenth * g));
                    for (i, q) in self.voigt.iter_mut().enumerate() {
                        let crept = low_pass(q, x, h, 10f64.powi(i as i32 - 3));
                        y = y.plus(g, crept);
                    }
                    x = y;
                }
                Hidden::Resonance(hz, zeta) => {
                    let w = TAU * hz;
                    let f = |r: [f64; 2]| [r[1], w * w * (x.mean - r[0]) - 2.0 * zeta * w * r[1]];
                    let old = self.ring;
                    self.ring = rk4(self.ring, h, f);
                    x = Through {
                        start: old[0],
                        // Two slopes and two ends make a cubic.
                        mean: 0.5 * (old[0] + self.ring[0]) + h / 12.0 * (old[1] - self.ring[1]),
                        end: self.ring[0],
                    };
                }
                Hidden::Backlash(width) => {
                    x = x.map(|x| {
                        self.play = f64::clamp(self.play, x - 0.5 * width, x + 0.5 * width);
                        self.play
                    });
                }
                Hidden::Relaxation(tau, strength) => {
                    let flow = low_pass(&mut self.solid, x, h, tau);
                    x = x.plus(strength, x).plus(-strength, flow);
                }
                Hidden::Stiffening(c) => x = x.map(|x| x + c * x * x * x),
                Hidden::Shake(hz, zeta, share) => {
                    let w = TAU * hz;
                    let f = |r: [f64; 2]| [r[1], w * w * (x.mean - r[0]) - 2.0 * zeta * w * r[1]];
                    self.stand = rk4(self.stand, h, f);
                    self.shake = share * (x.end - self.stand[0] - 2.0 * zeta * self.stand[1] / w);
                }
                Hidden::Second(Second::LooseStand(hz, zeta, share)) => {
                    self.shake = share * self.second.stand(hz, zeta, x, h);
                }
                Hidden::Second(second) => x = self.second.step(second, x, h),
                Hidden::Stranger(stranger) => x = self.odd.step(stranger, x, j / FINE, h),
                Hidden::Bubble(tau) => x = low_pass(&mut self.gas, x, h, tau),
                Hidden::Echo(c, late) => {
                    let k = (late / h) as usize;
                    let old = if j >= k && k > 0 {
                        self.past.get(j - k).copied().unwrap_or(0.0)
                    } else {
                        0.0
                    };
                    self.past.push(x.mean);
                    x = x.plus(c, Through::held(old));
                }
                _ => {}
            }
        }
        x
    }
}

/// The bead's motion in a step: what jumps, what flows, what is lost.
struct Way {
    jump: f64,
    v: f64,
    lost: f64,
}

/// What the hidden effects behind the plant make of the bead's motion in step `j`.
fn behind(
    hidden: &[Hidden],
    odd: &mut Odd,
    x: Through,
    way: Way,
    bead: f64,
    (j, h): (usize, f64),
) -> Way {
    let t = j as f64 * h;
    let Way {
        mut jump,
        mut v,
        mut lost,
    } = way;
    for e in hidden {
        match *e {
            Hidden::Gain(f) => {
                v *= f;
                jump *= f;
            }
            Hidden::GainDrift(r) => {
                v *= 1.0 + r * (t + 0.5 * h);
                jump *= 1.0 + r * t;
            }
            Hidden::FlowDrift(d) => v += d,
            Hidden::Adhesion(limit) => v = v.signum() * (v.abs() - limit).max(0.0),
            Hidden::Leak(w) => lost += w * (bead + jump + 0.5 * v * h),
            Hidden::Square(c) => v += c * x.mean * x.mean,
            Hidden::Cube(c) => v += c * x.mean * x.mean * x.mean,
            Hidden::Profile(c) => {
                let faster = 1.0 + c * (TAU * bead / 20.0).sin();
                v *= faster;
                jump *= faster;
            }
            Hidden::Spring(c) => lost += c * bead * bead * bead,
            Hidden::Swing(c, period) => {
                let swing = 1.0 + c * (TAU * t / period).sin();
                v *= swing;
                jump *= swing;
            }
            Hidden::Second(second) => {
                // A jump is not a flow: an effect that depends on speed lets it pass, or treats it as fast.
                jump *= second.gain(t, if jump == 0.0 { 0.0 } else { 1e6 * jump });
                v = v * second.gain(t, v) + second.flow(t);
                lost += second.lost(bead);
            }
            Hidden::Stranger(stranger) => (jump, v) = odd.behind(stranger, jump, v, h),
            Hidden::Valve(c) => {
                let way = |x: f64| if x > 0.0 { 1.0 + c } else { 1.0 - c };
                v *= way(v);
                jump *= way(jump);
            }
            Hidden::Jumps(c) if j % (FINE * 997) == FINE * 500 => jump += c,
            _ => {}
        }
    }
    Way { jump, v, lost }
}

/// Positions that the camera sees at every row, without localisation noise \[um\].
pub(super) fn positions(
    u: &[f64],
    rig: Rig,
    hidden: &[Hidden],
    nuisance: Nuisance,
    random: &mut Random,
) -> Vec<f64> {
    let h = 1e-3 / FINE as f64;
    let n = u.len() * FINE;
    let mut path = Vec::with_capacity(n + 1);
    let resisted = hidden.iter().find_map(|h| match h {
        Hidden::Stranger(Stranger::Turbulence(c)) => Some(*c),
        _ => None,
    });
    // Eq. (6) in controllable form.
    let derivative = |s: [f64; 2], x: f64| {
        let more = resisted.map_or(0.0, |c| turbulence(c, 76.3 * s[1]));
        [s[1], x - 76.3 * (1.0 + more) * s[1] - 0.13 * s[0]]
    };
    let output =
        |s: [f64; 2], x: f64| 0.01872 * ((20261.5 - 76.3) * s[1] + (1_745_041.0 - 0.13) * s[0] + x);
    let mut ahead = Ahead::new(hidden, random);
    let mut s = [0.0; 2];
    let (mut last, mut bead, mut walk) = (0.0, 0.0, 0.0);
    path.push([0.0; 2]);
    for j in 0..n {
        let x = ahead.step(hidden, rig.command(u, j), j, h);
        if let Rig::Actuator(gain) = rig {
            path[j][1] = gain * x.start;
            path.push([gain * x.end; 2]);
            continue;
        }
        // The instantaneous part of the direct path is a jump of the bead, separate from the flow that follows.
        let start = output(s, x.start);
        s = rk4(s, h, |s| derivative(s, x.mean));
        let end = output(s, x.end);
        let way = Way {
            jump: start - last,
            v: (end - start) / h,
            lost: 0.0,
        };
        last = end;
        let Way { jump, v, lost } = behind(hidden, &mut ahead.odd, x, way, bead, (j, h));
        bead += jump;
        path[j][1] = bead + walk + ahead.shake;
        bead += (v - lost) * h;
        walk += (2.0 * nuisance.diffusion_um2_per_s * h).sqrt() * random.normal();
        path.push([bead + walk + ahead.shake; 2]);
    }
    camera(&path, u, h, hidden, random)
}
