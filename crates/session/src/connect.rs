//! The description of a run in its folder, and the warnings after its end.

use crate::Failure;
use crate::ended::Ended;
pub use crate::failure::describe;
pub use crate::fit::{known_exposure_s, prepare, stated_exposure_s};
use crate::frames_seen::FrameAge;
use crate::provenance;
use crate::rig::{Finished, Rig};
use crate::rig_file::{ActuatorConfig, CameraConfig, ClockKind, RigFile};
use crate::setup::{ReferenceSpec, Setup, command_delay_s};
use cellpos_control::ControllerKind;
use cellpos_control::LoopModel;
use cellpos_control::design::{DesignPlant, bound_rms_of_path_um, bound_rms_um};
use cellpos_drivers::Calibration;
use cellpos_record::{Group, InputFile, RunEnd, RunMeta, RunWriter, space};
use cellpos_runtime::Summary;
use cellpos_runtime::realtime::Conditions;
use cellpos_runtime::recorder::Unconfirmed;
use cellpos_script::Sample;
use serde::Serialize;
use std::path::Path;

/// The metadata of a run, with the files among `inputs` fingerprinted.
pub fn meta(
    name: &str,
    clock: ClockKind,
    inputs: &[&Path],
    setup: &Setup,
    rig: &Rig,
) -> Result<RunMeta, Failure> {
    let file = rig.file();
    let clock = match clock {
        ClockKind::Real => "real",
        ClockKind::Virtual => "virtual",
    };
    let mut meta = RunMeta::new(name, clock);
    meta.columns = columns(setup, file, !rig.clock().is_virtual());
    meta.command_line = provenance::command_line();
    // Run even if the folder is gone.
    meta.started_in =
        std::env::current_dir().map_or_else(|_| String::new(), |path| path.display().to_string());
    meta.seed = file.is_emulated().then_some(file.emulator.seed);
    meta.versions
        .insert("cellpos".to_string(), provenance::VERSION.to_string());
    meta.versions
        .insert("commit".to_string(), provenance::COMMIT.to_string());
    meta.conditions = provenance::machine(rig);
    for path in inputs {
        meta.inputs
            .push(InputFile::of(path).map_err(Failure::input)?);
    }
    meta.config = table(&setup.config)?;
    let mut anchored = anchored(file)?;
    // The script's sample overrides that of the rig file.
    let of_script = setup.config.reference.script()?;
    let of_script = of_script.map_or_else(Sample::default, |(script, _)| script.sample);
    let sample = of_script.or(&anchored.sample.unwrap_or_default());
    anchored.sample = (sample != Sample::default()).then_some(sample);
    let rig = table(&anchored)?;
    meta.config
        .insert("rig".to_string(), toml::Value::Table(rig));
    meta.model = setup
        .model
        .to_toml_string()
        .parse::<toml::Table>()
        .map_err(Failure::failed)?;
    meta.controller = table(&setup.controller)?;
    meta.law_columns = setup
        .law()?
        .columns()
        .iter()
        .map(|name| (*name).to_owned())
        .collect();
    Ok(meta)
}

/// The columns that a run needs. A quantity that is neither measured nor computed takes no room on the disk.
fn columns(setup: &Setup, file: &RigFile, real_time: bool) -> Vec<Group> {
    let mpc = setup.controller.controller == ControllerKind::Mpc;
    let script = matches!(setup.config.reference, ReferenceSpec::Script { .. });
    let real = matches!(file.camera, CameraConfig::Industrial { .. });
    [
        (Group::Loop, true),
        (Group::Cell, file.follows_a_cell()),
        (Group::Truth, !real),
        (Group::Solver, mpc),
        (Group::Script, script),
        (Group::Partner, file.partner.is_some()),
        (Group::Line, real_time),
    ]
    .into_iter()
    .filter_map(|(group, wanted)| wanted.then_some(group))
    .collect()
}

/// Refuses a run for which the disk has no room; `ticks`: its largest number of ticks, if it has an end.
///
/// # Errors
/// A failure that names the needed and the free space.
pub fn room(root: &Path, ticks: Option<u64>, meta: &RunMeta) -> Result<(), Failure> {
    space::check(root, ticks, &meta.columns).map_err(Failure::input)
}

/// The rig with absolute paths, as kept with a run, so that a resume works from any folder.
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
    if let ActuatorConfig::Program { socket, .. } = &mut file.actuator {
        *socket = absolute(socket)?;
    }
    if let Some(socket) = (file.partner.as_mut()).and_then(|partner| partner.socket.as_mut()) {
        *socket = absolute(socket)?;
    }
    if let ActuatorConfig::Serial { port, .. } = &mut file.actuator
        // Otherwise it is a name of the operating system (COM5).
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

/// The files of the options `--rig`, `--model` and `--controller`, and the files that the rig file names.
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

/// Key of the summary in `run.toml` that says how the run ended, in sentences: an [`Ended`].
pub const ENDED: &str = "ended";

/// A run folder that is ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Kept {
    /// Its path.
    pub run: String,
    /// Whether it holds the whole run.
    pub whole: bool,
}

/// Ends a run folder. The summary counts rows that are not on the disk, and a warning names them.
pub fn finish(
    mut writer: RunWriter,
    (outcome, ended): (&str, &Ended),
    summary: &mut Summary,
    conditions: &Conditions,
    warnings: &mut Vec<String>,
) -> Kept {
    let mut end = RunEnd::new(outcome);
    end.summary = toml::Table::try_from(&*summary).unwrap_or_default();
    if let Ok(ended) = toml::Value::try_from(ended) {
        end.summary.insert(ENDED.to_string(), ended);
    }
    writer.add_conditions(provenance::granted(conditions));
    // Rows that never reached the writer; it adds its own losses.
    end.rows_lost = summary.records_lost;
    end.events_lost = summary.events_lost;
    let done = writer.finish(end);
    warnings.extend(summary.plan_warning());
    if summary.records_lost > 0 {
        warnings.push(format!(
            "{} rows were lost on the way to the recorder",
            summary.records_lost
        ));
    }
    summary.records_lost += done.faults.rows_lost;
    summary.events_lost += done.faults.events_lost;
    if done.faults.rows_lost + done.faults.events_lost > 0 {
        warnings.push(format!(
            "{} rows and {} events could not be written: {}",
            done.faults.rows_lost,
            done.faults.events_lost,
            done.faults.first.clone().unwrap_or_default()
        ));
    } else if let Err(error) = &done.parquet {
        warnings.push(format!("no ticks.parquet: {error}"));
    }
    if let Some(slowest) = done.slowest_sync.filter(|took| *took >= Unconfirmed::SAID) {
        warnings.push(format!(
            "the disk took up to {:.1} s to confirm what was written: a power failure would have cost that much of the run",
            slowest.as_secs_f64()
        ));
    }
    if !done.closed {
        warnings
            .push("run.toml does not say how the run ended: it could not be written".to_owned());
    }
    Kept {
        run: done.folder.display().to_string(),
        whole: done.closed && summary.records_lost == 0,
    }
}

/// Ends the folder of a run whose board was not armed.
pub fn not_armed(writer: RunWriter, failure: &Failure) {
    let mut end = RunEnd::new("not-armed");
    end.summary
        .insert("why".to_string(), toml::Value::String(failure.text()));
    // The user sees the failure anyway.
    let _ = writer.finish(end);
}

/// Whether a hold of some seconds reached less than a bound by more than chance: then the bound is of a diffusion or a delay that is
/// too large. Both errors in the same unit, without the noise of the camera.
pub fn is_beaten(bound: f64, reached: f64, duration_s: f64) -> bool {
    /// Time over which the error of a hold is correlated, s: a loop of 30 Hz or so.
    const CORRELATED_S: f64 = 0.005;
    // An RMS of n independent values has a relative standard deviation of 1/sqrt(2 n); three standard deviations.
    let unsure = 3.0 * (CORRELATED_S / duration_s.max(CORRELATED_S)).sqrt();
    reached < bound * (1.0 - unsure)
}

/// Figures of a run, over or not, that its lowest possible error depends on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Reached {
    /// Localisation noise as vision states it, nm RMS.
    pub(crate) fix_noise_nm: f64,
    /// As in [`delay_of_run_s`].
    pub(crate) loop_delay_ms: Option<f64>,
    /// RMS of the true error, nm, if it is known.
    pub(crate) rms_true_nm: Option<f64>,
    /// RMS of the measured error, nm, if it is known.
    pub(crate) rms_measured_nm: Option<f64>,
    pub(crate) duration_s: f64,
}

/// Smallest RMS error that any controller could reach, nm: from the assumed Brownian motion and noise, with the delay that the run
/// measured, not the configured one. `None` if the run did better: then the stated diffusion or noise is wrong, and the figure is not a
/// bound.
pub fn bound_rms_nm(file: &RigFile, setup: &Setup, summary: &Summary) -> Option<f64> {
    let diffusion = crate::fit::diffusion_um2_per_s(file, &setup.model);
    bound_of_run_nm(setup, diffusion, &Reached::of(summary)?)
}

impl Reached {
    /// Of a run that is over; `None` without a position.
    pub(crate) fn of(summary: &Summary) -> Option<Self> {
        let used = summary.exposure_to_command_us.max > 0.0;
        Some(Self {
            fix_noise_nm: summary.fix_noise_nm?,
            loop_delay_ms: used.then_some(summary.loop_delay_ms),
            rms_true_nm: summary.rms_true_nm,
            rms_measured_nm: summary.rms_measured_nm,
            duration_s: summary.duration_s,
        })
    }
}

/// [`bound_rms_nm`] of the run's figures and the diffusion, um^2/s.
pub(crate) fn bound_of_run_nm(setup: &Setup, diffusion: f64, run: &Reached) -> Option<f64> {
    let noise_nm = run.fix_noise_nm;
    let delay_s = delay_of_run_s(setup, run.loop_delay_ms);
    let bound_nm = 1e3 * bound_of_um(setup, diffusion, noise_nm * 1e-3, delay_s);
    let measured_nm = |nm: f64| (nm * nm - noise_nm * noise_nm).max(0.0).sqrt();
    let reached_nm = (run.rms_true_nm).or(run.rms_measured_nm.map(measured_nm));
    let beaten = reached_nm.is_some_and(|nm| is_beaten(bound_nm, nm, run.duration_s));
    (!beaten && bound_nm.is_finite()).then_some(bound_nm)
}

/// Delay from an exposure to the command of a run, s: as the run measured it (`loop_delay_ms`, with half a period of hold in it), or, of
/// a run that used no frame, as its rig file says.
pub fn delay_of_run_s(setup: &Setup, loop_delay_ms: Option<f64>) -> f64 {
    let timing = &setup.config.timing;
    match loop_delay_ms {
        Some(ms) => (1e-3 * ms - 0.5e-6 * timing.period_us).max(0.0),
        None => timing.camera_delay_ms * 1e-3,
    }
}

/// The lowest possible error as people read it, nm; `rms_nm` is the error of the run.
pub fn possible_text(bound_rms_nm: Option<f64>, rms_nm: Option<f64>) -> String {
    match (bound_rms_nm, rms_nm) {
        (Some(nm), _) => {
            format!("{nm:.1} nm RMS (Brownian motion, loop delay, noise of these fixes)")
        }
        (None, None) => "not stated: no error was measured".to_owned(),
        (None, Some(_)) => {
            "not stated: the error is below what the model says is possible. The model's diffusion or delay is too large: identify again"
                .to_owned()
        }
    }
}

/// The bound of a set-up's path with another camera path of `frame_age_s`, um. A command's way to the bead, measured with the model, is
/// part of the path.
pub fn bound_of_um(setup: &Setup, diffusion: f64, noise_um: f64, frame_age_s: f64) -> f64 {
    let sample_s = setup.config.timing.period_us * 1e-6;
    let delay_s = frame_age_s + command_delay_s(&setup.model);
    let plant =
        DesignPlant::from_model(&setup.model, Some(delay_s + 0.5 * sample_s), sample_s).ok();
    let model = plant.and_then(|plant| plant.loop_model().ok());
    match model {
        Some(model) => {
            let model = LoopModel { delay_s, ..model };
            bound_rms_of_path_um(diffusion, noise_um, &model)
        }
        None => bound_rms_um(diffusion, noise_um, delay_s, sample_s),
    }
}

/// The warning if the frames of a run were not as old as the rig file says: the loop was designed for another delay.
pub fn delay_warning(file: &RigFile, summary: &Summary) -> Option<String> {
    /// A shorter run holds mostly the first frames, which waited for the loop to begin.
    const FEWEST_TICKS: u64 = 100;
    // If no frame was used, their age is unknown, and the delay is that of the hold alone.
    if summary.exposure_to_command_us.max <= 0.0 || summary.counts.ticks < FEWEST_TICKS {
        return None;
    }
    let age = FrameAge {
        early_ms: 1e-3 * summary.exposure_to_command_us.p10,
        median_ms: 1e-3 * summary.exposure_to_command_us.p50,
    };
    age.advice(&file.timing).map(|(what, _)| what)
}

/// Warnings about a run that is over.
pub fn warnings<S>(finished: &Finished<S>) -> Vec<String> {
    let mut warnings = finished.rig.warnings().to_vec();
    warnings.extend(delay_warning(finished.rig.file(), &finished.summary));
    warnings.extend(partner_warning(&finished.summary));
    let calibration = finished.rig.file().calibration;
    warnings.extend((finished.odd_gain).map(|ratio| gain_warning(ratio, calibration.as_ref())));
    warnings
}

/// Warnings about the slow partner after a run.
fn partner_warning(summary: &Summary) -> Option<String> {
    let counts = &summary.counts;
    let part = |ticks: u64| 100.0 * ticks as f64 / counts.ticks.max(1) as f64;
    let (lost, limited) = (part(counts.partner_lost), part(counts.partner_limited));
    (lost + limited > 0.0).then(|| {
        format!(
            "the slow actuator was missing for {lost:.1} % of the run and at an end of its range for {limited:.1} %: for that time the PZT worked alone; see the run's events"
        )
    })
}

/// Possible causes of a gain that differs from the model's. A wrong pixel size changes the gain by the same factor.
fn gain_warning(ratio: f64, calibration: Option<&Calibration>) -> String {
    let pixel = calibration.map_or_else(String::new, |c| {
        format!(
            " (pixel_um = {}; {:.4} would make it the model's)",
            c.pixel_um,
            c.pixel_um / ratio
        )
    });
    format!(
        "the bead answered the arming pulse with {ratio:.2} of the model's gain: a pixel size wrong by that factor looks like this\
         {pixel}, and so do a wrong um per volt and the model of another chip: calibrate with a stage micrometre (cellpos \
         calibrate); if pixel and drive are right measure this rig (cellpos identify)"
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rig_file::Frames;
    use crate::{Options, Rig};

    #[test]
    fn the_lowest_error_counts_the_way_of_a_command_to_the_bead() {
        let options = Options {
            clock: ClockKind::Virtual,
            frames: Frames::Off,
            best_effort: true,
        };
        let mut rig = Rig::open(RigFile::default(), options).expect("a rig");
        let prepared = rig.prepare("eq6", "pi").expect("a law");
        let hold = ReferenceSpec::Hold { position_um: 0.0 };
        let mut setup = rig.set_up(prepared, hold).expect("a set-up");
        let bound_um = |setup: &Setup, frame_age_s| bound_of_um(setup, 0.33, 1e-3, frame_age_s);
        let (short_um, long_um) = (bound_um(&setup, 2e-3), bound_um(&setup, 3e-3));
        // A camera path of 2 ms, and 1 ms from a command to the bead.
        (setup.model.camera_delay_s, setup.model.frame_age_s) = (Some(3e-3), Some(2e-3));
        let found_um = bound_um(&setup, 2e-3);
        assert!(short_um < 0.95 * long_um);
        assert!((found_um - long_um).abs() < 1e-9, "{found_um} {long_um}");
    }
}
