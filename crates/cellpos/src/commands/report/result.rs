//! The answer on the first screen: one sentence and one figure.

use super::Session;
use super::bound::Bound;
use super::origin;
use super::ticks::Ticks;
use super::traces;
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
    learned: Option<(f64, f64)>,
) -> String {
    let (status, ended) = ending(sessions);
    let what = origin::subject(sessions.iter().find_map(|session| session.meta.as_ref()));
    let (lost, without) = (
        counted(sessions, "frames_lost"),
        counted(sessions, "fixes_lost"),
    );
    let mut sentence = of_a_cell(rows)
        .or_else(|| of_waves(rows, what))
        .or_else(|| of_cycles(rows, what))
        .or_else(|| of_a_hold(ticks, bound, what, ended.is_none()))
        .unwrap_or_else(|| {
            "The loop was not closed long enough for an error to be stated.".to_string()
        });
    if let Some((before_um, after_um)) = learned {
        sentence.push_str(&format!(
            " With learning: {} nm over the first few cycles, {} nm over the last few.",
            nm(before_um),
            nm(after_um)
        ));
    }
    sentence.push_str(&match lost {
        0 => " No frame was lost.".to_string(),
        1 => " One frame was lost.".to_string(),
        many => format!(" {many} frames were lost."),
    });
    if without > 0 {
        sentence.push_str(&format!(" {without} frames showed no {what}."));
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
    let Some(stretch) = cyclic(rows, |row| rest.stretch(row)) else {
        return of_few_cycles(rows, &rest);
    };
    let mut text = format!(
        "The cell's stretch (largest length over that at rest) went {} over {} cycles",
        change(&stretch),
        stretch.cycles
    );
    if let Some(recovery) = cyclic(rows, |row| row.recovery_s) {
        text.push_str(&format!(", its recovery time {} s", change(&recovery)));
    }
    text.push_str(&format!(
        " (means of the first and the last {}, with 95 % intervals).",
        stretch.first.cycles
    ));
    Some(text)
}

/// A cell over too few cycles for an interval.
fn of_few_cycles(rows: &[CycleRow], rest: &AtRest) -> Option<String> {
    let stretches: Vec<f64> = (rows.iter())
        .filter(super::fatigue::is_whole)
        .filter(|row| !super::cycles::was_elsewhere(row))
        .map(|row| rest.stretch(row))
        .filter(|stretch| stretch.is_finite())
        .collect();
    let (first, last) = (stretches.first()?, stretches.last()?);
    Some(format!(
        "The cell's stretch (largest length over that at rest) was {first:.3} in the first and {last:.3} in the last of {} cycles: too few \
         for an interval.",
        stretches.len()
    ))
}

/// A bead over cycles of waves, each with an amplitude of its own.
fn of_waves(rows: &[CycleRow], what: &str) -> Option<String> {
    let reached = cyclic(rows, |row| row.reached_um / row.commanded_um)?;
    let rms = nm(CycleRow::rms_over_um(rows)?);
    Some(format!(
        "The {what} reached {} of the commanded amplitude in the first {} of {} cycles, and {} in the last (means with 95 % intervals). \
         Error: {rms} nm RMS over the cycles.",
        super::with_interval(reached.first.mean, reached.first.ci95),
        reached.first.cycles,
        reached.cycles,
        super::with_interval(reached.last.mean, reached.last.ci95),
    ))
}

/// A bead over the cycles of a script. Its steps count, which the error of a hold leaves out.
fn of_cycles(rows: &[CycleRow], what: &str) -> Option<String> {
    let rms = nm(CycleRow::rms_over_um(rows)?);
    let disturbed = rows.iter().filter(|row| row.flags.is_disturbed()).count();
    let but = match disturbed {
        0 => String::new(),
        n => format!(", {n} of them disturbed"),
    };
    let cycles = if rows.len() == 1 { "cycle" } else { "cycles" };
    Some(format!(
        "The {what} went through {} {cycles}{but}, with an error of {rms} nm RMS over the cycles, steps included.",
        rows.len()
    ))
}

/// A bead that was held, or moved.
fn of_a_hold(ticks: &Ticks, bound: Option<&Bound>, what: &str, kept: bool) -> Option<String> {
    let rms_um = ticks.rms_um()?;
    let error = match ticks.rms_ci95_um() {
        Some(ci95_um) => format!(
            "{} nm RMS (95 % interval)",
            super::with_interval(1e3 * rms_um, 1e3 * ci95_um)
        ),
        None => format!("{} nm RMS", nm(rms_um)),
    };
    let long = duration(ticks.duration_s());
    let possible = bound.map_or_else(String::new, |bound| {
        format!("; the lowest possible is {:.1} nm", bound.rms_um * 1e3)
    });
    Some(match ticks.motion_rms_um() {
        Some(motion_um) if rms_um < motion_um => format!(
            "The {what} followed its moving target for {long} with an error of {error}, {:.1} % of the motion.",
            1e2 * rms_um / motion_um
        ),
        Some(_) => format!("The {what} did not follow its moving target: error {error} in {long}."),
        None if kept => {
            format!(
                "The {what} stayed at its target for {long} with an error of {error}{possible}."
            )
        }
        None => format!("The {what} was to stay at its target: error {error} in {long}{possible}."),
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

/// The error over the run; beside it how it is spread, or the motion.
pub(super) fn error_figure(ticks: &Ticks, bound: Option<&Bound>, of_a_script: bool) -> Figure {
    let course = ticks.error.course(0);
    let mut over_time = Panel::new(Axis::linear("time", "s"), Axis::linear("error", "nm"));
    let mut caption = "Error: measured position less the target at the time of its exposure, from two seconds after the loop was closed".to_string();
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
        caption.push_str(" (envelope and median)");
    }
    if ticks.motion_rms_um().is_some() {
        let motion = if of_a_script {
            caption.push_str(". Left: position and target over the whole run.");
            traces::position(ticks)
        } else {
            let end = ticks.last_periods(3.0);
            caption.push_str(
                ". Left: measured position at the end of the run, and the target at the time of each exposure.",
            );
            Panel::new(Axis::linear("time", "s"), Axis::linear("position", "um"))
                .series(Series::line("target", &end.time_s, &end.target_um).color(1))
                .series(
                    Series::points("measured", &end.time_s, &end.measured_um)
                        .color(0)
                        .thin(),
                )
        };
        return Figure::new("error", &caption)
            .panel(motion)
            .panel(over_time)
            .columns(2);
    }
    if let Some(bound) = bound {
        let [low, high] = [-1e3, 1e3].map(|sign| [sign * bound.rms_um; 2]);
        let ends = [0.0, ticks.end_s()];
        let line = |name: &str, at: &[f64; 2]| Series::line(name, &ends, at).dashed().color(1);
        over_time = over_time
            .series(line("lowest possible RMS", &high))
            .series(line("", &low));
        caption.push_str(&format!(
            "; dashed: the lowest RMS that Brownian motion ({} um2/s), delay and localisation noise allow, {:.1} nm",
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
