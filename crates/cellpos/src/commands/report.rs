//! `cellpos report`: what a run did, on one page.

mod bound;
mod clips;
mod cycles;
mod envelope;
mod fatigue;
mod fault;
mod session;
mod spectrum;
mod spread;
mod ticks;

use super::run::{learning, resume};
use crate::arguments::run_folder;
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use crate::output;
use cellpos_record::{CYCLES_CSV, RunEnd, RunReader};
use cellpos_report::{Axis, Column, Emphasis, Figure, Panel, Report, Series, Table};
use cellpos_runtime::Summary;
use cellpos_runtime::summary::plan_warning;
use cellpos_script::read_cycles;
pub use cycles::with_interval;
use session::{Session, events, provenance, timing};
use std::path::{Path, PathBuf};
use ticks::Ticks;

/// Arguments of `cellpos report`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:
  cellpos report runs/20261121T190000Z-fatigue

Writes report.html into the run folder, and beside it report-figures/ with every figure as SVG and its data as CSV. The
sessions of a run that was resumed are joined; the gaps show.")]
pub struct Args {
    /// The run's folder; `latest`, or `latest-NAME`: the newest below runs/.
    #[arg(value_parser = run_folder())]
    run: PathBuf,
    /// The page to write; left out: report.html in the run folder.
    #[arg(long)]
    out: Option<PathBuf>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// Writes the page.
pub fn run(args: Args) -> CommandResult {
    output::ready(&args.out)?;
    let first = RunReader::open(&args.run).map_err(Failure::input)?;
    let text = std::fs::read_to_string(args.run.join(CYCLES_CSV)).unwrap_or_default();
    let cycles = read_cycles(&text);
    let mut ticks = Ticks::with_courses(fatigue::courses(&cycles.rows));
    let mut sessions = Vec::new();
    for folder in resume::sessions(&args.run) {
        let reader = RunReader::open(&folder).map_err(Failure::input)?;
        let gap_s = resume::session_config(&reader).and_then(|config| config.gap_s());
        let start_s = if sessions.is_empty() {
            0.0
        } else {
            ticks.end_s() + gap_s.unwrap_or(0.0)
        };
        let mut batches = reader.batches().map_err(Failure::failed)?;
        ticks.begin(start_s, reader.meta().ok().and_then(bound::hold_of));
        for batch in batches.by_ref() {
            batch.iter().for_each(|record| ticks.add(record));
        }
        sessions.push(Session {
            lost: batches.lost(),
            events: reader.events().map_err(Failure::failed)?.events,
            meta: reader.meta().ok().cloned(),
            folder,
            start_s,
        });
    }
    let meta = first.meta().ok();
    let name = meta.map_or("run", |meta| meta.name.as_str());
    let mut page = Report::new(&format!("Run {name}"));
    if let Some(notes) = notes(&first) {
        page.paragraph(&notes);
    }
    what_it_was(&mut page, &sessions);
    head(&mut page, &sessions, &ticks);
    traces(&mut page, &ticks);
    let bound = bound::Bound::of(meta, &ticks);
    errors(&mut page, &ticks, bound.as_ref());
    let trends = cycles::section(&mut page, &cycles);
    fatigue::section(&mut page, &cycles.rows, &ticks);
    learned(&mut page, &args.run)?;
    timing(&mut page, &sessions, &ticks);
    fault::section(&mut page, &sessions)?;
    clips::section(&mut page, &sessions);
    events(&mut page, &sessions);
    provenance(&mut page, &sessions);
    let out = args.out.unwrap_or_else(|| args.run.join("report.html"));
    page.write_with_figures(&out)
        .map_err(|error| Failure::bad_input(error, "name a page that you may write with --out"))?;
    if args.json {
        print_json(&serde_json::json!({
            "out": out,
            "sessions": sessions.len(),
            "ticks": ticks.rows,
            "cycles": cycles.rows.len(),
            "rms_nm": ticks.rms_um().map(|um| um * 1e3),
            "bound_rms_nm": bound.as_ref().map(|bound| bound.rms_um * 1e3),
            "trends": trends,
        }))?;
    } else {
        print_text(&format!("{}\n", out.display()))?;
    }
    Ok(Outcome::Done)
}

/// The notes of the script, if the run is one of a script with notes.
fn notes(reader: &RunReader) -> Option<String> {
    // A run that cannot be set up again is still worth a report.
    let setup = cellpos_session::recorded::setup(reader).ok()?;
    let (script, _) = setup.config.reference.script().ok()??;
    Some(script.notes).filter(|notes| !notes.is_empty())
}

fn nm(um: Option<f64>) -> String {
    // What rounds to nothing has no sign.
    um.map_or_else(
        || "-".to_string(),
        |um| format!("{:.1}", (um * 1e4).round() / 10.0 + 0.0),
    )
}

/// How a session ended.
fn ending(session: &Session) -> (Emphasis, String) {
    match session.meta.as_ref().and_then(|meta| meta.end.as_ref()) {
        Some(end) if end.outcome == "done" => (Emphasis::Good, "came to its end".to_string()),
        Some(end) => (Emphasis::Warning, format!("ended: {}", end.outcome)),
        None => (
            Emphasis::Bad,
            "was cut off: it reads up to its last flush".to_string(),
        ),
    }
}

/// Sample, date, machine, devices, controller and gains: what a reader asks first.
fn what_it_was(page: &mut Report, sessions: &[Session]) {
    let Some(meta) = sessions.iter().find_map(|session| session.meta.as_ref()) else {
        return;
    };
    let at = |table: &toml::Table, path: &[&str]| -> Option<toml::Value> {
        let (first, rest) = path.split_first()?;
        let mut value = table.get(*first)?;
        for key in rest {
            value = value.get(key)?;
        }
        Some(value.clone())
    };
    let text = |table: &toml::Table, path: &[&str]| {
        at(table, path).map(|value| match value {
            toml::Value::String(text) => text,
            other => other.to_string(),
        })
    };
    let mut rows: Vec<(String, String)> = Vec::new();
    let sample = at(&meta.config, &["rig", "sample"])
        .and_then(|value| value.try_into::<cellpos_script::Sample>().ok())
        .unwrap_or_default();
    for (name, value) in sample.rows() {
        rows.push((name.to_owned(), value));
    }
    let mut add = |name: &str, value: Option<String>| {
        if let Some(value) = value.filter(|value| !value.is_empty()) {
            rows.push((name.to_owned(), value));
        }
    };
    add("started (UTC)", Some(meta.started_utc.clone()));
    add("host", text(&meta.conditions, &["host"]));
    add("clock", Some(meta.clock.clone()));
    let device = |kind: &str| {
        let of_rig = text(&meta.config, &["rig", kind, "kind"]);
        let name = text(&meta.conditions, &[kind, "name"]);
        match (of_rig, name) {
            (Some(kind), Some(name)) if name != kind => Some(format!("{kind}: {name}")),
            (one, other) => one.or(other),
        }
    };
    add("actuator", device("actuator"));
    add("camera", device("camera"));
    let law = text(&meta.controller, &["controller"]);
    let gains = meta
        .controller
        .get("pi")
        .and_then(toml::Value::as_table)
        .map(|gains| {
            let gains: Vec<String> = gains
                .iter()
                .map(|(key, value)| match value.as_float() {
                    Some(number) => format!("{key} = {number:.4}"),
                    None => format!("{key} = {value}"),
                })
                .collect();
            gains.join(", ")
        });
    add(
        "controller",
        law.map(|law| match (law.as_str(), gains) {
            ("pi", Some(gains)) => format!("pi: {gains}"),
            (_, Some(gains)) => format!("{law} (its fallback PI: {gains})"),
            (_, None) => law,
        }),
    );
    add(
        "loop delay designed for",
        text(&meta.controller, &["delay_ms"]).map(|ms| format!("{ms} ms")),
    );
    let version = |name: &str| meta.versions.get(name).cloned();
    add(
        "cellpos",
        version("cellpos").map(|cellpos| match version("commit") {
            Some(commit) => format!("{cellpos} ({commit})"),
            None => cellpos,
        }),
    );
    add("command", Some(meta.command_line.join(" ")));
    let rows: Vec<(&str, String)> = rows
        .iter()
        .map(|(name, value)| (name.as_str(), value.clone()))
        .collect();
    page.table(Table::key_values(&rows));
}

fn head(page: &mut Report, sessions: &[Session], ticks: &Ticks) {
    if let Some(last) = sessions.last() {
        let (status, text) = ending(last);
        let text = match sessions.len() {
            1 => format!("The run {text}."),
            many => format!("The last of {many} sessions {text}."),
        };
        page.note(status, &text);
    }
    let end = |session: &Session| session.meta.as_ref()?.end.clone();
    let missing: u64 = sessions.iter().map(|session| session.lost.rows).sum();
    let damaged: u64 = sessions
        .iter()
        .map(|session| session.lost.damaged_bytes)
        .sum();
    if missing + damaged > 0 {
        let text = format!("{missing} rows are missing, {damaged} bytes damaged.");
        page.note(Emphasis::Warning, &text);
    }
    let unwritten = |of: fn(&RunEnd) -> u64| {
        let ends = sessions.iter().filter_map(end);
        ends.map(|end| of(&end)).sum::<u64>()
    };
    let (rows, events) = (
        unwritten(|end| end.rows_lost),
        unwritten(|end| end.events_lost),
    );
    if rows + events > 0 {
        let text = format!("{rows} rows and {events} events could not be written.");
        page.note(Emphasis::Warning, &text);
    }
    for end in sessions.iter().filter_map(end) {
        let percent = end
            .summary
            .get("plan_off_percent")
            .and_then(toml::Value::as_float);
        let most = Summary::PLAN_OFF_PERCENT;
        if let Some(percent) = percent.filter(|percent| percent.is_nan() || percent.abs() > most) {
            let text = format!("In this run {}.", plan_warning(percent));
            page.note(Emphasis::Warning, &text);
        }
    }
    let rows = [
        ("ticks", ticks.rows.to_string()),
        ("duration (s)", format!("{:.3}", ticks.duration_s())),
        ("error, RMS (nm)", nm(ticks.rms_um())),
        ("error, mean (nm)", nm(ticks.mean_um())),
        ("error, largest (nm)", nm(ticks.peak_um())),
    ];
    let mut table = Table::key_values(&rows);
    table.caption(
        "Errors: measured position less the reference of the time of its exposure, from two seconds after the loop was closed (or \
         went on after a freeze) until the bead was frozen or the PZT parked; the same as the terminal and run.toml have.",
    );
    page.table(table);
    if sessions.len() > 1 {
        let mut table = Table::new([
            Column::right("session"),
            Column::right("start (s)"),
            Column::right("error, RMS (nm)"),
            Column::right("rows missing"),
            Column::left("how it ended"),
        ]);
        for (number, session) in (1u64..).zip(sessions) {
            table.row([
                number.to_string().as_str(),
                &format!("{:.3}", session.start_s),
                &nm(ticks
                    .statistics
                    .get(number as usize - 1)
                    .and_then(|statistics| statistics.rms_measured_nm())
                    .map(|nm| nm * 1e-3)),
                &session.lost.rows.to_string(),
                &ending(session).1,
            ]);
        }
        page.table(table);
    }
}

fn traces(page: &mut Report, ticks: &Ticks) {
    page.section("Traces");
    let time = || Axis::linear("time", "s");
    let times_s = ticks.traces.times_s();
    let [target_um, measured_um, command_um, neutral_um] =
        std::array::from_fn(|column| ticks.traces.column(column));
    let caption = match ticks.traces.rows() {
        1 => "Reference, position, PZT over the whole run.".to_string(),
        rows => format!(
            "Reference, position, PZT over the whole run: the smallest and the largest of every {rows} ticks."
        ),
    };
    page.figure(
        Figure::new("traces", &caption)
            .panel(
                Panel::new(time(), Axis::linear("bead", "um"))
                    .series(
                        Series::line("measured", &times_s, &measured_um)
                            .thin()
                            .color(1),
                    )
                    .series(
                        Series::line("reference", &times_s, &target_um)
                            .thin()
                            .color(0),
                    ),
            )
            .panel(
                Panel::new(time(), Axis::linear("PZT", "um"))
                    .series(
                        Series::line("command", &times_s, &command_um)
                            .thin()
                            .color(2),
                    )
                    .series(Series::line("neutral", &times_s, &neutral_um).color(3)),
            )
            .share_x(),
    );
    let near = &ticks.excerpt;
    page.figure(
        Figure::new(
            "excerpt",
            "Every tick of the first two seconds of the closed loop.",
        )
        .panel(
            Panel::new(time(), Axis::linear("bead", "um"))
                .series(Series::line("reference", &near.time_s, &near.target_um))
                .series(Series::line("measured", &near.time_s, &near.measured_um).thin()),
        )
        .panel(
            Panel::new(time(), Axis::linear("PZT", "um"))
                .series(Series::step("command", &near.time_s, &near.command_um).color(2)),
        )
        .share_x(),
    );
}

fn errors(page: &mut Report, ticks: &Ticks, bound: Option<&bound::Bound>) {
    page.section("Error");
    page.figure(
        Figure::new("error-histogram", "Error of every position, closed loop.").panel(
            Panel::new(Axis::linear("error", "nm"), Axis::linear("positions", ""))
                .series(ticks.error_nm.histogram("error", 80)),
        ),
    );
    let Some(spectrum) = ticks.error_um.spectrum(ticks.period_s()) else {
        page.paragraph("The run is too short for a spectrum.");
        return;
    };
    let mut panel = Panel::new(
        Axis::log("frequency", "Hz"),
        Axis::log("density", "nm/rtHz"),
    )
    .series(Series::line("error", &spectrum.hz, &spectrum.nm_per_rthz));
    let mut caption = "Amplitude density of the error, one-sided.".to_string();
    if let Some(bound) = bound {
        let density: Vec<f64> = spectrum
            .hz
            .iter()
            .map(|hz| bound.nm_per_rthz(*hz))
            .collect();
        panel = panel.series(Series::line("bound", &spectrum.hz, &density).dashed());
        caption.push_str(&format!(
            " Dashed: what Brownian motion ({} um2/s), delay and localisation noise leave to the best controller while \
             holding, {:.1} nm RMS.",
            bound.diffusion_um2_per_s,
            bound.rms_um * 1e3
        ));
    }
    page.figure(Figure::new("error-spectrum", &caption).panel(panel));
}

fn learned(page: &mut Report, run: &Path) -> Result<(), Failure> {
    let motions = learning::load(run);
    if motions.is_empty() {
        return Ok(());
    }
    page.section("Learning");
    let mut table = Table::new([
        Column::left("motion"),
        Column::right("cycles"),
        Column::right("error, first few (nm RMS)"),
        Column::right("error, last few (nm RMS)"),
        Column::right("retreats"),
        Column::left("the plant was taken to be known to"),
    ]);
    for motion in &motions {
        let learned = &motion.table;
        table.row([
            motion.name.as_str(),
            &format!("{:.0}", learned.cycles),
            &nm(learned.error_before_um),
            &nm(learned.error_after_um),
            &learned.retreats.to_string(),
            &learned
                .margins
                .map_or_else(|| "-".to_owned(), |margins| margins.to_string()),
        ]);
    }
    table.caption(
        "Measured errors over the first few cycles in full swing and the last few, localisation noise included: two cycles or so \
         tell an error to some 20 %.",
    );
    page.table(table);
    Ok(())
}
