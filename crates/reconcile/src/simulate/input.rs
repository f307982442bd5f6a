//! The inputs of a record's chain, and their course between the rows.

use super::camera::Sampling;

/// The inputs of a record's chain.
#[derive(Clone, Copy)]
pub(crate) struct Input<'a> {
    /// Displacement from the working point \[um\].
    pub u: &'a [f64],
    pub sampling: &'a Sampling,
    /// Further motion of the bead, as the displacement that has the same effect \[um\]; empty: nothing.
    ///
    /// A linear plant turns it into noise, which is left out. Blocks behind the plant see it, because they act on the flow.
    pub flow_um: &'a [f64],
}

impl<'a> Input<'a> {
    /// Displacement alone.
    pub(crate) fn new(u: &'a [f64], sampling: &'a Sampling) -> Self {
        Self {
            u,
            sampling,
            flow_um: &[],
        }
    }
}

/// Rate limit, from a rest at `at`; each step holds the mean of the ramp over the step, so that its integral is exact.
pub(crate) fn slew(x: &mut [f64], rate: f64, h: f64, mut at: f64) {
    let most = rate * h;
    for v in x.iter_mut() {
        let d = (*v - at).clamp(-most, most);
        let share = if most > 0.0 { d.abs() / most } else { 0.0 };
        // The ramp takes `share` of the step, then rests at its end.
        *v = at + d * (1.0 - 0.5 * share);
        at += d;
    }
}
