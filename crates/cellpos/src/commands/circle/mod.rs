//! `cellpos circle`: identify, reconcile, design again, track again, and what each step was worth.
//!
//! The loop is shown a model and a rig; what the rig hides stays in the rig. On the emulated rig the truth is known, so that
//! the margins that each model predicts can be set beside those that the loop has.

mod report;

use crate::commands::identify::new_run_folder;
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use crate::output;
use crate::rig_file::{ClockKind, Frames, RigFile};
use cellpos_experiment::circle::stage::{Motion, Stage};
use cellpos_experiment::circle::{Circle, Job, close};
use cellpos_experiment::on_rig::OnRig;
use cellpos_plant::Model;
use cellpos_units::{Hertz, Micrometers, Seconds};
use serde_json::json;
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
    /// Whether the emulated rig stands still, or has the imperfections of a real one (false) [default: as rig.toml says].
    #[arg(long, value_name = "BOOL", num_args = 0..=1, require_equals = true, default_missing_value = "true")]
    ideal: Option<bool>,
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
    /// Go on from the finished segments of a circle that was stopped in its identification.
    #[arg(long, value_name = "PARTIAL")]
    resume: Option<PathBuf>,
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

/// Runs the command.
pub fn run(args: Args) -> CommandResult {
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
    report::report(circle, &gap)
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
