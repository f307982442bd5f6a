//! Periodic disturbances: strokes of a pump and their harmonics, mains hum, a fan. They are detected in the residual of the fixes, tracked
//! in amplitude, phase and frequency, and cancelled by the command.
//!
//! Each line is an oscillator in the disturbance model. The fixes pass the filter of [`super::whiten`], which answers an oscillator `z` with
//! `Re(S z)` plus white noise. `S` is the response of that filter at the line's frequency. One Kalman filter of the amplitude, phase,
//! frequency and drift of all lines follows from that. It sees the disturbance as it would be if nothing were cancelled, so a correction does
//! not shake it. The command moves the bead against the lines through the inverse of the model. Estimator and regression leave
//! this part of the command out, because the disturbance cancels it.
//!
//! A line is tracked if its peak in a spectrum of what the lines leave exceeds the neighbouring bins and is one steady tone. It is
//! cancelled once the fixes that follow show it beyond chance, and removed if its amplitude is no larger than chance.
//!
//! Amplitudes are in units of the command (bead motion over the gain in force): they stay valid when the gain in force changes.

mod search;

use super::whiten::Whitener;
use search::{BINS, CANDIDATE_S, Search, SearchSettings, square, unit};
use std::f64::consts::TAU;

/// Lines at once: a pump with five harmonics, the mains, and one more.
pub(super) const MOST: usize = 8;
/// Bins within which two lines are one: less than half a main lobe.
const ONE_LINE: f64 = 1.5;
/// Mean time between two false positives, s: 28 hours.
const FALSE_S: f64 = 1e5;
/// Memory of amplitude and phase, s: a line that stops is gone in twice that time, and each line adds 0.7 % to the hold error at 1 kHz.
const MEMORY_S: f64 = 1.0;
/// Standard deviations of a new line. Amplitude, um: the largest that a loop follows. Frequency, bins: the interpolated peak of a line
/// that fills a part of the window.
const FIRST_UM: f64 = 1.0;
const FIRST_BINS: f64 = 0.25;
/// Square of an amplitude over its variance below which a line is removed: two standard deviations.
const GONE: f64 = 4.0;
/// Relative drift of a frequency, 1/s: a motor that warms up; and the time in which it changes by as much, s.
const DRIFT_PER_S: f64 = 0.01;
const STEADY_S: f64 = 450.0;

/// What the lines take from the loop, and how sure they have to be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct LineSettings {
    sample_s: f64,
    /// Ticks from fix to fix.
    interval: f64,
    /// Time in which the speed moves the bead as far as the plant's jump does, ticks.
    jump: f64,
    search: SearchSettings,
    /// Square of the amplitude of a candidate over its variance that chance exceeds in one of `FALSE_S / CANDIDATE_S`.
    sure: f64,
}

/// One line.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Line {
    /// Its motion of the bead now is the real part of the amplitude (um over the gain in force) times the phase.
    amplitude: [f64; 2],
    phase: [f64; 2],
    /// Angle in a tick, rad.
    turn: f64,
    /// Change of that angle in a fix.
    drift: f64,
    /// Fixes since it was found.
    fixes: f64,
    /// The fixes after the spectrum show it as well.
    confirmed: bool,
}

/// Errors of a line: both parts of the amplitude (um), the angle in a fix (rad) and its change.
const ERRORS: usize = 4;
const ALL_ERRORS: usize = ERRORS * MOST;

/// The lines, and the search for more.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Lines {
    lines: [Line; MOST],
    count: usize,
    /// Covariance of the errors of all.
    covariance: [[f64; ALL_ERRORS]; ALL_ERRORS],
    search: Search,
}

fn product(a: [f64; 2], b: [f64; 2]) -> [f64; 2] {
    [a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]]
}

fn quotient(a: [f64; 2], b: [f64; 2]) -> [f64; 2] {
    product(a, [b[0], -b[1]]).map(|part| part / square(b).max(f64::MIN_POSITIVE))
}

impl LineSettings {
    /// For a loop of this sample time, s, and `interval` ticks from fix to fix. With each command the bead jumps as far as its speed then
    /// moves it in `jump` ticks.
    pub(super) fn new(sample_s: f64, interval: f64, jump: f64) -> Self {
        Self {
            sample_s,
            interval,
            jump,
            search: SearchSettings::new(sample_s, interval),
            // The sum of two squares of a normal distribution.
            sure: 2.0 * (FALSE_S / CANDIDATE_S).ln(),
        }
    }

    fn fix_s(&self) -> f64 {
        self.interval * self.sample_s
    }

    /// Whether a frequency in bins is that of a line.
    fn is_known(&self, lines: &[Line], bin: f64) -> bool {
        let turn = self.turn(bin);
        let known = |line: &Line| (line.turn - turn).abs() < self.turn(ONE_LINE);
        lines.iter().any(known)
    }

    /// Angle in a tick of a frequency in bins, rad.
    fn turn(&self, bin: f64) -> f64 {
        self.search.turn(bin)
    }
}

impl Line {
    /// It some ticks from now, um.
    fn at(&self, ticks: f64) -> [f64; 2] {
        product(self.amplitude, product(self.phase, unit(self.turn * ticks)))
    }

    /// Jump at a tick of a motion against it, as a factor of where that motion ended the tick before. A command moves the bead by
    /// `m u_k + D (u_k - u_(k-1))` in a tick, its second part at once; `jump` is `D/m`.
    fn jump(&self, jump: f64) -> [f64; 2] {
        let [cos, sin] = unit(self.turn);
        let over = [1.0 + jump * (1.0 - cos), jump * sin];
        quotient([jump * (2.0 * cos - 2.0), 0.0], over)
    }

    /// Where a motion against it is to be at a tick some ticks from now, um.
    ///
    /// The command is held, so the motion jumps at a tick and is straight until the next one. Its ends turn by `w` in a tick. This part of
    /// them is left at the line's frequency, and so they are beyond the line: `sinc(w/2)^2 + jump int_0^1 (1 - x) exp(-i w x) dx`.
    fn end(&self, ticks: f64, jump: [f64; 2]) -> [f64; 2] {
        let (w, [cos, sin]) = (self.turn, unit(self.turn));
        let straight = (2.0 - 2.0 * cos) / (w * w);
        let jumps = product(jump, [0.5 * straight, (sin / w - 1.0) / w]);
        quotient(self.at(ticks), [straight + jumps[0], jumps[1]])
    }

    /// The rest of the line that the motion against it leaves between two ticks, some ticks ago, um.
    fn left_um(&self, ago: f64, jump: f64) -> f64 {
        let newer = ago.floor();
        let (since, [cos, sin]) = (1.0 - (ago - newer), unit(self.turn));
        let jump = self.jump(jump);
        let jumped = jump.map(|part| (1.0 - since) * part);
        let way = [
            1.0 - since + jumped[0] + since * cos,
            jumped[1] + since * sin,
        ];
        self.at(-ago)[0] - product(self.end(-newer - 1.0, jump), way)[0]
    }
}

impl Lines {
    pub(super) fn new() -> Self {
        Self {
            lines: [Line::default(); MOST],
            count: 0,
            covariance: [[0.0; ALL_ERRORS]; ALL_ERRORS],
            search: Search::new(),
        }
    }

    /// Those that the command cancels, by their frequency, Hz, and amplitude, um over the gain in force.
    pub(super) fn cancelled(&self, settings: &LineSettings) -> [Option<[f64; 2]>; MOST] {
        let mut confirmed = self.now().iter().filter(|line| line.confirmed);
        let hz = |line: &Line| line.turn / (TAU * settings.sample_s);
        std::array::from_fn(|_| {
            let line = confirmed.next()?;
            Some([hz(line), square(line.amplitude).sqrt()])
        })
    }

    fn now(&self) -> &[Line] {
        &self.lines[..self.count]
    }

    /// Where a motion against the confirmed lines is to be at a tick `ticks` ticks from now, um.
    pub(super) fn end_um(&self, settings: &LineSettings, ticks: f64) -> f64 {
        let confirmed = self.now().iter().filter(|line| line.confirmed);
        confirmed
            .map(|line| line.end(ticks, line.jump(settings.jump))[0])
            .sum()
    }

    /// What the motion against the confirmed lines leaves of them some ticks ago, um: it is that of a held command.
    pub(super) fn left_um(&self, settings: &LineSettings, ago: f64) -> f64 {
        let confirmed = self.now().iter().filter(|line| line.confirmed);
        confirmed.map(|line| line.left_um(ago, settings.jump)).sum()
    }

    /// A tick on; a part of the search.
    pub(super) fn tick(&mut self, settings: &LineSettings) {
        for line in &mut self.lines[..self.count] {
            line.phase = product(line.phase, unit(line.turn));
        }
        let lines = &self.lines[..self.count];
        let known = |bin: f64| settings.is_known(lines, bin);
        let found = self.search.tick(&settings.search, known);
        found
            .into_iter()
            .flatten()
            .for_each(|bin| self.add(settings, bin));
    }

    /// A whitened fix of the disturbance that is `ago` ticks old, as if nothing were cancelled, and its variance without lines, um and um^2.
    pub(super) fn learn(
        &mut self,
        settings: &LineSettings,
        whitener: &Whitener,
        (fix_um, noise_um2): (f64, f64),
        ago: f64,
    ) {
        let memory = MEMORY_S / settings.fix_s();
        let mut shown = [0.0; ALL_ERRORS];
        let mut left_um = fix_um;
        for k in 0..self.count {
            let line = self.lines[k];
            let angle = line.turn * settings.interval;
            let seen = whitener.response(angle);
            // A fix shows one of both parts of an amplitude.
            let wander_um2 = 2.0 * noise_um2 / (square(seen) * memory * memory);
            let changes = DRIFT_PER_S * settings.fix_s() * angle;
            self.onward(
                k,
                wander_um2,
                changes * changes * settings.fix_s() / STEADY_S,
            );
            let seen = product(seen, product(line.phase, unit(-line.turn * ago)));
            (shown[ERRORS * k], shown[ERRORS * k + 1]) = (seen[0], -seen[1]);
            left_um -= product(seen, line.amplitude)[0];
        }
        self.search.take(left_um);
        self.correct(&shown, left_um, noise_um2, settings.interval);
        let mut k = 0;
        while k < self.count {
            let over = square(self.lines[k].amplitude) / self.variance_um2(k);
            let line = &mut self.lines[k];
            line.fixes += 1.0;
            let settled = line.fixes > memory;
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

    /// The covariance one fix on: the amplitude wanders, an error of the angle turns it, a drift changes the angle.
    fn onward(&mut self, k: usize, wander_um2: f64, changes: f64) {
        let [re, im] = self.lines[k].amplitude;
        let n = ERRORS * self.count;
        let [a, b, angle, drift] = std::array::from_fn(|i| ERRORS * k + i);
        let p = &mut self.covariance;
        let (of_angle, of_drift) = (p[angle], p[drift]);
        for (row, by, other) in [
            (a, -im, &of_angle),
            (b, re, &of_angle),
            (angle, 1.0, &of_drift),
        ] {
            for (p, other) in p[row].iter_mut().zip(other).take(n) {
                *p += by * other;
            }
        }
        for row in &mut p[..n] {
            row[a] -= im * row[angle];
            row[b] += re * row[angle];
            row[angle] += row[drift];
        }
        p[a][a] += wander_um2;
        p[b][b] += wander_um2;
        p[drift][drift] += changes;
    }

    /// All lines by one fix, which shows these parts of their errors.
    fn correct(&mut self, shown: &[f64; ALL_ERRORS], left_um: f64, noise_um2: f64, interval: f64) {
        let n = ERRORS * self.count;
        let mut with = [0.0; ALL_ERRORS];
        for (with, row) in with[..n].iter_mut().zip(&self.covariance) {
            *with = row.iter().zip(shown).take(n).map(|(p, h)| p * h).sum();
        }
        let variance_um2: f64 = noise_um2 + with.iter().zip(shown).map(|(p, h)| p * h).sum::<f64>();
        for (row, one) in self.covariance.iter_mut().zip(with).take(n) {
            let gain = one / variance_um2;
            for (p, other) in row.iter_mut().zip(with).take(n) {
                *p -= gain * other;
            }
        }
        for (k, line) in self.lines[..self.count].iter_mut().enumerate() {
            let [re, im, angle, drift] =
                std::array::from_fn(|i| with[ERRORS * k + i] / variance_um2 * left_um);
            line.amplitude = [line.amplitude[0] + re, line.amplitude[1] + im];
            line.turn += (line.drift + angle) / interval;
            line.drift += drift;
        }
    }

    /// Variance of the size of an amplitude, um^2.
    fn variance_um2(&self, k: usize) -> f64 {
        let [re, im] = self.lines[k].amplitude;
        let p = |i: usize, j: usize| self.covariance[ERRORS * k + i][ERRORS * k + j];
        let size2 = (re * re + im * im).max(f64::MIN_POSITIVE);
        (re * re * p(0, 0) + 2.0 * re * im * p(0, 1) + im * im * p(1, 1)) / size2
    }

    fn remove(&mut self, k: usize) {
        let n = ERRORS * self.count;
        self.count -= 1;
        self.lines.copy_within(k + 1.., k);
        self.covariance.copy_within(ERRORS * (k + 1)..n, ERRORS * k);
        for row in &mut self.covariance {
            row.copy_within(ERRORS * (k + 1)..n, ERRORS * k);
        }
    }

    /// A line of a frequency in bins, unless it is one that is known.
    fn add(&mut self, settings: &LineSettings, bin: f64) {
        let turn = settings.turn(bin);
        if self.count < MOST && !settings.is_known(self.now(), bin) {
            self.lines[self.count] = Line {
                phase: [1.0, 0.0],
                turn,
                ..Line::default()
            };
            let angle = turn * settings.interval;
            let unsure = [
                FIRST_UM,
                FIRST_UM,
                settings.turn(FIRST_BINS) * settings.interval,
                DRIFT_PER_S * settings.fix_s() * angle,
            ];
            for (i, sd) in unsure.into_iter().enumerate() {
                let at = ERRORS * self.count + i;
                self.covariance[at].fill(0.0);
                (self.covariance.iter_mut()).for_each(|row| row[at] = 0.0);
                self.covariance[at][at] = sd * sd;
            }
            self.count += 1;
        }
    }
}

#[cfg(test)]
#[path = "lines_tests.rs"]
mod tests;
