//! State feedback on the estimator's prediction of the present: the law of LQG, and that of MPC without constraints.
//!
//! State: the deviation of `(q, x_1, x_2, u_(k-1) - n)` from the model that is driven along the reference by the
//! feed-forward command `u_f`. `u_k = n + u_f - F s`, so that the drift state (neutral) takes the place of an integrator. With
//! the estimator's prediction over the delay this is a Smith predictor that also knows Brownian motion and drift.

use crate::deviation::{DEVIATION, Deviation};
use crate::error::{BuildError, check};
use crate::estimator::{Estimator, EstimatorConfig, PredictedState};
use crate::feedforward::FeedForwardState;
use crate::law::{ControlLaw, LawInput, LawOutput};
use crate::linear::LinearLaw;
use crate::loop_model::{LoopModel, MODES};
use crate::riccati::{kalman_gain, lq_feedback};
use nalgebra::{DMatrix, DVector, RowDVector};
use serde::{Deserialize, Serialize};

/// Configuration of the LQG controller.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Lqg {
    /// Weight of the motion that a command causes by the next tick, relative to the position error: 0.05 is close to minimum
    /// variance, 10 is cautious; 3.8 is stable for twice the gain with one more frame of delay where every tick has a frame, however
    /// exact the fixes. [`Lqg::for_path`] finds that of other paths.
    pub effort: f64,
}

impl Default for Lqg {
    fn default() -> Self {
        Self { effort: 3.8 }
    }
}

impl Lqg {
    /// Checks the weight.
    ///
    /// # Errors
    /// [`BuildError::OutOfRange`].
    pub fn validate(&self) -> Result<(), BuildError> {
        check_effort(self.effort)
    }

    /// The feedback for a plant.
    ///
    /// # Errors
    /// A weight out of range, or a Riccati equation without solution.
    pub fn feedback(&self, model: &LoopModel) -> Result<Feedback, BuildError> {
        self.validate()?;
        let d = Deviation::new(model);
        let weight = self.effort * d.costed_um().powi(2);
        let (f, _) = lq_feedback(&d.a, &d.b, &(d.c.transpose() * &d.c), weight)?;
        Ok(Feedback {
            gains: std::array::from_fn(|i| f[i]),
        })
    }
}

/// Refuses a weight of commands that no problem has.
pub(crate) fn check_effort(effort: f64) -> Result<(), BuildError> {
    let usable = (1e-4..=1e4).contains(&effort);
    check("effort", "", effort, usable, "0.0001 to 10000")
}

/// Gains F on the deviation state.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Feedback {
    pub(crate) gains: [f64; DEVIATION],
}

/// The deviation of a predicted state from the model on the reference.
pub(crate) fn deviation(now: &PredictedState, on: &FeedForwardState) -> [f64; DEVIATION] {
    let mut s = [0.0; DEVIATION];
    s[0] = now.q - on.integrator_um;
    for i in 0..MODES {
        s[1 + i] = now.modes[i] - on.modes[i];
    }
    s[DEVIATION - 1] = now.last_um - now.n - on.last_um;
    s
}

impl Feedback {
    /// `-F s`, um of PZT from neutral.
    pub(crate) fn correction(&self, s: &[f64; DEVIATION]) -> f64 {
        -self.gains.iter().zip(s).map(|(f, s)| f * s).sum::<f64>()
    }

    /// The linear equivalent of estimator and feedback, with the estimator's steady-state gain.
    ///
    /// # Errors
    /// A delay that the estimator cannot hold, or a Riccati equation without solution.
    pub fn linear(
        &self,
        estimator: &EstimatorConfig,
        model: &LoopModel,
    ) -> Result<LinearLaw, BuildError> {
        let filter = Estimator::new(*estimator, *model)?;
        let (k, h) = (
            steady_gain(estimator, model, &filter)?,
            filter.delay_ticks(),
        );
        // State: q, n, modes at the filter's time; then u_(k-1) .. u_(k-h-1). Every operation is linear, so that its
        // matrices are its responses to unit vectors.
        let n = 2 + MODES + h + 1;
        let step = |x: &DVector<f64>, y: f64| -> (DVector<f64>, f64) {
            let command = |ago: usize| x[1 + MODES + ago];
            let mut modes = [0.0; MODES];
            modes
                .iter_mut()
                .enumerate()
                .for_each(|(i, m)| *m = x[2 + i]);
            let m = PredictedState {
                q: x[0],
                n: x[1],
                modes,
                last_um: 0.0,
            };
            let mut m = filter.tick_state(&m, command(h + 1));
            let innovation = y - filter.position_measured(&m, if h > 0 { command(h) } else { 0.0 });
            m.q += k[0] * innovation;
            m.n += k[1] * innovation;
            let mut next = DVector::zeros(n);
            (next[0], next[1]) = (m.q, m.n);
            next.rows_mut(2, MODES).copy_from_slice(&m.modes);
            for ago in (1..=h).rev() {
                m = filter.tick_state(&m, command(ago));
            }
            let u = m.n + self.correction(&deviation(&m, &FeedForwardState::default()));
            next[2 + MODES] = u;
            for ago in 1..=h {
                next[2 + MODES + ago] = command(ago);
            }
            (next, u)
        };
        let mut a = DMatrix::zeros(n, n);
        let mut c = RowDVector::zeros(n);
        for j in 0..n {
            let mut unit = DVector::zeros(n);
            unit[j] = 1.0;
            let (next, u) = step(&unit, 0.0);
            a.set_column(j, &next);
            c[j] = -u;
        }
        let (b, u) = step(&DVector::zeros(n), 1.0);
        Ok(LinearLaw::StateSpace { a, b, c, d: -u })
    }
}

/// Steady-state gains of the estimator on position and neutral.
fn steady_gain(
    config: &EstimatorConfig,
    model: &LoopModel,
    filter: &Estimator,
) -> Result<DVector<f64>, BuildError> {
    let ts = model.sample_time_s;
    let a = DMatrix::from_row_slice(2, 2, &[1.0, -model.gain_per_s * ts, 0.0, 1.0]);
    let h = DVector::from_vec(vec![1.0, filter.neutral_sensitivity()]);
    // Without any walk neutral would be learned once and for all, and the equation has no stabilising solution.
    let walk = config.neutral_walk_um_per_sqrt_s.powi(2).max(1e-10);
    let q = DMatrix::from_diagonal(&DVector::from_vec(vec![
        2.0 * config.diffusion_um2_per_s * ts,
        walk * ts,
    ]));
    kalman_gain(
        &a,
        &h,
        &q,
        config.fix_noise_um.powi(2) / config.ltr_noise_scaling,
    )
}

/// The LQG law: feedback of the estimator's state.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LqgLaw {
    feedback: Feedback,
}

/// State of [`LqgLaw`]: nothing but what is recorded.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LqgState {
    feed_forward_um: f64,
}

impl LqgLaw {
    /// The law for a plant.
    ///
    /// # Errors
    /// A weight out of range, or a Riccati equation without solution.
    pub fn new(config: &Lqg, model: &LoopModel) -> Result<Self, BuildError> {
        Ok(Self {
            feedback: config.feedback(model)?,
        })
    }
}

impl ControlLaw for LqgLaw {
    type State = LqgState;

    fn start(&self, _command_um: f64) -> LqgState {
        LqgState::default()
    }

    fn step(&self, state: &mut LqgState, input: &LawInput) -> LawOutput {
        state.feed_forward_um = input.feed_forward_um;
        let deviation = deviation(&input.estimate.now, &input.on_path);
        LawOutput::wish(input.estimate.neutral_um + self.feedback.correction(&deviation))
    }

    fn columns(&self) -> &'static [&'static str] {
        &["lqg_feed_forward_um"]
    }

    fn record(&self, state: &LqgState, out: &mut [f32]) {
        if let Some(value) = out.first_mut() {
            *value = state.feed_forward_um as f32;
        }
    }
}
