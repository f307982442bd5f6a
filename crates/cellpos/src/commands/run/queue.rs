//! A queue of cells: catch one, run the script, release it, wait for the next. Each cell has a run folder below the queue's. One
//! table and one page cover all.

mod population;

use super::over::Over;
use super::{Args, fresh, start};
use crate::arguments::span;
use crate::outcome::{CommandResult, Failure, Outcome, print_json_of, print_text};
use cellpos_numeric::units::Seconds;
use cellpos_runtime::life::Refusal;
use cellpos_script::CycleRow;
use cellpos_session::rig_file::ClockKind;
use cellpos_session::{ended::EndKind, signals};
use population::CellRow;
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// How cells follow each other.
#[derive(Debug, clap::Args)]
pub(super) struct QueueArgs {
    /// Run the script on N cells, one after the other; one table and one page over all.
    #[arg(long, value_name = "N", conflicts_with = "resume", value_parser = clap::value_parser!(u64).range(1..=10_000))]
    pub(super) cells: Option<u64>,
    /// Pause between two cells: the flow takes one away and brings the next.
    #[arg(long, default_value = "5s", requires = "cells", value_parser = crate::arguments::positive::<Seconds>)]
    between: Seconds,
    /// End if no cell comes for this long.
    #[arg(long, default_value = "10min", requires = "cells", value_parser = crate::arguments::positive::<Seconds>)]
    patience: Seconds,
}

/// What `--json` prints.
#[derive(Debug, Serialize)]
struct Report<'a> {
    /// The queue's folder.
    folder: String,
    table: String,
    page: String,
    /// Why the queue ended before its last cell; null where it did not.
    ended_early: Option<&'a str>,
    cells: &'a [CellRow],
}

/// Runs the queue.
pub(super) fn run(args: &Args, cells: u64) -> CommandResult {
    // What is wrong with script, rig or model is wrong for every cell.
    let first = fresh(args)?;
    let live = first.clock == ClockKind::Real;
    let folder = folder(&args.run.runs, &first.name)?;
    let mut queue = Queue {
        folder,
        name: first.name,
        rows: Vec::new(),
        cycles: Vec::new(),
    };
    let mut ended_early = None;
    for number in 1..=cells {
        if number > 1 && live {
            pause(span(args.queue.between));
        }
        match queue.cell(args, number, live)? {
            None => {}
            Some(why) => {
                ended_early = Some(why);
                break;
            }
        }
    }
    let report = Report {
        folder: queue.folder.display().to_string(),
        table: queue.folder.join(TABLE).display().to_string(),
        page: queue.folder.join(PAGE).display().to_string(),
        ended_early: ended_early.as_deref(),
        cells: &queue.rows,
    };
    if args.json {
        print_json_of("cells", &report)?;
    } else {
        let early = ended_early
            .as_ref()
            .map_or(String::new(), |why| format!("ended early: {why}\n"));
        print_text(&format!(
            "{}{early}table             {}\npage              {}\n",
            population::text(&queue.rows),
            report.table,
            report.page
        ))?;
    }
    let all = ended_early.is_none() && queue.rows.iter().all(CellRow::is_done);
    Ok(if all { Outcome::Done } else { Outcome::Broken })
}

const TABLE: &str = "cells.csv";
const PAGE: &str = "cells.html";

struct Queue {
    folder: PathBuf,
    name: String,
    rows: Vec<CellRow>,
    cycles: Vec<Vec<CycleRow>>,
}

impl Queue {
    /// One cell, from the search for it to the table; `Some`: why there is no further one.
    fn cell(&mut self, args: &Args, number: u64, live: bool) -> Result<Option<String>, Failure> {
        let asked = Instant::now();
        let mut tries = 0;
        loop {
            if let Some(signal) = signals::stopped_by() {
                return Ok(Some(format!("stopped by {signal}")));
            }
            let over = self.one(args, number, tries)?;
            let missing = over.ended.refusal.is_some_and(Refusal::lacks_a_bead);
            if missing && live && asked.elapsed().as_secs_f64() < args.queue.patience.value() {
                // The folder of a search that found nothing holds nothing that anyone asked for.
                let _ = std::fs::remove_dir_all(&over.folder);
                tries += 1;
                pause(Duration::from_secs(1));
                continue;
            }
            if missing {
                return Ok(Some(format!("cell {number}: {}", over.ended)));
            }
            let stop = match over.ended.kind {
                EndKind::Done | EndKind::ReferenceOver | EndKind::Stopped => None,
                EndKind::Operator if over.outcome != "aborted" => None,
                // One cell that is lost is one row; a rig that fails would fail every further cell.
                EndKind::Safe | EndKind::NotKept => None,
                _ => Some(format!("cell {number}: {}", over.ended)),
            };
            self.add(number, over)?;
            return Ok(stop);
        }
    }

    fn one(&self, args: &Args, number: u64, tries: u64) -> Result<Over, Failure> {
        let mut ready = fresh(args)?;
        ready.name = format!(
            "{}-{number:03}",
            self.name.chars().take(58).collect::<String>()
        );
        ready.runs.clone_from(&self.folder);
        // The emulated rig has another cell each time.
        let seed = &mut ready.file.emulator.seed;
        *seed = seed.wrapping_add(1000 * (number - 1) + tries);
        start(args, ready, false)
    }

    /// Table and page are there after each cell, whatever ends the queue.
    fn add(&mut self, number: u64, over: Over) -> Result<(), Failure> {
        let row = CellRow::new(number, &over);
        tracing::info!("{}", population::text(std::slice::from_ref(&row)));
        self.rows.push(row);
        self.cycles.push(over.cycles);
        let written = |path: &Path, text: &str| {
            cellpos_table::write_atomically(path, text.as_bytes()).map_err(Failure::failed)
        };
        written(&self.folder.join(TABLE), &population::csv(&self.rows))?;
        let page = population::page(&self.name, &self.rows, &self.cycles);
        page.write_with_figures(&self.folder.join(PAGE))
            .map_err(Failure::failed)
    }
}

/// A folder for the queue, as run folders are named.
fn folder(runs: &Path, name: &str) -> Result<PathBuf, Failure> {
    let now = jiff::Timestamp::now().strftime("%Y%m%dT%H%M%SZ");
    std::fs::create_dir_all(runs).map_err(|error| {
        Failure::bad_input(
            format!("{}: {error}", runs.display()),
            "choose another folder with --runs",
        )
    })?;
    for number in 1..1000 {
        let tail = if number == 1 {
            String::new()
        } else {
            format!("-{number}")
        };
        let folder = runs.join(format!("{now}-{name}-cells{tail}"));
        match std::fs::create_dir(&folder) {
            Ok(()) => return Ok(folder),
            Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => {}
            Err(error) => {
                let help = "choose another folder with --runs";
                return Err(Failure::bad_input(
                    format!("{}: {error}", folder.display()),
                    help,
                ));
            }
        }
    }
    Err(Failure::bad_input(
        format!("{}: too many queues in one second", runs.display()),
        "wait a second",
    ))
}

/// Waits, and ends at once when the operator asks for a stop.
fn pause(time: Duration) {
    const LOOK: Duration = Duration::from_millis(50);
    let start = Instant::now();
    while start.elapsed() < time && signals::stopped_by().is_none() {
        std::thread::sleep(LOOK.min(time));
    }
}
