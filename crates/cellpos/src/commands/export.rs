//! `cellpos export`: a run for other programs.

use super::beside;
use crate::arguments::run_folder;
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use crate::output;
use cellpos_numeric::units::Seconds;
use cellpos_record::{Exported, Format, RecordError, Selection, Sessions, export};
use std::num::NonZeroU64;
use std::path::{Path, PathBuf};

/// Arguments of `cellpos export`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  cellpos export runs/20261121T093000Z-track
  cellpos export runs/20261121T093000Z-track --out track.parquet
  cellpos export runs/20261121T093000Z-track --out track.h5      # HDF5
  cellpos export runs/20261121T093000Z-track --out track.mat     # MATLAB
  cellpos export runs/20261121T190000Z-fatigue --out cell.rtdc   # Shape-Out: a cell's runs
  cellpos export runs/20261121T190000Z-fatigue --from 60s --to 120s --every 10 --columns time_s,target_um,bead_um,error_um

Joins the sessions of a resumed run; the column session tells them apart. docs/data.md has columns, units and words. error_um is the
error; do not subtract target_um from bead_um, which is some ms older. Exit code 1: rows of the run are missing.")]
pub(crate) struct Args {
    /// The run's folder.
    #[arg(value_parser = run_folder())]
    run: PathBuf,
    /// Format; default: by the ending of --out, else CSV.
    #[arg(long, value_enum)]
    format: Option<ExportFormat>,
    /// File to write; default: the run's name, next to its folder.
    #[arg(long)]
    out: Option<PathBuf>,
    /// Start time in the run.
    #[arg(long)]
    from: Option<Seconds>,
    /// End time in the run.
    #[arg(long)]
    to: Option<Seconds>,
    /// Columns, in this order.
    #[arg(long, value_delimiter = ',')]
    columns: Option<Vec<String>>,
    /// Keep one of N rows.
    #[arg(long, default_value = "1")]
    every: NonZeroU64,
    /// Only this session.
    #[arg(long)]
    session: Option<u64>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum ExportFormat {
    Csv,
    Parquet,
    Hdf5,
    Mat,
    Rtdc,
}

impl ExportFormat {
    const ALL: [Self; 5] = [Self::Csv, Self::Parquet, Self::Hdf5, Self::Mat, Self::Rtdc];

    fn extension(self) -> &'static str {
        match self {
            Self::Csv => "csv",
            Self::Parquet => "parquet",
            Self::Hdf5 => "h5",
            Self::Mat => "mat",
            Self::Rtdc => "rtdc",
        }
    }

    fn format(self) -> Format {
        match self {
            Self::Csv => Format::Csv,
            Self::Parquet => Format::Parquet,
            Self::Hdf5 => Format::Hdf5,
            Self::Mat => Format::Mat,
            Self::Rtdc => Format::Rtdc,
        }
    }

    /// The format that a file's name asks for.
    fn of(path: &Path) -> Option<Self> {
        let extension = match path.extension()?.to_str()? {
            "hdf5" => "h5",
            extension => extension,
        };
        Self::ALL
            .into_iter()
            .find(|format| format.extension().eq_ignore_ascii_case(extension))
    }
}

/// The format, by option or by name; the two must not contradict each other, and an ending that is no format's is not guessed at.
fn chosen(args: &Args) -> Result<ExportFormat, Failure> {
    let named = args.out.as_deref().and_then(ExportFormat::of);
    match (args.format, named) {
        (Some(asked), Some(named)) if asked != named => Err(Failure::bad_input(
            format!(
                "--format {} and a file that ends in .{}: which of the two?",
                asked.extension(),
                named.extension()
            ),
            "leave --format out, or give the file the name of the format",
        )),
        (Some(format), _) | (None, Some(format)) => Ok(format),
        (None, None) => match args.out.as_deref().and_then(Path::extension) {
            Some(ending) if !is_device(args.out.as_deref()) => Err(Failure::bad_input(
                format!("--out: there is no such format as .{}", ending.display()),
                "end the name in .csv, .parquet, .h5, .mat or .rtdc, or say which it is with --format",
            )),
            _ => Ok(ExportFormat::Csv),
        },
    }
}

fn is_device(path: Option<&Path>) -> bool {
    path.and_then(|path| std::fs::metadata(path).ok())
        .is_some_and(|found| !found.is_file())
}

fn selection(args: &Args) -> Result<Selection, Failure> {
    let from_s = args.from.map_or(f64::NEG_INFINITY, |s| s.value());
    let to_s = args.to.map_or(f64::INFINITY, |s| s.value());
    if from_s > to_s {
        return Err(Failure::bad_input(
            format!("--from {from_s}s is after --to {to_s}s"),
            "times count from the start of the run",
        ));
    }
    let selection = Selection {
        from_s,
        to_s,
        every: args.every,
        columns: args.columns.clone(),
    };
    Ok(selection)
}

/// Writes the file and reports missing rows.
pub(crate) fn run(args: Args) -> CommandResult {
    let format = chosen(&args)?;
    let selection = selection(&args)?;
    let mut sessions = Sessions::of(&args.run).map_err(Failure::input)?;
    if let Some(wanted) = args.session {
        sessions.readers.retain(|(number, _)| *number == wanted);
        if sessions.readers.is_empty() {
            return Err(Failure::bad_input(
                format!("{}: has no session {wanted}", args.run.display()),
                "leave --session out for all sessions",
            ));
        }
    }
    let output = args
        .out
        .unwrap_or_else(|| beside(&args.run, &format!(".{}", format.extension())));
    let output = if output.as_os_str() == "-" {
        PathBuf::from("/dev/stdout")
    } else {
        output
    };
    let unreadable = std::mem::take(&mut sessions.unreadable);
    let count = sessions.readers.len();
    let source = sessions.into_source().map_err(Failure::failed)?;
    selection.columns(&source).map_err(Failure::input)?;
    output::ready([&output])?;
    let done =
        export(&source, &selection, format.format(), &output).map_err(|error| match error {
            RecordError::Nothing { .. } => Failure::input(error),
            error => Failure::failed(error),
        })?;
    tell(&output, &done, count, &unreadable, args.json)
}

fn tell(
    output: &Path,
    done: &Exported,
    sessions: usize,
    unreadable: &[String],
    json: bool,
) -> CommandResult {
    let sum = |of: fn(&cellpos_record::Lost) -> u64| done.lost.iter().map(of).sum::<u64>();
    let missing = sum(|lost| lost.rows);
    let damaged = sum(|lost| lost.damaged_rows);
    let damaged_bytes = sum(|lost| lost.damaged_bytes);
    let cut_off = done.lost.iter().filter(|lost| !lost.finished).count();
    if json {
        print_json(&serde_json::json!({
            "output": output,
            "rows": done.rows,
            "sessions": sessions,
            "rows_missing": missing,
            "rows_damaged": damaged,
            "damaged_bytes": damaged_bytes,
            "torn_bytes": sum(|lost| lost.torn_bytes),
            "finished": cut_off == 0,
            "unreadable": unreadable,
        }))?;
    } else {
        // A pipe gets the export only.
        let say = |text: &str| {
            if is_device(Some(output)) {
                eprint!("{text}");
                Ok(())
            } else {
                print_text(text)
            }
        };
        let of = if sessions > 1 {
            format!(" of {sessions} sessions")
        } else {
            String::new()
        };
        say(&format!("{}: {} rows{of}\n", output.display(), done.rows))?;
        if missing + damaged + damaged_bytes > 0 {
            say(&format!(
                "{missing} rows are missing between others; {damaged} rows are damaged or were never written to the disk; \
                 {damaged_bytes} bytes make no sense\n",
            ))?;
        }
        for folder in unreadable {
            say(&format!("left out: {folder}\n"))?;
        }
        if cut_off > 0 {
            say(
                "the run was cut off (killed, or its disk was full): it reads up to its last flush\n",
            )?;
        }
    }
    let whole = missing + damaged + damaged_bytes == 0 && unreadable.is_empty();
    Ok(if whole {
        Outcome::Done
    } else {
        Outcome::Broken
    })
}
