//! What is left beside the model, by frequency: where a line stands out of it.
//!
//! A pump or the mains shake the bead at one frequency, or a few. A bank of resonators, evenly spaced by the logarithm of frequency,
//! takes the power of what is left beside the tuning in force: a line stands out of the bands beside it, whatever the colour of the
//! rest.

use std::f64::consts::TAU;

/// Resonators.
const BANDS: usize = 32;
/// Lowest and highest centre, cycles a sample.
const LOW: f64 = 0.005;
const HIGH: f64 = 0.45;
/// Half the width of a resonator over its frequency.
const HALF_WIDTH: f64 = 0.08;
/// Memory of a power, in memories of its resonator; shortest, ticks.
const MEMORIES: f64 = 8.0;
const SHORTEST_TICKS: f64 = 500.0;
/// A line stands out of the bands so far beside it, by this factor, and by so much evidence (a logarithm of a likelihood ratio:
/// by chance never in a hundred hours).
const BESIDE: usize = 3;
const CONTRAST: f64 = 3.0;
const EVIDENCE: f64 = 25.0;
/// The factor at either end, where only one side is heard.
const CONTRAST_AT_ENDS: f64 = 6.0;

/// Looks at which it must stand out, and part of its mean power that it must have at each.
const LOOKS: u8 = 4;
const STANDS: f64 = 0.2;

/// One value a band.
type Bands = [f64; BANDS];

/// The bank. Immutable.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Bank {
    /// Centres, rad a sample.
    rad: Bands,
    /// Real and imaginary part of the poles.
    pole: [Bands; 2],
    /// What of a sample a resonator takes.
    part: Bands,
    /// Memory of a power, ticks.
    memory: Bands,
    /// Power that white noise of variance 1 leaves in a resonator.
    white: Bands,
}

impl Default for Bank {
    fn default() -> Self {
        let ratio = (HIGH / LOW).powf(1.0 / (BANDS - 1) as f64);
        let rad: Bands = std::array::from_fn(|k| TAU * LOW * ratio.powi(k as i32));
        let part = rad.map(|w| 1.0 - (-HALF_WIDTH * w).exp());
        let of =
            |f: fn(f64) -> f64| -> Bands { std::array::from_fn(|k| (1.0 - part[k]) * f(rad[k])) };
        Self {
            rad,
            pole: [of(f64::cos), of(f64::sin)],
            part,
            memory: part.map(|part| (MEMORIES / part).max(SHORTEST_TICKS)),
            white: part.map(|part| part / (2.0 - part)),
        }
    }
}

/// Resonators of one series.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Resonators {
    re: Bands,
    im: Bands,
}

const AT_REST: Resonators = Resonators {
    re: [0.0; BANDS],
    im: [0.0; BANDS],
};

impl Resonators {
    fn step(&mut self, bank: &Bank, value: f64) {
        let [cos, sin] = &bank.pole;
        for k in 0..BANDS {
            let (re, im) = (self.re[k], self.im[k]);
            self.re[k] = cos[k] * re - sin[k] * im + bank.part[k] * value;
            self.im[k] = sin[k] * re + cos[k] * im;
        }
    }
}

impl Bank {
    /// Weight of a tick in a band's mean.
    fn weight(&self, k: usize, ticks: f64) -> f64 {
        1.0 / self.memory[k].min(ticks)
    }

    /// Independent values in a band's mean.
    fn values(&self, k: usize, ticks: f64) -> f64 {
        2.0 * self.part[k] * self.memory[k].min(ticks)
    }
}

/// The search for lines.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Lineup {
    left: Resonators,
    power: Bands,
    /// Mean turn of a resonator from tick to tick.
    turn: [Bands; 2],
    ticks: f64,
    /// The band that stood out at the last look, and at how many looks one after the other it did.
    candidate: (usize, u8),
}

impl Lineup {
    pub const NONE: Self = Self {
        left: AT_REST,
        power: [0.0; BANDS],
        turn: [[0.0; BANDS]; 2],
        ticks: 0.0,
        candidate: (0, 0),
    };

    /// Ticks that it has heard.
    pub fn ticks(&self) -> f64 {
        self.ticks
    }

    /// One tick: what is left, um.
    pub fn add(&mut self, bank: &Bank, left_um: f64) {
        self.ticks += 1.0;
        let old = self.left;
        self.left.step(bank, left_um);
        let new = &self.left;
        for k in 0..BANDS {
            let weight = bank.weight(k, self.ticks);
            let re = new.re[k] * old.re[k] + new.im[k] * old.im[k];
            let im = new.im[k] * old.re[k] - new.re[k] * old.im[k];
            let power = new.re[k] * new.re[k] + new.im[k] * new.im[k];
            self.power[k] += weight * (power - self.power[k]);
            self.turn[0][k] += weight * (re - self.turn[0][k]);
            self.turn[1][k] += weight * (im - self.turn[1][k]);
        }
    }

    /// A look: the frequency of the line that stands out most, rad a sample, where it has for some looks. What was once and is no
    /// more (a plant that changed makes the loop ring until it has adapted) is no line.
    pub fn line(&mut self, bank: &Bank) -> Option<f64> {
        let k = self.standing_out(bank);
        self.candidate = match (k, self.candidate) {
            (Some(k), (before, looks)) if before.abs_diff(k) <= 1 => (k, looks.saturating_add(1)),
            (Some(k), _) => (k, 1),
            (None, _) => (0, 0),
        };
        let k = k.filter(|_| self.candidate.1 >= LOOKS)?;
        let rad = self.turn[1][k].atan2(self.turn[0][k]);
        let near = (0.8..1.25).contains(&(rad / bank.rad[k]));
        Some(if near { rad } else { bank.rad[k] })
    }

    fn standing_out(&self, bank: &Bank) -> Option<usize> {
        let density = |k: usize| (self.power[k] / bank.white[k]).max(1e-12);
        let mut best = (EVIDENCE, None);
        for k in 0..BANDS {
            let below = k.checked_sub(BESIDE).map(density);
            let above = (k + BESIDE < BANDS).then(|| density(k + BESIDE));
            let (level, contrast) = match (below, above) {
                (Some(a), Some(b)) => ((a * b).sqrt(), CONTRAST),
                (a, b) => (a.or(b).unwrap_or(f64::INFINITY), CONTRAST_AT_ENDS),
            };
            let over = density(k) / level;
            let evidence = bank.values(k, self.ticks) * (over - 1.0 - over.ln());
            if over > contrast && evidence > best.0 {
                best = (evidence, Some(k));
            }
        }
        best.1.filter(|&k| {
            let now = self.left.re[k].powi(2) + self.left.im[k].powi(2);
            now > STANDS * self.power[k]
        })
    }
}
