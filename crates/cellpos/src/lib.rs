//! The commands of the `cellpos` program: arguments in, calls, results out.
//!
//! [`main`] is the program; [`run`] is one command of it within another process, which is how tests call commands.
//!
//! Exit codes: 0 done, 1 failed or limits broken, 2 bad input. With `--json` standard output carries one JSON object
//! and nothing else (an error is one too); progress, warnings and errors for people go to standard error.
//!
//! ```
//! use cellpos::Outcome;
//! // Design a controller for the paper's plant, as `cellpos design --model eq6 --delay 2.5ms` does.
//! let done = cellpos::run(["cellpos", "--quiet", "design", "--model", "eq6", "--delay", "2.5ms"]);
//! assert!(matches!(done, Ok(Outcome::Done)));
//! ```
//!
//! The crates below this one, from a frame to a voltage: `cellpos-rig` (traits of devices), `cellpos-drivers` and
//! `cellpos-emulator` (devices), `cellpos-vision` (frame to position), `cellpos-control` (estimator and laws),
//! `cellpos-runtime` (the tick and its threads), `cellpos-session` (from rig file to finished run), `cellpos-record` (run
//! folders). Off line: `cellpos-ident` and `cellpos-reconcile` (from records to models), `cellpos-plant` (the model).
#![forbid(unsafe_code)]

mod arguments;
mod checked;
mod clips;
mod commands;
mod kept;
mod keyboard;
mod keys;
mod loop_args;
mod notify;
mod outcome;
mod output;
mod view_args;

use cellpos_session::{cyclic, provenance, recording, rig_file, setup, signals, toml_file};
use clap::{CommandFactory, FromArgMatches, Parser};
use std::ffi::OsString;
use std::process::ExitCode;
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::prelude::*;

pub use outcome::{CommandResult, Failure, Outcome};

/// Heading of the options that every command has; they come last.
const EVERYWHERE: &str = "Options of every command";
const LAST: usize = 1000;

/// Closed-loop positioning of a cell or bead in a PDMS microchannel at 1 kHz.
#[derive(Debug, Parser)]
#[command(
    name = "cellpos",
    version = provenance::VERSION_AND_COMMIT,
    arg_required_else_help = true,
    after_help = "RUST_LOG or CELLPOS_LOG selects logs, for example RUST_LOG=cellpos_rig=debug."
)]
struct Cli {
    /// Log more on standard error; twice: even more.
    #[arg(long, global = true, action = clap::ArgAction::Count, conflicts_with = "quiet", help_heading = EVERYWHERE, display_order = LAST)]
    verbose: u8,
    /// Log errors only, without progress.
    #[arg(long, global = true, help_heading = EVERYWHERE, display_order = LAST)]
    quiet: bool,
    /// Overwrite existing files.
    #[arg(long, global = true, help_heading = EVERYWHERE, display_order = LAST)]
    force: bool,
    #[command(subcommand)]
    command: commands::Command,
}

/// What is logged: as the environment says, else as the options do.
fn log_filter(verbose: u8, quiet: bool) -> Targets {
    let said = ["RUST_LOG", "CELLPOS_LOG"]
        .into_iter()
        .find_map(|name| std::env::var(name).ok()?.parse().ok());
    let level = match (quiet, verbose) {
        (true, _) => LevelFilter::ERROR,
        (false, 0) => LevelFilter::WARN,
        (false, 1) => LevelFilter::INFO,
        (false, _) => LevelFilter::DEBUG,
    };
    said.unwrap_or_else(|| Targets::new().with_default(level))
}

/// The program's arguments, for completions and manual pages too.
fn command_line() -> clap::Command {
    let command = Cli::command();
    let groups = commands::groups(&command);
    // The groups take the place of clap's one long list.
    command.help_template(format!(
        "{{about-with-newline}}\n{{usage-heading}} {{usage}}\n\n{groups}\nOptions of every command:\n{{options}}{{after-help}}"
    ))
}

/// The parsed command line, with the name of its command.
fn parse(words: Vec<OsString>) -> Result<(Cli, String), clap::Error> {
    let matches = command_line().try_get_matches_from(words)?;
    let name = matches.subcommand_name().unwrap_or("cellpos").to_owned();
    Ok((Cli::from_arg_matches(&matches)?, name))
}

/// Runs one command line, the program's name first, and returns how it ended. Results go to standard output as in the
/// program; errors are returned, not printed. It catches no signals and sets up no log.
///
/// # Errors
/// [`Failure::BadInput`] for arguments, files and values that cannot be used, [`Failure::Failed`] for work that failed.
///
/// ```
/// use cellpos::{Failure, Outcome};
/// assert!(matches!(cellpos::run(["cellpos", "simulate"]), Err(Failure::BadInput(_))));
/// let checked = cellpos::run(["cellpos", "--quiet", "check", "../../examples/scripts/staircase.toml"]);
/// assert!(matches!(checked, Ok(Outcome::Done)));
/// ```
pub fn run(words: impl IntoIterator<Item = impl Into<OsString>>) -> CommandResult {
    let words = arguments::joined(words.into_iter().map(Into::into));
    let (cli, name) = parse(words).map_err(Failure::input)?;
    execute(cli, name)
}

fn execute(cli: Cli, command: String) -> CommandResult {
    output::configure(output::Settings {
        command,
        force: cli.force,
        quiet: cli.quiet,
    });
    cli.command.run()
}

/// The program: the process's own arguments, signals, log and exit code.
pub fn main() -> ExitCode {
    cellpos_live::terminal::panics_do_not_wait();
    outcome::set_for_people();
    if let Err(error) = signals::listen() {
        eprintln!(
            "signals cannot be caught ({error}): Ctrl-C ends the program at once, and the board's watchdog parks the PZT"
        );
    }
    let words = arguments::joined(std::env::args_os());
    let json = words
        .iter()
        .take_while(|word| *word != "--")
        .any(|word| word == "--json");
    let (cli, name) = match parse(words) {
        Ok(parsed) => parsed,
        Err(error) => return outcome::exit_arguments(&error, json),
    };
    let lines = tracing_subscriber::fmt::layer()
        .with_writer(|| cellpos_live::terminal::Log)
        .with_ansi(std::io::IsTerminal::is_terminal(&std::io::stderr()))
        .without_time()
        .with_target(false);
    tracing_subscriber::registry()
        .with(lines.with_filter(log_filter(cli.verbose, cli.quiet)))
        .init();
    outcome::exit(execute(cli, name), json)
}
