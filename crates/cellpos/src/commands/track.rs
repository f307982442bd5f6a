//! `cellpos track`: hold a bead, or go to a position, in closed loop.

mod target;

use crate::arguments::{positive, run_name};
use crate::checked;
use crate::clips;
use crate::kept;
use crate::keys::{self, Steering};
use crate::loop_args::LoopArgs;
use crate::notify::{NotifyArgs, What};
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use crate::view_args::ViewArgs;
use cellpos_control::{ControllerFile, ControllerKind, LearnedTable, SolverKind};
use cellpos_numeric::units::{Micrometers, Seconds};
use cellpos_record::RunWriter;
use cellpos_runtime::realtime::Conditions;
use cellpos_runtime::{EndRule, Summary};
use cellpos_session::adapt;
use cellpos_session::clips::Clipped;
use cellpos_session::cyclic::{self, LearnSpec, Sine};
use cellpos_session::live_line::{LiveLine, Typed};
use cellpos_session::recording::Recording;
use cellpos_session::rig_file::{ClockKind, Frames, RigFile};
use cellpos_session::setup::{Prepared, ReferenceSpec, Setup};
use cellpos_session::view::{Page, View, Viewed};
use cellpos_session::words::of_what_is_followed;
use cellpos_session::{EndKind, Ended, Finished, Options, Rig, connect};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Arguments of `cellpos track`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  cellpos track --target 0um
  cellpos track --target 10um --duration 5s --clock virtual --seed 7 --json
  cellpos track --target 0um --rig rig.toml --controller controller.toml
  cellpos track --target 0um --sine 5um@50Hz --controller lqg --learn --duration 5s

Without --rig the rig is emulated. Ctrl-C freezes the bead, then parks the PZT; a second Ctrl-C parks at once. Keys on a terminal:
f freezes and continues, q ends like Ctrl-C, the arrows move the target (left, right: 0.1 um; down, up: 1 um), a number and Enter
sets it. Exit code 0: done; 1: Safe, or the bead was not kept; 2: bad input.")]
pub(crate) struct Args {
    /// Position to hold.
    #[arg(long, allow_hyphen_values = true)]
    target: Micrometers,
    /// Duration; default: until Ctrl-C.
    #[arg(long, value_parser = positive::<Seconds>)]
    duration: Option<Seconds>,
    /// Follow a sine about the target: amplitude@frequency.
    #[arg(long, value_name = "5um@50Hz")]
    sine: Option<Sine>,
    /// Learn the feed-forward of the sine; the run folder keeps it as learned.toml.
    #[arg(long, requires = "sine")]
    learn: bool,
    /// Start from the learned.toml of an earlier run.
    #[arg(long, requires = "learn")]
    learned: Option<PathBuf>,
    /// Solver of mpc; default: that of controller.toml, else active-set.
    #[arg(long, value_enum)]
    solver: Option<Solver>,
    /// Clock of the emulated rig.
    #[arg(long, value_enum, default_value = "real")]
    clock: ClockKind,
    /// Render frames of the emulated rig.
    #[arg(long, value_enum, default_value = "on")]
    frames: Frames,
    /// Name of the run.
    #[arg(long, default_value = "track", value_parser = run_name)]
    name: String,
    /// Do not write a run folder.
    #[arg(long)]
    no_record: bool,
    #[command(flatten)]
    run: LoopArgs,
    #[command(flatten)]
    view: ViewArgs,
    #[command(flatten)]
    notify: NotifyArgs,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// Solvers of mpc.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Solver {
    /// Interior-point method.
    Clarabel,
    /// Dual active-set method: faster, no allocation.
    ActiveSet,
}

/// What `--json` prints.
#[derive(Debug, Serialize)]
struct Report<'a> {
    ended: &'a Ended,
    #[serde(flatten)]
    summary: &'a Summary,
    target_um: f64,
    controller: &'a str,
    bound_rms_nm: Option<f64>,
    conditions: &'a Conditions,
    warnings: &'a [String],
    learned: Option<&'a LearnedTable>,
    run: Option<String>,
}

/// Holds the bead.
pub(crate) fn run(args: Args) -> CommandResult {
    let file = args.run.file()?;
    let ticks = ticks(args.duration, file.timing.period_us)?;
    let options = Options {
        clock: args.clock,
        frames: args.frames,
        best_effort: args.run.best_effort,
    };
    let mut prepared = args.run.prepare(&file)?;
    choose_solver(args.solver, &mut prepared.controller)?;
    let mut rig = checked::open(file, options, args.run.rig.as_deref(), args.run.anyway)?;
    rig.fit(&mut prepared);
    target::check(args.target, args.sine.map(|sine| sine.amplitude), &rig)?;
    let predicted = cyclic::predicted(args.sine, &prepared, rig.file())?;
    let limits = prepared.controller.limits;
    let learn = learn(&args, &prepared, rig.file())?;
    let mut setup = rig.set_up(prepared, reference(&args))?;
    setup.config.learn = learn;
    let (typed, steered) = (Typed::default(), args.sine.is_none());
    let help = if steered {
        keys::OF_A_HOLD
    } else {
        keys::OF_A_MOTION
    };
    let line = LiveLine {
        low_um: limits.low_um,
        high_um: limits.high_um,
        keys: help,
        typed: typed.clone(),
    };
    let recording = Recording::new(
        writer(&args, &rig, &setup)?,
        (!args.json && !args.view.tui() && !crate::output::settings().quiet).then_some(line),
    )
    .steered(steered);
    let end = EndRule {
        ticks,
        ..EndRule::default()
    };
    let core = setup.core()?;
    let shown = page(&args);
    let mut view = (args.view).open(&mut rig, &setup, &shown, help, &typed)?;
    let clips = match recording.folder() {
        Some(folder) => {
            view.iter().for_each(|view| view.recorded_in(&folder));
            clips::of(&mut rig, &folder, None)?
        }
        None => None,
    };
    let sink = Clipped::new(recording, clips, vec![], true);
    let sink = Viewed::new(sink, view.as_mut());
    let view_um = rig.source().field_um;
    let _keys = (args.clock == ClockKind::Real).then(|| {
        keys::of_a_track(Steering::new(
            rig.operator(),
            typed,
            args.target.value(),
            view_um,
            steered,
        ))
    });
    match rig.arm(&setup, core, sink, end) {
        Ok(armed) => {
            let finished = armed.start()?.wait()?;
            conclude(&args, &setup, finished, predicted, view)
        }
        Err(not_armed) => {
            let sink = not_armed.sink.refused(&not_armed.failure);
            drop(view);
            if let Some(writer) = sink.into_parts().0.into_writer() {
                connect::not_armed(writer, &not_armed.failure);
            }
            let reason = not_armed.failure.to_string();
            args.notify.tell(What::Failed, &args.name, &reason, None);
            Err(not_armed.failure)
        }
    }
}

fn page(args: &Args) -> Page {
    let motion = args.sine.map_or_else(
        || "hold".to_string(),
        |sine| format!("sine of {} at {}", sine.amplitude, sine.frequency),
    );
    let rig = args.run.rig.as_ref().map_or_else(
        || "emulated rig".to_string(),
        |path| path.display().to_string(),
    );
    Page {
        name: args.name.clone(),
        subtitle: format!("track: {motion}, {}, {rig}", args.run.controller),
        steered: args.sine.is_none(),
        script: false,
        notes: !args.no_record,
    }
}

fn reference(args: &Args) -> ReferenceSpec {
    let centre_um = args.target.value();
    match args.sine {
        Some(sine) => ReferenceSpec::Sine {
            centre_um,
            amplitude_um: sine.amplitude.value(),
            frequency_hz: sine.frequency.value(),
            fade_s: cyclic::FADE_S,
        },
        None => ReferenceSpec::Hold {
            position_um: centre_um,
        },
    }
}

fn learn(args: &Args, prepared: &Prepared, file: &RigFile) -> Result<Option<LearnSpec>, Failure> {
    let table = args
        .learned
        .as_deref()
        .map(cyclic::load_table)
        .transpose()?;
    args.sine
        .filter(|_| args.learn)
        .map(|sine| LearnSpec::for_sine(prepared, file, sine, table))
        .transpose()
}

/// The run folder, unless none is wanted.
fn writer(args: &Args, rig: &Rig, setup: &Setup) -> Result<Option<RunWriter>, Failure> {
    if args.no_record {
        return Ok(None);
    }
    let file = rig.file();
    let mut inputs = args.run.inputs(file);
    inputs.extend(args.learned.as_deref());
    let meta = connect::meta(&args.name, args.clock, &inputs, setup, rig)?;
    let ticks = ticks(args.duration, file.timing.period_us)?;
    connect::room(&args.run.runs, ticks, &meta)?;
    let writer = RunWriter::create(&args.run.runs, meta).map_err(Failure::input)?;
    Ok(Some(writer))
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

fn choose_solver(solver: Option<Solver>, controller: &mut ControllerFile) -> Result<(), Failure> {
    let Some(solver) = solver else {
        return Ok(());
    };
    if controller.controller != ControllerKind::Mpc {
        return Err(Failure::bad_input(
            "--solver is a choice of mpc, and the controller is another",
            "write --controller mpc, or leave --solver out",
        ));
    }
    controller.mpc.solver = match solver {
        Solver::Clarabel => SolverKind::Clarabel,
        Solver::ActiveSet => SolverKind::ActiveSet,
    };
    Ok(())
}

fn conclude(
    args: &Args,
    setup: &Setup,
    finished: Finished<Viewed<Clipped<Recording>>>,
    predicted: Option<String>,
    view: Option<View>,
) -> CommandResult {
    let mut warnings = connect::warnings(&finished);
    warnings.extend(predicted);
    let Finished {
        ended,
        rig,
        mut summary,
        conditions,
        learned,
        sink,
        ..
    } = finished;
    // A sine is one motion.
    let learned = learned.into_iter().flatten().next();
    let healthy = ended.as_asked();
    let outcome = if healthy {
        "done"
    } else {
        summary.state.name()
    };
    let (sink, kept_clips) = sink.into_inner(&summary, &ended).into_parts();
    // First release the terminal and end the page, then print.
    drop(view);
    warnings.extend(clips::warnings(kept_clips));
    let kept = sink.into_writer().map(|writer| {
        connect::finish(
            writer,
            (outcome, &ended),
            &mut summary,
            &conditions,
            &mut warnings,
        )
    });
    let whole = kept.as_ref().is_none_or(|kept| kept.whole);
    let run = kept.map(|kept| kept.run);
    if let (Some(run), Some(table)) = (&run, &learned)
        && let Err(error) = cyclic::save_table(Path::new(run), table)
    {
        warnings.push(format!("no learned.toml: {error}"));
    }
    let what = match ended.kind {
        EndKind::Operator | EndKind::Stopped => What::Stop,
        _ if healthy => What::End,
        _ => What::Safe,
    };
    let told = (args.notify).tell(what, &args.name, &ended.to_string(), run.as_deref());
    warnings.extend(told);
    let bound_rms_nm = connect::bound_rms_nm(rig.file(), setup, &summary);
    let report = Report {
        ended: &ended,
        summary: &summary,
        target_um: args.target.value(),
        controller: &args.run.controller,
        bound_rms_nm,
        conditions: &conditions,
        warnings: &warnings,
        learned: learned.as_ref(),
        run,
    };
    if args.json {
        print_json(&report)?;
    } else {
        print_text(&of_what_is_followed(
            &text(&report),
            rig.file().follows_a_cell(),
        ))?;
    }
    Ok(if healthy && whole {
        Outcome::Done
    } else {
        Outcome::Broken
    })
}

fn text(report: &Report) -> String {
    let s = report.summary;
    let nm = |value: Option<f64>| value.map_or_else(|| "-".to_string(), |nm| format!("{nm:.1} nm"));
    let mut out = String::new();
    let mut line = |name: &str, value: String| out.push_str(&format!("{name:<18}{value}\n"));
    line(
        "state",
        format!("{}: {}", s.state.name(), report.ended.seen),
    );
    if !report.ended.as_asked() {
        line("expected", report.ended.expected.clone());
        line("to do", report.ended.to_do.clone());
    }
    line(
        "duration",
        format!("{:.3} s, {} ticks", s.duration_s, s.counts.ticks),
    );
    line("error", kept::error(&s.kept));
    line("held", kept::held(&s.kept));
    line(
        "error, measured",
        format!("{} RMS, noise of the fixes included", nm(s.rms_measured_nm)),
    );
    if s.rms_true_nm.is_some() {
        line(
            "error, true",
            format!("{} RMS, from the same time on", nm(s.rms_true_nm)),
        );
    }
    line(
        "lowest possible",
        connect::possible_text(report.bound_rms_nm, s.rms_measured_nm),
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
    if let Some(now) = &s.adaptation {
        line("adaptation", adapt::text(now));
    }
    if let Some(learned) = report.learned {
        line("learning", cyclic::learned_text(learned));
    }
    if s.counts.plans_stopped + s.counts.plans_reused + s.counts.solver_fallbacks > 0 {
        line(
            "solver",
            format!(
                "{} ticks out of time (best feasible point), {} on the previous plan, {} on PI",
                s.counts.plans_stopped, s.counts.plans_reused, s.counts.solver_fallbacks
            ),
        );
    }
    if s.records_lost > 0 {
        line(
            "LOST",
            format!("{} rows could not be written", s.records_lost),
        );
    }
    if let Some(lost) = s.commands_lost.filter(|&lost| lost > 0) {
        line(
            "commands",
            super::run::text::commands_lost(lost, s.commands_not_taken),
        );
    }
    line("loop delay", format!("{:.2} ms", s.loop_delay_ms));
    let c = &s.counts;
    line(
        "frames",
        format!(
            "{} lost, {} stale, {} without a position, {} ticks coasted, bead re-acquired {} times",
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
