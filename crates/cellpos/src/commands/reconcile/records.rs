//! The records that a reconciliation reads: CSV files and run folders, and the working point that they give.

use crate::outcome::Failure;
use cellpos_plant::effects;
use cellpos_plant::{Hertz, Model, Noise, TransferFunction};
use cellpos_reconcile::Record;
use cellpos_record::{RunMeta, RunReader, number_at};
use cellpos_runtime::TickRecord;
use cellpos_session::sessions;
use cellpos_workbench::experiment::collect::{neutral_um, of_ticks, record_name, refused};
use cellpos_workbench::foreign::columns::{self, Wanted};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Where CSV files have what, and in which units.
#[derive(Debug, clap::Args)]
pub(super) struct Columns {
    /// Input column: its name, with or without the unit, or its number from 1.
    #[arg(long, alias = "input", default_value = "pzt_um")]
    pub(super) input_column: String,
    /// Output column: its name, or its number from 1.
    #[arg(long, alias = "output", default_value = "bead_um")]
    pub(super) output_column: String,
    /// Time column, in the unit of its name (`t [ms]`, time_min), else in seconds
    /// [default: the one called time or t].
    #[arg(long)]
    time_column: Option<String>,
    /// Sampling rate (200Hz) of files without a time column.
    #[arg(long, value_parser = crate::arguments::positive::<cellpos_numeric::units::Hertz>)]
    rate: Option<cellpos_numeric::units::Hertz>,
    /// Factor from the input column to um of the model: 4 for 4 um per volt. Data of another rig need none.
    #[arg(long, default_value_t = 1.0)]
    input_um_per_unit: f64,
    /// Factor from the output column to um of the model: 0.001 for nanometres. Data of another rig need none.
    #[arg(long, default_value_t = 1.0)]
    output_um_per_unit: f64,
    /// Rows of every file, from 0, TO not included.
    #[arg(long, value_name = "FROM:TO")]
    rows: Option<String>,
}

/// Endings of the files that are taken for records where a folder is named.
const RECORDS: [&str; 6] = ["csv", "dat", "txt", "tsv", "npy", "mat"];

/// All record files behind the arguments, in a fixed order.
pub(super) fn files(data: &[PathBuf]) -> Result<Vec<PathBuf>, Failure> {
    let mut found = Vec::new();
    for path in data {
        if path.is_dir() && !is_run(path) {
            let entries = std::fs::read_dir(path).map_err(|e| {
                Failure::bad_input(
                    format!("--data {}: cannot be read: {e}", path.display()),
                    "make it readable, or name its files with --data",
                )
            })?;
            let mut inside: Vec<PathBuf> = entries
                .filter_map(Result::ok)
                .map(|e| e.path())
                .filter(|p| {
                    (p.is_dir() && is_run(p))
                        || p.extension()
                            .is_some_and(|e| RECORDS.iter().any(|r| e == *r))
                })
                .collect();
            inside.sort();
            if inside.is_empty() {
                return Err(Failure::bad_input(
                    format!(
                        "no record (csv, dat, txt, npy, mat) and no run folder in {}",
                        path.display()
                    ),
                    "--data takes record files (text, .npy, .mat), run folders, or a folder of them",
                ));
            }
            found.extend(inside);
        } else if path.exists() {
            found.push(path.clone());
        } else {
            return Err(Failure::bad_input(
                format!("--data {}: does not exist", path.display()),
                "give a record file, a run folder or a folder of them",
            ));
        }
    }
    // A run that was resumed has a record for each of its sessions.
    Ok((found.iter())
        .flat_map(|path| match is_run(path) {
            true => sessions::of(path),
            false => vec![path.clone()],
        })
        .collect())
}

/// Runs of the emulated rig, by their seed.
#[derive(Debug, Default)]
pub(super) struct Noises(BTreeMap<u64, PathBuf>);

impl Noises {
    /// Takes a run of its own noise; sessions of one run belong together. Runs of the emulated rig with one seed share one noise: the
    /// second would confirm whatever fits the noise of the first.
    pub(super) fn add(&mut self, path: &Path, run: &RunReader) -> Result<(), Failure> {
        let Some(seed) = run.meta().ok().and_then(|meta| meta.seed) else {
            return Ok(());
        };
        let Some(first) = self.0.get(&seed) else {
            self.0.insert(seed, path.to_owned());
            return Ok(());
        };
        if path != first && path.starts_with(first) {
            return Ok(());
        }
        Err(Failure::bad_input(
            format!(
                "--data: {} and {} are runs of the emulated rig with the same `seed` = {seed}: they share one noise",
                first.display(),
                path.display()
            ),
            format!(
                "record one of them again with --seed {}",
                seed.wrapping_add(1)
            ),
        ))
    }
}

pub(super) fn is_run(path: &Path) -> bool {
    path.join("ticks.arrow").exists()
}

pub(super) fn read(path: &Path, columns: &Columns, held: bool) -> Result<Record, Failure> {
    let wanted = Wanted {
        input: &columns.input_column,
        output: Some(&columns.output_column),
        time: columns.time_column.as_deref(),
        rate: columns.rate,
        factors: [columns.input_um_per_unit, columns.output_um_per_unit],
        rows: columns.rows.as_deref(),
        held,
    };
    columns::read(path, &wanted)
}

/// A run folder, of an open or a closed loop: the commands given, and the positions as the camera delivered them; and where
/// its bead rested.
pub(super) fn read_run(path: &Path, run: &RunReader) -> Result<(Record, Option<f64>), Failure> {
    let whole = run.to_record().map_err(Failure::input)?;
    let ticks: Vec<TickRecord> = run.batches().map_err(Failure::input)?.flatten().collect();
    let mut read = if ticks.iter().any(TickRecord::is_running) {
        of_ticks(&record_name(path), &ticks, whole.step_s)?
    } else {
        let time_s: Vec<f64> = (0..whole.len())
            .map(|k| whole.start_s + k as f64 * whole.step_s)
            .collect();
        Record::from_rows(&record_name(path), &time_s, &whole.pzt_um, &whole.bead_um)
            .map_err(refused)?
    };
    read.exposure_s = run.meta().map_or(0.0, exposure_s);
    read.slew_um_per_s = run.meta().map_or(0.0, slew_um_per_s);
    // Where the bead of a closed loop rested: the mean of what was commanded while the loop ran, um.
    let held = ticks.iter().filter(|tick| held(tick));
    let (sum_um, count) = held.fold((0.0, 0_usize), |(sum, count), tick| {
        (sum + tick.command_um, count + 1)
    });
    // Ten seconds of a held bead move it by less than 10 um: 2 nm of PZT.
    Ok((read, (count >= 1000).then(|| sum_um / count as f64)))
}

/// Exposure of a run's frames as its loop knew it, s; 0 if it did not.
fn exposure_s(meta: &RunMeta) -> f64 {
    let ms = number_at(&meta.controller, &["estimator", "exposure_ms"]);
    ms.map_or(0.0, |ms| 1e-3 * ms.max(0.0))
}

/// Largest speed of the displacement that a run's board allowed, um/s; 0 if run.toml does not say.
fn slew_um_per_s(meta: &RunMeta) -> f64 {
    let rigs = number_at(&meta.config, &["rig", "limits", "slew_um_per_s"]);
    let boards = number_at(&meta.conditions, &["actuator", "slew_um_per_s"]);
    let known = [rigs, boards].into_iter().flatten();
    known.reduce(f64::min).unwrap_or(0.0).max(0.0)
}

/// Whether the loop ran in a tick.
fn held(t: &TickRecord) -> bool {
    t.is_controlled() && t.command_um.is_finite()
}

/// The rest of a bead differs from day to day. The working point of records of a rig of cellpos is the command at which their bead neither
/// went nor came. That of other records is the model's, if one of them comes near it.
/// Whether it is another than the model's: it is then no better known than these records tell.
pub(super) fn at_rest_of_records(
    model: &mut Model,
    records: &[Record],
    rests_um: &[f64],
    bead: bool,
) -> bool {
    let own = of_own_rig(records);
    let inside = records.iter().any(|r| {
        let (low, high) = r.pzt_range_um();
        (low..=high).contains(&model.working_point_um)
    });
    let gain_per_s = model.plant.velocity_gain_at(Hertz(2.0));
    let of_records: Vec<f64> = match rests_um.is_empty() && bead && !in_volts(model, records) {
        true => records.iter().map(|r| neutral_um(r, gain_per_s)).collect(),
        false => rests_um.to_vec(),
    };
    if inside && !own || of_records.is_empty() {
        return false;
    }
    let rest_um = of_records.iter().sum::<f64>() / of_records.len() as f64;
    if !inside {
        tracing::warn!(
            "the model's working point, {} um, is outside of what was commanded: the bead of these records rested at {rest_um:.3} um, \
             which is taken instead",
            model.working_point_um
        );
    }
    model.working_point_um = rest_um;
    true
}

/// Whether records are of a rig of cellpos: those say when their frames were taken.
pub(super) fn of_own_rig(records: &[Record]) -> bool {
    records.iter().any(|r| !r.frame_age_s.is_empty())
}

/// Whether the commands look like volts: at 4 um per volt they would be at the model's working point.
fn in_volts(model: &Model, records: &[Record]) -> bool {
    cellpos_reconcile::looks_like_volts(records, model.working_point_um)
}

/// A run shows its bead late by the camera path. If the model states that delay, it is added as an effect here; otherwise it
/// would be found again and counted twice.
pub(super) fn with_camera_delay(model: &mut Model) {
    if model.effect("time-delay").is_none()
        && let Some(delay_s) = model.camera_delay_s.take().filter(|d| *d > 0.0)
    {
        model.effects.push(effects::time_delay(delay_s));
        let stated = model.covariance.iter_mut();
        for name in stated.flat_map(|stated| &mut stated.parameters) {
            if name == Model::CAMERA_DELAY {
                "time-delay.delay_s".clone_into(name);
            }
        }
    }
}

/// A base model for data without one: a constant gain about the command before the records began.
pub(super) fn fitted(records: &[Record]) -> Result<Model, Failure> {
    let (gain, working_point_um) = cellpos_reconcile::constant_gain(records).map_err(refused)?;
    Ok(Model {
        name: "fit".to_owned(),
        description: "A constant gain fitted to the records".to_owned(),
        plant: TransferFunction::new(vec![gain], vec![1.0]).map_err(Failure::input)?,
        working_point_um,
        noise: Noise::NONE,
        ..Model::eq6()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_says_how_long_its_frames_were_exposed_and_how_fast_its_board_may_be() {
        let mut meta = RunMeta::new("r", "real");
        assert_eq!((exposure_s(&meta), slew_um_per_s(&meta)), (0.0, 0.0));
        let table = |text: &str| toml::from_str::<toml::Table>(text).expect("TOML");
        meta.controller = table("[estimator]\nexposure_ms = 0.5\n");
        meta.config = table("[rig.limits]\nslew_um_per_s = 20000.0\n");
        assert_eq!((exposure_s(&meta), slew_um_per_s(&meta)), (5e-4, 20_000.0));
        meta.conditions = table("[actuator]\nslew_um_per_s = 5000.0\n");
        assert_eq!(slew_um_per_s(&meta), 5000.0);
    }
}
