//! The zero flow in a record: its most probable path, from the residual of a fit.
//!
//! Effects of a bead (sticking, another gain outward than inward, a gain that changes) act on the flow that carries it: command
//! less zero flow. In a closed loop the command follows the zero flow, and that motion is larger than many effects.

use crate::data::free::Free;
use crate::data::motion::FlowPaths;
use crate::data::noise::NoiseModel;
use crate::data::whitener::Whitener;
use crate::dot::dot;

/// Mean motion of the bead in every row \[um\] that a noise's zero flow makes, given a residual \[um\]; empty without such a flow.
///
/// `off` says that a zero flow that is off may be of any size: then it is the first of the free motions.
pub(crate) fn motion_um(
    noise: &NoiseModel,
    (whitener, free): (&Whitener, &Free),
    paths: &FlowPaths,
    off: bool,
    residual: &[f64],
) -> Vec<f64> {
    let Some(z) = noise.zero_flow else {
        return Vec::new();
    };
    let rows = residual.len();
    let mut e = vec![0.0; rows];
    whitener.apply(residual, &mut e);
    let raw = e.clone();
    free.weigh(&mut e);
    // The residual times the inverse of its covariance: by its covariance with the residual any part of the noise follows.
    let x = whitener.transpose(&e);
    let mut motion = vec![0.0; rows];
    // A motion acts on all rows after its own.
    let mut later = 0.0;
    for (m, x) in motion.iter_mut().zip(&x).rev() {
        *m = z.motion_um2 * later;
        later += x;
    }
    if let Some(chip) = z.loss {
        chip.transpose(&mut motion);
    }
    correlate(&mut motion, z.keep());
    let middle = 0.5 * (rows as f64 - 1.0);
    let drifts = z.drift_um.powi(2) * dot(&paths.drift, &x);
    let mut wrong = (z.drift_um * rows as f64).powi(2) * dot(&paths.off, &x);
    for (k, m) in motion.iter_mut().enumerate() {
        *m += drifts * (k as f64 - middle);
    }
    if off {
        // Of any size: the best fit next to the rest.
        let mut at = 0.0;
        let known: Vec<f64> = (motion.iter())
            .map(|m| {
                let before = at;
                at += m;
                before
            })
            .collect();
        let mut of_known = vec![0.0; rows];
        whitener.apply(&known, &mut of_known);
        let left: Vec<f64> = raw.iter().zip(&of_known).map(|(e, k)| e - k).collect();
        wrong = free.size_of_first(&left);
    }
    motion.iter_mut().for_each(|m| *m += wrong);
    motion
}

/// Sums over all rows, each times `keep` to the power of its distance.
fn correlate(values: &mut [f64], keep: f64) {
    let mut before = 0.0;
    let ahead: Vec<f64> = (values.iter())
        .map(|v| {
            before = keep * before + v;
            before
        })
        .collect();
    let mut after = 0.0;
    for (v, ahead) in values.iter_mut().zip(ahead).rev() {
        let own = *v;
        *v = ahead + keep * after;
        after = own + keep * after;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::motion::ZeroFlow;
    use crate::data::row_noise::RowNoise;

    fn noise() -> NoiseModel {
        NoiseModel {
            zero_flow: Some(ZeroFlow {
                motion_um2: 4e-6,
                time_rows: 4000.0,
                drift_um: 1e-6,
                loss: None,
            }),
            ..NoiseModel::new(0.33, 1e-3, 0.030)
        }
    }

    /// Motions whose sum is the residual, without other noise.
    fn recovered(motions: &[f64], off: bool) -> Vec<f64> {
        recovered_beside(&RowNoise::default(), motions, off)
    }

    /// The same beside noise of single rows.
    fn recovered_beside(beside: &RowNoise, motions: &[f64], off: bool) -> Vec<f64> {
        let mut at = 0.0;
        let residual: Vec<f64> = (motions.iter())
            .map(|m| {
                let before = at;
                at += m;
                before
            })
            .collect();
        let rows = motions.len();
        let noise = noise();
        let whitener = Whitener::new(&noise, &vec![true; rows], beside);
        let paths = FlowPaths::new((0..rows).map(|k| k as f64).collect());
        let transients = if off { vec![paths.off.clone()] } else { vec![] };
        let free = Free::new(&noise, &whitener, &transients, &paths, &[]);
        motion_um(&noise, (&whitener, &free), &paths, off, &residual)
    }

    #[test]
    fn the_path_of_a_zero_flow_is_found_whether_it_wanders_drifts_or_is_off() {
        // 5 nm a row about nothing; then 1e-6 um more in every row; then an offset of 30 nm a row, which is free.
        let rows = 20_000;
        // The share of a slow sine that differs from the walk: the power of the zero flow there over that of both.
        let noise = noise();
        let z = noise.zero_flow.expect("a zero flow");
        let power = 2.0 * z.motion_um2 * z.time_rows / (1.0 + (z.time_rows / 1500.0).powi(2));
        let told = power / (power + noise.walk_um2);
        for (drift, wrong) in [(0.0, 0.0), (1e-6, 0.0), (1e-6, 0.03)] {
            let path = |size: f64| -> Vec<f64> {
                let at = |k| {
                    let t = f64::from(k);
                    size * (t / 1500.0).sin() + drift * (t - 10_000.0) + wrong
                };
                (0..rows).map(at).collect()
            };
            let found = recovered(&path(0.005), wrong != 0.0);
            let right = path(0.005 * told);
            for k in [5_000, 7_000, 10_000, 13_000, 15_000] {
                let (found, right) = (found[k], right[k]);
                assert!((found - right).abs() < 3e-4, "{k}: {found} {right}");
            }
        }
    }

    #[test]
    fn where_the_bead_does_not_follow_the_flow_goes_on_as_before_and_after() {
        let rows = 20_000;
        let stuck = 9_700..10_300;
        let flow = |k: usize| 0.005 * (k as f64 / 1500.0).cos();
        // The bead does not move, and that says nothing.
        let seen: Vec<f64> = (0..rows)
            .map(|k| if stuck.contains(&k) { 0.0 } else { flow(k) })
            .collect();
        let anywhere = |k: usize| if stuck.contains(&k) { 1.0 } else { 0.0 };
        let blind = RowNoise {
            walk: Some((0..rows).map(anywhere).collect()),
            white: None,
        };
        let middle = 10_000;
        let (told, misled) = (
            recovered_beside(&blind, &seen, false)[middle],
            recovered(&seen, false)[middle],
        );
        // Both know no more than the noise lets them.
        let [told, misled] = [told, misled].map(|flow_um| flow_um / flow(middle));
        assert!((0.7..1.0).contains(&told), "{told}");
        assert!(misled < 0.5, "{misled}");
    }

    #[test]
    fn sums_with_a_memory_are_those_of_the_definition() {
        let mut values = [1.0, -2.0, 0.5, 3.0];
        let direct: Vec<f64> = (0..4i32)
            .map(|i| {
                (values.iter().enumerate())
                    .map(|(j, v)| v * 0.7f64.powi((i - j as i32).abs()))
                    .sum()
            })
            .collect();
        correlate(&mut values, 0.7);
        for (v, d) in values.iter().zip(direct) {
            assert!((v - d).abs() < 1e-12);
        }
    }
}
