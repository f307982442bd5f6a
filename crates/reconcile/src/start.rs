//! What a record does not tell about the time before it.

use crate::data::motion::FlowPaths;
use crate::data::noise::NoiseModel;
use crate::simulate::Base;

/// Start of a record that begins in motion, which is not scored \[s\].
const RUN_IN_S: f64 = 0.5;

/// Whether the command before a record, which nobody knows, shows in the record. A simulation begins at rest and jumps to the first command:
/// lags, resonances and a delay would answer a step that never came.
///
/// How a sampled analogue input came to its first sample is never known. The command before a held input shows if the first command moves
/// the bead in a row by more than a third of the noise, because a delay may be three rows long. Where the start of the plant is free, it
/// explains what came before.
fn begins_in_motion(base: &Base, u: &[f64], noise: &NoiseModel) -> bool {
    let first_um = u.first().copied().unwrap_or(0.0);
    let moved_um = base.speed_per_um() * base.sample_s * first_um.abs();
    base.interpolated_input || !base.free_start && moved_um > noise.innovation_um() / 3.0
}

/// Rows at the start of a record that are not scored.
pub(crate) fn run_in(base: &Base, u: &[f64], noise: &NoiseModel) -> usize {
    match begins_in_motion(base, u, noise) {
        true => ((RUN_IN_S / base.sample_s) as usize).min(u.len() / 10),
        false => 0,
    }
}

/// Free motions of a record. With an unknown working point: the motion of a wrong zero flow. For a plant that did not rest before
/// the record: the decays of its poles.
pub(crate) fn transients(base: &Base, flow: &FlowPaths, rows: usize) -> Vec<Vec<f64>> {
    let mut all = Vec::new();
    if base.free_working_point {
        all.push(flow.off.clone());
    }
    if !base.free_start {
        return all;
    }
    let (dt, length_s) = (base.sample_s, rows as f64 * base.sample_s);
    for p in &base.zpk.poles {
        // Slower is a level, faster is over at once.
        if p.im < 0.0 || p.norm() * length_s < 0.05 || -p.re * dt > 5.0 {
            continue;
        }
        let decay = |f: fn(f64) -> f64| -> Vec<f64> {
            (0..rows)
                .map(|k| {
                    let t = k as f64 * dt;
                    (p.re * t).exp() * f(p.im * t)
                })
                .collect()
        };
        all.push(decay(f64::cos));
        if p.im > 0.0 {
            all.push(decay(f64::sin));
        }
    }
    all
}
