//! What every command that closes the loop does: connect and arm a rig, run, stop on signals, write the run's metadata.

use crate::outcome::Failure;
use crate::rig_file::{ActuatorConfig, CameraConfig, ClockKind, Frames, Rig, RigFile};
use crate::setup::{self, ReferenceSpec, Setup, SetupConfig};
use cellpos_control::ControllerKind;
use cellpos_control::design::bound_rms_um;
use cellpos_plant::{Effect, Model};
use cellpos_record::{InputFile, RunEnd, RunMeta, RunWriter};
use cellpos_rig::actuator::Session;
use cellpos_runtime::live::{Operator, Threads};
use cellpos_runtime::{
    Core, EndRule, Finished, Guide, Request, RunSink, Statistics, Summary, live, virtual_run,
};
use serde::Serialize;
use std::path::Path;
use std::sync::Arc;

/// Asks for a stop with each signal: first freeze, then park.
pub fn stop_on_signals(operator: &Arc<Operator>) -> Result<(), Failure> {
    let stopper = Arc::clone(operator);
    ctrlc::set_handler(move || {
        let message = match stopper.stop() {
            Request::Freeze => "freezing, then parking; once more to park at once",
            _ => "parking",
        };
        eprintln!("\n{message}");
    })
    .map_err(Failure::failed)
}

/// Narrows the controller's limits to what rig file and board allow, and the positions that MPC plans for to what the
/// camera sees; tells the estimator how long a frame is exposed.
pub fn narrow(setup: &mut setup::Prepared, file: &RigFile, rig: &Rig) {
    let board = rig.actuator.info();
    let own = setup.controller.limits;
    let asked = setup::within(file.limits, [own.low_um, own.high_um, own.slew_um_per_s]);
    setup.controller.limits =
        setup::within(asked, [board.low_um, board.high_um, board.slew_um_per_s]);
    let exposure_ms = 1e3 * exposure_s(file, &setup.model);
    let estimator = &mut setup.controller.estimator;
    if estimator.exposure_ms == 0.0 && exposure_ms <= file.timing.period_us * 1e-3 {
        estimator.exposure_ms = exposure_ms;
    }
    let [low_um, high_um] = rig.source.info().field_um;
    if setup.controller.controller == ControllerKind::Mpc && low_um < high_um {
        let mpc = &mut setup.controller.mpc;
        let given = |view_um: Option<f64>| view_um.filter(|um| um.is_finite());
        mpc.view_low_um = given(Some(mpc.view_low_um.map_or(low_um, |um| um.max(low_um))));
        mpc.view_high_um = given(Some(mpc.view_high_um.map_or(high_um, |um| um.min(high_um))));
    }
}

/// How long a frame is exposed, s, where the rig file says so.
pub fn stated_exposure_s(file: &RigFile) -> Option<f64> {
    match &file.camera {
        CameraConfig::Emulated {} => Some(file.emulator.exposure_ms * 1e-3),
        CameraConfig::Industrial { exposure_us, .. } => exposure_us.map(|us| us * 1e-6),
        CameraConfig::Socket { .. } => None,
    }
}

/// How long a frame is exposed, s: as the rig file says, else as the model does; 0 where nobody does.
fn exposure_s(file: &RigFile, model: &Model) -> f64 {
    let of_model = || {
        model.effects.iter().find_map(|effect| match effect {
            Effect::ExposureAveraging { exposure_s } => Some(*exposure_s),
            _ => None,
        })
    };
    stated_exposure_s(file).or_else(of_model).unwrap_or(0.0)
}

/// Arms the board and completes the set-up with where it stands.
pub fn arm(
    prepared: setup::Prepared,
    file: &RigFile,
    rig: &mut Rig,
    session: u16,
    reference: ReferenceSpec,
) -> Result<Setup, Failure> {
    /// The loop limits the change of the command from tick to tick, and counts on it being reached early in the tick: the
    /// board may go faster by this factor, if it can.
    const HEADROOM: f64 = 4.0;
    let limits = prepared.controller.limits;
    let slew_um_per_s = (HEADROOM * limits.slew_um_per_s).min(rig.actuator.info().slew_um_per_s);
    let armed = rig
        .actuator
        .arm(&Session {
            id: session,
            park_um: limits.park_um,
            limits: [limits.low_um, limits.high_um, slew_um_per_s],
            watchdog_ms: file.watchdog_ms(),
        })
        .map_err(Failure::failed)?;
    Ok(Setup {
        model: prepared.model,
        controller: prepared.controller,
        config: SetupConfig {
            displacement_um: armed.applied_um,
            neutral_um: file.first_neutral_um,
            reference,
            timing: file.timing,
            arming: file.arming,
            learn: None,
            motions: Vec::new(),
        },
    })
}

/// Runs the loop on the rig's clock.
pub fn drive<G: Guide + Send, S: RunSink>(
    core: Core<G>,
    rig: &mut Rig,
    sink: S,
    end: EndRule,
    best_effort: bool,
    operator: &Operator,
) -> Result<Finished<S>, Failure> {
    if rig.clock.is_virtual() {
        virtual_run::run(
            core,
            &rig.clock,
            rig.source.as_mut(),
            rig.actuator.as_mut(),
            sink,
            Statistics::default(),
            end,
            |_| operator.take(),
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
            sink,
            Statistics::default(),
            end,
            &threads,
            operator,
        )
    }
    .map_err(Failure::failed)
}

/// The metadata of a run, with the files among `inputs` fingerprinted.
pub fn meta(
    name: &str,
    clock: ClockKind,
    inputs: &[&Path],
    file: &RigFile,
    setup: &Setup,
) -> Result<RunMeta, Failure> {
    let clock = match clock {
        ClockKind::Real => "real",
        ClockKind::Virtual => "virtual",
    };
    let mut meta = RunMeta::new(name, clock);
    meta.command_line = std::env::args().collect();
    // A folder that is gone is no reason not to run.
    meta.started_in =
        std::env::current_dir().map_or_else(|_| String::new(), |path| path.display().to_string());
    meta.seed = file.is_emulated().then_some(file.emulator.seed);
    meta.versions
        .insert("cellpos".to_string(), env!("CARGO_PKG_VERSION").to_string());
    for path in inputs {
        meta.inputs
            .push(InputFile::of(path).map_err(Failure::input)?);
    }
    meta.config = table(&setup.config)?;
    let rig = table(&anchored(file)?)?;
    meta.config
        .insert("rig".to_string(), toml::Value::Table(rig));
    meta.model = setup
        .model
        .to_toml_string()
        .parse::<toml::Table>()
        .map_err(Failure::failed)?;
    meta.controller = table(&setup.controller)?;
    Ok(meta)
}

/// The rig with absolute paths, as it is kept with a run: whoever goes on with the run need not start the program from the
/// same folder.
fn anchored(file: &RigFile) -> Result<RigFile, Failure> {
    let absolute = |path: &Path| {
        std::path::absolute(path).map_err(|error| {
            Failure::Failed(miette::miette!(
                "no absolute path of {}: {error}",
                path.display()
            ))
        })
    };
    let mut file = file.clone();
    if let Some(calibration) = &mut file.calibration_file {
        *calibration = absolute(calibration)?;
    }
    if let Some(background) = file.cell.as_mut().and_then(|cell| cell.background.as_mut()) {
        *background = absolute(background)?;
    }
    if let CameraConfig::Socket { socket, .. } = &mut file.camera {
        *socket = absolute(socket)?;
    }
    if let ActuatorConfig::Serial { port, .. } = &mut file.actuator
        // Else it is a name of the system's own (COM5).
        && Path::new(port).exists()
    {
        *port = absolute(Path::new(port))?.display().to_string();
    }
    if file.emulator.model != "eq6" {
        file.emulator.model = absolute(Path::new(&file.emulator.model))?
            .display()
            .to_string();
    }
    Ok(file)
}

/// The files behind the options `--rig`, `--model` and `--controller`, and those that the rig file names.
pub fn inputs<'a>(
    rig: Option<&'a Path>,
    file: &'a RigFile,
    model: &'a str,
    controller: &'a str,
) -> Vec<&'a Path> {
    let mut inputs: Vec<&Path> = rig.into_iter().collect();
    inputs.extend(file.background());
    if model != "eq6" {
        inputs.push(Path::new(model));
    }
    if controller.ends_with(".toml") {
        inputs.push(Path::new(controller));
    }
    inputs
}

/// A value as a TOML table.
pub fn table(value: &impl Serialize) -> Result<toml::Table, Failure> {
    toml::Table::try_from(value).map_err(Failure::failed)
}

/// Ends a run folder; gives its path, and adds what could not be written to the warnings.
pub fn finish(
    writer: RunWriter,
    outcome: &str,
    summary: &Summary,
    warnings: &mut Vec<String>,
) -> String {
    let mut end = RunEnd::new(outcome);
    end.summary = toml::Table::try_from(summary).unwrap_or_default();
    let done = writer.finish(end);
    if done.faults.rows_lost + done.faults.events_lost > 0 {
        warnings.push(format!(
            "{} rows and {} events could not be written: {}",
            done.faults.rows_lost,
            done.faults.events_lost,
            done.faults.first.unwrap_or_default()
        ));
    } else if let Err(error) = done.parquet {
        warnings.push(format!("no ticks.parquet: {error}"));
    }
    done.folder.display().to_string()
}

/// Smallest RMS error that any controller could reach, nm: Brownian motion, delay and noise in force.
pub fn bound_rms_nm(file: &RigFile, setup: &Setup, summary: &Summary) -> Option<f64> {
    let diffusion = if file.is_emulated() {
        file.emulator.diffusion_um2_per_s
    } else {
        setup.model.noise.diffusion_um2_per_s
    };
    summary.fix_noise_nm.map(|noise_nm| {
        let timing = &setup.config.timing;
        1e3 * bound_rms_um(
            diffusion,
            noise_nm * 1e-3,
            timing.camera_delay_ms * 1e-3,
            timing.period_us * 1e-6,
        )
    })
}

/// What is wrong when the frames of a run were not as old as the rig file says: the loop was made for another delay.
pub fn delay_warning(file: &RigFile, summary: &Summary) -> Option<String> {
    /// Part of a period: what time stamps can tell without being a setting.
    const WORTH_SAYING: f64 = 0.3;
    let timing = &file.timing;
    let period_ms = timing.period_us * 1e-3;
    let found_ms = summary.loop_delay_ms - 0.5 * period_ms;
    ((found_ms - timing.camera_delay_ms).abs() > WORTH_SAYING * period_ms).then(|| {
        format!(
            "the frames were {found_ms:.2} ms old when they were used, camera_delay_ms says {} ms: correct it in rig.toml",
            timing.camera_delay_ms
        )
    })
}

/// An error with what is behind it, on one line.
pub fn describe(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(error) = source {
        text.push_str(": ");
        text.push_str(&error.to_string());
        source = error.source();
    }
    text
}

/// Model and controller by their options, before a board is known.
pub fn prepare(model: &str, controller: &str, file: &RigFile) -> Result<setup::Prepared, Failure> {
    let model = Model::load(model).map_err(Failure::input)?;
    let controller = setup::controller(controller, &model, &file.timing)?;
    Ok(setup::Prepared { model, controller })
}

/// Connects the rig and tells its tracker which plant to expect.
pub fn connect(
    file: &RigFile,
    clock: ClockKind,
    frames: Frames,
    model: &Model,
) -> Result<Rig, Failure> {
    let rig = file.connect(clock, frames)?;
    rig.expect(model);
    Ok(rig)
}
