//! The stated covariance where the template, the noise or the pixels are not what the fit takes them for.

use crate::common::Random;
use cellpos_vision::{
    FixQuality, Frame, Localiser, LocaliserConfig, Pixels, ProfileSpec, RadialProfile, RingProfile,
};

const SIDE: usize = 64;
const EDGE_PX: f64 = 6.4;

/// What happens to the picture between bead and file.
#[derive(Debug, Clone, Copy)]
enum Spoilt {
    Not,
    /// Bead larger than the template by this factor.
    Larger(f64),
    /// Noise and bead are blurred by a Gaussian of this standard deviation, px.
    Blurred(f64),
    /// Only every so many grey levels exist.
    Steps(f64),
    /// Grey levels end here.
    Saturated(f64),
    /// 8 x 8 blocks of which only the strong cosines are kept, as a codec of low quality does.
    Compressed(f64),
    /// A dark rod sticks to the bead and turns.
    Rod,
}

fn picture(spoilt: Spoilt, at: (f64, f64), random: &mut Random) -> Vec<u8> {
    let size = match spoilt {
        Spoilt::Larger(factor) => factor,
        _ => 1.0,
    };
    let profile = RingProfile::new(EDGE_PX * size).unwrap();
    let angle = std::f64::consts::TAU * random.uniform();
    let mut grey: Vec<f64> = (0..SIDE * SIDE)
        .map(|k| {
            let (dx, dy) = ((k % SIDE) as f64 - at.0, (k / SIDE) as f64 - at.1);
            let mut v = 110.0 + 80.0 * profile.value(f64::hypot(dx, dy)) + 2.0 * random.normal();
            if let Spoilt::Rod = spoilt {
                let (u, w) = (
                    dx * angle.cos() + dy * angle.sin() - 13.0,
                    dy * angle.cos() - dx * angle.sin(),
                );
                v -= 40.0 * (-0.5 * (u * u / 9.0 + w * w / 2.0)).exp();
            }
            v
        })
        .collect();
    match spoilt {
        Spoilt::Blurred(sd) => grey = blurred(&grey, sd),
        Spoilt::Steps(step) => grey
            .iter_mut()
            .for_each(|v| *v = (*v / step).round() * step),
        Spoilt::Saturated(most) => grey.iter_mut().for_each(|v| *v = v.min(most)),
        Spoilt::Compressed(step) => compress(&mut grey, step),
        _ => {}
    }
    grey.iter()
        .map(|v| v.round().clamp(0.0, 255.0) as u8)
        .collect()
}

fn blurred(grey: &[f64], sd: f64) -> Vec<f64> {
    let kernel: Vec<f64> = (-4..=4)
        .map(|k| (-0.5 * f64::from(k * k) / (sd * sd)).exp())
        .collect();
    let sum: f64 = kernel.iter().sum();
    let pass = |grey: &[f64], stride: usize| -> Vec<f64> {
        (0..SIDE * SIDE)
            .map(|k| {
                let c = k / stride % SIDE;
                let near = kernel.iter().zip(0..9).map(|(w, j)| {
                    let to = (c + j).clamp(4, SIDE + 3) - 4;
                    w * grey[k + to * stride - c * stride]
                });
                near.sum::<f64>() / sum
            })
            .collect()
    };
    pass(&pass(grey, 1), SIDE)
}

/// Rounds the cosine coefficients of each block to multiples of a step that grows with the frequency.
fn compress(grey: &mut [f64], step: f64) {
    let basis = |k: usize, n: usize| {
        let scale = if k == 0 { (1.0_f64 / 8.0).sqrt() } else { 0.5 };
        scale * (std::f64::consts::PI * (n as f64 + 0.5) * k as f64 / 8.0).cos()
    };
    for by in (0..SIDE).step_by(8) {
        for bx in (0..SIDE).step_by(8) {
            let mut out = [[0.0; 8]; 8];
            for v in 0..8 {
                for u in 0..8 {
                    let mut c = 0.0;
                    for y in 0..8 {
                        for x in 0..8 {
                            c += (grey[(by + y) * SIDE + bx + x] - 128.0)
                                * basis(u, x)
                                * basis(v, y);
                        }
                    }
                    let q = step * (1.0 + 0.5 * (u + v) as f64);
                    let c = (c / q).round() * q;
                    for (y, row) in out.iter_mut().enumerate() {
                        for (x, o) in row.iter_mut().enumerate() {
                            *o += c * basis(u, x) * basis(v, y);
                        }
                    }
                }
            }
            for (y, row) in out.iter().enumerate() {
                for (x, o) in row.iter().enumerate() {
                    grey[(by + y) * SIDE + bx + x] = o + 128.0;
                }
            }
        }
    }
}

/// RMS error over RMS of the stated standard deviation, x and y together, and the RMS error.
fn ratio(spoilt: Spoilt) -> (f64, f64) {
    let mut random = Random(77);
    let mut config = LocaliserConfig::new(ProfileSpec::Ring { edge_px: EDGE_PX });
    config.template_tolerance = 0.3;
    let mut localiser = Localiser::new(config).unwrap();
    let (mut error2, mut stated2) = (0.0, 0.0);
    // So many frames show the ratio to 3 %; where it is near a bound, to 1 %, so that chance does not decide.
    let near_bound = matches!(
        spoilt,
        Spoilt::Blurred(1.5) | Spoilt::Saturated(160.0) | Spoilt::Compressed(20.0)
    );
    let count = if near_bound { 2500 } else { 300 };
    for _ in 0..count {
        let at = (31.0 + random.uniform(), 31.0 + random.uniform());
        let pixels = picture(spoilt, at, &mut random);
        let frame = Frame {
            width: SIDE,
            height: SIDE,
            pixels: Pixels::Mono8(&pixels),
        };
        let fix = localiser.locate(&frame, Some((31.5, 31.5)));
        assert_eq!(fix.verdict, FixQuality::Good, "{spoilt:?} {fix:?}");
        error2 += (fix.x_px - at.0).powi(2) + (fix.y_px - at.1).powi(2);
        stated2 += fix.var_x_px2 + fix.var_y_px2;
    }
    (
        (error2 / stated2).sqrt(),
        (0.5 * error2 / f64::from(count)).sqrt(),
    )
}

#[test]
fn the_error_is_what_the_covariance_says_on_pictures_that_the_template_does_not_describe() {
    let cases = [
        Spoilt::Not,
        Spoilt::Larger(1.1),
        Spoilt::Larger(0.9),
        Spoilt::Blurred(0.8),
        Spoilt::Steps(8.0),
        Spoilt::Steps(24.0),
        Spoilt::Saturated(170.0),
        Spoilt::Compressed(10.0),
        Spoilt::Compressed(30.0),
        Spoilt::Compressed(80.0),
    ];
    the_error_is_what_the_covariance_says(&cases);
}

#[test]
#[ignore = "nightly: what comes near a bound takes 2500 frames a case; the fast one has the ten others"]
fn the_error_is_what_the_covariance_says_where_it_is_near_a_bound() {
    let cases = [
        Spoilt::Blurred(1.5),
        Spoilt::Saturated(160.0),
        Spoilt::Compressed(20.0),
    ];
    the_error_is_what_the_covariance_says(&cases);
}

fn the_error_is_what_the_covariance_says(cases: &[Spoilt]) {
    let found: Vec<_> = cases.iter().map(|case| (case, ratio(*case))).collect();
    for (case, (ratio, rms)) in &found {
        println!("{case:?}: error over stated {ratio:.2}, RMS {rms:.4} px");
    }
    for (case, (ratio, _)) in found {
        assert!((0.8..1.5).contains(&ratio), "{case:?}: {ratio}");
    }
}

#[test]
fn a_rod_on_the_bead_and_noise_blurred_as_wide_as_the_ring_are_known_less_well() {
    for (case, allowed) in [(Spoilt::Rod, 0.5..1.5), (Spoilt::Blurred(2.5), 0.8..2.0)] {
        let (ratio, rms) = ratio(case);
        println!("{case:?}: error over stated {ratio:.2}, RMS {rms:.4} px");
        assert!(allowed.contains(&ratio), "{case:?}: {ratio}");
    }
}
