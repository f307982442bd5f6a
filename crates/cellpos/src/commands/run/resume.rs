//! A run that is gone on with: everything comes from its folder.

use super::ready::Ready;
use crate::outcome::Failure;
use crate::rig_file::{ClockKind, RigFile};
use crate::setup::{Prepared, ReferenceSpec};
use cellpos_record::{
    CYCLES_CSV, CYCLES_PARQUET, LineFile, RecordError, RunReader, SESSIONS, TableColumn,
    write_table_parquet,
};
use cellpos_runtime::{Stage, TickRecord};
use cellpos_script::{ArmKind, CycleRow, CycleTable, read_cycles};
use cellpos_session::sessions::{self, SessionConfig, session_config};
use cellpos_table::read_text;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Larger than the table of any run, bytes.
const MOST_TABLE: u64 = 1 << 30;

/// The acknowledged cycles of a run. Without the table, cycles are counted from the ticks: starting at cycle 0 would repeat all.
pub(crate) fn cycles(folder: &Path) -> Result<Vec<CycleRow>, Failure> {
    let path = folder.join(CYCLES_CSV);
    let text = match read_text(&path, MOST_TABLE) {
        Ok(text) => text,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return counted(folder),
        Err(error) => {
            return Err(Failure::bad_input(
                format!("{}: {error}", path.display()),
                "give the folder of a run of cellpos run",
            ));
        }
    };
    let whole = cellpos_record::whole_text(&text);
    let read = read_cycles(whole);
    // Going on from fewer rows than there are would do cycles twice.
    let problem = match (&read.head, read.unreadable) {
        (Some(error), _) => error.to_string(),
        (None, 0) => return Ok(read.rows),
        (None, lines) => format!("{lines} lines are no rows"),
    };
    Err(Failure::bad_input(
        format!("{}: {problem}", path.display()),
        "was it changed, or written by a newer version? correct it, use that version, or begin a new run",
    ))
}

/// The cycles that the ticks of all sessions hold whole.
fn counted(folder: &Path) -> Result<Vec<CycleRow>, Failure> {
    let mut rows = Vec::new();
    for session in sessions::of(folder) {
        let reader = RunReader::open(&session).map_err(Failure::input)?;
        let Some(config) = session_config(&reader) else {
            continue;
        };
        let setup = cellpos_session::recorded::setup(&reader)?;
        let Some((_, plan)) = setup.config.reference.script()? else {
            continue;
        };
        let timing = &setup.config.timing;
        let mut table = CycleTable::new(
            Arc::new(plan),
            config.number,
            config.first_cycle,
            timing.camera_delay_ms,
            timing.period_us,
        );
        for tick in reader.batches().map_err(Failure::input)?.flatten() {
            table.add(&tick);
            rows.extend(std::iter::from_fn(|| table.pop()));
        }
    }
    Ok(rows)
}

/// Rewrites a run's table of cycles, completely or not at all.
fn write_cycles(path: &Path, rows: &[CycleRow]) -> Result<(), Failure> {
    let mut text = CycleRow::csv_head() + "\n";
    for row in rows {
        text.push_str(&row.to_csv());
        text.push('\n');
    }
    cellpos_table::write_atomically(path, text.as_bytes()).map_err(Failure::failed)
}

/// Converts the table of an older version's run to the present columns, in one step. New rows then have the same header; values
/// that the older version did not measure stay empty.
fn renew(folder: &Path) -> Result<(), Failure> {
    let path = folder.join(CYCLES_CSV);
    let Ok(text) = read_text(&path, MOST_TABLE) else {
        // The table is gone: the cycles that the ticks hold are its first rows.
        let rows = cycles(folder)?;
        return match rows.is_empty() {
            true => Ok(()),
            false => write_cycles(&path, &rows),
        };
    };
    if !read_cycles(cellpos_record::whole_text(&text)).older {
        return Ok(());
    }
    // Held while it is replaced: nobody else may be writing it.
    let held = LineFile::open(&path, &CycleRow::csv_head(), true).map_err(Failure::input)?;
    write_cycles(&path, &cycles(folder)?)?;
    drop(held);
    Ok(())
}

/// The per-cycle table for other programs.
pub(crate) fn cycles_parquet(folder: &Path, rows: &[CycleRow]) -> Result<(), RecordError> {
    let Some(first) = rows.first() else {
        return Ok(());
    };
    let numbers: Vec<Vec<(&str, f64)>> = rows.iter().map(CycleRow::numbers).collect();
    let mut columns: Vec<(&str, TableColumn)> = first
        .numbers()
        .iter()
        .enumerate()
        .map(|(index, (name, _))| {
            let values = numbers
                .iter()
                .map(|row| row.get(index).map_or(f64::NAN, |cell| cell.1));
            (*name, TableColumn::Numbers(values.collect()))
        })
        .collect();
    let arm = |row: &CycleRow| match row.arm {
        ArmKind::Cyclic => "cyclic".to_string(),
        ArmKind::Static => "static".to_string(),
    };
    columns.push(("arm", TableColumn::Texts(rows.iter().map(arm).collect())));
    let flags = rows.iter().map(|row| row.flags.to_string()).collect();
    columns.push(("flags", TableColumn::Texts(flags)));
    write_table_parquet(&folder.join(CYCLES_PARQUET), &columns)
}

/// What comes after the sessions of a run.
pub(crate) enum Next {
    /// Another session.
    Session(Box<Ready>),
    /// Nothing: why.
    Nothing(String),
}

/// The next session of a run.
pub(crate) fn ready(folder: &Path, best_effort: bool) -> Result<Next, Failure> {
    let not_a_run = |problem: String| {
        Failure::bad_input(
            format!("{}: {problem}", folder.display()),
            "give the folder of a run of cellpos run",
        )
    };
    let reader = RunReader::open(folder).map_err(Failure::input)?;
    let setup = cellpos_session::recorded::setup(&reader)?;
    let first =
        session_config(&reader).ok_or_else(|| not_a_run("is no run of a script".to_string()))?;
    if first.number != 1 {
        return Err(not_a_run(
            "is a further session of a run: give the folder of that run".to_string(),
        ));
    }
    let meta = reader
        .meta()
        .map_err(|problem| not_a_run(problem.to_string()))?;
    let rig = meta.config.get("rig").and_then(toml::Value::as_table);
    let rig = rig.ok_or_else(|| not_a_run("run.toml names no rig".to_string()))?;
    let text = toml::to_string(rig).map_err(Failure::failed)?;
    let mut file: RigFile =
        crate::toml_file::parse(&text, &folder.join("run.toml").display().to_string())?;

    let Some((_, plan)) = setup.config.reference.script()? else {
        return Err(not_a_run("is no run of a script".to_string()));
    };
    let done = cycles(folder)?;
    let next = done.last().map_or(0, |row| row.cycle + 1);
    let from_s = next
        .checked_sub(1)
        .and_then(|last| plan.cycle(last))
        .map_or(0.0, |last| last.start_s + last.duration_s);
    let over = meta
        .end
        .as_ref()
        .is_some_and(|end| WHOLE.contains(&end.outcome.as_str()));
    let sessions = sessions::of(folder);
    let last = sessions.last().map_or(folder, PathBuf::as_path);
    let last_done = is_done(last);
    // A script without a recorded end may still have a step after its last cycle.
    if over || last_done {
        return Ok(Next::Nothing(nothing_left(done.len(), plan.cycle_count())));
    }
    let ReferenceSpec::Script {
        file: script,
        text,
        waveforms,
        ..
    } = setup.config.reference
    else {
        return Err(not_a_run("is no run of a script".to_string()));
    };
    renew(folder)?;
    let number = sessions.len() as u64 + 1;
    let ran_s = ran_s(&sessions, file.timing.period_us * 1e-6)?;
    go_on_from(&mut file, &done, last);
    // Another session sees other noise, and the same each time that it is repeated.
    file.emulator.seed = file.emulator.seed.wrapping_add(number - 1);
    let clock = if meta.clock == "virtual" {
        ClockKind::Virtual
    } else {
        ClockKind::Real
    };
    Ok(Next::Session(Box::new(Ready {
        prepared: Prepared {
            model: setup.model,
            controller: setup.controller,
        },
        file,
        reference: ReferenceSpec::Script {
            file: script,
            text,
            from_s,
            ran_s: Some(ran_s),
            first_length_um: done
                .iter()
                .map(|row| row.length_start_um)
                .find(|um| um.is_finite()),
            waveforms,
        },
        clock,
        name: meta.name.clone(),
        session: SessionConfig {
            number,
            first_cycle: next,
            gap_s: gap_s(last),
            after: last
                .strip_prefix(folder)
                .ok()
                .map(|path| path.display().to_string()),
            best_effort: best_effort || first.best_effort,
            ..first
        },
        inputs: meta.inputs.clone(),
        runs: PathBuf::new(),
        home: Some((folder.to_owned(), folder.join(SESSIONS))),
    })))
}

/// Why a run has no next session.
fn nothing_left(done: usize, planned: u64) -> String {
    match (done as u64) < planned {
        true => format!(
            "the script's own [stop] ended this run after {done} of {planned} cycles: nothing to resume; for more cycles begin a new run \
             with a later stop"
        ),
        false => "all cycles are done: nothing to resume".to_owned(),
    }
}

/// Outcomes of a script that came to its end.
const WHOLE: [&str; 2] = ["done", "not-kept"];

/// Whether a session's script came to its end.
fn is_done(session: &Path) -> bool {
    RunReader::open(session).ok().is_some_and(|reader| {
        let end = reader.meta().ok().and_then(|meta| meta.end.as_ref());
        end.is_some_and(|end| WHOLE.contains(&end.outcome.as_str()))
    })
}

/// Has the next session look for the bead where it was; an emulated cell is as tired as it was.
fn go_on_from(file: &mut RigFile, done: &[CycleRow], last: &Path) {
    if let Some(cell) = &mut file.emulator.cell {
        let passages = done.iter().filter(|row| row.arm == ArmKind::Cyclic).count();
        cell.passages_before = u32::try_from(passages).unwrap_or(u32::MAX);
    }
    // Where the bead rested last is a better first belief than the rig file's.
    let rested = done.iter().rev().map(|row| row.neutral_um);
    let within = |um: &f64| (file.limits.low_um..=file.limits.high_um).contains(um);
    if let Some(neutral_um) = rested.into_iter().find(within) {
        file.rested_um = Some(neutral_um);
    }
    // Of several beads in view the one that was followed.
    let seen = RunReader::open(last).ok().and_then(|reader| {
        reader
            .last_where(|tick| tick.measured_um.is_finite())
            .ok()
            .flatten()
    });
    file.near_um = seen.map(|tick| tick.measured_um).or(file.near_um);
}

/// From the last write of a session's records to now, s.
fn gap_s(session: &Path) -> Option<f64> {
    let written = std::fs::metadata(session.join(cellpos_record::TICKS_ARROW))
        .and_then(|meta| meta.modified())
        .ok()?;
    written.elapsed().ok().map(|gap| gap.as_secs_f64())
}

/// Running time of the script in some sessions, s: from the first to the last tick on the disk, with waits and pauses, without
/// the approach. What lies between the sessions does not count.
fn ran_s(sessions: &[PathBuf], period_s: f64) -> Result<f64, Failure> {
    let in_script = |row: &TickRecord| {
        [Stage::Running, Stage::Waiting, Stage::Paused].contains(&Stage::from_number(row.stage))
    };
    let mut ticks = 0;
    for session in sessions {
        let reader = RunReader::open(session).map_err(Failure::input)?;
        let Some(last) = reader.last_where(in_script).map_err(Failure::input)? else {
            continue;
        };
        let rows = reader.batches().map_err(Failure::input)?;
        if let Some(first) = rows.flatten().find(in_script) {
            ticks += (last.seq + 1).saturating_sub(first.seq);
        }
    }
    Ok(ticks as f64 * period_s)
}
