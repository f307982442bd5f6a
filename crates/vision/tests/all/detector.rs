//! What the detector sees in uneven light, beside stronger things, in noise, blur and motion, and how many.

use crate::common::Random;
use cellpos_vision::{
    Detector, Frame, LinkConfig, Localiser, LocaliserConfig, ManyTracker, Pixels, ProfileSpec,
    RadialProfile, RingProfile,
};

/// Places and peak contrasts of beads on a level that depends on the place, blurred and moved during the exposure.
struct Scene {
    size: (usize, usize),
    edge_px: f64,
    beads: Vec<(f64, f64, f64)>,
    noise: f64,
    /// Standard deviation of a blur, and length of a motion along the rows, px.
    blur_px: f64,
    motion_px: f64,
    level: fn(f64, f64) -> f64,
}

impl Scene {
    fn draw(&self, seed: u64) -> Vec<u8> {
        let (width, height) = self.size;
        let ring = RingProfile::new(self.edge_px).unwrap();
        let mut random = Random(seed);
        let mut grey: Vec<f64> = (0..width * height)
            .map(|k| (self.level)((k % width) as f64, (k / width) as f64))
            .collect();
        // Blur and motion by sub-exposures, so that they are exact where the bead is drawn.
        let steps = if self.blur_px + self.motion_px > 0.0 {
            24
        } else {
            1
        };
        for &(x, y, contrast) in &self.beads {
            for step in 0..steps {
                let t = (step as f64 + 0.5) / steps as f64 - 0.5;
                // Golden angles spread a blur evenly; radii give it a normal distribution.
                let (angle, share) = (2.399_963 * step as f64, (step as f64 + 0.5) / steps as f64);
                let radius = self.blur_px * (-2.0 * (1.0 - share).ln()).sqrt();
                let (cx, cy) = (
                    x + self.motion_px * t + radius * angle.cos(),
                    y + radius * angle.sin(),
                );
                let reach = 2.6 * self.edge_px;
                for j in (cy - reach).max(0.0) as usize..((cy + reach) as usize).min(height) {
                    for i in (cx - reach).max(0.0) as usize..((cx + reach) as usize).min(width) {
                        let r = f64::hypot(i as f64 - cx, j as f64 - cy);
                        grey[j * width + i] += contrast * ring.value(r) / steps as f64;
                    }
                }
            }
        }
        grey.iter()
            .map(|v| (v + self.noise * random.normal()).round().clamp(0.0, 255.0) as u8)
            .collect()
    }

    /// Share of the beads found with a good fix, others found, and refused.
    fn look(&self, seed: u64) -> (f64, usize, usize) {
        let config = LocaliserConfig {
            template_tolerance: 0.2,
            ..LocaliserConfig::new(ProfileSpec::Ring {
                edge_px: self.edge_px,
            })
        };
        let link = LinkConfig {
            max_step_px: 5.0,
            memory_frames: 1,
            max_beads: 20_000,
        };
        let mut many = ManyTracker::new(Localiser::new(config).unwrap(), link);
        let pixels = self.draw(seed);
        let frame = Frame {
            width: self.size.0,
            height: self.size.1,
            pixels: Pixels::Mono8(&pixels),
        };
        let sights = many.step(&frame).to_vec();
        // Light that falls off within the window itself draws a large bead by some hundredths of its radius.
        let most_px = (0.06 * self.edge_px).max(1.5);
        let near = |x: f64, y: f64| {
            sights
                .iter()
                .any(|s| f64::hypot(s.fix.x_px - x, s.fix.y_px - y) < most_px)
        };
        let found = self.beads.iter().filter(|b| near(b.0, b.1)).count();
        (
            found as f64 / self.beads.len() as f64,
            sights.len() - found,
            many.refused().len(),
        )
    }
}

/// Beads of a contrast on a grid, jittered.
fn grid(size: (usize, usize), apart: f64, contrast: f64, seed: u64) -> Vec<(f64, f64, f64)> {
    let mut random = Random(seed);
    let count = |side: usize| (side as f64 / apart) as usize;
    let mut beads = Vec::new();
    for j in 0..count(size.1) {
        for i in 0..count(size.0) {
            let mut at =
                |k: usize| apart * (k as f64 + 0.5) + 0.8 * random.normal().clamp(-2.0, 2.0);
            beads.push((at(i), at(j), contrast));
        }
    }
    beads
}

fn scene(noise: f64) -> Scene {
    let size = (480, 360);
    Scene {
        size,
        edge_px: 6.4,
        beads: grid(size, 60.0, 40.0, 3),
        noise,
        blur_px: 0.0,
        motion_px: 0.0,
        level: |_, _| 110.0,
    }
}

#[test]
fn beads_of_a_radius_of_40_px_and_of_6_px_are_found_in_uneven_light() {
    // From 60 to 160 grey levels across the frame, darker towards the corners: more than the beads' own contrast.
    let level: fn(f64, f64) -> f64 = |x, y| 60.0 + 0.14 * x + 0.05 * y - 1e-4 * (x - 320.0).powi(2);
    for (edge_px, apart) in [(40.0, 200.0), (6.4, 60.0)] {
        let size = (800, 600);
        let scene = Scene {
            size,
            edge_px,
            beads: grid(size, apart, 40.0, 5),
            level,
            ..scene(2.0)
        };
        let (recall, others, refused) = scene.look(1);
        println!(
            "edge {edge_px} px, uneven light: recall {recall:.3}, {others} others, {refused} refused"
        );
        assert!(recall == 1.0 && others == 0, "{edge_px}: {recall} {others}");
    }
}

#[test]
fn thousands_of_beads_in_a_frame_are_all_found() {
    let size = (1200, 1200);
    let scene = Scene {
        size,
        edge_px: 3.0,
        beads: grid(size, 20.0, 80.0, 6),
        ..scene(2.0)
    };
    let (recall, others, refused) = scene.look(2);
    println!(
        "{} beads: recall {recall:.4}, {others} others, {refused} refused",
        scene.beads.len()
    );
    assert!(
        scene.beads.len() == 3600 && recall > 0.999 && others == 0,
        "{recall} {others}"
    );
}

#[test]
fn weak_beads_are_seen_beside_a_strong_one() {
    let mut scene = scene(1.0);
    scene.beads = vec![
        (60.3, 70.1, 140.0),
        (200.2, 70.4, 12.0),
        (330.7, 220.3, 9.0),
    ];
    let (recall, others, refused) = scene.look(3);
    println!(
        "beads of 140, 12 and 9 grey levels: recall {recall:.3}, {others} others, {refused} refused"
    );
    assert!(recall == 1.0 && others == 0, "{recall} {others}");
}

#[test]
fn recall_falls_gradually_with_noise_blur_and_motion_and_not_with_the_offset() {
    let run = |name: &str, value: f64, scene: Scene| {
        let (recall, others, refused) = scene.look(4);
        println!("{name} {value}: recall {recall:.3}, {others} others, {refused} refused");
        assert!(others <= 1, "{name} {value}: {others} others");
        let told = recall + refused as f64 / scene.beads.len() as f64;
        assert!(told > 0.99, "{name} {value}: neither found nor refused");
        recall
    };
    for offset in [40.0_f64, 110.0, 190.0] {
        let level: fn(f64, f64) -> f64 = match offset as u32 {
            40 => |_, _| 40.0,
            110 => |_, _| 110.0,
            _ => |_, _| 190.0,
        };
        assert_eq!(
            run(
                "offset",
                offset,
                Scene {
                    level,
                    ..scene(2.0)
                }
            ),
            1.0
        );
    }
    let falls = |name: &str, values: &[f64], least: &[f64], make: &dyn Fn(f64) -> Scene| {
        let recalls: Vec<f64> = values.iter().map(|v| run(name, *v, make(*v))).collect();
        for (k, (recall, least)) in recalls.iter().zip(least).enumerate() {
            assert!(recall >= least, "{name} {}: {recall}", values[k]);
        }
    };
    // Contrast 40: signal to noise ratios from 20 down to 2.7; `min_snr` is 3.
    falls(
        "noise",
        &[2.0, 4.0, 8.0, 10.0, 11.0, 12.0, 13.0, 15.0],
        &[1.0, 1.0, 1.0, 1.0, 0.95, 0.8, 0.5, 0.0],
        &scene,
    );
    falls("blur", &[1.0, 2.0, 3.0, 4.0], &[1.0, 1.0, 0.9, 0.3], &|v| {
        Scene {
            blur_px: v,
            ..scene(2.0)
        }
    });
    falls(
        "motion",
        &[3.0, 6.0, 9.0, 10.0],
        &[1.0, 1.0, 0.9, 0.0],
        &|v| Scene {
            motion_px: v,
            ..scene(2.0)
        },
    );
}

#[test]
fn a_look_at_a_large_frame_with_one_bead_takes_less_than_ten_sums_over_its_pixels() {
    // Against a sum of floats in order, which no compiler makes faster than one addition after another: the same share on a
    // slow or busy machine. The shortest of many looks is the one that nothing has interrupted.
    let side = 500;
    let spec = ProfileSpec::Ring { edge_px: 6.4 };
    let localiser = Localiser::new(LocaliserConfig::new(spec)).unwrap();
    let mut image = vec![120.0_f32; side * side];
    localiser
        .template()
        .draw(&mut image, side, 250.3, 249.8, 80.0);
    let mut random = Random(3);
    let pixels: Vec<u8> = image
        .iter()
        .map(|v| (f64::from(*v) + 2.0 * random.normal()).round() as u8)
        .collect();
    let frame = Frame {
        width: side,
        height: side,
        pixels: Pixels::Mono8(&pixels),
    };
    let mut detector = Detector::new(&localiser, 100);
    let shortest = |work: &mut dyn FnMut()| {
        let times = (0..60).map(|_| {
            let start = std::time::Instant::now();
            work();
            start.elapsed()
        });
        times.min().unwrap().as_secs_f64()
    };
    let mut found = 0;
    let look = shortest(&mut || found = detector.detect(&frame).len());
    assert_eq!(found, 1);
    let sum = shortest(&mut || {
        std::hint::black_box(pixels.iter().map(|v| f32::from(*v)).sum::<f32>());
    });
    println!("look {:.0} us, sum {:.0} us", 1e6 * look, 1e6 * sum);
    assert!(look < 10.0 * sum, "{look} s against {sum} s");
}
