//! What happened when Safe was latched: the last half second before it, as a picture and in sentences.

use super::Session;
use cellpos_record::{Event, RunReader};
use cellpos_report::{Axis, Column, Emphasis, Figure, Panel, Report, Series, Table};
use cellpos_runtime::{TickFlags, TickRecord};
use cellpos_session::Failure;
use std::collections::VecDeque;

/// How much is shown before Safe, s, and behind it.
const BEFORE_S: f64 = 0.5;
const BEHIND_S: f64 = 0.1;

/// One section for each session that ended in Safe without having been asked to.
pub(super) fn section(page: &mut Report, sessions: &[Session]) -> Result<(), Failure> {
    for session in sessions {
        let Some(safe) = session.events.iter().find(|event| is_fault(event)) else {
            continue;
        };
        let reader = RunReader::open(&session.folder).map_err(Failure::input)?;
        let rows = rows(&reader, safe.time_s)?;
        page.section("What happened");
        let what = text(safe).unwrap_or("Safe was latched.");
        page.note(Emphasis::Bad, what);
        sequence(page, session, safe);
        if !rows.is_empty() {
            page.figure(figure(&rows, session.start_s, safe.time_s));
            page.table(counted(&rows));
        }
    }
    Ok(())
}

fn text(event: &Event) -> Option<&str> {
    event.data.get("text")?.as_str()
}

fn is_fault(event: &Event) -> bool {
    let reason = event.data.get("reason").and_then(|value| value.as_str());
    event.event == "safe-latched" && reason != Some("operator")
}

/// The rows around a time; of a long run only they are kept.
fn rows(reader: &RunReader, at_s: f64) -> Result<Vec<TickRecord>, Failure> {
    let mut kept = VecDeque::new();
    let [from_ns, to_ns] = [at_s - BEFORE_S, at_s + BEHIND_S].map(|s| (s * 1e9) as i64);
    for row in reader.batches().map_err(Failure::input)?.flatten() {
        if (from_ns..=to_ns).contains(&row.time_ns) {
            kept.push_back(row);
        }
    }
    Ok(kept.into())
}

/// The sentences of that time, in their order.
fn sequence(page: &mut Report, session: &Session, safe: &Event) {
    let mut table = Table::new([Column::right("time (s)"), Column::left("what happened")]);
    let span = safe.time_s - BEFORE_S..=safe.time_s + BEHIND_S;
    const MOST: usize = 40;
    let shown: Vec<&Event> = (session.events.iter())
        .filter(|event| span.contains(&event.time_s))
        .collect();
    for event in shown.iter().skip(shown.len().saturating_sub(MOST)) {
        let time = format!("{:.3}", session.start_s + event.time_s);
        table.row([time.as_str(), text(event).unwrap_or(&event.event)]);
    }
    table.caption("Events of the last half second before the PZT began to park.");
    page.table(table);
}

fn figure(rows: &[TickRecord], start_s: f64, safe_s: f64) -> Figure {
    let times_s: Vec<f64> = (rows.iter())
        .map(|row| start_s + row.time_ns as f64 * 1e-9)
        .collect();
    let of = |value: fn(&TickRecord) -> f64| rows.iter().map(value).collect::<Vec<f64>>();
    let time = || Axis::linear("time", "s");
    let at_s = start_s + safe_s;
    let bead = Panel::new(time(), Axis::linear("bead", "um"))
        .series(Series::line("measured", &times_s, &of(|r| r.measured_um)).color(1))
        .series(Series::line("reference", &times_s, &of(|r| r.target_um)).color(0))
        .series(Series::line("estimate", &times_s, &of(|r| r.estimate_um)).color(4))
        .vertical(at_s, "safe");
    let pzt = Panel::new(time(), Axis::linear("PZT", "um"))
        .series(Series::line("command", &times_s, &of(|r| r.command_um)).color(2))
        .series(Series::line("reported by the board", &times_s, &of(|r| r.applied_um)).color(3))
        .vertical(at_s, "safe");
    let late = Panel::new(time(), Axis::linear("wake-up, computing", "us"))
        .series(Series::line("wake-up", &times_s, &of(|r| r.wake_ns as f64 * 1e-3)).color(1))
        .series(Series::line("computing", &times_s, &of(|r| r.compute_ns as f64 * 1e-3)).color(2))
        .vertical(at_s, "safe");
    Figure::new(
        "fault",
        "Half a second before Safe and what followed: where the measured line is broken there was no position.",
    )
    .panel(bead)
    .panel(pzt)
    .panel(late)
    .share_x()
}

/// Which limit, which frames, which stage, in numbers.
fn counted(rows: &[TickRecord]) -> Table {
    let count = |is: &dyn Fn(&TickRecord) -> bool| rows.iter().filter(|row| is(row)).count();
    let flagged = |flag: u32| count(&|row| row.flags.has(flag));
    let steps: u64 = rows
        .windows(2)
        .map(|pair| (pair[1].seq - pair[0].seq).saturating_sub(1))
        .sum();
    let largest = |value: fn(&TickRecord) -> u32| {
        let most = rows.iter().map(value).max().unwrap_or(0);
        format!("{:.0} us", f64::from(most) * 1e-3)
    };
    let mut table = Table::key_values(&[
        ("ticks", rows.len().to_string()),
        ("rows missing", steps.to_string()),
        (
            "without a position",
            count(&|row| !row.measured_um.is_finite()).to_string(),
        ),
        ("on prediction", flagged(TickFlags::COASTING).to_string()),
        (
            "with a frame too old",
            flagged(TickFlags::STALE).to_string(),
        ),
        ("late", flagged(TickFlags::LATE).to_string()),
        ("longest wake-up", largest(|row| row.wake_ns)),
        ("longest computing", largest(|row| row.compute_ns)),
    ]);
    table.caption("Of these ticks.");
    table
}
