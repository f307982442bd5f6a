//! Parameters beyond place, contrast and level: light that rises across the window, and a bead out of focus, whose image is larger
//! or smaller than the template.
//!
//! Light that rises draws the fit to its side. A template of another size weights the pixels wrongly, and between the pixels
//! it is off its own centre. Both are nuisance parameters, and a window that does not need them would lose certainty by
//! them: they are fitted where a score test finds them.

use crate::crop::{Crop, LANES, Row, STRIDE};
use crate::fit::{Image, Pass, Weights};
use crate::streak::Comb;
use crate::template::Template;
use nalgebra::{SMatrix, SVector};
use wide::f32x4;

/// Smallest and largest size that another focus or a blur makes of a bead. A blur of half the radius makes a Gaussian larger by the root
/// of two. Farther off the rest of the picture has changed, too, and beads of other sizes are others.
const SIZES: (f64, f64) = (0.8, 1.5);
/// Least share of a fit's excess residual that the parameters must explain: another error bends them to it.
const LEAST_EXPLAINED: f64 = 0.3;
/// Steps of the fit, and when it is at rest: place in px, size as a fraction.
const MOST_STEPS: usize = 4;
const AT_REST: (f64, f64) = (0.01, 0.005);
/// Parameters: x, y, contrast, level, slope of the light along the row, size, slope down the column.
const ALL: usize = 7;

/// Nuisance parameters to fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Asked {
    pub slopes: bool,
    pub size: bool,
}

/// The fit of all parameters, from one of place, contrast and level on. Leaves the window without the slope and the template at
/// the size found, and gives the slope. `None` if the window does not separate the parameters, or they explain too little: then
/// both are as before. `start` is the place, the sum of squares that is left there, and how much of it is more than noise.
pub(crate) fn fit(
    crop: &mut Crop,
    template: &mut Template,
    comb: &Comb,
    start: ((f64, f64), f64, f64),
    weights: Weights,
    asked: Asked,
) -> Option<(f64, f64, Pass, (f64, f64))> {
    let (at, before, misfit) = start;
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
    let lanes_end = crop.lanes_end();
    let mut image = Image::new(lanes_end);
    let mut weight = weights.of_even(crop);
    let with_size = f32::from(u8::from(asked.size && comb.is_still()));
    let slopes = f32::from(u8::from(asked.slopes));
    // Along the row: derivative by the slope, and distance from the bead for the size. A parameter that is not asked for has zeros.
    let (mut across, mut away): (Row, Row) = ([0.0; STRIDE], [0.0; STRIDE]);
    for (i, (u, dx)) in across.iter_mut().zip(&mut away).enumerate() {
        (*u, *dx) = (slopes * (i as f32 - u0), with_size * (i as f32 - x));
    }
    let mut sums = Sums::default();
    for (j, pixels) in crop.rows.iter().enumerate().take(crop.height) {
        let dy = j as f32 - y;
        image.draw_row(template, comb, x, dy);
        weights.of_shot(crop, &image.value[..lanes_end], &mut weight);
        let mut with_holes = weight;
        for column in crop.left_out(j) {
            with_holes[column.min(STRIDE - 1)] = 0.0;
        }
        let mut row = RowSums::default();
        let dy = f32x4::splat(with_size * dy);
        for k in (0..lanes_end).step_by(LANES) {
            let four = |from: &Row| {
                f32x4::from(<[f32; LANES]>::try_from(&from[k..k + LANES]).unwrap_or_default())
            };
            let (fx, fy) = (four(&image.by_x), four(&image.by_y));
            let size = four(&away) * fx + dy * fy;
            let g = [fx, fy, four(&image.value), f32x4::ONE, four(&across), size];
            row.add(four(&with_holes), g, four(pixels));
        }
        sums.take_row(&row, slopes * (j as f32 - v0));
    }
    sums.solve()
}

/// Parameters whose derivative changes along a row: all but the slope down the column, which is a row's own.
const ALONG: usize = ALL - 1;
/// The level among them: its products are the sums of the others.
const LEVEL: usize = 3;

/// Sums over a row, lane by lane: the lower triangle of the normal matrix, the right side, and the pixels' square.
#[derive(Default)]
struct RowSums {
    normal: [[f32x4; ALONG]; ALONG],
    right: [f32x4; ALONG],
    square: f32x4,
}

impl RowSums {
    #[inline(always)]
    fn add(&mut self, w: f32x4, g: [f32x4; ALONG], p: f32x4) {
        for (a, (row, right)) in self.normal.iter_mut().zip(&mut self.right).enumerate() {
            let wg = w * g[a];
            for (sum, g) in row.iter_mut().zip(&g).take(a + 1) {
                *sum += wg * *g;
            }
            *right += wg * p;
        }
        self.square += w * p * p;
    }
}

/// Sums over the window, in the order x, y, contrast, level, slope along the row, size, slope down the column.
#[derive(Default)]
struct Sums {
    normal: [[f64; ALL]; ALL],
    right: [f64; ALL],
    square: f64,
}

impl Sums {
    /// A row in which the slope down the column adds `v`.
    fn take_row(&mut self, row: &RowSums, v: f32) {
        let (v, t) = (f64::from(v), |lanes: f32x4| f64::from(lanes.reduce_add()));
        for a in 0..ALONG {
            for b in 0..=a {
                self.normal[a][b] += t(row.normal[a][b]);
            }
            self.normal[ALONG][a] += v * t(row.normal[a.max(LEVEL)][a.min(LEVEL)]);
            self.right[a] += t(row.right[a]);
        }
        self.normal[ALONG][ALONG] += v * v * t(row.normal[LEVEL][LEVEL]);
        self.right[ALONG] += v * t(row.right[LEVEL]);
        self.square += t(row.square);
    }

    fn solve(&self) -> Option<(Pass, (f64, f64), f64)> {
        let mut matrix = SMatrix::<f64, ALL, ALL>::from_fn(|a, b| self.normal[a.max(b)][a.min(b)]);
        for k in LEVEL + 1..ALL {
            // A column that is not asked for.
            if matrix[(k, k)] == 0.0 {
                matrix[(k, k)] = 1.0;
            }
        }
        let right = SVector::<f64, ALL>::from(self.right);
        let inverse = matrix.cholesky()?.inverse();
        let solution = inverse * right;
        let amplitude = solution[2];
        let pass = Pass {
            step_x_px: solution[0] / amplitude,
            step_y_px: solution[1] / amplitude,
            amplitude,
            amplitude_variance: inverse[(2, 2)],
            // At the middle of the window.
            background: solution[LEVEL],
            chi2: self.square - solution.dot(&right),
            covariance: inverse.fixed_view::<2, 2>(0, 0) / (amplitude * amplitude),
        };
        let size = solution[5] / amplitude;
        let finite =
            pass.step_x_px.is_finite() && pass.step_y_px.is_finite() && pass.chi2.is_finite();
        (finite && size.is_finite()).then_some((pass, (solution[4], solution[6]), size))
    }
}

/// Middle of a window.
pub(crate) fn middle(crop: &Crop) -> (f32, f32) {
    (
        0.5 * (crop.width as f32 - 1.0),
        0.5 * (crop.height as f32 - 1.0),
    )
}
