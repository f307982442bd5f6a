//! How far a hidden effect lies above what can be detected at all, without a word from the engine.
//!
//! Noise-free records with and without the effect differ by some motion. Its sum of squares in the innovations of the noise is
//! the expected gain in twice the log-likelihood. The noise is a walk and white noise at their nominal sizes; each record's start
//! is free, and the frame's share of the newest command is fitted. The threshold is the gain that an addition must reach in a
//! search over the whole vocabulary; distances are in amplitude, so the root of the ratio.

use super::{Excitation, Hidden, Nuisance, Random, Rig, Second, run, scripts};

/// Nominal diffusion, per row \[um^2\], and localisation noise \[um^2\].
const WALK_UM2: f64 = 2.0 * 0.33e-3;
const WHITE_UM2: f64 = 0.03 * 0.03;

/// Gain that an addition with this many numbers must reach: 1.3 times the chi-square quantile at 4.1 standard deviations
/// (Wilson-Hilferty).
fn bar(numbers: f64) -> f64 {
    let a = 2.0 / (9.0 * numbers);
    1.3 * numbers * (1.0 - a + 4.1 * a.sqrt()).powi(3)
}

/// Numbers that the effect's name brings with it, in six records.
fn numbers(hidden: &Hidden) -> f64 {
    match hidden.id() {
        "pzt-hysteresis" | "pixel-locking" | "gain-swing" | "camera-shake" => 3.0,
        "saturation" | "pzt-resonance" | "pdms-relaxation" => 2.0,
        "mains-hum" => 13.0,
        _ => 1.0,
    }
}

/// Innovations of a residual in the steady filter of the noise, the start taken from the first row.
fn whitened(residual: &[f64]) -> Vec<f64> {
    let p = 0.5 * (WALK_UM2 + (WALK_UM2 * WALK_UM2 + 4.0 * WALK_UM2 * WHITE_UM2).sqrt());
    let (gain, sigma) = (p / (p + WHITE_UM2), (p + WHITE_UM2).sqrt());
    let mut at = residual.first().copied().unwrap_or(0.0);
    residual
        .iter()
        .map(|r| {
            let e = r - at;
            at += gain * e;
            e / sigma
        })
        .collect()
}

/// A weak saturation with its levels moved to twice the threshold: only the few highest peaks of the excitation are clipped, and
/// their height depends on its random phases. Everything else is weak enough by its number alone.
pub fn weak(hidden: Hidden, seed: u64) -> Hidden {
    let Hidden::Saturation(..) = hidden else {
        return hidden;
    };
    let at = |width_um: f64| Hidden::Saturation(4.0 - width_um, 4.0 + width_um);
    let (mut near, mut far) = (1.0, 6.0);
    for _ in 0..12 {
        let middle = 0.5 * (near + far);
        if above_threshold(&[at(middle)], Excitation::Standard, seed) > 2.0 {
            near = middle;
        } else {
            far = middle;
        }
    }
    at(((near + far) * 500.0).round() * 1e-3)
}

/// Amplitude of a hidden effect over the amplitude that just reaches the threshold; for effects of single frames, their
/// rate over the least rate that is named.
pub fn above_threshold(hidden: &[Hidden], excitation: Excitation, seed: u64) -> f64 {
    match hidden {
        [Hidden::Drops(rate) | Hidden::Second(Second::DropBursts(rate))] => return rate / 2e-4,
        // At a resolution of 0.1 nm one increment in about 1100 is zero by chance; half as many again are named.
        [Hidden::Repeats(rate) | Hidden::Second(Second::RepeatBursts(rate))] => return rate / 5e-4,
        _ => {}
    }
    // Beside others, missing and repeated frames are left out of the account.
    let hidden: Vec<Hidden> = hidden
        .iter()
        .copied()
        .filter(|h| !h.id().starts_with("frame-"))
        .collect();
    let hidden = hidden.as_slice();
    let mut random = Random::new(seed);
    random.uniform();
    let (mut dd, mut ds, mut ss) = (0.0, 0.0, 0.0);
    for script in scripts(excitation, &mut random) {
        let with = run(
            &script,
            Rig::Bead,
            hidden,
            Nuisance::QUIET,
            &mut random.clone(),
        );
        let without = run(
            &script,
            Rig::Bead,
            &[],
            Nuisance::QUIET,
            &mut random.clone(),
        );
        let d: Vec<f64> = with
            .bead_um
            .iter()
            .zip(&without.bead_um)
            .map(|(a, b)| a - b)
            .collect();
        let edge: Vec<f64> = (0..script.pzt_um.len())
            .map(|k| {
                if k == 0 {
                    0.0
                } else {
                    script.pzt_um[k] - script.pzt_um[k - 1]
                }
            })
            .collect();
        let (d, edge) = (whitened(&d), whitened(&edge));
        dd += d.iter().map(|x| x * x).sum::<f64>();
        ds += d.iter().zip(&edge).map(|(x, y)| x * y).sum::<f64>();
        ss += edge.iter().map(|x| x * x).sum::<f64>();
    }
    let expected = (dd - ds * ds / ss.max(1e-12)).max(0.0);
    // An error in position is seen only as sharply as the position is known from the frames before.
    let blur: f64 = hidden
        .iter()
        .map(|h| match h {
            Hidden::PixelLocking(pixel, _) | Hidden::Second(Second::UnevenPixels(pixel, _)) => {
                let p =
                    0.5 * (WALK_UM2 + (WALK_UM2 * WALK_UM2 + 4.0 * WALK_UM2 * WHITE_UM2).sqrt());
                (-p * (std::f64::consts::TAU / pixel).powi(2)).exp()
            }
            _ => 1.0,
        })
        .product();
    let expected = expected * blur;
    let numbers: f64 = hidden.iter().map(numbers).sum();
    (expected / bar(numbers.max(1.0))).sqrt()
}
