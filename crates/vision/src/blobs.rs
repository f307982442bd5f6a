//! Connected components of a thresholded frame, in arrays of fixed size.
//!
//! One pass over the rows joins runs of pixels above the threshold (8-connected) with a union-find over a bounded
//! table of labels. Nothing is allocated after [`Blobs::new`]; what does not fit is counted, not lost silently.

/// Widest frame for which nothing is allocated later, px.
pub(crate) const WIDEST: usize = 16_384;
/// Pixels that are compared with the threshold at once.
const CHUNK: usize = 32;

/// A connected region of pixels above a threshold.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Blob {
    /// Pixels in the region.
    pub area_px: f64,
    /// Centroid weighted with the contrast, px.
    pub x_px: f64,
    /// Centroid weighted with the contrast, px.
    pub y_px: f64,
    /// Sum of the contrast over the region, grey levels.
    pub contrast_sum: f64,
    /// Largest contrast, grey levels.
    pub peak: f64,
    /// Mean contrast, each pixel weighted with its own: that of the body, whatever the share of the soft edge.
    pub body: f64,
    /// Whether the region touches the frame's border.
    pub at_border: bool,
    /// First column and first row of the region, and the first column and row behind it.
    pub bounds: [u32; 4],
    /// Root label of its runs.
    label: u32,
}

/// Sums over a region.
#[derive(Debug, Clone, Copy)]
struct Label {
    parent: u32,
    n: f64,
    sx: f64,
    sy: f64,
    w: f64,
    ww: f64,
    wx: f64,
    wy: f64,
    peak: f64,
    at_border: bool,
    bounds: [u32; 4],
}

#[derive(Debug, Clone, Copy)]
struct Run {
    start: u32,
    end: u32,
    label: u32,
}

/// Where a row crosses a region: the first column in it, and the first behind its last.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Span {
    /// Row.
    pub y: u32,
    /// First column.
    pub start: u32,
    /// First column behind.
    pub end: u32,
}

/// Buffers for the labelling.
#[derive(Debug, Clone)]
pub struct Blobs {
    labels: Vec<Label>,
    before: Vec<Run>,
    now: Vec<Run>,
    found: Vec<Blob>,
    /// Contrast of the row at hand.
    row: Vec<f32>,
    /// All runs of the frame, row by row, if they are wanted.
    runs: Vec<(u32, Run)>,
    dropped_runs: u64,
    max_runs: usize,
    max_labels: usize,
    max_kept_runs: usize,
}

impl Blobs {
    /// Room for `max_labels` provisional regions (a region shaped like a comb takes one for each tooth) and for
    /// `max_runs` runs in a row.
    pub fn new(max_runs: usize, max_labels: usize) -> Self {
        Blobs {
            labels: Vec::with_capacity(max_labels),
            before: Vec::with_capacity(max_runs),
            now: Vec::with_capacity(max_runs),
            found: Vec::with_capacity(max_labels),
            row: Vec::with_capacity(WIDEST),
            runs: Vec::new(),
            dropped_runs: 0,
            max_runs,
            max_labels,
            max_kept_runs: 0,
        }
    }

    /// The same, with room to keep `max_kept_runs` runs of a frame for [`Blobs::spans`].
    pub fn with_spans(max_runs: usize, max_labels: usize, max_kept_runs: usize) -> Self {
        Blobs {
            runs: Vec::with_capacity(max_kept_runs),
            max_kept_runs,
            ..Blobs::new(max_runs, max_labels)
        }
    }

    /// Runs of pixels left out of the last frame for want of room: when not zero, the frame is not a picture of a
    /// few objects.
    pub fn dropped_runs(&self) -> u64 {
        self.dropped_runs
    }

    /// Regions of the last frame, largest contrast sum first.
    pub fn found(&self) -> &[Blob] {
        &self.found
    }

    /// Labels a frame of `width` x `height`; `contrast(y, row)` writes the contrast of a row, and pixels above `threshold`
    /// belong to a region. Regions of fewer than `min_area_px` pixels are left out.
    pub fn label(
        &mut self,
        (width, height): (usize, usize),
        threshold: f32,
        min_area_px: f64,
        mut contrast: impl FnMut(usize, &mut [f32]),
    ) -> &[Blob] {
        self.labels.clear();
        self.before.clear();
        self.now.clear();
        self.found.clear();
        self.dropped_runs = 0;
        self.runs.clear();
        // Taken out while runs are joined.
        let mut row = std::mem::take(&mut self.row);
        row.clear();
        row.resize(width, 0.0);
        for y in 0..height {
            contrast(y, &mut row);
            let edge_row = y == 0 || y + 1 == height;
            let mut x = 0;
            while let Some(start) = next_above(&row, x, threshold) {
                let run = row.iter().enumerate().skip(start);
                x = start;
                let mut sums = Label::EMPTY;
                for (at, v) in run.take_while(|(_, v)| **v > threshold) {
                    sums.add(&Label::at(*v, at, y));
                    x = at + 1;
                }
                sums.at_border = edge_row || start == 0 || x == width;
                sums.bounds = [start as u32, y as u32, x as u32, y as u32 + 1];
                self.join(start as u32, x as u32, sums);
            }
            if self.max_kept_runs > 0 {
                let room = self.max_kept_runs - self.runs.len();
                self.dropped_runs += self.now.len().saturating_sub(room) as u64;
                self.runs
                    .extend(self.now.iter().take(room).map(|run| (y as u32, *run)));
            }
            std::mem::swap(&mut self.before, &mut self.now);
            self.now.clear();
        }
        self.row = row;
        for (label, i) in self.labels.iter().zip(0_u32..) {
            if label.parent == i && label.n >= min_area_px {
                self.found.push(Blob {
                    label: i,
                    ..label.blob()
                });
            }
        }
        self.found
            .sort_unstable_by(|a, b| b.contrast_sum.total_cmp(&a.contrast_sum));
        &self.found
    }

    /// The rows that cross a region of the last frame, from the first to the last, each with its outermost columns: a hole
    /// in the region counts as part of it. Empty without [`Blobs::with_spans`].
    pub fn spans(&self, blob: &Blob) -> impl Iterator<Item = Span> {
        let label = blob.label;
        let mut runs = self
            .runs
            .iter()
            .filter(move |(_, run)| self.root(run.label) == label)
            .peekable();
        std::iter::from_fn(move || {
            let &(y, Run { start, mut end, .. }) = runs.next()?;
            while let Some((_, run)) = runs.next_if(|(row, _)| *row == y) {
                end = run.end;
            }
            Some(Span { y, start, end })
        })
    }

    /// Gives a run the label of the runs of the row above that touch it, or a new one.
    fn join(&mut self, start: u32, end: u32, sums: Label) {
        if self.now.len() >= self.max_runs {
            self.dropped_runs += 1;
            return;
        }
        let mut label: Option<u32> = None;
        for k in 0..self.before.len() {
            let Some(above) = self.before.get(k).copied() else {
                break;
            };
            // Touching by a corner counts.
            if above.end < start || above.start > end {
                continue;
            }
            let root = self.root(above.label);
            label = Some(match label {
                None => root,
                Some(l) => self.unite(l, root),
            });
        }
        let label = match label {
            Some(l) => {
                if let Some(to) = self.labels.get_mut(l as usize) {
                    to.add(&sums);
                }
                l
            }
            None if self.labels.len() < self.max_labels => {
                let l = self.labels.len() as u32;
                self.labels.push(Label { parent: l, ..sums });
                l
            }
            None => {
                self.dropped_runs += 1;
                return;
            }
        };
        self.now.push(Run { start, end, label });
    }

    fn root(&self, mut label: u32) -> u32 {
        while let Some(l) = self.labels.get(label as usize) {
            if l.parent == label {
                break;
            }
            label = l.parent;
        }
        label
    }

    fn unite(&mut self, a: u32, b: u32) -> u32 {
        let (keep, give) = (a.min(b), a.max(b));
        if keep != give
            && let Some(given) = self.labels.get(give as usize).copied()
        {
            if let Some(to) = self.labels.get_mut(keep as usize) {
                to.add(&given);
            }
            if let Some(from) = self.labels.get_mut(give as usize) {
                from.parent = keep;
            }
        }
        keep
    }
}

/// The first place from `from` on that is above the threshold.
fn next_above(row: &[f32], from: usize, threshold: f32) -> Option<usize> {
    let mut from = from;
    for chunk in row.get(from..)?.chunks(CHUNK) {
        // Without a branch per pixel: most of a frame is background.
        if chunk.iter().fold(false, |any, v| any | (*v > threshold)) {
            let at = chunk.iter().position(|v| *v > threshold)?;
            return Some(from + at);
        }
        from += chunk.len();
    }
    None
}

impl Label {
    const EMPTY: Label = Label {
        parent: 0,
        n: 0.0,
        sx: 0.0,
        sy: 0.0,
        w: 0.0,
        ww: 0.0,
        wx: 0.0,
        wy: 0.0,
        peak: f64::NEG_INFINITY,
        at_border: false,
        bounds: [u32::MAX, u32::MAX, 0, 0],
    };

    fn at(contrast: f32, x: usize, y: usize) -> Self {
        let (v, x, y) = (f64::from(contrast), x as f64, y as f64);
        Label {
            parent: 0,
            n: 1.0,
            sx: x,
            sy: y,
            w: v,
            ww: v * v,
            wx: v * x,
            wy: v * y,
            peak: v,
            at_border: false,
            bounds: [u32::MAX, u32::MAX, 0, 0],
        }
    }

    fn add(&mut self, other: &Label) {
        self.n += other.n;
        self.sx += other.sx;
        self.sy += other.sy;
        self.w += other.w;
        self.ww += other.ww;
        self.wx += other.wx;
        self.wy += other.wy;
        self.peak = self.peak.max(other.peak);
        self.at_border |= other.at_border;
        let ([a, b, c, d], [e, f, g, h]) = (self.bounds, other.bounds);
        self.bounds = [a.min(e), b.min(f), c.max(g), d.max(h)];
    }

    fn blob(&self) -> Blob {
        let (mx, my) = (self.sx / self.n, self.sy / self.n);
        let weighted = self.w > 0.0;
        Blob {
            area_px: self.n,
            x_px: if weighted { self.wx / self.w } else { mx },
            y_px: if weighted { self.wy / self.w } else { my },
            contrast_sum: self.w,
            peak: self.peak,
            body: if weighted { self.ww / self.w } else { 0.0 },
            at_border: self.at_border,
            bounds: self.bounds,
            label: 0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn label(blobs: &mut Blobs, picture: &[&str], min_area_px: f64) -> Vec<Blob> {
        let rows: Vec<&[u8]> = picture.iter().map(|r| r.as_bytes()).collect();
        let grey = |v: &u8| {
            if *v == b'.' {
                0.0
            } else {
                f32::from(*v - b'0')
            }
        };
        let contrast = |y: usize, row: &mut [f32]| {
            row.iter_mut().zip(rows[y]).for_each(|(c, v)| *c = grey(v));
        };
        blobs
            .label((rows[0].len(), rows.len()), 0.5, min_area_px, contrast)
            .to_vec()
    }

    #[test]
    fn regions_that_touch_by_a_corner_are_one_and_others_are_apart() {
        let mut blobs = Blobs::new(16, 16);
        let found = label(
            &mut blobs,
            &["........", ".11...1.", "...1....", ".......1"],
            1.0,
        );
        assert_eq!(found.len(), 3);
        assert_eq!(found[0].area_px, 3.0);
        assert!(!found[0].at_border && found.iter().filter(|b| b.at_border).count() == 1);
    }

    #[test]
    fn a_comb_of_separate_teeth_joined_at_the_bottom_is_one_region() {
        let mut blobs = Blobs::new(16, 16);
        let found = label(&mut blobs, &["1.1.1.1", "1.1.1.1", "1111111"], 1.0);
        assert_eq!(found.len(), 1);
        assert_eq!(found[0].area_px, 15.0);
        assert!((found[0].x_px - 3.0).abs() < 1e-12);
    }

    #[test]
    fn small_regions_are_left_out_and_the_rest_come_largest_first() {
        let mut blobs = Blobs::new(16, 16);
        let found = label(&mut blobs, &["1.....22", "......22", "333....."], 2.0);
        assert_eq!(
            found.iter().map(|b| b.area_px).collect::<Vec<_>>(),
            [3.0, 4.0]
        );
        assert_eq!(found[0].peak, 3.0);
    }

    #[test]
    fn the_rows_of_a_region_come_one_by_one_over_its_holes_and_without_its_neighbours() {
        let mut blobs = Blobs::with_spans(16, 16, 64);
        let found = label(
            &mut blobs,
            &["333..1", "3.3...", "333...", "...1..", "......"],
            1.0,
        );
        let spans = |blob: &Blob| -> Vec<(u32, u32, u32)> {
            blobs.spans(blob).map(|s| (s.y, s.start, s.end)).collect()
        };
        assert_eq!(
            spans(&found[0]),
            [(0, 0, 3), (1, 0, 3), (2, 0, 3), (3, 3, 4)]
        );
        assert_eq!(spans(&found[1]), [(0, 5, 6)]);
        assert_eq!(found[0].bounds, [0, 0, 4, 4]);
        assert_eq!(blobs.dropped_runs(), 0);
        assert!((found[0].body - (8.0 * 9.0 + 1.0) / 25.0).abs() < 1e-12);
        let mut cramped = Blobs::with_spans(16, 16, 2);
        label(&mut cramped, &["1.1.1.1"], 1.0);
        assert_eq!(cramped.dropped_runs(), 2);
    }

    #[test]
    fn what_does_not_fit_is_counted() {
        let mut blobs = Blobs::new(2, 2);
        let found = label(&mut blobs, &["1.1.1.1.1", "........."], 1.0);
        assert_eq!((found.len(), blobs.dropped_runs()), (2, 3));
    }
}
