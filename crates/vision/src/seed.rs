//! A first position in a whole frame, by threshold.

use crate::frame::{Frame, Pixels};

/// At most this many pixels serve for the statistics of the background.
const STATISTICS_PIXELS: usize = 1024;
/// The least noise a pixel can have, grey levels: that of rounding to whole levels.
pub(crate) const LEAST_NOISE: f64 = 0.29;
/// Side of the square whose sum is compared, px: one hot pixel is not a bead.
pub(crate) const PATCH: usize = 3;

/// Centroid of the strongest bead of the frame; `sign` is -1 for dark cores. `None` when nothing stands out of the
/// background by `min_snr` times its noise.
pub(crate) fn strongest(
    frame: &Frame,
    sign: f64,
    radius_px: f64,
    min_snr: f64,
) -> Option<(f64, f64)> {
    match frame.pixels {
        Pixels::Mono8(p) => strongest_in(p, frame, sign, radius_px, min_snr),
        Pixels::Mono16(p) => strongest_in(p, frame, sign, radius_px, min_snr),
    }
}

/// Background level and noise of a pixel. The level is the mean after clipping; the noise comes from differences of
/// neighbours, so that neither uneven light nor a bead that fills the frame counts as noise.
pub(crate) fn background<T: Copy>(pixels: &[T]) -> (f64, f64)
where
    f32: From<T>,
{
    // An odd step does not walk down a column of a frame of even width.
    let step = pixels.len().div_ceil(STATISTICS_PIXELS).max(1) | 1;
    let grey = |v: &T| f64::from(f32::from(*v));
    let (mut mean, mut spread, mut limit) = (0.0_f64, f64::INFINITY, f64::INFINITY);
    for _ in 0..3 {
        let (mut n, mut s, mut s2, mut differences, mut sum) = (0.0_f64, 0.0, 0.0, 0.0_f64, 0.0);
        for pair in pixels.windows(2).step_by(step) {
            let [a, b] = pair else { continue };
            let (v, d) = (grey(a), (grey(b) - grey(a)).abs());
            if spread.is_infinite() || (v - mean).abs() <= 2.5 * spread {
                n += 1.0;
                s += v;
                s2 += v * v;
            }
            if d <= limit {
                differences += 1.0;
                sum += d;
            }
        }
        if n < 1.0 {
            break;
        }
        mean = s / n;
        spread = (s2 / n - mean * mean).max(0.0).sqrt();
        limit = 4.0 * sum / differences.max(1.0);
    }
    // The mean of |d| for normal noise is sigma * 2 / sqrt(pi); `limit` holds four times it.
    let noise = limit / 4.0 * core::f64::consts::PI.sqrt() / 2.0;
    (mean, if noise.is_finite() { noise } else { 0.0 })
}

fn strongest_in<T: Copy>(
    pixels: &[T],
    frame: &Frame,
    sign: f64,
    radius_px: f64,
    min_snr: f64,
) -> Option<(f64, f64)>
where
    f32: From<T>,
{
    let (width, height) = (frame.width, frame.height);
    let pixels = pixels.get(..width.checked_mul(height)?)?;
    let (mean, noise) = background(pixels);
    let sign = sign as f32;
    let (best, at) = brightest_patch(
        pixels,
        width,
        height,
        sign,
        if radius_px >= 3.0 { 2 } else { 1 },
    )?;
    let contrast = f64::from(best) / (PATCH * PATCH) as f64 - f64::from(sign) * mean;
    if contrast <= min_snr * noise.max(LEAST_NOISE) {
        return None;
    }
    Some(centroid(
        pixels,
        frame,
        (sign, mean as f32, (0.5 * contrast) as f32),
        at,
        radius_px,
    ))
}

/// Largest sum over a patch, and the patch's centre; patches are `step` pixels apart both ways.
fn brightest_patch<T: Copy>(
    pixels: &[T],
    width: usize,
    height: usize,
    sign: f32,
    step: usize,
) -> Option<(f32, (usize, usize))>
where
    f32: From<T>,
{
    if width < PATCH || height < PATCH {
        return None;
    }
    let (mut best, mut at) = (f32::NEG_INFINITY, (0, 0));
    for j in (0..=(height - PATCH)).step_by(step) {
        let rows = [
            pixels.get(j * width..)?,
            pixels.get((j + 1) * width..)?,
            pixels.get((j + 2) * width..)?,
        ];
        let columns = rows[0]
            .windows(PATCH)
            .zip(rows[1].windows(PATCH))
            .zip(rows[2].windows(PATCH));
        for (i, ((a, b), c)) in columns.enumerate().take(width - PATCH + 1).step_by(step) {
            let add = |w: &[T]| w.iter().map(|v| f32::from(*v)).sum::<f32>();
            let sum = sign * (add(a) + add(b) + add(c));
            if sum > best {
                (best, at) = (sum, (i + 1, j + 1));
            }
        }
    }
    Some((best, at))
}

/// Centroid of what exceeds the threshold within a bead's diameter of `at`, the window moved once onto the result.
fn centroid<T: Copy>(
    pixels: &[T],
    frame: &Frame,
    (sign, mean, threshold): (f32, f32, f32),
    at: (usize, usize),
    radius_px: f64,
) -> (f64, f64)
where
    f32: From<T>,
{
    let (mut x, mut y) = (at.0 as f64, at.1 as f64);
    for reach_px in [2.0 * radius_px, 1.3 * radius_px] {
        let (x0, x1) = crate::template::span(x, reach_px.max(1.0), frame.width);
        let (y0, y1) = crate::template::span(y, reach_px.max(1.0), frame.height);
        let (mut s, mut sx, mut sy) = (0.0_f64, 0.0, 0.0);
        for j in y0..y1 {
            let Some(row) = pixels.get(j * frame.width + x0..j * frame.width + x1) else {
                break;
            };
            for (i, v) in row.iter().enumerate() {
                let above = f64::from(sign * (f32::from(*v) - mean) - threshold);
                if above > 0.0 {
                    s += above;
                    sx += above * (x0 + i) as f64;
                    sy += above * j as f64;
                }
            }
        }
        if s > 0.0 {
            (x, y) = (sx / s, sy / s);
        }
    }
    (x, y)
}
