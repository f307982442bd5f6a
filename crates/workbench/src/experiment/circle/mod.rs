//! The circle: identify, reconcile, design again, track again, and measure the gain from each step.
//!
//! The steps get a model and a rig; the hidden model stays in the rig. On the emulated rig the truth is known, so the margins that
//! each model predicts are compared with those of the loop.

mod answer;
pub mod margins;
pub mod page;
pub mod stage;

use crate::experiment::collect::{self, Collected, Collecting, Ran};
use crate::experiment::excitation::Experiment;
use crate::experiment::identify::{self, Done, Excitation};
use crate::experiment::on_rig::OnRig;
use cellpos_ident::excitation::PAPER_FREQUENCIES_HZ;
use cellpos_plant::{Model, effects};
use cellpos_reconcile::{Options, Reconciliation, Record};
use cellpos_session::{Failure, connect};
use stage::{Motion, Stage};
use std::collections::BTreeMap;
use std::path::Path;

/// Settings of the circle.
pub struct Job<'a> {
    /// The assumed model at the start.
    pub given: Model,
    /// The rig, and the loop on it.
    pub rig: OnRig,
    /// The model that an emulated rig runs, for the true margins.
    pub truth: Option<Model>,
    /// Which controller: pi, lead, lqg or mpc.
    pub controller: &'a str,
    /// What is tracked.
    pub motion: Motion,
    /// Factor on the duration of the experiments for reconcile.
    pub effort: f64,
    /// Most effects to add.
    pub max_effects: usize,
    /// Most further experiments if the first leaves names open.
    pub rounds: usize,
    /// Folder for the records.
    pub folder: &'a Path,
    /// Finished segments of an identification that was stopped within the circle.
    pub resume: Option<&'a Path>,
}

/// Its results.
pub struct Circle {
    /// The measured response and its fit.
    pub identified: Done,
    /// Whether the model that reconcile extended is the identified one (else the one given), and why.
    pub base: (&'static str, String),
    /// The verdict.
    pub reconciled: Reconciliation,
    /// The records for it.
    pub collected: Vec<Collected>,
    /// As given, as identified, as reconciled.
    pub stages: Vec<Stage>,
    /// The rig's own model with the delay that its frames had; emulated rigs only.
    pub truth: Option<Model>,
    /// What was tracked.
    pub motion: Motion,
    /// Sample time of the loop, s.
    pub sample_s: f64,
}

/// Runs the circle once; calls `progress` with each step.
///
/// # Errors
/// The rig failed, an experiment could not be finished, or no verdict could be reached.
pub fn close(job: Job<'_>, progress: &mut (dyn FnMut(&str) + Send)) -> Result<Circle, Failure> {
    let rig = &job.rig;
    let file = &rig.file;
    let mut given = job.given.clone();
    let done = measure(&job, progress)?;

    progress("recording for reconcile");
    let seed = file.emulator.seed;
    let survey = job.folder.join("survey.csv");
    let first =
        collect::run_experiment(rig, Experiment::Survey, job.effort, seed, &survey, progress)?;
    given.working_point_um = first.neutral_um;
    let identified = Model {
        noise: given.noise,
        ..done
            .result
            .model("identified", first.neutral_um, BTreeMap::new())
            .map_err(Failure::failed)?
    };
    let (mut start, base) = base(&done, &given, &identified);
    // An effect that the rig file states needs no finding. Without the exposure, its motion blur counts as delay: 14 us at 0.5
    // ms.
    if let Some(exposure_s) = connect::stated_exposure_s(file).filter(|s| *s > 0.0)
        && start.effect("exposure-averaging").is_none()
    {
        start = start.with_effect(effects::exposure_averaging(exposure_s));
    }
    let (reconciled, collected) = reconcile(&job, &mut start, &first, progress)?;

    // The truth as the loop sees it: the delay runs from the middle of an exposure to the tick that uses its frame.
    let truth = job.truth.clone().map(|model| Model {
        working_point_um: file.emulator.neutral_um,
        ..stage::with_delay(model, first.age_s)
    });
    let configured_s = file.timing.camera_delay_ms * 1e-3;
    let found_s = found_delay_s(&reconciled.augmented).unwrap_or(configured_s);
    let mut stages = Vec::new();
    for (name, model, delay_s) in [
        ("as given", given, configured_s),
        (
            "as identified",
            identified,
            done.result.judged.model.delay_s,
        ),
        ("as reconciled", reconciled.augmented.clone(), found_s),
    ] {
        progress(&format!("designing and tracking: {name}"));
        let model = stage::with_delay(model, delay_s);
        let stage = stage::run(name, model, job.controller, rig, truth.as_ref(), job.motion)?;
        stages.push(stage);
    }
    Ok(Circle {
        identified: done,
        base,
        reconciled,
        collected,
        stages,
        truth,
        motion: job.motion,
        sample_s: file.timing.period_us * 1e-6,
    })
}

fn measure(job: &Job<'_>, progress: &mut (dyn FnMut(&str) + Send)) -> Result<Done, Failure> {
    progress("identifying");
    let rig = &job.rig;
    let identification = identify::Job {
        limits: rig.limits(rig.bead_amplitude_um(8.0)?, 400.0, 10.0),
        setup: rig.bench_setup(),
        lines_hz: PAPER_FREQUENCIES_HZ.to_vec(),
        excitation: Excitation::Stepped,
        seconds_at_1_hz: 40.0,
        led_edges: if rig.file.is_emulated() { 100 } else { 0 },
        bootstrap: 0,
        seed: rig.file.emulator.seed,
        rig: Some(rig.clone()),
        resume: job.resume.map(Path::to_owned),
        keep_in: Some(job.folder.join("partial.json")),
    };
    identify::run(&identification, |ticks, total| {
        progress(&format!("identifying: {ticks} of {total} ticks"));
    })
}

/// The model that reconcile extends, and why: the identified one if it describes the response, else the given one.
fn base(done: &Done, given: &Model, identified: &Model) -> (Model, (&'static str, String)) {
    /// Penalised misfit, in variances, up to which the fit counts as a description.
    const DESCRIBES: f64 = 2.0;
    let scale = done.result.selection.scale;
    if scale <= DESCRIBES {
        let why = "Eq. (4) describes the measured response".to_owned();
        return (identified.clone(), ("identified", why));
    }
    let why = format!(
        "the measured response is {:.1} standard deviations from the best of Eq. (4): its coefficients have taken up a part of \
         what is missing, so the model given is extended instead",
        scale.sqrt()
    );
    (given.clone(), ("given", why))
}

/// Names the effects missing from `start`, with the survey and any further records that are needed.
fn reconcile(
    job: &Job<'_>,
    start: &mut Model,
    survey: &Ran,
    progress: &mut (dyn FnMut(&str) + Send),
) -> Result<(Reconciliation, Vec<Collected>), Failure> {
    let mut records: Vec<Record> = (survey.records.iter())
        .map(|(_, record)| record.clone())
        .collect();
    let options = Options {
        max_effects: job.max_effects,
        ..Options::default()
    };
    let collecting = Collecting {
        rig: &job.rig,
        folder: job.folder,
        rounds: job.rounds,
        share: job.effort,
        seed: job.rig.file.emulator.seed + 1,
    };
    let (reconciled, more) = collect::look(start, &mut records, &options, &collecting, progress)?;
    let verdict = match more.is_empty() {
        true => reconciled.verdict.word(),
        false => "ambiguous",
    };
    let why = "nothing is recorded yet";
    let mut collected = Collected::of(Experiment::Survey, why, verdict, &survey.records);
    collected.extend(more);
    Ok((reconciled, collected))
}

/// The loop's delay of a reconciled model, s: the model's ends with the exposure, the loop's in its middle.
fn found_delay_s(model: &Model) -> Option<f64> {
    let number = |id: &str, name: &str| model.effect(id).and_then(|e| e.get(name));
    let averaged_s = number("exposure-averaging", "exposure_s").unwrap_or(0.0);
    number("time-delay", "delay_s").map(|delay_s| delay_s + 0.5 * averaged_s)
}
