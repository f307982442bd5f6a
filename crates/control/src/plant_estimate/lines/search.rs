//! The search for lines: a spectrum of what the lines leave, and its peaks that are one steady tone.

use cellpos_numeric::statistics::invert;
use std::f64::consts::{LN_2, PI, TAU};

/// Highest frequency, Hz, and sampling interval of the spectrum, s (a slower camera has its own): two fifths of Nyquist's frequency.
const HIGHEST_HZ: f64 = 200.0;
const SAMPLE_S: f64 = 0.2 / HIGHEST_HZ;
/// Samples of a spectrum, 2 s: resolves lines that are 1 Hz apart under Hann's window (main lobe of 4 bins).
pub(super) const WINDOW: usize = 2048;
/// Samples that are kept: a window, and those that come while it is analysed.
const KEPT: usize = 2 * WINDOW;
pub(super) const BINS: usize =
    (HIGHEST_HZ * SAMPLE_S * WINDOW as f64) as usize + *BESIDE.end() + 2 + AT_ONCE;
/// Samples and bins that a tick analyses: a spectrum is complete after 0.93 s at 1 kHz.
const CHUNK: usize = 128;
pub(super) const AT_ONCE: usize = 8;
/// Mean time between two false candidates, s. They cost nothing: the fixes that follow confirm one in a thousand.
pub(super) const CANDIDATE_S: f64 = 100.0;
/// Bins on either side, beyond the main lobe. The median of all is the background: 11 Hz, of which the harmonics of a pump of 3 Hz fill less
/// than half.
const BESIDE: std::ops::RangeInclusive<usize> = 3..=22;
/// Part of a peak that a single steady tone may leave unexplained. A line at 100 Hz that drifts by 1 % a second leaves 0.09. A tone that
/// fills two thirds of the window 0.1, two tones 1 Hz apart that this window shows as one 0.65, and 0.00 if it shows both.
const UNEXPLAINED: f64 = 0.1;
/// Power that noise adds to that, over its mean in a bin: the tone is fitted to three bins, and 95 % of sums of two exponentials are less.
const NOISE_LEFT: f64 = 4.744;
/// Bins on either side within which a peak that is no tone pulls a tracker away: the main lobe's width.
const PULLS: i64 = 4;

/// Power over the median of `bins` bins of background that chance exceeds in one peak of `exp(looks)`.
///
/// The power in a bin of noise is exponential. Under Hann's window its correlation with the next bin is 4/9 and with the second 1/36, so the
/// bins are worth `many` independent ones. The smallest of `many` powers has a mean of `1/many`, the next one `1/(many - 1)` more.
fn peak_over_median(bins: usize, looks: f64) -> f64 {
    let many = (bins as f64 / (1.0 + 8.0 / 9.0 + 2.0 / 36.0)).floor();
    let median = (many / 2.0).ceil() as usize;
    let logarithm = |x: f64| {
        (0..median)
            .map(|i| (x / (many - i as f64)).ln_1p())
            .sum::<f64>()
    };
    invert(looks, 0.0, 1e6, logarithm)
}

/// Hann's main lobe, some bins from the tone.
fn main_lobe(bins: f64) -> f64 {
    let angle = PI * bins;
    let sinc = if angle.abs() < 1e-6 {
        1.0
    } else {
        angle.sin() / angle
    };
    match 1.0 - bins * bins {
        edge if edge.abs() < 1e-6 => 0.5,
        edge => sinc / edge,
    }
}

pub(super) fn square(a: [f64; 2]) -> f64 {
    a[0] * a[0] + a[1] * a[1]
}

pub(super) fn unit(angle: f64) -> [f64; 2] {
    let (sin, cos) = angle.sin_cos();
    [cos, sin]
}

/// Sampling of the spectrum, and what counts as a peak.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct SearchSettings {
    /// Ticks from sample to sample.
    ticks: u32,
    bins: usize,
    /// Power of a peak over the median of its background that chance exceeds once in [`CANDIDATE_S`].
    peak: f64,
}

impl SearchSettings {
    /// For a loop of this sample time, s, and `interval` ticks from fix to fix.
    pub(super) fn new(sample_s: f64, interval: f64) -> Self {
        let ticks = (SAMPLE_S / sample_s).max(interval).round().max(1.0);
        // A peak has a bin on either side.
        let highest = (HIGHEST_HZ * WINDOW as f64 * ticks * sample_s).ceil() as usize + 1;
        let beside = *BESIDE.end() + 1;
        let bins = (highest + beside).next_multiple_of(AT_ONCE).min(BINS);
        let bins = bins.min(WINDOW / 2) / AT_ONCE * AT_ONCE;
        let spectrum_s = (bins / AT_ONCE * (WINDOW / CHUNK + 1)) as f64 * sample_s;
        let looks = (CANDIDATE_S / spectrum_s * bins as f64).ln();
        Self {
            ticks: ticks as u32,
            bins,
            peak: peak_over_median(2 * BESIDE.count(), looks),
        }
    }

    /// Angle in a tick of a frequency in bins, rad.
    pub(super) fn turn(&self, bin: f64) -> f64 {
        TAU * bin / (WINDOW as f64 * f64::from(self.ticks))
    }
}

/// The samples, and how far their spectrum and its judgement are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Search {
    kept: [f32; KEPT],
    /// Samples so far, and the one that is being made.
    samples: usize,
    sum: f64,
    ticks: u32,
    /// First sample of the window that is analysed; the bin and the sample that are next.
    from: usize,
    bin: usize,
    at: usize,
    filter: [[f64; 2]; AT_ONCE],
    spectrum: [[f32; 2]; BINS],
    judged: usize,
}

impl Search {
    pub(super) fn new() -> Self {
        Self {
            kept: [0.0; KEPT],
            samples: 0,
            sum: 0.0,
            ticks: 0,
            from: 0,
            bin: 0,
            at: WINDOW,
            filter: [[0.0; 2]; AT_ONCE],
            spectrum: [[0.0; 2]; BINS],
            judged: BINS,
        }
    }

    /// What the lines leave of a fix, um.
    pub(super) fn take(&mut self, left_um: f64) {
        self.sum += left_um;
    }

    /// A tick on: a part of the transform, or of what is judged by it. The frequencies of tones that were found, bins; `known` are those of
    /// lines.
    pub(super) fn tick(
        &mut self,
        settings: &SearchSettings,
        known: impl Fn(f64) -> bool,
    ) -> [Option<f64>; AT_ONCE] {
        self.ticks += 1;
        if self.ticks >= settings.ticks {
            self.ticks = 0;
            self.kept[self.samples % KEPT] = std::mem::take(&mut self.sum) as f32;
            self.samples += 1;
        }
        if self.judged < settings.bins {
            self.judge(settings, known)
        } else {
            self.transform(settings);
            [None; AT_ONCE]
        }
    }

    /// Goertzel's filters of some bins on their way through the window.
    fn transform(&mut self, settings: &SearchSettings) {
        if self.bin == 0 && self.at >= WINDOW {
            if self.samples < WINDOW {
                return;
            }
            (self.from, self.at) = (self.samples - WINDOW, 0);
            self.filter = [[0.0; 2]; AT_ONCE];
        }
        let angle = |bin: usize| TAU * bin as f64 / WINDOW as f64;
        let twice: [f64; AT_ONCE] = std::array::from_fn(|i| 2.0 * angle(self.bin + i).cos());
        for k in self.from + self.at..self.from + self.at + CHUNK {
            let sample = f64::from(self.kept[k % KEPT]);
            for (state, twice) in self.filter.iter_mut().zip(twice) {
                *state = [sample + twice * state[0] - state[1], state[0]];
            }
        }
        self.at += CHUNK;
        if self.at < WINDOW {
            return;
        }
        for (i, state) in self.filter.iter().enumerate() {
            let [cos, sin] = unit(angle(self.bin + i));
            let value = [cos * state[0] - state[1], sin * state[0]];
            self.spectrum[self.bin + i] = value.map(|v| v as f32);
        }
        self.bin += AT_ONCE;
        self.filter = [[0.0; 2]; AT_ONCE];
        self.at = 0;
        if self.bin >= settings.bins {
            (self.bin, self.at, self.judged) = (0, WINDOW, 0);
        }
    }

    /// Value of a bin under Hann's window, its sign such that those of one tone have one phase. A spectrum of real numbers is its own mirror.
    fn value(&self, bin: i64) -> [f64; 2] {
        let of = |bin: i64| {
            let [re, im] = self.spectrum[bin.unsigned_abs() as usize].map(f64::from);
            [re, if bin < 0 { -im } else { im }]
        };
        let (before, at, after) = (of(bin - 1), of(bin), of(bin + 1));
        let sign = if bin % 2 == 0 { 1.0 } else { -1.0 };
        std::array::from_fn(|i| sign * (at[i] - 0.5 * (before[i] + after[i])))
    }

    fn power(&self, bin: i64) -> f64 {
        square(self.value(bin))
    }

    /// Power of a peak, and the side on which its larger neighbour is; `None` if it is no peak.
    fn peak(&self, bin: i64) -> Option<(f64, i64)> {
        let [below, own, above] = [bin - 1, bin, bin + 1].map(|bin| self.power(bin));
        let side = if above > below { 1 } else { -1 };
        (own >= below && own > above).then_some((own, side))
    }

    /// Frequency of the tone of a peak, in bins from it, and the power that this tone does not explain there, at its larger neighbour on
    /// `side`, and one bin further.
    fn tone(&self, bin: i64, side: i64) -> (f64, f64) {
        let values: [[f64; 2]; 3] = std::array::from_fn(|i| self.value(bin + side * i as i64));
        let ratio = (square(values[1]) / square(values[0])).sqrt();
        let off = (2.0 * ratio - 1.0) / (ratio + 1.0);
        let lobe: [f64; 3] = std::array::from_fn(|i| main_lobe(i as f64 - off));
        let over = 1.0 / (lobe[0] * lobe[0] + lobe[1] * lobe[1]);
        let amplitude: [f64; 2] = std::array::from_fn(|part| {
            over * (lobe[0] * values[0][part] + lobe[1] * values[1][part])
        });
        let left = values
            .iter()
            .zip(lobe)
            .map(|(value, lobe)| {
                square([
                    value[0] - lobe * amplitude[0],
                    value[1] - lobe * amplitude[1],
                ])
            })
            .sum();
        (side as f64 * off, left)
    }

    /// The tones in the next few bins.
    fn judge(
        &mut self,
        settings: &SearchSettings,
        known: impl Fn(f64) -> bool,
    ) -> [Option<f64>; AT_ONCE] {
        let mut found = [None; AT_ONCE];
        let last = settings.bins - BESIDE.end() - 2;
        let (aside, width) = (*BESIDE.start() as i64, 2 * *BESIDE.end() as i64);
        for (bin, found) in (self.judged..).zip(&mut found) {
            if bin == 0 || bin >= last {
                continue;
            }
            let bin = bin as i64;
            let Some((own, _)) = self.peak(bin) else {
                continue;
            };
            // At a low frequency bins above take the place of the missing bins below.
            let first = (bin - *BESIDE.end() as i64).max(1);
            let others = (first..=first + width).filter(|other| (other - bin).abs() >= aside);
            let mut beside = [f64::INFINITY; 2 * *BESIDE.end() + 1];
            let mut count = 0;
            for other in others {
                beside[count] = self.power(other);
                count += 1;
            }
            let (_, median, _) = beside[..count].select_nth_unstable_by(count / 2, f64::total_cmp);
            if own <= settings.peak * *median {
                continue;
            }
            // Powers of noise are exponential: their mean is the median over ln 2.
            let noise = NOISE_LEFT * *median / LN_2;
            let tone = |bin: i64| {
                let (own, side) = self.peak(bin)?;
                let (off, left) = self.tone(bin, side);
                let is_tone = left < UNEXPLAINED * own + noise;
                Some((own, is_tone.then_some(bin as f64 + off)))
            };
            // Next to something that is no tone a tracker would follow both.
            let pulls = |other: i64| {
                tone(other).is_some_and(|(power, at)| {
                    let is_large = power > UNEXPLAINED * own;
                    is_large && at.is_none() && !known(other as f64)
                })
            };
            let alone = (bin - PULLS..=bin + PULLS).all(|other| other == bin || !pulls(other));
            let at = tone(bin).and_then(|(_, at)| at);
            *found = at.filter(|_| alone);
        }
        self.judged += AT_ONCE;
        if self.judged >= settings.bins {
            self.judged = settings.bins.max(BINS);
        }
        found
    }
}
