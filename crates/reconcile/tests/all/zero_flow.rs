//! A rig in a closed loop whose zero flow moves: the command then holds what the flow did, and no effect may be made of it.

use cellpos_numeric::Random;
use cellpos_plant::{Model, Noise};
use cellpos_reconcile::{Options, Reconciliation, Record, Verdict, reconcile};
use std::f64::consts::TAU;

const STEPS_A_ROW: usize = 20;
const ROW_S: f64 = 1e-3;
const ROWS: usize = 38_000;
const DELAY_S: f64 = 2.3e-3;
const WORKING_POINT_UM: f64 = 20.0;

/// How the zero flow moves: size \[um\] and time \[s\] of its wandering, and its drift \[um/s\].
#[derive(Clone, Copy)]
struct Flow {
    wander_um: f64,
    time_s: f64,
    drift_um_per_s: f64,
}

/// What lies between command and bead beside the delay.
#[derive(Debug, Clone, Copy)]
enum Hidden {
    Nothing,
    Gain(f64),
    /// Corner \[rad/s\].
    Leak(f64),
    /// Ends of the range \[um\].
    Clip(f64, f64),
    /// Share of the stroke, by Dahl's equation, and the motion after which it has turned \[um\].
    Dahl(f64, f64),
    /// Corner \[Hz\].
    Lag(f64),
    /// Frequency \[Hz\] and damping.
    Resonance(f64, f64),
    /// Strength, and time \[s\].
    Relaxation(f64, f64),
    /// Part of a step that comes late, by eight exponentials of 10 ms to 30 s, per decade.
    Creep(f64),
    /// Speed below which the bead sticks \[um/s\].
    Adhesion(f64),
    /// Most speed of the amplifier \[um/s\].
    Slew(f64),
    /// Share of the frames that are lost.
    Drops(f64),
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
            Hidden::Nothing | Hidden::Adhesion(_) | Hidden::Drops(_) => u,
            Hidden::Gain(factor) => factor * u,
            Hidden::Leak(corner) => {
                s[0] += h * corner * (u - s[0]);
                u - s[0]
            }
            Hidden::Clip(low, high) => u.clamp(low - WORKING_POINT_UM, high - WORKING_POINT_UM),
            Hidden::Dahl(share, turn_um) => {
                s[0] += moved / turn_um * (1.0 - moved.signum() * s[0]);
                u - share * turn_um * s[0]
            }
            Hidden::Lag(hz) => {
                s[0] += h * TAU * hz * (u - s[0]);
                s[0]
            }
            Hidden::Resonance(hz, damping) => {
                let w = TAU * hz;
                s[1] += h * (w * w * (u - s[0]) - 2.0 * damping * w * s[1]);
                s[0] += h * s[1];
                s[0]
            }
            Hidden::Relaxation(strength, time_s) => {
                s[0] += h / time_s * (u - s[0]);
                u - strength * s[0]
            }
            Hidden::Creep(per_decade) => {
                // Half a decade apart.
                let mut x = u;
                for (i, s) in s.iter_mut().enumerate() {
                    let time_s = 0.01 * 10f64.powf(0.5 * i as f64);
                    *s += h / time_s * (u - *s);
                    x += 0.5 * per_decade * *s;
                }
                x
            }
            Hidden::Slew(rate) => {
                s[0] += (u - s[0]).clamp(-rate * h, rate * h);
                s[0]
            }
        }
    }
}

/// What the loop adds to the command.
type Added = fn(f64) -> f64;

/// Seven lines of one size.
fn tones(now_s: f64) -> f64 {
    [0.7, 1.9, 4.1, 9.7, 17.3, 31.1, 53.9]
        .iter()
        .enumerate()
        .map(|(i, hz)| 0.05 * (TAU * hz * now_s + 1.7 * (i * i) as f64).sin())
        .sum()
}

/// What a survey adds: many lines, three of them at three sizes, and a rest.
fn survey(now_s: f64) -> f64 {
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
fn closed_loop(flow: Flow, hidden: Hidden, added: Added, seed: u64) -> Record {
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
    let (mut stuck, mut last) = (0.0, 0.0);
    let (mut t, mut u, mut y) = (Vec::new(), Vec::new(), Vec::new());
    for k in 0..ROWS {
        let now_s = k as f64 * ROW_S;
        let zero = wander + flow.drift_um_per_s * now_s;
        let mut position = 0.0;
        for i in 0..STEPS_A_ROW {
            let input = chain.advance(commands[k * STEPS_A_ROW + i], step_s) - zero;
            let free = rest[0] * x[1] + rest[1] * x[0] + direct * input;
            if let Hidden::Adhesion(least) = hidden {
                let speed = (free - last) / step_s;
                let slips = speed.signum() * (speed.abs() - least).max(0.0);
                stuck += step_s * slips;
                last = free;
            } else {
                stuck = free;
            }
            if i == 0 {
                position = stuck;
            }
            let bends = input - slow[0] * x[1] - slow[1] * x[0];
            x = [x[0] + step_s * x[1], x[1] + step_s * bends];
        }
        let seen = position + walk + 0.012 * random.normal();
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

fn run(record: Record) -> Reconciliation {
    run_from(record, WORKING_POINT_UM, &Options::default())
}

/// With another working point of the model.
fn run_from(record: Record, working_point_um: f64, options: &Options) -> Reconciliation {
    let model = Model {
        working_point_um,
        noise: Noise {
            diffusion_um2_per_s: 0.33,
            localisation_um: 0.012,
        },
        ..Model::eq6()
    };
    reconcile(&model, &[record], options, &mut |_| {}).unwrap()
}

/// The names, of which the delay must be one, with its value.
fn named(r: &Reconciliation) -> Vec<&str> {
    let names = r.effects.iter().map(|e| e.id.as_str()).collect();
    let delay = (r.effects.iter().find(|e| e.id == "time-delay"))
        .unwrap_or_else(|| panic!("{:?}: {names:?}, {:?}", r.verdict, r.places));
    // The interval is one of 95 %; half as long again is one of 99.7 %.
    let p = &delay.parameters["delay_s"];
    let half = 0.5 * (p.ci95[1] - p.ci95[0]);
    assert!((p.value - DELAY_S).abs() < 1.5 * half, "{p:?}");
    names
}

#[test]
fn a_zero_flow_that_moves_is_no_effect_of_the_response() {
    let flows = [(0.006, 20.0, 0.001), (0.02, 5.0, 0.0), (0.002, 50.0, 0.005)];
    for (seed, (wander_um, time_s, drift_um_per_s)) in flows.into_iter().enumerate() {
        let flow = Flow {
            wander_um,
            time_s,
            drift_um_per_s,
        };
        let r = run(closed_loop(flow, Hidden::Nothing, tones, 40 + seed as u64));
        assert_eq!(named(&r), ["time-delay"], "{:?} {:?}", r.places, r.noise);
        assert_eq!(r.verdict, Verdict::Named, "{:?}", r.remainder);
        assert!(r.noise.zero_flow.is_some(), "{:?}", r.noise);
    }
}

#[test]
fn what_is_missing_is_named_beside_a_zero_flow_that_moves() {
    let flow = Flow {
        wander_um: 0.006,
        time_s: 20.0,
        drift_um_per_s: 0.001,
    };
    let r = run(closed_loop(flow, Hidden::Gain(0.8), tones, 50));
    let mut names = named(&r);
    names.sort_unstable();
    assert_eq!(names, ["gain-error", "time-delay"], "{:?}", r.places);
    let gain = r.effects.iter().find(|e| e.id == "gain-error").unwrap();
    let p = &gain.parameters["factor"];
    let half = 0.5 * (p.ci95[1] - p.ci95[0]);
    assert!(half < 0.01 && (p.value - 0.8).abs() < 1.5 * half, "{p:?}");
}

#[test]
fn a_leak_is_told_from_a_zero_flow_that_moves_wherever_the_bead_rests() {
    let flow = Flow {
        wander_um: 0.006,
        time_s: 20.0,
        drift_um_per_s: 0.001,
    };
    let record = closed_loop(flow, Hidden::Leak(2.0), survey, 71);
    let unknown = Options {
        free_working_point: true,
        ..Options::default()
    };
    let known = Options::default();
    for (off_um, options) in [(0.0, &known), (0.3, &unknown)] {
        let r = run_from(record.clone(), WORKING_POINT_UM + off_um, options);
        let mut names = named(&r);
        names.sort_unstable();
        assert_eq!(names, ["leak", "time-delay"], "{off_um}: {:?}", r.places);
        let leak = r.effects.iter().find(|e| e.id == "leak").unwrap();
        let p = &leak.parameters["corner_rad_per_s"];
        let half = 0.5 * (p.ci95[1] - p.ci95[0]);
        assert!(half < 0.4 && (p.value - 2.0).abs() < 1.5 * half, "{p:?}");
    }
}

#[test]
fn what_is_at_work_in_a_part_of_a_record_alone_is_named() {
    // Nothing clips in the last 40 % of the time, which a fit to the first 60 % has to predict.
    let flow = Flow {
        wander_um: 0.006,
        time_s: 20.0,
        drift_um_per_s: 0.001,
    };
    let r = run(closed_loop(flow, Hidden::Clip(19.4, 20.6), survey, 72));
    let mut names = named(&r);
    names.sort_unstable();
    assert_eq!(names, ["saturation", "time-delay"], "{:?}", r.places);
    let clip = r.effects.iter().find(|e| e.id == "saturation").unwrap();
    for (name, truth) in [("low_um", 19.4), ("high_um", 20.6)] {
        let p = &clip.parameters[name];
        let half = 0.5 * (p.ci95[1] - p.ci95[0]);
        assert!(half < 0.05 && (p.value - truth).abs() < 1.5 * half, "{p:?}");
    }
}

#[test]
fn a_zero_flow_that_stands_still_is_not_said_to_move() {
    let flow = Flow {
        wander_um: 0.0,
        time_s: 1.0,
        drift_um_per_s: 0.0,
    };
    let r = run(closed_loop(flow, Hidden::Nothing, tones, 60));
    assert_eq!(named(&r), ["time-delay"], "{:?}", r.places);
    assert!(r.noise.zero_flow.is_none(), "{:?}", r.noise);
}

#[test]
#[ignore = "a table: twelve effects, one after another"]
fn table_of_effects_beside_a_zero_flow_that_moves() {
    let hidden = [
        Hidden::Nothing,
        Hidden::Leak(2.0),
        Hidden::Clip(19.4, 20.6),
        Hidden::Gain(0.8),
        Hidden::Dahl(0.3, 0.2),
        Hidden::Lag(120.0),
        Hidden::Resonance(280.0, 0.1),
        Hidden::Relaxation(0.2, 0.3),
        Hidden::Creep(0.06),
        Hidden::Adhesion(40.0),
        Hidden::Slew(100.0),
        Hidden::Drops(0.05),
    ];
    let asked = std::env::var("HIDDEN").unwrap_or_default();
    let seed = std::env::var("SEED").map_or(70, |s| s.parse().unwrap());
    let flow = match std::env::var("STILL").is_ok() {
        true => Flow {
            wander_um: 0.0,
            time_s: 1.0,
            drift_um_per_s: 0.0,
        },
        false => Flow {
            wander_um: 0.006,
            time_s: 20.0,
            drift_um_per_s: 0.001,
        },
    };
    for (i, h) in hidden.into_iter().enumerate() {
        if !format!("{h:?}").contains(&asked) {
            continue;
        }
        let start = std::time::Instant::now();
        let r = run(closed_loop(flow, h, survey, seed + i as u64));
        let found: Vec<String> = r
            .effects
            .iter()
            .map(|e| {
                let p: Vec<String> = e
                    .parameters
                    .iter()
                    .map(|(n, p)| format!("{n} {:.5} [{:.5} {:.5}]", p.value, p.ci95[0], p.ci95[1]))
                    .collect();
                format!(
                    "{}({}; {:.4}; or {:?})",
                    e.id,
                    p.join(", "),
                    e.explained,
                    e.alternatives
                )
            })
            .collect();
        println!(
            "{h:?} -> {:?} {}\n      {:?}\n     {:?}\n     {:?} closure {:.3} {:.0} s",
            r.verdict,
            found.join(" + "),
            r.places,
            r.remainder.as_ref().map(|m| &m.how),
            r.noise.zero_flow,
            r.gap.closure(),
            start.elapsed().as_secs_f64()
        );
    }
}
