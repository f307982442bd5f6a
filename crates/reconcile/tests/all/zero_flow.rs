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

/// Eq. (6) by Euler steps of 50 us behind a delay and a gain, under a PI law that holds the bead while tones are added to the command.
fn closed_loop(flow: Flow, gain: f64, seed: u64) -> Record {
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
    let (mut t, mut u, mut y) = (Vec::new(), Vec::new(), Vec::new());
    for k in 0..ROWS {
        let now_s = k as f64 * ROW_S;
        let zero = wander + flow.drift_um_per_s * now_s;
        let mut position = 0.0;
        for i in 0..STEPS_A_ROW {
            let input = gain * commands[k * STEPS_A_ROW + i] - zero;
            if i == 0 {
                position = rest[0] * x[1] + rest[1] * x[0] + direct * input;
            }
            let bends = input - slow[0] * x[1] - slow[1] * x[0];
            x = [x[0] + step_s * x[1], x[1] + step_s * bends];
        }
        let seen = position + walk + 0.012 * random.normal();
        sum += seen * ROW_S;
        let tones: f64 = [0.7, 1.9, 4.1, 9.7, 17.3, 31.1, 53.9]
            .iter()
            .enumerate()
            .map(|(i, hz)| 0.05 * (TAU * hz * now_s + 1.7 * (i * i) as f64).sin())
            .sum();
        let command = -0.03 * seen - 0.06 * sum + tones;
        for i in 0..STEPS_A_ROW {
            commands[k * STEPS_A_ROW + i + late] = command;
        }
        t.push(now_s);
        u.push(WORKING_POINT_UM + command);
        y.push(seen);
        walk += (2.0 * 0.33 * ROW_S).sqrt() * random.normal();
        wander = keep * wander + (1.0 - keep * keep).sqrt() * flow.wander_um * random.normal();
    }
    Record::from_rows("loop", &t, &u, &y).unwrap()
}

fn run(record: Record) -> Reconciliation {
    let model = Model {
        working_point_um: WORKING_POINT_UM,
        noise: Noise {
            diffusion_um2_per_s: 0.33,
            localisation_um: 0.012,
        },
        ..Model::eq6()
    };
    reconcile(&model, &[record], &Options::default(), &mut |_| {}).unwrap()
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
        let r = run(closed_loop(flow, 1.0, 40 + seed as u64));
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
    let r = run(closed_loop(flow, 0.8, 50));
    let mut names = named(&r);
    names.sort_unstable();
    assert_eq!(names, ["gain-error", "time-delay"], "{:?}", r.places);
    let gain = r.effects.iter().find(|e| e.id == "gain-error").unwrap();
    let p = &gain.parameters["factor"];
    let half = 0.5 * (p.ci95[1] - p.ci95[0]);
    assert!(half < 0.01 && (p.value - 0.8).abs() < 1.5 * half, "{p:?}");
}

#[test]
fn a_zero_flow_that_stands_still_is_not_said_to_move() {
    let flow = Flow {
        wander_um: 0.0,
        time_s: 1.0,
        drift_um_per_s: 0.0,
    };
    let r = run(closed_loop(flow, 1.0, 60));
    assert_eq!(named(&r), ["time-delay"], "{:?}", r.places);
    assert!(r.noise.zero_flow.is_none(), "{:?}", r.noise);
}
