//! What the template leaves of a bead's windows, and by how much that widens the variance of its position.
//!
//! The part of it that stays from fix to fix is the look of the bead: it offsets its centre by a constant and scatters
//! nothing. The part that changes is noise that is more, or wider, than the pixels' own, something that turns with the bead
//! or that the bead passes, and the pixel lattice under a template that is not quite right.

use crate::config::MAX_WINDOW_PX;
use crate::crop::{Crop, LANES, Row, STRIDE};
use crate::fit::Image;
use crate::pool::Scales;
use crate::rings::{RINGS, take_off_radial_mean};
use crate::streak::Comb;
use crate::template::Template;
use nalgebra::{Matrix2, Vector2};

/// Side of the patches over which what the template leaves counts as one, px and bead radii: noise that a camera, a codec
/// or a blur has spread, and what sticks to a bead, are alike over some pixels. In a narrow bead they are smaller, so that several of them
/// tell the place: one that held the bead would have no score, for a fit has none.
const PATCH: (f64, f64) = (5.0, 0.5);
const LARGEST_PATCH_RADII: f64 = 0.8;
/// Share of even noise's variance that is left in a patch of values between the pixels; of noise that neighbours have in common more is
/// left, of one that all have, all.
const INTERPOLATED: f64 = 0.83;
/// Most patches in a window.
const MAX_PATCHES: usize = 256;
/// Share of a new fix in a bead's running look.
const LOOK_FORGETTING: f64 = 1.0 / 64.0;
/// A fix this near to a bead's last one is of that bead, bead radii: beads do not overlap.
const SAME_RADII: f64 = 2.0;
/// Beads remembered when nobody says how many there are: the followed one and its neighbours.
const FEW_BEADS: usize = 12;

/// Least degrees of freedom for which [`Scales`] holds.
const LEAST_FREEDOM: f64 = 2.0;
/// Least widening: the noise of the pixels gives at least this variance of the place. A window without noise, as a codec makes it, has
/// a smaller one. Its logarithm would outweigh those of many other windows.
const LEAST_WIDENING: f64 = 1.0;

/// One vector a patch: what its pixels add to the score of the position, relative to the bead's contrast.
type Scores = [[f32; 2]; MAX_PATCHES];

/// A bead's look.
#[derive(Debug, Clone)]
struct Look {
    x_px: f64,
    y_px: f64,
    used: u64,
    fixes: u32,
    /// Number of the frame of the last fix.
    frame: u64,
    /// Half the window that the scores are from: of another one they are not comparable.
    half: usize,
    mean: Scores,
    /// Its bends, relative to its contrast.
    bends: [f64; 2],
}

impl Look {
    /// Of a bead that is nowhere.
    const NONE: Look = Look {
        x_px: f64::NAN,
        y_px: f64::NAN,
        used: 0,
        fixes: 0,
        frame: 0,
        half: 0,
        mean: [[0.0; 2]; MAX_PATCHES],
        bends: [0.0; 2],
    };
}

/// What the patches of a window say.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Widening {
    /// By how much the variance of the position is larger.
    pub by: f64,
    /// The window's bends, besides those of the look if the bead was seen before.
    pub bends: [f64; 2],
    /// Whether it was.
    pub is_known: bool,
}

/// The looks of the beads, and room to work.
#[derive(Debug, Clone)]
pub(crate) struct Residues {
    looks: Vec<Look>,
    fixes: u64,
    /// Frames begun so far.
    frames: u64,
    /// What first and later fixes of all beads were widened by.
    pooled: [Scales; 2],
    /// Room for what the template leaves of a window, and its mean at whole distances from the bead, px.
    pub left: Box<[Row; MAX_WINDOW_PX]>,
    rings: Box<[f32; RINGS]>,
}

impl Residues {
    pub(crate) fn new() -> Self {
        Residues {
            looks: vec![Look::NONE; FEW_BEADS],
            fixes: 0,
            frames: 1,
            pooled: [Scales::default(); 2],
            left: Box::new([[0.0; STRIDE]; MAX_WINDOW_PX]),
            rings: Box::new([0.0; RINGS]),
        }
    }

    /// Begins another frame.
    pub(crate) fn begin_frame(&mut self) {
        self.frames += 1;
    }

    /// Makes room for the looks of so many beads.
    pub(crate) fn reserve(&mut self, beads: usize) {
        let room = beads.max(self.looks.len());
        self.looks.resize(room, Look::NONE);
    }

    /// By how much the variance of the position is larger than from noise of the even `variance` (grey^2), judged by what
    /// the template leaves of this window, besides the bead's look, and has left of the windows before. The same of its `bends`,
    /// relative to the contrast. `None` for a window with the bead far off its middle. Allocates nothing.
    pub(crate) fn widening(
        &mut self,
        crop: &Crop,
        template: &Template,
        comb: &Comb,
        at: (f64, f64),
        (amplitude, background): (f64, f64),
        (variance, mut bends): (f64, [f64; 2]),
    ) -> Option<Widening> {
        let half = crop.width.max(crop.height) / 2;
        let (scores, inverse, freedom) =
            self.scores(crop, template, comb, at, (amplitude, background))?;
        let common = in_common(crop, self.left.as_slice());
        let relative = variance / (amplitude * amplitude);
        let reach_px = SAME_RADII * template.radius_px();
        let k = self.look(at, reach_px, half);
        let look = &mut self.looks[k];
        // A window that is fitted again must not be compared with itself.
        let again = look.frame == self.frames;
        // The mean so far has an error of its own: of n fixes 1/n of their variance.
        let known = f64::from(look.fixes);
        let forgetting = (1.0 / (known + 1.0)).max(LOOK_FORGETTING);
        let is_new = look.fixes == 0 || again;
        let own = 1.0 + forgetting;
        let kept = INTERPOLATED + (1.0 - INTERPOLATED) * common;
        let mut now = widening_of(&scores, &Look::NONE.mean, inverse, relative * kept)?;
        if !is_new {
            // What the look has and this window has not, as a speck that is a part of the fit now, moves this fix by nothing.
            now = now.min(widening_of(
                &scores,
                &look.mean,
                inverse,
                relative * own * kept,
            )?);
        }
        let (seen, look_bends) = (bends, look.bends);
        if !is_new {
            for (bend, mean) in bends.iter_mut().zip(look_bends) {
                *bend = (*bend - mean) / own.sqrt();
            }
        }
        let pool = &mut self.pooled[usize::from(!is_new)];
        if !again {
            for (mean, bend) in look.bends.iter_mut().zip(seen) {
                *mean += forgetting * (bend - *mean);
            }
            for (mean, score) in look.mean.iter_mut().zip(&scores) {
                for (m, s) in mean.iter_mut().zip(score) {
                    *m += forgetting as f32 * (s - *m);
                }
            }
            look.fixes = look.fixes.saturating_add(1);
            look.frame = self.frames;
        }
        let now = now.max(LEAST_WIDENING);
        pool.take_in(now, freedom);
        Some(Widening {
            by: pool.moderate(now, freedom),
            bends,
            is_known: !is_new,
        })
    }

    /// The look of the bead at a place: the one of the nearest fix before, or a new one in place of that unused for longest.
    fn look(&mut self, (x_px, y_px): (f64, f64), reach_px: f64, half: usize) -> usize {
        self.fixes += 1;
        let away = |look: &Look| f64::hypot(look.x_px - x_px, look.y_px - y_px);
        let near = (self.looks.iter().enumerate())
            .filter(|(_, look)| look.half == half && away(look) < reach_px)
            .min_by(|a, b| away(a.1).total_cmp(&away(b.1)))
            .map(|(k, _)| k);
        let oldest = || (self.looks.iter().enumerate()).min_by_key(|(_, look)| look.used);
        let k = near.or_else(|| oldest().map(|(k, _)| k)).unwrap_or(0);
        if near.is_none() {
            self.looks[k] = Look { half, ..Look::NONE };
        }
        let look = &mut self.looks[k];
        (look.x_px, look.y_px, look.used) = (x_px, y_px, self.fixes);
        k
    }

    /// Takes the mean all round a place of the window off what was put into `left`.
    pub(crate) fn take_off_mean(&mut self, crop: &Crop, (x, y): (f32, f32)) {
        take_off_radial_mean(crop, (x, y), self.left.as_mut_slice(), &mut self.rings);
    }

    /// Mean square of what the template leaves besides its mean all round: a bead in another focus has none, whatever it has made of
    /// the profile, and it moves no bead; two beads, or a bead and something else, have.
    pub(crate) fn lopsided(
        &mut self,
        crop: &Crop,
        template: &Template,
        comb: &Comb,
        at: (f64, f64),
        (amplitude, background): (f64, f64),
    ) -> f64 {
        let middle = self.fill_left(crop, template, comb, at, (amplitude, background));
        let left = self.left.as_mut_slice();
        take_off_radial_mean(crop, middle, left, &mut self.rings);
        let rows = left.iter().take(crop.height);
        let square = |row: &Row| row.iter().take(crop.width).map(|v| v * v).sum::<f32>();
        let sum: f32 = rows.map(square).sum();
        f64::from(sum) / ((crop.width * crop.height) as f64)
    }

    /// Of what the last call of [`Residues::widening`] has left: its variance besides its mean all round where the place is read off,
    /// grey^2, and how much the picture answers to a motion of the bead, over how much the template does. Of a blurred bead, whose
    /// edges the template has steeper, it is less than 1, and the place is told worse by its square.
    pub(crate) fn besides_the_mean(
        &self,
        crop: &Crop,
        template: &Template,
        comb: &Comb,
        (x_px, y_px): (f64, f64),
        amplitude: f64,
    ) -> (f64, f64) {
        let (x, y) = (
            (x_px - crop.x0 as f64) as f32,
            (y_px - crop.y0 as f64) as f32,
        );
        let mut image = Image::new(crop.lanes_end());
        let (mut sum, mut weights, mut answer) = (0.0_f32, 0.0_f32, 0.0_f32);
        for (j, left) in self.left.iter().enumerate().take(crop.height) {
            let dy = j as f32 - y;
            image.draw_row(template, comb, x, dy);
            let derivatives = image.by_x.iter().zip(&image.by_y);
            for (i, ((fx, fy), r)) in derivatives.zip(left).enumerate().take(crop.width) {
                let dx = i as f32 - x;
                let weight = fx * fx + fy * fy;
                sum += weight * r * r;
                weights += weight;
                let away = (dx * dx + dy * dy).sqrt().max(0.5);
                let k = (away as usize).min(RINGS - 2);
                // The derivative by the centre is the opposite of that by the place.
                let slope = self.rings[k] - self.rings[k + 1];
                answer += (fx * dx + fy * dy) / away * slope;
            }
        }
        let weights = f64::from(weights.max(f32::MIN_POSITIVE));
        let answers = 1.0 + f64::from(answer) / (amplitude * weights);
        (f64::from(sum) / weights, answers)
    }

    /// Fills `left` with what the template leaves; the bead's place in the window.
    fn fill_left(
        &mut self,
        crop: &Crop,
        template: &Template,
        comb: &Comb,
        (x_px, y_px): (f64, f64),
        (amplitude, background): (f64, f64),
    ) -> (f32, f32) {
        let left = self.left.as_mut_slice();
        let (x, y) = (
            (x_px - crop.x0 as f64) as f32,
            (y_px - crop.y0 as f64) as f32,
        );
        let (amplitude, background) = (amplitude as f32, background as f32);
        let mut image = Image::new(crop.width.next_multiple_of(LANES).min(STRIDE));
        for ((j, pixels), left) in crop
            .rows
            .iter()
            .enumerate()
            .zip(left.iter_mut())
            .take(crop.height)
        {
            image.draw_row(template, comb, x, j as f32 - y);
            for ((l, p), f) in left
                .iter_mut()
                .zip(pixels)
                .zip(&image.value)
                .take(crop.width)
            {
                *l = p - background - amplitude * f;
            }
        }
        for (j, left) in left.iter_mut().enumerate().take(crop.height) {
            for column in crop.left_out(j) {
                left[column.min(STRIDE - 1)] = 0.0;
            }
        }
        (x, y)
    }

    /// The patches' scores, and the inverse of the information about the position, both for a contrast of 1. The third value is the degrees
    /// of freedom of the sum of the squared scores in even noise (Satterthwaite 1946). A residual that
    /// is the same all round, or on opposite sides of the centre, as a template of another focus or size leaves it, does
    /// not move the position and does not count.
    fn scores(
        &mut self,
        crop: &Crop,
        template: &Template,
        comb: &Comb,
        (x_px, y_px): (f64, f64),
        (amplitude, background): (f64, f64),
    ) -> Option<(Scores, Matrix2<f64>, f64)> {
        let (x, y) = self.fill_left(crop, template, comb, (x_px, y_px), (amplitude, background));
        let (left, amplitude) = (self.left.as_mut_slice(), amplitude as f32);
        let mut image = Image::new(crop.width.next_multiple_of(LANES).min(STRIDE));
        take_off_radial_mean(crop, (x, y), left, &mut self.rings);
        // Points at whole distances from the centre: those opposite each other lie alike between the pixels.
        let reach = |c: f32, len: usize| c.min(len as f32 - 1.0 - c).floor().max(0.0) as usize;
        let (across, down) = (reach(x, crop.width), reach(y, crop.height));
        if 2 * across + 1 < crop.width / 2 || 2 * down + 1 < crop.height / 2 {
            return None;
        }
        let at = |u: f32, v: f32| -> f32 {
            let (i, j) = (u as usize, v as usize);
            let (a, b) = (u - i as f32, v - j as f32);
            let get = |j: usize, i: usize| {
                left.get(j)
                    .and_then(|row| row.get(i))
                    .copied()
                    .unwrap_or(0.0)
            };
            let (upper, lower) = (
                get(j, i) + a * (get(j, i + 1) - get(j, i)),
                get(j + 1, i) + a * (get(j + 1, i + 1) - get(j + 1, i)),
            );
            upper + b * (lower - upper)
        };
        let radius_px = template.radius_px();
        let patch = PATCH
            .0
            .min(LARGEST_PATCH_RADII * radius_px)
            .max(PATCH.1 * radius_px);
        // Counted from the centre, so that a patch is the same part of the bead in every window.
        let half = crop.width.max(crop.height) / 2 + 1;
        let side = (patch as usize).max((2 * half + 1).div_ceil(15));
        let columns = (2 * half + 1).div_ceil(side);
        let mut patches = [[0.0; 2]; MAX_PATCHES];
        let mut information = Matrix2::zeros();
        let mut own = [[0.0_f32; 3]; MAX_PATCHES];
        for n in 0..=2 * down {
            let dy = n as f32 - down as f32;
            image.draw_row(template, comb, across as f32, dy);
            for m in 0..=2 * across {
                let dx = m as f32 - across as f32;
                let k = (n + half - down) / side * columns + (m + half - across) / side;
                let (Some(gx), Some(gy), Some(patch), Some(own)) = (
                    image.by_x.get(m),
                    image.by_y.get(m),
                    patches.get_mut(k),
                    own.get_mut(k),
                ) else {
                    continue;
                };
                let g = Vector2::new(f64::from(*gx), f64::from(*gy));
                information += g * g.transpose();
                // Half the difference: the part that can move the position.
                let odd = 0.5 / amplitude * (at(x + dx, y + dy) - at(x - dx, y - dy));
                patch[0] += odd * gx;
                patch[1] += odd * gy;
                own[0] += gx * gx;
                own[1] += gy * gy;
                own[2] += gx * gy;
            }
        }
        let (mut all, mut squares) = (0.0_f32, 0.0_f32);
        for [xx, yy, xy] in &own {
            all += xx + yy;
            squares += xx * xx + yy * yy + 2.0 * xy * xy;
        }
        // Patches opposite each other have the same score.
        let freedom = f64::from(0.5 * all * all / squares.max(f32::MIN_POSITIVE));
        let freedom = freedom.max(LEAST_FREEDOM);
        Some((patches, information.try_inverse()?, freedom))
    }
}

/// The clustered sandwich: what the patches' scores scatter the position by, over what noise of `variance` does; the mean of
/// the two directions.
fn widening_of(
    scores: &Scores,
    mean: &Scores,
    inverse: Matrix2<f64>,
    variance: f64,
) -> Option<f64> {
    let mut sum = Matrix2::zeros();
    let mut strongest = 0.0_f64;
    for (score, mean) in scores.iter().zip(mean) {
        let u = Vector2::new(f64::from(score[0] - mean[0]), f64::from(score[1] - mean[1]));
        sum += u * u.transpose();
        strongest = strongest.max(u.norm_squared());
    }
    // Every patch has its opposite with the same score; the scores of a fit sum to zero, which takes some off.
    let effective = (sum.trace() / strongest.max(1e-24)).max(4.0);
    let sum = sum * (2.0 * effective / (effective - 1.5));
    let robust = inverse * sum * inverse;
    let ratio = robust.trace() / (inverse * variance).trace();
    ratio.is_finite().then_some(ratio)
}

/// Correlation of neighbours in a row of what is left, 0 to 1.
fn in_common(crop: &Crop, left: &[Row]) -> f64 {
    let (mut products, mut squares) = (0.0_f32, 0.0_f32);
    for row in left.iter().take(crop.height) {
        let row = row.get(..crop.width).unwrap_or(&[]);
        for (a, b) in row.iter().zip(row.iter().skip(1)) {
            products += a * b;
            squares += 0.5 * (a * a + b * b);
        }
    }
    f64::from(products / squares.max(f32::MIN_POSITIVE)).clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::LocaliserConfig;
    use crate::frame::{Frame, Pixels};
    use crate::template::ProfileSpec;
    use cellpos_numeric::Random;

    const SIDE: usize = 21;
    const AT: (f64, f64) = (10.0, 10.0);

    /// The widening for a window of a bead of contrast 400 with noise, relative to pixels of variance 1.
    fn widened(residues: &mut Residues, noise: f64, is_new: bool) -> f64 {
        let spec = ProfileSpec::Gaussian { sigma_px: 1.5 };
        let template = LocaliserConfig::new(spec).template().unwrap();
        let mut grey = vec![1000.0_f32; SIDE * SIDE];
        template.draw(&mut grey, SIDE, AT.0, AT.1, 400.0);
        let mut random = Random::new(7 + residues.fixes * u64::from(is_new));
        let pixels = grey
            .iter()
            .map(|v| (f64::from(*v) + noise * random.normal()).round() as u16);
        let pixels: Vec<u16> = pixels.collect();
        let (width, height, pixels) = (SIDE, SIDE, Pixels::Mono16(&pixels));
        let frame = Frame {
            width,
            height,
            pixels,
        };
        let mut crop = Crop::new();
        assert!(crop.take(&frame, AT.0, AT.1, SIDE));
        let parts = (400.0, 1000.0 - f64::from(crop.pedestal));
        residues.frames += u64::from(is_new);
        let found = residues.widening(&crop, &template, &Comb::STILL, AT, parts, (1.0, [0.0; 2]));
        found.unwrap().by
    }

    #[test]
    fn a_window_that_is_fitted_again_is_not_compared_with_itself() {
        let mut residues = Residues::new();
        let first = widened(&mut residues, 5.0, true);
        let again = widened(&mut residues, 5.0, false);
        assert!(first > 5.0 && again > 0.99 * first, "{first} {again}");
    }

    #[test]
    fn windows_without_noise_hardly_change_what_others_are_widened_by() {
        let mut residues = Residues::new();
        (0..40).for_each(|_| _ = widened(&mut residues, 2.0, true));
        let before = residues.pooled[1].common().unwrap();
        (0..2).for_each(|_| _ = widened(&mut residues, 0.0, true));
        let after = residues.pooled[1].common().unwrap();
        assert!(after > 0.75 * before, "{before} {after}");
    }
}
