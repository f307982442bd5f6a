//! What drives the chain of a record, and how it goes on between the rows.

use super::camera::Sampling;

/// What a record's chain is driven by.
#[derive(Clone, Copy)]
pub(crate) struct Input<'a> {
    /// Displacement from the working point \[um\].
    pub u: &'a [f64],
    pub sampling: &'a Sampling,
    /// What carries the bead beside it, as the displacement that does the same \[um\]; empty: nothing.
    ///
    /// What a linear plant makes of it is noise and left out: blocks behind the plant see it, for they act on the flow.
    pub flow_um: &'a [f64],
}

impl<'a> Input<'a> {
    /// With nothing beside the displacement.
    pub(crate) fn new(u: &'a [f64], sampling: &'a Sampling) -> Self {
        Self {
            u,
            sampling,
            flow_um: &[],
        }
    }
}

/// Rate limit; each step holds the mean of the ramp over the step, so that its integral is exact.
pub(super) fn slew(x: &mut [f64], rate: f64, h: f64) {
    let most = rate * h;
    let mut at = 0.0f64;
    for v in x.iter_mut() {
        let d = (*v - at).clamp(-most, most);
        let share = if most > 0.0 { d.abs() / most } else { 0.0 };
        // The ramp takes `share` of the step, then rests at its end.
        *v = at + d * (1.0 - 0.5 * share);
        at += d;
    }
}

/// The mean over each step of a line through the values at the steps' ends: what a plant without a direct path answers to.
pub(super) fn middle(x: &mut [f64]) {
    let mut before = x.first().copied().unwrap_or(0.0);
    for v in x.iter_mut() {
        (before, *v) = (*v, 0.5 * (before + *v));
    }
}

/// Between the samples, straight lines, or (`smooth`) cubics whose slope at a sample is that of its neighbours, which take far
/// less from the fast part of an analogue input; each step of the grid holds the value at its end, so that a plant without dynamics
/// is exact at the samples.
pub(super) fn interpolate(u: &[f64], fine: usize, smooth: bool) -> Vec<f64> {
    let mut x = Vec::with_capacity(u.len() * fine);
    for k in 0..u.len() {
        let next = u.get(k + 1).copied().unwrap_or(u[k]);
        for i in 0..fine {
            let f = (i as f64 + 1.0) / fine as f64;
            let line = u[k] + f * (next - u[k]);
            x.push(if smooth {
                let before = u[k.saturating_sub(1)];
                let after = u.get(k + 2).copied().unwrap_or(next);
                // The cubic through both samples with half the neighbours' difference as slope, less the line.
                let (a, b) = (0.5 * (next - before), 0.5 * (after - u[k]));
                let d = next - u[k];
                line + f * (1.0 - f) * ((1.0 - f) * (a - d) - f * (b - d))
            } else {
                line
            });
        }
    }
    x
}
