//! `cellpos reconcile`: where simulation and measurement disagree, what is missing, added and shown.

mod model;
mod records;

use crate::commands::identify::HoldKind;
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use crate::output;
use crate::rig_file::{ClockKind, Frames, RigFile};
use cellpos_plant::Model;
use cellpos_plant::effects::{self, Definition};
use cellpos_reconcile::{Gap, NoiseKind, Options, Reconciliation, Units, Verdict, figure_of};
use cellpos_record::RunReader;
use cellpos_workbench::experiment::collect::{self, Collected, Collecting};
use cellpos_workbench::experiment::on_rig::OnRig;
use cellpos_workbench::foreign::{columns, form};
use model::{Asked, Data};
use records::{Columns, Noises, files, is_run, read, read_run};
use std::path::{Path, PathBuf};

/// Heading of the options that need a rig.
const ON_A_RIG: &str = "To collect on a rig what the records leave open";

/// Find what a model lacks, compared with records.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  cellpos reconcile --model eq6 --data runs/monday --out augmented.toml --report gap.html --json result.json
  cellpos reconcile --model eq6 --collect more --rig rig.toml --out augmented.toml
  cellpos reconcile --model base.toml --data d.csv --input u --output y --out augmented.toml
  cellpos reconcile --base --data d.csv --input u --output y --out augmented.toml
  cellpos reconcile --base order=2,delay --data d.csv --input 'p [kW]' --output 'T [degC]' --effects mine.toml
  cellpos reconcile --model fit --data Model_Vi_Do.dat --rows 0:8027 --input-column 1 --output-column 5 --rate 200Hz

Verdicts: named; named-with-remainder (something small is left); ambiguous (the records fit several effects; the result names the experiment that decides);
unknown (no effect of the catalogue explains enough); nothing-missing. Exit code 0: any verdict; 2: bad input.")]
pub(crate) struct Args {
    /// Model: eq6, the path of a model.toml, or `fit` for a constant gain fitted to the records.
    #[arg(long, default_value = "eq6")]
    model: String,
    /// For another rig, instead of --model: a linear model of this form, fitted to the records: order=N, with zeros=N, delay, integrating if you want them; or static. Without a form, or with auto, the records choose it.
    #[arg(long, conflicts_with_all = ["model", "collect"], num_args = 0..=1, default_missing_value = "auto", value_name = "FORM")]
    base: Option<form::Asked>,
    /// Records (text, .npy, .mat), run folders, or folders of both.
    #[arg(long, required_unless_present = "collect", num_args = 1.., value_parser = crate::arguments::run_folder())]
    data: Vec<PathBuf>,
    /// Run the experiments on the rig that decide, and keep their records in FOLDER.
    #[arg(long, value_name = "FOLDER", help_heading = ON_A_RIG)]
    collect: Option<PathBuf>,
    /// Rig file to collect with; default: the emulated rig.
    #[arg(long, requires = "collect", help_heading = ON_A_RIG)]
    rig: Option<PathBuf>,
    /// Largest number of experiments.
    #[arg(long, default_value_t = 2, requires = "collect", value_parser = clap::value_parser!(u8).range(1..=10), help_heading = ON_A_RIG)]
    rounds: u8,
    /// Factor on the duration of the experiments, 0.2 to 10.
    #[arg(long, default_value_t = 1.0, requires = "collect", help_heading = ON_A_RIG)]
    effort: f64,
    /// false: the emulated rig has the imperfections of a real one [default: as rig.toml says].
    #[arg(long, value_name = "BOOL", num_args = 0..=1, require_equals = true, default_missing_value = "true", help_heading = ON_A_RIG, requires = "collect")]
    ideal: Option<bool>,
    /// Seed of the emulated rig and of the excitations [default: that of rig.toml].
    #[arg(long, requires = "collect", help_heading = ON_A_RIG)]
    seed: Option<u64>,
    /// Clock of the emulated rig [default: virtual; a real rig has the real one].
    #[arg(long, value_enum, requires = "collect", help_heading = ON_A_RIG)]
    clock: Option<ClockKind>,
    /// Render frames of the emulated rig.
    #[arg(long, value_enum, default_value = "on", requires = "collect", help_heading = ON_A_RIG)]
    frames: Frames,
    /// Run without real-time priority.
    #[arg(long, requires = "collect", help_heading = ON_A_RIG)]
    best_effort: bool,
    /// Your own effects, searched like those of the catalogue (see docs/find-missing.md).
    #[arg(long, value_name = "FILE")]
    effects: Vec<PathBuf>,
    /// Write the augmented model here; with the verdict unknown, a hypothesis goes to NAME.effects.toml.
    #[arg(long)]
    out: Option<PathBuf>,
    /// Write the report here (HTML).
    #[arg(long)]
    report: Option<PathBuf>,
    /// Print the result as JSON, or write it to FILE.
    #[arg(long, num_args = 0..=1, default_missing_value = "-", value_name = "FILE")]
    json: Option<PathBuf>,
    #[command(flatten)]
    columns: Columns,
    /// Input between rows: a command is held (zero-order), a measured signal is not (none) [default: as the model was
    /// identified, else zero-order].
    #[arg(long, value_enum)]
    hold: Option<HoldKind>,
    /// Largest number of effects to add.
    #[arg(long, default_value_t = 4)]
    max_effects: usize,
    /// Factor on the number of simulations of the search.
    #[arg(long, default_value_t = 1.0)]
    work: f64,
    /// Noise of the records: auto (walk and white noise; without a stated diffusion, coloured if the likelihood asks for it), walk, coloured (first-order and white noise), white.
    #[arg(long, value_enum, default_value = "auto")]
    noise: NoiseArg,
    /// Threads; the result does not depend on them.
    #[arg(long)]
    threads: Option<usize>,
}

/// Kinds of noise, as they are given on the command line.
#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum NoiseArg {
    Auto,
    Walk,
    Coloured,
    White,
}

impl From<NoiseArg> for NoiseKind {
    fn from(arg: NoiseArg) -> Self {
        match arg {
            NoiseArg::Auto => Self::Auto,
            NoiseArg::Walk => Self::Walk,
            NoiseArg::Coloured => Self::Coloured,
            NoiseArg::White => Self::White,
        }
    }
}

/// Runs the command.
pub(crate) fn run(args: Args) -> CommandResult {
    collectable(&args)?;
    let json = args.json.iter().filter(|path| path.as_os_str() != "-");
    let beside: Vec<PathBuf> = args
        .out
        .iter()
        .flat_map(|out| [proposal_path(out), out.with_extension("best.toml")])
        .collect();
    output::ready(
        args.out
            .iter()
            .chain(&args.report)
            .chain(json)
            .chain(&beside),
    )?;
    let mut own_effects = Vec::new();
    for file in &args.effects {
        let kinds = Definition::load_file(file).map_err(Failure::input)?;
        own_effects.extend(kinds.iter().map(|kind| kind.spec().id));
    }
    let files = files(&args.data)?;
    let mut records = Vec::new();
    let mut rests_um = Vec::new();
    let mut noises = Noises::default();
    for file in &files {
        if is_run(file) {
            let run = RunReader::open(file).map_err(Failure::input)?;
            noises.add(file, &run)?;
            let (record, rest_um) = read_run(file, &run)?;
            records.push(record);
            rests_um.extend(rest_um);
        } else {
            records.push(read(
                file,
                &args.columns,
                args.hold != Some(HoldKind::None),
            )?);
        }
    }
    let threads = args
        .threads
        .unwrap_or_else(|| std::thread::available_parallelism().map_or(2, std::num::NonZero::get))
        .max(1);
    let mut options = Options {
        threads,
        max_effects: args.max_effects,
        work: args.work,
        noise: args.noise.into(),
        own_effects,
        ..Options::default()
    };
    let data = Data {
        records: &records,
        rests_um: &rests_um,
    };
    let asked = Asked {
        model: &args.model,
        base: args.base,
        hold: args.hold,
    };
    let model = model::model_of(&asked, &data, &mut options)?;
    if options.free_start || options.free_gain {
        options.units = units(&args.columns, &files);
    }
    let bar = output::progress_bar(None);
    let mut progress = |text: &str| {
        bar.set_message(text.to_owned());
        bar.tick();
    };
    let mut collected = Vec::new();
    let mut result = match &args.collect {
        None => model::reconcile_or_refit(&model, &records, &options, &mut progress)?,
        Some(folder) => {
            let mut model = model;
            let rig = rig(&args, &model)?;
            let collecting = Collecting {
                rig: &rig,
                folder,
                rounds: usize::from(args.rounds),
                share: args.effort,
                seed: rig.file.emulator.seed,
            };
            let found = collect::look(
                &mut model,
                &mut records,
                &options,
                &collecting,
                &mut progress,
            )?;
            collected = found.1;
            found.0
        }
    };
    bar.finish_and_clear();
    for model in [&mut result.augmented, &mut result.best] {
        model::put_output_at_rest(model, &records, &options)?;
    }
    tell(&mut result);
    write(&args, &result, &collected)?;
    Ok(Outcome::Done)
}

fn collectable(args: &Args) -> Result<(), Failure> {
    if args.collect.is_none() {
        return Ok(());
    }
    if args.model == "fit" {
        return Err(Failure::bad_input(
            "--collect with --model fit: a rig is held in a loop, and the loop needs a model",
            "name a model file, or eq6",
        ));
    }
    if !(0.2..=10.0).contains(&args.effort) {
        return Err(Failure::bad_input(
            format!("--effort {}: out of range", args.effort),
            "give 0.2 to 10",
        ));
    }
    Ok(())
}

/// The rig to collect on.
fn rig(args: &Args, model: &Model) -> Result<OnRig, Failure> {
    let mut file = RigFile::load(args.rig.as_deref())?;
    file.emulate_as(args.seed, args.ideal)?;
    OnRig::new(
        file,
        model.clone(),
        args.clock,
        args.frames,
        args.best_effort,
    )
}

/// Title of a page: at most two names of records.
fn heading<'a>(records: impl Iterator<Item = &'a Path>) -> String {
    let names: Vec<String> = records
        .map(|path| path.file_name().unwrap_or(path.as_os_str()))
        .map(|name| name.to_string_lossy().into_owned())
        .collect();
    match names.as_slice() {
        [first, _, _, ..] => format!("{first} and {} more", names.len() - 1),
        few => few.join(", "),
    }
}

fn write(args: &Args, result: &Reconciliation, collected: &[Collected]) -> Result<(), Failure> {
    if let Some(path) = &args.out {
        output::write(path, &result.augmented.to_toml_string())?;
    }
    let unnamed = unnamed(args, result);
    if let Some(path) = &unnamed {
        output::write(path, &result.best.to_toml_string())?;
    }
    let proposed = proposed(args, result);
    if let Some((path, text)) = &proposed {
        output::write(path, text)?;
    }
    if let Some(path) = &args.report {
        let count = collected.len();
        let collected = collected.iter().map(|one| one.file.as_path());
        let records = heading(args.data.iter().map(PathBuf::as_path).chain(collected));
        let model = match &args.base {
            Some(_) => "a linear model fitted to the records".to_owned(),
            None if args.model == "fit" => "a constant gain fitted to the records".to_owned(),
            None => format!("the model {}", args.model),
        };
        let name = match args.model.as_str() {
            "fit" => "a constant gain",
            model => model,
        };
        let title = match (&args.base, args.data.len() + count) {
            (Some(_), 1) => "what one record has beyond a linear model".to_owned(),
            (Some(_), n) => format!("what {n} records have beyond a linear model"),
            (None, 1) => format!("{name} against one record"),
            (None, n) => format!("{name} against {n} records"),
        };
        let lead = format!(
            "Task: find what {model} lacks, compared with {records}. Each effect of a catalogue was added to the model, fitted to a part of \
             the records, and kept if it predicts the rest better than chance allows."
        );
        output::write(
            path,
            &cellpos_reconcile::report(result, &title)
                .lead(&lead)
                .command(&cellpos_session::provenance::command_text())
                .to_html(),
        )?;
    }
    let mut json = result.to_json();
    if args.collect.is_some() {
        json["collected"] = serde_json::to_value(collected).map_err(Failure::failed)?;
    }
    match &args.json {
        Some(path) if path.as_os_str() == "-" => return print_json(&json),
        Some(path) => {
            let text = serde_json::to_string_pretty(&json).map_err(Failure::failed)?;
            output::write(path, &(text + "\n"))?;
        }
        None => {}
    }
    let mut text = String::new();
    for c in collected {
        text.push_str(&format!(
            "collected: {} ({}), {} rows in {}, then {}\n  because {}\n",
            c.experiment,
            c.what,
            c.rows,
            c.file.display(),
            c.verdict,
            c.why
        ));
    }
    text.push_str(&summary(result));
    if let Some((path, _)) = &proposed {
        text.push_str(&format!(
            "the hypothesis as effects of your own: {}; edit it, and run again with --effects\n",
            path.display()
        ));
    }
    if let Some(path) = &unnamed {
        text.push_str(&format!(
            "the model with the best set, its names not earned: {}\n",
            path.display()
        ));
    }
    print_text(&text)
}

/// With user-defined effects and no name: the file of the model with the best set.
fn unnamed(args: &Args, result: &Reconciliation) -> Option<PathBuf> {
    let wanted = !args.effects.is_empty() && result.verdict == Verdict::Unknown;
    wanted.then(|| args.out.as_ref().map(|out| out.with_extension("best.toml")))?
}

/// If the verdict is unknown and has a formula: the file next to the augmented model, and its text.
fn proposed(args: &Args, result: &Reconciliation) -> Option<(PathBuf, String)> {
    let text = result
        .proposal_toml()
        .filter(|_| result.verdict == Verdict::Unknown)?;
    Some((proposal_path(args.out.as_ref()?), text))
}

/// Lists the effects that were not searched for.
fn tell(result: &mut Reconciliation) {
    if result.verdict == Verdict::NothingMissing {
        result.places.push(not_looked_for());
    }
}

/// The units of other data, as the names of its columns in the first file give them.
fn units(columns: &Columns, files: &[PathBuf]) -> Units {
    let asked = [
        columns.input_column.as_str(),
        columns.output_column.as_str(),
    ];
    let file = files.iter().find(|file| !is_run(file));
    let [input, output] = match file {
        Some(file) => columns::names_in(file, asked),
        None => asked.map(str::to_owned),
    };
    let unit = |name: &str, else_it_is: &str| {
        columns::unit_of(name).map_or_else(|| else_it_is.to_owned(), str::to_owned)
    };
    Units {
        input: unit(&input, "input units"),
        output: unit(&output, "output units"),
    }
}

/// Limits of the verdict nothing-missing: effects that are simulated but not searched for.
fn not_looked_for() -> String {
    // Frames that are missing or repeated are counted, not fitted.
    let counted = ["frame-drops", "frame-repeats"];
    let unsought = effects::all()
        .into_iter()
        .filter(|kind| kind.candidates().is_empty() && !counted.contains(&kind.spec().id));
    let ids: Vec<&str> = unsought.map(|kind| kind.spec().id).collect();
    format!(
        "not looked for: {}; the floor may hold them, and nothing is said of them",
        ids.join(", ")
    )
}

fn proposal_path(out: &Path) -> PathBuf {
    out.with_extension("effects.toml")
}

/// The free run of a plant that integrates wanders with the noise: a difference is stated only if it exceeds that.
fn free_run(g: &Gap) -> String {
    let (f, unit) = (cellpos_reconcile::figure, &g.unit);
    let of = "gap on held-out records, RMS of free run:  ";
    let [before, after, floor] = [g.free_run_before, g.free_run_after, g.free_run_floor].map(f);
    match g.free_run_after < g.free_run_before {
        true => format!(
            "{of} {before} {unit} before, {after} {unit} after, noise alone about {floor} {unit}\n"
        ),
        false => format!(
            "{of} decides nothing here: {before} to {after} {unit}, of which noise alone makes about {floor} {unit}\n"
        ),
    }
}

fn summary(result: &Reconciliation) -> String {
    use std::fmt::Write as _;
    let mut s = format!("verdict: {}\n", result.verdict.word());
    for e in &result.effects {
        let _ = writeln!(
            s,
            "  {} (at the {}); without it {:.1} % of the excess comes back",
            e.id,
            e.place,
            100.0 * e.explained
        );
        for (name, p) in &e.parameters {
            let _ = writeln!(
                s,
                "    {name} = {} {} (95 %: {} .. {})",
                figure_of(p.value, 6),
                p.unit,
                figure_of(p.ci95[0], 6),
                figure_of(p.ci95[1], 6)
            );
        }
        if !e.alternatives.is_empty() {
            let _ = writeln!(s, "    or: {}", e.alternatives.join(", "));
        }
        if let Some(by) = &e.separate_by {
            let _ = writeln!(s, "    to separate: {by}");
        }
    }
    for p in &result.places {
        let _ = writeln!(s, "where: {p}");
    }
    if let Some(h) = &result.hypothesis {
        let _ = writeln!(
            s,
            "hypothesis ({:.0} % on held-out data): {}",
            100.0 * h.held_out_worth,
            h.formula
        );
    }
    if let Some(rest) = &result.remainder {
        let _ = writeln!(
            s,
            "remainder: {:.1} % of the excess: {}; {}",
            100.0 * rest.share,
            rest.how,
            rest.places.join("; ")
        );
    }
    let g = &result.gap;
    let (f, unit) = (cellpos_reconcile::figure, &g.unit);
    let _ = writeln!(
        s,
        "gap on held-out records, RMS of innovation: {} {unit} before, {} {unit} after, floor {} {unit} ({})",
        f(g.before),
        f(g.after),
        f(g.floor),
        result.floor.words()
    );
    s.push_str(&free_run(g));
    s
}
