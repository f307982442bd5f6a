//! `cellpos export`: a run as CSV or Parquet.

use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use cellpos_record::{Format, RunReader, export};
use std::path::PathBuf;

/// Arguments of `cellpos export`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Example:\n  cellpos export runs/20261121T093000Z-track --format csv --out track.csv\n\n\
                  Row k of the CSV: the displacement commanded from time_s on, held until the next row; bead_um is \
                  the position that the camera had delivered just before, empty without a bead."
)]
pub struct Args {
    /// The run's folder.
    run: PathBuf,
    /// What to write.
    #[arg(long, value_enum, default_value = "csv")]
    format: ExportFormat,
    /// The file to write; without it `<run>.csv` or `<run>.parquet` beside the folder.
    #[arg(long)]
    out: Option<PathBuf>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum ExportFormat {
    Csv,
    Parquet,
}

/// Writes the file and says what of the run is missing.
pub fn run(args: Args) -> CommandResult {
    let reader = RunReader::open(&args.run).map_err(Failure::input)?;
    let (format, extension) = match args.format {
        ExportFormat::Csv => (Format::Csv, "csv"),
        ExportFormat::Parquet => (Format::Parquet, "parquet"),
    };
    let output = args.out.unwrap_or_else(|| {
        let mut name = args.run.file_name().unwrap_or("run".as_ref()).to_owned();
        name.push(format!(".{extension}"));
        args.run.with_file_name(name)
    });
    let mut batches = reader.batches().map_err(Failure::failed)?;
    let rows: usize = batches.by_ref().map(|batch| batch.len()).sum();
    let lost = batches.lost();
    export(&reader, format, &output).map_err(Failure::failed)?;
    if args.json {
        print_json(&serde_json::json!({
            "output": output,
            "rows": rows,
            "rows_missing": lost.rows,
            "damaged_bytes": lost.damaged_bytes,
            "torn_bytes": lost.torn_bytes,
            "finished": lost.finished,
        }))?;
    } else {
        print_text(&format!("{}: {rows} rows\n", output.display()))?;
        if lost.rows > 0 || lost.damaged_bytes > 0 {
            print_text(&format!(
                "{} rows are missing in {} gaps ({} damaged bytes)\n",
                lost.rows,
                lost.gaps.len(),
                lost.damaged_bytes
            ))?;
        }
        if !lost.finished {
            print_text("the run was cut off: it reads up to its last flush\n")?;
        }
    }
    Ok(Outcome::Done)
}
