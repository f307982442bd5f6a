//! The `cellpos` program: arguments in, calls, results out.
//!
//! Exit codes: 0 done, 1 failed or limits broken, 2 bad input. With `--json` standard output carries one JSON object
//! and nothing else; progress, warnings and errors go to standard error.
#![forbid(unsafe_code)]

mod commands;
mod cyclic;
mod outcome;
mod recording;
mod rig_file;
mod session;
mod setup;
mod toml_file;

use clap::Parser;
use std::process::ExitCode;

/// Closed-loop positioning of a cell or bead in a PDMS microchannel at 1 kHz.
#[derive(Debug, Parser)]
#[command(name = "cellpos", version, arg_required_else_help = true)]
struct Cli {
    #[command(subcommand)]
    command: commands::Command,
}

fn main() -> ExitCode {
    tracing_subscriber::fmt()
        .with_writer(std::io::stderr)
        .with_ansi(std::io::IsTerminal::is_terminal(&std::io::stderr()))
        .without_time()
        .with_env_filter(
            tracing_subscriber::EnvFilter::try_from_env("CELLPOS_LOG")
                .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("warn")),
        )
        .with_target(false)
        .init();
    // clap itself leaves with exit code 2 on arguments that it cannot read.
    let cli = Cli::parse();
    outcome::exit(cli.command.run())
}
