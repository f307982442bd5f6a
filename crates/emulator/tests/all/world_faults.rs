//! Faults of the emulated world: frames, beads and the camera.

use crate::world::{MS, bead_in_frame, ids, localiser, locate, positions, quiet, world};
use cellpos_emulator::{FaultKind, Faults, World, WorldConfig};
use cellpos_plant::{Chain, Model};
use cellpos_vision::FixQuality;

#[test]
fn frames_are_dropped_doubled_reordered_and_go_stale_at_their_rates() {
    let run = |faults: Faults| {
        let config = WorldConfig { faults, ..quiet() };
        positions(&mut world(&config), 20_000, 20.0)
    };
    let rate = 0.1;
    let near = |count: usize| {
        let expected = 20_000.0 * rate;
        (count as f64 - expected).abs() < 5.0 * (expected * (1.0 - rate)).sqrt() + 5.0
    };
    let dropped = run(Faults {
        drop_rate: rate,
        ..Faults::default()
    });
    assert!(near(20_000 - dropped.len()), "{}", dropped.len());
    let doubled = run(Faults {
        double_rate: rate,
        ..Faults::default()
    });
    assert!(near(doubled.len() - 19_998), "{}", doubled.len());
    let pairs = doubled
        .windows(2)
        .filter(|w| w[0].info.id == w[1].info.id && w[0].info.true_um == w[1].info.true_um)
        .count();
    assert!(near(pairs));
    let reordered = run(Faults {
        reorder_rate: rate,
        ..Faults::default()
    });
    let back = ids(&reordered).windows(2).filter(|w| w[1] < w[0]).count();
    // A frame that is held back together with its predecessor does not overtake it.
    assert!(near(back + (20_000.0 * rate * rate) as usize), "{back}");
    let stale = run(Faults {
        stale_rate: rate,
        ..Faults::default()
    });
    let old = stale
        .iter()
        .filter(|fix| fix.info.delivery_ns - fix.info.mid_exposure_ns > 2 * MS)
        .count();
    assert!(near(old), "{old}");
    assert!(
        ids(&stale).windows(2).all(|w| w[1] == w[0] + 1),
        "ids go on as if nothing had happened"
    );
    assert!(stale.iter().all(|fix| {
        let age_ms = (fix.info.delivery_ns - fix.info.mid_exposure_ns) / MS;
        age_ms == 2 || age_ms == 7
    }));
}

#[test]
fn a_lost_bead_is_gone_from_pictures_and_positions_and_comes_back() {
    let config = WorldConfig {
        faults: Faults::default().with(FaultKind::LoseBead, 0.1, Some(0.05)),
        ..quiet()
    };
    let fixes = positions(&mut world(&config), 300, 20.0);
    let lost: Vec<u64> = fixes
        .iter()
        .filter(|fix| fix.verdict != FixQuality::Good)
        .map(|fix| fix.info.id)
        .collect();
    // Exposed from 99.75 ms + 1 on: ids 99 (middle 100 ms, half lit) to 149.
    assert_eq!((lost[0], lost[lost.len() - 1]), (99, 149));
    assert_eq!(lost.len(), 51);
    let mut world = world(&config);
    let (mut localiser, mut pixels) = (localiser(), Vec::new());
    world.advance_to(130 * MS, 20.0);
    let mut verdicts = Vec::new();
    while let Some((info, _, _, verdict)) = locate(&mut world, &mut localiser, &mut pixels) {
        verdicts.push((info.id, verdict));
    }
    assert!(
        verdicts
            .iter()
            .all(|&(id, verdict)| (verdict == FixQuality::Good) == (id < 99)),
        "{verdicts:?}"
    );
}

#[test]
fn a_stuck_bead_stands_still_in_the_flow_and_goes_on_from_there() {
    let config = WorldConfig {
        drift_um_per_s: 10.0,
        faults: Faults::default().with(FaultKind::StickBead, 0.1, Some(0.2)),
        ..quiet()
    };
    let mut world = world(&config);
    world.advance_to(110 * MS, 20.0);
    let stuck_um = world.bead_um();
    assert!((stuck_um - 1.0).abs() < 0.01);
    world.advance_to(290 * MS, 20.5);
    assert_eq!(world.bead_um(), stuck_um);
    world.advance_to(310 * MS, 20.5);
    let moved_um = world.bead_um() - stuck_um;
    assert!(
        moved_um > 1.0 && moved_um < 8.0,
        "{moved_um} um in 10-20 ms"
    );
}

#[test]
fn a_second_bead_shows_in_the_picture_and_spoils_the_position_when_it_is_close() {
    let at = |second_bead_um: f64| {
        let config = WorldConfig {
            faults: Faults {
                second_bead_um,
                ..Faults::default().with(FaultKind::SecondBead, 0.0, None)
            },
            ..quiet()
        };
        world(&config)
    };
    let mut pixels = Vec::new();
    let mut apart = at(6.0);
    apart.advance_to(20 * MS, 20.0);
    assert!(apart.take_frame(&mut pixels).is_some());
    let column = |um: f64| (127.5 + um / 0.1) as usize;
    let bright = |pixels: &[u8], x: usize| {
        pixels[16 * 256 + x - 1..16 * 256 + x + 2]
            .iter()
            .all(|&p| p > 150)
    };
    assert!(bright(&pixels, column(0.0)) && bright(&pixels, column(6.0)));
    assert!(!bright(&pixels, column(3.0)));
    let verdict = |world: &mut World| positions(world, 20, 20.0).pop().unwrap().verdict;
    assert_eq!(verdict(&mut at(6.0)), FixQuality::Good);
    assert_eq!(verdict(&mut at(0.7)), FixQuality::BadFit);
}

#[test]
fn a_stalled_camera_delivers_nothing_and_then_all_at_once() {
    let config = WorldConfig {
        faults: Faults::default().with(FaultKind::StallCamera, 0.1, Some(0.03)),
        ..quiet()
    };
    let mut world = world(&config);
    world.advance_to(100 * MS - 1, 20.0);
    let before = std::iter::from_fn(|| world.take_position()).count();
    assert_eq!(before, 97);
    world.advance_to(130 * MS - 1, 20.0);
    assert!(world.take_position().is_none());
    world.advance_to(130 * MS, 20.0);
    let burst: Vec<_> = std::iter::from_fn(|| world.take_position()).collect();
    assert_eq!(ids(&burst), (97..128).collect::<Vec<_>>());
}

#[test]
fn a_bead_that_was_carried_off_is_replaced_once_the_flow_is_slow() {
    let config = WorldConfig {
        new_bead_after_ms: Some(100.0),
        ..quiet()
    };
    let mut world = world(&config);
    positions(&mut world, 20, 0.0);
    assert!(
        !bead_in_frame(&world, &config),
        "20 um from neutral: 8.5 mm/s"
    );
    positions(&mut world, 300, 20.0);
    assert!(bead_in_frame(&world, &config));
    // At 51 um/s or less, dying away with the pole at 76 rad/s, and the slow pole's 3 um/s for 0.3 s.
    assert!(world.bead_um().abs() < 2.0, "{}", world.bead_um());
}

#[test]
fn a_flow_that_is_not_slow_brings_the_next_bead_from_upstream_and_carries_it_through() {
    for away_um in [-1.0_f64, 1.0] {
        let config = WorldConfig {
            new_bead_after_ms: Some(100.0),
            ..quiet()
        };
        let mut world = world(&config);
        // 0.43 mm/s: through the field of 25.6 um in 60 ms.
        positions(&mut world, 130, 20.0 + away_um);
        assert!(!bead_in_frame(&world, &config));
        let (mut passed, mut seen_um) = (0, Vec::new());
        for _ in 0..1000 {
            let was_in = bead_in_frame(&world, &config);
            positions(&mut world, 1, 20.0 + away_um);
            if bead_in_frame(&world, &config) {
                seen_um.push(away_um.signum() * world.bead_um());
            }
            passed += i32::from(was_in && !bead_in_frame(&world, &config));
        }
        let ends_um = seen_um
            .iter()
            .fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], um| {
                [low.min(*um), high.max(*um)]
            });
        assert!((5..=7).contains(&passed), "{passed} in a second");
        assert!(ends_um[0] < -12.0 && ends_um[1] > 12.0, "{ends_um:?}");
    }
}

#[test]
fn a_step_of_the_flow_carries_the_bead_at_once_and_ends() {
    let config = WorldConfig {
        faults: Faults {
            flow_step_um: -0.3,
            ..Faults::default().with(FaultKind::FlowStep, 0.1, Some(0.1))
        },
        ..quiet()
    };
    let mut world = world(&config);
    world.advance_to(100 * MS, 20.0);
    assert!(world.bead_um().abs() < 1e-9);
    world.advance_to(101 * MS, 20.0);
    assert!((world.zero_flow_um() - 19.7).abs() < 1e-12);
    world.advance_to(200 * MS, 20.0);
    // As the same step of the PZT does, there and back, to within a millisecond of it.
    let model = Model::eq6();
    let mut chain = Chain::new(&model).unwrap();
    chain.advance(model.working_point_um + 0.3, 0.1);
    let step_um = chain.bead_um();
    let near = |a_um: f64, b_um: f64| (a_um - b_um).abs() < 0.3 * 0.43;
    assert!(near(world.bead_um(), step_um), "{}", world.bead_um());
    chain.advance(model.working_point_um, 0.1);
    world.advance_to(300 * MS, 20.0);
    assert!(
        near(world.bead_um(), chain.bead_um()),
        "{}",
        world.bead_um()
    );
    assert_eq!(world.zero_flow_um(), 20.0);
}

#[test]
fn a_gain_that_is_flipped_and_an_amplifier_that_clips_move_the_bead_otherwise() {
    let speed = |kind, applied_um| {
        let config = WorldConfig {
            faults: Faults {
                clip_um: 20.4,
                ..Faults::default().with(kind, 0.1, None)
            },
            ..quiet()
        };
        let mut world = world(&config);
        world.advance_to(200 * MS, 20.0);
        let at_um = world.bead_um();
        world.advance_to(300 * MS, applied_um);
        (world.bead_um() - at_um) / 0.1
    };
    let free = speed(FaultKind::SlowSolver, 20.5);
    assert!((speed(FaultKind::GainFlip, 20.5) / free + 1.0).abs() < 1e-6);
    assert!((speed(FaultKind::ClipAmplifier, 20.5) / free - 0.8).abs() < 1e-6);
    assert!((speed(FaultKind::ClipAmplifier, 20.3) / free - 0.6).abs() < 1e-6);
}

#[test]
fn a_pzt_that_stands_at_the_zero_flow_lets_no_command_move_the_bead() {
    let at_um = |held_um: f64, events: Faults| {
        let config = WorldConfig {
            faults: Faults {
                flow_step_um: 0.5,
                ..events
            },
            drift_um_per_s: 3.0,
            ..quiet()
        };
        let mut world = world(&config);
        world.advance_to(100 * MS, 20.0);
        let from_um = world.bead_um();
        world.advance_to(200 * MS, held_um);
        world.bead_um() - from_um
    };
    let holds = || Faults::default().with(FaultKind::HoldZeroFlow, 0.1, Some(0.1));
    let steps = |from_s| holds().with(FaultKind::FlowStep, from_s, None);
    assert_eq!(at_um(23.0, holds()), 0.0);
    // The flow that has stepped before is stopped, and one that steps later carries the bead.
    assert!(at_um(23.0, steps(0.1)).abs() < 1e-9);
    assert!(at_um(23.0, steps(0.15)) < -5.0);
}

#[test]
fn a_frozen_picture_is_the_same_to_the_bit_under_new_numbers_while_the_bead_goes_on() {
    let config = WorldConfig {
        drift_um_per_s: 10.0,
        faults: Faults::default().with(FaultKind::FrozenPicture, 0.05, Some(0.05)),
        ..WorldConfig::ideal()
    };
    let mut world = world(&config);
    world.advance_to(130 * MS, 20.0);
    let (mut before, mut pixels) = (Vec::new(), Vec::new());
    let (mut equal, mut last) = (0, None);
    while let Some(info) = world.take_frame(&mut pixels) {
        if let Some((id, true_um)) = last {
            assert_eq!(info.id, id + 1);
            assert_ne!(info.true_um, true_um);
        }
        equal += usize::from(pixels == before);
        assert_eq!(pixels == before, (49..99).contains(&info.id), "{}", info.id);
        last = Some((info.id, info.true_um));
        before.clone_from(&pixels);
    }
    assert_eq!(equal, 50);
}
