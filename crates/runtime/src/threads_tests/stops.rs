//! Lines that stop and come back, and an operator who stops.

use super::*;

#[test]
fn a_line_that_stalls_for_less_than_200_ms_ends_no_run_and_one_that_stays_silent_does() {
    for (stall_ms, reason) in [
        (1, None),
        (5, None),
        (50, None),
        (120, None),
        (199, None),
        (300, Some(SafeReason::LinkLost)),
    ] {
        let faults = Faults {
            line: LineFaults {
                stalled_ns: vec![[1500 * MS, (1500 + stall_ms) * MS]],
                ..LineFaults::default()
            },
            ..Faults::default()
        };
        let ran = run(31, 3000, &faults, &[]);
        check(&ran, &faults);
        let end = ran.end.as_ref().expect("control lives");
        assert_eq!(end.safe_reason, reason, "{stall_ms} ms");
        let lost = ran.commands.expect("counted");
        let stall = stall_ms.unsigned_abs();
        if reason.is_none() {
            let flagged = ran
                .records
                .iter()
                .filter(|r| r.flags.has(TickFlags::COMMAND_LOST));
            assert!(flagged.count() as u64 >= stall / 2, "{stall_ms} ms");
            assert!(
                lost.lost_in_all().abs_diff(stall) <= 3,
                "{stall_ms} ms: {lost:?}"
            );
            assert!(ran.io_error.is_none(), "{stall_ms} ms");
        }
        replays(&ran);
    }
}

#[test]
fn a_board_thread_that_stalls_is_treated_as_a_line_that_does() {
    // The ring holds 64 commands.
    for (stall_ms, reason) in [
        (50, None),
        (100, None),
        (195, None),
        (300, Some(SafeReason::LinkLost)),
    ] {
        let peers = Peers {
            board_thread_stalls_ns: Some([1500 * MS, (1500 + stall_ms) * MS]),
            ..Peers::default()
        };
        let faults = Faults {
            peers,
            ..Faults::default()
        };
        let ran = run(31, 3000, &faults, &[]);
        check(&ran, &faults);
        let end = ran.end.as_ref().expect("control lives");
        assert_eq!(end.safe_reason, reason, "{stall_ms} ms");
        let refused = |r: &&TickRecord| r.flags.has(TickFlags::ACTUATOR_RING_FULL);
        let refused = ran.records.iter().filter(refused).count();
        assert_eq!(refused > 20, stall_ms >= 100, "{stall_ms} ms: {refused}");
        let furthest_um = (ran.records.iter())
            .filter(|r| r.is_running() && r.measured_um.is_finite())
            .map(|r| (r.measured_um - r.target_um).abs())
            .fold(0.0, f64::max);
        assert!(
            reason.is_some() || furthest_um < 3.0,
            "{stall_ms} ms: {furthest_um} um"
        );
        replays(&ran);
    }
}

#[test]
fn a_line_that_is_unplugged_and_comes_back_ends_no_run_before_the_board_is_silent_for_too_long() {
    for (away_ms, ends) in [(20, false), (150, false), (400, true)] {
        let faults = Faults {
            line: LineFaults {
                unplugged_ns: vec![[1500 * MS, (1500 + away_ms) * MS]],
                ..LineFaults::default()
            },
            ..Faults::default()
        };
        let ran = run(37, 3000, &faults, &[]);
        check(&ran, &faults);
        let end = ran.end.as_ref().expect("control lives");
        let reason = ends.then_some(SafeReason::LinkLost);
        assert_eq!(end.safe_reason, reason, "{away_ms} ms");
        let lost = ran.commands.expect("counted").lost_in_all();
        assert!(
            ends || lost.abs_diff(away_ms.unsigned_abs()) <= 3,
            "{away_ms} ms: {lost}"
        );
    }
}

#[test]
fn an_operator_who_stops_the_run_while_it_is_arming_ends_the_pulse_at_once() {
    let mut cut = 0;
    for at_ms in (0..160).step_by(5) {
        let ran = run(
            2,
            20_000,
            &Faults::default(),
            &[(at_ms * MS, Request::Freeze)],
        );
        check(&ran, &Faults::default());
        assert_eq!(ran.end.as_ref().map(|end| end.end), Some(End::Operator));
        let asked = ran
            .records
            .iter()
            .position(|r| r.request == Request::Freeze as u8);
        let (before, after) = ran.records.split_at(asked.expect("asked"));
        if before.last().is_none_or(|r| r.life != Life::Armed as u8) {
            continue;
        }
        let off_um = |r: &TickRecord| (r.command_um - r.neutral_um).abs();
        cut += u32::from(before.last().is_some_and(|r| off_um(r) > 0.05));
        // Ten periods for the way back at the slew.
        assert!(
            after
                .iter()
                .all(|r| r.flags.has(TickFlags::FREEZE) && r.life == Life::Armed as u8)
        );
        assert!(
            after.iter().skip(10).all(|r| off_um(r) < 0.05),
            "{at_ms} ms"
        );
        replays(&ran);
    }
    assert!(cut > 1, "no pulse was cut");
}

#[test]
fn a_camera_that_restarts_does_not_end_the_run() {
    let faults = Faults {
        restarts_at: Some(1000),
        ..Faults::default()
    };
    let ran = run(7, 3000, &faults, &[]);
    let end = ran.end.expect("control lives");
    assert_eq!((end.end, end.safe_reason), (End::Duration, None));
    assert_eq!((end.counts.camera_restarts, end.counts.frames_lost), (1, 0));
}
