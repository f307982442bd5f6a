//! How a command ends: exit codes, JSON on standard output, errors on standard error.

use serde::Serialize;
use std::process::ExitCode;

/// What a command that ran to its end has to say.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// Done: exit code 0.
    Done,
    /// It ran, and limits are broken or the run failed: exit code 1. The command has printed why.
    Broken,
}

/// Why a command could not do its work.
#[derive(Debug)]
pub enum Failure {
    /// The user can put it right: a file, key, value or argument. Exit code 2.
    BadInput(miette::Report),
    /// Something failed on the way: a device, a full disk, the loop. Exit code 1.
    Failed(miette::Report),
}

/// The result of every command.
pub type CommandResult = Result<Outcome, Failure>;

impl Failure {
    /// Bad input, with a help line that says what would be right.
    pub fn bad_input(error: impl std::fmt::Display, help: impl std::fmt::Display) -> Self {
        Self::BadInput(miette::miette!(help = help.to_string(), "{error}"))
    }

    /// A failure on the way, in the words of its error and of the errors behind it.
    pub fn failed(error: impl std::error::Error + Send + Sync + 'static) -> Self {
        Self::Failed(miette::Report::from_err(error))
    }

    /// In a line.
    pub fn text(&self) -> String {
        match self {
            Self::BadInput(report) | Self::Failed(report) => report.to_string(),
        }
    }

    /// Bad input, in the words of a library's error.
    pub fn input(error: impl std::error::Error + Send + Sync + 'static) -> Self {
        Self::BadInput(miette::Report::from_err(error))
    }
}

/// Prints `value` as the one JSON object on standard output.
pub fn print_json(value: &impl Serialize) -> Result<(), Failure> {
    let text = serde_json::to_string_pretty(value).map_err(Failure::failed)?;
    print_text(&format!("{text}\n"))
}

/// Prints text on standard output; a closed pipe (`| head`) is no error.
pub fn print_text(text: &str) -> Result<(), Failure> {
    use std::io::Write;
    match std::io::stdout().write_all(text.as_bytes()) {
        Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => Err(Failure::failed(error)),
        _ => Ok(()),
    }
}

/// Prints the error, if any, and gives the exit code.
pub fn exit(result: CommandResult) -> ExitCode {
    match result {
        Ok(Outcome::Done) => ExitCode::SUCCESS,
        Ok(Outcome::Broken) => ExitCode::from(1),
        Err(Failure::Failed(report)) => {
            eprintln!("{report:?}");
            ExitCode::from(1)
        }
        Err(Failure::BadInput(report)) => {
            eprintln!("{report:?}");
            ExitCode::from(2)
        }
    }
}
