//! `cellpos paper`: the figures and numbers of Mizoue et al. 2017 from the emulated rig, through frames.

use super::identify::new_run_folder;
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use cellpos_workbench::experiment::paper::measured;
use std::path::PathBuf;

/// Arguments of `cellpos paper`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  cellpos paper --report paper.html")]
pub(crate) struct Args {
    /// Seed of the emulated rig.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Report [default: report.html in a new folder of runs/].
    #[arg(long)]
    report: Option<PathBuf>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// Runs `cellpos paper`.
pub(crate) fn run(args: Args) -> CommandResult {
    crate::output::ready(&args.report)?;
    let found = measured(args.seed)?;
    let path = match &args.report {
        Some(path) => path.clone(),
        None => new_run_folder("paper")?.join("report.html"),
    };
    found
        .report()
        .write_with_figures(&path)
        .map_err(Failure::failed)?;
    if args.json {
        print_json(&found.to_json(&path, args.seed))?;
    } else {
        print_text(&found.text(&path))?;
    }
    Ok(if found.differ() == 0 {
        Outcome::Done
    } else {
        Outcome::Broken
    })
}
