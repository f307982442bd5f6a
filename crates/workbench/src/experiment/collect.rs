//! `cellpos reconcile --collect`: runs the deciding experiment on the rig, through the loop of `cellpos track`, adds its record to the
//! data and reconciles again.

use crate::experiment::again::Again;
use crate::experiment::excitation::Experiment;
use crate::experiment::on_rig::{Acquired, Listener, OnRig, Trouble};
use crate::experiment::rows::{Delivered, Rows};
use cellpos_ident::experiment::Plan;
use cellpos_plant::{Hertz, Model};
use cellpos_reconcile::{Options, ReconcileError, Reconciliation, Record, Verdict, reconcile};
use cellpos_runtime::TickRecord;
use cellpos_session::Failure;
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

impl Collected {
    /// Of the records of an experiment.
    pub fn of(
        experiment: Experiment,
        why: &str,
        verdict: &str,
        records: &[(PathBuf, Record)],
    ) -> Vec<Self> {
        let one = |(file, record): &(PathBuf, Record)| Self {
            experiment: experiment.name(),
            what: experiment.what(),
            why: why.to_owned(),
            file: file.clone(),
            rows: record.rows(),
            rows_without_bead: record.rows() - record.frames(),
            verdict: verdict.to_owned(),
        };
        records.iter().map(one).collect()
    }
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

/// An experiment on a rig.
#[derive(Debug, Clone)]
pub struct Ran {
    /// Its records, each with its file: one of each run. There are several if the bead was lost and another one came.
    pub records: Vec<(PathBuf, Record)>,
    /// Displacement at which the bead rests, um: for a held bead the mean command.
    pub neutral_um: f64,
    /// From the middle of an exposure to the tick that used it, s.
    pub age_s: f64,
}

/// Runs one experiment, all its times multiplied by `share`. After a lost bead it runs again what is missing, as `identify` does. A
/// record so far is written after each part, so that it survives the process: the first to `file`, the others to the same folder.
///
/// # Errors
/// The rig failed, or a run ended early and a person must act; the records are in their files.
pub fn run_experiment(
    rig: &OnRig,
    experiment: Experiment,
    share: f64,
    seed: u64,
    file: &Path,
    progress: &mut (dyn FnMut(&str) + Send),
) -> Result<Ran, Failure> {
    let plan = experiment.plan(rig, share, seed)?;
    run_plan(rig, &plan, file, &mut |part| {
        progress(&format!(
            "on the rig: {}, {:.0} %",
            experiment.what(),
            100.0 * part
        ));
    })
}

/// Runs a plan until every segment is measured; `progress` gets the measured part.
fn run_plan(
    rig: &OnRig,
    plan: &Plan,
    file: &Path,
    progress: &mut (dyn FnMut(f64) + Send),
) -> Result<Ran, Failure> {
    let mut rig = rig.clone();
    let (mut again, mut segments) = (Again::of(plan), Vec::new());
    let mut records: Vec<(PathBuf, Record)> = Vec::new();
    let total = plan.ticks().max(1) as f64;
    let mut done = 0.0;
    loop {
        let todo = again.missing(&segments);
        let file = free_path(file);
        let keep = |so_far: &Acquired| {
            let record = record(so_far, &file, plan.period_s)?;
            write_record(&record, &file).map(|()| record)
        };
        let mut heard = |ticks: usize| progress((done + ticks as f64 / total).min(1.0));
        let mut segment = |so_far: &Acquired| {
            if let Err(failure) = keep(so_far) {
                tracing::warn!("{}: {}", file.display(), failure.text());
            }
        };
        let mut listener = Listener {
            progress: &mut heard,
            segment: &mut segment,
        };
        let acquired = rig.acquire(plan, &todo, &mut listener);
        let acquired = acquired.map_err(|failure| match records.is_empty() {
            true => failure,
            false => failure.with_remedy(&what_is_kept(&records)),
        })?;
        let kept = keep(&acquired);
        let Some(trouble @ Trouble::Ended(ended)) = &acquired.trouble else {
            // A record is of use although the bead was out of sight in some segments.
            records.push((file, kept?));
            return ran(&rig, records, acquired.age_s);
        };
        match kept {
            Ok(record) => records.push((file, record)),
            Err(failure) => tracing::warn!("{}: {}", file.display(), failure.text()),
        }
        segments.extend_from_slice(&acquired.records);
        again.learn(&acquired, &segments);
        if !again.may_go_on(trouble) {
            return Err(ended.failure(&what_is_kept(&records)));
        }
        tracing::warn!("{}; measuring again what is missing", trouble.seen());
        done = segments.len() as f64 / plan.segments.len() as f64;
        if !acquired.records.is_empty() {
            rig.file.rested_um = Some(acquired.neutral_um);
        }
    }
}

/// What to do after a run that ended early.
fn what_is_kept(records: &[(PathBuf, Record)]) -> String {
    let files: Vec<String> = (records.iter())
        .map(|(file, _)| file.display().to_string())
        .collect();
    if files.is_empty() {
        return "run the command again; records already collected are kept".to_owned();
    }
    format!(
        "the records are in {}: give them to --data, or run the command again",
        files.join(", ")
    )
}

/// The records of an experiment, with a word if the machine did not keep the loop's time.
fn ran(rig: &OnRig, records: Vec<(PathBuf, Record)>, age_s: Option<f64>) -> Result<Ran, Failure> {
    let count = |of: fn(&Record) -> usize| records.iter().map(|(_, r)| of(r)).sum::<usize>();
    let rows = count(Record::rows);
    let missing = rows - count(Record::frames);
    if 50 * missing > rows {
        tracing::warn!(
            "{missing} of {rows} rows have no bead, or their frame came too late: this machine did not keep the loop's time, or the bead \
             was hard to see, and the verdict may suffer from it (cellpos doctor)"
        );
    }
    let longest = records.iter().max_by_key(|(_, record)| record.rows());
    let (_, longest) = longest.ok_or_else(|| refused(ReconcileError::NoRecords))?;
    Ok(Ran {
        neutral_um: neutral_um(longest, rig.model.plant.velocity_gain_at(Hertz(2.0))),
        records,
        age_s: age_s.unwrap_or(rig.file.timing.camera_delay_ms * 1e-3),
    })
}

/// The name of a file's record.
pub fn record_name(file: &Path) -> String {
    file.file_stem().map_or_else(
        || file.display().to_string(),
        |stem| stem.to_string_lossy().into_owned(),
    )
}

/// A run as a record, since the bead was caught.
fn record(acquired: &Acquired, file: &Path, period_s: f64) -> Result<Record, Failure> {
    let mut record = of_rows(&record_name(file), &acquired.rows.since_caught(), period_s)?;
    record.exposure_s = acquired.exposure_s;
    record.slew_um_per_s = acquired.slew_um_per_s;
    Ok(record)
}

/// The ticks of a run with a closed loop as a record, row by row of the camera: a tick that is early or late, or never comes, moves no row. A
/// stall leaves open when the board had the commands of its rows.
///
/// # Errors
/// Ticks that are no record, with what a record needs.
pub fn of_ticks(name: &str, ticks: &[TickRecord], period_s: f64) -> Result<Record, Failure> {
    let rows = Rows::of(ticks, (period_s * 1e9).round() as i64).delivered();
    of_rows(name, &rows, period_s)
}

fn of_rows(name: &str, rows: &Delivered, period_s: f64) -> Result<Record, Failure> {
    let time_s: Vec<f64> = (0..rows.pzt_um.len())
        .map(|k| k as f64 * period_s)
        .collect();
    let mut record =
        Record::from_rows(name, &time_s, &rows.pzt_um, &rows.bead_um).map_err(refused)?;
    record.unseen.clone_from(&rows.unseen);
    record.frame_age_s.clone_from(&rows.frame_age_s);
    record.late_command.clone_from(&rows.late_command);
    record.late_motion_um.clone_from(&rows.late_motion_um);
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
/// Column of a record with the largest speed of the displacement that the board allows.
pub const SLEW: &str = "slew_um_per_s";
/// Column of a record: 1 where a row's command came half a row late or more, or never, else 0.
pub const LATE_COMMAND: &str = "late_command";
/// Column of a record: standard deviation of the motion from the row before that late commands leave open, um; empty where nobody knows
/// when they acted.
pub const LATE_MOTION: &str = "late_motion_um";
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
    if !record.late_motion_um.is_empty() {
        more.push((LATE_MOTION.to_owned(), record.late_motion_um.clone()));
    }
    if record.unseen.contains(&true) {
        let came = (record.unseen.iter().zip(&record.bead_um))
            .map(|(unseen, bead)| f64::from(u8::from(*unseen || bead.is_finite())));
        more.push((FRAME_CAME.to_owned(), came.collect()));
    }
    for (name, value) in [(EXPOSURE, record.exposure_s), (SLEW, record.slew_um_per_s)] {
        if value > 0.0 {
            more.push((name.to_owned(), vec![value; record.rows()]));
        }
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
        let verdict = match &result {
            Ok(r) => r.verdict.word().to_owned(),
            Err(error) => error.to_string(),
        };
        for new in collected.iter_mut().filter(|one| one.verdict.is_empty()) {
            new.verdict.clone_from(&verdict);
        }
        let wanted = next(&result)
            .filter(|_| done.len() < collecting.rounds)
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
        let seed = collecting.seed + done.len() as u64 - 1;
        std::fs::create_dir_all(collecting.folder).map_err(Failure::failed)?;
        let file = collecting
            .folder
            .join(format!("{}-1.csv", experiment.name()));
        let Ran {
            records: ran,
            neutral_um,
            ..
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
        collected.extend(Collected::of(experiment, &why, "", &ran));
        records.extend(ran.into_iter().map(|(_, record)| record));
    }
}

/// The path itself if there is no such file yet, else one with the next free number: `survey-1.csv`, then `survey-2.csv`. Nothing is
/// overwritten.
fn free_path(file: &Path) -> PathBuf {
    let name = record_name(file);
    let stem = name.trim_end_matches(|c: char| c.is_ascii_digit());
    let stem = stem.trim_end_matches('-');
    let numbered = (1..).map(|n| file.with_file_name(format!("{stem}-{n}.csv")));
    std::iter::once(file.to_owned())
        .chain(numbered)
        .find(|path| !path.exists())
        .unwrap_or_else(|| file.to_owned())
}

#[cfg(test)]
#[path = "collect_tests.rs"]
mod table;
