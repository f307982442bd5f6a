//! A first position in a whole frame, by threshold.

use crate::frame::{Frame, Pixels};

/// At most this many pixels serve for the statistics of the background.
const STATISTICS_PIXELS: usize = 1024;
/// The least noise a pixel can have, grey levels: that of rounding to whole levels.
pub(crate) const LEAST_NOISE: f64 = 0.29;
/// Side of the square whose sum is compared, px: one hot pixel is not a bead.
pub(crate) const PATCH: usize = 3;
/// Columns that are summed up together: their sums stay in the nearest cache.
const COLUMNS: usize = 256;

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
    // Copied together first: the passes over them are without a branch.
    let (mut values, mut steps) = ([0.0_f64; STATISTICS_PIXELS], [0.0_f64; STATISTICS_PIXELS]);
    let mut count = 0;
    let pairs = pixels.windows(2).step_by(step);
    for ((pair, value), step) in pairs.zip(&mut values).zip(&mut steps) {
        let [a, b] = pair else { continue };
        let (a, b) = (f32::from(*a), f32::from(*b));
        (*value, *step) = (f64::from(a), f64::from((b - a).abs()));
        count += 1;
    }
    let (values, steps) = (&values[..count], &steps[..count]);
    let (mut mean, mut spread, mut limit) = (0.0_f64, f64::INFINITY, f64::INFINITY);
    for _ in 0..3 {
        let (mut n, mut s, mut s2, mut differences, mut sum) = (0.0_f64, 0.0, 0.0, 0.0_f64, 0.0);
        let reach = if spread.is_infinite() {
            f64::INFINITY
        } else {
            2.5 * spread
        };
        for (v, d) in values.iter().zip(steps) {
            let near = f64::from(u8::from((v - mean).abs() <= reach));
            n += near;
            s += near * v;
            s2 += near * v * v;
            let small = f64::from(u8::from(*d <= limit));
            differences += small;
            sum += small * d;
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

/// Sums over the patches whose first row is `y`, from left to right.
pub(crate) fn patch_sums<T: Copy>(pixels: &[T], width: usize, y: usize, sums: &mut Vec<f32>)
where
    f32: From<T>,
{
    sums.clear();
    for first in (0..width.saturating_sub(PATCH - 1)).step_by(COLUMNS - 2) {
        let end = (first + COLUMNS).min(width);
        let row = |k: usize| {
            pixels
                .get((y + k) * width + first..(y + k) * width + end)
                .unwrap_or(&[])
        };
        let mut columns = [0.0_f32; COLUMNS];
        let three = row(0).iter().zip(row(1)).zip(row(2));
        for (sum, ((a, b), c)) in columns.iter_mut().zip(three) {
            *sum = f32::from(*a) + f32::from(*b) + f32::from(*c);
        }
        // Not in place: a sum that is read back from memory waits for the one before.
        let columns = &columns[..end - first];
        let three = columns.iter().zip(&columns[1..]).zip(&columns[2..]);
        sums.extend(three.map(|((a, b), c)| a + b + c));
    }
}

/// Largest sum over a patch, and the patch's centre; patches are `step` rows apart.
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
    let mut sums = [0.0_f32; COLUMNS];
    for j in (0..=(height - PATCH)).step_by(step) {
        for first in (0..=width - PATCH).step_by(COLUMNS - 2) {
            let end = (first + COLUMNS).min(width);
            let row = |k: usize| pixels.get((j + k) * width + first..(j + k) * width + end);
            let columns = row(0)?.iter().zip(row(1)?).zip(row(2)?);
            for (sum, ((a, b), c)) in sums.iter_mut().zip(columns) {
                *sum = sign * (f32::from(*a) + f32::from(*b) + f32::from(*c));
            }
            let sums = &sums[..end - first];
            let patches = || {
                let three = sums.iter().zip(sums.get(1..)?).zip(sums.get(2..)?);
                Some(three.map(|((a, b), c)| a + b + c))
            };
            let above = patches()?.fold(false, |any, sum| any | (sum > best));
            if above {
                for (i, sum) in patches()?.enumerate() {
                    if sum > best {
                        (best, at) = (sum, (first + i + 1, j + 1));
                    }
                }
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
