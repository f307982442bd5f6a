//! How a command ends: exit codes, JSON on standard output, errors on standard error.

use crate::arguments::about_a_whole_number;
use cellpos_live::terminal::{Colours, clean};
pub use cellpos_session::Failure;
use serde::Serialize;
use std::borrow::Cow;
use std::process::ExitCode;
use std::time::Duration;

/// Result of a command that ran to its end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// Done: exit code 0.
    Done,
    /// It ran, and limits are broken or the run failed: exit code 1. The command has printed why.
    Broken,
}

/// The result of every command.
pub type CommandResult = Result<Outcome, Failure>;

/// Version of the JSON objects: it rises when a key changes its meaning or goes.
pub(crate) const JSON_VERSION: u32 = 1;

/// A JSON object with the name of its schema (docs/schemas) and its version in front.
#[derive(Serialize)]
struct Object<'a, T: Serialize> {
    schema: String,
    version: u32,
    #[serde(flatten)]
    value: &'a T,
}

/// Prints `value` as the one JSON object on standard output.
pub(crate) fn print_json(value: &impl Serialize) -> Result<(), Failure> {
    print_object(&crate::output::settings().command, value)
}

/// Prints a value as JSON under its schema, for a command with results of two kinds.
pub(crate) fn print_json_of(schema: &str, value: &impl Serialize) -> Result<(), Failure> {
    print_object(schema, value)
}

fn print_object(name: &str, value: &impl Serialize) -> Result<(), Failure> {
    let object = Object {
        schema: format!("cellpos.{name}"),
        version: JSON_VERSION,
        value,
    };
    let text = serde_json::to_string_pretty(&object).map_err(Failure::failed)?;
    print(&format!("{text}\n"))
}

/// Prints text on standard output; a closed pipe (`| head`) is no error. On a terminal people read, and units are as people write
/// them; in a pipe or a file they are as programs write them.
pub(crate) fn print_text(text: &str) -> Result<(), Failure> {
    print(&for_people_at(&std::io::stdout(), text))
}

/// A text as it is written to a stream: on a terminal for people, else for programs.
fn for_people_at<'a>(stream: &impl std::io::IsTerminal, text: &'a str) -> Cow<'a, str> {
    match stream.is_terminal() && reads_utf8() {
        true => Cow::Owned(cellpos_report::typeset(text)),
        false => Cow::Borrowed(text),
    }
}

/// Text on standard error is set for people, if they read it.
pub(crate) fn set_for_people() {
    if std::io::IsTerminal::is_terminal(&std::io::stderr()) && reads_utf8() {
        cellpos_live::terminal::typeset_with(cellpos_report::typeset);
    }
}

/// Prints a line on standard error, for a command that holds no rig.
pub(crate) fn print_err(line: &str) {
    eprintln!("{}", cellpos_live::terminal::for_people(line));
}

/// Whether the terminal's locale has letters beyond ASCII.
fn reads_utf8() -> bool {
    let set = |name| std::env::var(name).ok().filter(|value| !value.is_empty());
    let locale = ["LC_ALL", "LC_CTYPE", "LANG"].into_iter().find_map(set);
    locale.is_some_and(|locale| {
        let locale = locale.to_ascii_lowercase();
        locale.contains("utf-8") || locale.contains("utf8")
    })
}

fn print(text: &str) -> Result<(), Failure> {
    use std::io::Write;
    // The summary comes after the messages of the run.
    cellpos_live::terminal::stderr().flush(PATIENCE);
    match std::io::stdout().write_all(clean(text, Colours::Kept).as_bytes()) {
        Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => Err(Failure::Failed(
            miette::miette!("standard output: cannot be written: {error}"),
        )),
        _ => Ok(()),
    }
}

/// How long the last words of a run may take to reach the terminal.
const PATIENCE: Duration = Duration::from_millis(300);

/// What `--json` prints in place of a result.
#[derive(Debug, Serialize)]
struct ErrorObject {
    error: ErrorText,
}

#[derive(Debug, Serialize)]
struct ErrorText {
    /// `bad-input` (exit code 2) or `failed` (exit code 1).
    kind: &'static str,
    message: String,
    /// What is behind it, outermost first.
    causes: Vec<String>,
    help: Option<String>,
}

/// What is behind an error and not said by it already, outermost first.
fn causes(report: &miette::Report) -> Vec<String> {
    let mut said = report.to_string();
    let mut causes = Vec::new();
    for cause in report.chain().skip(1).map(ToString::to_string) {
        if !said.contains(&cause) {
            said.push_str(&cause);
            causes.push(cause);
        }
    }
    causes
}

/// The error as it is shown: without a tail of causes that it has said itself.
fn told_once(report: miette::Report) -> miette::Report {
    let repeats = report.chain().len() > 1 && causes(&report).is_empty();
    if !repeats || report.source_code().is_some() {
        return report;
    }
    let help = report.help().map(|help| help.to_string());
    match help {
        Some(help) => miette::miette!(help = help, "{report}"),
        None => miette::miette!("{report}"),
    }
}

fn error_object(kind: &'static str, report: &miette::Report) -> ErrorObject {
    ErrorObject {
        error: ErrorText {
            kind,
            message: report.to_string(),
            causes: causes(report),
            help: report.help().map(|help| help.to_string()),
        },
    }
}

/// Prints the error, if any, and gives the exit code.
pub(crate) fn exit(result: CommandResult, json: bool) -> ExitCode {
    let (code, kind, report) = match result {
        Ok(Outcome::Done) => return ExitCode::SUCCESS,
        Ok(Outcome::Broken) => return ExitCode::from(1),
        Err(Failure::Failed(report)) => (1, "failed", report),
        Err(Failure::BadInput(report)) => (2, "bad-input", report),
    };
    let report = told_once(report);
    cellpos_live::terminal::stderr().flush(PATIENCE);
    // Files are quoted in it: nothing in them gives orders to the terminal.
    print_err(&clean(&format!("{report:?}"), Colours::Kept));
    if json {
        // Nobody reads a message about a closed standard output.
        let _ = print_object("error", &error_object(kind, &report));
    }
    ExitCode::from(code)
}

/// An error about a whole number, without the words of the language that the program is written in.
fn number_in_words(error: &clap::Error) -> Option<clap::Error> {
    use clap::error::{ContextKind, ErrorKind};
    use std::error::Error;
    let part = |kind| error.get(kind).map(ToString::to_string);
    let value = part(ContextKind::InvalidValue)?;
    let wrong = about_a_whole_number(error.source()?, &value)?;
    let of = part(ContextKind::InvalidArg)?;
    Some(clap::Error::raw(
        ErrorKind::ValueValidation,
        format!(
            "invalid value '{value}' for '{of}': {wrong}\n\nFor more information, try '--help'.\n"
        ),
    ))
}

/// Prints help, version or what is wrong with the arguments, in colours where clap would use them.
fn print_arguments(error: &clap::Error) {
    use std::io::IsTerminal;
    let seen = match error.use_stderr() {
        true => std::io::stderr().is_terminal(),
        false => std::io::stdout().is_terminal(),
    };
    if !seen || !reads_utf8() {
        let _ = error.print();
        return;
    }
    let plain = std::env::var_os("NO_COLOR").is_some_and(|value| !value.is_empty());
    let styled = error.render();
    let text = match plain {
        true => styled.to_string(),
        false => styled.ansi().to_string(),
    };
    let text = cellpos_report::typeset(&text);
    match error.use_stderr() {
        true => eprint!("{text}"),
        false => {
            let _ = print(&text);
        }
    }
}

/// Says what is wrong with the arguments, or shows the help or version that they ask for.
pub(crate) fn exit_arguments(error: &clap::Error, json: bool) -> ExitCode {
    let in_words = number_in_words(error);
    let error = in_words.as_ref().unwrap_or(error);
    print_arguments(error);
    let surplus = error
        .get(clap::error::ContextKind::InvalidArg)
        .map(ToString::to_string)
        .filter(|word| {
            std::path::Path::new(word)
                .join(cellpos_record::RUN_TOML)
                .exists()
        });
    if let Some(run) = surplus {
        eprintln!(
            "\n  help: {run} is a second run, and this command takes one (did a glob match two?): name one, or write latest-NAME \
             for the newest of that name"
        );
    }
    let code = u8::try_from(error.exit_code()).unwrap_or(2);
    if json && error.use_stderr() {
        let text = error.to_string();
        let mut lines = text.lines().map(str::trim).filter(|line| !line.is_empty());
        let object = ErrorObject {
            error: ErrorText {
                kind: "bad-input",
                message: lines
                    .next()
                    .unwrap_or("")
                    .trim_start_matches("error: ")
                    .to_owned(),
                causes: Vec::new(),
                help: Some(lines.collect::<Vec<_>>().join("\n")).filter(|help| !help.is_empty()),
            },
        };
        let _ = print_object("error", &object);
    }
    ExitCode::from(code)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, thiserror::Error)]
    #[error("{said}")]
    struct Outer {
        said: &'static str,
        #[source]
        behind: std::io::Error,
    }

    #[test]
    fn a_cause_that_its_error_has_said_is_not_said_again() {
        let shown = |said| {
            let behind = std::io::Error::other("Permission denied");
            let report = told_once(miette::Report::from_err(Outer { said, behind }));
            (format!("{report:?}"), causes(&report))
        };
        let (text, behind) = shown("cannot write page.html: Permission denied");
        assert_eq!(text.matches("Permission denied").count(), 1, "{text}");
        assert!(behind.is_empty());
        let (text, behind) = shown("cannot write page.html");
        assert_eq!(text.matches("Permission denied").count(), 1, "{text}");
        assert_eq!(behind, ["Permission denied"]);
    }
}
