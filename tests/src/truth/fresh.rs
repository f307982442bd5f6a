//! How far a model carries: its free run over an excitation that was never fitted.

use super::cases::Case;
use super::{Hidden, Nuisance, Random, Rig, Second, Stranger, run, scripts};
use cellpos_plant::{Model, SimulateOptions};
use std::f64::consts::TAU;

/// A response whose free run is off by less than this has no gap to close \[um\]: the truth is rounded to 0.1 nm.
const NO_GAP_UM: f64 = 1e-3;

/// Part of the free run's RMS error that is gone with the augmented model, on a noise-free record.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fresh {
    /// About the mean. A model that integrates makes a ramp of a nanometre that a piezo remembers from before the record.
    pub plain: f64,
    /// About a straight line: the unknown start of the record is not part of the response.
    pub response: f64,
    /// RMS error about that line without the effects, and the RMS of the bead's walk over a record of that length \[um\].
    pub gap_um: [f64; 2],
}

/// Runs both models over a different large multisine; `None` if nothing is hidden in the response to a command. A line has an
/// unknown phase in every record, so it is subtracted from both errors.
pub(super) fn fresh(case: &Case, augmented: &Model, base: &Model, seed: u64) -> Option<Fresh> {
    if case.session.rig != Rig::Bead {
        return None;
    }
    let mut random = Random::new(seed + 7_777_777);
    let script = &scripts(case.session.excitation, &mut random)[2];
    let truth = run(
        script,
        Rig::Bead,
        &case.hidden,
        Nuisance::QUIET,
        &mut random,
    );
    let seen: Vec<usize> = (0..truth.bead_um.len())
        .filter(|&k| truth.bead_um[k].is_finite())
        .collect();
    let lines: Vec<f64> = case.hidden.iter().flat_map(lines).collect();
    let rms = |model: &Model, ramp: bool| {
        let options = SimulateOptions::default();
        let y = cellpos_plant::simulate(model, &truth.pzt_um, truth.sample_s, &options)
            .unwrap_or_else(|e| panic!("the augmented model does not simulate: {e}"));
        let mut d: Vec<f64> = seen.iter().map(|&k| y[k] - truth.bead_um[k]).collect();
        let mut columns: Vec<Vec<f64>> = vec![vec![1.0; seen.len()]];
        if ramp {
            columns.push(seen.iter().map(|&k| k as f64 * 1e-3).collect());
        }
        for hz in &lines {
            let angle = |k: &usize| TAU * hz * *k as f64 * 1e-3;
            columns.push(seen.iter().map(|k| angle(k).sin()).collect());
            columns.push(seen.iter().map(|k| angle(k).cos()).collect());
        }
        without(&mut d, columns);
        (d.iter().map(|d| d * d).sum::<f64>() / d.len() as f64).sqrt()
    };
    let before = rms(base, true);
    // A walk about its regression line: a fifteenth of its variance at the end.
    let walk_um2 = 2.0 * 0.33 * truth.duration_s() / 15.0;
    (before > NO_GAP_UM).then(|| Fresh {
        plain: 1.0 - rms(augmented, false) / rms(base, false),
        response: 1.0 - rms(augmented, true) / before,
        gap_um: [before, walk_um2.sqrt()],
    })
}

/// Frequencies of a hidden line and its harmonics.
fn lines(hidden: &Hidden) -> Vec<f64> {
    match *hidden {
        Hidden::Hum(hz, _) | Hidden::Line(hz, _) => vec![hz],
        Hidden::Second(Second::RichHum(hz, _)) => vec![hz, 3.0 * hz],
        Hidden::Stranger(Stranger::Pulsation(hz, ..)) => vec![hz, 2.0 * hz],
        _ => Vec::new(),
    }
}

/// What columns, one made orthogonal to the other, leave of a series.
fn without(d: &mut [f64], columns: Vec<Vec<f64>>) {
    let dot = |a: &[f64], b: &[f64]| -> f64 { a.iter().zip(b).map(|(a, b)| a * b).sum() };
    let take = |from: &mut [f64], q: &[f64]| {
        let share = dot(from, q);
        from.iter_mut().zip(q).for_each(|(f, q)| *f -= share * q);
    };
    let mut basis: Vec<Vec<f64>> = Vec::new();
    for mut c in columns {
        for q in &basis {
            take(&mut c, q);
        }
        let size = dot(&c, &c).sqrt();
        c.iter_mut().for_each(|c| *c /= size.max(1e-300));
        take(d, &c);
        basis.push(c);
    }
}
