//! The empty channel: mean of its frames, noise, and slow changes followed where no cell is.

/// Distance from a region within which the background is left alone, px.
const CLEAR_PX: usize = 6;
/// Pixels next to a region whose change is taken for that behind it.
const BESIDE_PX: usize = 12;
/// Number of frames in which each row of the background is refreshed once.
const REFRESHED_EVERY: usize = 16;

/// At most this many pixels serve for the estimate of a shift.
pub(super) const SAMPLES: usize = 384;

/// Side of the patches that are restless or not, px.
const PATCH: usize = 4;
/// A patch is restless from this multiple of the median patch's scatter on, and from this number of grey levels on.
const RESTLESS: (f32, f32) = (4.0, 4.0);
/// Least number of frames for a judgement, and the share of them in which a patch must change: an object that swims past changes
/// few. Text is written into the outer quarter of a frame.
const FEWEST_RESTLESS: u32 = 8;
const RESTLESS_SHARE: (u32, u32) = (2, 5);
/// Patches next to a restless one that count as restless.
const BESIDE: usize = 2;
/// About this number of pixels gives the estimate of the light.
const LIGHT_SAMPLES: usize = 2048;
/// Ratios of a pixel to the background's are counted in this number of classes from 0 on, with this number up to a ratio of 1.
const LIGHT_BINS: usize = 1024;
/// Groups that the place of a group moves on by from stretch to stretch.
const GATHERED_AT: usize = 7;
/// Stride of the counted pixels, and the largest change of the light that does not count.
const LIGHT_COUNTED: usize = 4;
const LIGHT_SETTLED: f32 = 1e-5;
const LIGHT_BINS_PER_ONE: f32 = 256.0;
const LIGHT_PASSES: usize = 4;

/// First column and row of a region, and the first behind it, px.
pub(super) type Bounds = [usize; 4];

/// The empty channel, with which a frame is compared.
#[derive(Debug, Clone)]
pub(super) struct Background {
    pub width: usize,
    pub mean: Vec<f32>,
    /// Sum of squared deviations from the running mean, over the pixels of each patch.
    deviations: Vec<f32>,
    /// Patches whose grey levels change without an object: text that counts the frames, a lamp in the picture.
    restless: Vec<bool>,
    /// Squared differences of the last frame in each patch, and in how many frames they were large.
    last: Vec<f32>,
    active: Vec<u32>,
    sorted: Vec<f32>,
    /// Pixels that serve for the light, and the background's there.
    lit: Vec<[f32; 8]>,
    unlit: Vec<[f32; 8]>,
    scatter: f64,
    /// Noise from elsewhere, grey levels; 0 without.
    known_noise: f64,
    pub frames: u32,
    refreshed: usize,
    /// Changes of the row being refreshed.
    change: Vec<f32>,
    /// Pixels at which it is steep, and frames since they were chosen first.
    pub steep: Vec<u32>,
    pub steep_age: u32,
    /// Level of each row when they were chosen, grey levels.
    pub row_levels: Vec<f32>,
}

impl Background {
    pub(super) fn new(width: usize, height: usize) -> Self {
        let patches = width.div_ceil(PATCH) * height.div_ceil(PATCH);
        Background {
            width,
            mean: vec![0.0; width * height],
            deviations: vec![0.0; patches],
            restless: vec![false; patches],
            last: vec![0.0; patches],
            active: vec![0; patches],
            sorted: Vec::with_capacity(patches),
            lit: Vec::with_capacity(2 * LIGHT_SAMPLES / 8),
            unlit: Vec::with_capacity(2 * LIGHT_SAMPLES / 8),
            scatter: 0.0,
            known_noise: 0.0,
            frames: 0,
            refreshed: 0,
            change: vec![0.0; width],
            steep: Vec::with_capacity(SAMPLES),
            steep_age: 0,
            row_levels: vec![0.0; height],
        }
    }

    /// Noise of a pixel, grey levels: the scatter of the background frames, restless patches left out, at least that of
    /// rounding.
    pub(super) fn noise_grey(&self) -> f64 {
        self.scatter
            .max((1.0_f64 / 12.0).sqrt())
            .max(self.known_noise)
    }

    /// Takes noise and restless patches from the deviations and from the last frame's differences.
    fn settle(&mut self) {
        if self.frames < 2 || self.last.is_empty() {
            return;
        }
        let pixels = (PATCH * PATCH) as f32;
        let most = |sorted: &mut Vec<f32>, values: &[f32], degrees: f32| {
            sorted.clear();
            sorted.extend(values);
            let middle = sorted.len() / 2;
            let (_, median, _) = sorted.select_nth_unstable_by(middle, f32::total_cmp);
            (RESTLESS.0 * RESTLESS.0 * *median).max(RESTLESS.1 * RESTLESS.1 * degrees)
        };
        let active = most(&mut self.sorted, &self.last, pixels);
        for (count, off) in self.active.iter_mut().zip(&self.last) {
            *count += u32::from(*off > active);
        }
        let degrees = (self.frames - 1) as f32 * pixels;
        let limit = most(&mut self.sorted, &self.deviations, degrees);
        let calm = self.deviations.iter().filter(|d| **d <= limit);
        let (sum, n) = calm.fold((0.0, 0.0), |(sum, n), d| (sum + f64::from(*d), n + 1.0));
        self.scatter = (sum / f64::max(n, 1.0) / f64::from(degrees)).sqrt();
        if self.frames < FEWEST_RESTLESS {
            return;
        }
        let columns = self.width.div_ceil(PATCH).max(1);
        let rows = self.restless.len() / columns;
        let least = self.frames * RESTLESS_SHARE.0 / RESTLESS_SHARE.1;
        let outer = |k: usize, count: usize| 4 * k.min(count - 1 - k) < count;
        for (k, restless) in self.restless.iter_mut().enumerate() {
            let (x, y) = (k % columns, k / columns);
            // Beside text that has changed there is text that will.
            let beside = k - x.min(BESIDE)..=k + BESIDE.min(columns - 1 - x);
            let near = self.active.get(beside).unwrap_or(&[]);
            let written = outer(x, columns) || outer(y, rows);
            *restless = written && near.iter().any(|count| *count >= least);
        }
    }

    /// Whether a pixel belongs to a patch that changes without an object.
    pub(super) fn is_restless(&self, x: usize, y: usize) -> bool {
        let patch = y / PATCH * self.width.div_ceil(PATCH) + x / PATCH;
        self.restless.get(patch).copied().unwrap_or(false)
    }

    /// Takes the restless patches out of a contrast.
    pub(super) fn calm(&self, contrast: &mut [f32]) {
        if !self.restless.contains(&true) {
            return;
        }
        let columns = self.width.div_ceil(PATCH);
        let rows = contrast.chunks_exact_mut(self.width);
        for (y, row) in rows.enumerate() {
            let restless = self.restless.iter().skip(y / PATCH * columns);
            for (patch, _) in row.chunks_mut(PATCH).zip(restless).filter(|(_, r)| **r) {
                patch.fill(0.0);
            }
        }
    }

    /// Takes a picture that is already a mean for the background; its noise is the difference of a frame from it.
    pub(super) fn be<T: Copy>(&mut self, pixels: &[T])
    where
        f32: From<T>,
    {
        (self.frames, self.scatter, self.steep_age) = (2, 0.0, 0);
        self.deviations.fill(0.0);
        self.restless.fill(false);
        for (mean, p) in self.mean.iter_mut().zip(pixels) {
            *mean = f32::from(*p);
        }
    }

    /// Takes the noise from a frame: half of the differences from the background, about their median, are within 0.67 standard
    /// deviations of it, whatever swims in it. The least of several frames counts.
    pub(super) fn learn_noise<T: Copy>(&mut self, pixels: &[T])
    where
        f32: From<T>,
    {
        let light = self.light_of(pixels);
        let step = (pixels.len() / 4096).max(1) | 1;
        let pairs = pixels.iter().zip(&self.mean).step_by(step);
        let off: Vec<f32> = pairs.map(|(p, m)| f32::from(*p) - light * m).collect();
        if off.is_empty() {
            return;
        }
        let spread = 0.741 * (quantile(&off, 0.75) - quantile(&off, 0.25));
        // Spread over its level, a value has the variance of an even distribution more.
        let even = 1.0 / 12.0;
        let noise = (spread * spread - even).max(even).sqrt();
        if self.known_noise == 0.0 || noise < self.known_noise {
            self.known_noise = noise;
        }
    }

    /// Takes a frame into the running mean.
    pub(super) fn average<T: Copy>(&mut self, pixels: &[T])
    where
        f32: From<T>,
    {
        self.frames = self.frames.saturating_add(1);
        self.steep_age = 0;
        let share = 1.0 / self.frames as f32;
        let columns = self.width.div_ceil(PATCH);
        self.last.fill(0.0);
        let rows = self.mean.chunks_exact_mut(self.width);
        for (y, (means, pixels)) in rows.zip(pixels.chunks_exact(self.width)).enumerate() {
            for (x, (mean, p)) in means.iter_mut().zip(pixels).enumerate() {
                let v = f32::from(*p);
                let before = v - *mean;
                *mean += share * before;
                let patch = y / PATCH * columns + x / PATCH;
                if let (Some(sum), Some(last)) =
                    (self.deviations.get_mut(patch), self.last.get_mut(patch))
                {
                    *sum += before * (v - *mean);
                    *last += before * before;
                }
            }
        }
        self.settle();
    }

    /// Follows a frame: a sixteenth of the rows at a time, by their share over `refresh_frames`.
    pub(super) fn refresh<T: Copy>(
        &mut self,
        pixels: &[T],
        light: f32,
        refresh_frames: u32,
        found: &[Bounds],
    ) where
        f32: From<T>,
    {
        self.refreshed = (self.refreshed + 1) % REFRESHED_EVERY;
        let share = (REFRESHED_EVERY as f32 / refresh_frames as f32).min(1.0);
        let unlit = 1.0 / light;
        let width = self.width;
        let rows = self
            .mean
            .chunks_exact_mut(width)
            .zip(pixels.chunks_exact(width))
            .enumerate();
        for (y, (mean, row)) in rows.skip(self.refreshed).step_by(REFRESHED_EVERY) {
            for ((change, m), p) in self.change.iter_mut().zip(&*mean).zip(row) {
                *change = share * (f32::from(*p) * unlit - m);
            }
            let mut x = 0;
            while let Some((from, to)) = next_near(found, x, y, width) {
                let open = |from: usize, to: usize| {
                    let shown = self.change.get(from..to).unwrap_or(&[]);
                    let sum: f32 = shown.iter().sum();
                    (!shown.is_empty()).then(|| sum / shown.len() as f32)
                };
                let left = open(from.saturating_sub(BESIDE_PX).max(x), from);
                let behind = next_near(found, to, y, width).map_or(width, |next| next.0);
                let right = open(to, (to + BESIDE_PX).min(behind));
                let (left, right) = match (left, right) {
                    (Some(left), Some(right)) => (left, right),
                    (Some(one), None) | (None, Some(one)) => (one, one),
                    (None, None) => (0.0, 0.0),
                };
                let steps = (to - from) as f32;
                if let Some(hidden) = self.change.get_mut(from..to) {
                    for (k, change) in hidden.iter_mut().enumerate() {
                        *change = left + (right - left) * (k as f32 + 0.5) / steps;
                    }
                }
                x = to;
            }
            for (m, change) in mean.iter_mut().zip(&self.change) {
                *m += change;
            }
        }
    }

    /// Light of the frame relative to the background's: the ratio of most pixels. The start is the median, which no header, cell
    /// or wall within half of the frame can change much. The result is the mean of the ratios within two standard deviations of
    /// it.
    pub(super) fn light_of<T: Copy>(&mut self, pixels: &[T]) -> f32
    where
        f32: From<T>,
    {
        self.gather(pixels);
        let mut counts = [0.0_f32; LIGHT_BINS];
        let mut n = 0.0_f32;
        let pairs = self
            .lit
            .as_flattened()
            .iter()
            .zip(self.unlit.as_flattened());
        for (v, m) in pairs.step_by(LIGHT_COUNTED).filter(|(_, m)| **m > 0.0) {
            let bin = (v / m * LIGHT_BINS_PER_ONE) as usize;
            if let Some(count) = counts.get_mut(bin.min(LIGHT_BINS - 1)) {
                *count += 1.0;
                n += 1.0;
            }
        }
        let below = |share: f32| {
            let (mut left, mut bin) = (share * n, 0);
            while bin < LIGHT_BINS - 1 && left > counts[bin] {
                left -= counts[bin];
                bin += 1;
            }
            (bin as f32 + left / counts[bin].max(1.0)) / LIGHT_BINS_PER_ONE
        };
        if n == 0.0 {
            return 1.0;
        }
        let mut light = below(0.5);
        // Half of a normal distribution lies within 0.67 standard deviations of its middle.
        let sd = 0.74 * (below(0.75) - below(0.25));
        for _ in 0..LIGHT_PASSES {
            let (mut over, mut under) = ([0.0_f32; 8], [0.0_f32; 8]);
            for (lit, unlit) in self.lit.iter().zip(&self.unlit) {
                for k in 0..8 {
                    let (v, m) = (lit[k], unlit[k]);
                    let near = (v - light * m).abs() <= 2.0 * sd * m + 1.0;
                    over[k] += if near { v } else { 0.0 };
                    under[k] += if near { m } else { 0.0 };
                }
            }
            let (over, under): (f32, f32) = (over.iter().sum(), under.iter().sum());
            let before = light;
            if under > 0.0 {
                light = over / under;
            }
            if (light - before).abs() <= LIGHT_SETTLED * before {
                break;
            }
        }
        light
    }

    /// Gathers groups of 8 pixels with the background's, spread over the frame.
    fn gather<T: Copy>(&mut self, pixels: &[T])
    where
        f32: From<T>,
    {
        let step = (pixels.len() / LIGHT_SAMPLES).max(1);
        self.lit.clear();
        self.unlit.clear();
        let groups = (0..pixels.len() / (8 * step)).take(self.lit.capacity());
        for n in groups {
            // At another place in each stretch, so that no column or row is met again and again.
            let at = 8 * (n * step + n * GATHERED_AT % step);
            let (Some(Ok::<&[T; 8], _>(lit)), Some(Ok::<&[f32; 8], _>(unlit))) = (
                pixels.get(at..at + 8).map(TryInto::try_into),
                self.mean.get(at..at + 8).map(TryInto::try_into),
            ) else {
                continue;
            };
            self.lit.push(lit.map(f32::from));
            self.unlit.push(*unlit);
        }
        if self.lit.is_empty() {
            // Fewer than 8 pixels: noughts count as nothing.
            let (mut lit, mut unlit) = ([0.0; 8], [0.0; 8]);
            let pairs = pixels.iter().zip(&self.mean);
            for ((lit, unlit), (p, m)) in lit.iter_mut().zip(&mut unlit).zip(pairs) {
                (*lit, *unlit) = (f32::from(*p), *m);
            }
            self.lit.push(lit);
            self.unlit.push(unlit);
        }
    }
}

/// Value below which a share of the values is. Each value is a whole grey level, so its true value is anywhere within half a
/// level.
fn quantile(values: &[f32], share: f64) -> f64 {
    let (low, high) = values.iter().fold((f32::MAX, f32::MIN), |(low, high), v| {
        (low.min(*v), high.max(*v))
    });
    let (mut low, mut high) = (f64::from(low) - 0.5, f64::from(high) + 0.5);
    while high - low > 1e-3 {
        let middle = 0.5 * (low + high);
        let below = |v: &f32| (middle - f64::from(*v) + 0.5).clamp(0.0, 1.0);
        let sum: f64 = values.iter().map(below).sum();
        if sum < share * values.len() as f64 {
            low = middle;
        } else {
            high = middle;
        }
    }
    0.5 * (low + high)
}

/// The first stretch of a row (from, to), at or behind column `x`, that is near a region; stretches that overlap are one.
fn next_near(found: &[Bounds], x: usize, y: usize, width: usize) -> Option<(usize, usize)> {
    let near = || {
        found.iter().filter_map(|&[left, top, right, bottom]| {
            let rows = y + CLEAR_PX >= top && y < bottom + CLEAR_PX;
            let (from, to) = (left.saturating_sub(CLEAR_PX), right + CLEAR_PX);
            (rows && to > x).then_some((from.max(x), to.min(width)))
        })
    };
    let (from, mut to) = near().min().filter(|(from, to)| from < to)?;
    while let Some((_, further)) = near().find(|next| next.0 <= to && next.1 > to) {
        to = further;
    }
    Some((from, to))
}
