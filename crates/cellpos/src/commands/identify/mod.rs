//! `cellpos identify`: excite, measure the frequency response, fit, write model.toml and a report.

mod foreign;

use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use crate::output;
use crate::rig_file::{ClockKind, Frames, RigFile};
use crate::view_args::{self, PageArgs};
use cellpos_emulator::WorldConfig;
use cellpos_ident::excitation::{ExcitationLimits, PAPER_FREQUENCIES_HZ};
use cellpos_ident::sampled::Hold;
use cellpos_numeric::units::{Hertz, Micrometers, MicrometersPerSecond, Seconds};
use cellpos_plant::Model;
use cellpos_rig::Clock;
use cellpos_session::OF_BOARD;
use cellpos_session::provenance;
use cellpos_session::provenance::command_text;
use cellpos_session::rig_file::ActuatorConfig;
use cellpos_session::view::{Page, Pages};
use cellpos_workbench::experiment::identify::held_bead::Setup;
use cellpos_workbench::experiment::identify::{self as identification, Excitation, page, said};
use cellpos_workbench::experiment::on_rig::OnRig;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// On or off.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Switch {
    /// Render frames and find the bead in them.
    On,
    /// Positions with equivalent noise: faster.
    Off,
}

/// Headings of the two uses.
const ON_A_RIG: &str = "To measure a rig";
const ON_RECORDS: &str = "To fit records of any rig";

/// Arguments of `cellpos identify`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cellpos identify --seed 3 --out model.toml --report identify.html\n  \
    cellpos identify --rig rig.toml --out model.toml\n  \
    cellpos identify --data runs/20261121T190000Z-sine\n  \
    cellpos identify --data record.csv --input pzt_um --output bead_um --rate 1kHz\n  \
    cellpos identify --data heater.csv --input 'power [W]' --output 'T [degC]' --base order=2,delay --out base.toml\n  \
    cellpos identify --response bode.csv --out base.toml\n  \
    cellpos identify --data Model_Vi_Do.dat --input 1 --output 5 --rate 200Hz --hold none")]
pub(crate) struct Args {
    /// Run folders, records of cellpos, or records of any rig with --input and --output.
    #[arg(long, num_args = 1.., value_parser = crate::arguments::run_folder(), help_heading = ON_RECORDS)]
    data: Vec<PathBuf>,
    /// Frequency response instead of records: a table (text, .npy, .mat) with `freq [Hz]` or `w [rad/s]`, and gain (or `gain [dB]`) and `phase [deg]` (or `[rad]`), or re and im.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["data", "rig", "resume"], help_heading = ON_RECORDS)]
    response: Option<PathBuf>,
    /// Input column: its name, with or without the unit, or its number from 1.
    #[arg(long, alias = "input-column", requires_all = ["data", "output"], help_heading = ON_RECORDS)]
    input: Option<String>,
    /// Output column: its name, or its number from 1.
    #[arg(long, alias = "output-column", requires = "input", help_heading = ON_RECORDS)]
    output: Option<String>,
    /// Time column, in the unit of its name (`t [ms]`), else in seconds [default: the one called time or t].
    #[arg(long, requires = "input", help_heading = ON_RECORDS)]
    time_column: Option<String>,
    /// Sampling rate of records without a time column.
    #[arg(long, requires = "input", value_parser = crate::arguments::positive::<Hertz>, help_heading = ON_RECORDS)]
    rate: Option<Hertz>,
    /// Rows of every file, from 0, TO not included.
    #[arg(long, value_name = "FROM:TO", requires = "input", help_heading = ON_RECORDS)]
    rows: Option<String>,
    /// Form of the model: order=N, with zeros=N, delay, integrating if you want them; or static. Default, or auto: the simplest that predicts as well as any, up to --order.
    #[arg(long, help_heading = ON_RECORDS)]
    base: Option<cellpos_workbench::foreign::form::Asked>,
    /// Input between rows: a command is held (zero-order), a measured signal is not (none).
    #[arg(long, value_enum, default_value_t = HoldKind::ZeroOrder, help_heading = ON_RECORDS)]
    hold: HoldKind,
    /// Highest model order to try.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u8).range(0..=8), help_heading = ON_RECORDS)]
    order: u8,
    /// Rig file; default: the emulated rig.
    #[arg(long, conflicts_with_all = ["data", "open_loop"], help_heading = ON_A_RIG)]
    rig: Option<PathBuf>,
    /// Continue a stopped identification from its finished segments.
    #[arg(long, conflicts_with = "data", help_heading = ON_A_RIG)]
    resume: Option<PathBuf>,
    /// Exposure of the camera of `--rig`; default: that of its `[emulator]`.
    #[arg(long, requires = "rig", value_parser = crate::arguments::positive::<Seconds>, help_heading = ON_A_RIG)]
    exposure: Option<Seconds>,
    /// Run without real-time priority.
    #[arg(long, requires = "rig", help_heading = ON_A_RIG)]
    best_effort: bool,
    /// Model for amplitudes, for the holding loop and for the emulated rig: `eq6` or a model.toml.
    #[arg(long, default_value = "eq6", help_heading = ON_A_RIG)]
    model: String,
    /// false: the emulated rig has the imperfections of a real one [default: as rig.toml says].
    #[arg(long, value_name = "BOOL", num_args = 0..=1, require_equals = true, default_missing_value = "true", help_heading = ON_A_RIG)]
    ideal: Option<bool>,
    /// Seed of the emulated rig, the excitation and the bootstrap [default: that of rig.toml, else 1].
    #[arg(long, help_heading = ON_A_RIG)]
    seed: Option<u64>,
    /// Clock of the emulated rig [default: virtual; a real rig has the real one].
    #[arg(long, value_enum, help_heading = ON_A_RIG)]
    clock: Option<ClockKind>,
    /// Render frames of the emulated rig, or use positions with equivalent noise.
    #[arg(long, value_enum, default_value_t = Switch::On, help_heading = ON_A_RIG)]
    frames: Switch,
    /// Form of the excitation.
    #[arg(long, value_enum, default_value_t = Excitation::Stepped, help_heading = ON_A_RIG)]
    excitation: Excitation,
    /// Frequencies to excite; default: the paper's ten.
    #[arg(long, num_args = 1.., value_delimiter = ',', help_heading = ON_A_RIG)]
    frequency: Vec<Hertz>,
    /// Largest amplitude of the bead (peak); on a rig at most half of the way to the picture's border.
    #[arg(long, default_value = "8um", help_heading = ON_A_RIG)]
    bead_amplitude: Micrometers,
    /// Largest speed of the bead (peak): its image should smear by less than two pixels in an exposure.
    #[arg(long, default_value = "400um/s", help_heading = ON_A_RIG)]
    bead_speed: MicrometersPerSecond,
    /// Largest PZT amplitude (peak).
    #[arg(long, default_value = "10um", help_heading = ON_A_RIG)]
    pzt_amplitude: Micrometers,
    /// Do not hold the bead: drift and low frequencies will take it out of view.
    #[arg(long, help_heading = ON_A_RIG)]
    open_loop: bool,
    /// Edges of the LED delay test; 0: no test.
    #[arg(long, default_value_t = 300, help_heading = ON_A_RIG)]
    led_edges: usize,
    /// Bootstrap replicates; 0: none.
    #[arg(long, default_value_t = 200)]
    bootstrap: usize,
    /// Model file [default: model.toml in a new folder of runs/].
    #[arg(long)]
    out: Option<PathBuf>,
    /// Compare with Eq. (6) of the paper.
    #[arg(long)]
    eq6: bool,
    /// Report [default: report.html in a new folder of runs/].
    #[arg(long)]
    report: Option<PathBuf>,
    #[command(flatten)]
    page: PageArgs,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// What the records' input does between rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum HoldKind {
    /// Held until the next row.
    ZeroOrder,
    /// Samples of a smooth signal.
    None,
}

impl From<HoldKind> for Hold {
    fn from(kind: HoldKind) -> Self {
        match kind {
            HoldKind::ZeroOrder => Self::ZeroOrder,
            HoldKind::None => Self::None,
        }
    }
}

/// A new folder below runs/, named by the time and `name`.
pub(crate) fn new_run_folder(name: &str) -> Result<PathBuf, Failure> {
    let time = jiff::Timestamp::now()
        .strftime("%Y%m%dT%H%M%SZ")
        .to_string();
    for attempt in 0..100 {
        let tail = if attempt == 0 {
            String::new()
        } else {
            format!("-{attempt}")
        };
        let folder = PathBuf::from("runs").join(format!("{time}-{name}{tail}"));
        match std::fs::create_dir_all("runs").and_then(|()| std::fs::create_dir(&folder)) {
            Ok(()) => return Ok(folder),
            Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => {}
            Err(error) => return Err(Failure::failed(error)),
        }
    }
    Err(Failure::Failed(miette::miette!(
        "runs/ holds a hundred folders of this second already"
    )))
}

fn checked(args: &Args) -> Result<(), Failure> {
    let positive = |name: &str, value: f64, unit: &str| {
        if value.is_finite() && value > 0.0 {
            Ok(())
        } else {
            Err(Failure::bad_input(
                format!("--{name} {value}{unit}: not above 0"),
                format!("give a value above 0, for example --{name} 8{unit}"),
            ))
        }
    };
    positive("bead-amplitude", args.bead_amplitude.0, "um")?;
    positive("bead-speed", args.bead_speed.0, "um/s")?;
    positive("pzt-amplitude", args.pzt_amplitude.0, "um")?;
    if let Some(f) = args
        .frequency
        .iter()
        .find(|f| !(f.0.is_finite() && f.0 >= 0.2 && f.0 < 480.0))
    {
        return Err(Failure::bad_input(
            format!("--frequency {f}: outside the band"),
            "lines lie between 0.2Hz and 480Hz at 1000 frames a second",
        ));
    }
    if args.led_edges != 0 && args.led_edges < 20 {
        return Err(Failure::bad_input(
            format!("--led-edges {}: too few for a delay", args.led_edges),
            "give 0 (no delay test) or at least 20 edges",
        ));
    }
    Ok(())
}

/// Of a loop with a longer period the paper's lines are above half its rate, us.
const SLOW_LOOP_US: f64 = 1500.0;
/// Frequencies for an actuator of some 10 ms, from the tube's compliance to the regulator's lag, Hz.
const SLOW_FREQUENCIES_HZ: [f64; 10] = [0.2, 0.5, 1.0, 2.0, 3.0, 5.0, 7.0, 10.0, 14.0, 20.0];
/// Highest frequency, as a fraction of the loop's rate: beyond, hold and alias weigh as much as the plant.
const HIGHEST_LINE: f64 = 0.3;

/// The rig of `--rig`, with a PI for its delay.
fn on_rig(args: &Args, model: &Model) -> Result<Option<OnRig>, Failure> {
    let Some(path) = &args.rig else {
        return Ok(None);
    };
    let mut file = RigFile::load(Some(path))?;
    file.emulate_as(args.seed, args.ideal)?;
    let frames = match args.frames {
        Switch::On => Frames::On,
        Switch::Off => Frames::Off,
    };
    OnRig::new(file, model.clone(), args.clock, frames, args.best_effort).map(Some)
}

/// The frequencies to excite in a loop of this period, ascending.
fn lines_hz(args: &Args, period_us: f64) -> Result<Vec<f64>, Failure> {
    /// Highest frequency of `--frequency`, as a fraction of the loop's rate.
    const BAND: f64 = 0.48;
    let rate_hz = 1e6 / period_us;
    let mut lines_hz: Vec<f64> = if !args.frequency.is_empty() {
        args.frequency.iter().map(|f| f.0).collect()
    } else if period_us > SLOW_LOOP_US {
        let of_slow = SLOW_FREQUENCIES_HZ.into_iter();
        of_slow.filter(|hz| *hz < HIGHEST_LINE * rate_hz).collect()
    } else {
        PAPER_FREQUENCIES_HZ.to_vec()
    };
    lines_hz.sort_by(f64::total_cmp);
    lines_hz.dedup();
    if let Some(hz) = lines_hz.last().filter(|hz| **hz >= BAND * rate_hz) {
        return Err(Failure::bad_input(
            format!("--frequency {hz}Hz: outside the band"),
            format!(
                "lines lie between 0.2Hz and {:.0}Hz at {rate_hz:.0} frames a second",
                BAND * rate_hz
            ),
        ));
    }
    Ok(lines_hz)
}

fn job(args: &Args) -> Result<identification::Job, Failure> {
    let model = Model::load(&args.model).map_err(Failure::input)?;
    let rig = on_rig(args, &model)?;
    let period_us = rig.as_ref().map_or(1000.0, |rig| rig.file.timing.period_us);
    let lines_hz = lines_hz(args, period_us)?;
    let seed = args
        .seed
        .or(rig.as_ref().map(|rig| rig.file.emulator.seed))
        .unwrap_or(1);
    let mut setup = match &rig {
        Some(rig) => rig.bench_setup(),
        None => Setup {
            world: WorldConfig {
                model: args.model.clone(),
                ideal: args.ideal.unwrap_or(WorldConfig::default().ideal),
                ..WorldConfig::default()
            },
            model,
            frames: args.frames == Switch::On,
            clock: match args.clock.unwrap_or(ClockKind::Virtual) {
                ClockKind::Virtual => Clock::virtual_at(0),
                ClockKind::Real => Clock::Real,
            },
            closed_loop: !args.open_loop,
            pi: None,
            two_lags: false,
        },
    };
    setup.world.seed = seed;
    if let Some(exposure) = args.exposure {
        setup.world.exposure_ms = exposure.0 * 1e3;
    }
    let amplitudes = (
        args.bead_amplitude.0,
        args.bead_speed.0,
        args.pzt_amplitude.0,
    );
    let limits = match &rig {
        Some(rig) => rig.limits(
            rig.bead_amplitude_um(amplitudes.0)?,
            amplitudes.1,
            amplitudes.2,
        ),
        // As [`on_rig::OnRig::limits`] for the emulated board's 40 um/ms.
        None => ExcitationLimits {
            bead_um: amplitudes.0,
            bead_um_per_s: amplitudes.1,
            pzt_um: amplitudes.2,
            slew_um_per_s: 3200.0,
        },
    };
    Ok(identification::Job {
        limits,
        setup,
        lines_hz,
        excitation: args.excitation,
        seconds_at_1_hz: 40.0,
        // An actuator program has no LED in front of the camera.
        led_edges: match rig.as_ref().map(|rig| &rig.file.actuator) {
            Some(ActuatorConfig::Program { .. }) => 0,
            _ => args.led_edges,
        },
        bootstrap: args.bootstrap,
        seed,
        rig,
        resume: args.resume.clone(),
        keep_in: None,
    })
}

/// The live page, if one is wanted.
fn pages(args: &Args, job: &identification::Job) -> Result<Option<Pages>, Failure> {
    let clock = job.rig.as_ref().map_or(ClockKind::Virtual, |rig| rig.clock);
    let wanted = args.page.wanted(clock)?;
    let of = args.rig.iter().map(|path| path.display().to_string());
    let page = Page {
        name: "identify".to_string(),
        subtitle: format!("identify: {:?}, {}", job.excitation, of.collect::<String>()),
        steered: false,
        script: false,
        notes: false,
    };
    Ok(wanted
        .is_any()
        .then(|| Pages::new(wanted, page, view_args::said)))
}

/// Runs `cellpos identify`.
pub(crate) fn run(args: Args) -> CommandResult {
    output::ready(args.out.iter().chain(&args.report))?;
    if args.base.is_some() && args.input.is_none() && args.response.is_none() {
        return Err(Failure::bad_input(
            "--base is only for records of other rigs, or a response",
            "name them with --data, --input and --output, or with --response",
        ));
    }
    if let Some(path) = &args.response {
        return foreign::run_response(&args, path);
    }
    if !args.data.is_empty() {
        return foreign::run(&args);
    }
    checked(&args)?;
    let mut job = job(&args)?;
    let folder = if args.out.is_none() || args.report.is_none() {
        Some(new_run_folder("identify")?)
    } else {
        None
    };
    // Beside the model that will be written, so that a resumed identification finds it where the user looks.
    let beside = args
        .out
        .as_ref()
        .map(|out| out.with_extension("partial.json"));
    job.keep_in = beside.or(folder.as_ref().map(|f| f.join("partial.json")));
    if let Some(rig) = &mut job.rig {
        rig.record_in = Some(PathBuf::from("runs"));
    }
    let bar = output::progress_bar(Some(0));
    bar.set_style(
        indicatif::ProgressStyle::with_template("{bar:40} {pos}/{len} ticks, {eta} left")
            .unwrap_or_else(|_| indicatif::ProgressStyle::default_bar()),
    );
    let mut pages = pages(&args, &job)?;
    let progress = |ticks: usize, total: usize| {
        bar.set_length(total as u64);
        bar.set_position(ticks as u64);
    };
    let done = identification::run_shown(&job, progress, pages.as_mut())?;
    bar.finish_and_clear();

    let place = |given: &Option<PathBuf>, name: &str| {
        given
            .clone()
            .unwrap_or_else(|| folder.clone().unwrap_or_default().join(name))
    };
    let (model_path, report_path) = (
        place(&args.out, "model.toml"),
        place(&args.report, "report.html"),
    );
    let rig = match &args.rig {
        Some(path) => path.display().to_string(),
        None => format!(
            "emulated (a simulation of the model {}, seed {})",
            args.model, job.seed
        ),
    };
    let mut provenance = BTreeMap::from([
        ("command".to_owned(), command_text()),
        (
            "version".to_owned(),
            provenance::VERSION_AND_COMMIT.to_owned(),
        ),
        (
            "lines_hz".to_owned(),
            job.lines_hz
                .iter()
                .map(f64::to_string)
                .collect::<Vec<_>>()
                .join(" "),
        ),
        ("rig".to_owned(), rig.clone()),
    ]);
    provenance.extend(done.board.clone().map(|board| (OF_BOARD.to_owned(), board)));
    let model = Model {
        frame_age_s: Some(done.age_s),
        ..done
            .result
            .model("identified", done.neutral_um, provenance)
            .map_err(Failure::failed)?
    };
    output::write(&model_path, &model.to_toml_string())?;
    page::report(&done, &rig, &command_text(), args.eq6)
        .write_with_figures(&report_path)
        .map_err(Failure::failed)?;
    if args.json {
        print_json(&said::identification(
            &done,
            &job,
            &model_path,
            &report_path,
        ))?;
    } else {
        print_text(&said::text(&done, &model_path, &report_path))?;
    }
    Ok(Outcome::Done)
}
