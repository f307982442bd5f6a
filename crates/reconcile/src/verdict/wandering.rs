//! A zero flow that wanders by more than that of any rig: it is there at rest, too.

use crate::data::noise::NoiseModel;
use crate::data::zero_flow::Prior;
use crate::fit::context::{Context, Fit};
use crate::problem::{Prepared, Problem};
use crate::thresholds::NUMBER;

/// How a zero flow wanders.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Wandering {
    /// RMS of the flow \[um/s\], and standard error of its logarithm.
    pub um_per_s: (f64, f64),
    /// Its correlation time \[s\], and standard error of its logarithm.
    pub time_s: (f64, f64),
    /// Gain over the zero flow of a rig, in twice the log-likelihood.
    pub gain: f64,
}

/// Prior of the zero flow of the problem's rig.
pub(crate) fn prior_of(problem: &Problem) -> Prior {
    let of_rig = Prior::new(problem.base.speed_per_um(), problem.base.sample_s);
    if problem.wanders {
        of_rig.of_wandering()
    } else {
        of_rig
    }
}

/// Whether a flow that wanders explains what a set leaves better than the zero flow of a rig does, where the command rests as elsewhere. What
/// a wrong equation leaves is slow, too, but it is where the command moves the bead.
pub(crate) fn suspected(ctx: &Context<'_>, fit: &Fit) -> bool {
    let problem = ctx.problem;
    if !problem.records.iter().any(|r| r.rest) {
        return false;
    }
    let (residual, _) = ctx.residual(fit);
    let of_rig = prior_of(problem);
    let of_wandering = of_rig.of_wandering();
    let unlikelihood = |noise: &NoiseModel| problem.unlikelihood(noise, &residual);
    let wandering = of_wandering.estimate(&problem.noise, unlikelihood);
    let cost =
        |prior: Prior, noise: &NoiseModel| unlikelihood(noise) + prior.price(noise, unlikelihood);
    let at_rest = |noise: &NoiseModel| -> f64 {
        let records = problem.records.iter().zip(&residual);
        let at_rest = records.filter(|(r, _): &(&Prepared, _)| r.rest);
        at_rest.map(|(r, e)| r.unlikelihood(noise, e)).sum()
    };
    cost(of_rig, &problem.noise) - cost(of_wandering, &wandering) > NUMBER
        && at_rest(&problem.noise) > at_rest(&wandering)
}

impl Wandering {
    /// That of a fit under noise with a flow that wanders; `gain` is what it gains over the zero flow of a rig.
    pub(crate) fn of(ctx: &Context<'_>, fit: &Fit, gain: f64) -> Option<Self> {
        let problem = ctx.problem;
        let z = problem.noise.zero_flow?;
        let (residual, _) = ctx.residual(fit);
        let unlikelihood = |noise: &NoiseModel| problem.unlikelihood(noise, &residual);
        let [of_size, of_time] = prior_of(problem).errors(&problem.noise, unlikelihood);
        let row_s = problem.base.sample_s;
        Some(Self {
            um_per_s: (z.motion_um2.sqrt() / row_s, of_size),
            time_s: (z.time_rows * row_s, of_time),
            gain,
        })
    }
}
