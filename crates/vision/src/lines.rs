//! The part of a bead's contrast that rows and columns of the picture explain: those that a camera reads out with an offset of
//! their own, a scratch, the wall of a channel.

use crate::crop::{Crop, LANES, STRIDE};
use crate::fit::Image;
use crate::streak::Comb;
use crate::template::Template;

/// Pixels next to the bead that show a line's offset, bead radii from its centre.
const BESIDE_RADII: f32 = 0.8;
/// Least number of these pixels.
const FEWEST: f32 = 4.0;

/// Contrast that the offsets of the lines through a bead would give it, and its variance for pixels of variance 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Explained {
    pub contrast: f64,
    pub variance: f64,
}

/// Sums along one line: light next to the bead and its pixels; the bead's own.
#[derive(Clone, Copy, Default)]
struct Line {
    beside: f32,
    pixels: f32,
    share: f32,
}

/// What rows and what columns explain of a fitted bead. Allocates nothing.
pub(crate) fn explained(
    crop: &Crop,
    template: &Template,
    comb: &Comb,
    (x_px, y_px): (f64, f64),
    (amplitude, background): (f64, f64),
) -> [Explained; 2] {
    let (x, y) = (
        (x_px - crop.x0 as f64) as f32,
        (y_px - crop.y0 as f64) as f32,
    );
    let away = BESIDE_RADII * template.radius_px() as f32;
    let mut image = Image::new(crop.width.next_multiple_of(LANES).min(STRIDE));
    let (mut rows, mut columns) = ([Line::default(); STRIDE], [Line::default(); STRIDE]);
    let (mut squares, mut sum) = (0.0_f32, 0.0_f32);
    let used = crop.rows.iter().enumerate().zip(&mut rows);
    for ((j, pixels), row) in used.take(crop.height) {
        image.draw_row(template, comb, x, j as f32 - y);
        let across = pixels.iter().zip(&image.value).zip(&mut columns);
        for (i, ((p, f), column)) in across.enumerate().take(crop.width) {
            // The bead's own light is removed: the rest is the line's.
            let light = p - background as f32 - amplitude as f32 * f;
            row.share += f;
            column.share += f;
            squares += f * f;
            sum += f;
            if (i as f32 - x).abs() > away {
                row.beside += light;
                row.pixels += 1.0;
            }
            if (j as f32 - y).abs() > away {
                column.beside += light;
                column.pixels += 1.0;
            }
        }
    }
    // The background is fitted, too: a template without its mean.
    let pixels = (crop.width * crop.height) as f32;
    let squares = squares - sum * sum / pixels;
    [
        (&rows, crop.height, crop.width),
        (&columns, crop.width, crop.height),
    ]
    .map(|(lines, count, length)| {
        let (mut contrast, mut variance) = (0.0_f32, 0.0_f32);
        for line in lines.iter().take(count).filter(|l| l.pixels >= FEWEST) {
            let share = line.share - sum / pixels * length as f32;
            contrast += share * line.beside / line.pixels;
            variance += share * share / line.pixels;
        }
        Explained {
            contrast: f64::from(contrast / squares),
            variance: f64::from(variance / (squares * squares)),
        }
    })
}
