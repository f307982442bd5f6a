//! The board against any sequence of messages, bytes and times.

use crate::wire;
use cellpos_board::{Board, Config};
use cellpos_link::{
    Arm, BoardState, Command, Limits, PROTOCOL_VERSION, ToBoard, um_from_picometres,
};
use proptest::prelude::*;

#[derive(Debug, Clone)]
enum Event {
    Tick,
    Bytes(Vec<u8>),
    Message(ToBoard),
}

fn event() -> impl Strategy<Value = Event> {
    let pm = prop_oneof![any::<i32>(), 0..40_000_000_i32];
    let arm = (
        0..3_u16,
        proptest::option::of(0..200_u16),
        proptest::option::of(0..200_u16),
        proptest::option::of(pm.clone()),
        proptest::option::of((0..20_000_000_i32, 20_000_000..40_000_000_i32, any::<u32>())),
        any::<bool>(),
    )
        .prop_map(
            |(session, watchdog_ms, hold_watchdog_ms, park_pm, limits, interpolate)| {
                ToBoard::Arm(Arm {
                    session,
                    watchdog_ms,
                    hold_watchdog_ms,
                    park_pm,
                    limits: limits.map(|(low_pm, high_pm, slew)| Limits {
                        low_pm,
                        high_pm,
                        slew_nm_per_s: slew % 50_000_000,
                    }),
                    interpolate,
                    status_every: 1,
                })
            },
        );
    let command = (0..3_u16, 0..500_u32, any::<u64>(), pm.clone(), pm).prop_map(
        |(session, seq, time_us, displacement_pm, neutral_pm)| {
            ToBoard::Command(Command {
                session,
                seq,
                time_us,
                displacement_pm,
                neutral_pm,
            })
        },
    );
    prop_oneof![
        6 => Just(Event::Tick),
        1 => proptest::collection::vec(any::<u8>(), 0..60).prop_map(Event::Bytes),
        2 => arm.prop_map(Event::Message),
        12 => command.prop_map(Event::Message),
        1 => prop_oneof![
            Just(ToBoard::Freeze),
            Just(ToBoard::Park),
            Just(ToBoard::Disarm),
            Just(ToBoard::StatusRequest),
            Just(ToBoard::Hello { protocol: PROTOCOL_VERSION }),
        ].prop_map(Event::Message),
    ]
}

proptest! {
    // A debug build draws fewer: the nightly run, a release build, draws all, and others each night.
    #![proptest_config(ProptestConfig::with_cases(if cfg!(debug_assertions) { 100 } else { 400 }))]

    #[test]
    fn whatever_comes_in_the_output_never_leaves_range_or_slew(
        events in proptest::collection::vec((prop_oneof![0..200_u64, 0..50_000_u64, any::<u64>()], any::<bool>(), event()), 1..300),
    ) {
        let config = Config::default();
        let mut board = Board::new(config).unwrap();
        board.receive(&wire(&ToBoard::Hello { protocol: PROTOCOL_VERSION }), 0);
        let step_um = 40.0 / 65535.0;
        let mut now_us = 0_u64;
        let mut latest_us = 0_u64;
        let mut before_um = um_from_picometres(board.applied_pm());
        // Output and state after the last tick: a tick is sure to have used up the time before it.
        let mut anchor = (0_u64, before_um, board.state());
        for (dt_us, backwards, event) in events {
            now_us = if backwards && dt_us < 200 {
                now_us.saturating_sub(dt_us)
            } else {
                now_us.saturating_add(dt_us % 10_000_000)
            };
            latest_us = latest_us.max(now_us);
            let ticked = matches!(event, Event::Tick);
            match event {
                Event::Tick => {
                    board.tick(now_us);
                }
                Event::Bytes(bytes) => board.receive(&bytes, now_us),
                Event::Message(message) => board.receive(&wire(&message), now_us),
            }
            let after_um = um_from_picometres(board.applied_pm());
            prop_assert!((0.0..=40.0).contains(&after_um), "{after_um} um");
            let per_call_um = 40_000.0 * 1e-6 * f64::from(config.update_us);
            prop_assert!((after_um - before_um).abs() <= per_call_um + step_um + 2e-6, "{before_um} to {after_um} um in one call");
            let (anchor_us, anchor_um, anchor_state) = anchor;
            let calm = |state| matches!(state, BoardState::Safe | BoardState::Disarmed);
            // A state that was left and entered again within one message is impossible: there are ticks in between.
            let rate = if calm(anchor_state) && ticked && calm(board.state()) { 1_000.0 } else { 40_000.0 };
            let reach_um = rate * 1e-6 * (latest_us - anchor_us) as f64;
            prop_assert!(
                (after_um - anchor_um).abs() <= reach_um + step_um + 2e-6,
                "{anchor_um} um to {after_um} um in {} us", latest_us - anchor_us
            );
            before_um = after_um;
            if ticked {
                anchor = (latest_us, after_um, board.state());
            } else if !calm(board.state()) {
                anchor.2 = board.state();
            }
        }
    }
}

/// What the test below lets happen: most of the time a host that commands, with stalls of all lengths.
fn stalls() -> impl Strategy<Value = Vec<(u64, i32, i32, u8)>> {
    let gap_us = prop_oneof![
        20 => 200..3_000_u64,
        2 => 3_000..60_000_u64,
        1 => 60_000..400_000_u64,
    ];
    let pm = || prop_oneof![3 => 0..40_000_000_i32, 1 => any::<i32>()];
    proptest::collection::vec((gap_us, pm(), pm(), 0..60_u8), 1..120)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    #[test]
    fn across_stalls_holds_and_parking_the_session_keeps_its_range_and_slew_over_every_window(
        events in stalls(),
        slew_nm_per_s in prop_oneof![Just(300_000_u32), 1_000..40_000_000_u32],
        interpolate in any::<bool>(),
        phase_us in 0..100_u64,
    ) {
        const LOW_PM: i32 = 2_000_000;
        const HIGH_PM: i32 = 38_000_000;
        let mut board = Board::new(Config::DEFAULT).unwrap();
        board.receive(&wire(&ToBoard::Hello { protocol: PROTOCOL_VERSION }), 0);
        let arm = Arm {
            watchdog_ms: Some(20),
            hold_watchdog_ms: Some(100),
            park_pm: Some(LOW_PM),
            limits: Some(Limits { low_pm: LOW_PM, high_pm: HIGH_PM, slew_nm_per_s }),
            interpolate,
            ..Arm::session(1)
        };
        let mut now_us = phase_us;
        board.receive(&wire(&ToBoard::Arm(arm)), now_us);
        // The output after each step of the board, every 100 us; commands fall between the steps.
        let mut steps_pm = vec![board.applied_pm()];
        let mut next_step_us = 100;
        for (seq, &(gap_us, displacement_pm, neutral_pm, special)) in (0_u32..).zip(&events) {
            let until_us = now_us + gap_us;
            while next_step_us <= until_us {
                board.tick(next_step_us);
                steps_pm.push(board.applied_pm());
                next_step_us += 100;
            }
            now_us = until_us;
            let message = match special {
                0 => ToBoard::Freeze,
                1 => ToBoard::Park,
                2 | 3 => ToBoard::Arm(arm),
                _ => ToBoard::Command(Command { session: 1, seq, time_us: now_us, displacement_pm, neutral_pm }),
            };
            board.receive(&wire(&message), now_us);
        }
        let step_pm = 40_000_000.0 / 65_535.0 + 2.0;
        for window in [1_usize, 2, 10, 50, 333] {
            let reach_pm = f64::from(slew_nm_per_s) * 1e3 * window as f64 * 100e-6;
            for pair in steps_pm.windows(window + 1) {
                let moved_pm = f64::from(pair[window]) - f64::from(pair[0]);
                prop_assert!(
                    moved_pm.abs() <= reach_pm + step_pm,
                    "{moved_pm} pm in {window} steps, {reach_pm} allowed"
                );
            }
        }
        let inside = |pm: &i32| (LOW_PM..=HIGH_PM).contains(pm) || (*pm - LOW_PM).abs() < 400 || (*pm - HIGH_PM).abs() < 400;
        prop_assert!(steps_pm.iter().all(inside));
    }
}
