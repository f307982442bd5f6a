//! Vision that takes longer for a frame than the camera.

use super::*;
use crate::life::{EventKind, FreezeReason};

#[test]
fn vision_slower_than_the_camera_ends_the_run_by_its_name() {
    let faults = Faults {
        vision_ns: (1_200_000, 1_200_000),
        ..Faults::default()
    };
    let ran = run(5, 20_000, &faults, &[]);
    check(&ran, &faults);
    let end = ran.end.as_ref().expect("control lives");
    assert_eq!(end.safe_reason, Some(SafeReason::VisionSlow));
    let told = ran.events.iter().find_map(|event| match event.kind {
        EventKind::VisionSlowStarted {
            vision_ms,
            period_ms,
        } => Some((vision_ms, period_ms)),
        _ => None,
    });
    assert_eq!(told, Some((1.2, 1.0)));
}

#[test]
fn vision_that_is_slow_for_a_while_is_waited_for_as_a_camera_that_stalls() {
    for (until_ms, lasts) in [(2_030, true), (2_200, true), (6_000, false)] {
        let faults = Faults {
            vision_slow: Some((2_000 * MS, until_ms * MS, 4 * MS)),
            ..Faults::default()
        };
        let ran = run(5, 6000, &faults, &[]);
        check(&ran, &faults);
        let end = ran.end.as_ref().expect("control lives");
        let expected = (!lasts).then_some(SafeReason::VisionSlow);
        assert_eq!(end.safe_reason, expected, "slow until {until_ms} ms");
        let frozen = ran.events.iter().any(|event| {
            let reason = FreezeReason::VisionSlow;
            matches!(event.kind, EventKind::FreezeStarted { reason: r, .. } if r == reason)
        });
        assert!(frozen || until_ms == 2_030, "slow until {until_ms} ms");
    }
}
