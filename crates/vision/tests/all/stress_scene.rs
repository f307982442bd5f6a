//! Pictures of the stress table: beads, and what spoils them.

use crate::common::Random;
use cellpos_vision::{Frame, Pixels, RadialProfile};

const SIDE: usize = 200;
const BACKGROUND: f64 = 20_000.0;
const AMPLITUDE: f64 = 4000.0;
/// What spoils a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Spoil {
    Clean,
    /// Out of focus: this many times as large.
    Defocus(f64),
    /// Gaussian blur of this many radii.
    Blur(f64),
    /// So many times the noise.
    Noise(f64),
    /// One pixel in a hundred, the same in every frame.
    HotPixels,
    /// Rows with offsets of half the noise.
    RowNoise,
    /// Light that falls by half the bead's contrast across the picture, and bends.
    UnevenLight,
    /// Every second bead has another at three radii.
    Neighbours,
    /// Specks of other shapes, bright and dark, the same in every frame.
    Dust,
    /// The quantisation of blocks of 8 x 8 pixels, as JPEG of quality 85 does it.
    Jpeg,
    /// What is brighter than 0.7 of the bead is cut off.
    Saturation,
    /// Steps of 16 grey levels of 16 bits.
    TwelveBit,
}

pub(crate) const ALL: [Spoil; 12] = [
    Spoil::Clean,
    Spoil::Defocus(1.15),
    Spoil::Blur(0.5),
    Spoil::Noise(5.0),
    Spoil::HotPixels,
    Spoil::RowNoise,
    Spoil::UnevenLight,
    Spoil::Neighbours,
    Spoil::Dust,
    Spoil::Jpeg,
    Spoil::Saturation,
    Spoil::TwelveBit,
];

pub(crate) struct Scene<'a> {
    pub profile: &'a dyn RadialProfile,
    snr: f64,
    spoil: Spoil,
    /// Hot pixels, and specks of dust: place, half axes, angle, contrast.
    hot: Vec<(usize, u16)>,
    dust: Vec<[f64; 6]>,
}

pub(crate) struct Picture {
    pub places: Vec<(f64, f64)>,
    pixels: Vec<u16>,
    /// The same with 8 bits, where the picture has no more.
    eight: Vec<u8>,
    /// Beads that a speck of dust covers in part: their picture is another one, and where its middle is no picture tells.
    pub covered: Vec<bool>,
}

impl<'a> Scene<'a> {
    pub(crate) fn new(profile: &'a dyn RadialProfile, snr: f64, spoil: Spoil, seed: u64) -> Self {
        let mut random = Random(seed);
        let hot = (0..SIDE * SIDE / 100).map(|_| {
            let at = (random.uniform() * (SIDE * SIDE) as f64) as usize;
            let grey = 16_000.0 + 3.0 * AMPLITUDE * random.uniform();
            (at, grey as u16)
        });
        let hot = hot.collect();
        let r = profile.radius_px();
        let dust = (0..12).map(|_| {
            let side = SIDE as f64;
            let (x, y) = (side * random.uniform(), side * random.uniform());
            let (width, length) = (0.5 * r.min(3.0) + 0.3, (1.5 + random.uniform()) * r);
            let sign = if random.uniform() < 0.5 { 1.0 } else { -1.0 };
            let contrast = sign * (0.3 + 0.5 * random.uniform()) * AMPLITUDE;
            [x, y, width, length, 3.0 * random.uniform(), contrast]
        });
        let dust = dust.collect();
        Scene {
            profile,
            snr,
            spoil,
            hot,
            dust,
        }
    }

    fn size(&self) -> f64 {
        match self.spoil {
            Spoil::Defocus(size) => size,
            _ => 1.0,
        }
    }

    /// Adds a bead.
    fn draw(&self, grey: &mut [f64], (x, y): (f64, f64)) {
        let size = self.size();
        let reach = (size * self.profile.support_px()).ceil();
        let span = |c: f64| {
            (c - reach).max(0.0) as usize..((c + reach).max(0.0) as usize).min(SIDE - 1) + 1
        };
        for j in span(y) {
            for i in span(x) {
                let r = f64::hypot(i as f64 - x, j as f64 - y) / size;
                grey[j * SIDE + i] += AMPLITUDE * self.profile.value(r);
            }
        }
    }

    pub(crate) fn picture(&self, random: &mut Random) -> Picture {
        let mut grey = vec![BACKGROUND; SIDE * SIDE];
        let radius = self.profile.radius_px();
        let reach = self.profile.support_px().min(4.5 * radius);
        let apart = if self.spoil == Spoil::Neighbours {
            3.0 * radius
        } else {
            0.0
        };
        let pitch = (2.6 * reach + apart).max(24.0);
        let count = ((SIDE as f64 / pitch) as usize).max(1);
        let pitch = SIDE as f64 / count as f64;
        let mut places = Vec::new();
        for k in 0..count * count {
            let mut jitter = |k: usize| (k as f64 + 0.5 + 0.2 * (random.uniform() - 0.5)) * pitch;
            let at = (jitter(k % count), jitter(k / count));
            places.push(at);
            if self.spoil == Spoil::Neighbours && k % 2 == 0 {
                let angle = std::f64::consts::TAU * random.uniform();
                places.push((at.0 + apart * angle.cos(), at.1 + apart * angle.sin()));
            }
        }
        places.iter().for_each(|at| self.draw(&mut grey, *at));
        self.spoil_light(&mut grey);
        let noise = AMPLITUDE / self.snr
            * if let Spoil::Noise(n) = self.spoil {
                n
            } else {
                1.0
            };
        for row in grey.chunks_exact_mut(SIDE) {
            let offset = if self.spoil == Spoil::RowNoise {
                0.5 * noise * random.normal()
            } else {
                0.0
            };
            row.iter_mut()
                .for_each(|v| *v += offset + noise * random.normal());
        }
        self.spoil_reading(&mut grey);
        let mut pixels: Vec<u16> = grey
            .iter()
            .map(|v| v.round().clamp(0.0, 65_535.0) as u16)
            .collect();
        match self.spoil {
            Spoil::HotPixels => self.hot.iter().for_each(|(at, v)| pixels[*at] = *v),
            Spoil::TwelveBit => pixels.iter_mut().for_each(|v| *v = (*v + 8) / 16),
            _ => {}
        }
        let eight = if self.spoil == Spoil::Jpeg {
            grey.iter()
                .map(|v| to_eight(*v).round().clamp(0.0, 255.0) as u8)
                .collect()
        } else {
            Vec::new()
        };
        let covered = places.iter().map(|at| self.is_covered(*at)).collect();
        Picture {
            places,
            pixels,
            eight,
            covered,
        }
    }

    fn is_covered(&self, (x, y): (f64, f64)) -> bool {
        // Two of its standard deviations, and the bead with its ring.
        let reach = 1.9 * self.profile.radius_px();
        let near = |[cx, cy, width, length, angle, _]: &[f64; 6]| {
            let (s, c) = angle.sin_cos();
            let (dx, dy) = (x - cx, y - cy);
            let (a, b) = (c * dx + s * dy, c * dy - s * dx);
            let (a, b) = (a / (2.0 * length + reach), b / (2.0 * width + reach));
            a * a + b * b < 1.0
        };
        self.spoil == Spoil::Dust && self.dust.iter().any(near)
    }

    fn spoil_light(&self, grey: &mut [f64]) {
        let at = |k: usize| ((k % SIDE) as f64, (k / SIDE) as f64);
        match self.spoil {
            Spoil::Blur(radii) => blur(grey, radii * self.profile.radius_px()),
            Spoil::UnevenLight => grey.iter_mut().enumerate().for_each(|(k, v)| {
                let ((x, y), side) = (at(k), SIDE as f64);
                let (u, w) = (x / side - 0.5, y / side - 0.5);
                *v *= 1.0 - 0.1 * u - 0.05 * w - 0.15 * (u * u + w * w);
            }),
            Spoil::Dust => {
                for [cx, cy, width, length, angle, contrast] in &self.dust {
                    for (k, v) in grey.iter_mut().enumerate() {
                        let (x, y) = (at(k).0 - cx, at(k).1 - cy);
                        let (s, c) = angle.sin_cos();
                        let (a, b) = ((c * x + s * y) / length, (c * y - s * x) / width);
                        *v += contrast * (-0.5 * (a * a + b * b)).exp();
                    }
                }
            }
            _ => {}
        }
    }

    fn spoil_reading(&self, grey: &mut [f64]) {
        match self.spoil {
            Spoil::Jpeg => jpeg(grey),
            Spoil::Saturation => {
                let most = BACKGROUND + 0.7 * AMPLITUDE;
                grey.iter_mut().for_each(|v| *v = v.min(most));
            }
            _ => {}
        }
    }
}

impl Picture {
    pub(crate) fn frame(&self) -> Frame<'_> {
        Frame {
            width: SIDE,
            height: SIDE,
            pixels: if self.eight.is_empty() {
                Pixels::Mono16(&self.pixels)
            } else {
                Pixels::Mono8(&self.eight)
            },
        }
    }
}

/// Blurs a square picture by a Gaussian.
pub(crate) fn blur(grey: &mut [f64], sd: f64) {
    let side = grey.len().isqrt();
    let reach = (3.5 * sd).ceil() as isize;
    let kernel: Vec<f64> = (-reach..=reach)
        .map(|k| (-0.5 * (k as f64 / sd).powi(2)).exp())
        .collect();
    let sum: f64 = kernel.iter().sum();
    for (along, across) in [(1, side), (side, 1)] {
        for line in 0..side {
            let values: Vec<f64> = (0..side).map(|k| grey[line * across + k * along]).collect();
            for k in 0..side as isize {
                let near = kernel
                    .iter()
                    .zip(-reach..)
                    .map(|(w, d)| w * values[(k + d).clamp(0, side as isize - 1) as usize]);
                grey[line * across + k as usize * along] = near.sum::<f64>() / sum;
            }
        }
    }
}

/// Grey levels of 8 bits: the bead has 62 of them over 110.
fn to_eight(grey: f64) -> f64 {
    110.0 + (grey - BACKGROUND) / 64.0
}

/// Blocks of 8 x 8 pixels through a cosine transform whose coefficients are rounded to the steps of quality 85 (the luminance
/// table of the standard, times 0.3), for grey levels of 8 bits.
fn jpeg(grey: &mut [f64]) {
    let base = |u: usize, v: usize| {
        if u + v == 0 {
            16.0
        } else {
            10.0 + 5.5 * (u + v) as f64
        }
    };
    let cosine = |x: usize, u: usize| {
        let norm = if u == 0 { (0.125_f64).sqrt() } else { 0.5 };
        norm * ((2 * x + 1) as f64 * u as f64 * std::f64::consts::PI / 16.0).cos()
    };
    for block in 0..(SIDE / 8) * (SIDE / 8) {
        let (bx, by) = (block % (SIDE / 8) * 8, block / (SIDE / 8) * 8);
        let at = |x: usize, y: usize| (by + y) * SIDE + bx + x;
        let mut half = [[0.0; 8]; 8];
        for (y, row) in half.iter_mut().enumerate() {
            for (u, v) in row.iter_mut().enumerate() {
                *v = (0..8)
                    .map(|x| to_eight(grey[at(x, y)]) * cosine(x, u))
                    .sum();
            }
        }
        let mut whole = [[0.0; 8]; 8];
        for (v, row) in whole.iter_mut().enumerate() {
            for (u, c) in row.iter_mut().enumerate() {
                let sum: f64 = (0..8).map(|y| half[y][u] * cosine(y, v)).sum();
                let step = 0.3 * base(u, v);
                *c = (sum / step).round() * step;
            }
        }
        for y in 0..8 {
            for x in 0..8 {
                let sum: f64 = (0..64)
                    .map(|k| whole[k / 8][k % 8] * cosine(x, k % 8) * cosine(y, k / 8))
                    .sum();
                grey[at(x, y)] = BACKGROUND + 64.0 * (sum.round() - 110.0);
            }
        }
    }
}

/// Light as a lens gives it: a core, a dark ring and a bright one. Neither a Gaussian nor the measured ring nor a disc.
struct Halo(f64);

impl RadialProfile for Halo {
    fn value(&self, r_px: f64) -> f64 {
        let u = r_px / self.0;
        (2.2 * u).cos() * (-0.45 * u * u).exp()
    }
    fn slope(&self, r_px: f64) -> f64 {
        let u = r_px / self.0;
        (-2.2 * (2.2 * u).sin() - 0.9 * u * (2.2 * u).cos()) * (-0.45 * u * u).exp() / self.0
    }
    fn radius_px(&self) -> f64 {
        0.7 * self.0
    }
    fn support_px(&self) -> f64 {
        4.5 * self.0
    }
}

pub(crate) fn halo(size_px: f64) -> (String, Box<dyn RadialProfile>) {
    (format!("table {size_px} px"), Box::new(Halo(size_px)))
}
