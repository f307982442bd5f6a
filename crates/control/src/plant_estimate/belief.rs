//! The belief in gain and delay: for each delay a mixture of normal distributions of the gain.
//!
//! The gain walks a little, and either or both may change to anything that a plant can have, once in a long time. The gain may as well move
//! there by and by: it walks far for some time, and settles. When the last change came is not known. There is one distribution for each of some spans of time in which it may have come, and each fix tells which of them
//! explains it best (change-point detection by Bayes). So a change is found as soon as it explains the fixes better than chance does at the
//! stated rate of changes, and there is no search that could raise a false alarm.

use std::f64::consts::LN_2;

/// Delays beyond the design's, samples: half a sample beyond those of the law's tunings at the upper end, so that a delay that is too long
/// for the law is found.
const LEAST: f64 = -1.0;
const MOST: f64 = 2.0;
/// Their step. A delay that is off by half of it takes at most as large a part from the gain: half of a change that is reported.
const STEP: f64 = 0.125;
const DELAYS: usize = ((MOST - LEAST) / STEP) as usize + 1;
/// Random walk of the logarithm of a plant's gain, 1/sqrt(s). A channel that clogs to half in a quarter of an hour is then followed
/// within half a standard deviation of the estimate. A gain that does not drift is inside for 99 % in the long run, whatever the walk
/// is: the drift is half of the stated variance.
const GAIN_WALK: f64 = 0.008;
/// Changes of each kind (gain at once, gain by and by, delay, gain and delay) in a second: one an hour.
const CHANGES_PER_S: f64 = 1.0 / 3600.0;
/// Standard deviation of the logarithm of a gain that is not known: twice and half the model's are usual.
const GAIN_PRIOR: f64 = LN_2;
/// Spans of time in which the last change may have come. Neighbours that are least likely become one. With 5 or 16 of them the
/// loop holds the same.
const SPANS: usize = 8;
/// Time that a change takes which is no jump, s. The gain walks as far as one that is not known meanwhile.
const MOVES_S: f64 = 20.0;
/// The span in which the gain moves; the others are by age, the oldest first.
const MOVING: usize = 0;

/// A delay of the belief beyond the design's, samples.
fn delay_at(d: usize) -> f64 {
    LEAST + STEP * d as f64
}

/// What a block of fixes tells of the gain `g` if the delay is known: the logarithm of its likelihood is `score g - information g^2 / 2`.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Likelihood {
    pub score: f64,
    pub information: f64,
}

/// What is known of the plant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Finding {
    /// Gain over the model's, and its standard deviation.
    pub gain: f64,
    pub gain_sd: f64,
    /// The same of its logarithm, which is normal.
    pub log_gain: f64,
    pub log_sd: f64,
    /// Delay beyond the design's, samples, and its standard deviation.
    pub delay: f64,
    pub delay_sd: f64,
    delays: [f64; DELAYS],
}

impl Finding {
    /// Logarithm of the odds that the delay is longer and that it is shorter than `delay` by more than `by`, samples.
    pub(super) fn delay_odds(&self, delay: f64, by: f64) -> [f64; 2] {
        let odds = |part: &dyn Fn(f64) -> bool| {
            let mut sums = [f64::MIN_POSITIVE; 2];
            for (d, p) in self.delays.iter().enumerate() {
                sums[usize::from(part(delay_at(d) - delay))] += p;
            }
            (sums[1] / sums[0]).ln()
        };
        [odds(&|off| off > by), odds(&|off| off < -by)]
    }
}

/// A part of the probability with its normal distribution of the gain.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Part {
    probability: f64,
    gain: f64,
    variance: f64,
}

impl Part {
    /// The parts as one normal distribution with their mean and variance.
    fn sum(parts: impl Iterator<Item = Self> + Clone) -> Self {
        let probability: f64 = parts.clone().map(|one| one.probability).sum();
        let over = 1.0 / probability.max(f64::MIN_POSITIVE);
        let share = |one: &Self| one.probability * over;
        let gain: f64 = parts.clone().map(|one| share(&one) * one.gain).sum();
        let spread = |one: Self| share(&one) * (one.variance + (one.gain - gain).powi(2));
        Self {
            probability,
            gain,
            variance: parts.map(spread).sum(),
        }
    }

    /// A gain that nothing is known of: the moments of a normal distribution of its logarithm.
    fn unknown(probability: f64) -> Self {
        let spread = (GAIN_PRIOR * GAIN_PRIOR).exp();
        Self {
            probability,
            gain: spread.sqrt(),
            variance: spread * (spread - 1.0),
        }
    }

    fn times(self, factor: f64) -> Self {
        Self {
            probability: factor * self.probability,
            ..self
        }
    }

    /// Takes a block of fixes. Logarithm of the probability of that block.
    fn observe(&mut self, block: Likelihood) -> f64 {
        let Likelihood { score, information } = block;
        let (gain, variance) = (self.gain, self.variance);
        let narrower = 1.0 / (1.0 + variance * information);
        self.gain = narrower * (gain + variance * score);
        self.variance = narrower * variance;
        let exponent = gain * score + 0.5 * (variance * score * score - information * gain * gain);
        narrower * exponent + 0.5 * narrower.ln()
    }
}

type Span = [Part; DELAYS];

/// The belief. All probabilities sum to 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Belief {
    prior: [f64; DELAYS],
    /// That of [`MOVING`], then the oldest first.
    spans: [Span; SPANS],
}

impl Belief {
    /// Nothing known. `least` is the least delay beyond the design's, samples.
    pub(super) fn new(least: f64) -> Self {
        let weight = |d: usize| match delay_at(d) {
            delay if delay < least - 1e-9 => 0.0,
            _ => 1.0,
        };
        let all: f64 = (0..DELAYS).map(weight).sum();
        let prior = std::array::from_fn(|d| weight(d) / all);
        let mut spans = [[Part::default(); DELAYS]; SPANS];
        spans[1] = prior.map(Part::unknown);
        Self { prior, spans }
    }

    fn delay(&self, d: usize) -> Part {
        Part::sum(self.spans.iter().map(|span| span[d]))
    }

    /// Makes room for a new span: the two neighbours that are least likely become one.
    fn merge(&mut self) {
        let of = |span: &Span| -> f64 { span.iter().map(|part| part.probability).sum() };
        let both = |k: &usize| of(&self.spans[*k]) + of(&self.spans[*k + 1]);
        let least = (1..SPANS - 1).min_by(|a, b| both(a).total_cmp(&both(b)));
        let k = least.unwrap_or(1);
        let [one, other] = [self.spans[k], self.spans[k + 1]];
        self.spans[k] = std::array::from_fn(|d| Part::sum([one[d], other[d]].into_iter()));
        self.spans.copy_within(k + 2.., k + 1);
    }

    /// The plant some time later.
    fn onward(&mut self, seconds: f64) {
        let change = CHANGES_PER_S * seconds;
        let settles = seconds / MOVES_S;
        // The delay wanders as the gain does: by a sample where the gain would by all of it.
        let wanders = 0.5 * (GAIN_WALK / STEP).powi(2) * seconds;
        let prior = self.prior;
        let all: Span = std::array::from_fn(|d| self.delay(d));
        let unknown = |d: usize| Part::unknown(change * (all[d].probability + prior[d]));
        let settled = self.spans[MOVING].map(|part| part.times(settles));
        for new in [settled, std::array::from_fn(unknown)] {
            self.merge();
            self.spans[SPANS - 1] = new;
        }
        for (k, span) in self.spans[..SPANS - 2].iter_mut().enumerate() {
            let any = Part::sum(span.iter().copied());
            let (begins, ends, walk) = match k {
                MOVING => (change, settles, GAIN_PRIOR / MOVES_S.sqrt()),
                _ => (0.0, change, GAIN_WALK),
            };
            let before = *span;
            for (d, part) in span.iter_mut().enumerate() {
                let beside = [d.wrapping_sub(1), d + 1]
                    .into_iter()
                    .filter(|&e| prior.get(e).is_some_and(|p| *p > 0.0));
                let stays = 1.0 - 3.0 * change - ends - wanders * beside.clone().count() as f64;
                let same = [
                    part.times(stays),
                    all[d].times(begins),
                    any.times(change * prior[d]),
                ];
                let moved = beside.map(|e| before[e].times(wanders));
                *part = Part::sum(same.into_iter().chain(moved));
                part.variance += (walk * part.gain).powi(2) * seconds;
            }
        }
    }

    /// A block of fixes over this time, as each delay explains it. What is known then.
    pub(super) fn observe(&mut self, block: impl Fn(f64) -> Likelihood, seconds: f64) -> Finding {
        let block: [Likelihood; DELAYS] = std::array::from_fn(|d| block(delay_at(d)));
        self.onward(seconds);
        let mut logs = [[f64::NEG_INFINITY; DELAYS]; SPANS];
        let mut most = f64::NEG_INFINITY;
        for (span, logs) in self.spans.iter_mut().zip(&mut logs) {
            for ((part, log), block) in span.iter_mut().zip(logs).zip(&block) {
                if part.probability > 0.0 {
                    *log = part.observe(*block) + part.probability.ln();
                    most = most.max(*log);
                }
            }
        }
        let all: f64 = logs.iter().flatten().map(|log| (log - most).exp()).sum();
        for (span, logs) in self.spans.iter_mut().zip(&logs) {
            for (part, log) in span.iter_mut().zip(logs) {
                part.probability = (log - most).exp() / all;
            }
        }
        self.finding()
    }

    /// Takes a gain that was measured otherwise, with its standard deviation, whatever the delay is.
    pub(super) fn tell(&mut self, gain: f64, sd: f64) {
        let information = 1.0 / (sd * sd);
        let measured = Likelihood {
            score: information * gain,
            information,
        };
        self.observe(|_| measured, 0.0);
    }

    fn finding(&self) -> Finding {
        let at: [Part; DELAYS] = std::array::from_fn(|d| self.delay(d));
        let of_gain = Part::sum(at.iter().copied());
        // The delay is anywhere in its cell.
        let of_delay = Part::sum(at.iter().enumerate().map(|(d, one)| Part {
            gain: delay_at(d),
            variance: STEP * STEP / 12.0,
            ..*one
        }));
        let gain = of_gain.gain;
        let log_variance = (of_gain.variance / (gain * gain)).ln_1p();
        Finding {
            gain,
            gain_sd: of_gain.variance.sqrt(),
            log_gain: gain.max(f64::MIN_POSITIVE).ln() - 0.5 * log_variance,
            log_sd: log_variance.sqrt(),
            delay: of_delay.gain,
            delay_sd: of_delay.variance.sqrt(),
            delays: at.map(|one| one.probability),
        }
    }
}
