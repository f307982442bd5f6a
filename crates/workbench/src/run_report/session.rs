//! The sessions of a run: timing, events, origin.

use super::ticks::Ticks;
use cellpos_record::{Lost, RunMeta};
use cellpos_report::{Axis, Column, Emphasis, Figure, Panel, Report, Table};
use cellpos_session::words::of_what_is_followed;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A session as it was read.
pub(super) struct Session {
    pub(super) folder: PathBuf,
    pub(super) meta: Option<RunMeta>,
    /// Whether a cell was followed, not a bead.
    pub(super) of_a_cell: bool,
    pub(super) lost: Lost,
    pub(super) events: Vec<cellpos_record::Event>,
    /// Start since the start of the run, s.
    pub(super) start_s: f64,
}

pub(super) fn timing(page: &mut Report, ticks: &Ticks) {
    page.section("Loop timing");
    if ticks.compute_us.is_empty() {
        page.paragraph("Virtual clock: ticks take no time.");
    } else {
        page.figure(
            Figure::new(
                "timing",
                "Wake-up of every tick behind its due time, and the time in which it was computed; a bin is a twelfth of a decade.",
            )
            .panel(
                Panel::new(Axis::log("time", "us"), Axis::log("ticks", ""))
                    .series(ticks.wake_us.steps("wake-up"))
                    .series(ticks.compute_us.steps("computing")),
            ),
        );
    }
}

/// The figures of the first and the last session, as run.toml has them.
pub(super) fn figures(page: &mut Report, sessions: &[Session]) {
    for (number, session) in ends(sessions) {
        let end = session.meta.as_ref().and_then(|meta| meta.end.as_ref());
        if let Some(end) = end.filter(|end| !end.summary.is_empty()) {
            page.subsection(&format!("Figures of session {number}"));
            page.verbatim(&toml::to_string(&end.summary).unwrap_or_default());
        }
    }
}

pub(super) fn events(page: &mut Report, sessions: &[Session]) {
    const MOST: usize = 200;
    page.section("Events");
    let mut counts: BTreeMap<&str, u64> = BTreeMap::new();
    for event in sessions.iter().flat_map(|session| &session.events) {
        *counts.entry(event.event.as_str()).or_default() += 1;
    }
    let mut table = Table::new([Column::left("event"), Column::right("how often")]);
    for (name, count) in &counts {
        table.row([*name, &count.to_string()]);
    }
    page.table(table);
    // Frequent events are only in events.jsonl.
    let daily = |name: &str| counts.get(name).is_some_and(|count| *count > 50);
    let mut table = Table::new([
        Column::right("time (s)"),
        Column::left("event"),
        Column::left("what happened"),
    ]);
    let mut left_out = 0;
    let mut shown = 0;
    for session in sessions {
        for event in session.events.iter().filter(|event| !daily(&event.event)) {
            if shown == MOST {
                left_out += 1;
                continue;
            }
            shown += 1;
            // Runs of older versions have no sentences.
            let data = match event.data.get("text").and_then(|text| text.as_str()) {
                Some(text) => text.to_owned(),
                None => serde_json::to_string(&event.data).unwrap_or_default(),
            };
            let data = match event.event.as_str() {
                // What a person wrote stays as it was written.
                "note" | "mark" => data,
                _ => of_what_is_followed(&data, session.of_a_cell),
            };
            let time = format!("{:.3}", session.start_s + event.time_s);
            table.row([time.as_str(), &event.event, &data]);
        }
    }
    table.caption(&format!(
        "Events that happened at most 50 times; {left_out} more are in events.jsonl."
    ));
    page.table(table);
}

pub(super) fn provenance(page: &mut Report, sessions: &[Session]) {
    page.subsection("Inputs");
    let mut table = Table::new([
        Column::left("input"),
        Column::right("bytes"),
        Column::left("SHA-256"),
    ]);
    let metas = sessions.iter().filter_map(|session| session.meta.as_ref());
    let inputs: Vec<_> = metas.flat_map(|meta| &meta.inputs).collect();
    for input in &inputs {
        table.row([input.path.as_str(), &input.bytes.to_string(), &input.sha256]);
    }
    if inputs.is_empty() {
        page.paragraph("No file went into this run.");
    } else {
        page.table(table);
    }
    for (_, session) in ends(sessions) {
        page.subsection(&folder_name(&session.folder));
        let path = session.folder.join(cellpos_record::RUN_TOML);
        match std::fs::read_to_string(&path) {
            Ok(text) => page.verbatim(&text),
            Err(error) => page.note(Emphasis::Bad, &format!("{}: {error}", path.display())),
        };
    }
}

/// The sessions that are shown in full, with their numbers: the first and the last.
pub(super) fn ends(sessions: &[Session]) -> impl Iterator<Item = (usize, &Session)> {
    let last = sessions.len();
    let shown = move |(number, _): &(usize, &Session)| *number == 1 || *number == last;
    (1..).zip(sessions).filter(shown)
}

pub(super) fn folder_name(folder: &Path) -> String {
    folder
        .file_name()
        .map_or_else(|| "run".to_string(), |name| name.to_string_lossy().into())
}

/// How a session ended.
pub(super) fn ending(session: &Session) -> (Emphasis, String) {
    match session.meta.as_ref().and_then(|meta| meta.end.as_ref()) {
        Some(end) if end.outcome == "done" => (Emphasis::Good, "came to its end".to_string()),
        Some(end) => (Emphasis::Warning, format!("ended: {}", end.outcome)),
        None => (
            Emphasis::Bad,
            "has no end: its program was killed, or the power failed".to_string(),
        ),
    }
}
