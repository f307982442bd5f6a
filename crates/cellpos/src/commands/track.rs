//! `cellpos track`: hold a bead, or go to a position, in closed loop.

use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use crate::recording::{LiveLine, Recording};
use crate::rig_file::{ClockKind, Frames, Rig, RigFile};
use crate::setup::{self, ReferenceSpec, Setup, SetupConfig};
use cellpos_control::design::bound_rms_um;
use cellpos_plant::Model;
use cellpos_record::{InputFile, RunEnd, RunMeta, RunWriter};
use cellpos_rig::actuator::Session;
use cellpos_runtime::live::{Operator, Threads};
use cellpos_runtime::realtime::Conditions;
use cellpos_runtime::{EndRule, Finished, Life, Request, Statistics, Summary, live, virtual_run};
use cellpos_units::{Micrometers, Seconds};
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Arguments of `cellpos track`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  cellpos track --target 0um
  cellpos track --target 10um --duration 5s --clock virtual --seed 7 --json
  cellpos track --target 0um --rig rig.toml --controller controller.toml

Without --rig the rig is emulated: frames are rendered, the board is the firmware library. Ctrl-C freezes the bead, then
parks the PZT; a second Ctrl-C parks at once. Exit code 0: the run ended as asked; 1: it ended in Safe; 2: bad input.")]
pub struct Args {
    /// Where the bead is to be.
    #[arg(long, allow_hyphen_values = true)]
    target: Micrometers,
    /// How long; left out: until Ctrl-C.
    #[arg(long)]
    duration: Option<Seconds>,
    /// pi, lead, lqg, mpc, or the path of a controller.toml.
    #[arg(long, default_value = "pi")]
    controller: String,
    /// The rig; left out: emulated.
    #[arg(long)]
    rig: Option<PathBuf>,
    /// The plant that the controller is made for: a model.toml, or eq6.
    #[arg(long, default_value = "eq6")]
    model: String,
    /// Seed of the emulated rig; left out: that of rig.toml.
    #[arg(long)]
    seed: Option<u64>,
    /// Clock of the emulated rig.
    #[arg(long, value_enum, default_value = "real")]
    clock: ClockKind,
    /// Whether the emulated rig renders frames.
    #[arg(long, value_enum, default_value = "on")]
    frames: Frames,
    /// Do not ask the operating system for real time.
    #[arg(long)]
    best_effort: bool,
    /// Where run folders go.
    #[arg(long, default_value = "runs")]
    runs: PathBuf,
    /// Name of the run.
    #[arg(long, default_value = "track")]
    name: String,
    /// Leave no run folder.
    #[arg(long)]
    no_record: bool,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// What `--json` prints.
#[derive(Debug, Serialize)]
struct Report<'a> {
    #[serde(flatten)]
    summary: &'a Summary,
    target_um: f64,
    controller: &'a str,
    bound_rms_nm: Option<f64>,
    conditions: &'a Conditions,
    warnings: &'a [String],
    run: Option<String>,
}

/// Holds the bead.
pub fn run(args: Args) -> CommandResult {
    let mut file = RigFile::load(args.rig.as_deref())?;
    if let Some(seed) = args.seed {
        file.emulator.seed = seed;
    }
    let ticks = ticks(args.duration, file.timing.period_us)?;
    let model = Model::load(&args.model).map_err(Failure::input)?;
    let mut controller = setup::controller(&args.controller, &model, &file.timing)?;

    let mut rig = file.connect(args.clock, args.frames)?;
    rig.expect(&model);
    check_target(args.target, &rig)?;
    let board = rig.actuator.info();
    let own = controller.limits;
    let asked = setup::within(file.limits, [own.low_um, own.high_um, own.slew_um_per_s]);
    controller.limits = setup::within(asked, [board.low_um, board.high_um, board.slew_um_per_s]);
    let limits = controller.limits;
    let armed = rig
        .actuator
        .arm(&Session {
            id: 1,
            park_um: limits.park_um,
            limits: [limits.low_um, limits.high_um, limits.slew_um_per_s],
            watchdog_ms: file.watchdog_ms(),
        })
        .map_err(Failure::failed)?;
    let setup = Setup {
        model,
        controller,
        config: SetupConfig {
            displacement_um: armed.applied_um,
            neutral_um: file.first_neutral_um,
            reference: ReferenceSpec::Hold {
                position_um: args.target.value(),
            },
            timing: file.timing,
            arming: file.arming,
        },
    };
    let writer = if args.no_record {
        None
    } else {
        Some(create_run(&args, &file, &setup)?)
    };
    let recording = Recording::new(
        writer,
        (!args.json).then_some(LiveLine {
            low_um: limits.low_um,
            high_um: limits.high_um,
        }),
    );
    let operator = Arc::new(Operator::default());
    let stopper = Arc::clone(&operator);
    ctrlc::set_handler(move || {
        let message = match stopper.stop() {
            Request::Freeze => "freezing, then parking; once more to park at once",
            _ => "parking",
        };
        eprintln!("\n{message}");
    })
    .map_err(Failure::failed)?;
    let finished = drive(
        &setup,
        &mut rig,
        recording,
        ticks,
        args.best_effort,
        &operator,
    )?;
    conclude(&args, &file, &setup, &rig, finished)
}

fn ticks(duration: Option<Seconds>, period_us: f64) -> Result<Option<u64>, Failure> {
    let Some(duration) = duration else {
        return Ok(None);
    };
    let ticks = (duration.value() * 1e6 / period_us).round();
    if ticks < 1.0 {
        return Err(Failure::bad_input(
            format!("--duration {duration}: shorter than one tick"),
            "write for example 10s",
        ));
    }
    Ok(Some(ticks as u64))
}

fn check_target(target: Micrometers, rig: &Rig) -> Result<(), Failure> {
    let [low_um, high_um] = rig.source.info().field_um;
    if (low_um..=high_um).contains(&target.value()) {
        return Ok(());
    }
    Err(Failure::bad_input(
        format!("--target {target}: outside what the camera sees, {low_um:.1}um to {high_um:.1}um"),
        "choose a target inside, or move the field of view (origin_px, width_px)",
    ))
}

/// Runs the loop on the rig's clock.
fn drive(
    setup: &Setup,
    rig: &mut Rig,
    recording: Recording,
    ticks: Option<u64>,
    best_effort: bool,
    operator: &Operator,
) -> Result<Finished<Recording>, Failure> {
    let core = setup.core()?;
    let end = EndRule {
        ticks,
        ..EndRule::default()
    };
    if rig.clock.is_virtual() {
        virtual_run::run(
            core,
            &rig.clock,
            rig.source.as_mut(),
            rig.actuator.as_mut(),
            recording,
            Statistics::default(),
            end,
            |_| operator.asked(),
        )
    } else {
        let threads = if best_effort {
            Threads::best_effort()
        } else {
            Threads::real_time()
        };
        live::run(
            core,
            rig.source.as_mut(),
            rig.actuator.as_mut(),
            recording,
            Statistics::default(),
            end,
            &threads,
            operator,
        )
    }
    .map_err(Failure::failed)
}

fn create_run(args: &Args, file: &RigFile, setup: &Setup) -> Result<RunWriter, Failure> {
    let clock = match args.clock {
        ClockKind::Real => "real",
        ClockKind::Virtual => "virtual",
    };
    let mut meta = RunMeta::new(&args.name, clock);
    meta.command_line = std::env::args().collect();
    meta.seed = file.is_emulated().then_some(file.emulator.seed);
    meta.versions
        .insert("cellpos".to_string(), env!("CARGO_PKG_VERSION").to_string());
    let mut inputs: Vec<&Path> = args.rig.iter().map(PathBuf::as_path).collect();
    if args.model != "eq6" {
        inputs.push(Path::new(&args.model));
    }
    if args.controller.ends_with(".toml") {
        inputs.push(Path::new(&args.controller));
    }
    for path in inputs {
        meta.inputs
            .push(InputFile::of(path).map_err(Failure::failed)?);
    }
    meta.config = table(&setup.config)?;
    meta.config
        .insert("rig".to_string(), toml::Value::Table(table(file)?));
    meta.model = setup
        .model
        .to_toml_string()
        .parse::<toml::Table>()
        .map_err(Failure::failed)?;
    meta.controller = table(&setup.controller)?;
    RunWriter::create(&args.runs, meta).map_err(Failure::failed)
}

fn table(value: &impl Serialize) -> Result<toml::Table, Failure> {
    toml::Table::try_from(value).map_err(Failure::failed)
}

fn conclude(
    args: &Args,
    file: &RigFile,
    setup: &Setup,
    rig: &Rig,
    finished: Finished<Recording>,
) -> CommandResult {
    let Finished {
        summary,
        conditions,
        sink,
        io_error,
        learned: _,
    } = finished;
    let mut warnings = rig.warnings.clone();
    if let Some(error) = &io_error {
        warnings.push(describe(error));
    }
    // Parked by the operator is ended as asked.
    let as_asked = summary.state == Life::Running
        || summary.safe_reason == Some(cellpos_runtime::SafeReason::Operator);
    let healthy = as_asked && io_error.is_none();
    let run = sink.into_writer().map(|writer| {
        let mut end = RunEnd::new(if healthy {
            "done"
        } else {
            summary.state.name()
        });
        end.summary = toml::Table::try_from(&summary).unwrap_or_default();
        let done = writer.finish(end);
        if done.faults.rows_lost + done.faults.events_lost > 0 {
            warnings.push(format!(
                "{} rows and {} events could not be written: {}",
                done.faults.rows_lost,
                done.faults.events_lost,
                done.faults.first.unwrap_or_default()
            ));
        }
        done.folder.display().to_string()
    });
    let diffusion = if file.is_emulated() {
        file.emulator.diffusion_um2_per_s
    } else {
        setup.model.noise.diffusion_um2_per_s
    };
    let bound_rms_nm = summary.fix_noise_nm.map(|noise_nm| {
        let timing = &setup.config.timing;
        1e3 * bound_rms_um(
            diffusion,
            noise_nm * 1e-3,
            timing.camera_delay_ms * 1e-3,
            timing.period_us * 1e-6,
        )
    });
    let report = Report {
        summary: &summary,
        target_um: args.target.value(),
        controller: &args.controller,
        bound_rms_nm,
        conditions: &conditions,
        warnings: &warnings,
        run,
    };
    if args.json {
        print_json(&report)?;
    } else {
        print_text(&text(&report))?;
    }
    Ok(if healthy {
        Outcome::Done
    } else {
        Outcome::Broken
    })
}

/// An error with what is behind it, on one line.
fn describe(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(error) = source {
        text.push_str(": ");
        text.push_str(&error.to_string());
        source = error.source();
    }
    text
}

fn text(report: &Report) -> String {
    let s = report.summary;
    let nm = |value: Option<f64>| value.map_or_else(|| "-".to_string(), |nm| format!("{nm:.1} nm"));
    let mut out = String::new();
    let mut line = |name: &str, value: String| out.push_str(&format!("{name:<18}{value}\n"));
    line(
        "state",
        match s.safe_reason {
            Some(reason) => format!("{} ({reason:?})", s.state.name()),
            None => s.state.name().to_string(),
        },
    );
    line(
        "duration",
        format!("{:.3} s, {} ticks", s.duration_s, s.counts.ticks),
    );
    line(
        "error, measured",
        format!("{} RMS after 2 s", nm(s.rms_measured_nm)),
    );
    if s.rms_true_nm.is_some() {
        line(
            "error, true",
            format!("{} RMS after 2 s", nm(s.rms_true_nm)),
        );
    }
    line(
        "lowest possible",
        format!(
            "{} RMS (Brownian motion, delay and noise in force)",
            nm(report.bound_rms_nm)
        ),
    );
    if let Some(step) = s.step {
        line(
            "step",
            format!(
                "{:+.2} um: within 5 % after {:.0} ms, overshoot {:.1} %",
                step.size_um, step.settling_ms, step.overshoot_percent
            ),
        );
    }
    line("loop delay", format!("{:.2} ms", s.loop_delay_ms));
    let c = &s.counts;
    line(
        "frames",
        format!(
            "{} lost, {} stale, {} without the bead, {} ticks coasted, bead re-acquired {} times",
            c.frames_lost, c.stale, c.fixes_lost, c.coasted, c.reacquired
        ),
    );
    let timing = |name: &str, q: &cellpos_runtime::latency::Quantiles| {
        format!(
            "{name} p50 {:.1} us, p99 {:.1} us, p99.9 {:.1} us, max {:.1} us",
            q.p50, q.p99, q.p999, q.max
        )
    };
    line("tick", timing("compute", &s.tick_us));
    line("", timing("wake-up", &s.wake_us));
    line("", format!("{} late, {} skipped", c.late, c.skipped));
    for degraded in &report.conditions.degraded {
        line("DEGRADED", degraded.clone());
    }
    for warning in report.warnings {
        line("WARNING", warning.clone());
    }
    if let Some(run) = &report.run {
        line("run", run.clone());
    }
    out
}
