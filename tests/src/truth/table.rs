//! Runs cases and counts.

use super::cases::Case;
pub use super::fresh::Fresh;
use super::fresh::fresh;
use super::threshold::above_threshold;
use super::{Excitation, Hidden, Nuisance, Random, Rig, Second, run, scripts};
use cellpos_plant::{Model, Noise, TransferFunction};
use cellpos_reconcile::{
    Effect, Options, Reconciliation, Record, Verdict, constant_gain, reconcile,
};
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
    /// Named, and neither hidden themselves nor with something hidden among their alternatives.
    pub false_names: BTreeSet<String>,
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
    /// The numbers of what is named, in words.
    pub numbers: String,
    /// The value of `where`.
    pub reason: String,
    /// Time that the search had of a processor \[s\], one thread.
    pub seconds: f64,
    /// How far the hidden effects lie above the threshold of detection: see [`above_threshold`].
    pub above_threshold: f64,
    /// How far the augmented model carries on a fresh excitation, where something of the catalogue is hidden and named.
    pub fresh: Option<Fresh>,
}

/// The records of a case under a seed.
pub fn records(case: &Case, seed: u64) -> Vec<Record> {
    let mut random = Random::new(seed);
    let session = case.session;
    let nuisance = Nuisance {
        diffusion_um2_per_s: 0.33 * (0.8 + 0.4 * random.uniform()),
        localisation_um: 0.03,
        kind: session.noise,
        step_um: session.step_um,
    };
    scripts(session.excitation, &mut random)
        .iter()
        .map(|s| run(s, session.rig, &case.hidden, nuisance, &mut random))
        .collect()
}

/// What is known of the rig before: its model, and how it is read.
fn base(case: &Case, records: &[Record]) -> Result<(Model, Options), String> {
    let options = Options {
        threads: 1,
        ..Options::default()
    };
    if let Rig::Actuator(_) = case.session.rig {
        let (gain, working_point_um) = constant_gain(records).map_err(|e| e.to_string())?;
        let model = Model {
            name: "fit".to_owned(),
            plant: TransferFunction::new(vec![gain], vec![1.0]).map_err(|e| e.to_string())?,
            working_point_um,
            noise: Noise::NONE,
            ..Model::eq6()
        };
        let options = Options {
            interpolated_input: true,
            free_gain: true,
            ..options
        };
        return Ok((model, options));
    }
    let mut model = Model::eq6();
    if case.session.excitation == Excitation::WithoutFloor {
        model.noise = Noise::NONE;
    }
    Ok((model, options))
}

/// Processor time of this thread until now \[s\].
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
    let (model, options) = base(case, &records)?;
    let start = processor_s();
    let result = reconcile(&model, &records, &options, &mut |words| {
        if std::env::var_os("RECONCILE_TABLE_PROGRESS").is_some() {
            eprintln!("{:6.1} s {words}", processor_s() - start);
        }
    })
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
    let false_names = result
        .effects
        .iter()
        .filter(|e| {
            !e.alternatives
                .iter()
                .chain([&e.id])
                .any(|n| hidden.contains(n))
        })
        .map(|e| e.id.clone())
        .collect();
    let carries = !hidden.is_empty() && named.iter().any(|n| !n.starts_with("frame-"));
    let fresh = if carries {
        fresh(case, &result.augmented, &model, seed)
    } else {
        None
    };
    Ok(Row {
        hidden,
        named,
        inside,
        false_names,
        verdict: result.verdict,
        numbers: numbers(&result),
        reason: result.places.join(" | "),
        alternatives: result
            .effects
            .iter()
            .flat_map(|e| e.alternatives.iter())
            .cloned()
            .collect(),
        covered,
        missed,
        seconds,
        above_threshold: match case.session.rig {
            Rig::Bead => above_threshold(&case.hidden, case.session.excitation, seed),
            Rig::Actuator(_) => f64::NAN,
        },
        closure: result
            .effects
            .iter()
            .any(|e| !e.id.starts_with("frame-"))
            .then(|| result.gap.closure()),
        fresh,
    })
}

/// The numbers of what is named.
fn numbers(result: &Reconciliation) -> String {
    let one = |e: &Effect| {
        let values: Vec<String> = e
            .parameters
            .iter()
            .map(|(name, p)| format!("{name} {:.4}", p.value))
            .collect();
        format!(
            "{}({}; of the gap {:.4})",
            e.id,
            values.join(", "),
            e.explained
        )
    };
    let all: Vec<String> = result.effects.iter().map(one).collect();
    all.join(" + ")
}

/// The camera's relative error of the pixel size.
fn magnified(behind: &[Hidden]) -> f64 {
    let factor = |h: &Hidden| match h {
        Hidden::Second(Second::Magnification(f)) => *f,
        _ => 1.0,
    };
    behind.iter().map(factor).product()
}

/// Whether the intervals of named effects hold what was hidden, where both have the same equation.
fn covered(case: &Case, result: &Reconciliation) -> ((usize, usize), Vec<String>) {
    let (mut good, mut all) = (0, 0);
    let mut missed = Vec::new();
    for (i, h) in case.hidden.iter().enumerate() {
        let Some(effect) = result.effects.iter().find(|e| e.id == h.id()) else {
            continue;
        };
        for (name, value) in h.parameters() {
            // A pixel is as large as the micrometres that the camera takes it for.
            let value = match name {
                "pixel_um" => value * magnified(&case.hidden[i..]),
                _ => value,
            };
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
