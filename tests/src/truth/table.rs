//! Runs cases and counts.

use super::cases::Case;
use super::threshold::above_threshold;
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
    /// Closure of the gap on held-out records; `None` where only frames are missing or repeated, which is no gap.
    pub closure: Option<f64>,
    /// Alternatives of the named ones.
    pub alternatives: BTreeSet<String>,
    /// 95 % intervals of parameters whose equation is the catalogue's: those that hold the truth, and all.
    pub covered: (usize, usize),
    /// Those that do not, in words.
    pub missed: Vec<String>,
    /// What `where` says last.
    pub reason: String,
    /// Time that the search had of a processor \[s\], one thread.
    pub seconds: f64,
    /// How far the hidden effects lie above the threshold of detection: see [`above_threshold`].
    pub above_threshold: f64,
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

/// What this thread has had of a processor until now \[s\]: does not count what others take.
fn processor_s() -> f64 {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    t.tv_sec as f64 + 1e-9 * t.tv_nsec as f64
}

/// Runs one case.
///
/// # Errors
/// The message of a refusal.
pub fn evaluate(case: &Case, seed: u64) -> Result<Row, String> {
    let records = records(case, seed);
    let start = processor_s();
    let result = reconcile(
        &Model::eq6(),
        &records,
        &Options {
            threads: 1,
            ..Options::default()
        },
        &mut |words| {
            if std::env::var_os("RECONCILE_TABLE_PROGRESS").is_some() {
                eprintln!("{:6.1} s {words}", processor_s() - start);
            }
        },
    )
    .map_err(|e| e.to_string())?;
    let seconds = processor_s() - start;
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
    let (covered, missed) = covered(case, &result);
    let fresh = (case.group == "single"
        && !named.is_empty()
        && !named.iter().all(|n| n.starts_with("frame-")))
    .then(|| fresh(case, &result, seed));
    Ok(Row {
        hidden,
        named,
        inside,
        verdict: result.verdict,
        reason: result.places.last().cloned().unwrap_or_default(),
        alternatives: result
            .effects
            .iter()
            .flat_map(|e| e.alternatives.iter())
            .cloned()
            .collect(),
        covered,
        missed,
        seconds,
        above_threshold: above_threshold(&case.hidden, seed),
        closure: result
            .effects
            .iter()
            .any(|e| !e.id.starts_with("frame-"))
            .then(|| result.gap.closure()),
        fresh,
    })
}

/// Whether the intervals of named effects hold what was hidden, where both have the same equation.
fn covered(case: &Case, result: &Reconciliation) -> ((usize, usize), Vec<String>) {
    let (mut good, mut all) = (0, 0);
    let mut missed = Vec::new();
    for h in &case.hidden {
        let Some(effect) = result.effects.iter().find(|e| e.id == h.id()) else {
            continue;
        };
        for (name, value) in h.parameters() {
            if let Some(p) = effect.parameters.get(name) {
                all += 1;
                if p.ci95[0] <= value && value <= p.ci95[1] {
                    good += 1;
                } else {
                    missed.push(format!(
                        "{name} {value} not in {:.6}..{:.6}",
                        p.ci95[0], p.ci95[1]
                    ));
                }
            }
        }
    }
    ((good, all), missed)
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
