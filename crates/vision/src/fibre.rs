//! The likelihood ratio of a bead and a fibre: how much of a window a fibre at the bead's place explains.
//!
//! A score test of the bead's own pixels misses a faint fibre, because most of the fibre's light is beyond the bead. The fibre is an
//! elliptical Gaussian. Its contrast and its level are fitted, as those of the bead are.

use crate::crop::{Crop, LANES, Row, STRIDE};
use wide::f32x4;

/// Length over width of the fibre. Let an object be an elliptical Gaussian of aspect a. In even noise a round Gaussian of its width explains
/// a part proportional to a^2 / (1 + a^2). One of aspect L explains L a^2 / (L^2 + a^2), which is more if a^2 > L. With L = 4, an object
/// that is more than twice as long as wide is a fibre.
const ASPECT: f32 = 4.0;

/// Chi-square that a fibre along a direction explains, for noise of variance 1 grey^2. The fibre is as wide as a bead of the radius. 0 if
/// its contrast has the other sign.
pub(crate) fn explains(
    crop: &Crop,
    (x_px, y_px): (f64, f64),
    radius_px: f64,
    (cos, sin): (f64, f64),
    sign: f64,
) -> f64 {
    let (x, y) = (
        (x_px - crop.x0 as f64) as f32,
        (y_px - crop.y0 as f64) as f32,
    );
    let (cos, sin) = (cos as f32, sin as f32);
    // The radius of a Gaussian bead is two of its standard deviations.
    let across = (2.0 / radius_px) as f32;
    let along = across / ASPECT;
    let mut away: Row = [0.0; STRIDE];
    away.iter_mut()
        .enumerate()
        .for_each(|(i, dx)| *dx = i as f32 - x);
    let [mut n, mut f, mut ff, mut p, mut fp] = [f32x4::ZERO; 5];
    for (j, pixels) in crop.rows.iter().enumerate().take(crop.height) {
        let mut mask = crop.mask;
        for column in crop.left_out(j) {
            mask[column.min(STRIDE - 1)] = 0.0;
        }
        let dy = j as f32 - y;
        for k in (0..crop.lanes_end()).step_by(LANES) {
            let four = |from: &Row| {
                f32x4::from(<[f32; LANES]>::try_from(&from[k..k + LANES]).unwrap_or_default())
            };
            let (dx, m) = (four(&away), four(&mask));
            let u = (dx * cos + f32x4::splat(dy * sin)) * along;
            let v = (f32x4::splat(dy * cos) - dx * sin) * across;
            let light = m * ((u * u + v * v) * -0.5).exp();
            let grey = four(pixels);
            n += m;
            f += light;
            ff += light * light;
            p += m * grey;
            fp += light * grey;
        }
    }
    let [n, f, ff, p, fp] = [n, f, ff, p, fp].map(|lanes| f64::from(lanes.reduce_add()));
    let (contrast, own) = (fp - f * p / n, ff - f * f / n);
    if sign * contrast > 0.0 && own > 0.0 {
        contrast * contrast / own
    } else {
        0.0
    }
}
