//! Pixels that show no light: hot and dead ones, and other specks of one pixel.
//!
//! The image of a point is wider than a pixel: a lens spreads it over its neighbours. A pixel that differs from all of them
//! by far more than they differ among themselves is not of the picture.

use crate::config::MAX_WINDOW_PX;
use crate::crop::{Crop, Row};

/// A speck differs by so many standard deviations of the noise at least: of 10,000 pixels, noise makes one in 50,000 frames.
pub(crate) const LEAST_SIGMA: f32 = 6.0;
/// ... and by so many times as its neighbours among themselves. The sharpest image of a point, a Gaussian of 0.7 px on the
/// middle of a pixel, differs by 3.3 times.
const LEAST_SPREADS: f32 = 4.0;
/// Largest share of a speck that its neighbours have on average. They have 0.36 of that sharpest image.
const MOST_SHARED: f32 = 0.25;
/// Largest share of a speck that is left on the other side of the bead's centre: interpolation makes it uncertain by less.
const MOST_OPPOSITE: f32 = 0.5;

/// What a pixel should be if it is a speck among its eight neighbours: their mean without the two extremes.
pub(crate) fn replacement(value: f32, mut near: [f32; 8], noise: f32) -> Option<f32> {
    // Cheap for most pixels: with two neighbours above it and two below there is no speck.
    let count =
        |beyond: fn(f32, f32) -> bool| near.iter().map(|v| u8::from(beyond(*v, value))).sum::<u8>();
    if count(|v, value| v >= value) > 1 && count(|v, value| v <= value) > 1 {
        return None;
    }
    near.sort_unstable_by(f32::total_cmp);
    let [_, low, inner @ .., high, _] = near;
    let mean = (low + high + inner.iter().sum::<f32>()) / 6.0;
    let off = (value - mean).abs();
    (off > LEAST_SIGMA * noise && off > LEAST_SPREADS * (high - low)).then_some(mean)
}

/// Mean of the 3 x 3 pixels about a place with specks among them replaced; `None` at the border.
pub(crate) fn mean_without<T: Copy>(
    pixels: &[T],
    (width, height): (usize, usize),
    (x, y): (usize, usize),
    noise: f32,
) -> Option<f32>
where
    f32: From<T>,
{
    if x < 2 || y < 2 || x + 2 >= width || y + 2 >= height {
        return None;
    }
    let mut sum = 0.0;
    for j in y - 1..=y + 1 {
        for i in x - 1..=x + 1 {
            let mut nine = [0.0_f32; 9];
            for (k, row) in nine.chunks_exact_mut(3).enumerate() {
                let from = pixels.get((j + k - 1) * width + i - 1..)?;
                for (v, p) in row.iter_mut().zip(from) {
                    *v = f32::from(*p);
                }
            }
            let [a, b, c, d, value, e, f, g, h] = nine;
            sum += replacement(value, [a, b, c, d, e, f, g, h], noise).unwrap_or(value);
        }
    }
    Some(sum / 9.0)
}

/// Replaces the specks of a picture, row by row.
pub(crate) fn clean_picture(values: &mut [f32], width: usize, noise: f32) {
    let height = values.len() / width.max(1);
    for y in 1..height.saturating_sub(1) {
        for x in 1..width.saturating_sub(1) {
            let at = y * width + x;
            let mut nine = [0.0_f32; 9];
            for (row, from) in nine.chunks_exact_mut(3).zip([at - width, at, at + width]) {
                row.copy_from_slice(&values[from - 1..from + 2]);
            }
            let [a, b, c, d, value, e, f, g, h] = nine;
            if let Some(instead) = replacement(value, [a, b, c, d, e, f, g, h], noise) {
                values[at] = instead;
            }
        }
    }
}

/// Replaces the specks of a window that show without knowing the bead, and says how many. Those next to each other hide one
/// another.
pub(crate) fn clean(crop: &mut Crop, noise: f32) -> usize {
    let mut found = 0;
    for j in 1..crop.height.saturating_sub(1) {
        for i in 1..crop.width.saturating_sub(1) {
            let [above, row, below] =
                [j - 1, j, j + 1].map(|j| &crop.rows[j.min(MAX_WINDOW_PX - 1)]);
            let (Some([a, b, c]), Some([d, value, e]), Some([f, g, h])) = (
                above.get(i - 1..i + 2),
                row.get(i - 1..i + 2),
                below.get(i - 1..i + 2),
            ) else {
                continue;
            };
            let near = [*a, *b, *c, *d, *e, *f, *g, *h];
            if let Some(instead) = replacement(*value, near, noise) {
                crop.rows[j][i] = instead;
                found += 1;
            }
        }
    }
    found
}

/// Leaves the specks that a fit shows out of the next fits in the window: the strongest, and those half as strong. A fit
/// that a strong speck has drawn off shows others that are none.
/// `left` is what the fit leaves, `strongest` its largest; `tolerance` is the share of the bead's own light that the template
/// may be wrong by. Returns how many there are.
pub(crate) fn leave_out(
    crop: &mut Crop,
    (x_px, y_px): (f64, f64),
    background: f64,
    (noise, tolerance): (f32, f32),
    left: &[Row],
    strongest: f32,
) -> usize {
    let background = background as f32;
    let (x, y) = (
        (x_px - crop.x0 as f64) as f32,
        (y_px - crop.y0 as f64) as f32,
    );
    let least = LEAST_SIGMA * noise;
    if strongest <= least {
        return 0;
    }
    let get = |j: usize, i: usize| left.get(j)?.get(i).copied();
    // What is left on the other side of the centre, between the pixels.
    let (width, height) = (crop.width, crop.height);
    let opposite = |j: usize, i: usize| {
        let (u, v) = ((2.0 * x - i as f32).max(0.0), (2.0 * y - j as f32).max(0.0));
        let (k, l) = (u as usize, v as usize);
        let (a, b) = (u - k as f32, v - l as f32);
        let at = |l, k| {
            if k < width && l < height {
                get(l, k).unwrap_or(0.0)
            } else {
                0.0
            }
        };
        let upper = at(l, k) + a * (at(l, k + 1) - at(l, k));
        let lower = at(l + 1, k) + a * (at(l + 1, k + 1) - at(l + 1, k));
        upper + b * (lower - upper)
    };
    let mut threshold = least;
    let mut found = 0;
    // The strongest that is a speck first; then those half as strong.
    for look in 0..2 {
        let mut most = 0.0_f32;
        for j in 0..crop.height {
            for i in 0..crop.width {
                let Some(own) = get(j, i).filter(|own| own.abs() > threshold) else {
                    continue;
                };
                let near = [
                    (j.wrapping_sub(1), i),
                    (j + 1, i),
                    (j, i.wrapping_sub(1)),
                    (j, i + 1),
                ];
                // A template of another size is wrong where the bead is steep: by its light next to the pixel.
                let bead = |j: usize, i: usize| {
                    let light = crop.rows.get(j).and_then(|row| row.get(i))? - background;
                    Some((light - get(j, i)?).abs())
                };
                let (mut sum, mut n) = (0.0_f32, 0.0_f32);
                let mut light = bead(j, i).unwrap_or(0.0);
                for (j, i) in near {
                    if j < crop.height && i < crop.width {
                        sum += get(j, i).unwrap_or(0.0);
                        n += 1.0;
                        light = light.max(bead(j, i).unwrap_or(0.0));
                    }
                }
                let shared = sum / n.max(1.0) * own.signum() > MOST_SHARED * own.abs();
                if shared || own.abs() <= least + tolerance * light {
                    continue;
                }
                // A template of another focus is wrong on both sides alike, and a speck in the very middle moves nothing.
                if opposite(j, i) * own.signum() > MOST_OPPOSITE * own.abs() {
                    continue;
                }
                most = most.max(own.abs());
                if look == 1 && crop.leave_out((j, i), crop.rows[j][i] - own) {
                    found += 1;
                }
            }
        }
        threshold = least.max(0.5 * most);
        if most == 0.0 {
            break;
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sharpest_image_of_a_point_is_no_speck_and_a_hot_or_dead_pixel_is() {
        for sigma_px in [0.7_f32, 1.0, 2.0] {
            for (x, y) in [(0.0, 0.0), (0.3, 0.1), (0.5, 0.5)] {
                let at = |i: i32, j: i32| {
                    let (dx, dy) = (i as f32 - x, j as f32 - y);
                    100.0 * (-0.5 * (dx * dx + dy * dy) / (sigma_px * sigma_px)).exp()
                };
                let near = [
                    (-1, -1),
                    (0, -1),
                    (1, -1),
                    (-1, 0),
                    (1, 0),
                    (-1, 1),
                    (0, 1),
                    (1, 1),
                ];
                let near = near.map(|(i, j)| at(i, j));
                assert_eq!(replacement(at(0, 0), near, 1.0), None, "{sigma_px} {x} {y}");
            }
        }
        let ground = [10.0, 11.0, 9.0, 10.0, 12.0, 10.0, 9.0, 90.0];
        assert!(replacement(60.0, ground, 1.0).is_some());
        assert!(replacement(-9.0, ground, 1.0).is_some());
        assert_eq!(replacement(15.0, ground, 1.0), None);
    }
}
