//! What stands still in the picture: dust, dirt and beads on the glass. It is learnt while the bead is elsewhere, and taken out of the
//! picture that the bead is looked for in.

use crate::frame::{Frame, Pixels};
use crate::level::Level;
use crate::seed::{LEAST_NOISE, background};

/// Most pixels of a picture whose scenery is learnt: 512 x 512.
const MOST_PIXELS: usize = 1 << 18;
/// Looks at a pixel from which on its mean counts: the scenery then adds 3 % to the noise of a frame. And looks that the mean remembers: it
/// adds 0.4 %, and follows light and glass that drift within a second or two.
const LOOKS: u8 = 16;
const MEMORY: u8 = 64;
/// Standard deviations of a frame's noise beyond which a pixel shows something else than before. That passes, like a bead; what stays for half of
/// [`LOOKS`] is the new scenery.
const FAR: f32 = 4.0;

/// A disc of the picture in which something may move: place and radius, px.
pub(super) type Disc = ((f64, f64), f64);

/// The scenery of a picture. Allocates only when made.
#[derive(Debug, Clone, Default)]
pub(super) struct Scenery {
    size: (usize, usize),
    mean: Vec<f32>,
    /// Looks that the mean is from, and looks in a row that were far from it.
    looks: Vec<u8>,
    far: Vec<u8>,
    /// What is taken from each pixel, grey levels, and whether that is anything.
    taken: Vec<i16>,
    any: bool,
    cells: Cells,
    clean8: Vec<u8>,
    clean16: Vec<u16>,
    /// There is always one, except in the empty scenery that replaces this one while it is used.
    level: Option<Level>,
}

impl Scenery {
    pub(super) fn new() -> Self {
        Scenery {
            mean: vec![0.0; MOST_PIXELS],
            looks: vec![0; MOST_PIXELS],
            far: vec![0; MOST_PIXELS],
            taken: vec![0; MOST_PIXELS],
            cells: Cells::new(),
            clean8: vec![0; MOST_PIXELS],
            clean16: vec![0; MOST_PIXELS],
            level: Some(Level::new()),
            ..Scenery::default()
        }
    }

    /// Nothing known.
    pub(super) fn forget(&mut self) {
        self.size = (0, 0);
        self.any = false;
    }

    /// The frame without the scenery.
    pub(super) fn without<'a>(&'a mut self, frame: Frame<'a>) -> Frame<'a> {
        if !self.any || self.size != (frame.width, frame.height) {
            return frame;
        }
        let pixels = match frame.pixels {
            Pixels::Mono8(from) => {
                for ((to, v), taken) in self.clean8.iter_mut().zip(from).zip(&self.taken) {
                    *to = (i16::from(*v) - taken).clamp(0, i16::from(u8::MAX)) as u8;
                }
                Pixels::Mono8(self.clean8.get(..from.len()).unwrap_or(from))
            }
            Pixels::Mono16(from) => {
                for ((to, v), taken) in self.clean16.iter_mut().zip(from).zip(&self.taken) {
                    *to = (i32::from(*v) - i32::from(*taken)).clamp(0, i32::from(u16::MAX)) as u16;
                }
                Pixels::Mono16(self.clean16.get(..from.len()).unwrap_or(from))
            }
        };
        Frame { pixels, ..frame }
    }

    /// Takes in a frame outside of `moving`, for beads of a radius, px.
    pub(super) fn learn(&mut self, frame: &Frame, radius_px: f64, moving: &[Disc]) {
        match frame.pixels {
            Pixels::Mono8(p) => self.learn_from(p, frame, radius_px, moving),
            Pixels::Mono16(p) => self.learn_from(p, frame, radius_px, moving),
        }
    }

    fn learn_from<T: Copy>(&mut self, pixels: &[T], frame: &Frame, radius_px: f64, moving: &[Disc])
    where
        f32: From<T>,
    {
        let (width, height) = (frame.width, frame.height);
        let count = width.saturating_mul(height);
        if count == 0 || count > self.mean.len() || pixels.len() < count {
            return;
        }
        if self.size != (width, height) {
            self.size = (width, height);
            self.looks[..count].fill(0);
            self.far[..count].fill(0);
            for (mean, v) in self.mean.iter_mut().zip(pixels) {
                *mean = f32::from(*v);
            }
        }
        let (_, noise) = background(pixels);
        let noise = noise.max(LEAST_NOISE) as f32;
        for y in 0..height {
            let mut from = 0;
            // The parts of the row between the discs.
            while from < width {
                let hidden = next_hidden(moving, y, from, width);
                let part = y * width + from..y * width + hidden.start;
                self.learn_row(pixels, part, FAR * noise);
                from = hidden.end.max(from + 1);
            }
        }
        self.judge((width, height), radius_px, noise);
    }

    fn learn_row<T: Copy>(&mut self, pixels: &[T], part: std::ops::Range<usize>, far: f32)
    where
        f32: From<T>,
    {
        let known = self.mean[part.clone()]
            .iter_mut()
            .zip(&mut self.looks[part.clone()])
            .zip(&mut self.far[part.clone()]);
        for (((mean, looks), odd), v) in known.zip(&pixels[part]) {
            let off = f32::from(*v) - *mean;
            let is_far = *looks >= LOOKS && off.abs() > far;
            *odd = if is_far { *odd + 1 } else { 0 };
            if *odd > LOOKS / 2 {
                (*looks, *odd) = (0, 0);
            } else if is_far {
                continue;
            }
            *looks = (*looks + 1).min(MEMORY);
            *mean += off / *looks as f32;
        }
    }

    /// What is to be taken out: objects that stand out of the background about them by more than a frame's noise, and are known as a whole.
    /// Less does not matter, and an even picture stays as it is.
    fn judge(&mut self, (width, height): (usize, usize), radius_px: f64, noise: f32) {
        let Some(level) = &mut self.level else { return };
        let mean = self.mean[..width * height].iter().sum::<f32>() / (width * height) as f32;
        let pixels = &self.mean[..width * height];
        level.take(pixels, (width, height), radius_px, mean);
        // Parts of an object are less than half a radius apart.
        self.cells
            .clear(((width, height), (0.5 * radius_px) as usize));
        for y in 0..height {
            let row = y * width..(y + 1) * width;
            let known = self.mean[row.clone()].iter().zip(&self.looks[row.clone()]);
            let known = known.zip(level.row(y)).zip(&mut self.taken[row]);
            for (x, (((mean, looks), level), taken)) in known.enumerate() {
                let out = mean - level;
                *taken = if out.abs() > noise {
                    out.round() as i16
                } else {
                    0
                };
                if *looks < LOOKS {
                    self.cells.set((x, y), Cell::Unknown);
                } else if *taken != 0 {
                    self.cells.set((x, y), Cell::Object);
                }
            }
        }
        self.cells.spread();
        self.any = false;
        for y in 0..height {
            for (x, taken) in self.taken[y * width..][..width].iter_mut().enumerate() {
                if self.cells.at((x, y)) != Cell::Object {
                    *taken = 0;
                }
                self.any |= *taken != 0;
            }
        }
    }

    /// Whether everything in a disc about a place of the picture is known, and taken out.
    pub(super) fn is_known(&self, ((x, y), radius_px): Disc) -> bool {
        let (width, height) = self.size;
        let reach = radius_px.ceil();
        let span = |c: f64, len: usize| {
            (c - reach).max(0.0) as usize..((c + reach + 1.0).max(0.0) as usize).min(len)
        };
        let inside = |px: usize, py: usize| f64::hypot(px as f64 - x, py as f64 - y) <= radius_px;
        let (columns, rows) = (span(x, width), span(y, height));
        !columns.is_empty()
            && !rows.is_empty()
            && rows.into_iter().all(|py| {
                (columns.clone())
                    .all(|px| !inside(px, py) || self.cells.at((px, py)) != Cell::Unknown)
            })
    }
}

/// The next part of a row, from a column on, that a disc hides; empty at its end if there is none.
fn next_hidden(moving: &[Disc], y: usize, from: usize, width: usize) -> std::ops::Range<usize> {
    let mut next = width..width;
    for ((x, disc_y), radius) in moving {
        let half2 = radius * radius - (y as f64 - disc_y).powi(2);
        if half2 < 0.0 {
            continue;
        }
        let half = half2.sqrt();
        let start = ((x - half).ceil().max(0.0) as usize).max(from);
        let end = ((x + half).floor() + 1.0).max(0.0) as usize;
        let end = end.min(width);
        if start < end && start < next.start {
            next = start..end;
        }
    }
    next
}

/// What a cell of the picture holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd)]
enum Cell {
    Empty,
    Object,
    /// Not known, or of an object that is not known as a whole.
    Unknown,
}

/// The picture in squares of pixels.
#[derive(Debug, Clone, Default)]
struct Cells {
    cells: Vec<Cell>,
    side: usize,
    columns: usize,
    rows: usize,
}

impl Cells {
    fn new() -> Self {
        Cells {
            cells: Vec::with_capacity(MOST_PIXELS),
            ..Cells::default()
        }
    }

    /// Empty cells of a side, px, for a picture.
    fn clear(&mut self, ((width, height), side): ((usize, usize), usize)) {
        self.side = side.max(1);
        self.columns = width.div_ceil(self.side);
        self.rows = height.div_ceil(self.side);
        self.cells.clear();
        self.cells.resize(self.columns * self.rows, Cell::Empty);
    }

    fn index(&self, (x, y): (usize, usize)) -> usize {
        y / self.side * self.columns + x / self.side
    }

    fn at(&self, place_px: (usize, usize)) -> Cell {
        self.cells[self.index(place_px)]
    }

    fn set(&mut self, place_px: (usize, usize), to: Cell) {
        let i = self.index(place_px);
        if self.cells[i] < to {
            self.cells[i] = to;
        }
    }

    /// An object that touches what is unknown is not known as a whole.
    fn spread(&mut self) {
        let count = self.cells.len();
        let mut changed = true;
        while changed {
            changed = false;
            for i in (0..count).chain((0..count).rev()) {
                if self.cells[i] == Cell::Object && self.touches_unknown(i) {
                    self.cells[i] = Cell::Unknown;
                    changed = true;
                }
            }
        }
    }

    fn touches_unknown(&self, i: usize) -> bool {
        let (x, y) = (i % self.columns, i / self.columns);
        let columns = x.saturating_sub(1)..(x + 2).min(self.columns);
        let mut rows = y.saturating_sub(1)..(y + 2).min(self.rows);
        rows.any(|y| (columns.clone()).any(|x| self.cells[y * self.columns + x] == Cell::Unknown))
    }
}
