//! The board against any sequence of messages, bytes and times.

use crate::wire;
use cellpos_firmware_sim::{Board, BoardConfig};
use cellpos_link::{Arm, BoardState, Command, Limits, PROTOCOL_VERSION, ToBoard};
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
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn whatever_comes_in_the_output_never_leaves_range_or_slew(
        events in proptest::collection::vec((prop_oneof![0..200_u64, 0..50_000_u64, any::<u64>()], any::<bool>(), event()), 1..300),
    ) {
        let config = BoardConfig::default();
        let mut board = Board::new(config).unwrap();
        board.receive(&wire(&ToBoard::Hello { protocol: PROTOCOL_VERSION }), 0);
        let step_um = config.step_um();
        let mut now_us = 0_u64;
        let mut latest_us = 0_u64;
        let mut before_um = board.applied_um();
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
            let after_um = board.applied_um();
            prop_assert!((config.low_um..=config.high_um).contains(&after_um), "{after_um} um");
            let per_call_um = config.slew_um_per_s * 1e-6 * f64::from(config.update_us);
            prop_assert!((after_um - before_um).abs() <= per_call_um + step_um, "{before_um} to {after_um} um in one call");
            let (anchor_us, anchor_um, anchor_state) = anchor;
            let calm = |state| matches!(state, BoardState::Safe | BoardState::Disarmed);
            // A state that was left and entered again within one message cannot be: ticks lie in between.
            let rate = if calm(anchor_state) && ticked && calm(board.state()) { config.ramp_um_per_s } else { config.slew_um_per_s };
            let reach_um = rate * 1e-6 * (latest_us - anchor_us) as f64;
            prop_assert!(
                (after_um - anchor_um).abs() <= reach_um + step_um + 1e-9,
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
