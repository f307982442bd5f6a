//! `cellpos run`: a setpoint script in closed loop, with a row for each cycle; resumed after whatever ended it.

mod following;
pub(super) mod learning;
mod load;
mod over;
pub(super) mod possible;
mod queue;
mod ready;
pub(super) mod resume;
mod shown;
mod sink;
pub(crate) mod text;
mod unshown;

use crate::arguments::run_name;
use crate::checked;
use crate::clips;
use crate::keys;
use crate::loop_args::LoopArgs;
use crate::notify::NotifyArgs;
use crate::outcome::{CommandResult, Failure, Outcome, print_text};
use crate::view_args::ViewArgs;
use cellpos_emulator::FaultKind;
use cellpos_record::{InputFile, LineFile, RunWriter};
use cellpos_runtime::EndRule;
use cellpos_script::{AmplitudeWatch, CycleRow, CycleTable, Plan, Script};
use cellpos_session::clips::Clipped;
use cellpos_session::live_line::Typed;
use cellpos_session::rig_file::{ClockKind, Frames};
use cellpos_session::sessions::SessionConfig;
use cellpos_session::setup::Setup;
use cellpos_session::view::{Page, Viewed};
use cellpos_session::{Options, Rig, connect};
use learning::Keeper;
use over::{Over, Telling};
use ready::Ready;
use resume::Next;
use sink::{ScriptSink, Stalls};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Arguments of `cellpos run`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  cellpos run examples/scripts/fatigue.toml --dry
  cellpos run examples/scripts/step.toml --rig rig.toml --model model.toml --controller controller.toml
  cellpos run --resume runs/20261121T190000Z-fatigue
  cellpos run examples/scripts/fatigue.toml --rig rig.toml --cells 20 --between 30s

cellpos check runs first, with the limits of the rig. Keys on a terminal: p pauses and continues, s skips to the next step, q freezes
the bead, then parks the PZT. Signals do the same: SIGUSR1 (p), SIGUSR2 (s), Ctrl-C and SIGTERM (q); a second one parks at once.
--resume continues after the last complete cycle in cycles.csv, after a crash too. Exit code 0: the script reached its end; 1: it did
not; 2: bad input, or the rig cannot do it.")]
pub(crate) struct Args {
    /// The script.
    #[arg(required_unless_present = "resume", conflicts_with = "resume")]
    script: Option<PathBuf>,
    /// Resume a run that was stopped or cut off.
    #[arg(long, value_name = "RUN", value_parser = crate::arguments::run_folder(), conflicts_with_all = ["adapt", "ideal"])]
    resume: Option<PathBuf>,
    /// Rehearse on the virtual clock, on an emulated rig like --model.
    #[arg(long)]
    dry: bool,
    /// Learn the feed-forward of periodic motions, like `learn = true` in the script.
    #[arg(long, conflicts_with = "resume")]
    learn: bool,
    /// Clock of the emulated rig; default: real, with --dry virtual.
    #[arg(long, value_enum)]
    clock: Option<ClockKind>,
    /// Render frames of the emulated rig; default: on, with --dry off.
    #[arg(long, value_enum)]
    frames: Option<Frames>,
    /// Amplitude error that gives an alarm, % of the commanded amplitude (mean of ten cycles).
    #[arg(long, default_value_t = 10.0)]
    alarm_percent: f64,
    /// Name of the run; default: that of the script.
    #[arg(long, value_parser = run_name)]
    name: Option<String>,
    #[command(flatten)]
    run: LoopArgs,
    #[command(flatten)]
    queue: queue::QueueArgs,
    #[command(flatten)]
    view: ViewArgs,
    #[command(flatten)]
    notify: NotifyArgs,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// Runs a script, resumes one, or runs it on one cell after another.
pub(crate) fn run(args: Args) -> CommandResult {
    if let Some(cells) = args.queue.cells {
        return queue::run(&args, cells);
    }
    let ready = match &args.resume {
        Some(folder) => match resume::ready(folder, args.run.best_effort)? {
            Next::Session(mut ready) => {
                args.run.choose_near(&mut ready.file);
                *ready
            }
            Next::Nothing(why) => {
                print_text(&format!("{why}\n"))?;
                return Ok(Outcome::Done);
            }
        },
        None => fresh(&args)?,
    };
    let over = start(&args, ready, true)?;
    Ok(if over.whole {
        Outcome::Done
    } else {
        Outcome::Broken
    })
}

/// A new run from the arguments.
fn fresh(args: &Args) -> Result<Ready, Failure> {
    if !(args.alarm_percent > 0.0 && args.alarm_percent.is_finite()) {
        return Err(Failure::bad_input(
            format!("--alarm-percent {}: must be above 0", args.alarm_percent),
            "write for example 10",
        ));
    }
    let path = args.script.as_deref().unwrap_or(Path::new(""));
    let (reference, script, mut inputs) = load::script(path)?;
    let mut file = args.run.file()?;
    if args.dry {
        possible::rehearse(&mut file, &args.run.model);
    }
    for path in args.run.inputs(&file) {
        inputs.push(InputFile::of(path).map_err(Failure::input)?);
    }
    let (clock, frames) = if args.dry {
        (ClockKind::Virtual, Frames::Off)
    } else {
        (ClockKind::Real, Frames::On)
    };
    let name = args.name.clone().unwrap_or_else(|| {
        let dry = if args.dry { "-dry" } else { "" };
        format!("{}{dry}", script.name)
    });
    let prepared = args.run.prepare(&file)?;
    Ok(Ready {
        prepared,
        file,
        reference,
        clock: args.clock.unwrap_or(clock),
        name,
        session: SessionConfig {
            number: 1,
            first_cycle: 0,
            frames: args.frames.unwrap_or(frames) == Frames::On,
            best_effort: args.run.best_effort,
            alarm_percent: args.alarm_percent,
            learn: args.learn || script.learn,
            gap_s: None,
            after: None,
        },
        inputs,
        runs: args.run.runs.clone(),
        home: None,
    })
}

/// What a run takes besides its plan, at most: arming, and the way to where the plan begins, s.
const BEFORE_S: f64 = 30.0;

/// Runs what is ready; `tell`: whether its end is printed.
fn start(args: &Args, ready: Ready, tell: bool) -> Result<Over, Failure> {
    let Ready {
        file,
        mut prepared,
        reference,
        clock,
        name,
        session: config,
        inputs,
        runs,
        home,
    } = ready;
    let (script, plan) = reference.script()?.ok_or_else(|| {
        Failure::bad_input("the run has no script", "resume a run of cellpos run")
    })?;
    let plan = Arc::new(plan);
    let options = Options {
        clock,
        frames: if config.frames {
            Frames::On
        } else {
            Frames::Off
        },
        best_effort: config.best_effort,
    };
    let path = args.run.rig.as_deref().filter(|_| !args.dry);
    let mut rig = checked::open(file, options, path, args.run.anyway)?;
    rig.fit(&mut prepared);
    possible::allowed(&script, &plan, &prepared, &rig)?;
    let mut warnings = match config.learn {
        // What is learned is not missed.
        true => Vec::new(),
        false => following::warnings(&plan, &prepared, &rig)?,
    };
    let mut motions = Vec::new();
    if config.learn {
        let known = match &home {
            Some((folder, _)) => learning::load(folder),
            None => Vec::new(),
        };
        motions = learning::motions(&plan, &prepared, rig.file(), &known, &mut warnings);
    }
    let mut setup = rig.set_up(prepared, reference)?;
    setup.config.motions = motions;

    let mut meta = connect::meta(&name, clock, &[], &setup, &rig)?;
    meta.inputs = inputs;
    let table = connect::table(&config)?;
    meta.config
        .insert("session".to_string(), toml::Value::Table(table));
    let root = home.as_ref().map_or(runs.as_path(), |(_, root)| root);
    let ticks = (plan.longest_s() + BEFORE_S) * 1e6 / rig.file().timing.period_us;
    connect::room(root, Some(ticks as u64), &meta)?;
    let writer = RunWriter::create(root, meta).map_err(Failure::input)?;
    let session = writer.folder().to_owned();
    let folder = home.map_or_else(|| writer.folder().to_owned(), |(folder, _)| folder);
    let sink = sink(writer, &folder, &config, &plan, &setup, &rig)?;
    let mut core = setup.core()?;
    if rig.file().is_emulated() {
        let faults = &rig.file().emulator.faults;
        core = core.with_late_solver(faults.spans_ns(FaultKind::SlowSolver));
    }
    let shown = page(&name, &script);
    let typed = Typed::default();
    let mut view = (args.view).open(&mut rig, &setup, &shown, keys::OF_A_SCRIPT, &typed)?;
    view.iter().for_each(|view| view.recorded_in(&session));
    let wishes = script.clips.clone().unwrap_or_default();
    let clips = clips::of(&mut rig, &session, script.clips.as_ref())?;
    let schedule = clips::schedule(&plan, &wishes);
    let sink = sink.with_page(view.is_some());
    let sink = Clipped::new(sink, clips, schedule, wishes.events);
    let sink = Viewed::new(sink, view.as_mut());
    let keys = keys::of_a_script(rig.operator());
    let armed = match rig.arm(&setup, core, sink, EndRule::default()) {
        Ok(armed) => armed,
        Err(not_armed) => {
            let sink = not_armed.sink.refused(&not_armed.failure);
            drop(view);
            connect::not_armed(sink.into_parts().0.close().0, &not_armed.failure);
            return Err(not_armed.failure);
        }
    };
    let finished = armed.start()?.wait()?;
    drop(keys);
    over::conclude(
        Telling {
            notify: &args.notify,
            json: args.json,
            tell,
        },
        &setup,
        &plan,
        folder,
        warnings,
        (finished, view),
    )
}

fn page(name: &str, script: &Script) -> Page {
    Page {
        name: name.to_string(),
        subtitle: format!("run: {}", script.file),
        steered: false,
        script: true,
        notes: true,
    }
}

/// Where the records go.
fn sink(
    writer: RunWriter,
    folder: &Path,
    config: &SessionConfig,
    plan: &Arc<Plan>,
    setup: &Setup,
    rig: &Rig,
) -> Result<ScriptSink, Failure> {
    let timing = &rig.file().timing;
    let live = !rig.clock().is_virtual();
    let lines = LineFile::open(
        &folder.join(cellpos_record::CYCLES_CSV),
        &CycleRow::csv_head(),
        live,
    )
    .map_err(Failure::failed)?;
    let cycles = CycleTable::new(
        Arc::clone(plan),
        config.number,
        config.first_cycle,
        timing.camera_delay_ms,
        timing.period_us,
    );
    let mut sink = ScriptSink::new(
        writer,
        lines,
        cycles,
        AmplitudeWatch::new(config.alarm_percent * 1e-2, AmplitudeWatch::WINDOW),
        Arc::clone(plan),
        Arc::clone(rig.operator()),
        config,
    );
    if config.number > 1 {
        sink = sink.with_cycles_done(&resume::cycles(folder)?);
    }
    if let Some(keeper) = Keeper::new(folder, &setup.config.motions, timing.period_us * 1e-6) {
        sink = sink.with_keeper(keeper, live);
    }
    if rig.file().is_emulated() {
        sink = sink.with_stalls(Stalls {
            spans_ns: rig
                .file()
                .emulator
                .faults
                .spans_ns(FaultKind::StallRecorder),
            clock: rig.clock().clone(),
        });
    }
    Ok(sink)
}
