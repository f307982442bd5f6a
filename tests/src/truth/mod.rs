//! A rig that hides effects, written apart from the catalogue of `cellpos-plant`.
//!
//! Another integrator (fixed-step Runge-Kutta on Eq. (6) in controllable form, 64 steps a millisecond, where the
//! catalogue is exact), other equations where the literature offers them (Preisach relays for hysteresis, one
//! Kelvin-Voigt element per decade for creep, an internal variable for the standard linear solid), and effects that the
//! catalogue does not have. Nuisances (diffusion, localisation noise, phases) are drawn at random.

pub mod cases;
pub mod table;
pub mod threshold;

use cellpos_reconcile::Record;
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

/// Classical Preisach model: relays over the half plane up > down, weights falling off from the diagonal and, slowly, from
/// the middle of the stroke. Evaluated exactly through its Everett function and the stack of extremes that the relays
/// remember (Mayergoyz, Mathematical Models of Hysteresis, 1991, ch. 1), because a grid of relays moves in steps that no
/// piezo shows.
struct Relays {
    width_um: f64,
    span: f64,
    /// Remembered extremes, alternating minimum and maximum, the outermost first.
    extremes: Vec<f64>,
    at: f64,
    scale: f64,
}

impl Relays {
    fn new(width_um: f64) -> Self {
        let span = 6.0 * width_um;
        let mut relays = Self {
            width_um,
            span,
            extremes: vec![-span],
            at: 0.0,
            scale: 1.0,
        };
        // Far from the last reversal the displacement goes with the input: the nominal gain is that of the large stroke.
        relays.scale = 0.5 / width_um;
        // Demagnetised by an oscillation that dies out.
        for k in 0..400 {
            let a = span * (1.0 - f64::from(k) / 400.0);
            relays.extremes.push(if k % 2 == 0 { a } else { -a });
        }
        relays
    }

    /// Weight of all relays that switch between two extremes: `exp(-half width/width)` integrated over the triangle,
    /// falling off from the middle over ten widths.
    fn everett(&self, up: f64, down: f64) -> f64 {
        let (w, d) = (self.width_um, (up - down).max(0.0));
        let middle = 0.5 * (up + down) / (10.0 * w);
        (2.0 * d * w - 4.0 * w * w * (1.0 - (-0.5 * d / w).exp())) * (-middle * middle).exp()
    }

    /// Displacement after the input has gone straight to `u`.
    fn follow(&mut self, u: f64) -> f64 {
        if u != self.at {
            let rising = u > self.at;
            let last_is_minimum = self.extremes.len() % 2 == 1;
            // A reversal is remembered.
            if rising != last_is_minimum {
                self.extremes.push(self.at);
            }
            // What the input passes is wiped out, pairs of extremes at a time.
            while self.extremes.len() >= 2 {
                let before = self.extremes[self.extremes.len() - 2];
                if (rising && u >= before) || (!rising && u <= before) {
                    self.extremes.pop();
                    self.extremes.pop();
                } else {
                    break;
                }
            }
            if self.extremes.is_empty() {
                self.extremes.push(-self.span);
            }
            self.at = u;
        }
        let mut sum = -0.5 * self.everett(self.span, -self.span);
        let mut low = self.extremes[0];
        let mut k = 1;
        loop {
            let high = self.extremes.get(k).copied();
            match high {
                None => {
                    sum += self.everett(self.at.max(low), low);
                    break;
                }
                Some(high) => {
                    let next = self.extremes.get(k + 1).copied().unwrap_or(self.at);
                    sum += self.everett(high, low) - self.everett(high, next.min(high));
                    low = next;
                    if k + 1 >= self.extremes.len() {
                        break;
                    }
                    k += 2;
                }
            }
        }
        sum * self.scale
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
    let (mut before, mut bead, mut walk) = (0.0, 0.0, 0.0);
    let mut pressed: Option<(f64, f64)> = None;
    let mut past: Vec<f64> = Vec::with_capacity(n);
    path.push(0.0);
    for j in 0..n {
        let t = j as f64 * h;
        let mut x = u[j / FINE];
        for e in hidden {
            match *e {
                Hidden::Saturation(low, high) => x = x.clamp(low - 4.0, high - 4.0),
                Hidden::SlewLimit(rate) => {
                    let old = slew;
                    slew += (x - slew).clamp(-rate * h, rate * h);
                    x = 0.5 * (old + slew);
                }
                Hidden::DriverLag(hz) => {
                    // Implicit midpoint rule.
                    let w = 0.5 * TAU * hz * h;
                    let old = lag;
                    lag = (lag * (1.0 - w) + 2.0 * w * x) / (1.0 + w);
                    x = 0.5 * (old + lag);
                }
                Hidden::Preisach(part, _) => {
                    let p = match pressed {
                        Some((at, p)) if at == x => p,
                        _ => relays.first_mut().map_or(0.0, |r| r.follow(x)),
                    };
                    pressed = Some((x, p));
                    // The domains that switch add to the elastic part: the gain rises with the amplitude and the loop
                    // lags, as in every measured piezo.
                    x = (1.0 - part) * x + part * p;
                }
                Hidden::Creep(g) => {
                    // One Kelvin-Voigt element per decade from 1 ms to 1000 s.
                    let mut sum = 0.0;
                    for (i, q) in voigt.iter_mut().enumerate() {
                        let tau = 10f64.powi(i as i32 - 3);
                        let old = *q;
                        *q += (x - *q) * (1.0 - (-h / tau).exp());
                        sum += 0.5 * (old + *q);
                    }
                    // The displacement 0.1 s after a step counts as 1.
                    let at_tenth: f64 =
                        (0..7).map(|i| 1.0 - (-0.1 / 10f64.powi(i - 3)).exp()).sum();
                    x = x * (1.0 - at_tenth * g) + g * sum;
                }
                Hidden::Resonance(hz, zeta) => {
                    let w = TAU * hz;
                    let f = |r: [f64; 2]| [r[1], w * w * (x - r[0]) - 2.0 * zeta * w * r[1]];
                    let old = ring[0];
                    ring = rk4(ring, h, f);
                    x = 0.5 * (old + ring[0]);
                }
                Hidden::Backlash(width) => {
                    play = f64::clamp(play, x - 0.5 * width, x + 0.5 * width);
                    x = play;
                }
                Hidden::Relaxation(tau, strength) => {
                    let old = solid;
                    solid += (x - solid) * (1.0 - (-h / tau).exp());
                    x += strength * (x - 0.5 * (old + solid));
                }
                Hidden::Bubble(tau) => {
                    let w = 0.5 * h / tau;
                    let old = gas;
                    gas = (gas * (1.0 - w) + 2.0 * w * x) / (1.0 + w);
                    x = 0.5 * (old + gas);
                }
                Hidden::Echo(c, late) => {
                    let k = (late / h) as usize;
                    let old = if j >= k && k > 0 {
                        past.get(j - k).copied().unwrap_or(0.0)
                    } else {
                        0.0
                    };
                    past.push(x);
                    x += c * old;
                }
                _ => {}
            }
        }
        s = rk4(s, h, |s| derivative(s, x));
        let now = output(s, x);
        let mut v = (now - before) / h;
        before = now;
        let mut lost = 0.0;
        for e in hidden {
            match *e {
                Hidden::Gain(f) => v *= f,
                Hidden::GainDrift(r) => v *= 1.0 + r * t,
                Hidden::FlowDrift(d) => v += d,
                Hidden::Adhesion(limit) => v = v.signum() * (v.abs() - limit).max(0.0),
                Hidden::Leak(w) => lost += w * (bead + 0.5 * v * h),
                Hidden::Square(c) => v += c * x * x,
                Hidden::Cube(c) => v += c * x * x * x,
                Hidden::Profile(c) => v *= 1.0 + c * (TAU * bead / 20.0).sin(),
                Hidden::Spring(c) => lost += c * bead * bead * bead,
                Hidden::Breathing(c) => v *= 1.0 + c * (TAU * 0.7 * t).sin(),
                Hidden::Valve(c) => v *= if v > 0.0 { 1.0 + c } else { 1.0 - c },
                Hidden::Jumps(c) if j % (FINE * 997) == FINE * 500 => v += c / h,
                _ => {}
            }
        }
        bead += (v - lost) * h;
        walk += (2.0 * nuisance.diffusion_um2_per_s * h).sqrt() * random.normal();
        path.push(bead + walk);
    }
    camera(&path, u.len(), h, hidden, random)
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
fn camera(path: &[f64], rows: usize, h: f64, hidden: &[Hidden], random: &mut Random) -> Vec<f64> {
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
        let x = (t / h).max(0.0);
        let i = (x as usize).min(path.len() - 2);
        path[i] + (path[i + 1] - path[i]) * (x - i as f64)
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
