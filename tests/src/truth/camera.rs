//! What the frames show.

use super::hidden::Hidden;
use super::random::Random;
use std::f64::consts::TAU;

/// What the frames show of a fine path.
///
/// `path[i]` holds the position right before and right after time i h.
pub(super) fn camera(
    path: &[[f64; 2]],
    rows: usize,
    h: f64,
    hidden: &[Hidden],
    random: &mut Random,
) -> Vec<f64> {
    let (mut delay, mut exposure, mut skew) = (0.0, 0.0, 0.0);
    let phase = TAU * random.uniform();
    for e in hidden {
        match *e {
            Hidden::Delay(d) => delay = d,
            Hidden::Exposure(e) => exposure = e,
            Hidden::ClockSkew(ppm) => skew = 1e-6 * ppm,
            _ => {}
        }
    }
    let at = |t: f64| {
        // Limits from the left: a command that acts at the very instant is not seen yet.
        let x = (t / h).max(0.0);
        let i = ((x - 1e-6).ceil() - 1.0)
            .max(0.0)
            .min(path.len() as f64 - 2.0) as usize;
        if x <= 1e-6 {
            return path[0][0];
        }
        path[i][1] + (path[i + 1][0] - path[i][1]) * (x - i as f64)
    };
    (0..rows)
        .map(|k| {
            let t = k as f64 * 1e-3 * (1.0 + skew) - delay;
            let mut y = if exposure > 0.0 {
                let n = 64;
                (0..n)
                    .map(|i| at(t - exposure * (f64::from(i) + 0.5) / f64::from(n)))
                    .sum::<f64>()
                    / f64::from(n)
            } else {
                at(t)
            };
            for e in hidden {
                match *e {
                    Hidden::Hum(hz, um) | Hidden::Line(hz, um) => {
                        y += um * (TAU * hz * k as f64 * 1e-3 + phase).sin()
                    }
                    Hidden::PixelLocking(p, b) => y += b * p * (TAU * y / p).sin(),
                    Hidden::Distortion(c) => y += c * y * y,
                    _ => {}
                }
            }
            y
        })
        .collect()
}
