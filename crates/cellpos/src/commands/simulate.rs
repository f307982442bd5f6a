//! `cellpos simulate`: the noise-free response of a model to the commands of a record.

use crate::commands::run::resume::sessions;
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use crate::output;
use cellpos_plant::{Model, SimulateOptions, simulate};
use cellpos_record::{RunReader, SESSIONS};
use cellpos_table::{Mapping, Record};
use std::path::PathBuf;

/// Arguments of `cellpos simulate`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Example:\n  cellpos simulate --model eq6 --input in.csv --out out.csv\n\n\
                        The input needs the columns time_s and pzt_um; the output has time_s, pzt_um and bead_um, the \
                        position just before the row's command takes effect. The bead starts at rest at 0 um."
)]
pub struct Args {
    /// `eq6`, or a model file.
    #[arg(long)]
    model: String,
    /// A record (CSV), or a run folder.
    #[arg(long, value_parser = crate::arguments::run_folder())]
    input: PathBuf,
    /// The record to write.
    #[arg(long)]
    out: PathBuf,
    /// Adds Brownian motion and localisation noise from this seed.
    #[arg(long)]
    seed: Option<u64>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// Reads, simulates, writes.
pub fn run(args: Args) -> CommandResult {
    output::ready([&args.out])?;
    let model = Model::load(&args.model).map_err(Failure::input)?;
    let input = if args.input.is_dir() {
        let sessions = sessions(&args.input).len();
        if sessions > 1 {
            // Each begins with a bead of its own.
            tracing::warn!(
                "{} has {sessions} sessions: the first is simulated; name the folder of another one, below {}",
                args.input.display(),
                args.input.join(SESSIONS).display()
            );
        }
        RunReader::open(&args.input)
            .and_then(|run| run.to_record())
            .map_err(Failure::input)?
    } else {
        Record::read(&args.input, &Mapping::commands_only()).map_err(Failure::input)?
    };
    let options = SimulateOptions {
        seed: args.seed,
        ..SimulateOptions::default()
    };
    let bead_um =
        simulate(&model, &input.pzt_um, input.step_s, &options).map_err(Failure::input)?;
    let mut answer = Record::new(&input.name, input.step_s, input.pzt_um, bead_um);
    answer.start_s = input.start_s;
    answer.write(&args.out).map_err(Failure::failed)?;
    if args.json {
        print_json(&serde_json::json!({
            "out": args.out,
            "rows": answer.len(),
            "rate_hz": answer.rate_hz(),
        }))?;
    } else {
        print_text(&format!("{}: {} rows\n", args.out.display(), answer.len()))?;
    }
    Ok(Outcome::Done)
}
