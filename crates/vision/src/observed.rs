//! The sandwich covariance of a place (Huber 1967): the picture's answer to a motion of the bead, and the scatter of the place's
//! score by the residual of the fit.
//!
//! The sum of squares S has the second derivative A^2 g.g - A r.f'' by the place (A contrast, f template, g its derivative, r
//! residual). The first part is the template's expectation. A blurred bead has flatter edges than the template, so the whole is
//! smaller, and the place is less sure in proportion. The score is the sum of g r over the pixels. It scatters by more than for
//! white noise if the errors of neighbouring pixels are alike, as a codec makes them. Its variance is the sum over pairs of pixels
//! with Bartlett's weights in both directions (Newey and West 1987), which is the sum over all squares of [`SIDE`] pixels.

use crate::crop::{Crop, LANES, Row, STRIDE};
use crate::fit::{FIRST_COLUMNS, Image};
use crate::streak::Comb;
use crate::template::Template;
use wide::f32x4;

/// Side of the squares whose errors count as one, px. In pictures of a codec the stated error of Gaussians of 1 to 4 px is 0.9 to
/// 1.15 of the true one with 3, 0.58 to 1.07 with 1, no better with 4 (right template). Noise that is alike over two pixels and as
/// wide as the bead is mostly fitted as place and contrast: a fifth of its excess is found.
const SIDE: usize = 3;

/// A window's contribution to the covariance of the place, in addition to noise and template.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Observed {
    /// Observed over expected information about the place, mean of the two directions: 1 for a picture of the template. Noise
    /// scatters it by less than the relative error of the contrast.
    pub answer: f64,
    /// Variance of the score over the information, grey^2: [`of_white`] times that of a pixel if the pixels' noise is white.
    pub scatter: f64,
}

/// Looks at the window of a bead that was at rest during the exposure.
pub(crate) fn of(
    crop: &Crop,
    template: &Template,
    (x_px, y_px): (f64, f64),
    (amplitude, background): (f64, f64),
) -> Observed {
    let (x, y) = (
        (x_px - crop.x0 as f64) as f32,
        (y_px - crop.y0 as f64) as f32,
    );
    let lanes = |from: &Row, first: usize| {
        let four = from.get(first..first + LANES).unwrap_or_default();
        f32x4::from(<[f32; LANES]>::try_from(four).unwrap_or_default())
    };
    let four = |v: f64| f32x4::splat(v as f32);
    let (light, level) = (four(amplitude), four(background));
    let lanes_end = crop.lanes_end();
    let mut image = Image::new(lanes_end);
    let mut squares = [Squares::new(); 2];
    let (mut expected, mut changed) = (f32x4::ZERO, f32x4::ZERO);
    let (mut seen, mut scores) = ([0.0; STRIDE], [[0.0; STRIDE]; 2]);
    for (j, row) in crop.rows.iter().enumerate().take(crop.height) {
        let dy = j as f32 - y;
        image.draw_row(template, &Comb::STILL, x, dy);
        // What is left out has no residual.
        seen[..lanes_end].copy_from_slice(&crop.mask[..lanes_end]);
        for column in crop.left_out(j) {
            seen[column.min(STRIDE - 1)] = 0.0;
        }
        let mut dx = FIRST_COLUMNS - f32x4::splat(x);
        let dy2 = f32x4::splat(dy * dy);
        let [along, down] = &mut scores;
        let chunks = along[..lanes_end].as_chunks_mut::<LANES>().0.iter_mut();
        let chunks = chunks.zip(down[..lanes_end].as_chunks_mut::<LANES>().0);
        for ((along, down), first) in chunks.zip((0..).step_by(LANES)) {
            let of_window = lanes(&crop.mask, first);
            let (gx, gy) = (lanes(&image.by_x, first), lanes(&image.by_y, first));
            let left = lanes(row, first) - level - light * lanes(&image.value, first);
            let left = lanes(&seen, first) * left;
            expected += of_window * (gx * gx + gy * gy);
            changed += left * template.laplacian(dx * dx + dy2);
            (*along, *down) = ((gx * left).to_array(), (gy * left).to_array());
            dx += f32x4::splat(LANES as f32);
        }
        for (squares, scores) in squares.iter_mut().zip(&scores) {
            squares.add(scores, crop.width);
        }
    }
    let (expected, changed) = (expected.reduce_add(), changed.reduce_add());
    let scatter = squares.iter().map(Squares::mean).sum::<f32>() / expected;
    Observed {
        answer: 1.0 - f64::from(changed) / f64::from(amplitude as f32 * expected),
        scatter: f64::from(scatter),
    }
}

/// [`Observed::scatter`] of white noise of variance 1 in a window of a side: the fit of place, contrast and level takes its part of it.
pub(crate) fn of_white(template: &Template, side_px: usize) -> f64 {
    let side = side_px.min(STRIDE);
    let middle = (side / 2) as f32;
    let n = (side * side) as f32;
    let mut image = Image::new(STRIDE);
    let mut rows = |with: &mut dyn FnMut(&Image)| {
        for j in 0..side {
            image.draw_row(template, &Comb::STILL, middle, j as f32 - middle);
            with(&image);
        }
    };
    let (mut place, mut light, mut square) = (0.0_f32, 0.0_f32, 0.0_f32);
    rows(&mut |image| {
        for (gx, f) in image.by_x.iter().zip(&image.value).take(side) {
            (place, light, square) = (place + gx * gx, light + f, square + f * f);
        }
    });
    let mean = light / n;
    let contrast = (square - light * mean).max(f32::MIN_POSITIVE);
    // The directions that the fit takes off, each of length 1, times the derivative: along the place, across it, contrast, level.
    let mut taken = [Squares::new(); 4];
    rows(&mut |image| {
        let mut scores = [[0.0; STRIDE]; 4];
        let [along, across, by_contrast, by_level] = &mut scores;
        let light = image.by_x.iter().zip(&image.by_y).zip(&image.value);
        for (i, ((gx, gy), f)) in light.enumerate().take(side) {
            along[i] = gx * gx / place.sqrt();
            across[i] = gx * gy / place.sqrt();
            by_contrast[i] = gx * (f - mean) / contrast.sqrt();
            by_level[i] = gx / n.sqrt();
        }
        for (taken, scores) in taken.iter_mut().zip(&scores) {
            taken.add(scores, side);
        }
    });
    let taken: f32 = taken.iter().map(Squares::mean).sum();
    f64::from((1.0 - taken / place.max(f32::MIN_POSITIVE)).max(0.1))
}

/// Sum over all squares of a window of the square of the sum of their scores.
#[derive(Clone, Copy)]
struct Squares {
    /// Sums along the last rows, each in the place of its number.
    rows: [Row; SIDE],
    count: usize,
    sum: f32,
}

impl Squares {
    fn new() -> Self {
        Squares {
            rows: [[0.0; STRIDE]; SIDE],
            count: 0,
            sum: 0.0,
        }
    }

    fn add(&mut self, scores: &Row, width: usize) {
        let sums = width.saturating_sub(SIDE - 1);
        let along = &mut self.rows[self.count % SIDE][..sums];
        let three = scores.iter().zip(&scores[1..]).zip(&scores[2..]);
        for (sum, ((a, b), c)) in along.iter_mut().zip(three) {
            *sum = a + b + c;
        }
        self.count += 1;
        if self.count >= SIDE {
            let [a, b, c] = self.rows.each_ref().map(|row| &row[..sums]);
            let mut lanes = [0.0_f32; LANES];
            let squares = a
                .iter()
                .zip(b)
                .zip(c)
                .map(|((a, b), c)| (a + b + c).powi(2));
            for (lane, square) in (0..LANES).cycle().zip(squares) {
                lanes[lane] += square;
            }
            self.sum += lanes.iter().sum::<f32>();
        }
    }

    /// With Bartlett's weights: 1 for a pixel with itself.
    fn mean(&self) -> f32 {
        self.sum / (SIDE * SIDE) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::LocaliserConfig;
    use crate::frame::{Frame, Pixels};
    use crate::template::ProfileSpec;

    /// Windows of a Gaussian bead with noise of 10 grey levels, white or alike over `wide` pixels along rows: the answer, the scatter
    /// over that of white noise, and the variance of the place over that from white noise.
    fn observed(sigma_px: f64, wide: usize) -> (f64, f64, f64) {
        const SIDE: usize = 21;
        let mut random = cellpos_numeric::Random::new(9);
        let config = LocaliserConfig::new(ProfileSpec::Gaussian { sigma_px });
        let template = config.template().unwrap();
        let mut crop = Crop::new();
        let (mut answer, mut scatter, mut error2, draws) = (0.0, 0.0, 0.0, 1000);
        for _ in 0..draws {
            let mut grey = vec![1000.0_f32; SIDE * SIDE];
            template.draw(&mut grey, SIDE, 10.0, 10.0, 400.0);
            let noise: Vec<f64> = (0..SIDE * SIDE + wide).map(|_| random.normal()).collect();
            let pixels: Vec<u16> = grey
                .iter()
                .zip(noise.windows(wide))
                .map(|(v, near)| {
                    let alike = near.iter().sum::<f64>() / (wide as f64).sqrt();
                    (f64::from(*v) + 10.0 * alike).round() as u16
                })
                .collect();
            let frame = Frame {
                width: SIDE,
                height: SIDE,
                pixels: Pixels::Mono16(&pixels),
            };
            assert!(crop.take(&frame, 10.0, 10.0, SIDE));
            let (mut at, mut found) = ((10.0, 10.0), None);
            for _ in 0..4 {
                let weights = crate::fit::Weights::Even { variance: 1.0 };
                let pass = crate::fit::pass(&crop, &template, &Comb::STILL, at, weights).unwrap();
                at = (at.0 + pass.step_x_px, at.1 + pass.step_y_px);
                found = Some((pass.amplitude, pass.background));
            }
            let seen = of(&crop, &template, at, found.unwrap());
            error2 +=
                0.5 * ((at.0 - 10.0_f64).powi(2) + (at.1 - 10.0_f64).powi(2)) / f64::from(draws);
            answer += seen.answer / f64::from(draws);
            scatter += seen.scatter / 100.0 / f64::from(draws);
        }
        // The square of a Gaussian's derivative has the integral pi / 2.
        let bound = 100.0 / (400.0 * 400.0 * core::f64::consts::FRAC_PI_2);
        (answer, scatter / of_white(&template, SIDE), error2 / bound)
    }

    #[test]
    fn the_scatter_of_the_score_is_that_of_the_place_for_white_noise_and_more_for_alike_noise() {
        for sigma_px in [1.0, 1.2] {
            let (answer, white, place) = observed(sigma_px, 1);
            assert!((answer - 1.0).abs() < 0.02, "{sigma_px}: {answer}");
            assert!(
                (white / place - 1.0).abs() < 0.1,
                "{sigma_px}: {white} {place}"
            );
            let (_, alike, _) = observed(sigma_px, 2);
            assert!(alike > 1.05 * white, "{sigma_px}: {alike} {white}");
        }
    }
}
