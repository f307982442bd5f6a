//! Localising a frame allocates nothing, whatever the verdict.

use cellpos_counting_alloc::allocations;
use cellpos_vision::{
    CellConfig, CellFinder, CellTracker, Commanded, FixQuality, Frame, Learning, Localiser,
    LocaliserConfig, PixelNoise, PixelResponse, Pixels, ProfileSpec, Tracker, TrackerConfig,
};

#[test]
fn locating_allocates_nothing_for_any_verdict() {
    let before = allocations();
    drop(std::hint::black_box(vec![0_u8; 100]));
    assert_eq!(allocations(), before + 1, "the counter must count");

    let spec = ProfileSpec::Ring { edge_px: 5.0 };
    let template = spec.template(PixelResponse::Point).unwrap();
    let mut image = vec![100.0_f32; 64 * 64];
    template.draw(&mut image, 64, 30.3, 31.7, 80.0);
    let mut ripple = 0.7_f32;
    for v in &mut image {
        ripple = 3.9 * ripple * (1.0 - ripple);
        *v += 4.0 * (ripple - 0.5);
    }
    let bead: Vec<u8> = image.iter().map(|v| v.round() as u8).collect();
    let bead16: Vec<u16> = image.iter().map(|v| (v * 16.0) as u16).collect();
    let blank = vec![100_u8; 64 * 64];
    let shot = PixelNoise::Known {
        read_sd_grey: 1.2,
        shot_grey_per_electron: 0.01,
        black_level_grey: 0.0,
    };
    for noise in [PixelNoise::Estimated, shot] {
        let mut localiser = Localiser::new(LocaliserConfig {
            noise,
            ..LocaliserConfig::new(spec)
        })
        .unwrap();
        let guesses = [
            None,
            Some((30.0, 32.0)),
            Some((36.0, 30.0)),
            Some((2.0, 2.0)),
            Some((-9.0, 4.0)),
            Some((f64::NAN, 0.0)),
        ];
        let frames = [
            Pixels::Mono8(&bead),
            Pixels::Mono16(&bead16),
            Pixels::Mono8(&blank),
            Pixels::Mono8(&bead[..50]),
        ];
        let mut good = 0;
        let before = allocations();
        for pixels in frames {
            for guess in guesses {
                let fix = localiser.locate(
                    &Frame {
                        width: 64,
                        height: 64,
                        pixels,
                    },
                    guess,
                );
                good += u32::from(fix.verdict == FixQuality::Good);
            }
        }
        assert_eq!(allocations(), before);
        assert!(good >= 3, "{good}");
    }
}

#[test]
fn tracking_through_an_encounter_and_a_loss_allocates_nothing() {
    let spec = ProfileSpec::Ring { edge_px: 4.5 };
    // Not quite the configured one: there is something to learn.
    let drawn = ProfileSpec::Ring { edge_px: 4.7 };
    let template = drawn.template(PixelResponse::Point).unwrap();
    let learning = Some(Learning {
        first_fixes: 5,
        refresh_fixes: 16,
        ..Learning::default()
    });
    let localiser = Localiser::new(LocaliserConfig {
        learning,
        ..LocaliserConfig::new(spec)
    })
    .unwrap();
    let mut tracker = Tracker::new(localiser, TrackerConfig::default()).unwrap();
    let (width, height) = (96, 64);
    let mut ripple = 0.7_f32;
    let frames: Vec<Vec<u8>> = (0..240)
        .map(|n| {
            let mut image = vec![100.0_f32; width * height];
            if n < 160 {
                template.draw(&mut image, width, 40.0, 30.0, 80.0);
                template.draw(&mut image, width, 0.6 * f64::from(n), 36.0, 80.0);
            }
            let mut noisy = |v: &f32| {
                ripple = 3.9 * ripple * (1.0 - ripple);
                (v + 4.0 * (ripple - 0.5)).round() as u8
            };
            image.iter().map(&mut noisy).collect()
        })
        .collect();
    let mut states = [0_u32; 4];
    tracker.choose(Some((40.0, 30.0)));
    let before = allocations();
    for (n, pixels) in frames.iter().enumerate() {
        let frame = Frame {
            width,
            height,
            pixels: Pixels::Mono8(pixels),
        };
        // A streak's template is drawn in place, too.
        let commanded = Commanded {
            streak_px: if n % 8 == 7 { (3.0, 0.0) } else { (0.0, 0.0) },
            turn_px: (0.0, 0.0),
            exposure_s: 5e-4,
            ..Commanded::default()
        };
        let step = tracker.step(Some(&frame), n as f64 * 1e-3, commanded);
        states[step.state as usize] += 1;
    }
    assert_eq!(allocations(), before);
    assert!(
        states.iter().all(|n| *n > 0),
        "every state must have been passed through: {states:?}"
    );
    assert!(tracker.localiser().learning().taken >= 1);
}

#[test]
fn finding_and_following_a_cell_allocates_nothing() {
    let mut finder = CellFinder::new(64, 48, CellConfig::default()).unwrap();
    let empty = vec![100_u8; 64 * 48];
    let mut cell = empty.clone();
    for k in 0..200 {
        cell[(10 + k / 20) * 64 + 20 + k % 20] = 150;
    }
    let frame = |pixels| Frame {
        width: 64,
        height: 48,
        pixels: Pixels::Mono8(pixels),
    };
    let before = allocations();
    finder.take_background(&frame(&empty)).unwrap();
    finder.take_background(&frame(&empty)).unwrap();
    let found = finder.find(&frame(&cell)).unwrap().len();
    assert_eq!(allocations(), before);
    assert_eq!(found, 1);
    let mut tracker = CellTracker::new(finder, TrackerConfig::default()).unwrap();
    let before = allocations();
    let mut taken = 0;
    for n in 0..200 {
        // Seen, gone, and seen again: found, followed, lost and taken anew.
        let shown = if (50..150).contains(&n) {
            &empty
        } else {
            &cell
        };
        let step = tracker.step(Some(&frame(shown)), f64::from(n) * 1e-3, (0.0, 0.0));
        taken += u32::from(step.is_ok_and(|step| step.cell.is_some()));
    }
    assert_eq!(allocations(), before);
    assert_eq!(taken, 98);
}
