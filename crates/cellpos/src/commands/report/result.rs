//! The answer on the first screen: one sentence and one figure.

use super::Session;
use super::bound::Bound;
use super::ticks::Ticks;
use cellpos_report::{Axis, Emphasis, Figure, Panel, Report, Series};
use cellpos_script::{ArmKind, AtRest, CycleRow, Trend, trend};
use cellpos_session::connect::ENDED;

/// Adds the sentence, and the figure unless the cycles of a cell have one; returns the sentence.
pub(super) fn section(
    page: &mut Report,
    sessions: &[Session],
    ticks: &Ticks,
    rows: &[CycleRow],
    bound: Option<&Bound>,
) -> String {
    let (status, ended) = ending(sessions);
    let (lost, without) = (
        counted(sessions, "frames_lost"),
        counted(sessions, "fixes_lost"),
    );
    let mut sentence = of_a_cell(rows)
        .or_else(|| of_waves(rows))
        .or_else(|| of_cycles(rows))
        .or_else(|| of_a_hold(ticks, bound))
        .unwrap_or_else(|| {
            "The loop was not closed long enough for an error to be stated.".to_string()
        });
    sentence.push_str(&match lost {
        0 => " No frame was lost.".to_string(),
        1 => " One frame was lost.".to_string(),
        many => format!(" {many} frames were lost."),
    });
    if without > 0 {
        sentence.push_str(&format!(" {without} frames showed no bead."));
    }
    if let Some(ended) = ended {
        sentence.push_str(&format!(" The run did not end as planned: {ended}."));
    }
    page.result(status, &sentence);
    sentence
}

/// Whether the run came to its end, and why not.
fn ending(sessions: &[Session]) -> (Emphasis, Option<String>) {
    let Some(session) = sessions.last() else {
        return (Emphasis::Plain, None);
    };
    match session.meta.as_ref().and_then(|meta| meta.end.as_ref()) {
        Some(end) if end.outcome == "done" => (Emphasis::Good, None),
        Some(end) => {
            let seen = end.summary.get(ENDED).and_then(|ended| ended.get("seen"));
            let seen = seen.and_then(toml::Value::as_str).unwrap_or(&end.outcome);
            (Emphasis::Warning, Some(seen.to_string()))
        }
        None => (
            Emphasis::Bad,
            Some("it was cut off, and reads up to its last flush".to_string()),
        ),
    }
}

/// A count of the summaries, over all sessions.
fn counted(sessions: &[Session], key: &str) -> u64 {
    let count = |session: &Session| {
        let end = session.meta.as_ref()?.end.as_ref()?;
        end.summary.get(key)?.as_integer()
    };
    (sessions.iter().filter_map(count))
        .map(|n| n.max(0) as u64)
        .sum()
}

fn cyclic(rows: &[CycleRow], of: impl Fn(&CycleRow) -> f64) -> Option<Trend> {
    let wanted = rows.iter().filter(|row| {
        row.arm == ArmKind::Cyclic
            && super::fatigue::is_whole(row)
            && !super::cycles::was_elsewhere(row)
    });
    trend(wanted.map(|row| (row.cycle, of(row))))
}

fn change(found: &Trend) -> String {
    format!(
        "from {} to {}",
        super::with_interval(found.first.mean, found.first.ci95),
        super::with_interval(found.last.mean, found.last.ci95)
    )
}

/// A cell over its cycles.
fn of_a_cell(rows: &[CycleRow]) -> Option<String> {
    let rest = AtRest::of(rows);
    let stretch = cyclic(rows, |row| rest.stretch(row))?;
    let mut text = format!(
        "Stretch went {} over {} cycles",
        change(&stretch),
        stretch.cycles
    );
    if let Some(recovery) = cyclic(rows, |row| row.recovery_s) {
        text.push_str(&format!(", recovery time {} s", change(&recovery)));
    }
    text.push_str(&format!(
        " (means of the first and the last {}, with 95 % intervals).",
        stretch.first.cycles
    ));
    Some(text)
}

/// A bead over cycles of waves, each with an amplitude of its own.
fn of_waves(rows: &[CycleRow]) -> Option<String> {
    let reached = cyclic(rows, |row| row.reached_um / row.commanded_um)?;
    let rms = nm(CycleRow::rms_over_um(rows)?);
    Some(format!(
        "{} cycles: {} of the commanded amplitude in the first {}, {} in the last; error {rms} nm RMS over the cycles.",
        reached.cycles,
        super::with_interval(reached.first.mean, reached.first.ci95),
        reached.first.cycles,
        super::with_interval(reached.last.mean, reached.last.ci95),
    ))
}

/// A bead over the cycles of a script. Its steps count, which the error of a hold leaves out.
fn of_cycles(rows: &[CycleRow]) -> Option<String> {
    let rms = nm(CycleRow::rms_over_um(rows)?);
    let disturbed = rows.iter().filter(|row| row.flags.is_disturbed()).count();
    let but = match disturbed {
        0 => String::new(),
        n => format!(", {n} of them disturbed"),
    };
    let cycles = if rows.len() == 1 { "cycle" } else { "cycles" };
    Some(format!(
        "{} {cycles}{but}: error {rms} nm RMS over the cycles, steps included.",
        rows.len()
    ))
}

/// A bead that was held, or moved.
fn of_a_hold(ticks: &Ticks, bound: Option<&Bound>) -> Option<String> {
    let rms_um = ticks.rms_um()?;
    let ci95 = ticks
        .rms_ci95_um()
        .map_or_else(String::new, |um| format!("\u{a0}±\u{a0}{}", nm(um)));
    let long = duration(ticks.duration_s());
    let error = format!("{}{ci95} nm RMS", nm(rms_um));
    Some(match (ticks.target_moves, bound) {
        (true, _) => format!("Followed a moving target with an error of {error}, for {long}."),
        (false, Some(bound)) => format!(
            "Held within {error} where {} nm are possible, for {long}.",
            nm(bound.rms_um)
        ),
        (false, None) => format!("Held within {error}, for {long}."),
    })
}

fn nm(um: f64) -> String {
    let nm = um * 1e3;
    if nm < 10.0 {
        format!("{nm:.1}")
    } else {
        format!("{nm:.0}")
    }
}

/// A time as people say it.
fn duration(s: f64) -> String {
    match s {
        s if s < 120.0 => format!("{s:.0} s"),
        s if s < 7200.0 => format!("{:.1} min", s / 60.0),
        s => format!("{:.1} h", s / 3600.0),
    }
}

/// The error over the run and how it is spread.
pub(super) fn error_figure(ticks: &Ticks, bound: Option<&Bound>) -> Figure {
    let course = ticks.error.course(0);
    let mut over_time = Panel::new(Axis::linear("time", "s"), Axis::linear("error", "nm"));
    let mut caption = "Error of the measured position, target at the exposure taken off, while the loop was closed".to_string();
    if ticks.error.is_bare() {
        over_time = over_time.series(Series::line("error", &course.time_s, &course.median).thin());
    } else {
        over_time = over_time
            .series(
                Series::band(
                    "smallest to largest",
                    &course.time_s,
                    &course.low,
                    &course.high,
                )
                .color(0),
            )
            .series(
                Series::line("median", &course.time_s, &course.median)
                    .color(0)
                    .thin(),
            );
        caption.push_str(", as an envelope with its median");
    }
    if let (Some(bound), false) = (bound, ticks.target_moves) {
        over_time = over_time
            .horizontal(bound.rms_um * 1e3, "lowest possible RMS")
            .horizontal(-bound.rms_um * 1e3, "");
        caption.push_str(&format!(
            "; dotted: the lowest RMS that Brownian motion ({} um2/s), delay and localisation noise allow, {:.1} nm",
            bound.diffusion_um2_per_s,
            bound.rms_um * 1e3
        ));
    }
    caption.push_str(". Right: how often each error occurred.");
    Figure::new("error", &caption)
        .panel(over_time)
        .panel(
            Panel::new(Axis::linear("error", "nm"), Axis::linear("positions", ""))
                .series(ticks.error_nm.histogram("", 60).color(0)),
        )
        .columns(2)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_and_errors_are_said_as_people_say_them() {
        assert_eq!(duration(12.3), "12 s");
        assert_eq!(duration(600.0), "10.0 min");
        assert_eq!(duration(9000.0), "2.5 h");
        assert_eq!((nm(0.058_4).as_str(), nm(0.005_2).as_str()), ("58", "5.2"));
    }

    #[test]
    fn a_cell_is_told_by_its_first_and_last_cycles() {
        let rows: Vec<CycleRow> = (0..40)
            .map(|cycle| {
                let mut row = CycleRow::empty(cycle, 1, ArmKind::Cyclic);
                (row.start_s, row.duration_s) = (cycle as f64, 1.0);
                row.length_start_um = 5.0;
                row.length_peak_um = 5.0 * (3.76 - 0.01 * cycle as f64);
                row.recovery_s = 0.17 + 0.005 * cycle as f64;
                row
            })
            .collect();
        let text = of_a_cell(&rows).unwrap();
        assert!(
            text.contains("3.7") && text.contains("3.4") && text.contains("40 cycles"),
            "{text}"
        );
        assert!(text.contains("recovery time from 0.19"), "{text}");
        assert!(of_a_cell(&[]).is_none());
    }
}
