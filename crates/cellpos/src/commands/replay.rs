//! `cellpos replay`: run a recorded run through its controller again and compare to the bit.

use crate::arguments::run_folder;
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use cellpos_record::{RunReader, Sessions};
use cellpos_runtime::replay::{Gap, Mismatch, Replay};
use cellpos_session::recorded;
use serde::Serialize;
use std::path::PathBuf;

/// Arguments of `cellpos replay`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  cellpos replay runs/20261121T090000Z-track\n
Every recorded measurement of every session goes through the recorded controller again; the commands must come out the
same to the last bit. Exit code 0: all do; 1: one does not, or rows are missing and those behind the gap cannot be replayed.")]
pub struct Args {
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
    first_mismatch: Option<Mismatch>,
    sessions: Vec<SessionReport>,
    unreadable: Vec<String>,
}

/// Replays.
pub fn run(args: Args) -> CommandResult {
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
        missing_rows: sum(|s| s.missing_rows + s.damaged_rows),
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
    let mut replay = Replay::new(recorded::setup(reader)?.core()?);
    let mut batches = reader.batches().map_err(Failure::input)?;
    for record in batches.by_ref().flatten() {
        replay.add(&record);
    }
    let outcome = replay.outcome();
    let lost = batches.lost();
    Ok(SessionReport {
        session: number,
        ticks: outcome.ticks,
        replayed: outcome.replayed,
        identical: outcome.identical,
        missing_rows: lost.rows,
        damaged_rows: lost.damaged_rows,
        ended_at_gap: outcome.gap,
        first_mismatch: outcome.first_mismatch,
    })
}

fn text(report: &Report) -> String {
    let mut out = String::new();
    for s in &report.sessions {
        let verdict = match (s.first_mismatch, s.ended_at_gap) {
            (Some(m), _) => format!(
                "differs first at tick {}: {} recorded {:?}, replayed {:?}",
                m.seq, m.column, m.recorded, m.replayed
            ),
            (None, None) => "every command reproduced to the bit".to_string(),
            (None, Some(gap)) => format!(
                "all that were replayed; the replay ended at tick {}, which is missing: {} ticks stand behind that gap ({} \
                 rows missing, {} damaged), where the state of the loop is not known, and were not replayed",
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
    }
    for folder in &report.unreadable {
        out.push_str(&format!("not replayed: {folder}\n"));
    }
    out
}
