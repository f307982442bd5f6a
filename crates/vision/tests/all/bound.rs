//! The localiser against the Cramer-Rao bound, beside methods that need no template.

use crate::common::{BACKGROUND, Errors, Random, SIDE, bound, frame, known_noise, render};
use cellpos_vision::{
    FixQuality, GaussianProfile, Learning, Localiser, LocaliserConfig, PixelNoise, Polarity,
    ProfileSpec, RadialProfile, RadialSymmetry, RingProfile,
};

const NOISE: f64 = 100.0;
const FRAMES: usize = 2000;

fn profiles() -> [(&'static str, ProfileSpec, Box<dyn RadialProfile>); 2] {
    let edge_px = RingProfile::MEASURED_EDGE_PX;
    [
        (
            "gaussian",
            ProfileSpec::Gaussian { sigma_px: 3.0 },
            Box::new(GaussianProfile::new(3.0).unwrap()),
        ),
        (
            "ring",
            ProfileSpec::Ring { edge_px },
            Box::new(RingProfile::new(edge_px).unwrap()),
        ),
    ]
}

#[test]
fn error_reaches_the_cramer_rao_bound_without_bias() {
    println!(
        "{FRAMES} frames of {SIDE} x {SIDE} px each, random sub-pixel positions; RMS error / bound, bias x, y (px)"
    );
    println!(
        "profile   SNR  bound px | template           | radial symmetry     | threshold centroid"
    );
    for (name, spec, profile) in profiles() {
        for snr in [10.0, 20.0, 40.0, 80.0] {
            let config = LocaliserConfig {
                window_px: SIDE,
                noise: known_noise(NOISE),
                ..LocaliserConfig::new(spec)
            };
            let mut localiser = Localiser::new(config).unwrap();
            let mut symmetry = RadialSymmetry::new(SIDE);
            let mut random = Random(7 + snr as u64);
            let (mut ours, mut radial, mut centroid) =
                (Errors::default(), Errors::default(), Errors::default());
            let (mut z2, mut bound_px) = (0.0, 0.0);
            for _ in 0..FRAMES {
                let (x, y) = (11.5 + random.uniform(), 11.5 + random.uniform());
                let pixels = render(profile.as_ref(), x, y, snr * NOISE, NOISE, &mut random);
                let frame = frame(&pixels);
                let fix = localiser.locate(&frame, None);
                assert_eq!(
                    fix.verdict,
                    FixQuality::Good,
                    "{name} {snr} {x} {y} {fix:?}"
                );
                let limit = bound(profile.as_ref(), x, y, snr);
                bound_px += limit.0 / FRAMES as f64;
                let (ex, ey) = (fix.x_px - x, fix.y_px - y);
                ours.add((ex, ey), limit);
                z2 += 0.5 * (ex * ex / fix.var_x_px2 + ey * ey / fix.var_y_px2) / FRAMES as f64;
                let (rx, ry) = symmetry.locate(&frame, 12.0, 12.0).unwrap();
                radial.add((rx - x, ry - y), limit);
                let radius_px = profile.radius_px();
                let (cx, cy) = symmetry
                    .threshold_centroid(&frame, 12.0, 12.0, Polarity::Bright, radius_px)
                    .unwrap();
                centroid.add((cx - x, cy - y), limit);
            }
            let cell =
                |e: &Errors| format!("{:6.3} {:+.4} {:+.4}", e.ratio(), e.bias().0, e.bias().1);
            let cells = [cell(&ours), cell(&radial), cell(&centroid)].join(" | ");
            println!(
                "{name:8} {snr:4}   {bound_px:.5} | {cells}   covariance: z {:.3}",
                z2.sqrt()
            );
            let (ratio, bias) = (ours.ratio(), ours.bias());
            assert!(ratio <= 1.03, "{name} SNR {snr}: RMS/CRB {ratio}");
            assert!(
                ratio > 0.95,
                "{name} SNR {snr}: RMS/CRB {ratio}: below the bound, so the bound is wrong"
            );
            assert!(
                (z2.sqrt() - 1.0).abs() < 0.05,
                "{name} SNR {snr}: covariance off by {}",
                z2.sqrt()
            );
            assert!(
                bias.0.abs() < 0.005 && bias.1.abs() < 0.005,
                "{name} SNR {snr}: bias {bias:?} px"
            );
        }
    }
}

#[test]
fn bias_stays_below_5_millipixels_in_every_part_of_the_pixel() {
    for (name, spec, profile) in profiles() {
        let config = LocaliserConfig {
            window_px: SIDE,
            noise: known_noise(NOISE),
            ..LocaliserConfig::new(spec)
        };
        let mut localiser = Localiser::new(config).unwrap();
        let mut random = Random(3);
        let mut bins = [(0.0, 0.0); 10];
        for k in 0..FRAMES {
            let (x, y) = (
                11.5 + (k as f64 + 0.5) / FRAMES as f64,
                11.5 + random.uniform(),
            );
            let pixels = render(profile.as_ref(), x, y, 80.0 * NOISE, NOISE, &mut random);
            let fix = localiser.locate(&frame(&pixels), Some((x + 0.3, y - 0.3)));
            let bin = &mut bins[(10.0 * (x - 11.5)) as usize];
            *bin = (bin.0 + fix.x_px - x, bin.1 + 1.0);
        }
        let bias: Vec<f64> = bins.iter().map(|(s, n)| s / n).collect();
        println!("{name}: bias by sub-pixel position, px: {bias:.4?}");
        assert!(bias.iter().all(|b| b.abs() < 0.005), "{name}: {bias:?}");
    }
}

#[test]
fn shot_noise_is_weighted_as_the_bound_asks() {
    // Grey levels per electron so large that the core is four times as noisy as the ring.
    let (gain, read, amplitude, black) = (8.0, 60.0, 6000.0, BACKGROUND - 4000.0);
    let profile = RingProfile::new(RingProfile::MEASURED_EDGE_PX).unwrap();
    let noise = PixelNoise::Known {
        read_sd_grey: read,
        shot_grey_per_electron: gain,
        black_level_grey: black,
    };
    let spec = ProfileSpec::Ring {
        edge_px: RingProfile::MEASURED_EDGE_PX,
    };
    let run = |noise: PixelNoise| {
        let mut localiser = Localiser::new(LocaliserConfig {
            window_px: SIDE,
            noise,
            ..LocaliserConfig::new(spec)
        })
        .unwrap();
        let mut random = Random(11);
        let (mut squares, mut claimed, mut chi2) = (0.0, 0.0, 0.0);
        for _ in 0..FRAMES {
            let (x, y) = (11.5 + random.uniform(), 11.5 + random.uniform());
            let pixel = |k: usize| {
                let r = f64::hypot((k % SIDE) as f64 - x, (k / SIDE) as f64 - y);
                let light = BACKGROUND - black + amplitude * profile.value(r);
                let sd = (read * read + gain * light).sqrt();
                (black + light + sd * random.normal()).round() as u16
            };
            let pixels: Vec<u16> = (0..SIDE * SIDE).map(pixel).collect();
            let fix = localiser.locate(&frame(&pixels), Some((12.0, 12.0)));
            assert_eq!(fix.verdict, FixQuality::Good, "{fix:?}");
            squares += ((fix.x_px - x).powi(2) + (fix.y_px - y).powi(2)) / (2 * FRAMES) as f64;
            claimed += (fix.var_x_px2 + fix.var_y_px2) / (2 * FRAMES) as f64;
            chi2 += fix.residual_ratio / FRAMES as f64;
        }
        (squares.sqrt(), claimed.sqrt(), chi2)
    };
    let (weighted, claimed, chi2) = run(noise);
    let (even, ..) = run(PixelNoise::Estimated);
    println!(
        "shot noise: weighted {weighted:.5} px, claimed {claimed:.5} px, even weights {even:.5} px, chi2 {chi2:.3}"
    );
    assert!((weighted / claimed - 1.0).abs() < 0.04 && (chi2 - 1.0).abs() < 0.03);
    assert!(weighted < even);
}

/// The measured bead with a shallower ring: no size of the configured one is like it.
struct Shallow(RingProfile);

impl Shallow {
    fn fill(r_px: f64) -> f64 {
        0.15 * (-0.25 * (r_px - 9.0).powi(2)).exp()
    }
}

impl RadialProfile for Shallow {
    fn value(&self, r_px: f64) -> f64 {
        self.0.value(r_px) + Self::fill(r_px)
    }
    fn slope(&self, r_px: f64) -> f64 {
        self.0.slope(r_px) - 0.5 * (r_px - 9.0) * Self::fill(r_px)
    }
    fn radius_px(&self) -> f64 {
        self.0.radius_px()
    }
    fn support_px(&self) -> f64 {
        self.0.support_px()
    }
}

#[test]
fn a_learnt_template_brings_a_wrong_one_to_the_bound() {
    let truth = Shallow(RingProfile::new(RingProfile::MEASURED_EDGE_PX).unwrap());
    let spec = ProfileSpec::Ring {
        edge_px: RingProfile::MEASURED_EDGE_PX,
    };
    let snr = 80.0;
    let run = |learning: Option<Learning>| {
        let config = LocaliserConfig {
            window_px: SIDE,
            noise: known_noise(NOISE),
            learning,
            ..LocaliserConfig::new(spec)
        };
        let mut localiser = Localiser::new(config).unwrap();
        let mut random = Random(5);
        let (mut errors, mut residual) = (Errors::default(), 0.0);
        for n in 0..200 + FRAMES {
            let (x, y) = (11.5 + random.uniform(), 11.5 + random.uniform());
            let pixels = render(&truth, x, y, snr * NOISE, NOISE, &mut random);
            let fix = localiser.locate(&frame(&pixels), Some((12.0, 12.0)));
            if n >= 200 {
                errors.add((fix.x_px - x, fix.y_px - y), bound(&truth, x, y, snr));
                residual += fix.residual_ratio / FRAMES as f64;
            }
        }
        (errors.ratio(), residual, localiser.learning())
    };
    let learning = Learning {
        first_fixes: 100,
        refresh_fixes: 1000,
        ..Learning::default()
    };
    let (fixed, fixed_residual, _) = run(None);
    let (learnt, learnt_residual, report) = run(Some(learning));
    println!("configured with too deep a ring: RMS/CRB {fixed:.3}, residual {fixed_residual:.1}");
    println!("learnt: RMS/CRB {learnt:.3}, residual {learnt_residual:.2}, {report:?}");
    assert!(
        learnt <= 1.05 && learnt < fixed,
        "learnt {learnt}, configured {fixed}"
    );
    assert!(learnt_residual < 1.2 && fixed_residual > 2.0);
    assert!(report.taken >= 2 && report.refused == 0);
}

#[test]
fn a_template_too_different_from_the_configured_one_is_not_learnt() {
    let other = GaussianProfile::new(4.0).unwrap();
    let spec = ProfileSpec::Ring {
        edge_px: RingProfile::MEASURED_EDGE_PX,
    };
    let learning = Some(Learning {
        first_fixes: 20,
        refresh_fixes: 20,
        max_change: 0.05,
    });
    // A tolerance that lets the wrong object through, so that the guard alone stands.
    let config = LocaliserConfig {
        learning,
        template_tolerance: 0.9,
        ..LocaliserConfig::new(spec)
    };
    let mut localiser = Localiser::new(config).unwrap();
    let mut random = Random(5);
    for _ in 0..100 {
        let pixels = render(&other, 12.1, 11.8, 60.0 * NOISE, NOISE, &mut random);
        localiser.locate(&frame(&pixels), Some((12.0, 12.0)));
    }
    let report = localiser.learning();
    assert!(report.refused >= 4 && report.taken == 0, "{report:?}");
}

#[test]
fn size_of_a_bead_is_measured_relative_to_the_template() {
    let spec = ProfileSpec::Ring {
        edge_px: RingProfile::MEASURED_EDGE_PX,
    };
    let mut random = Random(8);
    for size in [0.95, 1.0, 1.05] {
        let profile = RingProfile::new(size * RingProfile::MEASURED_EDGE_PX).unwrap();
        let mut localiser = Localiser::new(LocaliserConfig {
            noise: known_noise(NOISE),
            ..LocaliserConfig::new(spec)
        })
        .unwrap();
        let (mut sum, mut z2, n) = (0.0, 0.0, 200);
        for _ in 0..n {
            let (x, y) = (11.5 + random.uniform(), 11.5 + random.uniform());
            let pixels = render(&profile, x, y, 50.0 * NOISE, NOISE, &mut random);
            let fix = localiser.locate(&frame(&pixels), Some((12.0, 12.0)));
            let (measured, sd) = localiser.relative_size(&fix).unwrap();
            sum += measured / f64::from(n);
            z2 += ((measured - size) / sd).powi(2) / f64::from(n);
        }
        println!("size {size}: measured {sum:.4}, z {:.2}", z2.sqrt());
        assert!((sum - size).abs() < 0.005, "{size}: {sum}");
        if size == 1.0 {
            assert!((z2.sqrt() - 1.0).abs() < 0.15, "{z2}");
        }
    }
}

#[test]
fn dark_beads_are_found_by_a_dark_localiser_and_are_no_signal_to_a_bright_one() {
    let profile = GaussianProfile::new(3.0).unwrap();
    let spec = ProfileSpec::Gaussian { sigma_px: 3.0 };
    let mut random = Random(9);
    let pixels = render(&profile, 12.3, 11.9, -40.0 * NOISE, NOISE, &mut random);
    let locate = |polarity| {
        let config = LocaliserConfig {
            polarity,
            ..LocaliserConfig::new(spec)
        };
        Localiser::new(config)
            .unwrap()
            .locate(&frame(&pixels), None)
    };
    let dark = locate(Polarity::Dark);
    assert_eq!(dark.verdict, FixQuality::Good);
    assert!((dark.x_px - 12.3).abs() < 0.1 && dark.snr > 30.0);
    assert_eq!(locate(Polarity::Bright).verdict, FixQuality::NoSignal);
}

#[test]
fn noise_alone_gives_no_signal() {
    let spec = ProfileSpec::Ring { edge_px: 5.0 };
    let nothing = GaussianProfile::new(3.0).unwrap();
    let mut localiser = Localiser::new(LocaliserConfig::new(spec)).unwrap();
    let mut random = Random(10);
    for n in 0..300 {
        let pixels = render(&nothing, 12.0, 12.0, 0.0, NOISE, &mut random);
        let guess = if n % 2 == 0 { None } else { Some((12.0, 12.0)) };
        let fix = localiser.locate(&frame(&pixels), guess);
        assert_ne!(fix.verdict, FixQuality::Good, "{fix:?}");
    }
}
