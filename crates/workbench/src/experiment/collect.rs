//! `cellpos reconcile --collect`: runs the deciding experiment on the rig, through the loop of `cellpos track`, adds its record to the
//! data and reconciles again.

use crate::experiment::excitation::Experiment;
use crate::experiment::on_rig::{Acquired, Listener, OnRig, Trouble};
use cellpos_ident::experiment::Turn;
use cellpos_plant::{Hertz, Model};
use cellpos_reconcile::{Options, ReconcileError, Reconciliation, Record, Verdict, reconcile};
use cellpos_session::Failure;
use cellpos_session::connect::stated_exposure_s;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Converts the error of a failed verdict to a failure.
pub fn refused(error: ReconcileError) -> Failure {
    Failure::bad_input(
        error,
        "no verdict: see docs/find-missing.md for what records are needed",
    )
}

/// One experiment that was run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Collected {
    /// Its name.
    pub experiment: &'static str,
    /// What was driven.
    pub what: &'static str,
    /// Why it was run.
    pub why: String,
    /// Path of its record, ready for `--data`.
    pub file: PathBuf,
    /// Rows of the record.
    pub rows: usize,
    /// Rows without a bead: not seen, or its frame came too late for its row.
    pub rows_without_bead: usize,
    /// Verdict with it.
    pub verdict: String,
}

/// How to collect.
pub struct Collecting<'a> {
    /// The rig.
    pub rig: &'a OnRig,
    /// Folder for the records.
    pub folder: &'a Path,
    /// Most experiments.
    pub rounds: usize,
    /// Factor on the duration of every experiment.
    pub share: f64,
    /// Seed of the excitations.
    pub seed: u64,
}

/// A run on a rig, as a record.
#[derive(Debug, Clone)]
pub struct Ran {
    /// The record.
    pub record: Record,
    /// Displacement at which the bead rests, um: for a held bead the mean command.
    pub neutral_um: f64,
    /// From the middle of an exposure to the tick that used it, s.
    pub age_s: f64,
}

/// Runs one experiment, all its times multiplied by `share`. Its record so far is written to `file` after each part, so that it
/// survives the process.
///
/// # Errors
/// The rig failed, or the run ended early; its record is in `file`.
pub fn run_experiment(
    rig: &OnRig,
    experiment: Experiment,
    share: f64,
    seed: u64,
    file: &Path,
    progress: &mut (dyn FnMut(&str) + Send),
) -> Result<Ran, Failure> {
    let plan = experiment.plan(rig, share, seed)?;
    let all: Vec<Turn> = (0..plan.segments.len()).map(Turn::planned).collect();
    let total = plan.ticks();
    let exposure_s = stated_exposure_s(&rig.file).unwrap_or(0.0);
    let name = file
        .file_stem()
        .map_or_else(String::new, |stem| stem.to_string_lossy().into_owned());
    let mut heard = |ticks: usize| {
        progress(&format!(
            "on the rig: {}, {:.0} %",
            experiment.what(),
            100.0 * ticks.min(total) as f64 / total.max(1) as f64
        ));
    };
    let mut segment = |so_far: &Acquired| {
        let kept =
            record(&name, so_far, plan.period_s, exposure_s).and_then(|r| write_record(&r, file));
        if let Err(failure) = kept {
            tracing::warn!("{}: {}", file.display(), failure.text());
        }
    };
    let mut listener = Listener {
        progress: &mut heard,
        segment: &mut segment,
    };
    let acquired = rig.acquire(&plan, &all, &mut listener)?;
    if let Some(Trouble::Ended(ended)) = &acquired.trouble {
        let kept = record(&name, &acquired, plan.period_s, exposure_s)
            .and_then(|r| write_record(&r, file));
        return Err(ended.failure(&match kept {
            Ok(()) => format!(
                "the records are in {}: give them to --data, or run the command again",
                file.display()
            ),
            Err(_) => "run the command again; records already collected are kept".to_string(),
        }));
    }
    let record = record(&name, &acquired, plan.period_s, exposure_s)?;
    write_record(&record, file)?;
    let missing = record.rows() - record.frames();
    if 50 * missing > record.rows() {
        tracing::warn!(
            "{missing} of {} rows have no bead, or their frame came too late: this machine did not keep the loop's time, or the bead \
             was hard to see, and the verdict may suffer from it (cellpos doctor)",
            record.rows()
        );
    }
    Ok(Ran {
        neutral_um: neutral_um(&record, rig.model.plant.velocity_gain_at(Hertz(2.0))),
        record,
        age_s: acquired
            .age_s
            .unwrap_or(rig.file.timing.camera_delay_ms * 1e-3),
    })
}

/// A run as a record.
fn record(
    name: &str,
    acquired: &Acquired,
    period_s: f64,
    exposure_s: f64,
) -> Result<Record, Failure> {
    let (pzt_um, bead_um) = &acquired.rows;
    let time_s: Vec<f64> = (0..pzt_um.len()).map(|k| k as f64 * period_s).collect();
    let mut record = Record::from_rows(name, &time_s, pzt_um, bead_um).map_err(refused)?;
    record.unseen.clone_from(&acquired.unseen);
    record.frame_age_s.clone_from(&acquired.frame_age_s);
    record.late_command.clone_from(&acquired.late_command);
    record.exposure_s = exposure_s;
    Ok(record)
}

/// Mean command of a held bead, minus the part that moved the bead from its first to its last position. The loop's own estimate follows
/// Brownian motion, and an error of 4 nm would look like a drift of 1.7 um/s.
pub fn neutral_um(record: &Record, gain_per_s: f64) -> f64 {
    let mean_um = record.pzt_um.iter().sum::<f64>() / record.rows().max(1) as f64;
    let mut seen = record.bead_um.iter().filter(|b| b.is_finite());
    match (seen.next(), seen.next_back()) {
        (Some(first), Some(last)) if gain_per_s != 0.0 && record.duration_s() > 0.0 => {
            mean_um - (last - first) / (gain_per_s * record.duration_s())
        }
        _ => mean_um,
    }
}

/// Column of a record with the time from the exposure of a row's frame to the row's command.
pub const FRAME_AGE: &str = "frame_age_s";
/// Column of a record with the exposure of its frames.
pub const EXPOSURE: &str = "exposure_s";

/// Column of a record: 1 in a stall, in which nobody knows when a row's command acted, else 0.
pub const LATE_COMMAND: &str = "late_command";
/// Column of a record with 1 where a row's frame came, with a bead or without, and 0 where it was dropped.
pub const FRAME_CAME: &str = "frame_came";

/// Writes a record as the CSV that every command reads.
pub fn write_record(record: &Record, path: &Path) -> Result<(), Failure> {
    let mut more = Vec::new();
    if !record.frame_age_s.is_empty() {
        more.push((FRAME_AGE.to_owned(), record.frame_age_s.clone()));
    }
    if record.late_command.contains(&true) {
        let late = record
            .late_command
            .iter()
            .map(|late| f64::from(u8::from(*late)));
        more.push((LATE_COMMAND.to_owned(), late.collect()));
    }
    if record.unseen.contains(&true) {
        let came = (record.unseen.iter().zip(&record.bead_um))
            .map(|(unseen, bead)| f64::from(u8::from(*unseen || bead.is_finite())));
        more.push((FRAME_CAME.to_owned(), came.collect()));
    }
    if record.exposure_s > 0.0 {
        more.push((EXPOSURE.to_owned(), vec![record.exposure_s; record.rows()]));
    }
    let table = cellpos_table::Record {
        start_s: record.start_s,
        more,
        ..cellpos_table::Record::new(
            &record.name,
            record.sample_s,
            record.pzt_um.clone(),
            record.bead_um.clone(),
        )
    };
    table.write(path).map_err(Failure::failed)
}

/// The next experiment, and why; `None` if none would help.
fn next(result: &Result<Reconciliation, ReconcileError>) -> Option<(Experiment, String)> {
    match result {
        Ok(r) if r.verdict == Verdict::Ambiguous => r.effects.iter().find_map(|e| {
            let experiment = Experiment::separating(&e.id, &e.alternatives)?;
            let why = format!(
                "{} or {}: {}",
                e.id,
                e.alternatives.join(" or "),
                e.separate_by.as_deref().unwrap_or("more data")
            );
            Some((experiment, why))
        }),
        Ok(_) => None,
        Err(ReconcileError::NoRecords) => Some((Experiment::Survey, "no record yet".to_owned())),
        Err(error @ (ReconcileError::ConstantInput | ReconcileError::TooShort { .. })) => {
            Some((Experiment::Survey, error.to_string()))
        }
        Err(_) => None,
    }
}

/// Reconciles, then collects and reconciles again while that helps. If no record comes near `model.working_point_um`, it becomes the
/// neutral that the loop found.
pub fn look(
    model: &mut Model,
    records: &mut Vec<Record>,
    options: &Options,
    collecting: &Collecting<'_>,
    progress: &mut (dyn FnMut(&str) + Send),
) -> Result<(Reconciliation, Vec<Collected>), Failure> {
    let mut options = options.clone();
    let mut collected: Vec<Collected> = Vec::new();
    let mut done: Vec<Experiment> = Vec::new();
    loop {
        let result = reconcile(model, records, &options, &mut |text| progress(text));
        if let Some(last) = collected.last_mut() {
            last.verdict = match &result {
                Ok(r) => r.verdict.word().to_owned(),
                Err(error) => error.to_string(),
            };
        }
        let wanted = next(&result)
            .filter(|_| collected.len() < collecting.rounds)
            // The same experiment would not decide now either; a longer record may.
            .map(|(e, why)| {
                if done.contains(&e) {
                    (Experiment::Long, why)
                } else {
                    (e, why)
                }
            })
            .filter(|(e, _)| !done.contains(e));
        let Some((experiment, why)) = wanted else {
            return Ok((result.map_err(refused)?, collected));
        };
        done.push(experiment);
        let seed = collecting.seed + collected.len() as u64;
        std::fs::create_dir_all(collecting.folder).map_err(Failure::failed)?;
        let file = free_name(collecting.folder, experiment);
        let Ran {
            record, neutral_um, ..
        } = run_experiment(
            collecting.rig,
            experiment,
            collecting.share,
            seed,
            &file,
            progress,
        )?;
        options.free_working_point = true;
        if records.is_empty() {
            model.working_point_um = neutral_um;
        }
        collected.push(Collected {
            experiment: experiment.name(),
            what: experiment.what(),
            why,
            file,
            rows: record.rows(),
            rows_without_bead: record.rows() - record.frames(),
            verdict: String::new(),
        });
        records.push(record);
    }
}

/// The path of a new file, so that nothing is overwritten.
fn free_name(folder: &Path, experiment: Experiment) -> PathBuf {
    (1..)
        .map(|n| folder.join(format!("{}-{n}.csv", experiment.name())))
        .find(|path| !path.exists())
        .unwrap_or_else(|| folder.join(experiment.name()))
}

#[cfg(test)]
#[path = "collect_tests.rs"]
mod table;
