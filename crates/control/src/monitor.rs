//! On-line estimate of the plant's gain and lag from the loop's own motion, and what its changes are called.
//!
//! The increments of the measured position are regressed on those that the model predicts from the commands in force,
//! on the change of these from tick to tick, and on a constant: `dy_k = c + g (dp_k - lag (dp_k - dp_(k-1)) / Ts)`. `g` is the
//! gain over the model's, a positive lag a pole that the model lacks. Increments, because Brownian motion makes positions a
//! random walk. Ticks in which the model predicts no motion to speak of are not counted and nothing is forgotten in
//! them, so that an estimate does not decay while the bead is held: the forgetting is by excitation. Where the loop is faster than its
//! camera the increments are those from fix to fix.
//!
//! A fast estimate (some 40 moving ticks) is held against a slow one (some 1000), so that a gain that was wrong from the
//! start is no alarm. It only watches: no command depends on it.

use crate::error::BuildError;
use crate::estimator::{Estimator, EstimatorConfig, HISTORY, PredictedState};
use crate::loop_model::LoopModel;
use serde::Serialize;

/// What became of the plant.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "kebab-case")]
#[repr(u8)]
pub enum PlantVerdict {
    /// As before.
    #[default]
    Normal = 0,
    /// The gain is gone: the bead does not follow.
    Stuck = 1,
    /// The gain fell and a lag came: gas in the line.
    Bubble = 2,
    /// The gain jumped without a lag: another cross-section.
    Constriction = 3,
}

impl PlantVerdict {
    /// The verdict of a number in a record.
    pub fn from_number(number: u8) -> Self {
        match number {
            1 => Self::Stuck,
            2 => Self::Bubble,
            3 => Self::Constriction,
            _ => Self::Normal,
        }
    }
}

/// Estimate of gain and lag.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlantEstimate {
    /// Gain over the model's.
    pub gain_ratio: f64,
    /// Its standard uncertainty.
    pub gain_sd: f64,
    /// Lag that the model lacks, ms.
    pub lag_ms: f64,
    /// Its standard uncertainty, ms.
    pub lag_sd_ms: f64,
}

/// Weighted sums of one regression.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Sums {
    n: f64,
    /// Sums of 1, p, q; products pp, pq, qq; yp, yq, y, yy.
    p: f64,
    q: f64,
    y: f64,
    pp: f64,
    pq: f64,
    qq: f64,
    py: f64,
    qy: f64,
    yy: f64,
}

const NOTHING: Sums = Sums {
    n: 0.0,
    p: 0.0,
    q: 0.0,
    y: 0.0,
    pp: 0.0,
    pq: 0.0,
    qq: 0.0,
    py: 0.0,
    qy: 0.0,
    yy: 0.0,
};

impl Sums {
    fn add(&mut self, keep: f64, p: f64, q: f64, y: f64) {
        let s = self;
        for (sum, value) in [
            (&mut s.n, 1.0),
            (&mut s.p, p),
            (&mut s.q, q),
            (&mut s.y, y),
            (&mut s.pp, p * p),
            (&mut s.pq, p * q),
            (&mut s.qq, q * q),
            (&mut s.py, p * y),
            (&mut s.qy, q * y),
            (&mut s.yy, y * y),
        ] {
            *sum = *sum * keep + value;
        }
    }

    /// Least squares with at least the variance `noise_um2` per increment.
    fn estimate(&self, noise_um2: f64, sample_ms: f64) -> Option<PlantEstimate> {
        let n = self.n;
        if n < 8.0 {
            return None;
        }
        let (pp, pq, qq) = (
            self.pp - self.p * self.p / n,
            self.pq - self.p * self.q / n,
            self.qq - self.q * self.q / n,
        );
        let (py, qy, yy) = (
            self.py - self.p * self.y / n,
            self.qy - self.q * self.y / n,
            self.yy - self.y * self.y / n,
        );
        let det = pp * qq - pq * pq;
        if det.is_nan() || det <= 1e-6 * pp * qq {
            return None;
        }
        let a = (py * qq - qy * pq) / det;
        let b = (qy * pp - py * pq) / det;
        let residual = (yy - a * py - b * qy).max(0.0) / (n - 3.0).max(1.0);
        let variance = residual.max(noise_um2);
        let (a_sd, b_sd) = ((variance * qq / det).sqrt(), (variance * pp / det).sqrt());
        // The lag is -b/a ticks; where the gain is gone it means nothing.
        let size = a.abs().max(0.2);
        Some(PlantEstimate {
            gain_ratio: a,
            gain_sd: a_sd,
            lag_ms: -b / size * sample_ms,
            lag_sd_ms: b_sd / size * sample_ms,
        })
    }
}

/// A monitor for one model. Immutable; the state is apart and `Copy`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlantMonitor {
    estimator: Estimator,
    /// From fix to fix.
    sample_ms: f64,
    /// Ticks in a row that may be without a fix.
    planned_gap: u32,
    noise_um2: f64,
    least_um: f64,
}

/// State of a [`PlantMonitor`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlantMonitorState {
    model: PredictedState,
    commands_um: [f64; HISTORY + 2],
    fast: Sums,
    slow: Sums,
    /// Increment of the model since the last fix, um, and ticks since.
    gathered_um: f64,
    silent: u32,
    predicted_um: Option<f64>,
    measured_um: Option<f64>,
    before_um: f64,
    verdict: PlantVerdict,
    /// Moving ticks in a row for which the present evidence has held.
    held: u8,
    candidate: PlantVerdict,
}

/// Moving ticks of the fast and of the slow estimate.
const FAST_TICKS: f64 = 40.0;
const SLOW_TICKS: f64 = 1000.0;
/// Moving ticks before the slow estimate counts.
const LEARNED_TICKS: f64 = 60.0;
/// Motion below this many standard deviations of an increment's noise is not counted.
const LEAST_SIGMA: f64 = 3.0;
/// Evidence must hold for this many moving ticks.
const HOLD_TICKS: u8 = 8;
/// Gain ratio below which the bead counts as stuck.
const STUCK_RATIO: f64 = 0.15;
/// Lag that makes a bubble, ms; half of it is no lag.
const BUBBLE_MS: f64 = 0.5;
/// Change of the gain that makes a constriction, as a factor.
const JUMP: f64 = 1.3;
/// Standard deviations that a change must exceed.
const SURE: f64 = 4.0;

impl PlantMonitor {
    /// A monitor for a model and the noise of its estimator.
    ///
    /// # Errors
    /// As [`Estimator::new`].
    pub fn new(config: EstimatorConfig, model: LoopModel) -> Result<Self, BuildError> {
        let apart_s = model.sample_time_s * config.ticks_per_fix;
        let walk = 2.0 * config.diffusion_um2_per_s * apart_s;
        let noise_um2 = walk + 2.0 * config.fix_noise_um.powi(2);
        Ok(Self {
            estimator: Estimator::new(config, model)?,
            sample_ms: apart_s * 1e3,
            planned_gap: config.planned_gap(),
            noise_um2,
            least_um: LEAST_SIGMA * noise_um2.sqrt(),
        })
    }

    /// A plant at rest at a command.
    pub fn start(&self, command_um: f64) -> PlantMonitorState {
        PlantMonitorState {
            model: PredictedState::default(),
            commands_um: [command_um; HISTORY + 2],
            fast: NOTHING,
            slow: NOTHING,
            gathered_um: 0.0,
            silent: 0,
            predicted_um: None,
            measured_um: None,
            before_um: 0.0,
            verdict: PlantVerdict::Normal,
            held: 0,
            candidate: PlantVerdict::Normal,
        }
    }

    /// The fast estimate, where there was motion enough.
    pub fn estimate(&self, state: &PlantMonitorState) -> Option<PlantEstimate> {
        state.fast.estimate(self.noise_um2, self.sample_ms)
    }

    /// The present verdict.
    pub fn verdict(&self, state: &PlantMonitorState) -> PlantVerdict {
        state.verdict
    }

    /// One tick: the fix that arrived (um; only one that is on time, `None` otherwise), the estimate of neutral, and the
    /// command that takes effect now. Gives the verdict.
    pub fn step(
        &self,
        state: &mut PlantMonitorState,
        measured_um: Option<f64>,
        neutral_um: f64,
        command_um: f64,
    ) -> PlantVerdict {
        let delay = self.estimator.delay_ticks();
        let command = |ago: usize| {
            state
                .commands_um
                .get(ago - 1)
                .copied()
                .unwrap_or(neutral_um)
        };
        // The model at the time of this tick's frame, driven by what was in force before it. Its position starts anew
        // each tick, so that nothing grows over hours: only the increment counts.
        let mut from = state.model;
        from.q = 0.0;
        from.n = neutral_um;
        from.last_um = command(delay + 2);
        let before = self.estimator.position_measured(&from, command(delay + 1));
        let to = self.estimator.tick_state(&from, command(delay + 1));
        let part = if delay > 0 {
            command(delay)
        } else {
            command_um
        };
        state.gathered_um += self.estimator.position_measured(&to, part) - before;
        state.model = to;
        state.commands_um.rotate_right(1);
        state.commands_um[0] = command_um;
        if measured_um.is_none() && state.silent < self.planned_gap {
            state.silent += 1;
            return state.verdict;
        }
        state.silent = 0;
        let increment_um = std::mem::take(&mut state.gathered_um);
        if let (Some(now), Some(last), Some(predicted)) =
            (measured_um, state.measured_um, state.predicted_um)
        {
            let curve_um = increment_um - predicted;
            if increment_um.abs().max(predicted.abs()) > self.least_um {
                self.weigh(state, increment_um, curve_um, now - last);
            }
        }
        state.measured_um = measured_um.filter(|um| um.is_finite());
        state.predicted_um = Some(increment_um).filter(|um| um.is_finite());
        state.verdict
    }

    fn weigh(
        &self,
        state: &mut PlantMonitorState,
        increment_um: f64,
        curve_um: f64,
        moved_um: f64,
    ) {
        let fast = 1.0 - 1.0 / FAST_TICKS;
        state.fast.add(fast, increment_um, curve_um, moved_um);
        let slow = 1.0 - 1.0 / SLOW_TICKS;
        let known = state.slow.n >= LEARNED_TICKS;
        let baseline = state
            .slow
            .estimate(self.noise_um2, self.sample_ms)
            .filter(|_| known);
        let Some(now) = self.estimate(state) else {
            state.slow.add(slow, increment_um, curve_um, moved_um);
            return;
        };
        let wanted = match baseline {
            Some(baseline) => judge(&now, &baseline),
            None => PlantVerdict::Normal,
        };
        if wanted == state.candidate {
            state.held = state.held.saturating_add(1);
        } else {
            state.candidate = wanted;
            state.held = 1;
        }
        if state.held >= HOLD_TICKS {
            state.verdict = wanted;
        }
        // What is under suspicion must not become the measure of itself.
        if wanted == PlantVerdict::Normal && state.verdict == PlantVerdict::Normal {
            state.slow.add(slow, increment_um, curve_um, moved_um);
        }
    }
}

/// The name of a change.
fn judge(now: &PlantEstimate, baseline: &PlantEstimate) -> PlantVerdict {
    let sure = |difference: f64, a: f64, b: f64| difference > SURE * a.hypot(b);
    let ratio = now.gain_ratio / baseline.gain_ratio.max(1e-3);
    let fall = baseline.gain_ratio - now.gain_ratio;
    let lag = now.lag_ms - baseline.lag_ms;
    if ratio < STUCK_RATIO && sure(fall, now.gain_sd, baseline.gain_sd) {
        return PlantVerdict::Stuck;
    }
    if lag > BUBBLE_MS && sure(lag, now.lag_sd_ms, baseline.lag_sd_ms) {
        return PlantVerdict::Bubble;
    }
    let jumped = !(1.0 / JUMP..=JUMP).contains(&ratio);
    // A smooth motion tells little of a lag: what may be one by chance is none.
    let lags = lag.abs() >= 0.5 * BUBBLE_MS && sure(lag.abs(), now.lag_sd_ms, baseline.lag_sd_ms);
    if jumped && !lags && sure(fall.abs(), now.gain_sd, baseline.gain_sd) {
        return PlantVerdict::Constriction;
    }
    PlantVerdict::Normal
}
