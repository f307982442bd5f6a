//! A bead that is frozen for two reasons is held again when both are gone.

use crate::common::{controller, core, measurement, report};
use cellpos_control::ControllerKind;
use cellpos_rig::Measurement;
use cellpos_runtime::{FrameTally, Life, Request, TickFlags, TickInput};
use cellpos_vision::FixQuality;

#[test]
fn a_lost_bead_that_the_operator_froze_meanwhile_is_not_controlled_when_it_comes_back() {
    let mut core = core(&controller(ControllerKind::Pi), false);
    let mut frozen = Vec::new();
    for k in 0..1500_u64 {
        let seen = measurement(k, 0.0);
        let lost = Measurement {
            position_um: f64::NAN,
            verdict: FixQuality::NoSignal,
            ..seen
        };
        let request = match k {
            400..1000 => Request::Pause,
            _ => Request::None,
        };
        let output = core.step(&TickInput {
            time_ns: k as i64 * 1_000_000,
            measurement: Some(if (300..700).contains(&k) { lost } else { seen }),
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
            request,
            target_um: None,
            solver: Default::default(),
        });
        let record = output.expect("each in a period of its own").record;
        if core.life() == Life::Running {
            frozen.push((k, record.flags.has(TickFlags::FREEZE)));
        }
    }
    let first = frozen.iter().find(|(_, is)| *is).map(|(k, _)| *k);
    assert!(first.is_some_and(|k| (310..330).contains(&k)), "{first:?}");
    for (k, is) in frozen {
        assert_eq!(is, (first.unwrap_or(0)..1000).contains(&k), "tick {k}");
    }
}
