//! The `cellpos` program; everything it does is in the library of this crate.
#![forbid(unsafe_code)]


            "signals cannot be caught ({error}): Ctrl-C ends the program, and the board parks by its own watchdog"
        (false, 0) => LevelFilter::WARN,
        (false, 1) => LevelFilter::INFO,
        (false, _) => LevelFilter::DEBUG,
        (true, _) => LevelFilter::ERROR,
        );
        .any(|word| word == "--json");
        .find_map(|name| std::env::var(name).ok()?.parse().ok());
        .init();
        .into_iter()
        .iter()
        .take_while(|word| *word != "--")
        .with(lines.with_filter(log_filter(cli.verbose, cli.quiet)))
        .with_ansi(std::io::IsTerminal::is_terminal(&std::io::stderr()))
        .with_target(false);
        .with_writer(|| cellpos_terminal::Log)
        .without_time()
        Err(error) => return outcome::exit_arguments(&error, json),
        Ok(cli) => cli,
        Ok(matches) => matches,
        command: matches.subcommand_name().unwrap_or("cellpos").to_owned(),
        eprintln!(
        force: cli.force,
        quiet: cli.quiet,
    #[arg(long, global = true)]
    #[arg(long, global = true, action = clap::ArgAction::Count, conflicts_with = "quiet")]
    #[command(subcommand)]
    /// Log errors alone, and show no progress.
    /// Log more on standard error; twice: more still.
    /// Write over files that are there already.
    Cli::command()
    after_help = "RUST_LOG (else CELLPOS_LOG) sets what is logged, for example RUST_LOG=cellpos_rig=debug."
    arg_required_else_help = true,
    cellpos::main()
    cellpos_terminal::panics_do_not_wait();
    command: commands::Command,
    force: bool,
    if let Err(error) = signals::listen() {
    let cli = match Cli::from_arg_matches(&matches) {
    let json = words
    let level = match (quiet, verbose) {
    let lines = tracing_subscriber::fmt::layer()
    let matches = match command_line().try_get_matches_from(words) {
    let said = ["RUST_LOG", "CELLPOS_LOG"]
    let words = arguments::joined(std::env::args_os());
    name = "cellpos",
    outcome::exit(cli.command.run(), json)
    output::configure(output::Settings {
    quiet: bool,
    said.unwrap_or_else(|| Targets::new().with_default(level))
    tracing_subscriber::registry()
    verbose: u8,
    version = provenance::VERSION_AND_COMMIT,
    }
    });
    };
#[command(
#[derive(Debug, Parser)]
)]
/// Closed-loop positioning of a cell or bead in a PDMS microchannel at 1 kHz.
/// The program's arguments, for completions and manual pages too.
/// What is logged: as the environment says, else as the options do.
fn command_line() -> clap::Command {
fn log_filter(verbose: u8, quiet: bool) -> Targets {
fn main() -> ExitCode {
fn main() -> std::process::ExitCode {
mod arguments;
mod clips;
mod commands;
mod kept;
mod keyboard;
mod keys;
mod notify;
mod outcome;
mod output;
mod view_args;
struct Cli {
use cellpos_session::{cyclic, provenance, recording, rig_file, setup, signals, toml_file};
use clap::{CommandFactory, FromArgMatches, Parser};
use std::process::ExitCode;
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::prelude::*;
}
}
