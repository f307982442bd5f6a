//! `cellpos report`: a run on one page.

mod bound;
mod clips;
mod cycles;
mod envelope;
mod fatigue;
mod fault;
mod result;
mod session;
mod spectrum;
mod spread;
mod ticks;

use super::run::{learning, resume};
use crate::arguments::run_folder;
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use crate::output;
use cellpos_record::{CYCLES_CSV, RunEnd, RunMeta, RunReader};
use cellpos_report::{Axis, Column, Emphasis, Figure, Panel, Report, Series, Table};
use cellpos_runtime::Summary;
use cellpos_runtime::summary::plan_warning;
use cellpos_script::read_cycles;
pub(crate) use cycles::with_interval;
use session::{Session, events, provenance, timing};
use std::path::{Path, PathBuf};
use ticks::Ticks;

/// Arguments of `cellpos report`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:
  cellpos report runs/20261121T190000Z-fatigue

Writes report.html into the run folder, and report-figures/ with every figure as SVG and its data as CSV. It joins the sessions of a
resumed run and shows the gaps.")]
pub(crate) struct Args {
    /// Run folder; `latest`, or `latest-NAME`: the newest in runs/.
    #[arg(value_parser = run_folder())]
    run: PathBuf,
    /// Page to write; default: report.html in the run folder.
    #[arg(long)]
    out: Option<PathBuf>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// Writes the page.
pub(crate) fn run(args: Args) -> CommandResult {
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
    let bound = bound::Bound::of(meta, &ticks);
    let sentence = result::section(&mut page, &sessions, &ticks, &cycles.rows, bound.as_ref());
    let of_a_cell = fatigue::figure(&cycles.rows).filter(|_| ticks.has_length);
    let is_cell = of_a_cell.is_some();
    page.figure(of_a_cell.unwrap_or_else(|| result::error_figure(&ticks, bound.as_ref())));
    head(&mut page, &sessions, &ticks);
    traces(&mut page, &ticks);
    if is_cell {
        page.section("Error");
        page.figure(result::error_figure(&ticks, bound.as_ref()));
    }
    spectrum(&mut page, &ticks, meta);
    let trends = cycles::section(&mut page, &cycles);
    fatigue::section(&mut page, &cycles.rows, &ticks);
    learned(&mut page, &args.run)?;
    timing(&mut page, &ticks);
    fault::section(&mut page, &sessions)?;
    clips::section(&mut page, &sessions);
    events(&mut page, &sessions);
    page.section("What was run");
    what_it_was(&mut page, &sessions);
    if let Some(notes) = notes(&first) {
        page.paragraph(&notes);
    }
    page.fold("Figures, configuration and provenance in full");
    session::figures(&mut page, &sessions);
    provenance(&mut page, &sessions);
    page.unfold();
    let out = args.out.unwrap_or_else(|| args.run.join("report.html"));
    page.write_with_figures(&out)
        .map_err(|error| Failure::bad_input(error, "name a page that you may write with --out"))?;
    if args.json {
        print_json(&serde_json::json!({
            "out": out,
            "result": sentence,
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
    // A value that rounds to zero has no sign.
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

/// Sample, date, machine, devices, controller and gains.
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
        // A run that came to its end says so in its result.
        if sessions.len() > 1 || status != Emphasis::Good {
            page.note(status, &text);
        }
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

/// A column as an envelope with its median, or as it is where each point is one tick.
fn enveloped(panel: Panel, ticks: &Ticks, column: usize, name: &str, color: usize) -> Panel {
    let course = ticks.traces.course(column);
    let median = Series::line(name, &course.time_s, &course.median).thin();
    if ticks.traces.is_bare() {
        return panel.series(median.color(color));
    }
    let band = Series::band("", &course.time_s, &course.low, &course.high);
    panel.series(band.color(color)).series(median.color(color))
}

fn traces(page: &mut Report, ticks: &Ticks) {
    page.section("Traces");
    let time = || Axis::linear("time", "s");
    let caption = match ticks.traces.is_bare() {
        true => "Position and target (above), PZT and zero flow (below) over the whole run.".to_string(),
        false => "Position and target (above), PZT and zero flow (below) over the whole run: area from the smallest to the largest \
                  value of each stretch of time, line: median; the target by its two ends."
            .to_string(),
    };
    // The target is thin and on top; one that moves fast has an upper and a lower end.
    let target = ticks.traces.course(0);
    let mut bead = enveloped(
        Panel::new(time(), Axis::linear("position", "um")),
        ticks,
        1,
        "measured",
        0,
    )
    .series(
        Series::line("target", &target.time_s, &target.low)
            .thin()
            .color(1),
    );
    if !ticks.traces.is_bare() {
        bead = bead.series(
            Series::line("", &target.time_s, &target.high)
                .thin()
                .color(1),
        );
    }
    let pzt = enveloped(
        Panel::new(time(), Axis::linear("PZT", "um")),
        ticks,
        2,
        "command",
        2,
    );
    let neutral = ticks.traces.course(3);
    let pzt = pzt.series(
        Series::line("zero flow", &neutral.time_s, &neutral.median)
            .thin()
            .color(3),
    );
    page.figure(
        Figure::new("traces", &caption)
            .panel(bead)
            .panel(pzt)
            .share_x(),
    );
    let near = &ticks.excerpt;
    page.figure(
        Figure::new(
            "excerpt",
            "Every tick of the first two seconds of the closed loop.",
        )
        .panel(
            Panel::new(time(), Axis::linear("position", "um"))
                .series(
                    Series::line("measured", &near.time_s, &near.measured_um)
                        .thin()
                        .color(0),
                )
                .series(
                    Series::line("target", &near.time_s, &near.target_um)
                        .thin()
                        .color(1),
                ),
        )
        .panel(
            Panel::new(time(), Axis::linear("PZT", "um"))
                .series(Series::step("command", &near.time_s, &near.command_um).color(2)),
        )
        .share_x(),
    );
}

fn spectrum(page: &mut Report, ticks: &Ticks, meta: Option<&RunMeta>) {
    page.section("Spectrum of the error");
    let Some(spectrum) = ticks.error_um.spectrum(ticks.period_s()) else {
        page.paragraph("The run is too short for a spectrum.");
        return;
    };
    let mut panel = Panel::new(
        Axis::log("frequency", "Hz"),
        Axis::log("density", "nm/rtHz"),
    )
    .series(Series::line("measured", &spectrum.hz, &spectrum.nm_per_rthz).color(0));
    let mut caption = "Amplitude density of the measured error, one-sided.".to_string();
    if let Some(predicted) = predicted(meta, ticks, &spectrum.hz) {
        panel = panel.series(
            Series::line("predicted", &spectrum.hz, &predicted)
                .dashed()
                .color(1),
        );
        caption.push_str(
            " Dashed: what the linear model of this loop predicts for a hold, from Brownian motion and the localisation noise that \
             vision stated.",
        );
    }
    page.figure(Figure::new("error-spectrum", &caption).panel(panel));
}

/// The spectrum that the run's own set-up predicts; none where it cannot be set up again, or the target moves.
fn predicted(meta: Option<&RunMeta>, ticks: &Ticks, hz: &[f64]) -> Option<Vec<f64>> {
    let meta = meta.filter(|_| !ticks.target_moves)?;
    let diffusion = cellpos_session::recorded::diffusion_of_run_um2_per_s(meta)?;
    let setup = cellpos_session::recorded::setup_of(meta, "run.toml").ok()?;
    let predicted = setup.predicted_density(diffusion, hz)?;
    Some(predicted.with_noise_nm(ticks.noise_um() * 1e3))
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
