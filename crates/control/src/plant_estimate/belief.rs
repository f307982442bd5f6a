//! The belief in gain and delay: a probability for each pair on a grid.
//!
//! Between two observations the gain walks a little, and either or both may jump to anything that a plant can have, once in a long time.
//! So a change is found as soon as it explains the fixes better than chance does at the stated rate of changes, and there is no search
//! that could raise a false alarm.

use std::f64::consts::LN_2;

/// Delays on the grid beyond the design's, samples: the span of the lags of the instrument, in steps of [`STEP`].
pub(super) const FIRST: f64 = -1.0;
pub(super) const STEP: f64 = 0.25;
pub(super) const DELAYS: usize = 13;
/// Gains on the grid over the design's, 0.2 to 4.3: the range that arming accepts and half as much again. The step is about the
/// standard deviation that [`GAIN_WALK`] and a dither of one per cent of hold error leave. Within the cells the gain is normal
/// ([`Likely`]).
const GAINS: usize = 64;
const RATIO: f64 = 1.05;
const GRID: [f64; GAINS] = grid();
/// Random walk of the logarithm of a plant's gain, 1/sqrt(s). A channel that clogs to half in a quarter of an hour is then followed
/// within half a standard deviation of the estimate. The interval would hold that truth for 96 % of the time at 0.0045, but the worst stay of
/// the spread of gains would be held at 1.20 of the bound in the place of 1.19. A gain that does not drift is inside for 99 % in the
/// long run, whatever the walk is: the drift is half of the stated variance.
const GAIN_WALK: f64 = 0.008;
/// Changes of each kind (gain, delay, both) in a second: one an hour. By the odds that a report needs one of 3000 would be false if the
/// noise were as it is measured; in ten hours of hold two were.
const CHANGES_PER_S: f64 = 1.0 / 3600.0;
/// Standard deviation of the logarithm of a gain that is not known: twice and half the model's are usual.
const GAIN_PRIOR: f64 = LN_2;
/// Decay of the belief in a delay, for a sample of distance from the design's, natural logarithm.
const DELAY_PRIOR: f64 = 2.0;

const fn grid() -> [f64; GAINS] {
    let mut gains = [0.2; GAINS];
    let mut k = 1;
    while k < GAINS {
        gains[k] = gains[k - 1] * RATIO;
        k += 1;
    }
    gains
}

/// What a block of fixes tells of the gain if the delay is one of the grid: a normal distribution.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Likelihood {
    best: f64,
    information: f64,
    /// The same of a cell.
    precision: f64,
    /// Logarithm at its best gain.
    height: f64,
}

impl Likelihood {
    /// From the score of a gain of zero and the information.
    pub(super) fn new(score: f64, information: f64) -> Self {
        if information.is_nan() || information <= 0.0 {
            return Self::default();
        }
        let best = score / information;
        let width = (RATIO - 1.0) * best.clamp(GRID[0], GRID[GAINS - 1]);
        Self {
            best,
            information,
            // The gain is anywhere in its cell.
            precision: information / (1.0 + information * width * width / 12.0),
            height: 0.5 * score * best,
        }
    }

    fn logarithm(&self, gain: f64) -> f64 {
        self.height - 0.5 * self.precision * (gain - self.best).powi(2)
    }

    fn most(&self) -> f64 {
        self.logarithm(self.best.clamp(GRID[0], GRID[GAINS - 1]))
    }
}

/// What is known of the plant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Finding {
    /// Gain over the model's, and its standard deviation.
    pub gain: f64,
    pub gain_sd: f64,
    /// The same of its logarithm.
    pub log_gain: f64,
    pub log_sd: f64,
    /// Delay beyond the design's, samples, and its standard deviation.
    pub delay: f64,
    pub delay_sd: f64,
    marginal: Marginal,
}

impl Finding {
    /// Logarithm of the odds that the delay is longer and that it is shorter than one of the law's, samples, by half a step of the law's
    /// at least. A delay that is half way counts as longer.
    pub(super) fn delay_odds(&self, delay: f64) -> [f64; 2] {
        let off = |d: usize| FIRST + STEP * d as f64 - delay;
        [
            odds(&self.marginal.delays, |d| off(d) > 0.5 * STEP),
            odds(&self.marginal.delays, |d| off(d) < -1.5 * STEP),
        ]
    }

    /// Logarithm of the odds that the gain is farther from another one than this, by its logarithm.
    pub(super) fn gain_odds(&self, log_gain: f64, farther: f64) -> f64 {
        odds(&self.marginal.gains, |k| {
            (log_at(k) - log_gain).abs() > farther
        })
    }
}

/// Logarithm of the odds of a part of the cells.
fn odds(cells: &[f64], part: impl Fn(usize) -> bool) -> f64 {
    let mut sums = [f64::MIN_POSITIVE; 2];
    for (i, p) in cells.iter().enumerate() {
        sums[usize::from(part(i))] += p;
    }
    (sums[1] / sums[0]).ln()
}

/// Logarithm of a gain of the grid.
fn log_at(k: usize) -> f64 {
    GRID[0].ln() + k as f64 * RATIO.ln()
}

/// Probabilities of all delays, and of all gains.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Marginal {
    delays: [f64; DELAYS],
    gains: [f64; GAINS],
}

const NONE: Marginal = Marginal {
    delays: [0.0; DELAYS],
    gains: [0.0; GAINS],
};

impl Marginal {
    fn normal(mut self) -> Self {
        let all: f64 = self.delays.iter().sum();
        self.delays.iter_mut().for_each(|p| *p /= all);
        let all: f64 = self.gains.iter().sum();
        self.gains.iter_mut().for_each(|p| *p /= all);
        self
    }

    /// Before anything is known; no delay is less than `least`, samples beyond the design's.
    fn prior(least: f64) -> Self {
        let delay = |d: usize| FIRST + STEP * d as f64;
        let of_delay = |d: usize| match delay(d) {
            delay if delay < least - 1e-9 => 0.0,
            delay => (-DELAY_PRIOR * delay.abs()).exp(),
        };
        let of_gain = |k: usize| (-0.5 * (log_at(k) / GAIN_PRIOR).powi(2)).exp();
        Self {
            delays: std::array::from_fn(of_delay),
            gains: std::array::from_fn(of_gain),
        }
        .normal()
    }

    /// With the cells near the likely gain replaced by its normal distribution, which the grid is too coarse for.
    fn finding(&self, likely: &Likely) -> Finding {
        let near = likely.near(self);
        let far = |k: usize| !likely.is_near(k);
        let moments = |at: f64, variance: f64, value: &dyn Fn(usize) -> f64| {
            let cells = || {
                (0..GAINS)
                    .filter(|k| far(*k))
                    .map(|k| (self.gains[k], value(k)))
            };
            let mean = near * at + cells().map(|(p, x)| p * x).sum::<f64>();
            let square = |x: f64| (x - mean).powi(2);
            let spread = cells().map(|(p, x)| p * square(x)).sum::<f64>();
            (mean, near * (variance + square(at)) + spread)
        };
        let Likely { gain, variance } = *likely;
        let (mean, gain2) = moments(gain, variance, &|k| GRID[k]);
        let (log_gain, log2) = moments(gain.ln(), variance / (gain * gain), &log_at);
        let delay_at = |d: usize| FIRST + STEP * d as f64;
        let delays = || self.delays.iter().enumerate();
        let delay: f64 = delays().map(|(d, p)| p * delay_at(d)).sum();
        let delay2: f64 = delays()
            .map(|(d, p)| p * (delay_at(d) - delay).powi(2))
            .sum();
        Finding {
            gain: mean,
            gain_sd: gain2.sqrt(),
            log_gain,
            log_sd: log2.sqrt(),
            delay,
            // The delay is anywhere in its cell.
            delay_sd: delay2.max(STEP * STEP / 12.0).sqrt(),
            marginal: *self,
        }
    }
}

/// The gain within the cells that have most of the probability: a normal distribution. While it is wider than a cell it is that of the
/// grid.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Likely {
    gain: f64,
    variance: f64,
}

impl Likely {
    /// All of a distribution.
    fn new(cells: &Marginal) -> Self {
        let mean = |of: &dyn Fn(usize) -> f64| (0..GAINS).map(|k| cells.gains[k] * of(k)).sum();
        let gain: f64 = mean(&|k| GRID[k]);
        let variance = mean(&|k| (GRID[k] - gain).powi(2));
        Self { gain, variance }
    }

    /// A block of fixes over this time.
    fn observe(&mut self, block: &Likelihood, seconds: f64) {
        self.variance += (GAIN_WALK * self.gain).powi(2) * seconds;
        let part = self.variance * block.information / (1.0 + self.variance * block.information);
        let gain = self.gain + part * (block.best - self.gain);
        self.gain = gain.clamp(GRID[0], GRID[GAINS - 1]);
        self.variance *= 1.0 - part;
    }

    fn is_wide(&self) -> bool {
        self.variance.sqrt() > (RATIO - 1.0) * self.gain
    }

    /// Whether a cell is that of the gain, or within three standard deviations.
    fn is_near(&self, k: usize) -> bool {
        let far = (RATIO - 1.0) * self.gain + 3.0 * self.variance.sqrt();
        self.is_wide() || (GRID[k] - self.gain).abs() < far
    }

    fn near(&self, cells: &Marginal) -> f64 {
        let near = (0..GAINS).filter(|k| self.is_near(*k));
        near.map(|k| cells.gains[k]).sum()
    }
}

/// The probabilities, and the block that is on its way into them, a delay at a time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Belief {
    prior: Marginal,
    /// Sums to that of [`Belief::before`].
    cells: [[f64; GAINS]; DELAYS],
    before: Marginal,
    total: f64,
    likely: Likely,
    now: Marginal,
    block: [Likelihood; DELAYS],
    most: f64,
    seconds: f64,
    row: usize,
}

impl Belief {
    /// Nothing known.
    pub(super) fn new(least: f64) -> Self {
        let prior = Marginal::prior(least);
        Self {
            cells: prior.delays.map(|p| prior.gains.map(|q| p * q)),
            before: prior,
            total: 1.0,
            likely: Likely::new(&prior),
            now: NONE,
            block: [Likelihood::default(); DELAYS],
            most: 0.0,
            seconds: 0.0,
            row: DELAYS,
            prior,
        }
    }

    /// A block of fixes over this time enters with the next [`DELAYS`] calls of [`Belief::advance`].
    pub(super) fn observe(&mut self, block: [Likelihood; DELAYS], seconds: f64) {
        let possible = block
            .iter()
            .zip(self.prior.delays)
            .filter(|(_, p)| *p > 0.0);
        self.most = possible.fold(f64::NEG_INFINITY, |most, (one, _)| most.max(one.most()));
        if self.most.is_finite() {
            (self.block, self.seconds, self.row, self.now) = (block, seconds, 0, NONE);
            let delays = self.before.delays.iter().zip(&block);
            if let Some((_, block)) = delays.max_by(|a, b| a.0.total_cmp(b.0)) {
                self.likely.observe(block, seconds);
            }
        }
    }

    /// One delay. What is known when it was the last one.
    pub(super) fn advance(&mut self) -> Option<Finding> {
        let d = self.row;
        let row = self.cells.get_mut(d)?;
        let walk = 0.5 * GAIN_WALK * GAIN_WALK * self.seconds / RATIO.ln().powi(2);
        let change = CHANGES_PER_S * self.seconds;
        let (same, delay) = ((1.0 - 3.0 * change) / self.total, self.before.delays[d]);
        let (likelihood, prior) = (self.block[d], self.prior.delays[d]);
        let (mut below, mut sum) = (row[0], 0.0);
        for k in 0..GAINS {
            let (own, above) = (row[k], row[(k + 1).min(GAINS - 1)]);
            let walked = own + walk * (below - 2.0 * own + above);
            below = own;
            let jumped = self.prior.gains[k] * (delay + prior) + self.before.gains[k] * prior;
            let part = (likelihood.logarithm(GRID[k]) - self.most).exp();
            row[k] = (same * walked + change * jumped) * part;
            self.now.gains[k] += row[k];
            sum += row[k];
        }
        self.now.delays[d] = sum;
        self.row += 1;
        if self.row < DELAYS {
            return None;
        }
        self.total = self.now.delays.iter().sum();
        if self.total.is_nan() || self.total <= f64::MIN_POSITIVE {
            // No gain and no delay of the grid explains the block.
            let least = self.least();
            *self = Self::new(least);
            return None;
        }
        self.before = self.now.normal();
        if self.likely.is_wide() || self.likely.near(&self.before) < 0.5 {
            self.likely = Likely::new(&self.before);
        }
        Some(self.before.finding(&self.likely))
    }

    fn least(&self) -> f64 {
        let first = self.prior.delays.iter().position(|p| *p > 0.0);
        FIRST + STEP * first.unwrap_or(0) as f64
    }
}
