//! Recorded pictures as another microscope, camera or focus would have given them.

use super::Random;

/// A picture of real grey levels.
#[derive(Debug, Clone)]
pub(crate) struct Picture {
    pub width: usize,
    pub height: usize,
    pub grey: Vec<f64>,
}

/// What is done to the pictures before they are looked at, the background's and the cells' alike.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Change {
    None,
    /// Bright and dark exchanged.
    Inverted,
    /// Grey levels times a factor, plus an offset.
    Scaled(f64, f64),
    /// Grey levels over the middle of the range, to a power.
    Gamma(f64),
    /// Normal noise of this standard deviation on top.
    Noise(f64),
    /// Gaussian of this standard deviation, px.
    Blurred(f64),
    /// Another focus: so many times the Laplacian of the slightly blurred picture on top (transport of intensity).
    Defocused(f64),
    /// Upside down.
    Flipped,
    /// Other pixels: this many times as large a picture.
    Resized(f64),
    /// The frames, not the background, moved by so many px to the right and half as many down.
    Drifted(f64),
    /// The frames, not the background, brighter by this factor.
    Lamp(f64),
    /// So many rows of text on top, another one in each frame.
    Header(usize),
}

impl Change {
    /// Factor of lengths.
    pub(crate) fn size(self) -> f64 {
        match self {
            Change::Resized(factor) => factor,
            _ => 1.0,
        }
    }

    /// The changed picture; `empty` for one of the background.
    pub(crate) fn apply(self, picture: &Picture, empty: bool, random: &mut Random) -> Picture {
        let p = picture;
        let each = |f: &mut dyn FnMut(f64) -> f64| Picture {
            grey: p.grey.iter().map(|v| f(*v)).collect(),
            ..p.clone()
        };
        match self {
            Change::None => p.clone(),
            Change::Inverted => each(&mut |v| 255.0 - v),
            Change::Scaled(factor, offset) => each(&mut |v| factor * v + offset),
            Change::Gamma(power) => each(&mut |v| 128.0 * (v.max(0.0) / 128.0).powf(power)),
            Change::Noise(sd) => each(&mut |v| v + sd * random.normal()),
            Change::Blurred(sd) => p.blurred(sd),
            Change::Defocused(factor) => {
                let soft = p.blurred(0.7);
                let at = |x: usize, y: usize| soft.at(x as f64, y as f64);
                let laplacian = |k: usize| {
                    let (x, y) = (k % p.width, k / p.width);
                    let (r, d) = ((x + 1).min(p.width - 1), (y + 1).min(p.height - 1));
                    at(x.saturating_sub(1), y) + at(r, y) + at(x, y.saturating_sub(1)) + at(x, d)
                        - 4.0 * at(x, y)
                };
                let grey = (0..p.grey.len()).map(|k| p.grey[k] + factor * laplacian(k));
                Picture {
                    grey: grey.collect(),
                    ..p.clone()
                }
            }
            Change::Flipped => p.sampled(p.width, p.height, |x, y| (x, p.height as f64 - 1.0 - y)),
            Change::Resized(factor) => {
                // What is made smaller is blurred by its larger pixels first.
                let soft = if factor < 1.0 {
                    p.blurred(0.3 / factor)
                } else {
                    p.clone()
                };
                let side = |n: usize| (n as f64 * factor) as usize;
                soft.sampled(side(p.width), side(p.height), |x, y| {
                    ((x + 0.5) / factor - 0.5, (y + 0.5) / factor - 0.5)
                })
            }
            Change::Drifted(_) if empty => p.clone(),
            Change::Drifted(px) => p.sampled(p.width, p.height, |x, y| (x - px, y - 0.5 * px)),
            Change::Lamp(_) if empty => p.clone(),
            Change::Lamp(factor) => each(&mut |v| factor * v),
            Change::Header(rows) => {
                // Letters of 6 x 8 px in white on black, a third of their strokes set.
                let mut grey = vec![0.0; rows * p.width];
                for letter in 0..p.width / 6 * (rows / 8) {
                    let (column, line) = (letter % (p.width / 6), letter / (p.width / 6));
                    for stroke in 0..24 {
                        if random.uniform() < 0.35 {
                            let (x, y) = (6 * column + stroke % 4, 8 * line + stroke / 4);
                            grey[y * p.width + x] = 255.0;
                        }
                    }
                }
                grey.extend(&p.grey);
                Picture {
                    width: p.width,
                    height: p.height + rows,
                    grey,
                }
            }
        }
    }

    /// Where a place of the picture comes to lie.
    pub(crate) fn place(self, (x, y): (f64, f64), height: usize) -> (f64, f64) {
        match self {
            Change::Flipped => (x, height as f64 - 1.0 - y),
            Change::Resized(f) => ((x + 0.5) * f - 0.5, (y + 0.5) * f - 0.5),
            Change::Drifted(px) => (x + px, y + 0.5 * px),
            Change::Header(rows) => (x, y + rows as f64),
            _ => (x, y),
        }
    }
}

impl Picture {
    pub(crate) fn of(pixels: &[u8], width: usize) -> Self {
        Picture {
            width,
            height: pixels.len() / width,
            grey: pixels.iter().map(|v| f64::from(*v)).collect(),
        }
    }

    /// As a camera of 8 bits gives it.
    pub(crate) fn pixels(&self) -> Vec<u8> {
        let grey = self.grey.iter();
        grey.map(|v| v.round().clamp(0.0, 255.0) as u8).collect()
    }

    /// Between the pixels, linearly; the border goes on beyond it.
    fn at(&self, x: f64, y: f64) -> f64 {
        let (x, y) = (
            x.clamp(0.0, self.width as f64 - 1.0),
            y.clamp(0.0, self.height as f64 - 1.0),
        );
        let (i, j) = (x as usize, y as usize);
        let (r, d) = ((i + 1).min(self.width - 1), (j + 1).min(self.height - 1));
        let (u, v) = (x.fract(), y.fract());
        let get = |i: usize, j: usize| self.grey[j * self.width + i];
        let (upper, lower) = (
            get(i, j) + u * (get(r, j) - get(i, j)),
            get(i, d) + u * (get(r, d) - get(i, d)),
        );
        upper + v * (lower - upper)
    }

    /// The same, and nothing beyond the border.
    pub(crate) fn inside(&self, x: f64, y: f64) -> f64 {
        let (w, h) = (self.width as f64 - 1.0, self.height as f64 - 1.0);
        if (0.0..=w).contains(&x) && (0.0..=h).contains(&y) {
            self.at(x, y)
        } else {
            0.0
        }
    }

    /// Moved to the right and down, px.
    pub(crate) fn moved(&self, dx: f64, dy: f64) -> Picture {
        if (dx, dy) == (0.0, 0.0) {
            return self.clone();
        }
        self.sampled(self.width, self.height, |x, y| (x - dx, y - dy))
    }

    /// The mean over a way of so many px along the rows, as an exposure smears what moves.
    pub(crate) fn smeared(&self, px: f64) -> Picture {
        let steps = 4 * px.ceil() as usize;
        let mut mean = self.clone();
        mean.grey.fill(0.0);
        for k in 0..steps {
            let part = self.moved(px * ((k as f64 + 0.5) / steps as f64 - 0.5), 0.0);
            let sum = mean.grey.iter_mut().zip(&part.grey);
            sum.for_each(|(m, v)| *m += v / steps as f64);
        }
        mean
    }

    pub(crate) fn sampled(
        &self,
        width: usize,
        height: usize,
        from: impl Fn(f64, f64) -> (f64, f64),
    ) -> Picture {
        let value = |k: usize| {
            let (x, y) = from((k % width) as f64, (k / width) as f64);
            self.at(x, y)
        };
        Picture {
            width,
            height,
            grey: (0..width * height).map(value).collect(),
        }
    }

    fn blurred(&self, sd: f64) -> Picture {
        let reach = (4.0 * sd).ceil() as i32;
        let kernel: Vec<f64> = (-reach..=reach)
            .map(|k| (-0.5 * (f64::from(k) / sd).powi(2)).exp())
            .collect();
        let sum: f64 = kernel.iter().sum();
        let along = |p: &Picture, (dx, dy): (i32, i32)| {
            let last = (p.width as i32 - 1, p.height as i32 - 1);
            let value = |k: usize| {
                let (x, y) = ((k % p.width) as i32, (k / p.width) as i32);
                let near = kernel.iter().zip(-reach..).map(|(w, j)| {
                    let (i, j) = ((x + j * dx).clamp(0, last.0), (y + j * dy).clamp(0, last.1));
                    w * p.grey[j as usize * p.width + i as usize]
                });
                near.sum::<f64>() / sum
            };
            Picture {
                grey: (0..p.grey.len()).map(value).collect(),
                ..p.clone()
            }
        };
        along(&along(self, (1, 0)), (0, 1))
    }
}
