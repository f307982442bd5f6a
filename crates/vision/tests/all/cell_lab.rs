//! Recorded cells composed into recorded channels. A region called good (neither cut nor in contact) that is no single cell is a lie.

use crate::common::Random;
use crate::common::change::{Change, Picture};
use crate::common::stack::{Stack, masks};
use cellpos_vision::{Cell, CellConfig, CellFinder, Frame, Pixels};

pub(crate) const SETS: [&str; 3] = [
    "calibration-beads",
    "cells-wide-channel",
    "cells-low-contrast",
];
/// Contrast this far from a mask belongs to its cell, px; the outer half of it fades out.
const HALO_PX: f64 = 12.0;

/// A recorded cell without its channel.
pub(crate) struct Cut {
    pub(crate) contrast: Picture,
    x: f64,
    y: f64,
    /// Half lengths of the mask's box, px.
    pub(crate) half: (f64, f64),
}

/// An empty channel, and cells that were seen in it.
pub(crate) struct Set {
    pub(crate) empty: Picture,
    noise: f64,
    cells: Vec<Cut>,
}

impl Set {
    fn open(name: &str) -> Self {
        let stack = Stack::open(name, "frames.tif");
        let backgrounds = Stack::open(name, "background.tif");
        let header = if name == "cells-low-contrast" { 6 } else { 0 };
        let size = stack.width * (stack.height - header);
        let mut empty = Picture::of(&backgrounds.pages[0][..size], stack.width);
        let n = backgrounds.pages.len() as f64;
        let mut noise = 0.0;
        for (k, v) in empty.grey.iter_mut().enumerate() {
            let values = backgrounds.pages.iter().map(|p| f64::from(p[k]));
            let (s, ss) = values.fold((0.0, 0.0), |(s, ss), v| (s + v, ss + v * v));
            *v = s / n;
            noise += (ss / n - s / n * s / n) / size as f64;
        }
        let mut cells = Vec::new();
        for (page, mask) in stack.pages.iter().zip(&masks(name)) {
            let cut = Cut::of(&empty, &page[..size], &mask[..size]);
            // Wholly in the picture, with its halo.
            let inside = |c: &Cut| {
                let (w, h) = (empty.width as f64, empty.height as f64);
                let reach = |half: f64| half + 4.0;
                c.half.0 > 5.0
                    && c.x > reach(c.half.0)
                    && c.x < w - reach(c.half.0)
                    && c.y > reach(c.half.1)
                    && c.y < h - reach(c.half.1)
            };
            cells.extend(cut.filter(inside));
        }
        Set {
            empty,
            noise: noise.sqrt(),
            cells,
        }
    }

    fn finder(&self, random: &mut Random) -> CellFinder {
        let config = CellConfig::default();
        let mut finder = CellFinder::new(self.empty.width, self.empty.height, config).unwrap();
        for _ in 0..40 {
            let pixels = self.noisy(&self.empty, random);
            finder.take_background(&self.frame(&pixels)).unwrap();
        }
        finder
    }

    fn noisy(&self, picture: &Picture, random: &mut Random) -> Vec<u8> {
        Change::Noise(self.noise)
            .apply(picture, false, random)
            .pixels()
    }

    fn frame<'p>(&self, pixels: &'p [u8]) -> Frame<'p> {
        Frame {
            width: self.empty.width,
            height: self.empty.height,
            pixels: Pixels::Mono8(pixels),
        }
    }

    /// The channel with cells, each with its middle at a place.
    pub(crate) fn composed(&self, cells: &[(&Picture, &Cut, (f64, f64))]) -> Picture {
        let mut picture = self.empty.clone();
        for (contrast, cut, (x, y)) in cells {
            let reach = (cut.half.0 + HALO_PX + 12.0, cut.half.1 + HALO_PX + 12.0);
            for (k, v) in picture.grey.iter_mut().enumerate() {
                let (i, j) = ((k % picture.width) as f64, (k / picture.width) as f64);
                if (i - x).abs() > reach.0 || (j - y).abs() > reach.1 {
                    continue;
                }
                *v += contrast.inside(i - x + cut.x, j - y + cut.y);
            }
        }
        picture
    }

    fn find(&self, finder: &mut CellFinder, picture: &Picture, random: &mut Random) -> Vec<Cell> {
        let pixels = self.noisy(picture, random);
        finder.find(&self.frame(&pixels)).unwrap().to_vec()
    }

    /// What is found of a cell alone in the channel, if that is one good cell.
    fn alone(&self, finder: &mut CellFinder, cut: &Cut, random: &mut Random) -> Option<Cell> {
        let place = self.middle(cut);
        let picture = self.composed(&[(&cut.contrast, cut, place)]);
        let found = self.find(finder, &picture, random);
        at(&found, cut, place).copied().filter(good)
    }

    pub(crate) fn middle(&self, cut: &Cut) -> (f64, f64) {
        (0.5 * self.empty.width as f64 - 0.5, cut.y)
    }
}

impl Cut {
    /// The cell stretched by factors, a negative one mirrored, about its middle.
    fn varied(&self, (across, down): (f64, f64)) -> Self {
        let from = |x: f64, y: f64| ((x - self.x) / across + self.x, (y - self.y) / down + self.y);
        let (width, height) = (self.contrast.width, self.contrast.height);
        Cut {
            contrast: self.contrast.sampled(width, height, from),
            half: (self.half.0 * across.abs(), self.half.1 * down.abs()),
            ..*self
        }
    }

    fn of(empty: &Picture, page: &[u8], mask: &[u8]) -> Option<Self> {
        let width = empty.width;
        let inside: Vec<(f64, f64)> = (0..mask.len())
            .filter(|k| mask[*k] > 0)
            .map(|k| ((k % width) as f64, (k / width) as f64))
            .collect();
        if inside.len() < 100 {
            return None;
        }
        let range = |of: &dyn Fn(&(f64, f64)) -> f64| {
            let values = inside.iter().map(of);
            values.fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(v), h.max(v)))
        };
        let ((left, right), (top, bottom)) = (range(&|p| p.0), range(&|p| p.1));
        let light = {
            let mut ratios: Vec<f64> = page
                .iter()
                .zip(&empty.grey)
                .map(|(p, e)| f64::from(*p) / e.max(1.0))
                .collect();
            ratios.sort_by(f64::total_cmp);
            ratios[ratios.len() / 2]
        };
        let mut contrast = empty.clone();
        for (k, v) in contrast.grey.iter_mut().enumerate() {
            let (x, y) = ((k % width) as f64, (k / width) as f64);
            let (dx, dy) = (
                (left - x).max(x - right).max(0.0),
                (top - y).max(y - bottom).max(0.0),
            );
            let away = if f64::hypot(dx, dy) > HALO_PX {
                HALO_PX
            } else {
                inside
                    .iter()
                    .map(|p| (p.0 - x).powi(2) + (p.1 - y).powi(2))
                    .fold(f64::MAX, f64::min)
                    .sqrt()
            };
            let share = (2.0 - 2.0 * away / HALO_PX).clamp(0.0, 1.0);
            *v = share * (f64::from(page[k]) / light - *v);
        }
        Some(Cut {
            // The noise of the recording is not drawn twice.
            contrast: Change::Blurred(0.5).apply(&contrast, false, &mut Random(1)),
            x: 0.5 * (left + right),
            y: 0.5 * (top + bottom),
            half: (0.5 * (right - left + 1.0), 0.5 * (bottom - top + 1.0)),
        })
    }
}

pub(crate) fn good(cell: &Cell) -> bool {
    !cell.at_border && !cell.in_contact
}

/// The cell nearest to a place, within half of the cell's size.
fn at<'c>(found: &'c [Cell], cut: &Cut, (x, y): (f64, f64)) -> Option<&'c Cell> {
    let away = |c: &&Cell| f64::hypot(c.x_px - x, c.y_px - y);
    found
        .iter()
        .filter(|c| away(c) < 0.5 * cut.half.0.min(cut.half.1).max(4.0))
        .min_by(|a, b| away(a).total_cmp(&away(b)))
}

/// A row of the table: share of the cells found good, median and extremes of the area over that of the same cell alone, and lies.
#[derive(Debug, Default)]
pub(crate) struct Row {
    pub(crate) drawn: usize,
    pub(crate) areas: Vec<f64>,
    pub(crate) lies: usize,
    pub(crate) said: usize,
    pub(crate) sigmas: Vec<f64>,
    /// Time of the finder in a frame after another one and in one more that is alike, s.
    times: Vec<[f64; 2]>,
}

impl Row {
    pub(crate) fn print(&mut self, set: &str, name: &str) {
        self.areas.sort_by(f64::total_cmp);
        let of = |k: usize| self.areas.get(k).copied().unwrap_or(f64::NAN);
        let last = self.areas.len().saturating_sub(1);
        let longest = |k: usize| self.times.iter().map(|t| 1e3 * t[k]).fold(0.0, f64::max);
        let worst = [longest(0), longest(1)];
        self.sigmas.sort_by(f64::total_cmp);
        println!(
            "{set:19} {name:28} good {:3} of {:3}, said {:3}, lies {:3}, area {:.3} ({:.3} .. {:.3}), error/sigma median {:.1}, most {:.1}, longest {:.2} ms, then {:.2} ms",
            self.areas.len(),
            self.drawn,
            self.said,
            self.lies,
            of(last / 2),
            of(0),
            of(last),
            self.sigmas
                .get(self.sigmas.len() / 2)
                .copied()
                .unwrap_or(f64::NAN),
            self.sigmas.last().copied().unwrap_or(f64::NAN),
            worst[0],
            worst[1],
        );
    }

    /// A cell that is to be found whole.
    fn single(&mut self, found: &[Cell], known: &Known, place: (f64, f64)) {
        let (cut, alone) = (&known.cut, &known.alone);
        self.drawn += 1;
        let own = at(found, cut, place);
        if let Some(c) = own.filter(|c| good(c)) {
            let ratio = c.area_px / alone.area_px;
            self.areas.push(ratio);
            self.sigmas
                .push((c.area_px - alone.area_px).abs() / c.var_area_px2.sqrt());
        }
        self.said += usize::from(own.is_some_and(|c| !good(c)));
        self.wrong(found, &[(known, place)]);
    }

    /// What is called good and is no cell: not at the place of one of those drawn, or of another area, by a fifth and by five
    /// stated standard deviations.
    pub(crate) fn wrong(&mut self, found: &[Cell], drawn: &[(&Known, (f64, f64))]) {
        for c in found.iter().filter(|c| good(c)) {
            let is = |(known, place): &(&Known, (f64, f64))| {
                let off = f64::hypot(c.x_px - place.0, c.y_px - place.1);
                let other_area_px = c.area_px - known.alone.area_px;
                (other_area_px.abs() < 0.2 * known.alone.area_px
                    || other_area_px.abs() < 5.0 * c.var_area_px2.sqrt())
                    && off < 0.3 * known.cut.half.0
            };
            self.lies += usize::from(!drawn.iter().any(is));
        }
    }
}

/// A cell, and what is found of it alone in the channel.
pub(crate) struct Known {
    pub(crate) cut: Cut,
    pub(crate) alone: Cell,
}

/// A set with its finder.
pub(crate) struct Lab {
    pub(crate) name: &'static str,
    pub(crate) set: Set,
    pub(crate) finder: CellFinder,
    pub(crate) random: Random,
    pub(crate) cells: Vec<Known>,
}

impl Lab {
    pub(crate) fn open(name: &'static str) -> Self {
        let mut set = Set::open(name);
        let mut random = Random(5);
        let mut finder = set.finder(&mut random);
        let mut cells = Vec::new();
        for cut in std::mem::take(&mut set.cells) {
            let alone = set.alone(&mut finder, &cut, &mut random);
            // The seventh of the wide channel is two cells that touch.
            let Some(alone) = alone else {
                println!("{name}: at {:.0} {:.0} not one good cell", cut.x, cut.y);
                continue;
            };
            cells.push(Known { cut, alone });
        }
        Lab {
            name,
            set,
            finder,
            random,
            cells,
        }
    }

    /// Cells that nobody has recorded: each as often as said, mirrored, up to a fifth larger or smaller, with other noise; and how
    /// many of them were drawn.
    pub(crate) fn varied(&mut self, times: usize) -> (Vec<Known>, usize) {
        let (mut cells, mut drawn) = (Vec::new(), 0);
        for known in &self.cells {
            for _ in 0..times {
                let random = &mut self.random;
                let zoom = 0.83 * (1.2_f64 / 0.83).powf(random.uniform());
                let mut sign = || if random.uniform() < 0.5 { -1.0 } else { 1.0 };
                let cut = known.cut.varied((sign() * zoom, sign() * zoom));
                let height = self.set.empty.height as f64;
                if cut.y - cut.half.1 < 4.0 || cut.y + cut.half.1 > height - 5.0 {
                    continue;
                }
                drawn += 1;
                let alone = self.set.alone(&mut self.finder, &cut, &mut self.random);
                cells.extend(alone.map(|alone| Known { cut, alone }));
            }
        }
        (cells, drawn)
    }

    pub(crate) fn find(&mut self, picture: &Picture) -> Vec<Cell> {
        self.set.find(&mut self.finder, picture, &mut self.random)
    }

    /// Draws two cells at their places into a frame, unless the second is cut by it, and counts what the finder makes of them.
    pub(crate) fn pair(
        &mut self,
        row: &mut Row,
        first: (&Known, (f64, f64)),
        second: (&Known, (f64, f64)),
    ) {
        let ((known, place), (other, there)) = (first, second);
        let (top, bottom) = (there.1 - other.cut.half.1, there.1 + other.cut.half.1);
        if top < 4.0 || bottom > self.set.empty.height as f64 - 5.0 {
            return;
        }
        let picture = self.set.composed(&[
            (&known.cut.contrast, &known.cut, place),
            (&other.cut.contrast, &other.cut, there),
        ]);
        let found = self.find(&picture);
        row.drawn += 1;
        row.said += usize::from(found.iter().any(|c| c.in_contact));
        let ratio = |c: &Cell| c.area_px / known.alone.area_px;
        row.areas
            .extend(found.iter().filter(|c| good(c)).map(ratio));
        row.wrong(&found, &[first, second]);
    }

    /// A row of single cells, each with its contrast changed first and the whole frame then; the place is moved by so much.
    pub(crate) fn row(
        &mut self,
        what: &str,
        contrast: impl Fn(&Picture) -> Picture,
        frame: impl Fn(Picture) -> Picture,
        moved: impl Fn(&Cut, (f64, f64)) -> [(f64, f64); 2],
    ) -> Row {
        let mut row = Row::default();
        let cells = std::mem::take(&mut self.cells);
        for known in &cells {
            let cut = &known.cut;
            let [drawn, seen] = moved(cut, self.set.middle(cut));
            let changed = contrast(&cut.contrast);
            let picture = frame(self.set.composed(&[(&changed, cut, drawn)]));
            let pixels = self.set.noisy(&picture, &mut self.random);
            let frame = self.set.frame(&pixels);
            // The least of a few, as a frame after another and as the next one alike.
            let mut least = [f64::INFINITY; 2];
            let mut found = Vec::new();
            for _ in 0..4 {
                let mut finder = self.finder.clone();
                for least in &mut least {
                    let begun = std::time::Instant::now();
                    found = finder.find(&frame).unwrap().to_vec();
                    *least = least.min(begun.elapsed().as_secs_f64());
                }
            }
            self.finder.find(&frame).unwrap();
            row.times.push(least);
            row.single(&found, known, seen);
        }
        self.cells = cells;
        row.print(self.name, what);
        row
    }
}

pub(crate) fn blurred(picture: &Picture, px: f64) -> Picture {
    if px > 0.0 {
        Change::Blurred(px).apply(picture, false, &mut Random(1))
    } else {
        picture.clone()
    }
}
