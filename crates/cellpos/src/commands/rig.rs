//! `cellpos rig`: a rig file to begin with, and what is wrong with one.

use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use crate::rig_file::RigFile;
use cellpos_workbench::Bench;
use cellpos_workbench::check::{self, Connected, Finding, Weight};
use cellpos_workbench::template::{self, Found, Kind};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Arguments of `cellpos rig`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, clap::Subcommand)]
enum Command {
    /// Print a commented rig file with the devices of this machine.
    #[command(after_help = "Examples:\n  cellpos rig new --emulated > rig.toml\n  \
        cellpos rig new --serial /dev/ttyACM0 --camera 192.168.1.20 > rig.toml\n  \
        cellpos rig new --serial pzt --camera camera.sock > rig.toml")]
    New(New),
    /// Check a rig file: every wrong key, with the remedy.
    #[command(
        after_help = "Examples:\n  cellpos rig check rig.toml\n  cellpos rig check rig.toml --connect"
    )]
    Check(Check),
    /// Test board, camera, vision and machine, and write a sheet for the lab book.
    Prove(super::prove::Args),
    /// Measure gain, lag and delay of the slow actuator, table [partner], while the bead is held.
    Partner(super::partner::Args),
}

#[derive(Debug, clap::Args)]
struct New {
    /// Emulated board and camera.
    #[arg(long, conflicts_with_all = ["serial", "camera"])]
    emulated: bool,
    /// Serial port of the board; default: the first one found.
    #[arg(long, value_name = "PORT")]
    serial: Option<String>,
    /// Socket of a camera server, or address of a GigE or USB3 Vision camera. A server that sends pictures gives the origin.
    #[arg(long, value_name = "CAMERA")]
    camera: Option<String>,
}

#[derive(Debug, clap::Args)]
struct Check {
    /// The file.
    rig: PathBuf,
    /// Open board and camera, too; nothing moves.
    #[arg(long)]
    connect: bool,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// What a check found.
#[derive(Debug, Serialize)]
struct Checked {
    rig: PathBuf,
    findings: Vec<Finding>,
    connected: Option<Connected>,
}

/// Prints a template, or checks a file.
pub(crate) fn run(args: Args) -> CommandResult {
    match args.command {
        Command::New(args) => new(args),
        Command::Check(args) => check(args),
        Command::Prove(args) => super::prove::run(&args),
        Command::Partner(args) => super::partner::run(&args),
    }
}

fn new(args: New) -> CommandResult {
    let mut found = Found {
        ports: template::ports(),
        cameras: cameras(),
        width_px: None,
    };
    // Only a camera that was named: another one may serve a run.
    found.width_px = (args.camera.as_deref())
        .map(template::camera)
        .and_then(|camera| template::width_px(&camera));
    let camera_asked_for = args.camera.is_some();
    let port = args.serial.or_else(|| found.ports.first().cloned());
    let camera = args.camera.or_else(|| found.cameras.first().cloned());
    let kind = match (args.emulated, port, camera) {
        (true, ..) => Kind::Emulated,
        (false, Some(port), camera) => Kind::Real {
            port,
            camera: template::camera(camera.as_deref().unwrap_or("camera.sock")),
        },
        (false, None, _) if camera_asked_for => {
            return Err(Failure::bad_input(
                "no serial port was found for the board",
                "plug it in, or name the port: --serial PORT; docs/rig.md, Permissions",
            ));
        }
        // A camera alone is no rig.
        (false, None, _) => Kind::Emulated,
    };
    for (what, found) in [("serial ports", &found.ports), ("cameras", &found.cameras)] {
        let names = if found.is_empty() {
            "none".to_string()
        } else {
            found.join(", ")
        };
        eprintln!("{what} of this machine: {names}");
    }
    print_text(&template::text(&kind, &found))?;
    Ok(Outcome::Done)
}

/// Cameras that answer: servers with a socket in this folder, industrial ones by address or identifier.
fn cameras() -> Vec<String> {
    let (_, industrial, _) = super::camera::cameras();
    let industrial = industrial.into_iter().map(|camera| {
        if camera.address.is_empty() {
            camera.id
        } else {
            camera.address
        }
    });
    template::sockets(Path::new("."))
        .into_iter()
        .chain(industrial)
        .collect()
}

fn check(args: Check) -> CommandResult {
    let file = RigFile::load(Some(&args.rig))?;
    let findings = check::findings(&file, &args.rig);
    let broken = findings
        .iter()
        .any(|finding| finding.weight == Weight::Error);
    let connected = if args.connect {
        Some(check::connect(&Bench::of(file)?, &args.rig))
    } else {
        None
    };
    let broken = broken
        || (connected.iter())
            .flat_map(|connected| &connected.findings)
            .any(|finding| finding.weight == Weight::Error);
    let checked = Checked {
        rig: args.rig,
        findings,
        connected,
    };
    if args.json {
        print_json(&checked)?;
    } else {
        print_text(&checked.to_string())?;
    }
    Ok(if broken {
        Outcome::Broken
    } else {
        Outcome::Done
    })
}

impl Checked {
    fn write(&self, f: &mut std::fmt::Formatter<'_>, finding: &Finding) -> std::fmt::Result {
        let weight = match finding.weight {
            Weight::Error => "error",
            Weight::Warning => "warning",
        };
        let line = finding
            .line
            .map_or(String::new(), |line| format!(":{line}"));
        let file = self.rig.display();
        writeln!(f, "{file}{line}: {weight}: {}", finding.what)?;
        writeln!(f, "  {}", finding.remedy)
    }
}

impl std::fmt::Display for Checked {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        for finding in &self.findings {
            self.write(f, finding)?;
        }
        if let Some(connected) = &self.connected {
            for finding in &connected.findings {
                self.write(f, finding)?;
            }
            write_devices(f, connected)?;
        }
        let count = self.findings.len() + self.connected.as_ref().map_or(0, |c| c.findings.len());
        match count {
            0 => writeln!(f, "{}: nothing to say against it", self.rig.display()),
            1 => writeln!(f, "{}: 1 finding", self.rig.display()),
            n => writeln!(f, "{}: {n} findings", self.rig.display()),
        }
    }
}

/// What the devices say of themselves.
fn write_devices(f: &mut std::fmt::Formatter<'_>, connected: &Connected) -> std::fmt::Result {
    if let Some(board) = &connected.board {
        writeln!(f, "board   {}", board.info.name)?;
        writeln!(
            f,
            "        {} to {} um, {} um/s, watchdogs {} and {} ms; {} at {:.3} um",
            board.info.low_um,
            board.info.high_um,
            board.info.slew_um_per_s,
            board.info.watchdog_ms,
            board.info.hold_watchdog_ms,
            board.state,
            board.applied_um
        )?;
        let trip = &board.round_trip_ms;
        writeln!(
            f,
            "        round trip {:.2} ms (median), {:.2} (p99), {:.2} (largest); {} of {} lost",
            trip.p50, trip.p99, trip.max, board.lost, board.sent
        )?;
    }
    if let Some(camera) = &connected.camera {
        writeln!(
            f,
            "camera  {}: {} x {} px, {:.1} Hz, {:.2} ms from mid-exposure to arrival (median)",
            camera.name, camera.size_px[0], camera.size_px[1], camera.rate_hz, camera.age_ms.p50
        )?;
    }
    Ok(())
}
