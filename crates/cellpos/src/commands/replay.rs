//! `cellpos replay`: run a recorded run through its controller again and compare to the bit.

use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use crate::setup::{Setup, SetupConfig};
use cellpos_control::ControllerFile;
use cellpos_plant::Model;
use cellpos_record::RunReader;
use cellpos_runtime::replay::{Mismatch, Replay};
use serde::Serialize;
use std::path::PathBuf;

/// Arguments of `cellpos replay`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  cellpos replay runs/20261121T090000Z-track\n
Every recorded measurement goes through the recorded controller again; the commands must come out the same to the last
bit. Exit code 0: they do; 1: they do not, or rows are missing.")]
pub struct Args {
    /// The run folder.
    run: PathBuf,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Serialize)]
struct Report {
    run: String,
    ticks: u64,
    identical: u64,
    missing_rows: u64,
    first_mismatch: Option<Mismatch>,
}

/// Replays.
pub fn run(args: Args) -> CommandResult {
    let reader = RunReader::open(&args.run).map_err(Failure::input)?;
    let setup = setup(&reader)?;
    let mut replay = Replay::new(setup.core()?);
    let mut batches = reader.batches().map_err(Failure::input)?;
    for batch in batches.by_ref() {
        for record in &batch {
            replay.add(record);
        }
    }
    let outcome = replay.outcome();
    let lost = batches.lost();
    let report = Report {
        run: args.run.display().to_string(),
        ticks: outcome.ticks,
        identical: outcome.identical,
        missing_rows: lost.rows,
        first_mismatch: outcome.first_mismatch,
    };
    if args.json {
        print_json(&report)?;
    } else {
        let verdict = match report.first_mismatch {
            None if report.missing_rows == 0 => "every command reproduced to the bit".to_string(),
            None => format!(
                "{} rows are missing; all others reproduced to the bit",
                report.missing_rows
            ),
            Some(m) => format!(
                "differs first at tick {}: {} recorded {:?}, replayed {:?}",
                m.seq, m.column, m.recorded, m.replayed
            ),
        };
        print_text(&format!(
            "{} of {} ticks identical: {verdict}\n",
            report.identical, report.ticks
        ))?;
    }
    let same = report.first_mismatch.is_none() && report.missing_rows == 0 && report.ticks > 0;
    Ok(if same { Outcome::Done } else { Outcome::Broken })
}

/// The loop as the run folder describes it.
pub fn setup(reader: &RunReader) -> Result<Setup, Failure> {
    let meta = reader.meta().map_err(|problem| {
        Failure::bad_input(
            format!(
                "{}: run.toml cannot be used: {problem}",
                reader.folder().display()
            ),
            "a replay needs the configuration in run.toml",
        )
    })?;
    let mut config = meta.config.clone();
    config.remove("rig");
    config.remove("session");
    let name = reader.folder().join("run.toml").display().to_string();
    let text = |table: &toml::Table| toml::to_string(table).map_err(Failure::failed);
    Ok(Setup {
        model: Model::from_toml_str(&text(&meta.model)?, &name).map_err(Failure::input)?,
        controller: ControllerFile::from_toml_str(&text(&meta.controller)?, &name)
            .map_err(Failure::input)?,
        config: crate::toml_file::parse::<SetupConfig>(&text(&config)?, &name)?,
    })
}
