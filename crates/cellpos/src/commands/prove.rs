//! `cellpos rig prove`: a sheet for the lab book, line by line with numbers, and the conformance tests of board and camera server.

use crate::arguments::positive;
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use crate::rig_file::{ActuatorConfig, CameraConfig, Frames, RigFile};
use cellpos_numeric::units::{Micrometers, Seconds};
use cellpos_plant::Model;
use cellpos_report::{Column, Emphasis, Report, Table};
use cellpos_session::connect::describe;
use cellpos_session::signals;
use cellpos_workbench::Bench;
use cellpos_workbench::doctor;
use cellpos_workbench::experiment::on_rig::OnRig;
use cellpos_workbench::prove::{self, Line, Sheet, Talk, Verdict, board::Trial};
use serde::Serialize;
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// Arguments of `cellpos rig prove`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "The PZT moves by --amplitude about park, within [limits], and is left parked and disarmed. A bead in view moves, too.\n\n\
    Examples:\n  cellpos rig prove rig.toml --out proved.html\n  cellpos rig prove rig.toml --board           # does this board keep docs/board.md?\n  \
    cellpos rig prove rig.toml --camera --duration 10s   # does this server keep docs/camera-socket.md?\n\n\
    Exit code 0: every line that was tried passed; 1: a line failed."
)]
pub(super) struct Args {
    /// The rig file.
    rig: PathBuf,
    /// Only the board: the conformance test of docs/board.md.
    #[arg(long)]
    board: bool,
    /// Only the camera: rate, losses and age; of a socket the conformance test of docs/camera-socket.md.
    #[arg(long)]
    camera: bool,
    /// Duration of the camera test.
    #[arg(long, default_value = "60s", value_parser = positive::<Seconds>)]
    duration: Seconds,
    /// Motion of the PZT to each side of park.
    #[arg(long, default_value = "2um", value_parser = positive::<Micrometers>)]
    amplitude: Micrometers,
    /// Test a reset: press the board's reset button when asked.
    #[arg(long)]
    reset: bool,
    /// Write the sheet as a page, too (.html).
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// The sheet with its subject.
#[derive(Debug, Serialize)]
struct Proved {
    rig: PathBuf,
    /// When, UTC.
    at: String,
    /// Version of this program.
    program: &'static str,
    passed: usize,
    failed: usize,
    not_tried: usize,
    #[serde(flatten)]
    sheet: Sheet,
}

/// How long a bead at rest is looked at, s.
const LOOK_S: f64 = 5.0;
/// Edges of the LED, for a delay to some hundredths of a millisecond.
const LED_EDGES: usize = 200;

/// Tries what is asked for and writes the sheet.
pub(super) fn run(args: &Args) -> CommandResult {
    if let Some(out) = &args.out {
        crate::output::ready([out])?;
    }
    let file = RigFile::load(Some(&args.rig))?;
    let bench = Bench::of(file)?;
    let all = !args.board && !args.camera;
    let mut sheet = Sheet::default();
    // A bead that lies there is looked at first: the board's motion takes it along.
    if all {
        say("vision, machine");
        prove::vision(&mut sheet, &bench, LOOK_S);
        machine(&mut sheet);
    }
    if all || args.camera {
        say(&format!("camera: {} s", args.duration.value()));
        camera(&mut sheet, &bench, args.duration.value());
    }
    if all {
        led(&mut sheet, &bench);
    }
    if all || args.board {
        say("board: its line, its limits, its stops");
        board(&mut sheet, &bench, args);
    }
    let [passed, failed, not_tried] = sheet.counts();
    let proved = Proved {
        rig: args.rig.clone(),
        at: jiff::Timestamp::now()
            .strftime("%Y-%m-%d %H:%M:%S UTC")
            .to_string(),
        program: env!("CARGO_PKG_VERSION"),
        passed,
        failed,
        not_tried,
        sheet,
    };
    if let Some(out) = &args.out {
        crate::output::write(out, &proved.page().to_html())?;
    }
    if args.json {
        print_json(&proved)?;
    } else {
        print_text(&proved.to_string())?;
    }
    Ok(if failed == 0 {
        Outcome::Done
    } else {
        Outcome::Broken
    })
}

/// What is being done, on standard error.
fn say(what: &str) {
    crate::outcome::print_err(what);
}

fn board(sheet: &mut Sheet, bench: &Bench, args: &Args) {
    let limits = bench.file().limits;
    let mut again = |talk: Talk| reopened(bench, talk);
    let mut trial = Trial {
        limits_um: [limits.low_um, limits.high_um, limits.slew_um_per_s],
        park_um: limits.park_um,
        amplitude_um: args.amplitude.value(),
        reset: args.reset.then_some(&mut again),
    };
    match bench.line() {
        Ok(line) => prove::board::board(sheet, Talk::on(line), &mut trial),
        Err(failure) => {
            let name = prove::board::LINES[0];
            sheet.judge(
                ("board", name),
                false,
                (None, "ms"),
                "a line to the board",
                describe(&failure),
            );
            sheet.complete("board", &prove::board::LINES, "no line to the board");
        }
    }
}

/// The line to a board that somebody resets now: closed, and opened again when it can be.
fn reopened(bench: &Bench, mut talk: Talk) -> Result<Talk, Failure> {
    const PATIENCE: Duration = Duration::from_secs(60);
    say("press the board's reset button within 60 s");
    let before = talk.board_time_us()?;
    let start = Instant::now();
    let mut line = Some(talk);
    while start.elapsed() < PATIENCE {
        // Another commands' silence parks it: it is kept fed while nobody has pressed.
        let Some(mut talk) = line.take() else {
            std::thread::sleep(Duration::from_millis(20));
            line = bench.line().ok().map(Talk::on);
            continue;
        };
        match talk.keep_fed() {
            Ok(Some(us)) if us < before => return Ok(talk),
            Ok(_) => line = Some(talk),
            // A port that vanishes with its board comes back with it.
            Err(_) => drop(talk),
        }
    }
    line.ok_or_else(|| {
        Failure::bad_input(
            "--reset: the line to the board did not come back within 60 s",
            "see that the port has the same name after a reset (/dev/serial/by-id)",
        )
    })
}

fn camera(sheet: &mut Sheet, bench: &Bench, duration_s: f64) {
    match &bench.file().camera {
        // The conformance test needs no minute; the driver watches for the rest.
        CameraConfig::Socket { socket, rate_hz } => {
            prove::socket::socket(sheet, socket, *rate_hz, duration_s.min(10.0));
        }
        _ => sheet.complete(
            "socket",
            &prove::socket::LINES,
            "[camera] kind is not socket: there is no server to try",
        ),
    }
    prove::camera(sheet, bench, duration_s);
}

/// The delay from the middle of an exposure to a frame's arrival, by the LED in front of the camera.
fn led(sheet: &mut Sheet, bench: &Bench) {
    const NAME: (&str, &str) = ("camera", "delay by the LED");
    let file = bench.file();
    if !matches!(file.actuator, ActuatorConfig::Serial { .. }) {
        sheet.leave(
            NAME,
            "[actuator] kind is not serial: there is no board with an LED",
        );
        return;
    }
    let measured = OnRig::new(file.clone(), Model::eq6(), None, Frames::On, true)
        .and_then(|rig| rig.delay_test(LED_EDGES, 1));
    match measured {
        Ok(test) => {
            let estimate = test.estimate;
            let [low_s, high_s] = estimate.ci95_s;
            let half_ms = 0.5e3 * (high_s - low_s);
            sheet.judge(
                NAME,
                half_ms < 0.1,
                (estimate.delay_s * 1e3, "ms"),
                "known to 0.1 ms",
                format!(
                    "+- {half_ms:.3} ms (95 %) from {LED_EDGES} edges; [timing] camera_delay_ms is {}",
                    file.timing.camera_delay_ms
                ),
            );
        }
        Err(failure) => sheet.leave(NAME, &format!("no LED in view: {}", describe(&failure))),
    }
}

fn machine(sheet: &mut Sheet) {
    let limit = "cellpos doctor calls it fit for 1 kHz";
    let stop = signals::ends_measuring();
    match doctor::examine(Duration::from_secs(5), false, None, &stop) {
        Ok(it) => {
            sheet.judge(
                ("machine", "doctor's verdict"),
                it.fit,
                (it.soak.wake_us.p999, "us"),
                limit,
                it.verdict,
            );
        }
        Err(error) => sheet.leave(("machine", "doctor's verdict"), &error.to_string()),
    }
}

/// A number to four digits or so, with its unit.
fn value(line: &Line) -> String {
    line.value.map_or_else(String::new, |value| {
        let digits = match value.abs() {
            large if large >= 1000.0 || value.fract() == 0.0 => 0,
            medium if medium >= 10.0 => 1,
            _ => 3,
        };
        format!("{value:.digits$} {}", line.unit)
            .trim_end()
            .to_string()
    })
}

fn word(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Passed => "passed",
        Verdict::Failed => "FAILED",
        Verdict::NotTried => "not tried",
    }
}

impl std::fmt::Display for Proved {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mut part = "";
        for line in &self.sheet.lines {
            if line.part != part {
                part = line.part;
                writeln!(f, "{part}")?;
            }
            writeln!(
                f,
                "  {:9}  {:42}  {:>14}  {}",
                word(line.verdict),
                line.name,
                value(line),
                if line.verdict == Verdict::Passed {
                    ""
                } else {
                    line.note.as_str()
                }
            )?;
            if line.verdict == Verdict::Failed {
                writeln!(f, "             must be: {}", line.limit)?;
            }
        }
        writeln!(
            f,
            "{}: {} passed, {} failed, {} not tried, {}",
            self.rig.display(),
            self.passed,
            self.failed,
            self.not_tried,
            self.at
        )
    }
}

/// Lines of the sheet as a table, with their part where lines of several parts are in it.
fn table<'a>(lines: impl Iterator<Item = &'a Line>, with_part: bool) -> Table {
    let mut columns = vec![
        Column::left("verdict"),
        Column::left("what"),
        Column::right("measured"),
        Column::left("must be"),
        Column::left("seen"),
    ];
    if with_part {
        columns.insert(1, Column::left("part"));
    }
    let mut table = Table::with_columns(columns);
    for line in lines {
        let emphasis = match line.verdict {
            Verdict::Passed => Emphasis::Good,
            Verdict::Failed => Emphasis::Bad,
            Verdict::NotTried => Emphasis::Plain,
        };
        let mut row = vec![
            word(line.verdict).to_string(),
            line.name.to_string(),
            value(line),
            line.limit.clone(),
            line.note.clone(),
        ];
        if with_part {
            row.insert(1, line.part.to_string());
        }
        table.row_with(emphasis, row);
    }
    table
}

impl Proved {
    fn failures(&self) -> impl Iterator<Item = &Line> {
        let lines = self.sheet.lines.iter();
        lines.filter(|line| line.verdict == Verdict::Failed)
    }

    /// What came out, in a sentence that names each failed line.
    fn sentence(&self) -> String {
        let tried = self.passed + self.failed;
        let left = match self.not_tried {
            0 => String::new(),
            1 => " One line was not tried.".to_owned(),
            n => format!(" {n} lines were not tried."),
        };
        if tried == 0 {
            return format!("Nothing was tried.{left}");
        }
        let names: Vec<String> = self
            .failures()
            .map(|line| format!("{} ({})", line.name, line.part))
            .collect();
        if names.is_empty() {
            format!("{tried} of {tried} lines that were tried passed.{left}")
        } else {
            format!(
                "{} of {tried} lines failed: {}.{left}",
                self.failed,
                names.join(", ")
            )
        }
    }

    fn page(&self) -> Report {
        let mut page = Report::new(&format!("Rig proved: {}", self.rig.display()));
        let mut parts: Vec<&str> = self.sheet.lines.iter().map(|line| line.part).collect();
        parts.dedup();
        let mut named = parts.clone();
        named.sort_unstable();
        named.dedup();
        page.lead(&format!(
            "Task: test whether the rig {} does what a run relies on. Parts: {}. {}, cellpos {}.",
            self.rig.display(),
            named.join(", "),
            self.at,
            self.program
        ));
        let status = match (self.failed, self.passed) {
            (0, 0) => Emphasis::Plain,
            (0, _) => Emphasis::Good,
            _ => Emphasis::Bad,
        };
        page.result(status, &self.sentence());
        page.certainty(
            "each line was tried once, now, on this machine. Lines about time fail on a busy machine; a fault that comes once an hour passes.",
        );
        if self.failed > 0 {
            page.section("What failed");
            page.table(table(self.failures(), true));
        }
        for part in parts {
            page.section(part);
            let lines = self.sheet.lines.iter();
            page.table(table(lines.filter(|line| line.part == part), false));
        }
        page
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn proved(sheet: Sheet) -> Proved {
        let [passed, failed, not_tried] = sheet.counts();
        Proved {
            rig: "rig.toml".into(),
            at: "2026-11-20 08:00:00 UTC".to_owned(),
            program: "0.0.0",
            passed,
            failed,
            not_tried,
            sheet,
        }
    }

    #[test]
    fn the_page_says_first_what_was_tried_what_came_out_and_what_failed() {
        let mut sheet = Sheet::default();
        sheet.judge(
            ("board", "answers hello"),
            true,
            (0.1, "ms"),
            "an answer",
            "",
        );
        let good = proved(sheet.clone());
        assert_eq!(good.sentence(), "1 of 1 lines that were tried passed.");
        sheet.judge(
            ("camera", "frames lost"),
            false,
            (12.0, ""),
            "none",
            "12 of 900",
        );
        sheet.leave(("board", "reset in mid-flight"), "--reset asks for it");
        let bad = proved(sheet);
        assert_eq!(
            bad.sentence(),
            "1 of 2 lines failed: frames lost (camera). One line was not tried."
        );
        let html = bad.page().to_html();
        let at = |text: &str| html.find(text).unwrap_or_else(|| panic!("no {text}"));
        let order = [
            "Task: test",
            "1 of 2 lines failed",
            "each line was tried once",
            "12 of 900",
            "answers hello",
        ];
        assert!(
            order.windows(2).all(|pair| at(pair[0]) < at(pair[1])),
            "{html}"
        );
        assert_eq!(proved(Sheet::default()).sentence(), "Nothing was tried.");
    }
}
