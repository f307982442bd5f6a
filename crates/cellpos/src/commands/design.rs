//! `cellpos design`: a controller for a model and a loop delay, with margins, predicted error and spread.

mod print;
mod report;

use crate::outcome::{CommandResult, Failure, Outcome, print_err, print_json, print_text};
use crate::output;
use crate::rig_file::RigFile;
use crate::setup;
use cellpos_control::design::{
    DesignLimits, DesignPlant, DesignReport, DesignRequest, DesignWarning, PiSearch, Requested,
    default_lead, design, search_pi,
};
use cellpos_control::{
    ConfigError, ControllerConfig, ControllerFile, ControllerKind, Lead, Lqg, Mpc, Pi,
};
use cellpos_numeric::units::{Hertz, Seconds};
use cellpos_plant::Model;
use std::path::{Path, PathBuf};

/// Which controller is meant: a law to design, or a file to check.
#[derive(Debug, Clone)]
enum Choice {
    /// A law.
    Law(ControllerKind),
    /// What a controller.toml holds.
    File(Box<ControllerFile>),
}

impl Choice {
    /// The law.
    fn law(&self) -> ControllerKind {
        match self {
            Self::Law(law) => *law,
            Self::File(file) => file.controller,
        }
    }

    /// The file, where one is checked.
    fn file(&self) -> Option<&ControllerFile> {
        match self {
            Self::Law(_) => None,
            Self::File(file) => Some(file),
        }
    }
}

/// `pi`, `lead`, `lqg`, `mpc`, or a path.
fn choice(text: &str) -> Result<Choice, String> {
    if let Some(kind) = ControllerKind::from_name(text) {
        return Ok(Choice::Law(kind));
    }
    match text {
        path if path.ends_with(".toml") => ControllerFile::load(Path::new(path))
            .map(|file| Choice::File(Box::new(file)))
            .map_err(|error| error.to_string()),
        _ => Err("write pi, lead, lqg, mpc, or the path of a controller.toml".to_owned()),
    }
}

/// Arguments of `cellpos design`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  cellpos design --model eq6 --delay 2.5ms
  cellpos design --model eq6 --delay 2.5ms --controller pi
  cellpos design --model eq6 --delay 2.5ms --kp 0.46 --ki 19.5 --json
  cellpos design --model model.toml --controller pi --max-ms 1.6 --min-pm 40 --out controller.toml --report design.html
  cellpos design --model model.toml --controller controller.toml

The loop delay is the camera delay (from the middle of an exposure to the tick that uses it) plus half a sample of hold: 2 ms at 1 kHz
give 2.5ms. A model.toml of cellpos identify contains its camera delay. For --controller pi without gains, design finds those of largest
integral gain within --max-ms and --max-mt. A controller.toml is checked as it stands, for its own delay unless --delay or --rig states
another; --out then writes it for that delay. Exit code 1: the loop is unstable, or a limit is broken; 2: bad input.")]
pub(crate) struct Args {
    /// Model file, or `eq6` for the built-in nominal plant.
    #[arg(long, default_value = "eq6")]
    model: String,
    /// Loop delay: camera delay and half a sample of hold; default: of --rig, else of controller.toml, of the model, or 2.5ms.
    #[arg(long, value_parser = crate::arguments::loop_delay)]
    delay: Option<Seconds>,
    /// Rig file: its camera delay, period and limits are used.
    #[arg(long, conflicts_with_all = ["delay", "sample"])]
    rig: Option<PathBuf>,
    /// Sample time; default: of --rig, else of controller.toml, else 1ms.
    #[arg(long)]
    sample: Option<Seconds>,
    /// Control law: pi, lead, lqg, mpc (margins without active constraints); or the path of a controller.toml to check. Default: lqg,
    /// as for a run; pi where gains or a lead are given.
    #[arg(long, value_parser = choice)]
    controller: Option<Choice>,
    /// Proportional gain, um of PZT per um of bead (needs --ki).
    #[arg(long, requires = "ki", allow_negative_numbers = true)]
    kp: Option<f64>,
    /// Integral gain, 1/s (needs --kp).
    #[arg(long, requires = "kp", allow_negative_numbers = true)]
    ki: Option<f64>,
    /// Weight of the reference in the proportional path, 0 to 1.
    #[arg(long)]
    setpoint_weight: Option<f64>,
    /// Zero of the lead.
    #[arg(long, requires = "lead_pole", value_parser = crate::arguments::positive::<Hertz>)]
    lead_zero: Option<Hertz>,
    /// Pole of the lead.
    #[arg(long, requires = "lead_zero", value_parser = crate::arguments::positive::<Hertz>)]
    lead_pole: Option<Hertz>,
    /// TOML file with limits: max_ms, max_mt, min_pm_deg, min_gm_db, min_delay_margin_ms, max_rms_nm,
    /// max_overshoot_percent, max_settling_ms, stable_over_spread.
    #[arg(long)]
    limits: Option<PathBuf>,
    /// Largest peak of the sensitivity S; the search aims at 1.6 by default.
    #[arg(long)]
    max_ms: Option<f64>,
    /// Largest peak of the complementary sensitivity T; the search aims at 1.3 by default.
    #[arg(long)]
    max_mt: Option<f64>,
    /// Smallest phase margin, deg.
    #[arg(long)]
    min_pm: Option<f64>,
    /// Smallest gain margin, dB.
    #[arg(long)]
    min_gm: Option<f64>,
    /// Smallest delay margin.
    #[arg(long)]
    min_delay_margin: Option<Seconds>,
    /// Largest predicted hold error, nm RMS.
    #[arg(long)]
    max_rms: Option<f64>,
    /// Require stability for all of the spread (gain x 0.5..2, delay +0/+1 sample).
    #[arg(long)]
    stable_over_spread: bool,
    /// Localisation noise for the predicted errors; default: the model's (30 nm in eq6).
    #[arg(long)]
    fix_noise: Option<cellpos_numeric::units::Micrometers>,
    /// Write the controller to this file.
    #[arg(long)]
    out: Option<PathBuf>,
    /// Write a report to this file: margins, Bode, Nyquist, step, predicted spectrum.
    #[arg(long)]
    report: Option<PathBuf>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

impl Args {
    /// Gains of PI or a lead are given.
    fn gives_gains(&self) -> bool {
        self.kp.is_some() || self.setpoint_weight.is_some() || self.lead_zero.is_some()
    }

    /// What is to be designed or checked.
    fn asked(&self) -> Choice {
        let by_default = || {
            ControllerKind::from_name(setup::DEFAULT_LAW)
                .filter(|_| !self.gives_gains())
                .unwrap_or(ControllerKind::Pi)
        };
        (self.controller.clone()).unwrap_or_else(|| Choice::Law(by_default()))
    }
}

/// Designs or checks a controller, prints its figures.
pub(crate) fn run(args: Args) -> CommandResult {
    output::ready(&args.out)?;
    output::ready(&args.report)?;
    let model = Model::load(&args.model).map_err(Failure::input)?;
    let rig = (args.rig.as_deref())
        .map(|path| RigFile::load(Some(path)))
        .transpose()?;
    let asked = args.asked();
    let given = asked.file();
    let plant = plant(&args, given, &model, rig.as_ref())?;
    let limits = limits(&args)?;
    gains_belong_to(&args, &asked)?;
    let lead = lead(&args, &asked, plant.loop_delay_s())?;
    // Without a rig file every tick has a frame.
    let frame_s = (rig.as_ref()).map_or(plant.sample_time_s, RigFile::frame_s);
    let controller = requested(&args, &asked, (&plant, frame_s), &limits, lead)?;
    let of_rig = rig.as_ref().map(|file| file.limits);
    let request = DesignRequest {
        plant,
        controller,
        setpoint_weight: args.setpoint_weight,
        command_limits: given.map(|file| file.limits).or(of_rig).unwrap_or_default(),
        estimator: given.map(|file| file.estimator),
        limits,
    };
    let report = design(&request).map_err(Failure::input)?;
    if let Some(path) = &args.out {
        let file = controller_file(given, &request, &report, frame_s)?;
        output::write(path, &file.to_toml_string())?;
    }
    if let Some(path) = &args.report {
        report::page(&args.model, &request, &report)
            .map_err(Failure::failed)?
            .write_with_figures(path)
            .map_err(|error| {
                Failure::bad_input(error, "name a page that you may write with --report")
            })?;
    }
    for warning in &report.warnings {
        print_err(&format!("WARNING: {warning}"));
    }
    for broken in &report.limits_broken {
        print_err(&format!("LIMIT BROKEN: {broken}"));
    }
    if args.json {
        print_json(&print::json(&args.model, &request, &report))?;
    } else {
        print_text(&print::table(&args.model, &request, &report))?;
    }
    Ok(if report.limits_broken.is_empty() {
        Outcome::Done
    } else {
        Outcome::Broken
    })
}

/// Gains are of PI, and are not those of a file.
fn gains_belong_to(args: &Args, asked: &Choice) -> Result<(), Failure> {
    let given = args.gives_gains();
    match asked {
        Choice::File(_) if given => Err(Failure::bad_input(
            "--kp, --ki, --setpoint-weight and the lead are in controller.toml already",
            "leave them out, or change the file",
        )),
        Choice::Law(ControllerKind::Lqg | ControllerKind::Mpc) if given => Err(Failure::bad_input(
            "--kp, --ki, --setpoint-weight and the lead are gains of PI, not of lqg or mpc",
            "leave them out, or write --controller pi",
        )),
        _ => Ok(()),
    }
}

/// The plant as the loop sees it: the model with the delay and the sample time of the rig, or those given.
fn plant(
    args: &Args,
    given: Option<&ControllerFile>,
    model: &Model,
    rig: Option<&RigFile>,
) -> Result<DesignPlant, Failure> {
    let timing = rig.map(|file| file.timing);
    let model = &match rig {
        Some(file) => file.actuator.before(model.clone()),
        None => model.clone(),
    };
    let sample_time_s = (timing.map(|timing| timing.period_us * 1e-6))
        .or(args.sample.map(Seconds::value))
        .or(given.map(|file| file.sample_time_ms * 1e-3))
        .unwrap_or(1e-3);
    if !(1e-5..=1.0).contains(&sample_time_s) {
        return Err(Failure::bad_input(
            format!("--sample {}ms: must be 0.01ms to 1s", sample_time_s * 1e3),
            "the rig runs at 1ms",
        ));
    }
    let of_rig = timing
        .as_ref()
        .map(|timing| setup::loop_delay_s(model, timing));
    let given_s = (args.delay.map(Seconds::value))
        .or(of_rig)
        .or(given.map(|file| file.delay_ms * 1e-3));
    if given_s.is_some_and(|delay_s| delay_s < 0.5 * sample_time_s) {
        return Err(Failure::bad_input(
            format!(
                "--delay {}ms is less than half a sample of hold",
                given_s.unwrap_or(0.0) * 1e3
            ),
            "the loop delay is the camera path and half a sample: 2.5ms for a camera path of 2ms at 1 kHz",
        ));
    }
    let mut plant =
        DesignPlant::from_model(model, given_s, sample_time_s).map_err(Failure::input)?;
    let disagrees = timing
        .as_ref()
        .and_then(|timing| setup::model_delay_warning(model, timing));
    if let Some(warning) = disagrees {
        print_err(&format!("WARNING: {warning}"));
    }
    if given_s.is_none() && model.camera_delay_s.is_none() && plant.delay_s == 0.0 {
        plant.delay_s = 2e-3;
        plant.warnings.push(DesignWarning::DelayAssumed {
            assumed_ms: plant.loop_delay_s() * 1e3,
        });
    }
    if let Some(noise) = args.fix_noise {
        plant.fix_noise_um = noise.value();
    }
    Ok(plant)
}

/// The controller that is asked for.
fn requested(
    args: &Args,
    asked: &Choice,
    (plant, frame_s): (&DesignPlant, f64),
    limits: &DesignLimits,
    lead: Option<Lead>,
) -> Result<Requested, Failure> {
    if let Some(file) = asked.file() {
        return Ok(match file.controller_config() {
            ControllerConfig::Pi(pi) => Requested::Pi(pi),
            other => Requested::Given(other),
        });
    }
    Ok(match (asked.law(), args.kp, args.ki) {
        (ControllerKind::Lqg, ..) => {
            Requested::Given(ControllerConfig::Lqg(Lqg::for_path(plant, frame_s)))
        }
        (ControllerKind::Mpc, ..) => Requested::Given(ControllerConfig::Mpc(
            Mpc::for_path(plant, frame_s),
            fallback(plant)?,
        )),
        (_, Some(kp), Some(ki)) => Requested::Pi(Pi {
            lead,
            ..Pi::new(kp, ki)
        }),
        _ => {
            let nominal = PiSearch::default();
            Requested::SearchPi(PiSearch {
                max_ms: limits.max_ms.unwrap_or(nominal.max_ms),
                max_mt: limits.max_mt.unwrap_or(nominal.max_mt),
                lead,
            })
        }
    })
}

/// Gains of PI for a plant: what runs where MPC has no plan, and what stands in the file beside LQG.
fn fallback(plant: &DesignPlant) -> Result<Pi, Failure> {
    search_pi(plant, PiSearch::default())
        .map_err(Failure::input)?
        .ok_or_else(|| {
            Failure::bad_input(
                "no PI gains are stable enough on this plant",
                "design --controller pi with a larger --max-ms and --max-mt shows what can be had",
            )
        })
}

fn limits(args: &Args) -> Result<DesignLimits, Failure> {
    let mut limits = match &args.limits {
        Some(path) => {
            DesignLimits::load(path).map_err(|error: ConfigError| Failure::input(error))?
        }
        None => DesignLimits::default(),
    };
    let flags = [
        ("--max-ms", args.max_ms, &mut limits.max_ms),
        ("--max-mt", args.max_mt, &mut limits.max_mt),
        ("--min-pm", args.min_pm, &mut limits.min_pm_deg),
        ("--min-gm", args.min_gm, &mut limits.min_gm_db),
        (
            "--min-delay-margin",
            args.min_delay_margin.map(|d| d.value() * 1e3),
            &mut limits.min_delay_margin_ms,
        ),
        ("--max-rms", args.max_rms, &mut limits.max_rms_nm),
    ];
    for (flag, given, limit) in flags {
        if let Some(value) = given {
            if !(value.is_finite() && value > 0.0) {
                return Err(Failure::bad_input(
                    format!("{flag} {value}: is not above 0"),
                    "give a number above 0",
                ));
            }
            *limit = Some(value);
        }
    }
    if args.stable_over_spread {
        limits.stable_over_spread = Some(true);
    }
    Ok(limits)
}

fn lead(args: &Args, asked: &Choice, loop_delay_s: f64) -> Result<Option<Lead>, Failure> {
    match (asked.law(), args.lead_zero, args.lead_pole) {
        _ if asked.file().is_some() => Ok(None),
        (ControllerKind::Lead, Some(zero), Some(pole)) => Ok(Some(Lead {
            zero_hz: zero.value(),
            pole_hz: pole.value(),
        })),
        (ControllerKind::Lead, ..) => Ok(Some(default_lead(loop_delay_s))),
        (_, None, None) => Ok(None),
        _ => Err(Failure::bad_input(
            "--lead-zero and --lead-pole belong to --controller lead",
            "write --controller lead, or leave them out",
        )),
    }
}

fn controller_file(
    given: Option<&ControllerFile>,
    request: &DesignRequest,
    report: &DesignReport,
    frame_s: f64,
) -> Result<ControllerFile, Failure> {
    let loop_delay_s = request.plant.loop_delay_s();
    if let Some(given) = given {
        return Ok(ControllerFile {
            delay_ms: loop_delay_s * 1e3,
            sample_time_ms: request.plant.sample_time_s * 1e3,
            ..*given
        });
    }
    let mut file = match report.controller {
        ControllerConfig::Pi(pi) => ControllerFile::from_pi(pi, loop_delay_s),
        ControllerConfig::Lqg(lqg) => ControllerFile {
            controller: ControllerKind::Lqg,
            lqg,
            ..ControllerFile::from_pi(fallback(&request.plant)?, loop_delay_s)
        },
        ControllerConfig::Mpc(mpc, fallback) => ControllerFile {
            controller: ControllerKind::Mpc,
            mpc,
            ..ControllerFile::from_pi(fallback, loop_delay_s)
        },
    };
    file.sample_time_ms = request.plant.sample_time_s * 1e3;
    if file.controller != ControllerKind::Lqg {
        file.lqg = Lqg::for_path(&request.plant, frame_s);
    }
    if file.controller != ControllerKind::Mpc {
        file.mpc = Mpc::for_path(&request.plant, frame_s);
    }
    if let Some(config) = &report.config {
        file.estimator = config.estimator;
        file.limits = config.limits;
    }
    file.estimator.adapt = file.controller.adapts();
    Ok(file)
}
