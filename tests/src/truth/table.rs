//! Runs cases and counts.

use super::cases::Case;
use super::{Nuisance, Random, run, scripts};
use cellpos_plant::Model;
use cellpos_reconcile::{Options, Reconciliation, Record, Verdict, reconcile};
use std::collections::BTreeSet;

/// What a case came to.
#[derive(Debug, Clone)]
pub struct Row {
    /// Ids hidden.
    pub hidden: BTreeSet<String>,
    /// Ids named.
    pub named: BTreeSet<String>,
    /// Named, or alternatives of what was named.
    pub inside: BTreeSet<String>,
    /// The verdict.
    pub verdict: Verdict,
    /// Closure of the gap on held-out records.
    pub closure: f64,
    /// 1 - RMS error of the augmented over that of the null model, noise-free, on a fresh excitation; singles only.
    pub fresh: Option<f64>,
}

/// The records of a case under a seed.
pub fn records(case: &Case, seed: u64) -> Vec<Record> {
    let mut random = Random::new(seed);
    let nuisance = Nuisance {
        diffusion_um2_per_s: 0.33 * (0.8 + 0.4 * random.uniform()),
        localisation_um: 0.03,
    };
    scripts(&mut random)
        .iter()
        .map(|s| run(s, &case.hidden, nuisance, &mut random))
        .collect()
}

/// Runs one case.
///
/// # Errors
/// The message of a refusal.
pub fn evaluate(case: &Case, seed: u64) -> Result<Row, String> {
    let records = records(case, seed);
    let result = reconcile(
        &Model::eq6(),
        &records,
        &Options {
            threads: 1,
            ..Options::default()
        },
        &mut |_| {},
    )
    .map_err(|e| e.to_string())?;
    let hidden: BTreeSet<String> = case
        .hidden
        .iter()
        .map(|h| h.id().to_owned())
        .filter(|h| h != "outside")
        .collect();
    let named: BTreeSet<String> = result.effects.iter().map(|e| e.id.clone()).collect();
    let inside = result
        .effects
        .iter()
        .flat_map(|e| e.alternatives.iter().chain([&e.id]))
        .cloned()
        .collect();
    let fresh = (case.group == "single" && !named.is_empty()).then(|| fresh(case, &result, seed));
    Ok(Row {
        hidden,
        named,
        inside,
        verdict: result.verdict,
        closure: result.gap.closure(),
        fresh,
    })
}

/// Fall of the RMS error on an excitation that was never fitted: another multisine, noise-free.
fn fresh(case: &Case, result: &Reconciliation, seed: u64) -> f64 {
    let mut random = Random::new(seed + 7_777_777);
    let scripts = scripts(&mut random);
    let quiet = Nuisance {
        diffusion_um2_per_s: 0.0,
        localisation_um: 0.0,
    };
    let truth = run(&scripts[2], &case.hidden, quiet, &mut random);
    let error = |model: &Model| {
        let options = cellpos_plant::SimulateOptions::default();
        let y = simulate(model, &truth.pzt_um, truth.sample_s, options);
        let d: Vec<f64> = y
            .iter()
            .zip(&truth.bead_um)
            .filter(|(_, b)| b.is_finite())
            .map(|(a, b)| a - b)
            .collect();
        let mean = d.iter().sum::<f64>() / d.len() as f64;
        (d.iter().map(|d| (d - mean).powi(2)).sum::<f64>() / d.len() as f64).sqrt()
    };
    1.0 - error(&result.augmented) / error(&Model::eq6()).max(1e-12)
}

fn simulate(
    model: &Model,
    pzt_um: &[f64],
    sample_s: f64,
    options: cellpos_plant::SimulateOptions,
) -> Vec<f64> {
    cellpos_plant::simulate(model, pzt_um, sample_s, &options)
        .unwrap_or_else(|e| panic!("the augmented model does not simulate: {e}"))
}
