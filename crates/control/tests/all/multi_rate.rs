//! A loop that is faster than its camera: it adapts, and learns, by the fixes that there are.

use crate::common::{config, first_seed, mpc};
use cellpos_control::design::bound_rms_um;
use cellpos_control::*;

/// A bead that is held by a loop with a camera of 1 kHz and a path of 2 ms.
struct Held {
    controller: Controller,
    rig: SimulatedRig,
    preview: Vec<f64>,
    every: u64,
    sample_time_s: f64,
    tick: u64,
    /// Part of the fixes that are lost.
    lost_of_100: u64,
    events: Vec<AdaptNews>,
}

/// What a stay came to.
#[derive(Debug)]
struct Stay {
    over_bound: f64,
    stated: u32,
    outside: u32,
    farthest: f64,
    last: Adaptation,
}

impl Held {
    /// `stated`: whether the loop is told that fixes do not come in every tick.
    fn new(controller: ControllerConfig, every: u32, stated: bool, seed: u64) -> Self {
        let sample_time_s = 1e-3 / f64::from(every);
        let base = config(controller);
        let config = LoopConfig {
            model: LoopModel {
                sample_time_s,
                ..LoopModel::eq6(2e-3)
            },
            estimator: EstimatorConfig {
                adapt: true,
                ticks_per_fix: if stated { f64::from(every) } else { 1.0 },
                ..base.estimator
            },
            ..base
        };
        let rig = RigConfig {
            sample_time_s,
            ..RigConfig::eq6(seed)
        };
        let mut controller = Controller::new(config).unwrap();
        controller.start(20.0, 20.0);
        Self {
            preview: vec![0.0; controller.preview_len()],
            controller,
            rig: SimulatedRig::new(rig).unwrap(),
            every: u64::from(every),
            sample_time_s,
            tick: 0,
            lost_of_100: 0,
            events: Vec::new(),
        }
    }

    fn tick(&mut self) -> f64 {
        let true_um = self.rig.true_um();
        let fix = self.rig.measure();
        let number = self.tick / self.every;
        // A multiplicative hash is random enough for what is lost.
        let kept = number.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32;
        let comes = self.tick.is_multiple_of(self.every) && kept % 100 >= self.lost_of_100;
        let input = LoopInput {
            measurement: comes.then_some(fix),
            preview_um: &self.preview,
            ..LoopInput::default()
        };
        self.rig.advance(self.controller.step(&input).command_um);
        self.tick += 1;
        let now = self.controller.adaptation().unwrap();
        self.events.extend(now.news);
        true_um
    }

    /// Seconds, judged from `from_s` on.
    fn hold(&mut self, seconds: u64, from_s: u64) -> Stay {
        let second = (1.0 / self.sample_time_s).round() as u64;
        let (mut squares, mut stated, mut outside, mut farthest) = (0.0, 0, 0, 0.0_f64);
        for k in 0..seconds * second {
            let true_um = self.tick();
            if k < from_s * second {
                continue;
            }
            squares += true_um * true_um;
            if k % (second / 10) != 0 {
                continue;
            }
            let now = self.controller.adaptation().unwrap();
            if let Some([gain, sd]) = now.gain_estimate {
                let off = (gain - self.rig.gain).abs() / sd;
                stated += 1;
                outside += u32::from(off > 1.96);
                farthest = farthest.max(off);
            }
        }
        let ticks = ((seconds - from_s) * second) as f64;
        // Between fixes what is known grows older.
        let between_s = 0.5 * (self.every - 1) as f64 * self.sample_time_s;
        let bound_um = bound_rms_um(0.33, 0.0, 2e-3 + between_s, self.sample_time_s);
        Stay {
            over_bound: (squares / ticks).sqrt() / bound_um,
            stated,
            outside,
            farthest,
            last: self.controller.adaptation().unwrap(),
        }
    }
}

#[test]
fn a_loop_faster_than_its_camera_adapts_over_the_spread_and_states_gains_that_are_right() {
    let (mut stated, mut outside) = (0, 0);
    for (every, other) in [1, 2, 5]
        .into_iter()
        .flat_map(|every| (0..4).map(move |n| (every, n)))
    {
        let seed = 7 + first_seed() + 100 * other;
        let mut held = Held::new(ControllerConfig::Lqg(Lqg::default()), every, true, seed);
        let stay = held.hold(25, 10);
        println!("{every} ticks a fix, seed {seed}, nothing changes: {stay:?}");
        let quiet = (stay, std::mem::take(&mut held.events));
        let changed = [0.5, 2.0, 1.0].map(|gain| {
            held.rig.gain = gain;
            held.events.clear();
            let stay = held.hold(18, 8);
            println!("{every} ticks a fix, seed {seed}, gain {gain}: {stay:?}");
            stated += stay.stated;
            outside += stay.outside;
            (gain, stay, std::mem::take(&mut held.events))
        });
        // Of chance there is more than one seed bears: the others count together.
        if other > 0 {
            continue;
        }
        let (stay, events) = quiet;
        assert!(events.is_empty(), "{every}: {events:?}");
        assert!(
            stay.stated > 100 && stay.farthest < 3.0,
            "{every}: {stay:?}"
        );
        assert!(stay.last.gain.ln().abs() < 0.08, "{every}: {stay:?}");
        assert!(stay.last.delay_samples == 0.0, "{every}: {stay:?}");
        for (gain, stay, events) in changed {
            assert!(stay.over_bound < 1.2, "{every}, {gain}: {stay:?}");
            assert!(
                (stay.last.gain / gain).ln().abs() < 0.12,
                "{every}: {stay:?}"
            );
            assert!(!events.is_empty(), "{every}, {gain}: nothing told");
        }
    }
    // The estimate remembers 8 s: the 36 stays are 45 looks or so.
    println!("{outside} of {stated} outside");
    assert!(outside * 10 <= stated, "{outside} of {stated}");
}

#[test]
fn a_loop_that_is_not_told_how_rarely_fixes_come_states_no_wrong_gain() {
    for (every, lost_of_100) in [(2, 0), (5, 0), (1, 30)] {
        let law = if every == 2 {
            mpc(SolverKind::ActiveSet)
        } else {
            ControllerConfig::Lqg(Lqg::default())
        };
        let mut held = Held::new(law, every, false, 11);
        held.lost_of_100 = lost_of_100;
        let stay = held.hold(30, 10);
        println!("{every} ticks a fix, {lost_of_100} % lost: {stay:?}");
        assert!(held.events.is_empty(), "{every}: {:?}", held.events);
        assert!(stay.farthest < 3.0, "{every}: {stay:?}");
        assert!(stay.last.gain.ln().abs() < 0.1, "{every}: {stay:?}");
    }
}
