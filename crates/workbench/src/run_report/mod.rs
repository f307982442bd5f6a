//! Pages of recorded runs: [`one`] run with all its sessions, several [`compared`].

mod bound;
mod clips;
mod compare;
mod course;
mod cycles;
mod disturbed;
mod envelope;
mod error_figure;
mod fatigue;
mod fault;
mod montage;
mod origin;
mod recorded;
mod result;
mod session;
mod spectrum;
mod spread;
mod ticks;
mod traces;
mod unused;

use cellpos_record::{RunEnd, RunReader};
use cellpos_report::{Column, Emphasis, Report, Table};
use cellpos_runtime::Summary;
use cellpos_runtime::summary::plan_warning;
use cellpos_script::CycleRow;
use cellpos_session::Failure;
use cellpos_session::cyclic::{NamedTable, load_learned};
pub use compare::compared;
pub use cycles::{half95, was_elsewhere};
pub use fatigue::{OF_LENGTH, length_between};
use origin::what_it_was;
use recorded::Recorded;
use serde::Serialize;
use session::{Session, ending, events, provenance, timing};
use std::path::{Path, PathBuf};
use ticks::Ticks;
use traces::{over_the_run, spectrum, traces};

/// On what a run was made; nothing if its folder does not say.
pub fn rig_of(run: &Path) -> &'static str {
    let reader = RunReader::open(run).ok();
    let meta = reader.as_ref().and_then(|reader| reader.meta().ok());
    meta.map_or("", origin::rig)
}

/// A page that was written.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Written<T: Serialize> {
    /// The page.
    pub out: PathBuf,
    /// Its first sentence: the result.
    pub result: String,
    /// What else it says, as JSON.
    #[serde(flatten)]
    pub figures: T,
}

/// Figures of the page of one run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FiguresOfOne {
    /// Sessions of the run.
    pub sessions: usize,
    /// Ticks in all.
    pub ticks: u64,
    /// Cycles in all.
    pub cycles: usize,
    /// Measured error, RMS, nm.
    pub rms_nm: Option<f64>,
    /// What is physically possible, nm.
    pub bound_rms_nm: Option<f64>,
    /// Trends over the cycles.
    pub trends: serde_json::Value,
}

/// Writes the page of one run; without `out`, report.html in its folder.
///
/// # Errors
/// A folder that holds no run, records that cannot be read, a page that cannot be written.
pub fn one(run: &Path, out: Option<&Path>) -> Result<Written<FiguresOfOne>, Failure> {
    let recorded = Recorded::open(run)?;
    let (sessions, ticks, cycles) = (&recorded.sessions, &recorded.ticks, &recorded.cycles);
    let (meta, name) = (recorded.first.meta().ok(), recorded.name());
    let mut page = Report::new(&format!("Run {name}"));
    if let Some(meta) = meta {
        page.lead(&origin::lead(meta, &cycles.rows));
    }
    let bound =
        bound::Bound::of(&recorded.first, ticks).and_then(|bound| bound.unbeaten(ticks, &mut page));
    let motions = load_learned(run);
    let gain = match motions.as_slice() {
        [one] => one.table.error_before_um.zip(one.table.error_after_um),
        _ => None,
    };
    let sentence = result::section(
        &mut page,
        sessions,
        ticks,
        &cycles.rows,
        bound.as_ref(),
        gain,
    );
    let of_a_cell = fatigue::figure(&cycles.rows).filter(|_| ticks.has_length);
    let is_cell = of_a_cell.is_some();
    let has_error = ticks.rms_um().is_some();
    page.figure(match of_a_cell {
        Some(figure) => figure,
        None if has_error => error_figure::error_figure(ticks, bound.as_ref(), &cycles.rows),
        // A run without an error still shows what happened.
        None => over_the_run(ticks),
    });
    if is_cell && let Some(montage) = montage::figure(sessions, &cycles.rows) {
        page.figure(montage);
    }
    head(&mut page, sessions, ticks, &cycles.rows);
    traces(&mut page, ticks, is_cell || has_error);
    if is_cell && has_error {
        page.section("Error");
        page.figure(error_figure::error_figure(
            ticks,
            bound.as_ref(),
            &cycles.rows,
        ));
    }
    spectrum(&mut page, ticks, meta);
    let trends = cycles::section(&mut page, cycles, is_cell);
    fatigue::section(&mut page, &cycles.rows, ticks);
    learned(&mut page, &motions);
    timing(&mut page, ticks);
    fault::section(&mut page, sessions)?;
    clips::section(&mut page, sessions);
    events(&mut page, sessions);
    page.section("What was run");
    what_it_was(&mut page, sessions);
    if let Some(notes) = notes(&recorded.first) {
        page.paragraph(&notes);
    }
    page.fold("Figures, configuration and provenance in full");
    session::figures(&mut page, sessions);
    provenance(&mut page, sessions);
    page.unfold();
    Ok(Written {
        out: write(
            &page,
            out.map_or_else(|| run.join("report.html"), Path::to_owned),
        )?,
        result: sentence,
        figures: FiguresOfOne {
            sessions: sessions.len(),
            ticks: ticks.rows,
            cycles: cycles.rows.len(),
            rms_nm: ticks.rms_um().map(|um| um * 1e3),
            bound_rms_nm: bound.as_ref().map(|bound| bound.rms_um * 1e3),
            trends,
        },
    })
}

/// Writes a page and the files of its figures.
fn write(page: &Report, out: PathBuf) -> Result<PathBuf, Failure> {
    page.write_with_figures(&out)
        .map_err(|error| Failure::bad_input(error, "name a page that you may write with --out"))?;
    Ok(out)
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

fn head(page: &mut Report, sessions: &[Session], ticks: &Ticks, cycles: &[CycleRow]) {
    if let Some(last) = sessions.last() {
        let (status, text) = ending(last);
        // The result says how a run of one session ended.
        if let many @ 2.. = sessions.len() {
            page.note(status, &format!("The last of {many} sessions {text}."));
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
    let mut rows = vec![
        ("ticks", ticks.rows.to_string()),
        ("duration (s)", format!("{:.3}", ticks.duration_s())),
    ];
    if let Some(error) = result::cycles_error(cycles) {
        rows.push(("error over the cycles, RMS (nm)", error));
    }
    rows.extend([
        ("error after two seconds, RMS (nm)", nm(ticks.rms_um())),
        ("its mean (nm)", nm(ticks.mean_um())),
        ("its largest (nm)", nm(ticks.peak_um())),
    ]);
    let mut table = Table::key_values(&rows);
    table.caption(
        "Errors: measured position less the reference of the time of its exposure. After two seconds: from two seconds after the loop \
         was closed (or went on after a freeze) until the bead was frozen or the PZT parked; the same as the terminal and run.toml have.",
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

fn learned(page: &mut Report, motions: &[NamedTable]) {
    if motions.is_empty() {
        return;
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
    for motion in motions {
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
}
