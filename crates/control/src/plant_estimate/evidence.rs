//! Evidence of gain and delay: moments of the whitened fixes with the whitened motion that was chosen.
//!
//! Let `j` be lags around the design's delay, `x_j` the whitened motion of the model under the dither and the reference, `p_j` that under
//! all commands, and `y` the whitened fix. `x` does not depend on the fixes, so it is independent of the disturbance:
//! `sum x_i y = gain * sum x_i p_j e_j(delay)`, plus a term with the variance of the products `x r`, where `r` is the residual of `y`.
//! That variance is measured in blocks that are longer than the correlation of `x`, so it includes the colour of the disturbance.

/// Lags of the instrument beyond the design's delay, samples. A position between two ticks is on the line through them, so that
/// any delay between the first and the last is in their span.
pub(super) const LAGS: [f64; MEMBERS] = [-1.0, 0.0, 1.0, 2.0];
/// How many.
pub(super) const MEMBERS: usize = 4;
/// Fixes of a block. Whitened binary dither is correlated with itself over 3 ticks; a block of five times that has all but a tenth of
/// the correlation of neighbouring products.
const BLOCK: u32 = 16;
/// Memory, s. With the dither at one per cent of hold error the gain is known to 0.18 after a second. A memory of five seconds knows it to
/// 0.057. At [`GAIN_WALK`] the gain changes by less in that time.
const MEMORY_S: f64 = 5.0;
/// Jumps that are looked for: the ratio of gains, and the change of delay, samples. Half way to each is four standard deviations of
/// the estimate, so that its own error starts no search; of less the memory tells in its time.
const JUMPS: [(f64, f64); 4] = [(2.0, 0.0), (0.5, 0.0), (1.0, 1.0), (1.0, -1.0)];
/// Time after which Page's test of a jump finds one by chance, s; it costs a second in which less is known.
const CHANCE_S: f64 = 1200.0;
/// Memory of the newest blocks, s. If they leave the estimate by more than chance, their distance is added to its uncertainty until the
/// test of a jump has decided. A change of half the gain is two standard deviations of this memory.
const FAST_S: f64 = 1.0;
/// Standard deviations of the estimate by which a jump must leave it.
const APART: f64 = 2.5;
/// Random walk of the logarithm of a real plant's gain, 1/sqrt(s): a channel that clogs to half in an hour.
const GAIN_WALK: f64 = 0.014;
/// Blocks that the variance of independent products counts for against the measured variance of blocks: four times as many as there are lags.
const PRIOR_BLOCKS: f64 = 16.0;
/// Delays tried, samples apart.
const STEP: f64 = 0.25;
const STEPS: usize = 13;
/// Decay of the belief in a delay, for a sample of distance from that in force, natural logarithm.
const DELAY_PRIOR: f64 = 2.0;

type Vector = [f64; MEMBERS];
type Matrix = [Vector; MEMBERS];

/// Sums of one memory.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Sums {
    /// `sum x y`, `sum x p`.
    xy: Vector,
    xp: Matrix,
    /// Squares of the residuals of blocks and of fixes, with weights squared.
    blocks: Matrix,
    fixes: Matrix,
    /// Blocks, and the same with weights squared.
    n: f64,
    n2: f64,
}

/// What is known of the plant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Finding {
    /// Gain over the model's, and its standard deviation.
    pub gain: f64,
    pub gain_sd: f64,
    /// That standard deviation without the distance of the newest blocks.
    own_sd: f64,
    /// Delay beyond the design's, samples, and its standard deviation.
    pub delay: f64,
    pub delay_sd: f64,
    /// Logarithm of the likelihood of each delay tried.
    likelihood: [f64; STEPS],
    /// Weights of the moments of a block in its score for the motion at each lag.
    score: Matrix,
}

impl Finding {
    /// Logarithm of the gain; one that is no gain counts as a small one.
    pub(super) fn log_gain(&self) -> f64 {
        self.gain.max(0.05).ln()
    }

    /// Standard deviation of the logarithm of the gain.
    pub(super) fn log_sd(&self) -> f64 {
        self.gain_sd / self.gain.max(0.05)
    }

    /// Logarithm of the likelihood ratio of two delays, samples.
    pub(super) fn ratio(&self, delay: f64, other: f64) -> f64 {
        let at = |delay: f64| {
            let k = ((delay - LAGS[0]) / STEP)
                .round()
                .clamp(0.0, (STEPS - 1) as f64);
            self.likelihood[k as usize]
        };
        at(delay) - at(other)
    }
}

/// Weights of the lags for a delay, samples.
pub(super) fn weights(delay: f64) -> Vector {
    std::array::from_fn(|j| (1.0 - (delay - LAGS[j]).abs()).max(0.0))
}

pub(super) fn dot(a: &Vector, b: &Vector) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// A search for a jump: the evidence for one (Page's sum).
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Jump {
    evidence: f64,
    /// Gain and delay that it starts from.
    from: (f64, f64),
}

/// The gain of the newest blocks compared with the estimate: sums of scores, of their information, and of that with weights squared.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Fast {
    score: f64,
    information: f64,
    squares: f64,
}

impl Fast {
    fn take(&mut self, score: f64, information: f64, keep: f64) {
        self.score = keep * self.score + score;
        self.information = keep * self.information + information;
        self.squares = keep * keep * self.squares + information;
    }

    /// Square of the distance of the gain from the estimate, less the part that chance explains.
    fn beyond(&self) -> f64 {
        if self.information <= 0.0 {
            return 0.0;
        }
        (self.score.powi(2) - self.squares).max(0.0) / self.information.powi(2)
    }
}

/// What is remembered.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Evidence {
    block: Sums,
    fixes: u32,
    memory: Sums,
    /// One search for each of [`JUMPS`].
    jumps: [Jump; JUMPS.len()],
    fast: Fast,
    pub found: Option<Finding>,
}

/// The series of a fix.
pub(super) struct Products {
    pub y_um: f64,
    pub p_um: Vector,
    pub x_um: Vector,
    /// Residual of `y`, um.
    pub left_um: f64,
    /// Of a fix that is too far off for its noise less is taken.
    pub weight: f64,
}

impl Evidence {
    pub(super) fn new() -> Self {
        Self {
            block: Sums::default(),
            fixes: 0,
            memory: Sums::default(),
            jumps: [Jump::default(); JUMPS.len()],
            fast: Fast::default(),
            found: None,
        }
    }

    /// A fix. Whether a block is complete, so that [`Evidence::conclude`] has something to say.
    pub(super) fn add(&mut self, fix: &Products) -> bool {
        let block = &mut self.block;
        let w = fix.weight;
        let left2 = (w * fix.left_um).powi(2);
        for i in 0..MEMBERS {
            let x = fix.x_um[i];
            block.xy[i] += w * x * fix.y_um;
            for j in 0..MEMBERS {
                block.xp[i][j] += w * x * fix.p_um[j];
                block.fixes[i][j] += left2 * x * fix.x_um[j];
            }
        }
        self.fixes += 1;
        self.fixes >= BLOCK
    }

    /// At the end of a block, which `fix_s` from fix to fix have made: what is known now. `believed` is the gain and delay by which the
    /// block is judged, `delay` that in force, `least` the least that there can be, samples.
    pub(super) fn conclude(&mut self, fix_s: f64, believed: (f64, f64), delay: f64, least: f64) {
        let mut block = std::mem::take(&mut self.block);
        self.fixes = 0;
        let e = weights(believed.1);
        let left: Vector =
            std::array::from_fn(|i| block.xy[i] - believed.0 * dot(&block.xp[i], &e));
        for i in 0..MEMBERS {
            for j in 0..MEMBERS {
                block.blocks[i][j] = left[i] * left[j];
            }
        }
        (block.n, block.n2) = (1.0, 1.0);
        let block_s = f64::from(BLOCK) * fix_s;
        let keep = (-block_s / MEMORY_S).exp();
        self.memory.take(&block, keep);
        if let Some(found) = self.found {
            self.look_for_a_jump(&block, &found, block_s);
        }
        self.found = self.memory.finding(delay, least, block_s);
        if let Some(found) = &mut self.found {
            found.gain_sd = found.own_sd.hypot(self.fast.beyond().sqrt());
        }
    }

    /// Page's test of each jump, from the estimate at which its evidence began. After a jump the memory starts anew.
    fn look_for_a_jump(&mut self, block: &Sums, found: &Finding, block_s: f64) {
        let quiet = (found.gain.max(0.1), found.delay);
        let of = |xp: &Matrix, by: &Vector| -> f64 {
            let moved: Vector = std::array::from_fn(|i| dot(&xp[i], by));
            (0..MEMBERS)
                .map(|j| by[j] * dot(&found.score[j], &moved))
                .sum()
        };
        let score = |from: (f64, f64), by: &Vector| -> f64 {
            let now = weights(from.1);
            let left: Vector =
                std::array::from_fn(|i| block.xy[i] - from.0 * dot(&block.xp[i], &now));
            (0..MEMBERS)
                .map(|j| by[j] * dot(&found.score[j], &left))
                .sum()
        };
        let now = weights(found.delay);
        self.fast.take(
            score(quiet, &now),
            of(&block.xp, &now),
            (-block_s / FAST_S).exp(),
        );
        for (jump, (ratio, late)) in self.jumps.iter_mut().zip(JUMPS) {
            if jump.evidence <= 0.0 {
                jump.from = quiet;
            }
            let (gain, delay) = jump.from;
            let (before, after) = (
                weights(delay),
                weights((delay + late).clamp(LAGS[0], LAGS[MEMBERS - 1])),
            );
            let by: Vector = std::array::from_fn(|j| gain * (ratio * after[j] - before[j]));
            jump.evidence += score(jump.from, &by) - 0.5 * of(&block.xp, &by);
            let near = if late == 0.0 {
                (ratio - 1.0).abs() * gain < APART * found.own_sd
            } else {
                late.abs() < APART * found.delay_sd
            };
            if jump.evidence <= 0.0 || near {
                *jump = Jump::default();
                continue;
            }
            // By chance Page's sum is above `h` every `exp(h)` over its mean decrease.
            let decrease = 0.5 * of(&self.memory.xp, &by) / self.memory.n;
            if jump.evidence > (decrease / block_s * CHANCE_S).max(1.0).ln() {
                // Not those of the search: they were chosen for being far off.
                *self = Self::new();
                return;
            }
        }
    }
}

impl Sums {
    fn take(&mut self, block: &Self, keep: f64) {
        let keep2 = keep * keep;
        for i in 0..MEMBERS {
            self.xy[i] = keep * self.xy[i] + block.xy[i];
            for j in 0..MEMBERS {
                self.xp[i][j] = keep * self.xp[i][j] + block.xp[i][j];
                self.blocks[i][j] = keep2 * self.blocks[i][j] + block.blocks[i][j];
                self.fixes[i][j] = keep2 * self.fixes[i][j] + block.fixes[i][j];
            }
        }
        self.n = keep * self.n + 1.0;
        self.n2 = keep2 * self.n2 + 1.0;
    }

    /// The estimate from this memory; `None` if it has too few blocks.
    fn finding(&self, in_force: f64, least: f64, block_s: f64) -> Option<Finding> {
        if self.n2 <= 0.0 {
            return None;
        }
        // Independent blocks.
        let n = self.n * self.n / self.n2;
        if n < 0.5 * PRIOR_BLOCKS {
            return None;
        }
        let all = n + PRIOR_BLOCKS;
        let small = (all + MEMBERS as f64) / all;
        let variance: Matrix = std::array::from_fn(|i| {
            std::array::from_fn(|j| {
                small * (n * self.blocks[i][j] + PRIOR_BLOCKS * self.fixes[i][j]) / all
            })
        });
        let l = cholesky(&variance)?;
        let b = forward(&l, &self.xy);
        let columns: Matrix =
            std::array::from_fn(|j| forward(&l, &std::array::from_fn(|i| self.xp[i][j])));
        let mut likelihood = [f64::NEG_INFINITY; STEPS];
        let mut gains = [(0.0, 0.0); STEPS];
        let mut most = f64::NEG_INFINITY;
        for k in 0..STEPS {
            let delay = LAGS[0] + STEP * k as f64;
            if delay < least - 1e-9 {
                continue;
            }
            let e = weights(delay);
            let a: Vector =
                std::array::from_fn(|i| (0..MEMBERS).map(|j| columns[j][i] * e[j]).sum());
            let information = dot(&a, &a);
            if information <= 0.0 {
                continue;
            }
            let product = dot(&a, &b);
            gains[k] = (product / information, 1.0 / information);
            likelihood[k] = 0.5 * product.max(0.0).powi(2) / information;
            most = most.max(likelihood[k] - DELAY_PRIOR * (delay - in_force).abs());
        }
        if !most.is_finite() {
            return None;
        }
        let (mut sum, mut mean, mut square, mut at, mut at2) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for k in 0..STEPS {
            let delay = LAGS[0] + STEP * k as f64;
            let w = (likelihood[k] - DELAY_PRIOR * (delay - in_force).abs() - most).exp();
            if w > 1e-9 {
                let (gain, variance) = gains[k];
                sum += w;
                mean += w * gain;
                square += w * (gain * gain + variance);
                at += w * delay;
                at2 += w * delay * delay;
            }
        }
        let (gain, delay) = (mean / sum, at / sum);
        // From sums to the mean of a block.
        let score = columns.map(|a| backward(&l, &a).map(|w| w * self.n2 / self.n));
        // The age of a mean with exponential weights is half its memory, a quarter of the time of its blocks.
        let walk2 = (GAIN_WALK * gain).powi(2) * 0.25 * n * block_s;
        let gain_sd = ((square / sum - gain * gain).max(0.0) + walk2).sqrt();
        Some(Finding {
            gain,
            gain_sd,
            own_sd: gain_sd,
            delay,
            delay_sd: ((at2 / sum - delay * delay).max(0.0) + STEP * STEP / 12.0).sqrt(),
            likelihood,
            score,
        })
    }
}

/// Factor of a variance; `None` if it is zero.
fn cholesky(v: &Matrix) -> Option<Matrix> {
    let trace: f64 = (0..MEMBERS).map(|i| v[i][i]).sum();
    if trace.is_nan() || trace <= 0.0 {
        return None;
    }
    let mut l = [[0.0; MEMBERS]; MEMBERS];
    for i in 0..MEMBERS {
        for j in 0..=i {
            let sum: f64 = (0..j).map(|k| l[i][k] * l[j][k]).sum();
            l[i][j] = if i == j {
                (v[i][i] - sum).max(1e-6 * trace).sqrt()
            } else {
                (v[i][j] - sum) / l[j][j]
            };
        }
    }
    Some(l)
}

fn forward(l: &Matrix, b: &Vector) -> Vector {
    let mut x = [0.0; MEMBERS];
    for i in 0..MEMBERS {
        let sum: f64 = (0..i).map(|k| l[i][k] * x[k]).sum();
        x[i] = (b[i] - sum) / l[i][i];
    }
    x
}

fn backward(l: &Matrix, b: &Vector) -> Vector {
    let mut x = [0.0; MEMBERS];
    for i in (0..MEMBERS).rev() {
        let sum: f64 = (i + 1..MEMBERS).map(|k| l[k][i] * x[k]).sum();
        x[i] = (b[i] - sum) / l[i][i];
    }
    x
}
