//! The search for lines: a spectrum of what the lines leave, and its peaks that are one steady tone.

use super::{AT_ONCE, BINS, CHUNK, KEPT, LineSettings, Lines, WINDOW, square, unit};
use cellpos_numeric::statistics::invert;
use std::f64::consts::{LN_2, PI, TAU};

/// Bins on either side, beyond the main lobe. The median of all is the background: 11 Hz, of which the harmonics of a pump of 3 Hz fill less
/// than half.
pub(super) const BESIDE: std::ops::RangeInclusive<usize> = 3..=22;
/// Part of a peak that a single steady tone may leave unexplained. A line at 100 Hz leaves 0.09 if it drifts by [`super::DRIFT_PER_S`], a tone that
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
pub(super) fn peak_over_median(bins: usize, looks: f64) -> f64 {
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

impl Lines {
    /// A part of the search: of the transform, or of what is judged by it.
    pub(super) fn search(&mut self, settings: &LineSettings) {
        if self.judged < settings.bins {
            self.judge(settings);
        } else {
            self.transform(settings);
        }
    }

    /// Goertzel's filters of some bins on their way through the window.
    fn transform(&mut self, settings: &LineSettings) {
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

    /// Whether the next few bins hold lines.
    fn judge(&mut self, settings: &LineSettings) {
        let last = settings.bins - BESIDE.end() - 2;
        let (aside, width) = (*BESIDE.start() as i64, 2 * *BESIDE.end() as i64);
        for bin in self.judged..self.judged + AT_ONCE {
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
                    is_large && at.is_none() && !self.is_known(settings, other as f64)
                })
            };
            let alone = (bin - PULLS..=bin + PULLS).all(|other| other == bin || !pulls(other));
            let at = tone(bin).and_then(|(_, at)| at);
            if let Some(at) = at.filter(|_| alone && own > settings.peak * *median) {
                self.add(settings, at);
            }
        }
        self.judged += AT_ONCE;
        if self.judged >= settings.bins {
            self.judged = settings.bins.max(BINS);
        }
    }
}
