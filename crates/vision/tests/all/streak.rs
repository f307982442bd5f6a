//! Beads that move while the shutter is open: their images are streaks, and the fit knows it.

use crate::common::{BACKGROUND, Errors, Random, known_noise};
use cellpos_vision::{
    FixQuality, Frame, Localiser, LocaliserConfig, Pixels, ProfileSpec, RadialProfile, RingProfile,
    Start,
};
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

/// A frame of one bead that turns while the shutter is open: the second half of its way is longer than the first by `turn_px`. Its position
/// is the mean of the way.
fn render_turning(
    p: &RingProfile,
    (x, y): (f64, f64),
    (way_px, turn_px): (f64, f64),
    snr: f64,
    random: &mut Random,
) -> Vec<u16> {
    let pixel = |k: usize| {
        let (i, j) = ((k % WIDTH) as f64, (k / WIDTH) as f64);
        let value: f64 = (0..POINTS)
            .map(|k| (k as f64 + 0.5) / POINTS as f64 - 0.5)
            .map(|t| x + way_px * t + turn_px * (t.abs() - 0.25))
            .map(|x| p.value(f64::hypot(i - x, j - y)))
            .sum();
        let grey = snr * NOISE * value / POINTS as f64;
        (BACKGROUND + grey + NOISE * random.normal()).round() as u16
    };
    (0..WIDTH * HEIGHT).map(pixel).collect()
}

/// A frame of streaks, all along `way`.
fn render(
    p: &RingProfile,
    beads: &[(f64, f64)],
    way: (f64, f64),
    snr: f64,
    random: &mut Random,
) -> Vec<u16> {
    let pixel = |k: usize| {
        let (i, j) = ((k % WIDTH) as f64, (k / WIDTH) as f64);
        let values = beads.iter().map(|(x, y)| streak(p, (i - x, j - y), way).0);
        let value: f64 = values.sum();
        (BACKGROUND + snr * NOISE * value + NOISE * random.normal()).round() as u16
    };
    (0..WIDTH * HEIGHT).map(pixel).collect()
}

fn frame(pixels: &[u16]) -> Frame<'_> {
    Frame {
        width: WIDTH,
        height: HEIGHT,
        pixels: Pixels::Mono16(pixels),
    }
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
        noise: known_noise(NOISE),
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
                let pixels = render(&profile, &[at], way, snr, &mut random);
                localiser.expect_streak((known * way.0, known * way.1));
                let guess = (at.0 + random.normal(), at.1 + random.normal());
                let fix = localiser.locate(&frame(&pixels), Some(guess));
                good += i32::from(fix.verdict == FixQuality::Good);
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
fn a_bead_that_a_command_turns_while_it_is_exposed_is_where_it_was_on_average() {
    let profile = RingProfile::new(EDGE_PX).unwrap();
    let snr = 60.0;
    for (way_px, turn_px) in [(8.0, 2.0), (12.0, -4.0), (15.0, 4.0), (-12.0, 4.0)] {
        let n = 40;
        let bias = |known: f64| {
            let mut localiser = localiser();
            let mut random = Random(5);
            let errors = (0..n).map(|_| {
                let at = (31.5 + random.uniform(), 15.5 + random.uniform());
                let pixels = render_turning(&profile, at, (way_px, turn_px), snr, &mut random);
                localiser.expect_streak((0.9 * way_px, 0.0));
                localiser.expect_turn((known * turn_px, 0.0));
                let guess = (at.0 + random.normal(), at.1 + random.normal());
                let fix = localiser.locate(&frame(&pixels), Some(guess));
                fix.x_px - at.0
            });
            errors.sum::<f64>() / f64::from(n)
        };
        let (unknown, known) = (bias(0.0), bias(0.9));
        println!(
            "{way_px} px, {turn_px} px: bias {unknown:+.4} px, with the turn known {known:+.4}"
        );
        let limit = bound(&profile, (way_px, 0.0), snr).0 / f64::from(n).sqrt();
        assert!(
            known.abs() < 4.0 * limit + 0.01,
            "{way_px} {turn_px}: {known} px"
        );
    }
}

/// Of two beads that touch, the one in the frame's middle, once the other's image is taken off: its error is that of a bead
/// alone, whatever was looked at before. The pair looked at as if it were one bead is what a tracker does first; the length
/// of streak that this comes to is the pair's, not a bead's.
#[test]
fn of_two_beads_that_touch_and_move_fast_each_is_localised_at_its_own_bound() {
    // The speed too low beside the one, right and too high beside the others.
    touch_and_move_fast(|place, speed| place == speed);
}

#[test]
#[ignore = "nightly: each place with each speed; the fast one has each once"]
fn of_two_beads_that_touch_and_move_fast_each_is_localised_whatever_the_speed_is_taken_for() {
    touch_and_move_fast(|_, _| true);
}

fn touch_and_move_fast(take: impl Fn(usize, usize) -> bool) {
    let profile = RingProfile::new(EDGE_PX).unwrap();
    let way = (8.0, 0.0);
    let snr = 40.0;
    println!("apart (px)  expected  error / bound  bias x, y (px)  good");
    let places = [(9.0, 4.0), (2.0, 9.0), (11.0, 0.0)];
    for (place, apart) in places.into_iter().enumerate() {
        for (speed, known) in [0.8, 1.0, 1.2].into_iter().enumerate() {
            if !take(place, speed) {
                continue;
            }
            let mut random = Random(7);
            let limit = bound(&profile, way, snr);
            let mut errors = Errors::default();
            let (mut good, n) = (0, 40);
            for _ in 0..n {
                let at = (31.5 + random.uniform(), 15.5 + random.uniform());
                let other = (at.0 + apart.0, at.1 + apart.1);
                let pixels = render(&profile, &[at, other], way, snr, &mut random);
                // As near as light is seen, or a bead is predicted.
                let starts = [at, other].map(|(x, y)| Start {
                    place_px: (
                        x + random.normal().clamp(-2.0, 2.0),
                        y + random.normal().clamp(-2.0, 2.0),
                    ),
                    contrast: None,
                });
                let [fresh, fix] = [false, true].map(|pair_first| {
                    let mut localiser = localiser();
                    localiser.expect_streak((known * way.0, known * way.1));
                    if pair_first {
                        let middle = (at.0 + 0.5 * apart.0, at.1 + 0.5 * apart.1);
                        localiser.locate(&frame(&pixels), Some(middle));
                    }
                    let together = localiser.locate_together(&frame(&pixels), &starts);
                    *together
                        .expect("two beads")
                        .fixes()
                        .next()
                        .expect("the first")
                });
                assert_eq!(fresh, fix, "what was looked at before must not matter");
                good += i32::from(fix.verdict == FixQuality::Good);
                errors.add((fix.x_px - at.0, fix.y_px - at.1), limit);
            }
            let (ratio, bias) = (errors.ratio(), errors.bias());
            println!(
                "{apart:?}  {known}  {ratio:.3}  {:+.4} {:+.4}  {good}/{n}",
                bias.0, bias.1
            );
            assert_eq!(good, n, "{apart:?} {known}");
            assert!(ratio < 1.25, "{apart:?} {known}: {ratio}");
        }
    }
}

#[test]
fn a_streak_that_nobody_expects_is_no_fix() {
    let profile = RingProfile::new(EDGE_PX).unwrap();
    let mut random = Random(5);
    let way = (10.0, 0.0);
    let pixels = render(&profile, &[(32.0, 16.0)], way, 40.0, &mut random);
    let fix = localiser().locate(&frame(&pixels), Some((32.0, 16.0)));
    assert_ne!(fix.verdict, FixQuality::Good);
}
