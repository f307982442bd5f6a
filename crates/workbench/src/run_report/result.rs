//! The answer on the first screen: one sentence and one figure.

use super::Session;
use super::bound::Bound;
use super::disturbed;
use super::error_figure::{mean, motions};
use super::origin;
use super::ticks::Ticks;
use cellpos_report::{Emphasis, Report, with_interval};
use cellpos_script::{ArmKind, AtRest, CycleFlags, CycleRow, Trend, trend};
use cellpos_session::connect::ENDED;

/// Two errors that are known to a fifth each differ by chance by up to this share of one of them.
const LEARNED: f64 = 0.3;

/// What came out, and how sure it is.
pub(super) struct Said {
    pub(super) result: String,
    sure: String,
    /// Why the numbers may be wrong.
    doubt: Option<String>,
}

/// Adds the sentences, and the figure unless the cycles of a cell have one; returns the result's.
pub(super) fn section(
    page: &mut Report,
    sessions: &[Session],
    ticks: &Ticks,
    rows: &[CycleRow],
    bound: Option<&Bound>,
    learned: Option<(f64, f64)>,
) -> String {
    let (mut status, ended) = ending(sessions);
    let kept = ended.is_none();
    let what = origin::subject(sessions.iter().find_map(|session| session.meta.as_ref()));
    let lost = counted(sessions, "frames_lost");
    let Said {
        mut result,
        mut sure,
        doubt,
    } = of_a_cell(rows)
        .or_else(|| of_waves(rows, bound, what))
        .or_else(|| of_cycles(rows, bound, what))
        .or_else(|| of_a_hold(ticks, bound, what, kept))
        .unwrap_or_else(|| Said {
            result: "The loop was not closed long enough for an error to be stated.".to_string(),
            sure: "no error was measured. What happened is in the record, and below.".to_string(),
            doubt: None,
        });
    if let Some(doubt) = doubt {
        result.push_str(&format!(" {doubt}"));
        if status == Emphasis::Good {
            status = Emphasis::Warning;
        }
    }
    // How it ended comes first: the error is then that of a part.
    if let Some(ended) = ended {
        result.insert_str(0, &format!("The run did not end as planned: {ended}. "));
    }
    if let Some((before_um, after_um)) = learned {
        let (before, after) = (nm(before_um), nm(after_um));
        result.push_str(&match (after_um / before_um - 1.0).abs() < LEARNED {
            true => format!(" Learning changed it by no more than chance ({before} nm at first, {after} nm at last)."),
            false => format!(" Learning brought it from {before} nm at first to {after} nm at last."),
        });
        sure.push_str(
            " The two errors of learning are of two cycles or so, and known to some 20 % each.",
        );
    }
    result.push_str(&match lost {
        0 => " No frame is missing.".to_string(),
        1 => " One frame is missing.".to_string(),
        many => format!(" {many} frames are missing."),
    });
    result.push_str(&ticks.unused.sentence(what));
    page.result(status, &result);
    page.certainty(&sure);
    result
}

/// What the lowest possible error is, and that it is calculated.
fn of_bound(bound: &Bound) -> String {
    format!(
        " The lowest possible is calculated: what Brownian motion ({:.2} um2/s) does within the delay of the loop.",
        bound.diffusion_um2_per_s
    )
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
            Some(
                "its record has no end, because its program was killed or the power failed; what was written before is shown"
                    .to_string(),
            ),
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
        with_interval(found.first.mean, found.first.ci95),
        with_interval(found.last.mean, found.last.ci95)
    )
}

/// The change in percent, or that it is no more than chance.
fn percent(found: &Trend) -> String {
    let (first, last) = (&found.first, &found.last);
    if (last.mean - first.mean).abs() <= first.ci95.hypot(last.ci95) {
        return " (no more than chance)".to_string();
    }
    format!(" ({:+.1} %)", 100.0 * (last.mean / first.mean - 1.0)).replace('-', "\u{2212}")
}

/// A cell over its cycles.
fn of_a_cell(rows: &[CycleRow]) -> Option<Said> {
    let rest = AtRest::of(rows);
    let Some(stretch) = cyclic(rows, |row| rest.stretch(row)) else {
        return of_few_cycles(rows, &rest);
    };
    let mut text = format!(
        "The cell's stretch (largest length over the {} um at rest) went {}{} over {} cycles{} (means of the first and the last {})",
        at_rest(&rest),
        change(&stretch),
        percent(&stretch),
        stretch.cycles,
        disturbed::counted(rows.iter().filter(super::fatigue::is_whole)),
        stretch.first.cycles
    );
    if let Some(recovery) = cyclic(rows, |row| row.recovery_s) {
        text.push_str(&format!(
            ", the time constant of its recovery {} s{}",
            change(&recovery),
            percent(&recovery)
        ));
    }
    text.push('.');
    if let Some(fixed) = trend(under_load(rows).map(|row| (row.cycle, rest.stretch(row)))) {
        text.push_str(&format!(
            " Held under a static load: stretch {}{}.",
            change(&fixed),
            percent(&fixed)
        ));
    }
    let mut sure = format!(
        "each number is a mean of the first or the last {} cycles; \u{b1} is its 95 % interval, from the scatter of these cycles about a \
         straight line.",
        stretch.first.cycles
    );
    sure.push_str(&sure_of_rest(&rest));
    sure.push_str(" One cell does not tell how cells differ.");
    let doubt = of_stretch_in_doubt(rows, &rest);
    Some(Said {
        result: text,
        sure,
        doubt,
    })
}

/// The length at rest with its 95 % interval, um.
fn at_rest(rest: &AtRest) -> String {
    match rest.stretch_ci95() {
        share if share.is_finite() => with_interval(rest.length_um, share * rest.length_um),
        _ => format!("{:.2}", rest.length_um),
    }
}

/// How sure the length at rest is: the same for every stretch of the run.
fn sure_of_rest(rest: &AtRest) -> String {
    match 100.0 * rest.stretch_ci95() {
        of_rest if of_rest.is_finite() => {
            format!(" The length at rest is known to {of_rest:.2} %, alike for every stretch.")
        }
        _ => " How sure the length at rest is was not measured.".to_string(),
    }
}

/// Stretches of time of the static arm, its way to the load and back left out.
fn under_load(rows: &[CycleRow]) -> impl Iterator<Item = &CycleRow> {
    let wanted = |row: &&CycleRow| row.arm == ArmKind::Static && !super::cycles::on_the_way(row);
    rows.iter()
        .filter(wanted)
        .filter(|row| !row.flags.has(CycleFlags::SKIPPED))
}

/// A cell over too few cycles for an interval.
fn of_few_cycles(rows: &[CycleRow], rest: &AtRest) -> Option<Said> {
    let stretches: Vec<f64> = (rows.iter())
        .filter(super::fatigue::is_whole)
        .filter(|row| !super::cycles::was_elsewhere(row))
        .map(|row| rest.stretch(row))
        .filter(|stretch| stretch.is_finite())
        .collect();
    let (first, last) = (stretches.first()?, stretches.last()?);
    Some(Said {
        result: format!(
            "The cell's stretch (largest length over the {} um at rest) was {first:.3} in the first and {last:.3} in the last of {} cycles{}.",
            at_rest(rest),
            stretches.len(),
            disturbed::counted(rows.iter().filter(super::fatigue::is_whole))
        ),
        sure: format!("so few cycles have no interval.{}", sure_of_rest(rest)),
        doubt: of_stretch_in_doubt(rows, rest),
    })
}

/// Whether disturbed cycles put the stretch in doubt.
fn of_stretch_in_doubt(rows: &[CycleRow], rest: &AtRest) -> Option<String> {
    let counted = rows.iter().filter(super::fatigue::is_whole);
    let counted =
        counted.filter(|row| row.arm == ArmKind::Cyclic && !super::cycles::was_elsewhere(row));
    disturbed::doubt("the stretch", counted, |row| rest.stretch(row))
}

/// RMS error over cycles with half its 95 % interval, nm.
fn over_cycles(rows: &[CycleRow]) -> Option<String> {
    let rms_nm = 1e3 * CycleRow::rms_over_um(rows)?;
    let squares: Vec<f64> = (rows.iter().map(|row| 1e6 * row.rms_um * row.rms_um))
        .filter(|square| square.is_finite())
        .collect();
    let half_nm = super::half95(&squares) / (2.0 * rms_nm);
    Some(with_interval(rms_nm, half_nm))
}

/// What the error over cycles is, for [`super::head`].
pub(super) fn cycles_error(rows: &[CycleRow]) -> Option<String> {
    (!rows.is_empty()).then(|| over_cycles(rows)).flatten()
}

/// How sure an error over cycles is.
fn sure_of_cycles(bound: Option<&Bound>) -> String {
    format!(
        "\u{b1} is the 95 % interval, from the scatter between the cycles of this one run. The error is of all cycles, from the first \
         frame of each to its last, and has the noise of the camera in it.{}",
        bound.map_or_else(String::new, of_bound)
    )
}

fn possible(bound: Option<&Bound>) -> String {
    bound.map_or_else(String::new, |bound| {
        format!("; the lowest possible is {:.1} nm", bound.rms_um * 1e3)
    })
}

/// A bead over cycles of waves, each with an amplitude of its own.
fn of_waves(rows: &[CycleRow], bound: Option<&Bound>, what: &str) -> Option<Said> {
    /// More amplitudes than this are in the figure alone.
    const SAID: usize = 5;
    let reached = motions(rows);
    let error = over_cycles(rows)?;
    let cycles: usize = reached.iter().map(|(_, values)| values.len()).sum();
    let said: Vec<String> = (reached.iter())
        .map(|(um, values)| {
            let share = with_interval(100.0 * mean(values), 100.0 * super::half95(values));
            format!("{share} % of {} um", super::cycles::short(*um))
        })
        .collect();
    let shares = match said.as_slice() {
        [] => return None,
        [one] => format!("The {what} reached {one}, its commanded amplitude"),
        some if some.len() <= SAID => {
            format!(
                "Of its commanded amplitudes the {what} reached {}",
                some.join(", ")
            )
        }
        some => format!(
            "Of its {} commanded amplitudes the {what} reached {} to {}",
            some.len(),
            some[0],
            some[some.len() - 1]
        ),
    };
    let counted = |row: &&CycleRow| {
        super::fatigue::is_whole(row)
            && !super::cycles::was_elsewhere(row)
            && (row.reached_um / row.commanded_um).is_finite()
    };
    let but = disturbed::counted(rows.iter().filter(counted));
    Some(Said {
        result: format!(
            "{shares} (means of {cycles} cycles{but}). Error: {error} nm RMS{}.",
            possible(bound)
        ),
        sure: sure_of_cycles(bound),
        doubt: disturbed::doubt(
            "the share of the amplitude that was reached",
            rows.iter().filter(counted),
            |row| row.reached_um / row.commanded_um,
        ),
    })
}

/// A bead over the cycles of a script. Its steps count, which the error of a hold leaves out.
fn of_cycles(rows: &[CycleRow], bound: Option<&Bound>, what: &str) -> Option<Said> {
    let error = over_cycles(rows)?;
    let but = disturbed::counted(rows.iter());
    let cycles = if rows.len() == 1 { "cycle" } else { "cycles" };
    Some(Said {
        result: format!(
            "The {what} went through {} {cycles}{but}, with an error of {error} nm RMS over the cycles, steps included{}.",
            rows.len(),
            possible(bound)
        ),
        sure: sure_of_cycles(bound),
        doubt: disturbed::doubt("the mean of the cycles' errors in nm", rows.iter(), |row| {
            1e3 * row.rms_um
        }),
    })
}

/// A bead that was held, or moved.
fn of_a_hold(ticks: &Ticks, bound: Option<&Bound>, what: &str, kept: bool) -> Option<Said> {
    let rms_um = ticks.rms_um()?;
    let (error, of_interval) = match ticks.rms_ci95_um() {
        Some(ci95_um) => (
            with_interval(1e3 * rms_um, 1e3 * ci95_um) + " nm RMS",
            "\u{b1} is the 95 % interval of the error in this one run, from its scatter over time. ",
        ),
        None => (format!("{} nm RMS", nm(rms_um)), ""),
    };
    let long = duration(ticks.counted_s());
    let possible = possible(bound);
    let result = match ticks.motion_rms_um() {
        Some(motion_um) if rms_um < motion_um => format!(
            "The {what} followed its moving target with an error of {error} ({:.1} % of the RMS of the motion) over {long}{possible}.",
            1e2 * rms_um / motion_um
        ),
        Some(_) => format!(
            "The {what} did not follow its moving target: error {error} over {long}{possible}."
        ),
        None if kept => {
            format!(
                "The {what} stayed at its target with an error of {error} over {long}{possible}."
            )
        }
        None => {
            format!("The {what} was to stay at its target: error {error} over {long}{possible}.")
        }
    };
    let noise_nm = 1e3 * ticks.noise_um();
    let noise = match noise_nm > 0.0 {
        true => format!(", with the camera's noise of {noise_nm:.0} nm in it"),
        false => String::new(),
    };
    let sure = format!(
        "{of_interval}The error is that of the measured position{noise}, from two seconds after the loop was closed.{}",
        bound.map_or_else(String::new, of_bound)
    );
    Some(Said {
        result,
        sure,
        doubt: None,
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
        let text = of_a_cell(&rows).unwrap().result;
        assert!(
            text.contains("3.7") && text.contains("3.4") && text.contains("40 cycles"),
            "{text}"
        );
        assert!(
            text.contains("time constant of its recovery from 0.19"),
            "{text}"
        );
        assert!(of_a_cell(&[]).is_none());
    }

    #[test]
    fn a_bead_whose_cycles_were_disturbed_says_so_beside_their_number() {
        let rows: Vec<CycleRow> = (0..8)
            .map(|cycle| {
                let mut row = CycleRow::empty(cycle, 1, ArmKind::Cyclic);
                (row.stroke_um, row.duration_s, row.rms_um) = (3.0, 0.5, 0.05);
                (row.start_s, row.bias_um) = (cycle as f64, 0.0);
                (row.commanded_um, row.reached_um) = (3.0, 3.0);
                if cycle < 3 {
                    row.flags = CycleFlags(CycleFlags::DISTURBED);
                }
                row
            })
            .collect();
        let text = of_waves(&rows, None, "bead").unwrap().result;
        assert!(text.contains("8 cycles, 3 of them disturbed"), "{text}");
    }

    #[test]
    fn a_cell_whose_cycles_were_disturbed_says_so_first() {
        for cycles in [4, 40] {
            let rows: Vec<CycleRow> = (0..cycles)
                .map(|cycle| {
                    let mut row = CycleRow::empty(cycle, 1, ArmKind::Cyclic);
                    (row.start_s, row.duration_s) = (cycle as f64, 1.0);
                    (row.length_start_um, row.length_peak_um) = (5.0, 18.0);
                    row.flags = CycleFlags(CycleFlags::DISTURBED);
                    row
                })
                .collect();
            let text = of_a_cell(&rows).unwrap().result;
            let says = format!("{cycles} cycles, {cycles} of them disturbed");
            assert!(text.contains(&says), "{text}");
        }
    }
}
