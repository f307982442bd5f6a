//! The estimate of the plant on a rig written apart from the crate: the plant integrated in steps of 50 us, frames with an exposure, and
//! a process that stalls for 1 to 50 ms at random.

use crate::common::{config, first_seed};
use cellpos_control::*;
use cellpos_numeric::Random;
use std::collections::VecDeque;
use std::f64::consts::{LN_2, TAU};

/// Steps of the world in a millisecond.
pub(crate) const FINE: usize = 20;
pub(crate) const STEP_S: f64 = 1e-3 / FINE as f64;
pub(crate) const NEUTRAL_UM: f64 = 20.0;
pub(crate) const DELAY_MS: usize = 2;
const EXPOSURE_STEPS: usize = 4;
const NOISE_UM: f64 = 0.02;

/// Eq. (6) in controllable form, by Heun's method, and what else moves the bead.
pub(crate) struct World {
    random: Random,
    x: [f64; 2],
    walk_um: f64,
    /// Coloured part of the flow, um/s.
    wander_um_per_s: f64,
    gain: f64,
    late_steps: usize,
    flow: Flow,
    /// Where another flow has moved the bead, um.
    pub(crate) moved_um: f64,
    time_s: f64,
    /// Mean position in each step, newest first: the PZT's jump at the start of a tick is no part of the step before.
    pub(crate) path_um: VecDeque<f64>,
}

/// A disturbance beyond diffusion.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Flow {
    None,
    /// Frequency, Hz, and amplitude, um, of the fundamental; harmonic `n` has the `n`th part of it.
    Lines(f64, f64, u8),
    /// Corner, Hz, and RMS, um/s.
    Coloured(f64, f64),
}

impl World {
    pub(crate) fn new(seed: u64, flow: Flow) -> Self {
        Self {
            random: Random::new(seed),
            x: [0.0; 2],
            walk_um: 0.0,
            wander_um_per_s: 0.0,
            gain: 1.0,
            late_steps: 0,
            flow,
            moved_um: 0.0,
            time_s: 0.0,
            path_um: VecDeque::from(vec![0.0; 12 * FINE]),
        }
    }

    pub(crate) fn advance(&mut self, command_um: f64) {
        let u = self.gain * (command_um - NEUTRAL_UM);
        let (k, b1, b0, a1, a0) = (0.01872, 20_261.5, 1_745_041.0, 76.3, 0.13);
        let pzt_um = |x: [f64; 2]| k * ((b0 - a0) * x[0] + (b1 - a1) * x[1] + u);
        let start_um = pzt_um(self.x);
        let slope = |x: [f64; 2]| [x[1], u - a1 * x[1] - a0 * x[0]];
        let first = slope(self.x);
        let end = [0, 1].map(|i| self.x[i] + STEP_S * first[i]);
        let second = slope(end);
        self.x = [0, 1].map(|i| self.x[i] + 0.5 * STEP_S * (first[i] + second[i]));
        self.time_s += STEP_S;
        self.walk_um += (2.0 * 0.33 * STEP_S).sqrt() * self.random.normal();
        let line_um = match self.flow {
            Flow::None => 0.0,
            Flow::Lines(hz, um, harmonics) => (1..=harmonics)
                .map(|n| um / f64::from(n) * (TAU * hz * f64::from(n) * self.time_s).sin())
                .sum(),
            Flow::Coloured(hz, rms) => {
                let keep = (-TAU * hz * STEP_S).exp();
                self.wander_um_per_s = keep * self.wander_um_per_s
                    + (1.0 - keep * keep).sqrt() * rms * self.random.normal();
                self.walk_um += self.wander_um_per_s * STEP_S;
                0.0
            }
        };
        let mean_um = 0.5 * (start_um + pzt_um(self.x));
        self.path_um
            .push_front(mean_um + self.walk_um + line_um + self.moved_um);
        self.path_um.truncate(12 * FINE);
    }

    /// The fix that arrives now: the mean over an exposure whose middle is the delay old, and some steps more.
    pub(crate) fn fix(&mut self, older_steps: i32, rate: usize) -> Measurement {
        let ago = DELAY_MS * FINE + self.late_steps - EXPOSURE_STEPS / 2;
        let from = ago.checked_add_signed(older_steps as isize).unwrap();
        let older = f64::from(older_steps) * (rate as f64 / FINE as f64);
        let age = older.round();
        let sum_um: f64 = (from..from + EXPOSURE_STEPS).map(|k| self.path_um[k]).sum();
        Measurement {
            position_um: sum_um / EXPOSURE_STEPS as f64 + NOISE_UM * self.random.normal(),
            variance_um2: NOISE_UM * NOISE_UM,
            age_samples: age.max(0.0) as u16,
            offset_samples: older - age.max(0.0),
        }
    }
}

/// A row of the table.
#[derive(Debug, Clone, Copy)]
struct Row {
    /// Ticks in a millisecond.
    rate: usize,
    flow: Flow,
    /// Gain from the start on, and from the middle on.
    gain: [f64; 2],
    /// Delay beyond the model's from the start on, samples.
    late: f64,
    /// Time by which the exposures are older than the delay says, and its scatter, steps.
    older_steps: i32,
    scatter_steps: f64,
    /// Most by which a tick, and the command with it, comes too early or too late, steps.
    early_steps: f64,
    /// Stalls a second.
    stalls: f64,
    /// The gain halves in this time, s.
    halves_s: f64,
    /// Time from the start, and from the step of the gain, from which on statements count, s.
    settle_s: usize,
}

/// What came of it.
#[derive(Debug, Default)]
struct Kept {
    asked: u32,
    gain_inside: u32,
    delay_inside: u32,
    /// Changes that were reported, and those that led away from the truth.
    events: u32,
    wrong: u32,
    farthest: f64,
    /// Sums of the relative errors of the gain, and of their stated standard deviations.
    bias: f64,
    sd: f64,
}

impl Row {
    fn older(&self, random: &mut Random) -> i32 {
        match self.scatter_steps {
            0.0 => self.older_steps,
            scatter => self.older_steps + (scatter * random.normal()).round() as i32,
        }
    }
}

/// A loop for this world, with `rate` ticks in a millisecond.
pub(crate) fn loop_of(law: ControllerConfig, adapt: bool, rate: usize) -> LoopConfig {
    let base = config(law);
    LoopConfig {
        model: LoopModel {
            sample_time_s: 1e-3 / rate as f64,
            ..LoopModel::eq6(DELAY_MS as f64 * 1e-3)
        },
        estimator: EstimatorConfig {
            adapt,
            exposure_ms: EXPOSURE_STEPS as f64 / FINE as f64,
            ..base.estimator
        },
        ..base
    }
}

/// Seconds of a stay.
fn stay(row: &Row, seed: u64, seconds: usize, kept: &mut Kept) {
    let rate = row.rate;
    let law = ControllerConfig::Lqg(Lqg::default());
    let mut controller = Controller::new(loop_of(law, true, rate)).unwrap();
    controller.start(NEUTRAL_UM, NEUTRAL_UM);
    let mut world = World::new(seed, row.flow);
    world.gain = row.gain[0];
    world.late_steps = (row.late * FINE as f64 / rate as f64).round() as usize;
    let preview = vec![0.0; controller.preview_len()];
    let mut stalls = Random::new(seed ^ 0x5741_11ed);
    let mut stalled = 0_usize;
    let mut command_um = NEUTRAL_UM;
    let mut late = 0_i32;
    let late_samples = |late: i32| f64::from(late) * rate as f64 / FINE as f64;
    let (ticks, settle) = (seconds * 1000 * rate, row.settle_s * 1000 * rate);
    for tick in 0..ticks {
        if tick == ticks / 2 && row.gain[0] != row.gain[1] {
            world.gain = row.gain[1];
        }
        if stalled > 0 {
            stalled -= 1;
            controller.skip();
        } else {
            let input = LoopInput {
                measurement: Some(world.fix(row.older(&mut stalls) + late, rate)),
                preview_um: &preview,
                late_samples: late_samples(late),
                ..LoopInput::default()
            };
            command_um = controller.step(&input).command_um;
            if stalls.uniform() < row.stalls * 1e-3 / rate as f64 {
                stalled = (1.0 + 49.0 * stalls.uniform()) as usize * rate;
            }
        }
        world.gain *= (-LN_2 * 1e-3 / (rate as f64 * row.halves_s)).exp();
        let next = match row.early_steps {
            0.0 => 0,
            most => (most * (2.0 * stalls.uniform() - 1.0)).round() as i32,
        };
        for _ in 0..(FINE / rate) as i32 + next - late {
            world.advance(command_um);
        }
        late = next;
        let now = controller.adaptation().unwrap();
        let since = tick % (ticks / 2);
        if tick > settle
            && (since > settle || row.gain[0] == row.gain[1])
            && tick % (100 * rate) == 0
            && let (Some([gain, sd]), Some([delay, delay_sd])) =
                (now.gain_estimate, now.delay_estimate_samples)
        {
            kept.asked += 1;
            let off = (gain - world.gain).abs() / sd;
            kept.gain_inside += u32::from(off < 1.96);
            kept.bias += gain / world.gain - 1.0;
            kept.sd += sd / world.gain;
            kept.farthest = kept.farthest.max(off);
            kept.delay_inside += u32::from((delay - row.late).abs() < 1.96 * delay_sd);
        }
        if let Some(news) = now.news {
            kept.events += 1;
            let off =
                |gain: f64, delay: f64| (gain / world.gain).ln().abs() + (delay - row.late).abs();
            let [before, after] = [0, 1].map(|i| off(news.gain[i], news.delay_samples[i]));
            kept.wrong += u32::from(after > before);
        }
    }
}

/// The stays of a row. What broke, as text.
fn judge(row: &Row, seeds: u64, seconds: usize) -> Option<String> {
    let mut kept = Kept::default();
    for seed in first_seed()..first_seed() + seeds {
        stay(row, seed, seconds, &mut kept);
    }
    let share = |n: u32| f64::from(n) / f64::from(kept.asked.max(1));
    let result = format!(
        "{row:?}: gain {:.1} %, delay {:.1} % inside, bias {:.1} %, sd {:.1} %, {:.1} sd at most, {} events, {} wrong",
        100.0 * share(kept.gain_inside),
        100.0 * share(kept.delay_inside),
        100.0 * kept.bias / f64::from(kept.asked.max(1)),
        100.0 * kept.sd / f64::from(kept.asked.max(1)),
        kept.farthest,
        kept.events,
        kept.wrong
    );
    println!("{result}");
    // A memory of 5 s makes 14 independent statements in a stay: 92 % less two standard deviations of 50 of them.
    let good = share(kept.gain_inside) > 0.84 && share(kept.delay_inside) > 0.84;
    // A change is reported once.
    let changes = u32::from(row.gain[0] != 1.0)
        + u32::from(row.gain[1] != row.gain[0])
        + u32::from(row.late > 0.0);
    let false_event = kept.wrong > 0 || u64::from(kept.events) > seeds * u64::from(changes);
    (!good || false_event || kept.asked == 0).then_some(result)
}

fn plain(rate: usize) -> Row {
    Row {
        rate,
        flow: Flow::None,
        gain: [1.0; 2],
        late: 0.0,
        older_steps: 0,
        scatter_steps: 0.0,
        early_steps: 0.0,
        stalls: 0.0,
        halves_s: f64::INFINITY,
        settle_s: 10,
    }
}

#[test]
fn a_rig_written_apart_with_stalls_is_stated_as_it_is() {
    let rows = [
        Row {
            gain: [1.0, 0.5],
            stalls: 1.0,
            ..plain(1)
        },
        Row {
            gain: [1.0, 2.0],
            stalls: 1.0,
            ..plain(1)
        },
        Row {
            flow: Flow::Lines(50.0, 0.3, 3),
            stalls: 1.0,
            ..plain(1)
        },
        plain(5),
    ];
    let broken: Vec<_> = rows.iter().filter_map(|row| judge(row, 2, 60)).collect();
    assert!(broken.is_empty(), "{broken:#?}");
}

/// On a real line the exposures are anywhere between the ticks, and so is a delay that the model does not have.
#[test]
fn a_delay_and_exposures_between_the_ticks_are_no_change_of_the_gain() {
    let rows = [
        (0.25, 0, 0.0),
        (0.5, -4, 1.0),
        (0.75, -5, 1.0),
        (0.35, 7, 0.0),
    ];
    let broken: Vec<_> = rows
        .into_iter()
        .filter_map(|(late, older_steps, scatter_steps)| {
            let row = Row {
                late,
                older_steps,
                scatter_steps,
                ..plain(1)
            };
            judge(&row, 2, 60)
        })
        .collect();
    assert!(broken.is_empty(), "{broken:#?}");
}

/// The camera is on time, and the program is not.
#[test]
fn ticks_that_come_early_and_late_are_no_change_of_the_gain() {
    let row = Row {
        early_steps: 4.0,
        ..plain(1)
    };
    let mut kept = Kept::default();
    for seed in first_seed()..first_seed() + 8 {
        stay(&row, seed, 60, &mut kept);
    }
    let bias = kept.bias / f64::from(kept.asked);
    println!("{kept:?}: bias {bias:.4}");
    // 40 independent statements with standard deviations of 5 %.
    assert!(bias.abs() < 0.016, "{bias}");
}

/// In a stall a line moves the bead on, and the dither as well.
#[test]
fn a_strong_line_and_stalls_from_the_start_on_are_no_change_of_the_gain() {
    let row = Row {
        flow: Flow::Lines(50.0, 0.3, 3),
        stalls: 1.0,
        settle_s: 0,
        ..plain(2)
    };
    assert_eq!(judge(&row, 60, 4), None);
}

/// The tick that reports the change is the last one before a stall.
#[test]
fn a_change_before_a_stall_is_reported_once() {
    let row = Row {
        gain: [1.0, 0.5],
        stalls: 1.0,
        ..plain(2)
    };
    let mut kept = Kept::default();
    stay(&row, 99_752, 80, &mut kept);
    assert_eq!(kept.events, 1);
}

#[test]
#[ignore = "nightly: half an hour of a loop, 7 s of a debug build; the fast ones have gains that step and drift"]
fn a_channel_that_clogs_in_a_quarter_of_an_hour_is_within_the_interval() {
    let clogs = Row {
        halves_s: 900.0,
        ..plain(1)
    };
    let mut kept = Kept::default();
    for seed in 0..2 {
        stay(&clogs, seed, 900, &mut kept);
    }
    let inside = f64::from(kept.gain_inside) / f64::from(kept.asked);
    println!("{:.1} % inside, {kept:?}", 100.0 * inside);
    // A memory of a minute makes 30 independent statements. A walk of 0.003 in the place of 0.008 has 78 %.
    assert!(inside > 0.92, "{inside}");
}

#[test]
#[ignore = "long: 36 rows of four stays of 80 s, 5 kHz the slowest: for the nightly run"]
fn every_row_of_a_rig_written_apart_is_stated_as_it_is() {
    let mut broken = Vec::new();
    for rate in [1, 2, 5] {
        let plain = plain(rate);
        let rows = [
            plain,
            Row {
                stalls: 1.0,
                ..plain
            },
            Row {
                gain: [0.5; 2],
                ..plain
            },
            Row {
                gain: [2.0; 2],
                ..plain
            },
            Row {
                gain: [1.0, 0.5],
                stalls: 1.0,
                ..plain
            },
            Row {
                gain: [1.0, 2.0],
                stalls: 1.0,
                ..plain
            },
            Row { late: 1.0, ..plain },
            Row {
                flow: Flow::Lines(0.7, 0.5, 6),
                ..plain
            },
            Row {
                flow: Flow::Lines(7.0, 0.5, 6),
                stalls: 1.0,
                ..plain
            },
            Row {
                flow: Flow::Lines(50.0, 0.3, 3),
                stalls: 1.0,
                ..plain
            },
            Row {
                flow: Flow::Coloured(1.0, 10.0),
                ..plain
            },
            Row {
                flow: Flow::Coloured(20.0, 20.0),
                stalls: 1.0,
                ..plain
            },
        ];
        broken.extend(rows.iter().filter_map(|row| judge(row, 4, 80)));
    }
    assert!(broken.is_empty(), "{broken:#?}");
}
