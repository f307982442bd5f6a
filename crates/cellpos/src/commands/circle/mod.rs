//! `cellpos circle`: identify, reconcile, design again, track again, and what each step was worth.
//!
//! The loop is shown a model and a rig; what the rig hides stays in the rig. On the emulated rig the truth is known, so that
//! the margins that each model predicts can be set beside those that the loop has.

mod margins;
mod report;
mod stage;

use crate::commands::identify::on_rig::OnRig;
use crate::commands::identify::{Excitation, new_run_folder, run as identification};
use crate::commands::reconcile::collect::{self, Collected, Collecting};
use crate::commands::reconcile::experiment::Experiment;
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use crate::rig_file::{ClockKind, Frames, RigFile};
use cellpos_ident::excitation::PAPER_FREQUENCIES_HZ;
use cellpos_plant::{Effect, Model};
use cellpos_reconcile::{Options, Reconciliation};
use cellpos_units::{Hertz, Micrometers, Seconds};
use serde_json::json;
use stage::{Motion, Stage};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Arguments of `cellpos circle`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  cellpos circle --hidden hidden.toml --report circle.html --out augmented.toml
  cellpos circle --rig rig.toml --controller lqg --json

A controller is designed on the model as given, as identified, and as reconciled, and the rig is run with each. The rig's own
model ([emulator] model, or --hidden) is used by the emulated rig, and by the report for the true margins; the steps never see
it. On a real rig there are no true margins. Exit code 0: the circle is closed; 1: the loop of the last step ended in Safe, or
no verdict was reached.")]
pub struct Args {
    /// Model that the emulated rig runs and nobody is shown: a model.toml.
    #[arg(long)]
    hidden: Option<PathBuf>,
    /// The rig; left out: the emulated one.
    #[arg(long)]
    rig: Option<PathBuf>,
    /// The model that is believed in at the start: eq6, or a model.toml.
    #[arg(long, default_value = "eq6")]
    model: String,
    /// Which controller: pi, lead, lqg or mpc.
    #[arg(long, default_value = "pi", value_parser = ["pi", "lead", "lqg", "mpc"])]
    controller: String,
    /// Amplitude (half of peak to peak) of the sine that is tracked.
    #[arg(long, default_value = "3um")]
    amplitude: Micrometers,
    /// Its frequency.
    #[arg(long, default_value = "10Hz")]
    frequency: Hertz,
    /// How long each controller holds the bead, and tracks the sine.
    #[arg(long, default_value = "8s")]
    duration: Seconds,
    /// Factor on the duration of the experiments for reconcile, 0.2 to 10.
    #[arg(long, default_value_t = 1.0)]
    effort: f64,
    /// Most effects to add.
    #[arg(long, default_value_t = 4)]
    max_effects: usize,
    /// Most further experiments where the first leaves names open.
    #[arg(long, default_value_t = 1)]
    rounds: u8,
    /// Seed of the emulated rig and of the excitations [default: that of rig.toml].
    #[arg(long)]
    seed: Option<u64>,
    /// Clock of the emulated rig [default: virtual; a real rig has the real one].
    #[arg(long, value_enum)]
    clock: Option<ClockKind>,
    /// Whether the emulated rig renders frames.
    #[arg(long, value_enum, default_value = "on")]
    frames: Frames,
    /// Do not ask the operating system for real time.
    #[arg(long)]
    best_effort: bool,
    /// Write the augmented model here [default: augmented.toml in a new folder of runs/].
    #[arg(long)]
    out: Option<PathBuf>,
    /// Write the report here, figures beside it [default: report.html in a new folder of runs/].
    #[arg(long)]
    report: Option<PathBuf>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// Everything that came of it.
pub(crate) struct Circle {
    /// The measured response and what it was fitted by.
    identified: identification::Done,
    /// Whether the model that reconcile extended is the identified one (else the one given), and why.
    base: (&'static str, String),
    /// The verdict.
    reconciled: Reconciliation,
    /// What was recorded for it.
    collected: Vec<Collected>,
    /// As given, as identified, as reconciled.
    stages: Vec<Stage>,
    /// The rig's own model with the delay that its frames had; emulated rigs only.
    truth: Option<Model>,
    motion: Motion,
    /// Sample time of the loop, s.
    sample_s: f64,
}

/// Runs the command.
pub fn run(args: Args) -> CommandResult {
    checked(&args)?;
    let given = Model::load(&args.model).map_err(Failure::input)?;
    let mut file = RigFile::load(args.rig.as_deref())?;
    if let Some(seed) = args.seed {
        file.emulator.seed = seed;
    }
    if let Some(hidden) = &args.hidden {
        if !file.is_emulated() {
            return Err(Failure::bad_input(
                "--hidden is a model for the emulated rig, and --rig names a real one",
                "leave one of them out",
            ));
        }
        file.emulator.model = hidden.display().to_string();
    }
    let truth = file
        .is_emulated()
        .then(|| Model::load(&file.emulator.model).map_err(Failure::input))
        .transpose()?;
    let folder = new_run_folder("circle")?;
    let bar = indicatif::ProgressBar::new_spinner();
    let mut progress = |text: &str| {
        bar.set_message(text.to_owned());
        bar.tick();
    };
    let circle = close(&args, given, &file, truth, &folder, &mut progress)?;
    bar.finish_and_clear();
    write(&args, &circle, &folder)
}

fn checked(args: &Args) -> Result<(), Failure> {
    let within = |name: &str, value: f64, low: f64, high: f64, unit: &str| {
        if (low..=high).contains(&value) {
            Ok(())
        } else {
            Err(Failure::bad_input(
                format!("--{name} {value}{unit}"),
                format!("give {low}{unit} to {high}{unit}"),
            ))
        }
    };
    within("amplitude", args.amplitude.value(), 0.01, 12.0, "um")?;
    within("frequency", args.frequency.value(), 0.1, 200.0, "Hz")?;
    within("duration", args.duration.value(), 3.0, 3600.0, "s")?;
    within("effort", args.effort, 0.2, 10.0, "")
}

fn close(
    args: &Args,
    mut given: Model,
    file: &RigFile,
    truth: Option<Model>,
    folder: &Path,
    progress: &mut (dyn FnMut(&str) + Send),
) -> Result<Circle, Failure> {
    progress("identifying");
    let rig = OnRig::new(
        file.clone(),
        given.clone(),
        args.clock,
        args.frames,
        args.best_effort,
    )?;
    let seed = file.emulator.seed;
    let job = identification::Job {
        limits: rig.limits(8.0, 400.0, 10.0),
        setup: rig.bench_setup(),
        lines_hz: PAPER_FREQUENCIES_HZ.to_vec(),
        excitation: Excitation::Stepped,
        seconds_at_1_hz: 40.0,
        led_edges: if file.is_emulated() { 100 } else { 0 },
        bootstrap: 0,
        seed,
        rig: Some(rig.clone()),
        resume: None,
        keep_in: Some(folder.join("partial.json")),
    };
    let done = identification::run(&job, |ticks, total| {
        progress(&format!("identifying: {ticks} of {total} ticks"));
    })?;

    progress("recording for reconcile");
    let first = collect::run_experiment(&rig, Experiment::Survey, args.effort, seed, progress)?;
    let survey = folder.join("survey.csv");
    collect::write_record(&first.record, &survey)?;
    given.working_point_um = first.neutral_um;
    let identified = done
        .result
        .model("identified", first.neutral_um, BTreeMap::new())
        .map_err(Failure::failed)?;
    let identified = Model {
        noise: given.noise,
        ..identified
    };
    let fits = done.result.ladder.scale <= 2.0;
    let base = if fits {
        (
            "identified",
            "Eq. (4) describes the measured response".to_owned(),
        )
    } else {
        (
            "given",
            format!(
                "the measured response is {:.1} standard deviations from the best of Eq. (4): its coefficients have taken up a \
                 part of what is missing, so the model given is extended instead",
                done.result.ladder.scale.sqrt()
            ),
        )
    };
    let mut start = if fits {
        identified.clone()
    } else {
        given.clone()
    };
    // What the rig file states needs no finding. Left out, the way that the bead goes in a part of an exposure is taken for
    // delay: 14 us of it at 0.5 ms.
    if let Some(exposure_s) = crate::session::stated_exposure_s(file).filter(|s| *s > 0.0)
        && start.effect("exposure-averaging").is_none()
    {
        start = start.with_effect(Effect::ExposureAveraging { exposure_s });
    }
    let mut records = vec![first.record.clone()];
    let options = Options {
        max_effects: args.max_effects,
        ..Options::default()
    };
    let collecting = Collecting {
        rig: &rig,
        folder,
        rounds: usize::from(args.rounds),
        share: args.effort,
        seed: seed + 1,
    };
    let (reconciled, mut collected) =
        collect::look(&mut start, &mut records, &options, &collecting, progress)?;
    collected.insert(
        0,
        Collected {
            experiment: Experiment::Survey.name(),
            what: Experiment::Survey.what(),
            why: "nothing is recorded yet".to_owned(),
            file: survey,
            rows: first.record.rows(),
            rows_without_bead: first.record.rows() - first.record.frames(),
            verdict: if collected.is_empty() {
                reconciled.verdict.word().to_owned()
            } else {
                "ambiguous".to_owned()
            },
        },
    );

    // The truth as the loop meets it: the delay is from the middle of an exposure to the tick that uses its frame.
    let truth = truth.map(|model| Model {
        working_point_um: file.emulator.neutral_um,
        ..stage::with_delay(model, first.age_s)
    });
    let configured_s = file.timing.camera_delay_ms * 1e-3;
    let averaged_s = match reconciled.augmented.effect("exposure-averaging") {
        Some(Effect::ExposureAveraging { exposure_s }) => *exposure_s,
        _ => 0.0,
    };
    // The model's delay ends with the exposure, the loop's in its middle.
    let found_s = match reconciled.augmented.effect("time-delay") {
        Some(Effect::TimeDelay { delay_s }) => *delay_s + 0.5 * averaged_s,
        _ => configured_s,
    };
    let motion = Motion {
        amplitude_um: args.amplitude.value(),
        frequency_hz: args.frequency.value(),
        duration_s: args.duration.value(),
    };
    let delay_s = done.result.judged.model.delay_s;
    let mut stages = Vec::new();
    for (name, model, delay_s) in [
        ("as given", given, configured_s),
        ("as identified", identified, delay_s),
        ("as reconciled", reconciled.augmented.clone(), found_s),
    ] {
        progress(&format!("designing and tracking: {name}"));
        let model = stage::with_delay(model, delay_s);
        stages.push(stage::run(
            name,
            model,
            &args.controller,
            &rig,
            truth.as_ref(),
            motion,
        )?);
    }
    Ok(Circle {
        identified: done,
        base,
        reconciled,
        collected,
        stages,
        truth,
        motion,
        sample_s: file.timing.period_us * 1e-6,
    })
}

fn write(args: &Args, circle: &Circle, folder: &Path) -> CommandResult {
    let place =
        |given: &Option<PathBuf>, name: &str| given.clone().unwrap_or_else(|| folder.join(name));
    let (out, html) = (
        place(&args.out, "augmented.toml"),
        place(&args.report, "report.html"),
    );
    std::fs::write(&out, circle.reconciled.augmented.to_toml_string()).map_err(Failure::failed)?;
    let gap = folder.join("gap.html");
    cellpos_reconcile::report(&circle.reconciled, "circle")
        .write(&gap)
        .map_err(Failure::failed)?;
    report::report(circle, &gap)
        .write_with_figures(&html)
        .map_err(Failure::failed)?;
    let value = json!({
        "identify": {
            "gain_per_s": circle.identified.result.judged.model.gain_per_s,
            "delay_ms": circle.identified.result.judged.model.delay_s * 1e3,
            "misfit": circle.identified.result.ladder.scale.sqrt(),
            "warnings": circle.identified.result.warnings,
        },
        "base": { "model": circle.base.0, "why": circle.base.1 },
        "reconcile": circle.reconciled.to_json(),
        "collected": circle.collected,
        "stages": circle.stages,
        "before": circle.stages.first(),
        "after": circle.stages.last(),
        "model": out,
        "report": html,
        "gap_report": gap,
    });
    if args.json {
        print_json(&value)?;
    } else {
        print_text(&report::text(circle, &out, &html))?;
    }
    let closed = circle.stages.last().is_some_and(Stage::ran)
        && circle.reconciled.verdict != cellpos_reconcile::Verdict::Unknown;
    Ok(if closed {
        Outcome::Done
    } else {
        Outcome::Broken
    })
}
