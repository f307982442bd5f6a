//! A control law that this workspace does not know runs in the loop, in the record and in a replay.

use crate::common::{START_UM, controller, measurement, report};
use cellpos_control::{
    ControlLaw, Controller, ControllerKind, LawInput, LawOutput, Profile, SolverTerms,
};
use cellpos_plant::TransferFunction;
use cellpos_runtime::replay::{Gap, Replay};
use cellpos_runtime::{ArmingConfig, Core, FrameTally, Request, TickInput, TickRecord, Timing};

/// Proportional control with a memory, so that a state is needed to go on.
#[derive(Debug, Clone)]
struct Smoothed {
    kp_um_per_um: f64,
}

impl ControlLaw for Smoothed {
    type State = f64;

    fn start(&self, _command_um: f64) -> f64 {
        0.0
    }

    fn step(&self, error_um: &mut f64, input: &LawInput) -> LawOutput {
        *error_um += 0.5 * (input.reference_um - input.estimate.position_um - *error_um);
        LawOutput::wish(input.estimate.neutral_um + self.kp_um_per_um * *error_um)
    }

    fn columns(&self) -> &'static [&'static str] {
        &["smoothed_error_um"]
    }

    fn record(&self, error_um: &f64, out: &mut [f32]) {
        out[0] = *error_um as f32;
    }
}

fn core() -> Core<Profile> {
    let file = controller(ControllerKind::Pi);
    let config = file.loop_config(&cellpos_plant::Model::eq6()).unwrap();
    let controller = Controller::with_law(config.with(Smoothed { kp_um_per_um: 0.4 })).unwrap();
    Core::with_controller(
        controller,
        Profile::Hold { position_um: 0.0 },
        Timing::default(),
        ArmingConfig {
            check: false,
            ..ArmingConfig::default()
        },
        &TransferFunction::eq6(),
        [START_UM, START_UM],
    )
    .unwrap()
}

fn record(ticks: u64) -> Vec<TickRecord> {
    let mut core = core();
    (0..ticks)
        .map(|k| {
            let input = TickInput {
                time_ns: k as i64 * 1_000_000,
                measurement: Some(measurement(k, 0.1 * (k as f64 * 0.3).sin())),
                frames: FrameTally {
                    arrived: 1,
                    ..FrameTally::default()
                },
                slow_vision_ns: None,
                partner: None,
                board_trouble: None,
                previous_late_ns: None,
                previous_refused: false,
                command_lost: false,
                board: Some(report(k)),
                request: Request::None,
                target_um: None,
                solver: SolverTerms::Unlimited,
            };
            core.step(&input).expect("a period apart").record
        })
        .collect()
}

#[test]
fn its_own_columns_are_in_the_record_and_a_replay_compares_them() {
    let mut rows = record(400);
    assert!(rows.iter().any(|row| row.law[0].abs() > 0.02), "it ran");
    assert!(rows.iter().all(|row| row.law[1].is_nan()), "one column");
    let mut replay = Replay::new(core());
    rows.iter().for_each(|row| replay.add(row));
    assert_eq!(
        (replay.outcome().identical, replay.outcome().gap),
        (400, None)
    );
    rows[300].law[0] += 1.0;
    let mut replay = Replay::new(core());
    rows.iter().for_each(|row| replay.add(row));
    let mismatch = replay.outcome().first_mismatch.unwrap();
    assert_eq!((mismatch.seq, mismatch.column), (300, "smoothed_error_um"));
}

#[test]
fn a_gap_is_where_a_replay_ends_and_it_says_so() {
    let mut rows = record(400);
    rows.drain(200..210);
    let mut replay = Replay::new(core());
    rows.iter().for_each(|row| replay.add(row));
    let outcome = replay.outcome();
    assert_eq!((outcome.ticks, outcome.identical), (390, 200));
    let gap = Gap {
        from_seq: 200,
        found_seq: 210,
    };
    assert_eq!((outcome.gap, outcome.first_mismatch), (Some(gap), None));
    let mut replay = Replay::new(core());
    rows[5..].iter().for_each(|row| replay.add(row));
    assert_eq!(
        replay.outcome().gap.map(|gap| gap.found_seq),
        Some(5),
        "no beginning"
    );
}
