//! Frames that are late by random times: noise in proportion to the speed of the bead, white from frame to frame.
//!
//! It is looked for in what a set leaves. A response that is wrong in its shape leaves more where the bead is fast, too. But it leaves that
//! over some rows, as a walk would, or with the sign of the speed, and then it is no lateness of single frames.

use crate::data::noise::NoiseModel;
use crate::data::row_noise::RowNoise;
use crate::dot::dot;
use crate::fit::context::{Context, Fit};
use crate::problem::Prepared;
use crate::thresholds::{CHANCE_SD, NUMBER};
use cellpos_numeric::golden_section;
use cellpos_plant::Effect;
use cellpos_plant::effects::{self, Action};
use nalgebra::{Matrix3, Vector3};

/// Spread of the times over which the speed at a frame is first measured, as a part of a row.
const SPREAD_ROWS: f64 = 0.1;
/// Range of the standard deviation that is looked for, in rows. Above it frames would come in another order.
const RANGE_ROWS: (f64, f64) = (1e-3, 1.0);
/// Width of an even distribution over its standard deviation: the root of 12.
const EVEN: f64 = 3.464_101_615_137_754_6;
/// Another estimate changes nothing if it is nearer than this, in standard errors.
const SETTLED_SD: f64 = 0.5;
/// Frames in a row whose lateness must be independent of each other: 1 to so many apart.
const APART: usize = 4;

/// How late the frames are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct LateFrames {
    /// Each frame is late by a time even in 0 to this \[s\].
    pub up_to_s: f64,
    /// Its standard error \[s\].
    pub error_s: f64,
    /// Standard deviation of the times, and its standard error \[s\].
    pub sd_s: f64,
    sd_error_s: f64,
    /// Gain in twice the log-likelihood.
    pub gain: f64,
    /// Whether the frames are late by half of that in the mean. A camera that stamps the middle of its lateness shows no delay.
    pub delays: bool,
    /// Whether no delay of the set says so.
    open: bool,
}

impl LateFrames {
    /// What it may be: late in the mean or, if nothing tells, about it.
    pub(crate) fn possible(self) -> impl Iterator<Item = Self> {
        let centred = Self {
            delays: false,
            ..self
        };
        std::iter::once(self).chain(self.open.then_some(centred))
    }

    /// What they do to the mean of the positions, and the error of that by what the scatter says \[s\].
    pub(crate) fn mean(&self) -> (Option<Effect>, f64) {
        let mean = (self.delays).then(|| effects::frame_jitter_mean(self.up_to_s));
        (mean, 0.5 * EVEN * self.sd_error_s)
    }

    /// Whether another estimate says the same.
    pub(crate) fn agrees(&self, other: &Self) -> bool {
        let apart_s = self.up_to_s - other.up_to_s;
        self.delays == other.delays && apart_s.abs() < SETTLED_SD * self.error_s
    }

    /// Whether it is large enough to matter.
    pub(crate) fn matters(&self) -> bool {
        self.up_to_s >= effects::FRAME_JITTER_LEAST_S
    }

    /// The lateness in what a fit leaves, if there is any, and the speed of the bead at every frame \[um/s\]. `known` is the estimate with
    /// which the fit was made.
    pub(crate) fn find(
        ctx: &Context<'_>,
        fit: &Fit,
        known: Option<&Self>,
    ) -> Option<(Self, Vec<Vec<f64>>)> {
        let row_s = ctx.problem.base.sample_s;
        let spread_s = known.map_or(SPREAD_ROWS * row_s, |known| known.sd_s);
        let speeds = speeds(ctx, fit, spread_s);
        let (residual, _) = ctx.residual(fit);
        let left = Left {
            ctx,
            residual: &residual,
            speeds: &speeds,
        };
        let (low, high) = (RANGE_ROWS.0 * row_s, RANGE_ROWS.1 * row_s);
        let (sd_s, late) = least(low, high, |sd_s| left.unlikelihood(Of::Frame, sd_s));
        // Rivals with as many numbers: a motion that is wrong by a share of itself, and noise of another size everywhere.
        let (_, wrong) = least(low, high, |sd_s| left.unlikelihood(Of::Motion, sd_s));
        let rival = wrong.min(left.unlikelihood_of_size());
        let gain = (rival - late) / left.tails(sd_s);
        // What chance makes of all that is looked for, and the price of a number.
        let least_gain = CHANCE_SD * CHANCE_SD + NUMBER;
        // A set that was found beside other noise may be off. Beside this one it leaves nothing but lateness, or there is none.
        if gain < least_gain || known.is_some() && !left.independent(sd_s) {
            return None;
        }
        let (sd_s, sd_error_s) = left.joint(sd_s)?;
        let found = Self {
            up_to_s: EVEN * sd_s,
            error_s: EVEN * sd_error_s,
            sd_s,
            sd_error_s,
            gain,
            delays: false,
            open: false,
        };
        let delay_error_s = left.delay_error_s(&fit.innovations);
        let found = found.beside_delay(ctx, fit, (known, delay_error_s));
        Some((found, speeds))
    }

    /// The same with what the delay of a set says. If that is the mean of the lateness within both errors, one number is behind both, and
    /// the delay tells it better.
    fn beside_delay(
        self,
        ctx: &Context<'_>,
        fit: &Fit,
        (known, delay_error_s): (Option<&Self>, f64),
    ) -> Self {
        let known = known.filter(|known| known.delays);
        let mut delay = known.map(|known| (0.5 * known.up_to_s, 0.5 * known.error_s));
        for (i, part) in fit.parts.iter().enumerate() {
            if let Action::Delay(delay_s) = part.effect(&ctx.scope).act() {
                let slope = part.variant().params[0];
                let at = fit.numbers_before(i);
                let sd = fit.covariance[(at, at)].max(0.0).sqrt();
                let error_s = if slope.log { delay_s * sd } else { sd }.max(delay_error_s);
                delay = Some((delay_s + delay.map_or(0.0, |(known_s, _)| known_s), error_s));
            }
        }
        let Some((delay_s, error_s)) = delay else {
            // What stands for a delay may be a lag, under noise that knows of no lateness.
            return Self {
                delays: true,
                open: true,
                ..self
            };
        };
        let (mean_s, mean_error_s) = (0.5 * self.up_to_s, 0.5 * self.error_s);
        let apart = delay_s - mean_s;
        if apart.abs() < 2.0 * mean_error_s.hypot(error_s) {
            return Self {
                up_to_s: 2.0 * delay_s,
                error_s: 2.0 * error_s,
                delays: true,
                ..self
            };
        }
        Self {
            delays: apart > 0.0,
            ..self
        }
    }
}

/// Speed of the bead at every frame by the simulation, over times that spread by this much to both sides \[um/s\].
fn speeds(ctx: &Context<'_>, fit: &Fit, spread_s: f64) -> Vec<Vec<f64>> {
    let all = ctx.problem.all();
    let at = |late_s: f64| {
        let mut fixed = ctx.fixed.clone();
        fixed.push(effects::frame_jitter_mean(2.0 * late_s));
        let shifted = Context {
            fixed,
            ..ctx.clone()
        };
        shifted.simulated(&fit.parts, fit.offset_um, &all)
    };
    let (early, late) = (at(-spread_s), at(spread_s));
    let of = |(early, late): (&Vec<f64>, &Vec<f64>)| {
        let speed = |(a, b): (&f64, &f64)| fit.gain * (a - b) / (2.0 * spread_s);
        early.iter().zip(late).map(speed).collect()
    };
    early.iter().zip(&late).map(of).collect()
}

/// What is in proportion to the speed.
#[derive(Clone, Copy)]
enum Of {
    /// The error of a position.
    Frame,
    /// What the walk gains in a row.
    Motion,
}

/// What a fit leaves, and the speeds there.
struct Left<'a> {
    ctx: &'a Context<'a>,
    residual: &'a [Vec<f64>],
    speeds: &'a [Vec<f64>],
}

impl Left<'_> {
    fn records(&self) -> impl Iterator<Item = (&Prepared, &Vec<f64>, &Vec<f64>)> {
        let records = self.ctx.problem.records.iter();
        let left = records.zip(self.residual).zip(self.speeds);
        left.map(|((r, left), v)| (r, left, v))
    }

    /// Noise of the rows of a record with a lateness of this standard deviation.
    fn rows(of: Of, r: &Prepared, speeds: &[f64], sd_s: f64) -> RowNoise {
        let own = speeds.iter().map(|v| (v * sd_s).powi(2));
        let mut walk = r.row_noise.walk.clone();
        match of {
            Of::Frame => RowNoise {
                walk,
                white: Some(own.collect()),
            },
            Of::Motion => {
                let all = walk.get_or_insert_with(|| vec![0.0; speeds.len()]);
                all.iter_mut().zip(own).for_each(|(w, own)| *w += own);
                RowNoise { walk, white: None }
            }
        }
    }

    /// Innovations of all records under a noise, and the logarithm of the determinant of their covariance.
    fn innovations(&self, noise: &NoiseModel, of: Of, sd_s: f64) -> (Vec<Vec<f64>>, f64) {
        let mut sum = 0.0;
        let all = self.records().map(|(r, left, v)| {
            let rows = Self::rows(of, r, v, sd_s);
            let (e, log_determinant) = r.innovations(noise, &rows, left);
            sum += log_determinant;
            e
        });
        (all.collect(), sum)
    }

    /// Twice the negative log-likelihood.
    fn unlikelihood(&self, of: Of, sd_s: f64) -> f64 {
        self.unlikelihood_under(&self.ctx.problem.noise, of, sd_s)
    }

    fn unlikelihood_under(&self, noise: &NoiseModel, of: Of, sd_s: f64) -> f64 {
        let (e, log_determinant) = self.innovations(noise, of, sd_s);
        e.iter().map(|e| dot(e, e)).sum::<f64>() + log_determinant
    }

    /// The same without any lateness, the size of the noise by maximum likelihood.
    fn unlikelihood_of_size(&self) -> f64 {
        let (e, log_determinant) = self.innovations(&self.ctx.problem.noise, Of::Frame, 0.0);
        let count = self.ctx.problem.count(&self.ctx.problem.all()).max(1) as f64;
        let squares: f64 = e.iter().map(|e| dot(e, e)).sum();
        log_determinant + count * (1.0 + (squares / count).ln())
    }

    /// By how much more the squares of the innovations scatter than those of normal ones: a gain by them is worth as much less.
    fn tails(&self, sd_s: f64) -> f64 {
        let (e, _) = self.innovations(&self.ctx.problem.noise, Of::Frame, sd_s);
        let of = |power: i32| -> f64 { e.iter().flatten().map(|e| e.powi(power)).sum() };
        let count = self.ctx.problem.count(&self.ctx.problem.all()).max(1) as f64;
        let (squares, fourths) = (of(2) / count, of(4) / count);
        (0.5 * (fourths / (squares * squares).max(f64::MIN_POSITIVE) - 1.0)).max(1.0)
    }

    /// Whether the lateness of a frame says nothing of that of the next ones, nor of any mean.
    fn independent(&self, sd_s: f64) -> bool {
        let (e, _) = self.innovations(&self.ctx.problem.noise, Of::Frame, sd_s);
        // The part of each innovation that lateness has, with the sign of the speed. White noise alone is no measure: an exposure takes as much
        // of the walk off as there is of it.
        let floor_um2 = self.ctx.problem.noise.innovation_um().powi(2);
        let rest = self.records().zip(&e).map(|((.., v), e)| {
            let share = |v: &f64| v * sd_s / ((v * sd_s).powi(2) + floor_um2).sqrt();
            let rest = v.iter().zip(e).map(|(v, e)| share(v) * e);
            rest.collect::<Vec<f64>>()
        });
        let rest: Vec<Vec<f64>> = rest.collect();
        (1..=APART).all(|apart| {
            let (mut sum, mut squares) = (0.0, 0.0);
            for row in &rest {
                for (a, b) in row.iter().zip(row.iter().skip(apart)) {
                    sum += a * b;
                    squares += a * a * b * b;
                }
            }
            sum.abs() < CHANCE_SD * squares.sqrt()
        })
    }

    /// Standard error of a delay \[s\], whatever the innovations' variances are (White's estimate).
    fn delay_error_s(&self, innovations: &[Vec<f64>]) -> f64 {
        let (mut squares, mut scatter) = (0.0, 0.0);
        for ((r, _, v), e) in self.records().zip(innovations) {
            for (column, e) in r.whitened(v).iter().zip(e) {
                squares += column * column;
                scatter += (column * e).powi(2);
            }
        }
        scatter.sqrt() / f64::max(squares, f64::MIN_POSITIVE)
    }

    /// The standard deviation together with the sizes of walk and white noise, from `sd_s` on, and its standard error \[s\]. A rest of some
    /// seconds tells these sizes to some percent, and what they are wrong by would be taken for lateness.
    fn joint(&self, sd_s: f64) -> Option<(f64, f64)> {
        const ROUNDS: usize = 3;
        const STEPS: [f64; 3] = [0.05, 0.02, 0.02];
        let noise = &self.ctx.problem.noise;
        let variance_um2 = noise.walk_um2 + 2.0 * noise.white_um2;
        let value = |x: Vector3<f64>| {
            let noise = NoiseModel {
                walk_um2: noise.walk_um2 + x[1] * variance_um2,
                white_um2: noise.white_um2 + x[2] * variance_um2,
                ..*noise
            };
            self.unlikelihood_under(&noise, Of::Frame, sd_s * x[0].exp())
        };
        let step = |i: usize| Vector3::ith(i, STEPS[i]);
        let mut x = Vector3::zeros();
        let mut covariance = Matrix3::zeros();
        for _ in 0..ROUNDS {
            let here = value(x);
            let slope = Vector3::from_fn(|i, _| {
                (value(x + step(i)) - value(x - step(i))) / (2.0 * STEPS[i])
            });
            let bend = Matrix3::from_fn(|i, j| {
                let way = step(i) + if i == j { Vector3::zeros() } else { step(j) };
                value(x + way) + value(x - way) - 2.0 * here
            });
            let bend = Matrix3::from_fn(|i, j| match i == j {
                true => bend[(i, i)] / (STEPS[i] * STEPS[i]),
                false => {
                    let both = bend[(i, j)] - bend[(i, i)] - bend[(j, j)];
                    0.5 * both / (STEPS[i] * STEPS[j])
                }
            });
            covariance = bend.cholesky()?.inverse();
            x -= covariance * slope;
            // Beyond that the likelihood is no parabola.
            if x[0].is_nan() || x[0].abs() > 0.5 {
                return None;
            }
        }
        let sd_s = sd_s * x[0].exp();
        // Of twice the log-likelihood, half the bend is the information.
        let relative = (2.0 * covariance[(0, 0)] * self.tails(sd_s)).sqrt();
        Some((sd_s, sd_s * relative))
    }
}

/// Where a function of a scale is least, and its value there. Steps of a factor of two, then the golden section.
fn least(low: f64, high: f64, value: impl Fn(f64) -> f64) -> (f64, f64) {
    const TOLERANCE: f64 = 7e-3;
    let steps = (high / low).log2().ceil() as i32;
    let coarse = (0..=steps).map(|i| low * 2f64.powi(i));
    let best = coarse
        .map(|x| (x, value(x)))
        .min_by(|a, b| a.1.total_cmp(&b.1));
    let at = best.map_or(low, |(x, _)| x).ln();
    let (a, b) = (at - std::f64::consts::LN_2, at + std::f64::consts::LN_2);
    let x = golden_section(a, b, TOLERANCE, |x| value(x.exp())).exp();
    (x, value(x))
}
