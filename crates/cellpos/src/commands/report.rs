//! `cellpos report`: pages of runs.

use crate::arguments::run_folder;
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_json_of, print_text};
use crate::output;
use cellpos_workbench::run_report::{self, Written};
use serde::Serialize;
use std::path::PathBuf;

/// Arguments of `cellpos report`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  cellpos report runs/20261121T190000Z-fatigue
  cellpos report runs/*-cell-* --out study.html

Writes report.html into the run folder, and report-figures/ with every figure as SVG, PDF and CSV, and their captions. It joins the
sessions of a resumed run and shows the gaps. Several runs are compared on one page.")]
pub(crate) struct Args {
    /// Run folder; `latest`, or `latest-NAME`: the newest in runs/. Several: they are compared.
    #[arg(value_parser = run_folder(), required = true, value_name = "RUN")]
    runs: Vec<PathBuf>,
    /// Page to write; default: report.html in the run folder, comparison.html here for several runs.
    #[arg(long)]
    out: Option<PathBuf>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// Writes the page.
pub(crate) fn run(args: Args) -> CommandResult {
    output::ready(&args.out)?;
    let out = args.out.as_deref();
    match args.runs.as_slice() {
        [run] => say(&run_report::one(run, out)?, args.json, print_json),
        runs => say(&run_report::compared(runs, out)?, args.json, |written| {
            print_json_of("comparison", written)
        }),
    }
}

/// Prints the path of the page, or its figures as JSON.
fn say<T: Serialize>(
    written: &Written<T>,
    as_json: bool,
    print_json: impl Fn(&Written<T>) -> Result<(), Failure>,
) -> CommandResult {
    match as_json {
        true => print_json(written)?,
        false => print_text(&format!("{}\n", written.out.display()))?,
    }
    Ok(Outcome::Done)
}
