//! A whole rig in a box, in real time: the PZT board on a pseudo-terminal, the camera on a Unix socket, the plant between.
#![forbid(unsafe_code)]

mod program;

use clap::Parser;
use std::process::ExitCode;

fn main() -> ExitCode {
    let args = program::Args::parse();
    match program::run(&args) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("firmware-sim: {error}");
            ExitCode::from(error.exit_code())
        }
    }
}
