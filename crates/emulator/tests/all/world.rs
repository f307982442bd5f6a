//! The emulated world against closed forms: diffusion, gain, drift, delay, blur, noise, faults.

use cellpos_emulator::{FaultKind, Faults, FrameInfo, PositionFix, World, WorldConfig};
use cellpos_plant::{Model, effects};
use cellpos_vision::{FixQuality, Frame, Localiser, LocaliserConfig, Pixels, ProfileSpec};

pub(crate) const MS: i64 = 1_000_000;

pub(crate) fn quiet() -> WorldConfig {
    WorldConfig {
        diffusion_um2_per_s: 0.0,
        drift_um_per_s: 0.0,
        ..WorldConfig::ideal()
    }
}

pub(crate) fn world(config: &WorldConfig) -> World {
    World::new(config, &Model::eq6(), 0).unwrap()
}

/// Whether any part of the bead is within the frame.
pub(crate) fn bead_in_frame(world: &World, config: &WorldConfig) -> bool {
    world.bead_um().abs() < config.half_frame_um() + config.bead_radius_um
}

/// Runs for `ms` milliseconds at a constant output; the positions delivered.
pub(crate) fn positions(world: &mut World, ms: i64, applied_um: f64) -> Vec<PositionFix> {
    let mut all = Vec::new();
    let end_ns = world.now_ns() + ms * MS;
    while world.now_ns() < end_ns {
        world.advance_to(world.now_ns() + MS, applied_um);
        while let Some(fix) = world.take_position() {
            all.push(fix);
        }
    }
    all
}

pub(crate) fn ids(fixes: &[PositionFix]) -> Vec<u64> {
    fixes.iter().map(|fix| fix.info.id).collect()
}

#[test]
fn the_bead_diffuses_with_a_variance_of_2_d_t_along_and_stays_confined_across() {
    let config = WorldConfig {
        drift_um_per_s: 0.0,
        ..WorldConfig::ideal()
    };
    let mut world = world(&config);
    let (mut sum, mut n, mut widest) = (0.0, 0.0, 0.0_f64);
    let mut before = world.bead_um();
    for k in 1..=40_000_i64 {
        world.advance_to(k * MS, 20.0);
        let step = world.bead_um() - before;
        before = world.bead_um();
        sum += step * step;
        n += 1.0;
        widest = widest.max(world.lateral_um().abs());
        while world.take_position().is_some() {}
    }
    let ratio = sum / n / (2.0 * 0.33 * 1e-3);
    // The relative error of a variance from n increments is sqrt(2/n); five of them.
    assert!((ratio - 1.0).abs() < 5.0 * (2.0_f64 / n).sqrt(), "{ratio}");
    assert!(widest <= 0.25 && widest > 0.2, "{widest} um");
}

#[test]
fn one_micrometre_beyond_neutral_moves_the_bead_as_eq_6_does() {
    let mut world = world(&quiet());
    world.advance_to(400 * MS, 21.0);
    let start_um = world.bead_um();
    world.advance_to(500 * MS, 21.0);
    // Long after the pole-zero pair of 12-14 Hz has settled: K = 0.01872 x 1745041 / 76.3 = 428.1 um/s per um.
    let speed = (world.bead_um() - start_um) / 0.1;
    let slow_pole = (-0.001_704_f64 * 0.45).exp();
    assert!(
        (speed / (428.14 * slow_pole) - 1.0).abs() < 2e-3,
        "{speed} um/s"
    );
}

#[test]
fn the_drift_alone_is_a_ramp_of_the_configured_speed() {
    let config = WorldConfig {
        drift_um_per_s: 3.0,
        ..quiet()
    };
    let mut world = world(&config);
    world.advance_to(2_000 * MS, 20.0);
    assert!((world.bead_um() - 6.0).abs() < 1e-9, "{}", world.bead_um());
}

#[test]
fn a_frame_is_delivered_exactly_its_latency_after_the_middle_of_its_exposure() {
    for latency_ms in [0.25, 1.0, 2.0, 3.3] {
        let config = WorldConfig {
            latency_ms,
            ..quiet()
        };
        let mut world = world(&config);
        let mut seen = 0;
        for step in 1..20_000_i64 {
            let t_ns = step * 10_000;
            world.advance_to(t_ns, 20.0);
            let due_ns = world.next_delivery_ns();
            while let Some(fix) = world.take_position() {
                assert_eq!(fix.info.mid_exposure_ns, (seen as i64 + 1) * MS);
                assert_eq!(
                    fix.info.delivery_ns - fix.info.mid_exposure_ns,
                    (latency_ms * 1e6) as i64
                );
                assert!(due_ns.unwrap() <= t_ns && due_ns.unwrap() > t_ns - 10_000);
                assert_eq!(fix.info.id, seen);
                seen += 1;
            }
        }
        assert!(seen > 190);
    }
}

#[test]
fn a_command_acts_from_its_instant_on_and_shows_in_the_first_exposure_after_it() {
    let config = WorldConfig {
        exposure_ms: 0.0,
        localisation_um: Some(0.0),
        ..quiet()
    };
    let mut world = world(&config);
    // Frame 9 is exposed at 10 ms; the command comes 0.3 ms later.
    world.advance_to(10 * MS + 300_000, 20.0);
    world.advance_to(40 * MS, 21.0);
    let fixes: Vec<_> = std::iter::from_fn(|| world.take_position()).collect();
    assert!(fixes[..10].iter().all(|fix| fix.x_um == 0.0));
    // 0.7 ms at about 379 um/s, plus the feedthrough of 0.0187 um.
    assert!(
        (fixes[10].x_um - (0.0187 + 0.379 * 0.7)).abs() < 0.01,
        "{}",
        fixes[10].x_um
    );
}

#[test]
fn a_frame_shows_the_mean_of_the_path_over_the_exposure() {
    let config = WorldConfig {
        drift_um_per_s: 1000.0,
        exposure_ms: 0.8,
        localisation_um: Some(0.0),
        start_um: -5.0,
        ..quiet()
    };
    for fix in positions(&mut world(&config), 8, 20.0) {
        let expected = -5.0 + 1e-6 * fix.info.mid_exposure_ns as f64;
        assert!((fix.x_um - expected).abs() < 1e-9);
    }
}

pub(crate) fn localiser() -> Localiser {
    Localiser::new(LocaliserConfig::new(ProfileSpec::Ring { edge_px: 5.0 })).unwrap()
}

/// Locates the bead in the next frame, if there is one.
pub(crate) fn locate(
    world: &mut World,
    localiser: &mut Localiser,
    pixels: &mut Vec<u8>,
) -> Option<(FrameInfo, f64, f64, FixQuality)> {
    let info = world.take_frame(pixels)?;
    let frame = Frame {
        width: 256,
        height: 32,
        pixels: Pixels::Mono8(pixels),
    };
    let fix = localiser.locate(&frame, None);
    let x_um = world.config().um_from_px(fix.x_px);
    let sd_um = fix.var_x_px2.sqrt() * world.config().pixel_um;
    Some((info, x_um, sd_um, fix.verdict))
}

#[test]
fn vision_finds_the_bead_where_it_is_with_the_noise_that_positions_are_given() {
    let config = WorldConfig {
        diffusion_um2_per_s: 0.33,
        drift_um_per_s: 30.0,
        start_um: -8.0,
        ..WorldConfig::ideal()
    };
    let mut world = world(&config);
    let mut localiser = localiser();
    let mut pixels = Vec::new();
    let (mut sum, mut square, mut n) = (0.0, 0.0, 0.0);
    for k in 1..=600_i64 {
        world.advance_to(k * MS, 20.0);
        if let Some((info, x_um, sd_um, verdict)) = locate(&mut world, &mut localiser, &mut pixels)
        {
            assert_eq!(verdict, FixQuality::Good, "frame {}", info.id);
            let error = x_um - info.true_um;
            assert!(
                error.abs() < 6.0 * sd_um,
                "frame {}: {error} um, sd {sd_um} um",
                info.id
            );
            sum += error;
            square += error * error;
            n += 1.0;
        }
    }
    assert!(n > 590.0);
    let bound_um = world.localisation_um();
    let rms_um = (square / n).sqrt();
    assert!(
        (sum / n).abs() < 5.0 * bound_um / f64::sqrt(n) + 2e-4,
        "bias {} um",
        sum / n
    );
    assert!(
        rms_um > 0.85 * bound_um && rms_um < 1.25 * bound_um,
        "{rms_um} um against the bound {bound_um} um"
    );
}

#[test]
fn positions_scatter_by_the_localisation_noise_and_say_so() {
    for given in [None, Some(0.05)] {
        let config = WorldConfig {
            localisation_um: given,
            ..quiet()
        };
        let mut world = world(&config);
        let fixes = positions(&mut world, 5_000, 20.0);
        let n = fixes.len() as f64;
        let variance = fixes.iter().map(|fix| fix.x_um * fix.x_um).sum::<f64>() / n;
        let expected = world.localisation_um() * world.localisation_um();
        assert!((variance / expected - 1.0).abs() < 5.0 * (2.0 / n).sqrt());
        assert_eq!(fixes[0].variance_um2, expected);
    }
}

#[test]
fn pictures_and_positions_come_from_the_same_true_path() {
    let run = |pictures: bool| {
        let mut world = world(&WorldConfig::ideal());
        let mut truth = Vec::new();
        let mut pixels = Vec::new();
        for k in 1..=200_i64 {
            world.advance_to(k * MS, 20.0 + 0.01 * (k as f64).sin());
            let info = if pictures {
                world.take_frame(&mut pixels)
            } else {
                world.take_position().map(|fix| fix.info)
            };
            truth.extend(info.map(|info| info.true_um.to_bits()));
        }
        truth
    };
    assert_eq!(run(true), run(false));
}

#[test]
fn the_same_seed_gives_the_same_pixels_and_another_seed_others() {
    let run = |seed| {
        let mut world = world(&WorldConfig {
            seed,
            ..WorldConfig::ideal()
        });
        let mut pixels = Vec::new();
        world.advance_to(50 * MS, 20.0);
        while world.take_frame(&mut pixels).is_some() {}
        pixels
    };
    assert_eq!(run(3), run(3));
    assert_ne!(run(3), run(4));
}

#[test]
fn effects_of_the_model_at_the_cameras_place_are_taken_over() {
    let model = Model::eq6()
        .with_effect(effects::time_delay(0.003))
        .with_effect(effects::exposure_averaging(0.001))
        .with_effect(effects::frame_drops(0.5));
    let mut world = World::new(&quiet(), &model, 0).unwrap();
    let fixes = positions(&mut world, 1000, 20.0);
    assert!(fixes.len() > 400 && fixes.len() < 600);
    let info = fixes[0].info;
    assert_eq!(info.exposure_ns, MS);
    assert_eq!(info.delivery_ns - info.mid_exposure_ns, 3_500_000);
}

#[test]
fn the_led_lights_up_the_exposures_after_it() {
    let mut world = world(&quiet());
    world.advance_to(10 * MS, 20.0);
    world.set_led(true);
    world.advance_to(14 * MS, 20.0);
    let lit: Vec<f64> = std::iter::from_fn(|| world.take_position())
        .map(|fix| fix.info.lit)
        .collect();
    assert_eq!(lit[..9], [0.0; 9]);
    assert!(lit[9] > 0.0 && lit[9] < 1.0, "switched on in mid-exposure");
    assert_eq!(lit[10..], [1.0, 1.0]);
}

#[test]
fn values_that_cannot_be_are_refused_by_the_name_of_their_key() {
    let base = WorldConfig::ideal();
    for (config, key) in [
        (
            WorldConfig {
                rate_hz: f64::NAN,
                ..base.clone()
            },
            "`rate_hz`",
        ),
        (
            WorldConfig {
                exposure_ms: 1.5,
                ..base.clone()
            },
            "`exposure_ms`",
        ),
        (
            WorldConfig {
                latency_ms: 0.1,
                ..base.clone()
            },
            "`latency_ms`",
        ),
        (
            WorldConfig {
                contrast_grey: 0.0,
                ..base.clone()
            },
            "`contrast_grey`",
        ),
        (
            WorldConfig {
                faults: Faults {
                    drop_rate: 1.5,
                    ..Faults::default()
                },
                ..base.clone()
            },
            "`faults.drop_rate`",
        ),
    ] {
        let error = World::new(&config, &Model::eq6(), 0)
            .unwrap_err()
            .to_string();
        assert!(error.contains(key), "{error}");
    }
}

#[test]
fn a_table_reads_back_as_it_was_written_and_an_unknown_key_is_refused() {
    let config = WorldConfig {
        localisation_um: Some(0.03),
        faults: Faults::default().with(FaultKind::LinkLoss, 2.0, Some(0.5)),
        ..WorldConfig::ideal()
    };
    let text = toml::to_string(&config).unwrap();
    assert_eq!(toml::from_str::<WorldConfig>(&text).unwrap(), config);
    assert_eq!(
        toml::from_str::<WorldConfig>("").unwrap(),
        WorldConfig::default()
    );
    let error = toml::from_str::<WorldConfig>("latency_s = 0.002").unwrap_err();
    assert!(error.to_string().contains("latency_s"), "{error}");
}
