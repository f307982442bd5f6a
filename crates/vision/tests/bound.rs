//! The localiser against the Cramer-Rao bound, and what it says when it does not know.

use cellpos_vision::{
    Frame, GaussianProfile, Localiser, LocaliserConfig, Noise, Pixels, ProfileSpec, RadialProfile,
    RingProfile, Verdict,
};
use nalgebra::{Matrix4, Vector4};

/// A small generator of uniform and normal numbers (xorshift64*, Box-Muller): the same bits everywhere.
struct Random(u64);

impl Random {
    fn uniform(&mut self) -> f64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 11) as f64 / (1u64 << 53) as f64
    }
    fn normal(&mut self) -> f64 {
        let r = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        r * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

const SIDE: usize = 25;

/// A frame of one bead, straight from the profile's formula and not from the table that the fit reads.
fn render(
    p: &dyn RadialProfile,
    x: f64,
    y: f64,
    amplitude: f64,
    noise: f64,
    random: &mut Random,
) -> Vec<u16> {
    let pixel = |k: usize| {
        let r = f64::hypot((k % SIDE) as f64 - x, (k / SIDE) as f64 - y);
        (20_000.0 + amplitude * p.value(r) + noise * random.normal()).round() as u16
    };
    (0..SIDE * SIDE).map(pixel).collect()
}

/// Cramer-Rao bound of x and y (standard deviations, px) with amplitude and background unknown, from the formula.
fn bound(p: &dyn RadialProfile, x: f64, y: f64, snr: f64) -> (f64, f64) {
    let mut information = Matrix4::zeros();
    for k in 0..SIDE * SIDE {
        let (dx, dy) = ((k % SIDE) as f64 - x, (k / SIDE) as f64 - y);
        let r = f64::hypot(dx, dy).max(1e-9);
        let slope = -snr * p.slope(r) / r;
        let g = Vector4::new(slope * dx, slope * dy, p.value(r), 1.0);
        information += g * g.transpose();
    }
    let c = information.try_inverse().unwrap();
    (c[(0, 0)].sqrt(), c[(1, 1)].sqrt())
}

fn frame(pixels: &[u16]) -> Frame<'_> {
    Frame {
        width: SIDE,
        height: SIDE,
        pixels: Pixels::Mono16(pixels),
    }
}

#[test]
fn error_reaches_the_cramer_rao_bound_without_bias() {
    let ring = RingProfile::new(RingProfile::MEASURED_EDGE_PX).unwrap();
    let spot = GaussianProfile::new(3.0).unwrap();
    let cases: [(&str, ProfileSpec, &dyn RadialProfile); 2] = [
        ("gaussian", ProfileSpec::Gaussian { sigma_px: 3.0 }, &spot),
        (
            "ring",
            ProfileSpec::Ring {
                edge_px: RingProfile::MEASURED_EDGE_PX,
            },
            &ring,
        ),
    ];
    for (name, spec, profile) in cases {
        for snr in [10.0, 20.0, 40.0, 80.0] {
            let noise = 100.0;
            let config = LocaliserConfig {
                window_px: SIDE,
                noise: Noise::Known {
                    read_sd_grey: noise,
                    shot_grey_per_electron: 0.0,
                    black_level_grey: 0.0,
                },
                ..LocaliserConfig::new(spec)
            };
            let mut localiser = Localiser::new(config).unwrap();
            let mut random = Random(7 + snr as u64);
            let (mut ratio2, mut bias, mut z2, n) = (0.0, (0.0, 0.0), 0.0, 2000);
            for _ in 0..n {
                let (x, y) = (11.5 + random.uniform(), 11.5 + random.uniform());
                let pixels = render(profile, x, y, snr * noise, noise, &mut random);
                let fix = localiser.locate(&frame(&pixels), None);
                assert_eq!(fix.verdict, Verdict::Good, "{name} {snr} {x} {y} {fix:?}");
                let (ex, ey) = (fix.x_px - x, fix.y_px - y);
                let (bx, by) = bound(profile, x, y, snr);
                ratio2 += 0.5 * ((ex / bx).powi(2) + (ey / by).powi(2)) / f64::from(n);
                z2 += 0.5 * (ex * ex / fix.var_x_px2 + ey * ey / fix.var_y_px2) / f64::from(n);
                bias = (bias.0 + ex / f64::from(n), bias.1 + ey / f64::from(n));
            }
            let ratio = ratio2.sqrt();
            println!(
                "{name} SNR {snr}: RMS/CRB {ratio:.3}, z {:.3}, bias {:.5} {:.5} px",
                z2.sqrt(),
                bias.0,
                bias.1
            );
            assert!(
                ratio <= 1.03 && ratio > 0.95,
                "{name} SNR {snr}: RMS/CRB {ratio}"
            );
            assert!(
                (z2.sqrt() - 1.0).abs() < 0.05,
                "{name} SNR {snr}: covariance says {}",
                z2.sqrt()
            );
            assert!(
                bias.0.abs() < 0.005 && bias.1.abs() < 0.005,
                "{name} SNR {snr}: bias {bias:?} px"
            );
        }
    }
}
