//! A rig that hides effects, written apart from the catalogue of `cellpos-plant`.
//!
//! Another integrator (fixed-step Runge-Kutta on Eq. (6) in controllable form, 64 steps a millisecond, the jumps of its
//! direct path apart from the flow, where the catalogue is exact), other equations where the literature offers them (Preisach relays for hysteresis, one
//! Kelvin-Voigt element per decade for creep, an internal variable for the standard linear solid), and effects that the
//! catalogue does not have. Nuisances (diffusion, localisation noise, phases) are drawn at random.

pub mod cases;
mod relays;
pub mod table;
pub mod threshold;

use cellpos_reconcile::Record;
use relays::Relays;
use std::f64::consts::TAU;

/// Steps per millisecond.
const FINE: usize = 64;

/// xorshift64* with Box-Muller: small, seeded, the project's own.
#[derive(Debug, Clone)]
pub struct Random(u64);

impl Random {
    /// A generator of a seed.
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1)
    }

    /// Uniform in 0..1.
    pub fn uniform(&mut self) -> f64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Standard normal.
    pub fn normal(&mut self) -> f64 {
        let (a, b) = (self.uniform().max(1e-300), self.uniform());
        (-2.0 * a.ln()).sqrt() * (TAU * b).cos()
    }
}

/// A hidden effect, in this simulator's own equations.
#[derive(Debug, Clone, Copy, PartialEq)]
#[allow(missing_docs)]
pub enum Hidden {
    DriverLag(f64),
    SlewLimit(f64),
    Saturation(f64, f64),
    /// Part that switching domains give (lost at small amplitude), mean half width of the relays \[um\].
    Preisach(f64, f64),
    Creep(f64),
    Resonance(f64, f64),
    Backlash(f64),
    Relaxation(f64, f64),
    Bubble(f64),
    Leak(f64),
    Gain(f64),
    GainDrift(f64),
    Adhesion(f64),
    FlowDrift(f64),
    Delay(f64),
    Exposure(f64),
    ClockSkew(f64),
    Drops(f64),
    Repeats(f64),
    PixelLocking(f64, f64),
    Hum(f64, f64),
    // Not in the catalogue:
    /// Velocity += c d^2.
    Square(f64),
    /// Velocity += c d^3.
    Cube(f64),
    /// A line away from the mains, Hz and um.
    Line(f64, f64),
    /// Velocity gain depends on position: 1 + c sin(2 pi y / 20 um).
    Profile(f64),
    /// A force back to the start, c y + k y^3.
    Spring(f64),
    /// A second path arriving late: x(t) + c x(t - lag).
    Echo(f64, f64),
    /// Gain swings in time: 1 + c sin(2 pi 0.7 t).
    Breathing(f64),
    /// Motion down the channel is faster than up.
    Valve(f64),
    /// The camera's image is curved: y + c y^2.
    Distortion(f64),
    /// Flow noise in steps: the bead jumps by c um, once a second.
    Jumps(f64),
}

impl Hidden {
    /// Parameters whose equation is that of the catalogue.
    pub fn parameters(&self) -> Vec<(&'static str, f64)> {
        match *self {
            Self::DriverLag(hz) => vec![("bandwidth_hz", hz)],
            Self::SlewLimit(rate) => vec![("rate_um_per_s", rate)],
            Self::Saturation(low, high) => vec![("low_um", low), ("high_um", high)],
            Self::Resonance(hz, zeta) => vec![("frequency_hz", hz), ("damping", zeta)],
            Self::Backlash(width) => vec![("width_um", width)],
            Self::Relaxation(tau, strength) => vec![("time_s", tau), ("strength", strength)],
            Self::Bubble(tau) => vec![("lag_s", tau)],
            Self::Leak(w) => vec![("corner_rad_per_s", w)],
            Self::Gain(f) => vec![("factor", f)],
            Self::GainDrift(r) => vec![("per_s", r)],
            Self::Adhesion(v) => vec![("speed_um_per_s", v)],
            Self::FlowDrift(v) => vec![("um_per_s", v)],
            Self::Delay(d) => vec![("delay_s", d)],
            Self::Exposure(e) => vec![("exposure_s", e)],
            Self::ClockSkew(ppm) => vec![("ppm", ppm)],
            Self::Drops(p) | Self::Repeats(p) => vec![("rate", p)],
            Self::PixelLocking(pixel, b) => vec![("pixel_um", pixel), ("amplitude", b)],
            Self::Hum(hz, um) => vec![("hz", hz), ("um", um)],
            _ => Vec::new(),
        }
    }

    /// The id of the vocabulary, or `outside`.
    pub fn id(&self) -> &'static str {
        match self {
            Self::DriverLag(_) => "driver-lag",
            Self::SlewLimit(_) => "slew-limit",
            Self::Saturation(..) => "saturation",
            Self::Preisach(..) => "pzt-hysteresis",
            Self::Creep(_) => "pzt-creep",
            Self::Resonance(..) => "pzt-resonance",
            Self::Backlash(_) => "backlash",
            Self::Relaxation(..) => "pdms-relaxation",
            Self::Bubble(_) => "bubble",
            Self::Leak(_) => "leak",
            Self::Gain(_) => "gain-error",
            Self::GainDrift(_) => "gain-drift",
            Self::Adhesion(_) => "wall-adhesion",
            Self::FlowDrift(_) => "flow-drift",
            Self::Delay(_) => "time-delay",
            Self::Exposure(_) => "exposure-averaging",
            Self::ClockSkew(_) => "clock-skew",
            Self::Drops(_) => "frame-drops",
            Self::Repeats(_) => "frame-repeats",
            Self::PixelLocking(..) => "pixel-locking",
            Self::Hum(..) => "mains-hum",
            Self::Cube(_) => "stiffening",
            Self::Breathing(_) => "gain-swing",
            Self::Valve(_) => "valve-asymmetry",
            _ => "outside",
        }
    }
}

/// Commands of one record \[um\], about 4 um.
#[derive(Debug, Clone)]
pub struct Script {
    /// Name of the record.
    pub name: &'static str,
    /// Command per millisecond.
    pub pzt_um: Vec<f64>,
}

/// The set of records of a session: sines, two multisines, steps, triangle, rest.
pub fn scripts(random: &mut Random) -> Vec<Script> {
    let mut sines = Vec::new();
    for hz in [
        2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 120.0, 150.0, 200.0, 300.0,
    ] {
        let rows = ((1.5f64 * hz).ceil() / hz * 1000.0) as usize;
        sines.extend((0..rows).map(|k| 4.0 + 0.8 * (TAU * hz * k as f64 * 1e-3).sin()));
    }
    let mut multisine = |rms: f64| {
        let lines: Vec<(f64, f64)> = (1..=600)
            .map(|i| (0.5 * f64::from(i), TAU * random.uniform()))
            .collect();
        let a = rms * (2.0 / lines.len() as f64).sqrt();
        let period: Vec<f64> = (0..2000)
            .map(|k| {
                4.0 + lines
                    .iter()
                    .map(|(f, p)| a * (TAU * f * f64::from(k) * 1e-3 + p).sin())
                    .sum::<f64>()
            })
            .collect();
        (0..16000).map(|k| period[k % 2000]).collect::<Vec<f64>>()
    };
    let (small, large) = (multisine(0.25), multisine(1.0));
    let levels: Vec<f64> = (0..20)
        .map(|i| {
            if i % 2 == 0 {
                0.0
            } else {
                0.025 * (f64::from(i % 7) - 3.0)
            }
        })
        .collect();
    let steps = (0..16000).map(|k| 4.0 + levels[k / 800]).collect();
    let triangle = (0..12000)
        .map(|k| {
            let p = f64::from(k) * 4e-3 % 1.0;
            4.0 + 1.5
                * (if p < 0.25 {
                    4.0 * p
                } else if p < 0.75 {
                    2.0 - 4.0 * p
                } else {
                    4.0 * p - 4.0
                })
        })
        .collect();
    vec![
        Script {
            name: "sines",
            pzt_um: sines,
        },
        Script {
            name: "multisine-small",
            pzt_um: small,
        },
        Script {
            name: "multisine-large",
            pzt_um: large,
        },
        Script {
            name: "steps",
            pzt_um: steps,
        },
        Script {
            name: "triangle",
            pzt_um: triangle,
        },
        Script {
            name: "rest",
            pzt_um: vec![4.0; 10000],
        },
    ]
}

/// Noise of a session.
#[derive(Debug, Clone, Copy)]
pub struct Nuisance {
    /// Diffusion coefficient \[um^2/s\]; 0 for a noise-free run.
    pub diffusion_um2_per_s: f64,
    /// Localisation noise \[um\].
    pub localisation_um: f64,
}

/// Runs one record. Rows whose frame is dropped are left out of the record, as cameras do.
pub fn run(script: &Script, hidden: &[Hidden], nuisance: Nuisance, random: &mut Random) -> Record {
    let u: Vec<f64> = script.pzt_um.iter().map(|p| p - 4.0).collect();
    let seen = positions(&u, hidden, nuisance, random);
    let (mut time, mut pzt, mut bead) = (Vec::new(), Vec::new(), Vec::new());
    let mut last = f64::NAN;
    for (k, y) in seen.iter().enumerate() {
        let mut y = *y + nuisance.localisation_um * random.normal();
        let mut dropped = false;
        for h in hidden {
            match *h {
                Hidden::Repeats(p) if random.uniform() < p && last.is_finite() => y = last,
                Hidden::Drops(p) => dropped = random.uniform() < p,
                _ => {}
            }
        }
        last = y;
        time.push(k as f64 * 1e-3);
        pzt.push(script.pzt_um[k]);
        bead.push(if dropped {
            f64::NAN
        } else {
            (y * 1e4).round() / 1e4
        });
    }
    match Record::from_rows(script.name, &time, &pzt, &bead) {
        Ok(r) => r,
        Err(e) => panic!("the simulator made a record that cannot be read: {e}"),
    }
}

/// Positions that the camera sees at every row, without localisation noise \[um\].
fn positions(u: &[f64], hidden: &[Hidden], nuisance: Nuisance, random: &mut Random) -> Vec<f64> {
    let h = 1e-3 / FINE as f64;
    let n = u.len() * FINE;
    let mut path = Vec::with_capacity(n + 1);
    // Eq. (6) in controllable form.
    let derivative = |s: [f64; 2], x: f64| [s[1], x - 76.3 * s[1] - 0.13 * s[0]];
    let output =
        |s: [f64; 2], x: f64| 0.01872 * ((20261.5 - 76.3) * s[1] + (1_745_041.0 - 0.13) * s[0] + x);
    let mut relays: Vec<Relays> = hidden
        .iter()
        .filter_map(|h| {
            if let Hidden::Preisach(_, w) = h {
                Some(Relays::new(*w))
            } else {
                None
            }
        })
        .collect();
    let (mut s, mut lag, mut slew, mut play, mut solid, mut gas) =
        ([0.0; 2], 0.0, 0.0, 0.0, 0.0, 0.0);
    let mut voigt = [0.0f64; 7];
    let mut ring = [0.0f64; 2];
    let (mut last, mut bead, mut walk) = (0.0, 0.0, 0.0);
    let mut past: Vec<f64> = Vec::with_capacity(n);
    path.push([0.0; 2]);
    for j in 0..n {
        let t = j as f64 * h;
        let mut x = Through::held(u[j / FINE]);
        for e in hidden {
            match *e {
                Hidden::Saturation(low, high) => x = x.map(|x| x.clamp(low - 4.0, high - 4.0)),
                Hidden::SlewLimit(rate) => {
                    let old = slew;
                    let way = (x.end - slew).clamp(-rate * h, rate * h);
                    slew += way;
                    // The ramp takes a part of the step, then rests.
                    x = Through {
                        start: old,
                        mean: slew - 0.5 * way * (way.abs() / (rate * h)),
                        end: slew,
                    };
                }
                Hidden::DriverLag(hz) => x = low_pass(&mut lag, x, h, 1.0 / (TAU * hz)),
                Hidden::Preisach(part, _) => {
                    // The domains that switch add to the elastic part: the gain rises with the amplitude and the loop
                    // lags, as in every measured piezo.
                    x = x.map(|x| {
                        let p = relays.first_mut().map_or(0.0, |r| r.follow(x));
                        (1.0 - part) * x + part * p
                    });
                }
                Hidden::Creep(g) => {
                    // One Kelvin-Voigt element per decade from 1 ms to 1000 s. The displacement 0.1 s after a step counts
                    // as 1.
                    let at_tenth: f64 =
                        (0..7).map(|i| 1.0 - (-0.1 / 10f64.powi(i - 3)).exp()).sum();
                    let mut y = x.map(|x| x * (1.0 - at_tenth * g));
                    for (i, q) in voigt.iter_mut().enumerate() {
                        let crept = low_pass(q, x, h, 10f64.powi(i as i32 - 3));
                        y = y.plus(g, crept);
                    }
                    x = y;
                }
                Hidden::Resonance(hz, zeta) => {
                    let w = TAU * hz;
                    let f = |r: [f64; 2]| [r[1], w * w * (x.mean - r[0]) - 2.0 * zeta * w * r[1]];
                    let old = ring;
                    ring = rk4(ring, h, f);
                    x = Through {
                        start: old[0],
                        // Two slopes and two ends make a cubic.
                        mean: 0.5 * (old[0] + ring[0]) + h / 12.0 * (old[1] - ring[1]),
                        end: ring[0],
                    };
                }
                Hidden::Backlash(width) => {
                    x = x.map(|x| {
                        play = f64::clamp(play, x - 0.5 * width, x + 0.5 * width);
                        play
                    });
                }
                Hidden::Relaxation(tau, strength) => {
                    let flow = low_pass(&mut solid, x, h, tau);
                    x = x.plus(strength, x).plus(-strength, flow);
                }
                Hidden::Bubble(tau) => x = low_pass(&mut gas, x, h, tau),
                Hidden::Echo(c, late) => {
                    let k = (late / h) as usize;
                    let old = if j >= k && k > 0 {
                        past.get(j - k).copied().unwrap_or(0.0)
                    } else {
                        0.0
                    };
                    past.push(x.mean);
                    x = x.plus(c, Through::held(old));
                }
                _ => {}
            }
        }
        // What the direct path does at once is a jump of the bead, apart from the flow that follows.
        let start = output(s, x.start);
        s = rk4(s, h, |s| derivative(s, x.mean));
        let end = output(s, x.end);
        let mut jump = start - last;
        let mut v = (end - start) / h;
        last = end;
        let mut lost = 0.0;
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
                Hidden::Breathing(c) => {
                    let swing = 1.0 + c * (TAU * 0.7 * t).sin();
                    v *= swing;
                    jump *= swing;
                }
                Hidden::Valve(c) => {
                    let way = |x: f64| if x > 0.0 { 1.0 + c } else { 1.0 - c };
                    v *= way(v);
                    jump *= way(jump);
                }
                Hidden::Jumps(c) if j % (FINE * 997) == FINE * 500 => jump += c,
                _ => {}
            }
        }
        bead += jump;
        path[j][1] = bead + walk;
        bead += (v - lost) * h;
        walk += (2.0 * nuisance.diffusion_um2_per_s * h).sqrt() * random.normal();
        path.push([bead + walk; 2]);
    }
    camera(&path, u.len(), h, hidden, random)
}

/// A signal in one step of the integrator: its value right after the step's start, its mean, its value at the end.
#[derive(Debug, Clone, Copy)]
struct Through {
    start: f64,
    mean: f64,
    end: f64,
}

impl Through {
    fn held(x: f64) -> Self {
        Self {
            start: x,
            mean: x,
            end: x,
        }
    }

    /// Through something without dynamics, which may remember the way it went.
    fn map(self, mut f: impl FnMut(f64) -> f64) -> Self {
        if self.start == self.end {
            return Self::held(f(self.end));
        }
        let start = f(self.start);
        let mean = f(self.mean);
        let end = f(self.end);
        Self { start, mean, end }
    }

    fn plus(self, factor: f64, other: Self) -> Self {
        Self {
            start: self.start + factor * other.start,
            mean: self.mean + factor * other.mean,
            end: self.end + factor * other.end,
        }
    }
}

/// A first-order lag by the implicit midpoint rule, in parts of a step that are short against its time.
fn low_pass(z: &mut f64, x: Through, h: f64, tau: f64) -> Through {
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

fn rk4(s: [f64; 2], h: f64, f: impl Fn([f64; 2]) -> [f64; 2]) -> [f64; 2] {
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

/// What the frames show of a fine path.
///
/// `path[i]` holds the position right before and right after time i h.
fn camera(
    path: &[[f64; 2]],
    rows: usize,
    h: f64,
    hidden: &[Hidden],
    random: &mut Random,
) -> Vec<f64> {
    let (mut delay, mut exposure, mut skew) = (0.0, 0.0, 0.0);
    let phase = TAU * random.uniform();
    for e in hidden {
        match *e {
            Hidden::Delay(d) => delay = d,
            Hidden::Exposure(e) => exposure = e,
            Hidden::ClockSkew(ppm) => skew = 1e-6 * ppm,
            _ => {}
        }
    }
    let at = |t: f64| {
        // Limits from the left: a command that acts at the very instant is not seen yet.
        let x = (t / h).max(0.0);
        let i = ((x - 1e-6).ceil() - 1.0)
            .max(0.0)
            .min(path.len() as f64 - 2.0) as usize;
        if x <= 1e-6 {
            return path[0][0];
        }
        path[i][1] + (path[i + 1][0] - path[i][1]) * (x - i as f64)
    };
    (0..rows)
        .map(|k| {
            let t = k as f64 * 1e-3 * (1.0 + skew) - delay;
            let mut y = if exposure > 0.0 {
                let n = 64;
                (0..n)
                    .map(|i| at(t - exposure * (f64::from(i) + 0.5) / f64::from(n)))
                    .sum::<f64>()
                    / f64::from(n)
            } else {
                at(t)
            };
            for e in hidden {
                match *e {
                    Hidden::Hum(hz, um) | Hidden::Line(hz, um) => {
                        y += um * (TAU * hz * k as f64 * 1e-3 + phase).sin()
                    }
                    Hidden::PixelLocking(p, b) => y += b * p * (TAU * y / p).sin(),
                    Hidden::Distortion(c) => y += c * y * y,
                    _ => {}
                }
            }
            y
        })
        .collect()
}
