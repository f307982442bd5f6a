//! Periodic disturbances: strokes of a pump and their harmonics, mains hum, a fan. They are detected in the residual of the fixes, tracked
//! in amplitude, phase and frequency, and cancelled by the command.
//!
//! Each line is an oscillator in the disturbance model. The residual of the fixes passes the filter of [`super::whiten`]; there an
//! error `dz` of an oscillator is `Re(S dz)` plus white noise, with `S` the response of that filter at the line's frequency. A Kalman
//! filter of amplitude, phase, frequency and drift of the frequency follows from that. The command cancels the line through the inverse of
//! the model. Estimator and regression leave this part of the command out, because the disturbance cancels it. A line is tracked if its peak
//! in a spectrum exceeds the neighbouring bins, counts if the fixes that follow show it beyond chance, and is removed if its amplitude is
//! no larger than chance.
//!
//! Amplitudes are in units of the command (bead motion over the gain in force): they stay valid when the gain in force changes.

use super::whiten::Whitener;
use cellpos_numeric::statistics::invert;
use std::f64::consts::{LN_2, TAU};

/// Lines at once: a pump with five harmonics, the mains, and one more.
const MOST: usize = 8;
/// Highest frequency, Hz, and sampling interval of the spectrum, s (a slower camera has its own): two fifths of Nyquist's frequency.
const HIGHEST_HZ: f64 = 200.0;
const SAMPLE_S: f64 = 0.2 / HIGHEST_HZ;
/// Samples of a spectrum, 2 s: resolves lines that are 1 Hz apart under Hann's window (main lobe of 4 bins).
const WINDOW: usize = 2048;
/// Samples that are kept: a window, and those that come while it is analysed.
const KEPT: usize = 2 * WINDOW;
const BINS: usize = (HIGHEST_HZ * SAMPLE_S * WINDOW as f64) as usize + *BESIDE.end() + 2 + AT_ONCE;
/// Samples and bins that a tick analyses: a spectrum is complete after 0.85 s.
const CHUNK: usize = 128;
const AT_ONCE: usize = 8;
/// Bins within which two lines are one: less than half a main lobe.
const ONE_LINE: f64 = 1.5;
/// Bins on either side, beyond the main lobe. The median of all is the background: 11 Hz, of which the harmonics of a pump of 3 Hz fill less
/// than half.
const BESIDE: std::ops::RangeInclusive<usize> = 3..=22;
/// Number of nearest bins on a side, and the ratio of a peak to their mean above the background from which on it is narrow. A tone that fills 0.4 of the window
/// reaches 20, one that fills half the window 41; in less time two tones 1 Hz apart are one peak. Later nine in ten windows separate them.
const SKIRT: usize = 6;
const NARROW: f64 = 34.0;
/// Bins of half a main lobe of Hann's window.
const LOBE: i64 = 2;
/// Mean time between two false candidates, s: each adds as much to the hold error as a line, for a second. The fixes that follow confirm
/// one candidate in a thousand: mean time between two false positives, s, 28 hours.
const CANDIDATE_S: f64 = 100.0;
const FALSE_S: f64 = 1e5;
/// Memory of amplitude and phase, s: a line that stops is gone in that time, and each line adds 0.3 % to the hold error.
const MEMORY_S: f64 = 0.5;
/// Standard deviations of a new line. Amplitude, um: the largest that a loop follows. Frequency, bins: the interpolated peak of a line
/// that fills a part of the window.
const FIRST_UM: f64 = 1.0;
const FIRST_BINS: f64 = 0.25;
/// Square of an amplitude over its variance below which a line is removed: two standard deviations. A false positive is then
/// removed within a second.
const GONE: f64 = 4.0;
/// Relative drift of a frequency, 1/s: a motor that warms up; and the time in which it changes by as much, s.
const DRIFT_PER_S: f64 = 0.01;
const STEADY_S: f64 = 1000.0;

/// Sampling of the spectrum.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct LineSettings {
    sample_s: f64,
    /// Ticks from fix to fix, and from sample to sample of the spectrum.
    interval: f64,
    ticks: u32,
    bins: usize,
    /// Power of a peak over the median of its background that chance exceeds once in [`CANDIDATE_S`].
    peak: f64,
    /// Square of the amplitude of a candidate over its variance that chance exceeds in one of `FALSE_S / CANDIDATE_S`.
    sure: f64,
}

/// One line.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Line {
    /// Its motion of the bead now is the real part, um over the gain in force.
    z: [f64; 2],
    /// Angle in a tick, rad.
    turn: f64,
    /// Change of that angle in a fix.
    drift: f64,
    /// Variance of the amplitude, um^2.
    radial_um2: f64,
    /// The fixes after the spectrum show it as well.
    confirmed: bool,
    /// Covariance of the error across (um), the angle in a fix (rad) and its change.
    across: [[f64; 3]; 3],
}

/// A fix as a line sees it.
struct Residual {
    left_um: f64,
    noise_um2: f64,
    /// Ticks since the exposure.
    ago: f64,
    /// Response of the whitening filter at the frequency.
    seen: [f64; 2],
}

/// The lines, and the search for more.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Lines {
    lines: [Line; MOST],
    count: usize,
    kept: [f32; KEPT],
    /// Samples so far, and the one that is being made.
    samples: usize,
    sum: f64,
    ticks: u32,
    /// First sample of the window that is analysed; the bin and the sample that are next.
    from: usize,
    bin: usize,
    at: usize,
    /// The first sample after the last line found was cancelled.
    clean: usize,
    filter: [[f64; 2]; AT_ONCE],
    spectrum: [[f32; 2]; BINS],
    judged: usize,
}

fn product(a: [f64; 2], b: [f64; 2]) -> [f64; 2] {
    [a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]]
}

fn square(a: [f64; 2]) -> f64 {
    a[0] * a[0] + a[1] * a[1]
}

fn unit(angle: f64) -> [f64; 2] {
    let (sin, cos) = angle.sin_cos();
    [cos, sin]
}

impl LineSettings {
    /// For a loop of this sample time, s, and `interval` ticks from fix to fix.
    pub(super) fn new(sample_s: f64, interval: f64) -> Self {
        let ticks = (SAMPLE_S / sample_s).max(interval).round().max(1.0);
        let highest = (HIGHEST_HZ * WINDOW as f64 * ticks * sample_s) as usize;
        let beside = *BESIDE.end() + 1;
        let bins = (highest + beside).min(BINS).min(WINDOW / 2) / AT_ONCE * AT_ONCE;
        let spectrum_s = (bins / AT_ONCE * (WINDOW / CHUNK + 1)) as f64 * sample_s;
        let looks = (CANDIDATE_S / spectrum_s * bins as f64).ln();
        Self {
            sample_s,
            interval,
            ticks: ticks as u32,
            bins,
            peak: peak_over_median(2 * BESIDE.count(), looks),
            // The sum of two squares of a normal distribution.
            sure: 2.0 * (FALSE_S / CANDIDATE_S).ln(),
        }
    }

    fn fix_s(&self) -> f64 {
        self.interval * self.sample_s
    }

    /// Angle in a tick of a frequency in bins, rad.
    fn turn(&self, bin: f64) -> f64 {
        TAU * bin / (WINDOW as f64 * f64::from(self.ticks))
    }
}

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

impl Line {
    fn new(settings: &LineSettings, turn: f64) -> Self {
        let angle = turn * settings.interval;
        let unsure = [
            FIRST_UM,
            settings.turn(FIRST_BINS) * settings.interval,
            DRIFT_PER_S * settings.fix_s() * angle,
        ];
        let mut across = [[0.0; 3]; 3];
        for (i, sd) in unsure.into_iter().enumerate() {
            across[i][i] = sd * sd;
        }
        Self {
            z: [0.0; 2],
            turn,
            drift: 0.0,
            radial_um2: FIRST_UM * FIRST_UM,
            confirmed: false,
            across,
        }
    }

    /// A fix with this residual; `apart` is the angle in a tick to the nearest other component, rad. Whether the amplitude is as well known as
    /// it will be.
    fn follow(&mut self, settings: &LineSettings, residual: &Residual, apart: f64) -> bool {
        let angle = self.turn * settings.interval;
        let seen2 = square(residual.seen);
        // One fix shows one quadrature; the mean over a beat with the nearest component shows both, and no memory is shorter than that.
        let change = product(
            [residual.seen[0], -residual.seen[1]],
            unit(self.turn * residual.ago),
        )
        .map(|part| 2.0 * residual.left_um / seen2 * part);
        let white_um2 = 2.0 * residual.noise_um2 / seen2;
        let most = (apart * settings.interval / TAU).clamp(1e-4, 0.5);
        let memory = (MEMORY_S / settings.fix_s()).max(1.0 / most);
        let wander_um2 = white_um2 / (memory * memory);
        let size = square(self.z).sqrt();
        let way = match self.z.map(|um| um / size) {
            way if size > 1e-9 => way,
            _ => [1.0, 0.0],
        };
        let [along_um, across_um] = product(change, [way[0], -way[1]]);

        self.radial_um2 += wander_um2;
        let gain = (self.radial_um2 / (self.radial_um2 + white_um2)).min(most);
        self.radial_um2 = (1.0 - gain).powi(2) * self.radial_um2 + gain * gain * white_um2;

        self.onward(size);
        self.across[0][0] += wander_um2;
        let changes = DRIFT_PER_S * settings.fix_s() * angle;
        self.across[2][2] += changes * changes * settings.fix_s() / STEADY_S;
        // More noise than there is, so that the gain stays below `most`.
        let fix_um2 = white_um2.max(self.across[0][0] * (1.0 / most - 1.0));
        let all_um2 = self.across[0][0] + fix_um2;
        let gains = self.across.map(|row| row[0] / all_um2);
        for (row, gain) in self.across.iter_mut().zip(gains) {
            for (p, other) in row.iter_mut().zip(gains) {
                *p -= gain * other * all_um2;
            }
        }
        let step = product([gain * along_um, gains[0] * across_um], way);
        self.z = [self.z[0] + step[0], self.z[1] + step[1]];
        self.turn += (self.drift + gains[1] * across_um) / settings.interval;
        self.drift += gains[2] * across_um;
        self.radial_um2 < 2.0 * white_um2 / memory
    }

    /// The covariance one fix on: an error of the angle moves a line of this size across, a drift changes the angle.
    fn onward(&mut self, size_um: f64) {
        let p = &mut self.across;
        let [position, angle, drift] = *p;
        p[0] = std::array::from_fn(|j| position[j] + size_um * angle[j]);
        p[1] = std::array::from_fn(|j| angle[j] + drift[j]);
        for row in p.iter_mut() {
            row[0] += size_um * row[1];
            row[1] += row[2];
        }
    }
}

impl Lines {
    pub(super) fn new() -> Self {
        Self {
            lines: [Line::default(); MOST],
            count: 0,
            kept: [0.0; KEPT],
            samples: 0,
            sum: 0.0,
            ticks: 0,
            from: 0,
            bin: 0,
            at: WINDOW,
            clean: 0,
            filter: [[0.0; 2]; AT_ONCE],
            spectrum: [[0.0; 2]; BINS],
            judged: BINS,
        }
    }

    /// How many are confirmed.
    pub(super) fn count(&self) -> usize {
        self.now().iter().filter(|line| line.confirmed).count()
    }

    fn now(&self) -> &[Line] {
        &self.lines[..self.count]
    }

    /// Motion of the bead by the lines `ticks` ticks from now, um.
    pub(super) fn at_um(&self, ticks: f64) -> f64 {
        let of = |line: &Line| product(line.z, unit(line.turn * ticks))[0];
        self.now().iter().map(of).sum()
    }

    /// A tick on; a part of the search.
    pub(super) fn tick(&mut self, settings: &LineSettings) {
        for line in &mut self.lines[..self.count] {
            line.z = product(line.z, unit(line.turn));
        }
        self.ticks += 1;
        if self.ticks >= settings.ticks {
            self.ticks = 0;
            self.kept[self.samples % KEPT] = std::mem::take(&mut self.sum) as f32;
            self.samples += 1;
        }
        if self.judged < settings.bins {
            self.judge(settings);
        } else {
            self.transform(settings);
        }
    }

    /// The residual of a fix that is `ago` ticks old, and its variance without lines, um and um^2.
    pub(super) fn learn(
        &mut self,
        settings: &LineSettings,
        whitener: &Whitener,
        (left_um, noise_um2): (f64, f64),
        ago: f64,
    ) {
        self.sum += left_um;
        let mut k = 0;
        while k < self.count {
            let turn = self.lines[k].turn;
            // Its own mirror image is a component as well.
            let mut apart = 2.0 * turn;
            for (other, line) in self.now().iter().enumerate() {
                if other != k {
                    apart = apart.min((line.turn - turn).abs());
                }
            }
            let residual = Residual {
                left_um,
                noise_um2,
                ago,
                seen: whitener.response(turn * settings.interval),
            };
            let line = &mut self.lines[k];
            let settled = line.follow(settings, &residual, apart);
            let over = square(line.z) / line.radial_um2;
            let gone = settled && over < GONE;
            line.confirmed |= settled && over > settings.sure;
            let turn = line.turn;
            let possible = turn > settings.turn(0.5) && turn < settings.turn(BINS as f64);
            let twin = (self.lines[..k].iter())
                .any(|other| (other.turn - turn).abs() < settings.turn(0.5 * ONE_LINE));
            if gone || twin || !possible {
                self.remove(k);
            } else {
                k += 1;
            }
        }
    }

    fn remove(&mut self, k: usize) {
        self.count -= 1;
        self.lines.copy_within(k + 1.., k);
    }

    /// Goertzel's filters of some bins on their way through the window.
    fn transform(&mut self, settings: &LineSettings) {
        if self.bin == 0 && self.at >= WINDOW {
            if self.samples < self.clean + WINDOW {
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

    /// Power in a bin under Hann's window; a spectrum of real numbers is its own mirror.
    fn power(&self, bin: i64) -> f64 {
        let of = |bin: i64| {
            let [re, im] = self.spectrum[bin.unsigned_abs() as usize].map(f64::from);
            [re, if bin < 0 { -im } else { im }]
        };
        let (before, at, after) = (of(bin - 1), of(bin), of(bin + 1));
        square([
            at[0] - 0.5 * (before[0] + after[0]),
            at[1] - 0.5 * (before[1] + after[1]),
        ])
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
            let own = self.power(bin);
            let (below, above) = (self.power(bin - 1), self.power(bin + 1));
            if own < below || own <= above {
                continue;
            }
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
            let clear = settings.peak * *median;
            // A skirt ends where another line's main lobe begins: strokes of 3 Hz have one in each seventh bin.
            let skirt = |side: i64| -> (f64, i64) {
                let at = |by: i64| self.power(bin + side * by);
                let is_line =
                    |by: &i64| at(*by) > clear && at(*by) >= at(by - 1) && at(*by) > at(by + 1);
                let end = aside + SKIRT as i64;
                let lobe = (2 * LOBE..end + LOBE).find(is_line).unwrap_or(i64::MAX);
                let end = end.min(lobe.saturating_sub(LOBE)).max(aside);
                ((aside..end).map(at).sum(), end - aside)
            };
            let ((left, few), (right, more)) = (skirt(-1), skirt(1));
            // Powers of noise are exponential: their mean is the median over ln 2. The rest of the skirts is the peak's own.
            let its_own = (left + right) / (few + more) as f64 - *median / LN_2;
            if few.min(more) > 0 && own > clear && own > NARROW * its_own {
                // Where the peak of Hann's window is between two bins.
                let (side, sign) = if above > below {
                    (above, 1.0)
                } else {
                    (below, -1.0)
                };
                let ratio = (side / own).sqrt();
                self.add(
                    settings,
                    bin as f64 + sign * (2.0 * ratio - 1.0) / (ratio + 1.0),
                );
            }
        }
        self.judged += AT_ONCE;
        if self.judged >= settings.bins {
            self.judged = settings.bins.max(BINS);
        }
    }

    /// A line of a frequency in bins, unless it is one that is known.
    fn add(&mut self, settings: &LineSettings, bin: f64) {
        let turn = settings.turn(bin);
        let known = |line: &Line| (line.turn - turn).abs() < settings.turn(ONE_LINE);
        if self.count < MOST && !self.now().iter().any(known) {
            self.lines[self.count] = Line::new(settings, turn);
            self.count += 1;
            // A window in which it is cancelled only in part has side lobes that would pass for lines.
            let settled = MEMORY_S / (settings.sample_s * f64::from(settings.ticks));
            self.clean = self.samples + settled as usize;
        }
    }
}

#[cfg(test)]
#[path = "lines_tests.rs"]
mod tests;
