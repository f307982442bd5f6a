//! Tracking in rendered scenes that are hard to see in.

use crate::scene_camera::{SceneCamera, SceneConfig};
use cellpos_rig::{Camera, Clock, FrameBuffer};
use cellpos_vision::{
    Learning, Localiser, LocaliserConfig, ProfileSpec, TrackState, Tracker, TrackerConfig,
};

/// Share of frames tracked and RMS error along both axes, px.
fn track(config: SceneConfig, frames: usize) -> (f64, f64) {
    let aim = (config.beads[0].x_px, config.beads[0].y_px);
    let flow = (config.beads[0].x_px_per_s, config.beads[0].y_px_per_s);
    let learning = Some(Learning::default());
    let localiser = LocaliserConfig {
        learning,
        template_tolerance: 0.12,
        ..LocaliserConfig::new(ProfileSpec::Ring {
            edge_px: config.beads[0].edge_px,
        })
    };
    let mut tracker =
        Tracker::new(Localiser::new(localiser).unwrap(), TrackerConfig::default()).unwrap();
    tracker.choose(Some(aim));
    let mut camera = SceneCamera::new(config, Clock::virtual_at(0)).unwrap();
    let mut buffer = FrameBuffer::default();
    let (mut tracked, mut squares) = (0, 0.0);
    for _ in 0..frames {
        let stamp = camera.next_frame(&mut buffer, i64::MAX).unwrap().unwrap();
        let t = tracker.step(
            Some(&buffer.frame()),
            stamp.mid_exposure_ns as f64 * 1e-9,
            flow,
        );
        if t.state == TrackState::Tracking {
            let (x, y) = camera.places()[0];
            let error_px = f64::hypot(t.fix.x_px - x, t.fix.y_px - y);
            assert!(
                error_px < 2.0,
                "another object is followed: {t:?}, bead at {x} {y}"
            );
            squares += 0.5 * error_px * error_px;
            tracked += 1;
        }
    }
    (
        tracked as f64 / frames as f64,
        (squares / tracked as f64).sqrt(),
    )
}

#[test]
fn dust_uneven_and_flickering_light_and_defocus_cost_little() {
    let mut calm = SceneConfig {
        light_slope: 0.0,
        vignette: 0.0,
        flicker: 0.0,
        defocus: 0.0,
        ..SceneConfig::default()
    };
    calm.dust.clear();
    calm.beads
        .iter_mut()
        .for_each(|b| b.diffusion_px2_per_s = 5.0);
    let mut hard = SceneConfig::default();
    hard.beads
        .iter_mut()
        .for_each(|b| b.diffusion_px2_per_s = 5.0);
    let (calm_share, calm_px) = track(calm, 500);
    let (hard_share, hard_px) = track(hard, 500);
    println!(
        "calm: tracked {calm_share:.4}, RMS {calm_px:.4} px; hard: tracked {hard_share:.4}, RMS {hard_px:.4} px"
    );
    assert!(calm_share > 0.99 && hard_share > 0.98);
    assert!(calm_px < 0.03 && hard_px < 0.06);
}

#[test]
fn a_bead_blurred_by_its_own_motion_is_placed_at_the_middle_of_the_exposure() {
    let mut config = SceneConfig {
        exposure_share: 1.0,
        ..SceneConfig::default()
    };
    config.beads.truncate(1);
    let bead = &mut config.beads[0];
    (bead.x_px, bead.x_px_per_s, bead.diffusion_px2_per_s) = (30.0, 800.0, 1.0);
    let (share, rms_px) = track(config, 80);
    println!("800 px/s: tracked {share:.3}, RMS {rms_px:.4} px");
    assert!(share > 0.95 && rms_px < 0.06);
}

#[test]
fn a_seed_fixes_every_picture_and_bad_scenes_are_refused_by_key() {
    let picture = |seed| {
        let mut camera = SceneCamera::new(
            SceneConfig {
                seed,
                ..SceneConfig::default()
            },
            Clock::virtual_at(0),
        )
        .unwrap();
        let mut buffer = FrameBuffer::default();
        for _ in 0..3 {
            camera.next_frame(&mut buffer, i64::MAX).unwrap();
        }
        buffer.mono8
    };
    assert_eq!(picture(1), picture(1));
    assert_ne!(picture(1), picture(2));
    let refused = |config| {
        SceneCamera::new(config, Clock::virtual_at(0))
            .unwrap_err()
            .key
    };
    assert_eq!(
        refused(SceneConfig {
            width_px: 0,
            ..SceneConfig::default()
        }),
        "width_px"
    );
    assert_eq!(
        refused(SceneConfig {
            flicker: f64::NAN,
            ..SceneConfig::default()
        }),
        "flicker"
    );
}
