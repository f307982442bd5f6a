//! Whatever the measurements, the operator and the clock do, no command leaves the range or the slew limit by the clock.

use crate::common::{START_UM, controller, core, measurement, report};
use cellpos_control::ControllerKind;
use cellpos_runtime::{Action, FrameTally, Life, Request, TickInput};
use cellpos_vision::FixQuality;
use proptest::prelude::*;

/// What may go wrong with one tick's measurement.
#[derive(Debug, Clone)]
struct Tick {
    position_um: f64,
    variance_um2: f64,
    id_step: i64,
    age_ns: i64,
    time_step_ns: i64,
    verdict: FixQuality,
    drained: u32,
    request: Request,
}

fn number() -> impl Strategy<Value = f64> {
    prop_oneof![
        8 => -20.0..20.0_f64,
        2 => -1e6..1e6_f64,
        1 => prop::num::f64::ANY,
    ]
}

fn tick() -> impl Strategy<Value = Tick> {
    (
        number(),
        prop_oneof![8 => 1e-6..1e-2_f64, 1 => prop::num::f64::ANY],
        prop_oneof![12 => Just(1_i64), 1 => -3..5_i64],
        prop_oneof![12 => Just(2_000_000_i64), 1 => -10_000_000..20_000_000_i64],
        prop_oneof![12 => Just(1_000_000_i64), 3 => 0..1_000_000_i64, 1 => 0..30_000_000_i64],
        prop_oneof![12 => Just(FixQuality::Good), 1 => Just(FixQuality::NoSignal)],
        0..4_u32,
        prop_oneof![60 => Just(Request::None), 1 => Just(Request::Freeze)],
    )
        .prop_map(
            |(
                position_um,
                variance_um2,
                id_step,
                age_ns,
                time_step_ns,
                verdict,
                drained,
                request,
            )| {
                Tick {
                    position_um,
                    variance_um2,
                    id_step,
                    age_ns,
                    time_step_ns,
                    verdict,
                    drained,
                    request,
                }
            },
        )
}

fn kind() -> impl Strategy<Value = ControllerKind> {
    prop_oneof![
        Just(ControllerKind::Pi),
        Just(ControllerKind::Lead),
        Just(ControllerKind::Lqg),
        Just(ControllerKind::Mpc),
    ]
}

proptest! {
    // A debug build draws fewer: the nightly run, a release build, draws all, and others each night.
    #![proptest_config(ProptestConfig::with_cases(if cfg!(debug_assertions) { 250 } else { 1000 }))]
    #[test]
    fn no_command_leaves_range_or_slew(kind in kind(), ticks in prop::collection::vec(tick(), 100..300)) {
        let file = controller(kind);
        let mut core = core(&file, false);
        let slew_um_per_s = file.limits.slew_um_per_s;
        let mut last_ns = -1_000_000;
        let (mut time_ns, mut id, mut last_um) = (0_i64, 0_u64, START_UM);
        for (k, tick) in ticks.iter().enumerate() {
            // The loop is closed on good frames first, so that there is something to disturb.
            let calm = k < 60;
            if k == 60 {
                prop_assert_eq!(core.life(), Life::Running);
            }
            time_ns += if calm { 1_000_000 } else { tick.time_step_ns };
            id = if calm { id + 1 } else { id.saturating_add_signed(tick.id_step) };
            let mut m = measurement(0, 0.0);
            m.frame_id = id;
            m.mid_exposure_ns = time_ns - 2_000_000;
            m.ready_ns = time_ns;
            if !calm {
                m.position_um = tick.position_um;
                m.variance_um2 = tick.variance_um2;
                m.mid_exposure_ns = time_ns - tick.age_ns;
                m.verdict = tick.verdict;
            }
            let drained = if calm { 1 } else { tick.drained };
            let stepped = core.step(&TickInput {
                time_ns,
                measurement: (drained > 0).then_some(m),
                frames: FrameTally { arrived: drained, ..FrameTally::default() },
                slow_vision_ns: None,
partner: None,
board_trouble: None,
                previous_late_ns: None,
                previous_refused: false,
            command_lost: false,
                board: Some(report(k as u64)),
                request: if calm { Request::None } else { tick.request },
                target_um: None,
                solver: Default::default(),
            });
            let Some(output) = stepped else { continue };
            let most_um = slew_um_per_s * 1e-9 * (time_ns - last_ns).min(1_000_000) as f64 * (1.0 + 1e-9);
            last_ns = time_ns;
            if let Action::Command { command_um, neutral_um } = output.action {
                prop_assert!(command_um.is_finite() && neutral_um.is_finite());
                prop_assert!((file.limits.low_um..=file.limits.high_um).contains(&command_um), "{command_um}");
                prop_assert!((command_um - last_um).abs() <= most_um + 1e-9, "{last_um} -> {command_um}");
                last_um = command_um;
            }
        }
    }
}
