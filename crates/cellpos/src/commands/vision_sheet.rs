//! Contact sheet: frames of the recording with what was found drawn in.

use cellpos_vision::{Cell, Frame, Pixels};
use image::{Rgb, RgbImage};
use std::path::Path;

/// Tiles on the sheet.
const TILES: usize = 9;
/// Columns of tiles.
const COLUMNS: u32 = 3;
/// Largest side of a tile, px.
const MOST_PX: usize = 600;
const GOOD: Rgb<u8> = Rgb([40, 220, 90]);
const REFUSED: Rgb<u8> = Rgb([255, 90, 60]);
const GAP: u32 = 4;

/// Digits of 3 x 5 pixels, a row to three bits.
const DIGITS: [u16; 10] = [
    0b111_101_101_101_111,
    0b010_110_010_010_111,
    0b111_001_111_100_111,
    0b111_001_111_001_111,
    0b101_101_111_001_001,
    0b111_100_111_001_111,
    0b111_100_111_101_111,
    0b111_001_010_010_010,
    0b111_101_111_101_111,
    0b111_101_111_001_111,
];

/// A cell on the sheet.
#[derive(Debug)]
pub(super) struct CellMark<'a> {
    pub number: u32,
    pub cell: Cell,
    /// Its outline, px.
    pub outline: &'a [(f64, f64)],
    pub good: bool,
}

/// Gathers tiles.
#[derive(Debug)]
pub(super) struct Sheet {
    wanted: Vec<usize>,
    tiles: Vec<RgbImage>,
}

impl Sheet {
    /// A contact sheet for a recording of `frames` frames: nine, evenly spread.
    pub(super) fn new(frames: usize) -> Self {
        let last = frames.saturating_sub(1);
        let mut wanted: Vec<usize> = (0..TILES).map(|k| k * last / (TILES - 1)).collect();
        wanted.dedup();
        Sheet {
            wanted,
            tiles: Vec::new(),
        }
    }

    /// Takes the frame `n` if it is one of the sheet's; marks are (number, x, y, radius, good), px; a refused object without a
    /// number has none.
    pub(super) fn add(
        &mut self,
        n: usize,
        frame: &Frame,
        marks: impl Iterator<Item = (Option<u32>, f64, f64, f64, bool)>,
    ) {
        if !self.wanted.contains(&n) {
            return;
        }
        let mut tile = Tile::new(frame);
        for (number, x_px, y_px, radius_px, good) in marks {
            tile.mark(
                number,
                (x_px, y_px),
                radius_px,
                if good { GOOD } else { REFUSED },
            );
        }
        tile.number(n as u32, (3.0, 3.0), Rgb([255, 220, 60]));
        self.tiles.push(tile.picture);
    }

    /// Takes the frame `n` with its cells, if it is one of the sheet's: green or red.
    pub(super) fn add_cells(&mut self, n: usize, frame: &Frame, cells: &[CellMark<'_>]) {
        if !self.wanted.contains(&n) {
            return;
        }
        let mut tile = Tile::new(frame);
        for mark in cells {
            let colour = if mark.good { GOOD } else { REFUSED };
            tile.outline(mark.number, &mark.cell, mark.outline, colour);
        }
        tile.number(n as u32, (3.0, 3.0), Rgb([255, 220, 60]));
        self.tiles.push(tile.picture);
    }

    /// Writes the sheet as PNG.
    pub(super) fn save(&self, path: &Path) -> Result<(), image::ImageError> {
        let width = self.tiles.iter().map(RgbImage::width).max().unwrap_or(1) + GAP;
        let height = self.tiles.iter().map(RgbImage::height).max().unwrap_or(1) + GAP;
        let count = self.tiles.len().max(1) as u32;
        let columns = COLUMNS.min(count);
        let mut sheet = RgbImage::new(columns * width, count.div_ceil(columns) * height);
        for (k, tile) in (0..).zip(&self.tiles) {
            let place = (
                i64::from(k % columns * width),
                i64::from(k / columns * height),
            );
            image::imageops::replace(&mut sheet, tile, place.0, place.1);
        }
        sheet.save(path)
    }
}

struct Tile {
    picture: RgbImage,
    /// Pixels of the tile per pixel of the frame.
    scale: f64,
}

impl Tile {
    fn new(frame: &Frame) -> Self {
        let most = frame.width.max(frame.height).max(1);
        // Small frames are enlarged, large ones reduced.
        let scale = if most <= MOST_PX / 2 {
            (MOST_PX / most).min(6) as f64
        } else {
            (MOST_PX as f64 / most as f64).min(1.0)
        };
        let grey = |k: usize| match frame.pixels {
            Pixels::Mono8(p) => p.get(k).map_or(0.0, |v| f64::from(*v)),
            Pixels::Mono16(p) => p.get(k).map_or(0.0, |v| f64::from(*v)),
        };
        let pixels = frame.width * frame.height;
        let (low, high) = (0..pixels)
            .map(grey)
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| {
                (l.min(v), h.max(v))
            });
        let side = |n: usize| ((n as f64 * scale) as u32).max(1);
        let picture = RgbImage::from_fn(side(frame.width), side(frame.height), |i, j| {
            let at = |k: u32, n: usize| ((f64::from(k) / scale) as usize).min(n.saturating_sub(1));
            let v = grey(at(j, frame.height) * frame.width + at(i, frame.width));
            let level = (255.0 * (v - low) / (high - low).max(1.0)) as u8;
            Rgb([level; 3])
        });
        Tile { picture, scale }
    }

    fn dot(&mut self, x: f64, y: f64, colour: Rgb<u8>) {
        let inside = x >= 0.0
            && y >= 0.0
            && x < f64::from(self.picture.width())
            && y < f64::from(self.picture.height());
        if inside {
            self.picture.put_pixel(x as u32, y as u32, colour);
        }
    }

    /// A circle, a small cross and the number; the place is in pixels of the frame.
    fn mark(
        &mut self,
        number: Option<u32>,
        (x_px, y_px): (f64, f64),
        radius_px: f64,
        colour: Rgb<u8>,
    ) {
        // A pixel's centre lies half a pixel from its corner.
        let (x, y) = ((x_px + 0.5) * self.scale, (y_px + 0.5) * self.scale);
        let radius = (1.5 * radius_px * self.scale).clamp(3.0, 300.0);
        let steps = (8.0 * radius) as u32;
        for k in 0..steps {
            let angle = std::f64::consts::TAU * f64::from(k) / f64::from(steps);
            self.dot(x + radius * angle.cos(), y + radius * angle.sin(), colour);
        }
        for d in -3..=3 {
            self.dot(x + f64::from(d), y, colour);
            self.dot(x, y + f64::from(d), colour);
        }
        if let Some(number) = number {
            self.number(number, (x + radius + 2.0, y - 4.0), colour);
        }
    }

    /// A cell's outline and its number.
    fn outline(&mut self, number: u32, cell: &Cell, outline: &[(f64, f64)], colour: Rgb<u8>) {
        for (k, a) in outline.iter().enumerate() {
            let Some(b) = outline.get((k + 1) % outline.len()) else {
                continue;
            };
            let steps = (f64::hypot(b.0 - a.0, b.1 - a.1) * self.scale)
                .ceil()
                .max(1.0) as u32;
            for t in 0..steps {
                let t = f64::from(t) / f64::from(steps);
                let at = |a: f64, b: f64| (a + t * (b - a) + 0.5) * self.scale;
                self.dot(at(a.0, b.0), at(a.1, b.1), colour);
            }
        }
        let beside_px = 0.5 * cell.extent_px((1.0, 0.0)) + 2.0;
        let (x, y) = (cell.x_px + beside_px + 0.5, cell.y_px + 0.5);
        self.number(number, (x * self.scale, y * self.scale - 4.0), colour);
    }

    fn number(&mut self, number: u32, (x, y): (f64, f64), colour: Rgb<u8>) {
        for (place, digit) in number.to_string().bytes().enumerate() {
            let bits = DIGITS.get(usize::from(digit - b'0')).copied().unwrap_or(0);
            for row in 0..5 {
                for column in 0..3 {
                    if bits >> (14 - 3 * row - column) & 1 == 1 {
                        // Twice the size of the pattern.
                        for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                            let at_x = x + (8 * place + 2 * column + dx) as f64;
                            self.dot(at_x, y + (2 * row + dy) as f64, colour);
                        }
                    }
                }
            }
        }
    }
}
