//! A rig in a closed loop whose zero flow moves, simulated apart from the catalogue: Eq. (6) by Euler steps of 50 us.

use cellpos_numeric::Random;
use cellpos_plant::{Effect, Model, Noise};
use cellpos_reconcile::{Options, Reconciliation, Record, reconcile};
use std::f64::consts::TAU;

const STEPS_A_ROW: usize = 20;
const ROW_S: f64 = 1e-3;
const ROWS: usize = 38_000;
pub(super) const DELAY_S: f64 = 2.3e-3;
pub(super) const WORKING_POINT_UM: f64 = 20.0;

/// How the zero flow moves: size \[um\] and time \[s\] of its wandering, and its drift \[um/s\].
#[derive(Clone, Copy)]
pub(super) struct Flow {
    pub(super) wander_um: f64,
    pub(super) time_s: f64,
    pub(super) drift_um_per_s: f64,
}

/// What lies between command and bead beside the delay.
#[derive(Debug, Clone, Copy)]
pub(super) enum Hidden {
    Nothing,
    Gain(f64),
    /// Corner \[rad/s\].
    Leak(f64),
    /// The same, with the zero flow ahead of it.
    LeakAfterFlow(f64),
    /// Ends of the range \[um\].
    Clip(f64, f64),
    /// Share of the stroke, by Dahl's equation, and the motion after which it has turned \[um\].
    Dahl(f64, f64),
    /// Share of the stroke, in three play operators of 50 nm, 0.3 um and 1.5 um.
    Plays(f64),
    /// Corner \[Hz\].
    Lag(f64),
    /// Frequency \[Hz\] and damping.
    Resonance(f64, f64),
    /// Strength, and time \[s\].
    Relaxation(f64, f64),
    /// Part of a step that comes late, by eight exponentials of 10 ms to 30 s, per decade.
    Creep(f64),
    /// The same with shares `exp(-onset/time)`: the logarithm of one and the time in onsets \[s\].
    LateCreep(f64, f64),
    /// Creep by a power of time; its share after a second, and the exponent.
    PowerCreep(f64, f64),
    /// Relaxation in three times a factor of four apart: strength, and the time of the middle one \[s\].
    SpreadRelaxation(f64, f64),
    /// Speed below which the bead sticks \[um/s\].
    Adhesion(f64),
    /// Most speed of the amplifier \[um/s\].
    Slew(f64),
    /// Share of the frames that are lost.
    Drops(f64),
    /// Share of the frames that come twice, in the place of the next.
    Repeats(f64),
    /// Displacement about rest that moves nothing \[um\].
    DeadZone(f64),
    /// Play \[um\].
    Play(f64),
    /// Cubic part \[1/um^2\].
    Stiffening(f64),
    /// Part that goes with the square, of the sign of the displacement \[1/um\].
    Progressive(f64),
    /// Frequency \[Hz\], damping and share of a stand that the piezo shakes.
    Shake(f64, f64, f64),
    /// Change of the gain \[1/s\].
    GainDrift(f64),
    /// Frequency \[Hz\] and size \[um\] of a line in the picture.
    Line(f64, f64),
    /// Strokes that move the zero flow: Hz, and the size of the first of four multiples \[um\], the others less by their number.
    Pump(f64, f64),
    /// Each frame is late by another time, at most this \[s\].
    Jitter(f64),
}

impl Hidden {
    /// The id that is right, and the numbers that mean the same as the catalogue's.
    pub(super) fn truth(self) -> (&'static str, Vec<(&'static str, f64)>) {
        match self {
            Self::Nothing => ("", vec![]),
            Self::Gain(f) => ("gain-error", vec![("factor", f)]),
            Self::Leak(w) | Self::LeakAfterFlow(w) => ("leak", vec![("corner_rad_per_s", w)]),
            Self::Clip(low, high) => ("saturation", vec![("low_um", low), ("high_um", high)]),
            Self::Dahl(share, _) => ("pzt-hysteresis", vec![("fraction", share)]),
            Self::Plays(_) => ("pzt-hysteresis", vec![]),
            Self::Lag(hz) => ("driver-lag", vec![("bandwidth_hz", hz)]),
            Self::Resonance(hz, d) => ("pzt-resonance", vec![("frequency_hz", hz), ("damping", d)]),
            // `1 - s/(1 + T s)` is `(1 + (1 + k) T s)/(1 + T s)` over `1 + k`, where `1 - s` is `1/(1 + k)`.
            Self::Relaxation(s, time_s) => (
                "pdms-relaxation",
                vec![("strength", s / (1.0 - s)), ("time_s", time_s)],
            ),
            Self::Creep(per_decade) => ("pzt-creep", vec![("per_decade", per_decade)]),
            Self::LateCreep(per_decade, _) => ("pzt-creep", vec![("per_decade", per_decade)]),
            Self::PowerCreep(..) => ("pzt-creep", vec![]),
            Self::SpreadRelaxation(..) => ("pdms-relaxation", vec![]),
            Self::Adhesion(v) => ("wall-adhesion", vec![("speed_um_per_s", v)]),
            Self::DeadZone(_) => ("wall-adhesion", vec![]),
            Self::Slew(rate) => ("slew-limit", vec![("rate_um_per_s", rate)]),
            Self::Drops(rate) => ("frame-drops", vec![("rate", rate)]),
            Self::Repeats(rate) => ("frame-repeats", vec![("rate", rate)]),
            Self::Play(width) => ("backlash", vec![("width_um", width)]),
            Self::Stiffening(c) => ("stiffening", vec![("per_um2", c)]),
            Self::Progressive(c) => ("stiffening", vec![("per_um", c)]),
            Self::Shake(hz, d, share) => (
                "camera-shake",
                vec![("frequency_hz", hz), ("damping", d), ("share", share)],
            ),
            Self::GainDrift(r) => ("gain-drift", vec![("per_s", r)]),
            Self::Line(hz, um) => ("mains-hum", vec![("hz", hz), ("um", um)]),
            Self::Pump(hz, _) => ("pump-pulsation", vec![("hz", hz), ("second", 0.25)]),
            Self::Jitter(up_to) => ("frame-jitter", vec![("up_to_s", up_to)]),
        }
    }
}

/// The states of what is hidden, advanced by Euler steps.
struct Chain {
    hidden: Hidden,
    state: [f64; 8],
    before: f64,
}

impl Chain {
    fn new(hidden: Hidden) -> Self {
        Self {
            hidden,
            state: [0.0; 8],
            before: 0.0,
        }
    }

    /// What reaches the plant of a displacement, counted from the working point.
    fn advance(&mut self, u: f64, h: f64) -> f64 {
        let s = &mut self.state;
        let moved = u - self.before;
        self.before = u;
        match self.hidden {
            Hidden::Nothing
            | Hidden::Adhesion(_)
            | Hidden::Drops(_)
            | Hidden::Repeats(_)
            | Hidden::Line(..)
            | Hidden::Pump(..)
            | Hidden::Jitter(_) => u,
            Hidden::Gain(factor) => factor * u,
            Hidden::GainDrift(per_s) => {
                s[0] += h;
                (1.0 + per_s * s[0]) * u
            }
            Hidden::DeadZone(width) => u - u.clamp(-0.5 * width, 0.5 * width),
            Hidden::Play(width) => {
                s[0] = s[0].clamp(u - 0.5 * width, u + 0.5 * width);
                s[0]
            }
            Hidden::Stiffening(c) => u + c * u.powi(3),
            Hidden::Progressive(c) => u + c * u * u.abs(),
            // The stand; what it adds to the picture is read from outside.
            Hidden::Shake(hz, damping, share) => {
                s[2] = share * swung(s, u, TAU * hz, damping, h).1;
                u
            }
            Hidden::Leak(corner) | Hidden::LeakAfterFlow(corner) => {
                u - lagged(&mut s[0], u, h * corner)
            }
            Hidden::Clip(low, high) => u.clamp(low - WORKING_POINT_UM, high - WORKING_POINT_UM),
            Hidden::Dahl(share, turn_um) => {
                s[0] += moved / turn_um * (1.0 - moved.signum() * s[0]);
                u - share * turn_um * s[0]
            }
            Hidden::Plays(share) => {
                let each = s.iter_mut().zip([0.05, 0.3, 1.5]);
                let lost: f64 = each
                    .map(|(p, half)| {
                        *p = p.clamp(u - half, u + half);
                        u - *p
                    })
                    .sum();
                u - share / 3.0 * lost
            }
            Hidden::Lag(hz) => lagged(&mut s[0], u, h * TAU * hz),
            Hidden::Resonance(hz, damping) => swung(s, u, TAU * hz, damping, h).0,
            Hidden::Relaxation(strength, time_s) => u - strength * lagged(&mut s[0], u, h / time_s),
            // Half a decade apart.
            Hidden::Creep(per_decade) => u + lags(s, u, h, |_| 0.5 * per_decade),
            Hidden::LateCreep(per_decade, onset_s) => {
                u + lags(s, u, h, |time_s| {
                    0.5 * per_decade * (-onset_s / time_s).exp()
                })
            }
            Hidden::PowerCreep(share, power) => {
                // The integral of `(1 - exp(-t/time)) time^power` over `ln time` is `gamma(1 - power)/power t^power`.
                let gamma = 1.0 + 0.5772 * power + 0.989 * power * power;
                let at_1_s = share * power / gamma * 0.5 * 10f64.ln();
                u + lags(s, u, h, |time_s| at_1_s * time_s.powf(power))
            }
            Hidden::SpreadRelaxation(strength, time_s) => {
                let parts = [(0.25, 0.25), (0.5, 1.0), (0.25, 4.0)];
                let each = parts.iter().zip(s.iter_mut());
                u - each
                    .map(|((part, times), s)| strength * part * lagged(s, u, h / (time_s * times)))
                    .sum::<f64>()
            }
            Hidden::Slew(rate) => {
                // A ramp over a part of the step, then rest.
                let goes = (u - s[0]).clamp(-rate * h, rate * h);
                s[0] += goes;
                s[0] - 0.5 * goes * goes.abs() / (rate * h)
            }
        }
    }
}

/// Mean over a step of eight lags from 10 ms on, half a decade apart, each with the share of its time.
fn lags(state: &mut [f64; 8], u: f64, step_s: f64, share: impl Fn(f64) -> f64) -> f64 {
    let times = (0..).map(|i| 0.01 * 10f64.powf(0.5 * f64::from(i)));
    state
        .iter_mut()
        .zip(times)
        .map(|(s, time_s)| share(time_s) * lagged(s, u, step_s / time_s))
        .sum()
}

/// Mean output over a step of a lag whose rate times the step is `share`; `state` goes on to the end of the step.
fn lagged(state: &mut f64, u: f64, share: f64) -> f64 {
    let (before, kept) = (*state, (-share).exp());
    *state = u + (before - u) * kept;
    u + (before - u) * (1.0 - kept) / share
}

/// Mean over a step of an oscillator's position, and its acceleration over `w^2` at the step's start; `state` (position and speed) goes on
/// to the end of the step, by the midpoint rule in quarters: in one piece it swings 0.13 % too fast at 280 Hz.
fn swung(state: &mut [f64], u: f64, w: f64, damping: f64, step_s: f64) -> (f64, f64) {
    const PIECES: usize = 4;
    let h = step_s / PIECES as f64;
    let bends = |x: f64, v: f64| w * w * (u - x) - 2.0 * damping * w * v;
    let starts = bends(state[0], state[1]) / (w * w);
    let mut mean = 0.0;
    for _ in 0..PIECES {
        let (x, v) = (state[0], state[1]);
        let (x_half, v_half) = (x + 0.5 * h * v, v + 0.5 * h * bends(x, v));
        state[0] = x + h * v_half;
        state[1] = v + h * bends(x_half, v_half);
        mean += x_half / PIECES as f64;
    }
    (mean, starts)
}

#[test]
fn what_is_hidden_comes_as_late_as_its_equation_says() {
    let (h, slope) = (5e-5, 0.01);
    // A lag of second order is 2 damping/w behind a ramp.
    let mut chain = Chain::new(Hidden::Resonance(280.0, 0.1));
    let mut late = 0.0;
    for k in 0..20_000 {
        let u = slope * f64::from(k);
        late = (u - chain.advance(u, h)) / slope * h;
    }
    let right = 0.2 / (TAU * 280.0);
    assert!((late - right).abs() < 1e-6, "{late} {right}");
    // The mean of the n-th step of a ramp is that of its middle.
    let mut chain = Chain::new(Hidden::Slew(100.0));
    let mean = (0..100).map(|_| chain.advance(1.0, h)).last().unwrap();
    assert!((mean - 99.5 * 100.0 * h).abs() < 1e-12, "{mean}");
}

/// What the loop adds to the command.
pub(super) type Added = fn(f64) -> f64;

/// Seven lines of one size.
pub(super) fn tones(now_s: f64) -> f64 {
    [0.7, 1.9, 4.1, 9.7, 17.3, 31.1, 53.9]
        .iter()
        .enumerate()
        .map(|(i, hz)| 0.05 * (TAU * hz * now_s + 1.7 * (i * i) as f64).sin())
        .sum()
}

/// What a survey adds: many lines, three of them at three sizes, and a rest.
pub(super) fn survey(now_s: f64) -> f64 {
    let tones = |all: &[f64], size: f64| -> f64 {
        let one = |(i, hz): (usize, &f64)| (TAU * hz * now_s + 1.7 * (i * i) as f64).sin();
        size * all.iter().enumerate().map(one).sum::<f64>()
    };
    let three = [3.0, 11.0, 47.0];
    match now_s {
        ..15.0 => tones(
            &[
                1.5, 2.5, 4.5, 7.5, 13.5, 23.5, 41.5, 71.5, 127.5, 223.5, 331.5,
            ],
            0.08,
        ),
        ..21.0 => tones(&three, 0.3),
        ..26.0 => tones(&three, 0.12),
        ..30.0 => tones(&three, 0.045),
        _ => 0.0,
    }
}

/// Eq. (6) by Euler steps of 50 us behind a delay and what is hidden, under a PI law that holds the bead while something is
/// added to the command.
pub(super) fn closed_loop(flow: Flow, hidden: Hidden, added: Added, seed: u64) -> Record {
    let model = Model::eq6();
    let (num, den) = (model.plant.num(), model.plant.den());
    let (direct, slow) = (num[0] / den[0], [den[1] / den[0], den[2] / den[0]]);
    // What is left of the numerator beside the direct path, in the controllable form.
    let rest = [
        num[1] / den[0] - direct * slow[0],
        num[2] / den[0] - direct * slow[1],
    ];
    let mut random = Random::new(seed);
    let step_s = ROW_S / STEPS_A_ROW as f64;
    let late = (DELAY_S / step_s).round() as usize;
    let mut commands = vec![0.0; ROWS * STEPS_A_ROW + late];
    let keep = (-ROW_S / flow.time_s).exp();
    let mut wander = flow.wander_um * random.normal();
    let (mut x, mut walk, mut sum) = ([0.0, 0.0], 0.0, 0.0);
    let mut chain = Chain::new(hidden);
    let (mut stuck, mut last, mut before) = (0.0, 0.0, 0.0);
    let (mut t, mut u, mut y) = (Vec::new(), Vec::new(), Vec::new());
    // Where the bead was in the steps of the last row, the latest last.
    let mut past = [0.0; STEPS_A_ROW];
    for k in 0..ROWS {
        let now_s = k as f64 * ROW_S;
        let strokes_um = |hz: f64, um: f64| -> f64 {
            let one = |k: f64| um / k * (TAU * k * hz * now_s + k * k).sin();
            [1.0, 2.0, 3.0, 4.0].map(one).iter().sum()
        };
        let pumped_um = match hidden {
            Hidden::Pump(hz, um) => strokes_um(hz, um),
            _ => 0.0,
        };
        let zero = wander + flow.drift_um_per_s * now_s + pumped_um;
        let mut position = 0.0;
        for i in 0..STEPS_A_ROW {
            let command = commands[k * STEPS_A_ROW + i];
            let input = match hidden {
                Hidden::LeakAfterFlow(_) => chain.advance(command - zero, step_s),
                _ => chain.advance(command, step_s) - zero,
            };
            let free = rest[0] * x[1] + rest[1] * x[0] + direct * input;
            if let Hidden::Adhesion(least) = hidden {
                // A jump is faster than any speed that sticks.
                let smooth = free - direct * input;
                let speed = (smooth - last) / step_s;
                let slips = speed.signum() * (speed.abs() - least).max(0.0);
                stuck += step_s * slips + direct * (input - before);
                (last, before) = (smooth, input);
            } else {
                stuck = free;
            }
            if i == 0 {
                // The frame shows bead and stand at one instant.
                position = stuck;
                if let Hidden::Shake(..) = hidden {
                    position += chain.state[2];
                }
                if let Hidden::Jitter(up_to_s) = hidden {
                    let late = random.uniform() * up_to_s / step_s;
                    let at = |steps: usize| match steps {
                        0 => stuck,
                        _ => past[STEPS_A_ROW - steps],
                    };
                    let (whole, part) = (late as usize, late.fract());
                    position = at(whole) + part * (at(whole + 1) - at(whole));
                }
            }
            past.rotate_left(1);
            past[STEPS_A_ROW - 1] = stuck;
            let bends = input - slow[0] * x[1] - slow[1] * x[0];
            x = [x[0] + step_s * x[1], x[1] + step_s * bends];
        }
        let shown = match hidden {
            Hidden::Line(hz, um) => um * (TAU * hz * now_s + 0.6).sin(),
            _ => 0.0,
        };
        let mut seen = position + walk + shown + 0.012 * random.normal();
        if matches!(hidden, Hidden::Repeats(rate) if random.uniform() < rate) {
            seen = y.last().copied().unwrap_or(seen);
        }
        sum += seen * ROW_S;
        let command = -0.03 * seen - 0.06 * sum + added(now_s);
        for i in 0..STEPS_A_ROW {
            commands[k * STEPS_A_ROW + i + late] = command;
        }
        let lost = matches!(hidden, Hidden::Drops(rate) if random.uniform() < rate);
        if !lost {
            t.push(now_s);
            u.push(WORKING_POINT_UM + command);
            y.push(seen);
        }
        walk += (2.0 * 0.33 * ROW_S).sqrt() * random.normal();
        wander = keep * wander + (1.0 - keep * keep).sqrt() * flow.wander_um * random.normal();
    }
    Record::from_rows("loop", &t, &u, &y).unwrap()
}

pub(super) fn run(record: Record) -> Reconciliation {
    run_from(record, WORKING_POINT_UM, &Options::default(), Vec::new())
}

/// With another working point of the model.
/// Beside a model that states some effects.
pub(super) fn run_from(
    record: Record,
    working_point_um: f64,
    options: &Options,
    effects: Vec<Effect>,
) -> Reconciliation {
    let model = Model {
        effects,
        working_point_um,
        noise: Noise {
            diffusion_um2_per_s: 0.33,
            localisation_um: 0.012,
        },
        ..Model::eq6()
    };
    reconcile(&model, &[record], options, &mut |_| {}).unwrap()
}
