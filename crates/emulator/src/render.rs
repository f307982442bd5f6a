//! Renders positions of beads and cells as grey values.
//!
//! It computes only the neighbourhood of an object; everything else is background. The background's noise is drawn once into a long strip
//! of grey values, and each row uses a piece at a random place. A piece recurs after a hundred thousand pixels, at another place of
//! another frame.

use crate::cell_picture::{CellPicture, HalfAxes, walls};
use crate::config::WorldConfig;
use crate::light::empty_channel;
use crate::look::Look;
use cellpos_numeric::Random;
use cellpos_vision::{PixelResponse, RadialProfile, Template};

/// Largest spacing of the points that replace a bead's path; the error of the blur is of second order in it.
const POINT_SPACING_PX: f64 = 0.25;
const MAX_POINTS: usize = 16;
/// Small enough to stay in a core's own cache.
const STRIP_LEN: usize = 1 << 17;
/// Light of the LED over a whole exposure, grey levels.
const LED_GREY: f64 = 60.0;
const GAUSSIAN_LEN: usize = 1 << 14;

/// Points that represent the path of a bead during an exposure, px.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Blur {
    points: [(f32, f32); MAX_POINTS],
    count: usize,
}

impl Blur {
    /// Reduces a bead's path, sampled at equal times with the weights of the trapezoidal rule, to as few points as the
    /// spacing allows.
    pub(crate) fn along(path: &[(f64, f64)]) -> Self {
        Self::spaced(path, POINT_SPACING_PX)
    }

    fn spaced(path: &[(f64, f64)], spacing_px: f64) -> Self {
        let mut blur = Self {
            points: [(0.0, 0.0); MAX_POINTS],
            count: 1,
        };
        let length_px = path
            .windows(2)
            .map(|w| (w[1].0 - w[0].0).hypot(w[1].1 - w[0].1))
            .sum::<f64>();
        let wanted = (length_px / spacing_px).ceil().max(1.0);
        blur.count = (wanted as usize).min(MAX_POINTS);
        let last = path.len().saturating_sub(1);
        for (k, point) in blur.points.iter_mut().enumerate().take(blur.count) {
            // The mean over the k-th of `count` equal parts of the exposure.
            let (from, to) = (
                last as f64 * k as f64 / blur.count as f64,
                last as f64 * (k + 1) as f64 / blur.count as f64,
            );
            let (x, y) = mean_between(path, from, to);
            *point = (x as f32, y as f32);
        }
        blur
    }

    pub(crate) fn points(&self) -> &[(f32, f32)] {
        &self.points[..self.count]
    }
}

/// Time average of the piecewise linear path between the sample numbers `from` and `to`.
pub(crate) fn mean_between(path: &[(f64, f64)], from: f64, to: f64) -> (f64, f64) {
    let at = |u: f64| {
        let i = (u as usize).min(path.len().saturating_sub(2));
        let t = u - i as f64;
        match (path.get(i), path.get(i + 1)) {
            (Some(a), Some(b)) => (a.0 + t * (b.0 - a.0), a.1 + t * (b.1 - a.1)),
            (Some(a), None) => *a,
            _ => (0.0, 0.0),
        }
    };
    if to <= from {
        return at(from);
    }
    let (mut x, mut y) = (0.0, 0.0);
    let (mut u, mut a) = (from, at(from));
    while u < to {
        // Never negative, so a cast rounds down without a function call.
        let next = ((u as usize + 1) as f64).min(to);
        let b = at(next);
        x += 0.5 * (a.0 + b.0) * (next - u);
        y += 0.5 * (a.1 + b.1) * (next - u);
        (u, a) = (next, b);
    }
    (x / (to - from), y / (to - from))
}

/// Something to be drawn.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Body {
    blur: Blur,
    form: Form,
}

#[derive(Debug, Clone, Copy)]
enum Form {
    /// A bead, with the size of its ring against that in focus.
    Bead(f32),
    Cell(HalfAxes),
}

/// Draws frames.
#[derive(Debug, Clone)]
pub(crate) struct Renderer {
    width: usize,
    height: usize,
    pixel_um: f64,
    background: f32,
    contrast: f32,
    read_variance: f32,
    grey_per_electron: f32,
    template: Template,
    support_px: f32,
    cell: CellPicture,
    /// Pixels on the channel's walls, by number, and the grey levels that they lose; empty without a cell.
    walls: Vec<(usize, f32)>,
    /// Grey level of each pixel of the empty channel, and its noise; empty when the light is even.
    light: Vec<(f32, f32)>,
    /// Grey values of background with noise.
    strip: Vec<u8>,
    gaussian: Vec<f32>,
    /// Room for the objects' light in a piece of one row.
    values: Vec<f32>,
    rng: Random,
}

impl Renderer {
    /// `None` when the bead's radius makes no profile.
    pub(crate) fn new(config: &WorldConfig) -> Option<Self> {
        let profile = Look::new(config.bead_look, config.bead_radius_px())?;
        let template = Template::new(&profile, PixelResponse::Point);
        let mut noise = Random::stream(config.seed, 10);
        let gaussian: Vec<f32> = (0..GAUSSIAN_LEN + usize::from(config.width_px))
            .map(|_| noise.normal() as f32)
            .collect();
        let read_variance = (config.read_noise_grey * config.read_noise_grey) as f32;
        let grey_per_electron = (1.0 / config.electrons_per_grey) as f32;
        let background = config.background_grey as f32;
        let sd = f64::from(background * grey_per_electron + read_variance).sqrt();
        let light = empty_channel(config).into_iter().map(|level| {
            let variance = level * grey_per_electron + read_variance;
            (level, variance.sqrt())
        });
        let light = light.collect();
        let strip = (0..STRIP_LEN + usize::from(config.width_px))
            .map(|_| grey(background + (sd * noise.normal()) as f32))
            .collect();
        Some(Self {
            width: usize::from(config.width_px),
            height: usize::from(config.height_px),
            pixel_um: config.pixel_um,
            background,
            contrast: config.contrast_grey as f32,
            read_variance,
            grey_per_electron,
            support_px: profile.support_px() as f32,
            template,
            cell: CellPicture::new(config.pixel_um, &config.cell.unwrap_or_default()),
            walls: config.cell.map_or(Vec::new(), |cell| walls(config, &cell)),
            light,
            strip,
            gaussian,
            values: vec![0.0; usize::from(config.width_px)],
            rng: Random::stream(config.seed, 11),
        })
    }

    /// A bead that moved along a path, px; its ring is larger by the fraction `defocus`.
    pub(crate) fn bead(&self, path: &[(f64, f64)], defocus: f64) -> Body {
        Body {
            blur: Blur::along(path),
            form: Form::Bead((1.0 + defocus) as f32),
        }
    }

    /// A cell that moved along a path, px.
    pub(crate) fn cell(&self, path: &[(f64, f64)], length_um: f64, width_um: f64) -> Body {
        let px = |um: f64| um / self.pixel_um;
        Body {
            // The soft edge hides steps of half its width.
            blur: Blur::spaced(path, f64::from(0.5 * self.cell.blur_px())),
            form: Form::Cell(self.cell.half_axes(px(length_um), px(width_um))),
        }
    }

    /// Draws the objects (none, one or two) into `pixels`, which is brought to the frame's size. `lit` is the part of the
    /// exposure for which the LED added its light.
    pub(crate) fn draw(&mut self, bodies: &[Body], lit: f64, pixels: &mut Vec<u8>) {
        self.draw_bodies(bodies, pixels);
        let light = grey((lit * LED_GREY) as f32);
        if light > 0 {
            for pixel in pixels {
                *pixel = pixel.saturating_add(light);
            }
        }
    }

    fn draw_bodies(&mut self, bodies: &[Body], pixels: &mut Vec<u8>) {
        pixels.resize(self.width * self.height, 0);
        self.draw_empty(pixels);
        for (number, wall) in &self.walls {
            if let Some(pixel) = pixels.get_mut(*number) {
                *pixel = grey(f32::from(*pixel) - wall);
            }
        }
        let Some((columns, rows)) = self.neighbourhood(bodies) else {
            return;
        };
        for (y, row) in pixels
            .chunks_exact_mut(self.width)
            .enumerate()
            .take(rows.1)
            .skip(rows.0)
        {
            let (Some(row), Some(values)) = (
                row.get_mut(columns.0..columns.1),
                self.values.get_mut(..columns.1 - columns.0),
            ) else {
                continue;
            };
            values.fill(0.0);
            for body in bodies {
                let weight = self.contrast / body.blur.points().len() as f32;
                for &(bx, by) in body.blur.points() {
                    let (x, dy) = (bx - columns.0 as f32, y as f32 - by);
                    match body.form {
                        Form::Bead(size) => {
                            let reach_px = size * self.support_px;
                            let room2 = reach_px * reach_px - dy * dy;
                            // The same light on a larger ring.
                            let (weight, shrink) = (weight / (size * size), 1.0 / (size * size));
                            if room2 > 0.0 {
                                add_chord(values, x, room2.sqrt(), |dx| {
                                    let r2 = shrink * (dx * dx + dy * dy);
                                    weight * self.template.value_at_squared(r2)
                                });
                            }
                        }
                        Form::Cell(axes) => {
                            let (along, across) = self.cell.reach_px(axes);
                            let room2 = 1.0 - (dy / across) * (dy / across);
                            if room2 > 0.0 {
                                add_chord(values, x, along * room2.sqrt(), |dx| {
                                    weight * self.cell.value(axes, dx, dy)
                                });
                            }
                        }
                    }
                }
            }
            let at = (self.rng.bits() >> 40) as usize % GAUSSIAN_LEN;
            let Some(noise) = self.gaussian.get(at..at + row.len()) else {
                continue;
            };
            let first = y * self.width + columns.0;
            let from = self.walls.partition_point(|(number, _)| *number < first);
            for (number, wall) in self.walls.iter().skip(from) {
                match values.get_mut(number - first) {
                    Some(value) => *value -= wall,
                    None => break,
                }
            }
            if let Some(light) = self.light.get(first..first + row.len()) {
                // Objects are as bright as the light at their place.
                let share = 1.0 / self.background;
                for (value, (level, _)) in values.iter_mut().zip(light) {
                    *value = level * (1.0 + *value * share) - self.background;
                }
            }
            for ((pixel, value), noise) in row.iter_mut().zip(&*values).zip(noise) {
                let level = (self.background + value).max(0.0);
                let sd = (level * self.grey_per_electron + self.read_variance).sqrt();
                *pixel = grey(level + sd * noise);
            }
        }
    }

    /// The channel with nothing in it.
    fn draw_empty(&mut self, pixels: &mut [u8]) {
        let rows = pixels.chunks_exact_mut(self.width);
        if self.light.is_empty() {
            for row in rows {
                let from = (self.rng.bits() >> 40) as usize % STRIP_LEN;
                if let Some(piece) = self.strip.get(from..from + row.len()) {
                    row.copy_from_slice(piece);
                }
            }
            return;
        }
        for (row, light) in rows.zip(self.light.chunks_exact(self.width)) {
            let from = (self.rng.bits() >> 40) as usize % GAUSSIAN_LEN;
            let noise = self.gaussian.get(from..from + row.len()).unwrap_or(&[]);
            for ((pixel, (level, sd)), noise) in row.iter_mut().zip(light).zip(noise) {
                *pixel = grey(level + sd * noise);
            }
        }
    }

    /// Columns and rows (from, to) that hold all objects' neighbourhoods; `None` when none is in the frame.
    fn neighbourhood(&self, bodies: &[Body]) -> Option<((usize, usize), (usize, usize))> {
        let reach = |body: &Body| match body.form {
            Form::Bead(size) => (size * self.support_px, size * self.support_px),
            Form::Cell(axes) => self.cell.reach_px(axes),
        };
        let (mut low, mut high) = (
            (f32::INFINITY, f32::INFINITY),
            (f32::NEG_INFINITY, f32::NEG_INFINITY),
        );
        for body in bodies {
            let (rx, ry) = reach(body);
            for &(x, y) in body.blur.points() {
                low = (low.0.min(x - rx), low.1.min(y - ry));
                high = (high.0.max(x + rx), high.1.max(y + ry));
            }
        }
        let span = |low: f32, high: f32, length: usize| {
            // `as` takes what is below 0 to 0.
            let from = (low.floor().max(0.0) as usize).min(length);
            let to = (high.ceil() + 1.0).max(0.0) as usize;
            (from, to.min(length))
        };
        if low.0 > high.0 {
            return None;
        }
        let (columns, rows) = (
            span(low.0, high.0, self.width),
            span(low.1, high.1, self.height),
        );
        (columns.0 < columns.1 && rows.0 < rows.1).then_some((columns, rows))
    }
}

/// Adds `value`, a function of the distance from `x`, to the pixels of a row within `half` of `x`.
fn add_chord(values: &mut [f32], x: f32, half: f32, value: impl Fn(f32) -> f32) {
    // `as` takes what is below 0 to 0.
    let from = (x - half).ceil() as usize;
    let to = (((x + half).floor() + 1.0) as usize).min(values.len());
    let Some(chord) = values.get_mut(from.min(to)..to) else {
        return;
    };
    for (i, place) in chord.iter_mut().enumerate() {
        *place += value((from + i) as f32 - x);
    }
}

/// A grey value as the camera's converter makes it: rounded, clipped to 0..255.
fn grey(level: f32) -> u8 {
    (level + 0.5) as u8
}

/// The Cramer-Rao bound of x with unknown position, contrast and background, um: the smallest standard deviation that an unbiased
/// localiser can reach on rendered frames. For a bead (or a cell at rest) in mid-frame.
///
/// By symmetry x is uncorrelated with y, contrast and background, so only the information of x matters.
pub(crate) fn localisation_bound_um(config: &WorldConfig) -> Option<f64> {
    let profile = Look::new(config.bead_look, config.bead_radius_px())?;
    let picture = CellPicture::new(config.pixel_um, &config.cell.unwrap_or_default());
    let value = |dx: f64, dy: f64| match config.cell {
        None => profile.value(dx.hypot(dy)),
        Some(cell) => {
            let rest_px = cell.rest_um / config.pixel_um;
            let axes = picture.half_axes(rest_px, rest_px);
            f64::from(picture.value(axes, dx as f32, dy as f32))
        }
    };
    let slope = |dx: f64, dy: f64| match config.cell {
        None => {
            let r = dx.hypot(dy);
            if r > 0.0 && r <= profile.support_px() {
                profile.slope(r) * dx / r
            } else {
                0.0
            }
        }
        // Half a pixel on either side: wider than the steps of the edge's table.
        Some(_) => value(dx + 0.5, dy) - value(dx - 0.5, dy),
    };
    let (x0, y0) = (config.origin_x_px(), config.origin_y_px());
    let mut information = 0.0;
    for y in 0..config.height_px {
        for x in 0..config.width_px {
            let (dx, dy) = (f64::from(x) - x0, f64::from(y) - y0);
            let slope = config.contrast_grey * slope(dx, dy);
            let level = (config.background_grey + config.contrast_grey * value(dx, dy)).max(0.0);
            // Rounding to whole grey levels adds a variance of 1/12.
            let variance = level / config.electrons_per_grey
                + config.read_noise_grey * config.read_noise_grey
                + 1.0 / 12.0;
            information += slope * slope / variance;
        }
    }
    (information > 0.0).then(|| config.pixel_um / information.sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_short_path_becomes_one_point_and_a_long_one_many_with_the_same_mean() {
        let still = Blur::along(&[(5.0, 1.0); 5]);
        assert_eq!(still.points(), [(5.0, 1.0)]);
        let path = [(0.0, 0.0), (1.0, 0.0), (3.0, 0.0), (3.5, 0.0), (4.0, 0.0)];
        let blur = Blur::along(&path);
        assert_eq!(blur.points().len(), 16);
        let mean = blur.points().iter().map(|p| f64::from(p.0)).sum::<f64>() / 16.0;
        let trapezoid = (0.5 * 0.0 + 1.0 + 3.0 + 3.5 + 0.5 * 4.0) / 4.0;
        assert!((mean - trapezoid).abs() < 1e-6);
        assert!((mean_between(&path, 0.0, 4.0).0 - trapezoid).abs() < 1e-12);
    }

    #[test]
    fn the_background_has_the_level_and_the_noise_that_were_set() {
        let config = WorldConfig::ideal();
        let mut renderer = Renderer::new(&config).unwrap();
        let mut pixels = Vec::new();
        let (mut sum, mut square, mut n) = (0.0, 0.0, 0.0);
        for _ in 0..50 {
            renderer.draw(&[], 0.0, &mut pixels);
            for &pixel in &pixels {
                sum += f64::from(pixel);
                square += f64::from(pixel) * f64::from(pixel);
                n += 1.0;
            }
        }
        let mean = sum / n;
        let variance = square / n - mean * mean;
        let expected = 100.0 / 40.0 + 1.0 + 1.0 / 12.0;
        assert!((mean - 100.0).abs() < 0.03, "{mean}");
        assert!(
            (variance / expected - 1.0).abs() < 0.02,
            "{variance} against {expected}"
        );
    }

    #[test]
    fn pixels_on_the_bead_have_the_shot_noise_of_their_own_level() {
        let config = WorldConfig::ideal();
        let mut renderer = Renderer::new(&config).unwrap();
        let bead = renderer.bead(&[(128.0, 16.0)], 0.0);
        let centre = 16 * 256 + 128;
        let mut pixels = Vec::new();
        let values: Vec<f64> = (0..4000)
            .map(|_| {
                renderer.draw(&[bead], 0.0, &mut pixels);
                f64::from(pixels[centre])
            })
            .collect();
        let mean = values.iter().sum::<f64>() / 4000.0;
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / 4000.0;
        let expected = 180.0 / 40.0 + 1.0 + 1.0 / 12.0;
        assert!((mean - 180.0).abs() < 0.2, "{mean}");
        assert!(
            (variance / expected - 1.0).abs() < 0.12,
            "{variance} against {expected}"
        );
    }

    #[test]
    fn a_bead_beyond_the_border_draws_nothing_and_one_on_it_is_cut() {
        let config = WorldConfig::ideal();
        let mut renderer = Renderer::new(&config).unwrap();
        let mut pixels = Vec::new();
        for x in [-1e6, -40.0, 300.0, 1e9] {
            let bead = renderer.bead(&[(x, 16.0)], 0.0);
            renderer.draw(&[bead], 0.0, &mut pixels);
            assert!(pixels.iter().all(|&p| p < 130), "bead at {x}");
        }
        let bead = renderer.bead(&[(0.0, 16.0)], 0.0);
        renderer.draw(&[bead], 0.0, &mut pixels);
        assert!(pixels[16 * 256] > 150);
    }
}
