//! A periodic flow (a pump, the mains, a fan) is detected, becomes part of the model, and is cancelled by the command.

use crate::apart::{self, DELAY_MS, FINE, NEUTRAL_UM, STEP_S, World, loop_of};
use crate::common::mpc;
use cellpos_control::design::bound_rms_um;
use cellpos_control::*;
use std::f64::consts::TAU;

/// A bead that is held at 0 um while a flow moves it.
struct Held {
    controller: Controller,
    world: World,
    preview: Vec<f64>,
    /// Ticks in a millisecond.
    rate: usize,
    told: usize,
}

impl Held {
    fn new(controller: ControllerConfig, adapt: bool, rate: usize, seed: u64) -> Self {
        let mut controller = Controller::new(loop_of(controller, adapt, rate)).unwrap();
        controller.start(NEUTRAL_UM, NEUTRAL_UM);
        Self {
            preview: vec![0.0; controller.preview_len()],
            controller,
            world: World::new(seed, apart::Flow::None),
            rate,
            told: 0,
        }
    }

    /// A tick in which a flow moves the bead to `moved_um`, by the time in it, s. The lines that are cancelled after it, and the sum of the
    /// squares of the bead's positions in the steps of the tick.
    fn tick(&mut self, moved_um: impl Fn(f64) -> f64) -> (usize, f64) {
        let input = LoopInput {
            measurement: Some(self.world.fix(0, self.rate)),
            preview_um: &self.preview,
            ..LoopInput::default()
        };
        let command_um = self.controller.step(&input).command_um;
        let mut squares = 0.0;
        for step in 0..FINE / self.rate {
            self.world.moved_um = moved_um((step as f64 + 0.5) * STEP_S);
            self.world.advance(command_um);
            squares += self.world.path_um[0].powi(2);
        }
        let now = self.controller.adaptation();
        self.told += usize::from(now.is_some_and(|now| now.news.is_some()));
        (
            now.map_or(0, |now| now.periodic_flows.iter().flatten().count()),
            squares,
        )
    }

    /// Hold error over the bound from `from_s` on.
    fn over_bound(&mut self, seconds: f64, from_s: f64, flow: &dyn Fn(f64) -> f64) -> f64 {
        let sample_s = 1e-3 / self.rate as f64;
        let ticks = |s: f64| (s / sample_s).round() as u64;
        let (end, from) = (ticks(seconds), ticks(from_s));
        let mut sum = 0.0;
        for k in 0..end {
            let (_, squares) = self.tick(|t| flow(k as f64 * sample_s + t));
            if k >= from {
                sum += squares;
            }
        }
        let steps = (end - from) as f64 * (FINE / self.rate) as f64;
        (sum / steps).sqrt() / bound_rms_um(0.33, 0.0, DELAY_MS as f64 * 1e-3, sample_s)
    }
}

/// Where a flow has moved the bead by a time, s, um.
type Flow = Box<dyn Fn(f64) -> f64>;

/// By lines: frequency, Hz, and amplitude, um.
fn lines(lines: Vec<(f64, f64)>) -> Flow {
    Box::new(move |t| lines.iter().map(|(hz, um)| um * (TAU * hz * t).sin()).sum())
}

/// A pump: its strokes and five harmonics, in all some 0.5 um.
fn pump(hz: f64) -> Flow {
    lines(
        (1..=6)
            .map(|n| (hz * f64::from(n), 0.5 / f64::from(n)))
            .collect(),
    )
}

/// 0.3 um at 30 Hz.
fn tone(t: f64) -> f64 {
    0.3 * (TAU * 30.0 * t).sin()
}

/// The same, with a frequency that rises by 1 % a second.
fn drifts(t: f64) -> f64 {
    tone(t + 0.005 * t * t)
}

/// Mean square that the best command leaves of a line of 1 um, um^2. It is held, so the motion against the line is straight from tick to tick:
/// the residual of the least squares of a sine by a polygon.
fn held_um2(hz: f64, rate: usize) -> f64 {
    let turn = TAU * hz * 1e-3 / rate as f64;
    let sinc = (0.5 * turn).sin() / (0.5 * turn);
    0.5 * (1.0 - 3.0 * sinc.powi(4) / (2.0 + turn.cos()))
}

/// The rows of the table, and the fast line in each: frequency, Hz, and amplitude, um.
fn rows() -> Vec<(String, Flow, (f64, f64))> {
    let mut rows: Vec<(String, Flow, (f64, f64))> = Vec::new();
    let slow = (1.0, 0.0);
    for hz in [0.7, 3.0, 10.0, 30.0, 50.0, 100.0, 150.0, 200.0] {
        for um in [0.1, 0.3, 1.0] {
            let name = format!("{hz} Hz, {um} um");
            rows.push((name, lines(vec![(hz, um)]), (hz, um)));
        }
    }
    for (hz, um) in [(0.7, 27.0), (3.0, 10.0), (10.0, 5.0)] {
        let name = format!("{hz} Hz, {um} um");
        rows.push((name, lines(vec![(hz, um)]), slow));
    }
    for hz in [0.7, 3.3, 7.0, 20.0] {
        rows.push((format!("pump of {hz} Hz"), pump(hz), slow));
    }
    let hum = lines(vec![(50.0, 0.3), (100.0, 0.1), (150.0, 0.05)]);
    rows.push(("50, 100, 150 Hz".into(), hum, slow));
    let two = lines(vec![(40.0, 0.3), (41.0, 0.3)]);
    rows.push(("40 and 41 Hz".into(), two, slow));
    rows.push(("30 Hz, 1 % a second".into(), Box::new(drifts), slow));
    let later = |t: f64| drifts((t - 8.0).max(0.0)) + tone(t.min(8.0));
    rows.push((
        "30 Hz, 1 % a second from 8 s on".into(),
        Box::new(later),
        slow,
    ));
    let stops = |t: f64| tone(t.min(7.0));
    rows.push(("30 Hz until 7 s".into(), Box::new(stops), slow));
    rows.push(("none".into(), lines(vec![]), slow));
    rows
}

/// Hold error over the bound from 10 to 25 s after a flow began, and what was told of the plant, which is the model.
fn stay(law: ControllerConfig, adapt: bool, rate: usize, seed: u64, flow: &Flow) -> (f64, usize) {
    let mut held = Held::new(law, adapt, rate, seed);
    held.over_bound(5.0, 0.0, &|_| 0.0);
    (held.over_bound(25.0, 10.0, flow), held.told)
}

fn lqg() -> ControllerConfig {
    ControllerConfig::Lqg(Lqg::default())
}

#[test]
fn a_line_a_pump_and_the_mains_are_cancelled_ten_seconds_after_they_began() {
    for (law, rate, flow) in [
        (lqg(), 1, lines(vec![(10.0, 0.3)])),
        (lqg(), 1, lines(vec![(100.0, 1.0)])),
        (mpc(SolverKind::ActiveSet), 1, lines(vec![(50.0, 0.3)])),
        (lqg(), 2, lines(vec![(50.0, 0.3), (100.0, 0.1)])),
        (lqg(), 1, lines(vec![(0.7, 27.0)])),
        (lqg(), 1, lines(vec![(40.0, 0.3), (41.0, 0.3)])),
        (lqg(), 2, lines(vec![(40.0, 0.3), (41.0, 0.3)])),
        (lqg(), 1, Box::new(drifts)),
        (lqg(), 1, pump(7.0)),
    ] {
        let without = stay(law, false, rate, 3, &flow).0;
        let (with, told) = stay(law, true, rate, 3, &flow);
        println!("{law:?}, {rate} kHz: {without:.2} without, {with:.2} with");
        assert!(without > 1.6, "{without}");
        // A single stay of 15 s scatters by 2 %.
        assert!(with < 1.15 * 1.04 && told == 0, "{with}, {told}");
    }
}

#[test]
fn what_is_no_line_is_not_cancelled_and_a_line_that_stops_is_gone() {
    // Steps, rest, and a line that stopped are held as without.
    let steps = |t: f64| 3.0 * (t / 4.0).floor();
    let stops = |t: f64| tone(t.min(7.0));
    let none: Flow = lines(vec![]);
    let flows: [Flow; 3] = [none, Box::new(steps), Box::new(stops)];
    for flow in &flows {
        let without = stay(lqg(), false, 1, 4, flow).0;
        let with = stay(lqg(), true, 1, 4, flow).0;
        assert!(with < 1.04 * without, "{without} without, {with} with");
    }
}

#[test]
#[ignore = "the whole table, 37 flows of 30 s, four seeds, with and without, 1, 2 and 5 kHz: for the nightly run"]
fn every_periodic_flow_is_held_no_worse_than_without_and_most_as_if_there_were_none() {
    let seeds = 4_u32;
    let mut broken = Vec::new();
    for rate in [1, 2, 5] {
        for (name, flow, (hz, um)) in rows() {
            let (mut without, mut with, mut told) = (0.0, 0.0, 0);
            for seed in 0..seeds {
                without += stay(lqg(), false, rate, seed.into(), &flow).0 / f64::from(seeds);
                let (over, events) = stay(lqg(), true, rate, seed.into(), &flow);
                with += over / f64::from(seeds);
                told += events;
            }
            let bound_um = bound_rms_um(0.33, 0.0, DELAY_MS as f64 * 1e-3, 1e-3 / rate as f64);
            let held = um * held_um2(hz, rate).sqrt() / bound_um;
            println!("{name}, {rate} kHz: {without:.3} without, {with:.3} with, {told} told");
            // Four stays of 15 s scatter by 1 %; the dither costs 1 %.
            let most = (1.02 * without).max(1.15 * 1.02) * 1.02;
            // Each of six lines costs some 0.7 %.
            let many = if name.starts_with("pump") || name.contains("and 41") {
                1.02
            } else {
                1.0
            };
            // A line that adds less than 7 % to the hold error is not told from noise within seconds.
            let cancelled = with < 1.15 * 1.02 * many * held.hypot(1.0) || without < 1.07 * 1.12;
            if with > most || !cancelled || told > 0 {
                broken.push(format!(
                    "{name}, {rate} kHz: {without}, {with}, {told} told"
                ));
            }
        }
    }
    assert!(broken.is_empty(), "{broken:#?}");
}

/// Lines found in hours of hold with nothing periodic in the flow, and the part of the time that they were there.
fn false_lines(seed: u64, rate: usize, hours: f64) -> (usize, f64) {
    let mut held = Held::new(lqg(), true, rate, seed);
    let (mut found, mut before, mut there) = (0, 0, 0);
    let ticks = (3.6e6 * hours * rate as f64) as u64;
    for _ in 0..ticks {
        let (lines, _) = held.tick(|_| 0.0);
        found += lines.saturating_sub(before);
        there += lines;
        before = lines;
    }
    (found, there as f64 / ticks as f64)
}

#[test]
fn at_rest_no_line_is_found_in_ten_minutes() {
    let (found, _) = false_lines(5, 1, 1.0 / 6.0);
    assert_eq!(found, 0);
}

#[test]
#[ignore = "thirty hours of hold at 1, 2 and 5 kHz: for the nightly run"]
fn at_rest_fewer_lines_are_found_than_one_in_ten_hours() {
    for rate in [1, 2, 5] {
        let of = |seed| false_lines(seed, rate, 5.0);
        let stays = [of(1), of(2)];
        let found: usize = stays.iter().map(|stay| stay.0).sum();
        println!("{rate} kHz: {found} lines in 10 hours: {stays:?}");
        // 0.4 are expected, and chance makes more than 2 once in 100.
        assert!(found <= 2, "{rate} kHz: {stays:?}");
    }
}
