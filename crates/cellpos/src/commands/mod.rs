//! One module a command: `Args` (read by clap), `run(args)` (calls the libraries, prints the result).

pub(crate) mod background;
pub(crate) mod board;
pub(crate) mod bundle;
pub(crate) mod calibrate;
pub(crate) mod camera;
mod camera_of_rig;
pub(crate) mod check;
pub(crate) mod circle;
pub(crate) mod design;
pub(crate) mod doctor;
pub(crate) mod export;
pub(crate) mod generate;
pub(crate) mod identify;
pub(crate) mod jog;
pub(crate) mod paper;
mod partner;
mod prove;
pub(crate) mod reconcile;
pub(crate) mod replay;
pub(crate) mod report;
pub(crate) mod rig;
pub(crate) mod run;
pub(crate) mod simulate;
pub(crate) mod track;
pub(crate) mod vision;
mod vision_sheet;
mod vision_summary;
pub(crate) mod watch;

use crate::outcome::CommandResult;

/// The commands, in the order in which a lab needs them.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// Hold a bead in closed loop: at a position, or on a sine.
    Track(track::Args),
    /// Run a setpoint script in closed loop, or resume one.
    Run(Box<run::Args>),
    /// Make a controller for a model and a delay: margins, predicted error, spread, controller.toml.
    Design(design::Args),
    /// Check a setpoint script against model and limits; nothing moves.
    Check(check::Args),
    /// Simulate the response of a model to the commands of a record.
    Simulate(simulate::Args),
    /// Repeat a recorded run and compare the commands to the last bit.
    Replay(replay::Args),
    /// Show a run on the live page, from its folder.
    Watch(watch::Args),
    /// Write a run's report: result, traces, errors, cycles, timing, events.
    Report(report::Args),
    /// Pack a run for archiving, with a manifest.
    Bundle(bundle::Args),
    /// Convert a run to CSV, Parquet, HDF5, MAT or RT-DC.
    Export(export::Args),
    /// Test whether this machine is fit for a 1 kHz loop.
    Doctor(doctor::Args),
    /// Measure the plant on a rig, or fit a model to records.
    Identify(Box<identify::Args>),
    /// Find what a model lacks, compared with records.
    Reconcile(Box<reconcile::Args>),
    /// Identify, reconcile, design and track in one go, with errors before and after.
    Circle(Box<circle::Args>),
    /// Find beads or cells in a recording: CSV, contact sheet, summary.
    Vision(Box<vision::Args>),
    /// Write, check or prove a rig.
    Rig(rig::Args),
    /// Test the line to the PZT board; show its identity and counters.
    Board(board::Args),
    /// Move the PZT by hand.
    Jog(jog::Args),
    /// Calibrate the camera's picture: axis, sign, pixel size.
    Calibrate(calibrate::Args),
    /// List cameras, or measure rate, intervals, age and losses of one.
    Camera(camera::Args),
    /// Record the empty channel: the background for cells.
    Background(background::Args),
    /// Repeat Mizoue et al. 2017 on the emulated rig and compare every number.
    Paper(paper::Args),
    /// Write shell completions and manual pages.
    Generate(generate::Args),
}

/// The commands by task.
const GROUPS: [(&str, &[&str]); 6] = [
    ("Hold and move", &["track", "run", "jog"]),
    (
        "Look at a run",
        &["watch", "report", "replay", "export", "bundle"],
    ),
    (
        "Plan and predict",
        &["design", "check", "simulate", "paper"],
    ),
    ("Measure the plant", &["identify", "reconcile", "circle"]),
    (
        "Set up the rig",
        &[
            "doctor",
            "rig",
            "board",
            "camera",
            "background",
            "vision",
            "calibrate",
        ],
    ),
    ("The program itself", &["generate", "help"]),
];

/// The commands in groups, as the help shows them.
pub(crate) fn groups(command: &clap::Command) -> String {
    let line = |name: &str| {
        let about = match name {
            "help" => "This text, or the help of a command".to_string(),
            name => (command.find_subcommand(name)?.get_about())
                .map_or_else(String::new, ToString::to_string),
        };
        Some(format!("  {name:<11} {about}\n"))
    };
    GROUPS
        .iter()
        .map(|(title, names)| {
            let lines: String = names.iter().filter_map(|name| line(name)).collect();
            format!("{title}:\n{lines}\n")
        })
        .collect()
}

impl Command {
    /// Runs the command.
    pub(crate) fn run(self) -> CommandResult {
        match self {
            Self::Track(args) => track::run(args),
            Self::Run(args) => run::run(*args),
            Self::Replay(args) => replay::run(args),
            Self::Watch(args) => watch::run(args),
            Self::Design(args) => design::run(args),
            Self::Check(args) => check::run(args),
            Self::Simulate(args) => simulate::run(args),
            Self::Report(args) => report::run(args),
            Self::Bundle(args) => bundle::run(args),
            Self::Export(args) => export::run(args),
            Self::Doctor(args) => doctor::run(args),
            Self::Identify(args) => identify::run(*args),
            Self::Reconcile(args) => reconcile::run(*args),
            Self::Circle(args) => circle::run(*args),
            Self::Vision(args) => vision::run(*args),
            Self::Rig(args) => rig::run(args),
            Self::Board(args) => board::run(args),
            Self::Jog(args) => jog::run(args),
            Self::Calibrate(args) => calibrate::run(args),
            Self::Camera(args) => camera::run(args),
            Self::Background(args) => background::run(args),
            Self::Paper(args) => paper::run(args),
            Self::Generate(args) => generate::run(args),
        }
    }
}

/// The path next to a run's folder with its name and a suffix. A folder given as `.` has a name too.
fn beside(run: &std::path::Path, behind: &str) -> std::path::PathBuf {
    let folder = match run.file_name() {
        Some(_) => run.to_owned(),
        None => std::fs::canonicalize(run).unwrap_or_else(|_| run.to_owned()),
    };
    let mut name = folder.file_name().unwrap_or("run".as_ref()).to_owned();
    name.push(behind);
    folder.with_file_name(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_command_is_in_one_group_of_the_help() {
        let command = <Command as clap::Subcommand>::augment_subcommands(clap::Command::new("c"));
        let mut known: Vec<&str> = (command.get_subcommands())
            .map(clap::Command::get_name)
            .collect();
        known.push("help");
        known.sort_unstable();
        let mut grouped: Vec<&str> = GROUPS
            .iter()
            .flat_map(|(_, names)| names.iter().copied())
            .collect();
        grouped.sort_unstable();
        assert_eq!(grouped, known);
    }
}
