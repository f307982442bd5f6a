//! Parameters beyond place, contrast and level: light that rises across the window, and a bead out of focus, whose image is larger
//! or smaller than the template.
//!
//! Light that rises draws the fit to its side. A template of another size weights the pixels wrongly, and between the pixels
//! it is off its own centre. Both are nuisance parameters, and a window that does not need them would lose certainty by
//! them: they are fitted where a score test finds them.

use crate::crop::{Crop, LANES, STRIDE};
use crate::fit::{Image, Pass, Weights};
use crate::streak::Comb;
use crate::template::Template;
use nalgebra::{SMatrix, SVector};

/// Smallest and largest size that another focus or a blur makes of a bead. A blur of half the radius makes a Gaussian larger by the root
/// of two. Farther off the rest of the picture has changed, too, and beads of other sizes are others.
const SIZES: (f64, f64) = (0.8, 1.5);
/// Least share of a fit's excess residual that the parameters must explain: another error bends them to it.
const LEAST_EXPLAINED: f64 = 0.3;
/// Steps of the fit, and when it is at rest: place in px, size as a fraction.
const MOST_STEPS: usize = 4;
const AT_REST: (f64, f64) = (0.01, 0.005);
/// Parameters: x, y, contrast, level, slopes of the light along row and column, size.
const ALL: usize = 7;

const NONE: Asked = Asked {
    slopes: false,
    size: false,
};

/// Nuisance parameters to fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Asked {
    pub slopes: bool,
    pub size: bool,
}

/// The fit of all parameters, from one of place, contrast and level on. Leaves the window without the slope and the template at
/// the size found, and gives the slope. `None` if the window does not separate the parameters, or they explain too little: then
/// both are as before. `start` is the place, and the excess of the sum of squares over noise.
pub(crate) fn fit(
    crop: &mut Crop,
    template: &mut Template,
    comb: &Comb,
    start: ((f64, f64), f64),
    weights: Weights,
    asked: Asked,
) -> Option<(f64, f64, Pass, (f64, f64))> {
    let (at, misfit) = start;
    let before = pass(crop, template, comb, at, weights, NONE)?.0.chi2;
    let size_before = template.size();
    let reach_px = 0.4 * template.radius_px();
    let mut taken = (0.0, 0.0);
    let mut asked = asked;
    let (mut x_px, mut y_px) = at;
    let mut found = None;
    for n in 0..MOST_STEPS {
        let Some((pass, slope, size)) = pass(crop, template, comb, (x_px, y_px), weights, asked)
        else {
            found = None;
            break;
        };
        let step = f64::hypot(pass.step_x_px, pass.step_y_px);
        if step > reach_px {
            found = None;
            break;
        }
        (x_px, y_px) = (x_px + pass.step_x_px, y_px + pass.step_y_px);
        taken = (taken.0 + slope.0, taken.1 + slope.1);
        crop.take_off_slope(middle(crop), (slope.0 as f32, slope.1 as f32));
        let wanted = template.size() * (1.0 + size.clamp(-0.2, 0.2));
        let size = wanted.clamp(SIZES.0, SIZES.1);
        let moved = (size / template.size() - 1.0).abs();
        // At the end of the range the size is no longer free.
        asked.size &= size == wanted;
        template.stretch_to(size);
        found = Some((x_px, y_px, pass));
        if step < AT_REST.0 && moved < AT_REST.1 && n > 0 {
            break;
        }
    }
    found = found.filter(|(_, _, pass)| before - pass.chi2 >= LEAST_EXPLAINED * misfit);
    if found.is_none() {
        crop.take_off_slope(middle(crop), (-taken.0 as f32, -taken.1 as f32));
        template.stretch_to(size_before);
    }
    found.map(|(x_px, y_px, pass)| (x_px, y_px, pass, taken))
}

/// One pass in all parameters: step and figures, change of the slopes, relative change of the size.
fn pass(
    crop: &Crop,
    template: &Template,
    comb: &Comb,
    (x_px, y_px): (f64, f64),
    weights: Weights,
    asked: Asked,
) -> Option<(Pass, (f64, f64), f64)> {
    let (x, y) = (
        (x_px - crop.x0 as f64) as f32,
        (y_px - crop.y0 as f64) as f32,
    );
    let (u0, v0) = middle(crop);
    let lanes_end = crop.width.next_multiple_of(LANES).min(STRIDE);
    let mut image = Image::new(lanes_end);
    let mut weight = weights.of_even(crop);
    let with_size = asked.size && comb.is_still();
    let slopes = f32::from(u8::from(asked.slopes));
    // The lower triangle, row by row, the right side, and the pixels' square.
    let (mut normal, mut right, mut square) = ([[0.0_f64; ALL]; ALL], [0.0_f64; ALL], 0.0_f64);
    for (j, pixels) in crop.rows.iter().enumerate().take(crop.height) {
        let dy = j as f32 - y;
        image.draw_row(template, comb, x, dy);
        weights.of_shot(crop, &image.value[..lanes_end], &mut weight);
        let mut with_holes = weight;
        for column in crop.left_out(j) {
            with_holes[column.min(STRIDE - 1)] = 0.0;
        }
        let (mut row, mut row_right, mut row_square) =
            ([[0.0_f32; ALL]; ALL], [0.0_f32; ALL], 0.0_f32);
        let parts = pixels.iter().zip(&with_holes).zip(&image.value);
        let parts = parts
            .zip(image.by_x.iter().zip(&image.by_y))
            .take(crop.width);
        for (i, (((p, w), f), (fx, fy))) in parts.enumerate() {
            let size = if with_size {
                (i as f32 - x) * fx + dy * fy
            } else {
                0.0
            };
            let g = [
                *fx,
                *fy,
                *f,
                1.0,
                slopes * (i as f32 - u0),
                slopes * (j as f32 - v0),
                size,
            ];
            for a in 0..ALL {
                let wg = w * g[a];
                for b in 0..=a {
                    row[a][b] += wg * g[b];
                }
                row_right[a] += wg * p;
            }
            row_square += w * p * p;
        }
        for a in 0..ALL {
            for b in 0..=a {
                normal[a][b] += f64::from(row[a][b]);
            }
            right[a] += f64::from(row_right[a]);
        }
        square += f64::from(row_square);
    }
    let mut matrix = SMatrix::<f64, ALL, ALL>::from_fn(|a, b| normal[a.max(b)][a.min(b)]);
    for k in 4..ALL {
        // A column that is not asked for.
        if matrix[(k, k)] == 0.0 {
            matrix[(k, k)] = 1.0;
        }
    }
    let right = SVector::<f64, ALL>::from(right);
    let inverse = matrix.cholesky()?.inverse();
    let solution = inverse * right;
    let amplitude = solution[2];
    let pass = Pass {
        step_x_px: solution[0] / amplitude,
        step_y_px: solution[1] / amplitude,
        amplitude,
        amplitude_variance: inverse[(2, 2)],
        // At the middle of the window.
        background: solution[3],
        chi2: square - solution.dot(&right),
        covariance: inverse.fixed_view::<2, 2>(0, 0) / (amplitude * amplitude),
    };
    let size = solution[6] / amplitude;
    let finite = pass.step_x_px.is_finite() && pass.step_y_px.is_finite() && pass.chi2.is_finite();
    (finite && size.is_finite()).then_some((pass, (solution[4], solution[5]), size))
}

/// Middle of a window.
pub(crate) fn middle(crop: &Crop) -> (f32, f32) {
    (
        0.5 * (crop.width as f32 - 1.0),
        0.5 * (crop.height as f32 - 1.0),
    )
}
