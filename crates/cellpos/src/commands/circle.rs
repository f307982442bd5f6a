//! `cellpos circle`: identify, reconcile, design again, track again, and what each step was worth.
//!
//! The loop gets a model and a rig; the hidden model stays in the rig. On the emulated rig the truth is known, so the margins that
//! each model predicts are compared with those of the loop.

use crate::commands::identify::new_run_folder;
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use crate::output;
use crate::rig_file::{ClockKind, Frames, RigFile};
use cellpos_numeric::units::{Hertz, Micrometers, Seconds};
use cellpos_plant::Model;
use cellpos_workbench::experiment::circle::stage::{Motion, Stage};
use cellpos_workbench::experiment::circle::{Circle, Job, close, page};
use cellpos_workbench::experiment::on_rig::OnRig;
use serde_json::json;
use std::path::{Path, PathBuf};

/// Arguments of `cellpos circle`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  cellpos circle --hidden hidden.toml --report circle.html --out augmented.toml
  cellpos circle --rig rig.toml --controller lqg --json

Designs a controller for the model as given, as identified, and as reconciled, and runs the rig with each. The hidden model (--hidden,
or [emulator] model) drives the emulated rig and gives the true margins of the report; the steps never see it. Exit code 0: done; 1: the last
loop ended in Safe, or there is no verdict.")]
pub(crate) struct Args {
    /// Hidden model of the emulated rig: a model.toml.
    #[arg(long)]
    hidden: Option<PathBuf>,
    /// Rig file; default: the emulated rig.
    #[arg(long)]
    rig: Option<PathBuf>,
    /// Model to start from: eq6, or a model.toml.
    #[arg(long, default_value = "eq6")]
    model: String,
    /// Control law: pi, lead, lqg or mpc.
    #[arg(long, default_value = "pi", value_parser = ["pi", "lead", "lqg", "mpc"])]
    controller: String,
    /// Amplitude of the sine (half of peak to peak).
    #[arg(long, default_value = "3um")]
    amplitude: Micrometers,
    /// Its frequency.
    #[arg(long, default_value = "10Hz")]
    frequency: Hertz,
    /// Duration of each hold and each sine.
    #[arg(long, default_value = "8s")]
    duration: Seconds,
    /// Factor on the duration of the experiments for reconcile, 0.2 to 10.
    #[arg(long, default_value_t = 1.0)]
    effort: f64,
    /// Largest number of effects to add.
    #[arg(long, default_value_t = 4)]
    max_effects: usize,
    /// Largest number of further experiments.
    #[arg(long, default_value_t = 1)]
    rounds: u8,
    /// false: the emulated rig has the imperfections of a real one [default: as rig.toml says].
    #[arg(long, value_name = "BOOL", num_args = 0..=1, require_equals = true, default_missing_value = "true")]
    ideal: Option<bool>,
    /// Seed of the emulated rig and of the excitations [default: that of rig.toml].
    #[arg(long)]
    seed: Option<u64>,
    /// Clock of the emulated rig [default: virtual; a real rig has the real one].
    #[arg(long, value_enum)]
    clock: Option<ClockKind>,
    /// Render frames of the emulated rig.
    #[arg(long, value_enum, default_value = "on")]
    frames: Frames,
    /// Run without real-time priority.
    #[arg(long)]
    best_effort: bool,
    /// Continue from the finished segments of a circle that was stopped during identification.
    #[arg(long, value_name = "PARTIAL")]
    resume: Option<PathBuf>,
    /// Augmented model [default: augmented.toml in a new folder of runs/].
    #[arg(long)]
    out: Option<PathBuf>,
    /// Report [default: report.html in a new folder of runs/].
    #[arg(long)]
    report: Option<PathBuf>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub(crate) fn run(args: Args) -> CommandResult {
    checked(&args)?;
    output::ready(args.out.iter().chain(&args.report))?;
    let given = Model::load(&args.model).map_err(Failure::input)?;
    let mut file = RigFile::load(args.rig.as_deref())?;
    file.emulate_as(args.seed, args.ideal)?;
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
    let bar = output::progress_bar(None);
    let mut progress = |text: &str| {
        bar.set_message(text.to_owned());
        bar.tick();
    };
    let job = Job {
        rig: OnRig::new(
            file,
            given.clone(),
            args.clock,
            args.frames,
            args.best_effort,
        )?,
        given,
        truth,
        controller: &args.controller,
        motion: Motion {
            amplitude_um: args.amplitude.value(),
            frequency_hz: args.frequency.value(),
            duration_s: args.duration.value(),
        },
        effort: args.effort,
        max_effects: args.max_effects,
        rounds: usize::from(args.rounds),
        folder: &folder,
        resume: args.resume.as_deref(),
    };
    let circle = close(job, &mut progress)?;
    bar.finish_and_clear();
    write(&args, &circle, &folder)
}

fn checked(args: &Args) -> Result<(), Failure> {
    let within = |name: &str, value: f64, low: f64, high: f64, unit: &str| {
        if (low..=high).contains(&value) {
            Ok(())
        } else {
            Err(Failure::bad_input(
                format!("--{name} {value}{unit}: out of range"),
                format!("give {low}{unit} to {high}{unit}"),
            ))
        }
    };
    within("amplitude", args.amplitude.value(), 0.01, 12.0, "um")?;
    within("frequency", args.frequency.value(), 0.1, 200.0, "Hz")?;
    within("duration", args.duration.value(), 3.0, 3600.0, "s")?;
    within("effort", args.effort, 0.2, 10.0, "")
}

fn write(args: &Args, circle: &Circle, folder: &Path) -> CommandResult {
    let place =
        |given: &Option<PathBuf>, name: &str| given.clone().unwrap_or_else(|| folder.join(name));
    let (out, html) = (
        place(&args.out, "augmented.toml"),
        place(&args.report, "report.html"),
    );
    output::write(&out, &circle.reconciled.augmented.to_toml_string())?;
    let gap = folder.join("gap.html");
    cellpos_reconcile::report(&circle.reconciled, "circle")
        .write(&gap)
        .map_err(Failure::failed)?;
    page::report(circle, &gap)
        .write_with_figures(&html)
        .map_err(Failure::failed)?;
    let value = json!({
        "identify": {
            "gain_per_s": circle.identified.result.judged.model.gain_per_s,
            "delay_ms": circle.identified.result.judged.model.delay_s * 1e3,
            "misfit": circle.identified.result.selection.scale.sqrt(),
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
        print_text(&page::text(circle, &out, &html))?;
    }
    let closed = circle.stages.last().is_some_and(Stage::ran)
        && circle.reconciled.verdict != cellpos_reconcile::Verdict::Unknown;
    Ok(if closed {
        Outcome::Done
    } else {
        Outcome::Broken
    })
}
