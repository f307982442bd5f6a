//! The empty channel: mean of its frames, noise, and slow changes followed where no cell is.

/// Distance from a region within which the background is left alone, px.
const CLEAR_PX: usize = 6;
/// Pixels beside that, whose change stands for that behind the region.
const BESIDE_PX: usize = 12;
/// Each row of the background is refreshed once in so many frames.
const REFRESHED_EVERY: usize = 16;

/// At most this many pixels serve for the estimate of a shift.
pub(super) const SAMPLES: usize = 384;

/// About so many pixels serve for the estimate of the light.
const LIGHT_SAMPLES: usize = 2048;
/// Ratios of a pixel to the background's are counted in so many classes from 0 on, and so many to a ratio of 1.
const LIGHT_BINS: usize = 1024;
const LIGHT_BINS_PER_ONE: f32 = 256.0;
const LIGHT_PASSES: usize = 4;

/// First column and row of a region, and the first behind it, px.
pub(super) type Bounds = [usize; 4];

/// What a frame is compared with.
#[derive(Debug, Clone)]
pub(super) struct Background {
    pub width: usize,
    pub mean: Vec<f32>,
    /// Sum of squared deviations from the running mean, over all pixels.
    deviations: f64,
    /// Noise from elsewhere, grey levels; 0 without.
    known_noise: f64,
    pub frames: u32,
    refreshed: usize,
    /// Changes of the row being refreshed.
    change: Vec<f32>,
    /// Pixels at which it is steep, and frames since they were chosen first.
    pub steep: Vec<u32>,
    pub steep_age: u32,
}

impl Background {
    pub fn new(width: usize, height: usize) -> Self {
        Background {
            width,
            mean: vec![0.0; width * height],
            deviations: 0.0,
            known_noise: 0.0,
            frames: 0,
            refreshed: 0,
            change: vec![0.0; width],
            steep: Vec::with_capacity(SAMPLES),
            steep_age: 0,
        }
    }

    /// Noise of a pixel, grey levels: the scatter of the background frames, at least that of rounding.
    pub fn noise_grey(&self) -> f64 {
        let degrees = f64::from(self.frames.saturating_sub(1)) * self.mean.len() as f64;
        let scatter = (self.deviations / degrees.max(1.0)).max(1.0 / 12.0).sqrt();
        scatter.max(self.known_noise)
    }

    /// Takes a picture that is a mean already for the background; its noise is that of a frame beside it.
    pub fn be<T: Copy>(&mut self, pixels: &[T])
    where
        f32: From<T>,
    {
        (self.frames, self.deviations, self.steep_age) = (2, 0.0, 0);
        for (mean, p) in self.mean.iter_mut().zip(pixels) {
            *mean = f32::from(*p);
        }
    }

    /// Takes the noise from a frame: half of the differences from the background, about their median, are within 0.67
    /// standard deviations of it, whatever swims in it. The least of several frames counts.
    pub fn learn_noise<T: Copy>(&mut self, pixels: &[T])
    where
        f32: From<T>,
    {
        let light = self.light_of(pixels);
        let step = (pixels.len() / 4096).max(1) | 1;
        let pairs = pixels.iter().zip(&self.mean).step_by(step);
        let mut off: Vec<f32> = pairs.map(|(p, m)| f32::from(*p) - light * m).collect();
        off.sort_unstable_by(f32::total_cmp);
        let at = |share: f64| off.get((share * off.len() as f64) as usize);
        if let (Some(low), Some(high)) = (at(0.25), at(0.75)) {
            // Of whole grey levels, of which a quartile is no finer than one.
            let noise = (0.741 * f64::from(high - low)).max(0.5);
            if self.known_noise == 0.0 || noise < self.known_noise {
                self.known_noise = noise;
            }
        }
    }

    /// Takes a frame into the running mean.
    pub fn average<T: Copy>(&mut self, pixels: &[T])
    where
        f32: From<T>,
    {
        self.frames = self.frames.saturating_add(1);
        self.steep_age = 0;
        let share = 1.0 / self.frames as f32;
        for (mean, p) in self.mean.iter_mut().zip(pixels) {
            let v = f32::from(*p);
            let before = v - *mean;
            *mean += share * before;
            self.deviations += f64::from(before) * f64::from(v - *mean);
        }
    }

    /// Follows a frame: a sixteenth of the rows at a time, by their share over `refresh_frames`.
    pub fn refresh<T: Copy>(
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

    /// Light of the frame relative to the background's: where most pixels' ratios lie. Its median is a start that no header,
    /// cell or wall within half of the frame draws away; then the mean of what lies within two standard deviations of it.
    pub fn light_of<T: Copy>(&self, pixels: &[T]) -> f32
    where
        f32: From<T>,
    {
        let step = (pixels.len() / LIGHT_SAMPLES).max(1) | 1;
        let pairs = || {
            let pairs = pixels.iter().zip(&self.mean).step_by(step);
            pairs.map(|(p, m)| (f32::from(*p), *m))
        };
        let mut counts = [0.0_f32; LIGHT_BINS];
        let mut n = 0.0_f32;
        for (v, m) in pairs().filter(|(_, m)| *m > 0.0) {
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
            let (mut over, mut under) = (0.0_f32, 0.0_f32);
            for (v, m) in pairs() {
                if (v - light * m).abs() <= 2.0 * sd * m + 1.0 {
                    over += v;
                    under += m;
                }
            }
            if under > 0.0 {
                light = over / under;
            }
        }
        light
    }
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
