//! Pixels that show no light: hot and dead ones, and other specks of one pixel.
//!
//! The image of a point is wider than a pixel: a lens spreads it over its neighbours. A pixel that differs from all of them
//! by far more than they differ among themselves is not of the picture.

use crate::config::MAX_WINDOW_PX;
use crate::crop::{Crop, Row};

/// A speck differs by so many standard deviations of the noise at least: of 10,000 pixels, noise makes one in 50,000 frames.
pub(crate) const LEAST_SIGMA: f32 = 6.0;
/// The same once the bead is fitted. Noise makes one of 150,000 pixels so strong, and to leave that one out costs next to nothing; where one
/// pixel in a thousand is hot, most that are so strong are.
pub(crate) const LEAST_LEFT_SIGMA: f32 = 4.5;
/// A speck differs by so many times as its neighbours among themselves. The sharpest image of a point, a Gaussian of 0.7 px on the
/// middle of a pixel, differs by 3.3 times.
const LEAST_SPREADS: f32 = 4.0;
/// Largest share of a speck that its neighbours have on average. They have 0.36 of that sharpest image.
const MOST_SHARED: f32 = 0.25;

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

/// Whether a pixel can be a speck, by the two beside it. A speck is off the mean of its inner neighbours by [`LEAST_SIGMA`], and by
/// [`LEAST_SPREADS`] (four) times their spread. If both beside it are nearer than d, so is an end of that spread, and it is off by less than
/// d and a quarter of the same: less than four thirds of d.
fn can_be(left: f32, value: f32, right: f32, noise: f32) -> bool {
    let far = 0.75 * LEAST_SIGMA * noise;
    value - left.min(right) > far || left.max(right) - value > far
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
            if !can_be(*d, *value, *e, noise) {
                continue;
            }
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
/// `left` is what the fit leaves, `strongest` its largest. What the fit leaves of the bead's other pixels says by how much of its
/// light the template is wrong. Returns how many there are.
pub(crate) fn leave_out(
    crop: &mut Crop,
    background: f64,
    noise: f32,
    left: &[Row],
    strongest: f32,
) -> usize {
    let background = background as f32;
    let least = LEAST_LEFT_SIGMA * noise;
    if strongest <= least {
        return 0;
    }
    let get = |j: usize, i: usize| left.get(j)?.get(i).copied();
    let mut threshold = least;
    let mut found = 0;
    // The strongest that is a speck first; then those half as strong.
    for look in 0..2 {
        let mut most = 0.0_f32;
        let wrong = Wrong::of(crop, background, noise, left);
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
                let bead = |j: usize, i: usize| Some(light(crop, background, (j, i), get(j, i)?));
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
                if shared || own.abs() <= LEAST_SPREADS * wrong.without(own, light) {
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

/// The bead's own light in a pixel, of which a fit leaves `left`.
fn light(crop: &Crop, background: f32, (j, i): (usize, usize), left: f32) -> f32 {
    let grey = crop.rows.get(j).and_then(|row| row.get(i));
    grey.map_or(0.0, |grey| (grey - background - left).abs())
}

/// How far the template is wrong by a share of the bead's light, as what it leaves beyond noise says.
struct Wrong {
    /// Sums over the window, weighted with the light's square: what is left, squared, beyond noise; and the light's square.
    excess: f32,
    squares: f32,
    noise: f32,
}

impl Wrong {
    fn of(crop: &Crop, background: f32, noise: f32, left: &[Row]) -> Self {
        let (mut excess, mut squares) = (0.0_f32, 0.0_f32);
        for (j, row) in left.iter().enumerate().take(crop.height) {
            for (i, own) in row.iter().enumerate().take(crop.width) {
                let light = light(crop, background, (j, i), *own);
                let weight = light * light;
                excess += weight * (own * own - noise * noise);
                squares += weight * weight;
            }
        }
        Wrong {
            excess,
            squares,
            noise,
        }
    }

    /// Standard deviation of what is left of a pixel with some light, judged by all but the pixel itself.
    fn without(&self, own: f32, light: f32) -> f32 {
        let weight = light * light;
        let excess = self.excess - weight * (own * own - self.noise * self.noise);
        let squares = self.squares - weight * weight;
        let share = if squares > 0.0 {
            (excess / squares).max(0.0)
        } else {
            0.0
        };
        (self.noise * self.noise + share * weight).sqrt()
    }
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
