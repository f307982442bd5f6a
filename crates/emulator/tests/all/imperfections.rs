//! The rig as a real one is: nothing about it stands quite still.

use crate::world::{MS, positions, world};
use cellpos_emulator::{EmulatedRig, Imperfections, World, WorldConfig};
use cellpos_plant::Model;
use cellpos_vision::{Frame, Localiser, LocaliserConfig, Pixels, ProfileSpec};

fn quiet() -> WorldConfig {
    WorldConfig {
        diffusion_um2_per_s: 0.0,
        drift_um_per_s: 0.0,
        ..WorldConfig::ideal()
    }
}

#[test]
fn a_rig_that_is_not_ideal_has_the_imperfections_of_a_real_one() {
    let mut real = world(&WorldConfig::real());
    let fixes = positions(&mut real, 1000, 20.0);
    let first = &fixes[0].info;
    let last = &fixes[fixes.len() - 1].info;
    // 15 ppm over a second of exposures.
    let frames = (last.id - first.id) as f64;
    let late_ns = (last.mid_exposure_ns - first.mid_exposure_ns) as f64 - frames * 1e6;
    assert!(
        (late_ns - 15.0 * frames).abs() <= 2.0,
        "{late_ns} ns over {frames} frames"
    );
    let beyond_us: Vec<f64> = fixes
        .iter()
        .map(|fix| (fix.info.delivery_ns - fix.info.mid_exposure_ns) as f64 * 1e-3 - 2000.0)
        .collect();
    let mean = beyond_us.iter().sum::<f64>() / beyond_us.len() as f64;
    // Exponential with a mean of 30 us: five standard deviations of the mean of a thousand.
    assert!((mean - 30.0).abs() < 5.0, "{mean} us");
    // The exposure's own jitter of 2 us, at most four times that, is the only delay before the fastest.
    assert!(beyond_us.iter().all(|us| *us >= -8.0), "{beyond_us:?}");
    assert_eq!(
        world(&WorldConfig::real()).config().imperfections(),
        Imperfections::REAL
    );
}

#[test]
fn frames_arrive_in_their_order_whatever_the_jitter() {
    let config = WorldConfig {
        arrival_jitter_us: Some(2000.0),
        ..WorldConfig::real()
    };
    let fixes = positions(&mut world(&config), 2000, 20.0);
    assert!(fixes.windows(2).all(|pair| {
        pair[0].info.id + 1 == pair[1].info.id
            && pair[0].info.delivery_ns <= pair[1].info.delivery_ns
    }));
}

#[test]
fn a_seed_fixes_every_picture_and_an_ideal_rig_stands_still() {
    let frames = |config: &WorldConfig| {
        let mut world = World::new(config, &Model::eq6(), 0).unwrap();
        let (mut pixels, mut all) = (Vec::new(), Vec::new());
        for k in 1..=50 {
            world.advance_to(k * MS, 20.0);
            while let Some(info) = world.take_frame(&mut pixels) {
                all.push((info.delivery_ns, pixels.clone()));
            }
        }
        (all, world.zero_flow_um())
    };
    let config = WorldConfig::real();
    let (once, wandered_um) = frames(&config);
    assert!(once.len() > 40 && wandered_um != 20.0);
    assert_eq!(once, frames(&config).0);
    let other = WorldConfig { seed: 2, ..config };
    assert_ne!(once, frames(&other).0);
    assert_eq!(frames(&WorldConfig::ideal()).1, 20.0);
}

#[test]
fn across_an_askew_channel_the_calibration_finds_the_position_along_it() {
    let config = WorldConfig {
        tilt_deg: Some(3.0),
        lateral_um: Some(0.6),
        diffusion_um2_per_s: 3.0,
        ..quiet()
    };
    let calibration = EmulatedRig::calibration_of(&config);
    let edge_px = config.bead_radius_px();
    let mut localiser =
        Localiser::new(LocaliserConfig::new(ProfileSpec::Ring { edge_px })).unwrap();
    let mut world = world(&config);
    let mut pixels = Vec::new();
    let (mut error2, mut rows2, mut n) = (0.0, 0.0, 0.0);
    for k in 1..=400 {
        world.advance_to(k * MS, 20.0);
        while let Some(info) = world.take_frame(&mut pixels) {
            let frame = Frame {
                width: 256,
                height: 32,
                pixels: Pixels::Mono8(&pixels),
            };
            let fix = localiser.locate(&frame, None);
            error2 += (calibration.position_um(fix.x_px, fix.y_px) - info.true_um).powi(2);
            rows2 += (config.um_from_px(fix.x_px) - info.true_um).powi(2);
            n += 1.0;
        }
    }
    let (error_nm, rows_nm) = (1e3 * f64::sqrt(error2 / n), 1e3 * f64::sqrt(rows2 / n));
    // Localisation alone; a rule along the rows mistakes the walk across for one along.
    assert!(error_nm < 8.0, "{error_nm} nm");
    assert!(rows_nm > 2.0 * error_nm, "{rows_nm} nm");
}

#[test]
fn the_ring_grows_and_shrinks_as_the_focus_wanders() {
    let config = WorldConfig {
        focus_wander: Some(0.05),
        focus_time_s: Some(0.01),
        ..quiet()
    };
    let mut world = world(&config);
    let mut pixels = Vec::new();
    let mut centres = Vec::new();
    for k in 1..=400 {
        world.advance_to(k * MS, 20.0);
        while world.take_frame(&mut pixels).is_some() {
            let centre: f64 = (15..17)
                .flat_map(|y| (127..129).map(move |x| (x, y)))
                .map(|(x, y)| f64::from(pixels[y * 256 + x]))
                .sum();
            centres.push(0.25 * centre);
        }
    }
    let n = centres.len() as f64;
    let mean = centres.iter().sum::<f64>() / n;
    let sd = (centres.iter().map(|c| (c - mean).powi(2)).sum::<f64>() / n).sqrt();
    // 80 grey levels over the square of a size of 5 % RMS: 8; the noise of four pixels adds 1.2.
    assert!((5.0..12.0).contains(&sd), "{sd} grey levels");
}
