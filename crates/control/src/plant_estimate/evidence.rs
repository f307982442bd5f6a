//! Evidence of gain and delay: moments of the whitened fixes with the whitened motion that was chosen.
//!
//! Let `j` be lags at whole ticks, `x_j` the whitened motion of the model under the dither and the reference, `p_j` that under
//! all commands, and `y` the whitened fix. `x` does not depend on the fixes, so it is independent of the disturbance:
//! `sum x_i y = gain * sum x_i p_j e_j(delay)`, plus a term with the variance of the products `x r`, where `r` is the residual of `y`.
//! That variance is measured in blocks that are longer than the correlation of `x`, so it includes the colour of the disturbance.

use super::belief::{Belief, Finding, Likelihood};
use super::motion::{BLOCK, Frame, MEMBERS};

/// Memory of all that is known of the noise, and of how the commands follow the motion that was chosen, fixes: two seconds at 1 kHz. The
/// variance of the products is then known to 6 %.
pub(super) const MEMORY_FIXES: f64 = 2048.0;
const MEMORY: f64 = MEMORY_FIXES / BLOCK as f64;
/// Standard deviations from which on less is taken of a fix (Huber).
pub(super) const FAR: f64 = 3.0;
/// Standard deviation of the commanded motion over the chosen motion, a lag, before it was seen. The loop leaves the dither alone, so it
/// answers what a wrong gain makes of it only: half of that in a tick, and the gain is wrong by half.
const ANSWER: f64 = 0.25;
/// Blocks from which the noise of a block is known: the degrees of freedom. It is integrated out, so a block is one of Student's
/// distribution with as many dimensions as there are lags.
const SCALE_BLOCKS: f64 = 8.0;

/// Part of a mean of the noise that a new one of `count` values makes up, with a memory of `memory` values. What the design states counts as
/// one block.
pub(super) fn part(count: f64, memory: f64) -> f64 {
    1.0 / (count + memory / MEMORY).min(memory)
}

type Vector = [f64; MEMBERS];
type Matrix = [Vector; MEMBERS];

pub(super) fn dot(a: &Vector, b: &Vector) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// The series of a fix.
pub(super) struct Products {
    pub y_um: f64,
    pub p_um: Vector,
    pub x_um: Vector,
    /// Of a fix that is too far off for its noise less is taken.
    pub weight: f64,
}

/// Sums of a block: `sum x y`, `sum x p`, `sum x x`.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Block {
    xy: Vector,
    xp: Matrix,
    xx: Matrix,
}

impl Block {
    fn take(&mut self, block: &Self) {
        let keep = 1.0 - 1.0 / MEMORY;
        for i in 0..MEMBERS {
            for j in 0..MEMBERS {
                self.xp[i][j] = keep * self.xp[i][j] + block.xp[i][j];
                self.xx[i][j] = keep * self.xx[i][j] + block.xx[i][j];
            }
        }
    }

    /// How the commanded motion at each lag follows the chosen motion at all lags: the mean of a normal distribution, if the rest of the
    /// commanded motion has this variance in the products.
    fn answer(&self, noise_um2: f64) -> Matrix {
        let unseen = (noise_um2 / (ANSWER * ANSWER)).max(f64::MIN_POSITIVE);
        let mut xx = self.xx;
        (0..MEMBERS).for_each(|i| xx[i][i] += unseen);
        let mut answer = [[0.0; MEMBERS]; MEMBERS];
        let Some(l) = cholesky(&xx) else {
            return answer;
        };
        for (j, column) in answer.iter_mut().enumerate() {
            let xp = std::array::from_fn(|i| self.xp[i][j] + if i == j { unseen } else { 0.0 });
            *column = backward(&l, &forward(&l, &xp));
        }
        transposed(&answer)
    }
}

fn transposed(a: &Matrix) -> Matrix {
    std::array::from_fn(|i| std::array::from_fn(|j| a[j][i]))
}

/// What is remembered.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Evidence {
    block: Block,
    fixes: u32,
    /// Variance of the products over that of `x`, um^2, and the blocks that it is from.
    noise_um2: f64,
    blocks: f64,
    /// The same of the commanded motion that was not chosen.
    answer_um2: f64,
    recent: Block,
    belief: Belief,
    pub found: Option<Finding>,
}

impl Evidence {
    /// Nothing known. `least` is the least delay beyond the design's, samples; `noise_um2` the variance of a whitened fix.
    pub(super) fn new(least: f64, noise_um2: f64) -> Self {
        Self {
            block: Block::default(),
            fixes: 0,
            noise_um2,
            blocks: 0.0,
            answer_um2: 0.0,
            recent: Block::default(),
            belief: Belief::new(least),
            found: None,
        }
    }

    /// Takes a gain that was measured otherwise, with its standard deviation. Nothing is stated before a block of fixes.
    pub(super) fn tell(&mut self, gain: f64, sd: f64) {
        self.belief.tell(gain, sd);
    }

    /// A fix. Whether a block of `block` fixes is complete, so that [`Evidence::conclude`] has something to say.
    pub(super) fn add(&mut self, fix: &Products, block: u32) -> bool {
        for i in 0..MEMBERS {
            let x = fix.weight * fix.x_um[i];
            self.block.xy[i] += x * fix.y_um;
            for j in 0..MEMBERS {
                self.block.xp[i][j] += x * fix.p_um[j];
                self.block.xx[i][j] += x * fix.x_um[j];
            }
        }
        self.fixes += 1;
        self.fixes >= block
    }

    /// At the end of a block, which took `seconds`. `believed` is the gain and delay by which the noise is judged.
    pub(super) fn conclude(&mut self, seconds: f64, frame: &Frame, (gain, delay): (f64, f64)) {
        let block = std::mem::take(&mut self.block);
        self.fixes = 0;
        let Some(l) = cholesky(&block.xx) else {
            return;
        };
        let e = frame.of(delay);
        let left: Vector = std::array::from_fn(|i| block.xy[i] - gain * dot(&block.xp[i], &e));
        // Moves of the dither that end with the fixes show themselves in fewer ways than there are members.
        let (left_um2, members) = mean_square(&l, &block.xx, &left);
        self.blocks += 1.0;
        let scale = self.blocks.min(SCALE_BLOCKS);
        let weight = (scale + members) / (scale * self.noise_um2 + members * left_um2);
        self.noise_um2 += (left_um2 - self.noise_um2) / (scale + 1.0);
        let part = part(self.blocks, MEMORY);
        // The commands answer the disturbance, so their products in this block correlate with its noise. How they follow the motion that was
        // chosen is known from the blocks before.
        let answered: Vector =
            std::array::from_fn(|i| dot(&block.xp[i], &e) - dot(&block.xx[i], &e));
        let (answer_um2, _) = mean_square(&l, &block.xx, &answered);
        self.answer_um2 += part * (answer_um2 - self.answer_um2);
        let answer = self.recent.answer(self.answer_um2);
        let commanded = |delay: f64| -> Vector {
            let e = frame.of(delay);
            std::array::from_fn(|i| dot(&answer[i], &e))
        };
        let before = commanded(delay);
        let score: Vector = std::array::from_fn(|i| left[i] + gain * dot(&block.xx[i], &before));
        let likelihood = |delay: f64| {
            let by = commanded(delay);
            let moved: Vector = std::array::from_fn(|i| dot(&block.xx[i], &by));
            Likelihood {
                score: weight * dot(&by, &score),
                information: weight * dot(&by, &moved),
            }
        };
        self.found = Some(self.belief.observe(likelihood, seconds));
        self.recent.take(&block);
    }
}

/// Share of a matrix' trace below which a direction of it is empty.
const EMPTY: f64 = 1e-6;

/// Mean square of a vector by the matrix `v`, whose factor is `l`, in the directions that are not empty, and how many those are.
fn mean_square(l: &Matrix, v: &Matrix, b: &Vector) -> (f64, f64) {
    let trace: f64 = (0..MEMBERS).map(|i| v[i][i]).sum();
    let white = forward(l, b);
    let full = (0..MEMBERS).filter(|&i| l[i][i] * l[i][i] > EMPTY * trace);
    let (sum, count) = full.fold((0.0, 0.0), |(sum, count), i| {
        (sum + white[i] * white[i], count + 1.0)
    });
    (sum / count, count)
}

/// Factor of a matrix; `None` if it is zero.
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
                (v[i][i] - sum).max(EMPTY * trace).sqrt()
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

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_numeric::Random;

    /// Dither on sides of two fixes, and commands that wander as they answer a bead that wanders.
    #[test]
    fn what_the_commands_answer_by_chance_is_not_taken_for_an_answer_to_the_dither() {
        for seed in 0..20 {
            let mut random = Random::new(seed);
            let mut evidence = Evidence::new(-2.0, 1e-3);
            let mut x_um = [0.0; MEMBERS];
            let frame = Frame {
                first: 0.0,
                jump: 0.0,
                exposure: 0.0,
            };
            let (mut wander_um, mut side_um) = (0.0, 0.0);
            let mut farthest = 0.0_f64;
            for fix in 0..20_000 {
                let before_um = side_um;
                if fix % 2 == 0 {
                    side_um = if random.uniform() < 0.5 { -3e-3 } else { 3e-3 };
                }
                x_um.rotate_right(1);
                x_um[0] = side_um - before_um;
                wander_um = 0.95 * wander_um + 5e-3 * random.normal();
                let p_um = x_um.map(|x| x + wander_um);
                let products = Products {
                    y_um: p_um[1] + 0.03 * random.normal(),
                    p_um,
                    x_um,
                    weight: 1.0,
                };
                if evidence.add(&products, BLOCK) {
                    let seconds = 1e-3 * f64::from(BLOCK);
                    evidence.conclude(seconds, &frame, (1.0, 0.0));
                    let answer = evidence.recent.answer(evidence.answer_um2);
                    for (i, row) in answer.iter().enumerate() {
                        for (j, part) in row.iter().enumerate() {
                            let chosen = f64::from(u8::from(i == j));
                            farthest = farthest.max((part - chosen).abs());
                        }
                    }
                }
            }
            assert!(farthest < 3.0 * ANSWER, "seed {seed}: {farthest}");
            let found = evidence.found.expect("an estimate after 20 s");
            let off = (found.gain - 1.0).abs() / found.gain_sd;
            assert!(off < 3.5 && found.gain_sd < 0.2, "seed {seed}: {found:?}");
        }
    }
}
