//! Beads that move while the shutter is open: their images are streaks, and the fit knows it.

mod common;

use cellpos_vision::{
    Frame, Localiser, LocaliserConfig, Noise, Pixels, ProfileSpec, RadialProfile, RingProfile,
    Verdict,
};
use common::{BACKGROUND, Errors, Random};
use nalgebra::{Matrix4, Vector4};

const WIDTH: usize = 65;
const HEIGHT: usize = 33;
const WINDOW: usize = 31;
const NOISE: f64 = 100.0;
const EDGE_PX: f64 = 5.0;
/// Points that stand for the exposure: more than the localiser has.
const POINTS: usize = 96;

/// Value and derivatives by the centre of a streak along `way`, at a distance from its middle.
fn streak(p: &RingProfile, (dx, dy): (f64, f64), way: (f64, f64)) -> (f64, f64, f64) {
    let mut sums = (0.0, 0.0, 0.0);
    for k in 0..POINTS {
        let at = (k as f64 + 0.5) / POINTS as f64 - 0.5;
        let (x, y) = (dx - at * way.0, dy - at * way.1);
        let r = f64::hypot(x, y).max(1e-9);
        let slope = -p.slope(r) / r;
        sums = (sums.0 + p.value(r), sums.1 + slope * x, sums.2 + slope * y);
    }
    let n = POINTS as f64;
    (sums.0 / n, sums.1 / n, sums.2 / n)
}

fn render(
    p: &RingProfile,
    (x, y): (f64, f64),
    way: (f64, f64),
    snr: f64,
    random: &mut Random,
) -> Vec<u16> {
    let pixel = |k: usize| {
        let d = ((k % WIDTH) as f64 - x, (k / WIDTH) as f64 - y);
        let value = streak(p, d, way).0;
        (BACKGROUND + snr * NOISE * value + NOISE * random.normal()).round() as u16
    };
    (0..WIDTH * HEIGHT).map(pixel).collect()
}

/// Cramer-Rao bound of x and y in the localiser's window, px.
fn bound(p: &RingProfile, way: (f64, f64), snr: f64) -> (f64, f64) {
    let half = (WINDOW / 2) as i64;
    let mut information = Matrix4::zeros();
    for j in -half..=half {
        for i in -half..=half {
            let (f, fx, fy) = streak(p, (i as f64, j as f64), way);
            let g = Vector4::new(snr * fx, snr * fy, snr * f, snr);
            information += g * g.transpose();
        }
    }
    let c = information
        .try_inverse()
        .expect("a bead carries information");
    (c[(0, 0)].sqrt(), c[(1, 1)].sqrt())
}

fn localiser() -> Localiser {
    let config = LocaliserConfig {
        window_px: WINDOW,
        noise: Noise::Known {
            read_sd_grey: NOISE,
            shot_grey_per_electron: 0.0,
            black_level_grey: 0.0,
        },
        ..LocaliserConfig::new(ProfileSpec::Ring { edge_px: EDGE_PX })
    };
    Localiser::new(config).unwrap()
}

#[test]
fn streaks_are_localised_at_their_bound_though_the_speed_is_half_known() {
    let profile = RingProfile::new(EDGE_PX).unwrap();
    println!(
        "way px  expected  SNR  bound x, y (px)  error / bound  bias x, y (px)  good  residual"
    );
    for (way, snr) in [
        ((4.0, 0.0), 20.0),
        ((8.0, 0.0), 20.0),
        ((8.0, 0.0), 60.0),
        ((7.5, -2.7), 40.0),
        ((15.0, 0.0), 40.0),
    ] {
        for known in [0.6, 1.6] {
            let mut localiser = localiser();
            let mut random = Random(11);
            let limit = bound(&profile, way, snr);
            let mut errors = Errors::default();
            let (mut good, mut residual) = (0, 0.0);
            let n = 40;
            for _ in 0..n {
                let at = (31.5 + random.uniform(), 15.5 + random.uniform());
                let pixels = render(&profile, at, way, snr, &mut random);
                let frame = Frame {
                    width: WIDTH,
                    height: HEIGHT,
                    pixels: Pixels::Mono16(&pixels),
                };
                localiser.expect_streak((known * way.0, known * way.1));
                let guess = (at.0 + random.normal(), at.1 + random.normal());
                let fix = localiser.locate(&frame, Some(guess));
                good += i32::from(fix.verdict == Verdict::Good);
                residual += fix.residual_ratio / f64::from(n);
                errors.add((fix.x_px - at.0, fix.y_px - at.1), limit);
            }
            let (ratio, bias) = (errors.ratio(), errors.bias());
            println!(
                "{way:?}  {known}  {snr}  {:.4} {:.4}  {ratio:.3}  {:+.4} {:+.4}  {good}/{n}  {residual:.2}",
                limit.0, limit.1, bias.0, bias.1
            );
            assert_eq!(good, n, "{way:?} {known} {snr}");
            assert!(ratio < 1.25, "{way:?} {known} {snr}: {ratio}");
            let sigma = (f64::from(n)).sqrt().recip();
            assert!(bias.0.abs() < 4.0 * limit.0 * sigma + 0.005, "{bias:?}");
            assert!(bias.1.abs() < 4.0 * limit.1 * sigma + 0.005, "{bias:?}");
        }
    }
}

#[test]
fn a_streak_that_nobody_expects_is_no_fix() {
    let profile = RingProfile::new(EDGE_PX).unwrap();
    let mut random = Random(5);
    let pixels = render(&profile, (32.0, 16.0), (10.0, 0.0), 40.0, &mut random);
    let frame = Frame {
        width: WIDTH,
        height: HEIGHT,
        pixels: Pixels::Mono16(&pixels),
    };
    let fix = localiser().locate(&frame, Some((32.0, 16.0)));
    assert_ne!(fix.verdict, Verdict::Good);
}
