//! `cellpos replay`: run a recorded run through its controller again and compare to the bit.

use crate::arguments::run_folder;
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use cellpos_record::{RunReader, Sessions};
use cellpos_runtime::replay::{Gap, Mismatch, Replay};
use cellpos_session::{provenance, recorded};
use serde::Serialize;
use std::path::PathBuf;

/// Arguments of `cellpos replay`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  cellpos replay runs/20261121T090000Z-track\n
Puts every recorded measurement through the recorded controller again and compares the commands. Exit code 0: equal to the last bit;
1: different, or rows are missing. The result counts rows that cannot be replayed: missing, damaged, behind a gap, after a kill.")]
pub(crate) struct Args {
    /// The run folder.
    #[arg(value_parser = run_folder())]
    run: PathBuf,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// How the replay of a session went.
#[derive(Debug, Serialize)]
struct SessionReport {
    session: u64,
    ticks: u64,
    /// Those before the first gap: behind it the state of the loop is not known.
    replayed: u64,
    identical: u64,
    missing_rows: u64,
    damaged_rows: u64,
    /// Rows of the run that are not in the record, as run.toml says, besides those that are missing or damaged in between.
    lost_rows: u64,
    /// Whether the record ends where the run did; it does not if the run was killed or still runs.
    complete: bool,
    /// Bytes of a batch that is cut off or damaged beyond being rows.
    unreadable_bytes: u64,
    /// The version that recorded it, if different.
    recorded_by: Option<String>,
    ended_at_gap: Option<Gap>,
    first_mismatch: Option<Mismatch>,
}

#[derive(Debug, Serialize)]
struct Report {
    run: String,
    ticks: u64,
    replayed: u64,
    identical: u64,
    missing_rows: u64,
    complete: bool,
    first_mismatch: Option<Mismatch>,
    sessions: Vec<SessionReport>,
    unreadable: Vec<String>,
}

/// Replays.
pub(crate) fn run(args: Args) -> CommandResult {
    let found = Sessions::of(&args.run).map_err(Failure::input)?;
    let sessions = found
        .readers
        .iter()
        .map(|(number, reader)| session(*number, reader))
        .collect::<Result<Vec<_>, _>>()?;
    let sum = |of: fn(&SessionReport) -> u64| sessions.iter().map(of).sum();
    let report = Report {
        run: args.run.display().to_string(),
        ticks: sum(|s| s.ticks),
        replayed: sum(|s| s.replayed),
        identical: sum(|s| s.identical),
        missing_rows: sum(|s| s.missing_rows + s.damaged_rows + s.lost_rows),
        complete: found.unreadable.is_empty() && sessions.iter().all(|s| s.complete),
        first_mismatch: sessions.iter().find_map(|s| s.first_mismatch),
        sessions,
        unreadable: found.unreadable,
    };
    if args.json {
        print_json(&report)?;
    } else {
        print_text(&text(&report))?;
    }
    let same = report.identical == report.ticks
        && report.missing_rows == 0
        && report.ticks > 0
        && report.unreadable.is_empty();
    Ok(if same { Outcome::Done } else { Outcome::Broken })
}

fn session(number: u64, reader: &RunReader) -> Result<SessionReport, Failure> {
    let core = recorded::setup(reader)?.core()?;
    same_law(reader, core.controller().columns())?;
    let mut replay = Replay::new(core);
    let mut batches = reader.batches().map_err(Failure::input)?;
    for record in batches.by_ref().flatten() {
        replay.add(&record);
    }
    let outcome = replay.outcome();
    let lost = batches.lost();
    let known = lost.rows + lost.damaged_rows;
    let meta = reader.meta().ok();
    let end = meta.and_then(|meta| meta.end.as_ref());
    Ok(SessionReport {
        session: number,
        ticks: outcome.ticks,
        replayed: outcome.replayed,
        identical: outcome.identical,
        missing_rows: lost.rows,
        damaged_rows: lost.damaged_rows,
        lost_rows: end.map_or(0, |end| end.rows_lost).saturating_sub(known),
        complete: lost.finished && lost.read_error.is_none(),
        unreadable_bytes: lost.torn_bytes + lost.damaged_bytes,
        recorded_by: meta
            .and_then(|meta| meta.versions.get("cellpos").cloned())
            .filter(|version| version != provenance::VERSION),
        ended_at_gap: outcome.gap,
        first_mismatch: outcome.first_mismatch,
    })
}

/// A replay through another control law than the recorded one would say nothing of either.
fn same_law(reader: &RunReader, columns: &[&'static str]) -> Result<(), Failure> {
    let recorded = reader.law_columns();
    // A record without such columns has nothing to compare.
    if recorded.is_empty() || recorded.iter().eq(columns) {
        return Ok(());
    }
    let named = |names: &[&str]| match names {
        [] => "none of its own".to_string(),
        names => names.join(", "),
    };
    let recorded: Vec<&str> = recorded.iter().map(String::as_str).collect();
    Err(Failure::bad_input(
        format!(
            "{}: its control law has other columns ({}) than the law in run.toml ({})",
            reader.folder().display(),
            named(&recorded),
            named(columns)
        ),
        "it is the law of another program: let that program replay it (cellpos_runtime::replay)",
    ))
}

/// Rows of a session that were not replayed, besides those behind a gap.
fn left_out(s: &SessionReport) -> Vec<String> {
    let mut lines = Vec::new();
    if s.lost_rows > 0 {
        lines.push(format!(
            "not replayed: {} rows that were lost in the run and are not in the record",
            s.lost_rows
        ));
    }
    if s.damaged_rows > 0 && s.ended_at_gap.is_none() {
        lines.push(format!("not replayed: {} damaged rows", s.damaged_rows));
    }
    if !s.complete {
        lines.push(format!(
            "not replayed: anything after the last row; the record has no end ({} unreadable bytes): the run was killed, its disk was full, or it is still running",
            s.unreadable_bytes
        ));
    } else if s.unreadable_bytes > 0 {
        lines.push(format!(
            "not replayed: {} bytes that make no rows",
            s.unreadable_bytes
        ));
    }
    if let Some(version) = &s.recorded_by {
        lines.push(format!(
            "recorded by cellpos {version}, replayed by another version"
        ));
    }
    lines
}

fn text(report: &Report) -> String {
    let mut out = String::new();
    for s in &report.sessions {
        let verdict = match (s.first_mismatch, s.ended_at_gap) {
            (Some(m), _) => format!(
                "first difference at tick {}: {} recorded {:?}, replayed {:?}",
                m.seq, m.column, m.recorded, m.replayed
            ),
            (None, None) if s.complete && s.lost_rows + s.damaged_rows == 0 => {
                "every command reproduced to the bit".to_string()
            }
            (None, None) => "every command that the record has reproduced to the bit".to_string(),
            (None, Some(gap)) => format!(
                "all that were replayed; the replay ended at tick {}, which is missing: {} ticks after that gap ({} rows missing, {} damaged) were not replayed, because the state of the loop is not known there",
                gap.from_seq,
                s.ticks - s.replayed,
                s.missing_rows,
                s.damaged_rows
            ),
        };
        if report.sessions.len() > 1 {
            out.push_str(&format!("session {}: ", s.session));
        }
        out.push_str(&format!(
            "{} of {} ticks identical: {verdict}\n",
            s.identical, s.ticks
        ));
        out.extend(left_out(s).iter().map(|line| format!("{line}\n")));
    }
    for folder in &report.unreadable {
        out.push_str(&format!("not replayed: {folder}\n"));
    }
    out
}
