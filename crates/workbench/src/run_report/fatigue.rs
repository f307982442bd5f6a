//! The fatigue figure: change of the cell over the cycles.

use super::cycles::{on_the_way, was_elsewhere};
use super::ticks::{Course, Ticks};
use super::traces::over_time;
use cellpos_report::{Axis, Figure, Panel, Report, Series};
use cellpos_script::{ArmKind, AtRest, CycleFlags, CycleRow, Mean};

/// The cycles that are drawn over each other: the first, the tenth, the hundredth, ... and the last one with records.
pub(super) fn courses(rows: &[CycleRow]) -> Vec<Course> {
    let cyclic: Vec<&CycleRow> = rows.iter().filter(is_whole).collect();
    let mut wanted = Vec::new();
    let mut number = 1;
    while number <= cyclic.len() {
        wanted.push(number);
        number *= 10;
    }
    // The last one shows the outcome.
    if wanted.last().is_some_and(|last| *last != cyclic.len()) {
        wanted.push(cyclic.len());
    }
    wanted
        .into_iter()
        .filter_map(|number| {
            let row = cyclic.get(number - 1)?;
            let from_ns = (row.start_s * 1e9) as i64;
            Some(Course {
                number: row.cycle + 1,
                session: row.session,
                from_ns,
                to_ns: from_ns + (row.duration_s * 1e9) as i64,
                time_s: Vec::new(),
                length_um: Vec::new(),
            })
        })
        .collect()
}

pub(super) fn is_whole(row: &&CycleRow) -> bool {
    row.arm == ArmKind::Cyclic
        && row.start_s.is_finite()
        && !row.flags.has(CycleFlags::SKIPPED)
        && !row.flags.has(CycleFlags::RAMP)
}

/// Means of ten cycles each (of the last six or more) with their 95 % intervals: cycle, mean, low, high.
pub(super) fn tens(values: &[(f64, f64)]) -> [Vec<f64>; 4] {
    const TEN: usize = 10;
    let mut columns: [Vec<f64>; 4] = Default::default();
    for ten in values.chunks(TEN).filter(|ten| ten.len() > TEN / 2) {
        let cycle = ten.iter().map(|p| p.0).sum::<f64>() / ten.len() as f64;
        let found = Mean::of(ten);
        let ends = [found.mean - found.ci95, found.mean + found.ci95];
        for (column, value) in columns
            .iter_mut()
            .zip([cycle, found.mean, ends[0], ends[1]])
        {
            column.push(value);
        }
    }
    columns
}

/// The length of the cell over the run and over single cycles, where the run has cycles of a cell.
pub(super) fn section(page: &mut Report, rows: &[CycleRow], ticks: &Ticks) {
    if AtRest::of(rows).length_um.is_nan() || !ticks.has_length {
        return;
    }
    page.section("The cell over its cycles");
    page.figure(
        Figure::new(
            "length",
            "Length of the cell over the whole run: median of each stretch of time, and envelope.",
        )
        .panel(over_time(&ticks.length, "length", "um")),
    );
    let mut panel = Panel::new(
        Axis::linear("time since the cycle began", "s"),
        Axis::linear("length", "um"),
    );
    let drawn: Vec<&Course> = ticks
        .courses
        .iter()
        .filter(|course| !course.time_s.is_empty())
        .collect();
    for course in &drawn {
        let name = format!("cycle {}", course.number);
        panel = panel.series(Series::line(&name, &course.time_s, &course.length_um).thin());
    }
    if !drawn.is_empty() {
        page.figure(
            Figure::new(
                "cycles-over-each-other",
                "Length of the cell over single cycles, laid over each other: the first, the tenth, the hundredth, the last.",
            )
            .panel(panel),
        );
    }
}

/// What [`length_between`] is.
pub const OF_LENGTH: &str = "Length at start: what the pause before a cycle leaves of the stretch; the first cycle, which begins at rest, is left out.";

/// Length at the start of a cycle that follows another; NaN of the first.
pub fn length_between(row: &CycleRow) -> f64 {
    match row.cycle {
        0 => f64::NAN,
        _ => row.length_start_um,
    }
}

/// Change of the cell over the cycles: the main figure of a run with a cell.
pub(super) fn figure(rows: &[CycleRow]) -> Option<Figure> {
    let rest = AtRest::of(rows);
    if rest.length_um.is_nan() {
        return None;
    }
    let of_arm = |arm: ArmKind| {
        rows.iter()
            .filter(move |row| row.arm == arm)
            .map(|row| row.cycle)
    };
    let (cyclic, fixed) = (of_arm(ArmKind::Cyclic).min(), of_arm(ArmKind::Static).min());
    let same_cell = match (cyclic, fixed) {
        (Some(cyclic), Some(fixed)) if cyclic < fixed => {
            " Both parts are of this one run: under the static load is the cell that went through the cycles, not a fresh one."
        }
        (Some(_), Some(_)) => {
            " Both parts are of this one run: the cycles are of the cell that was under the static load before."
        }
        _ => "",
    };
    let figure = Figure::new(
        "fatigue",
        &format!(
            "Small points: each cycle (under the static load: as long as a cycle). Large: means of ten with their 95 % interval, where \
             it is larger than the point. {OF_LENGTH}{same_cell}"
        ),
    );
    let mut panels = vec![
        panel(rows, ArmKind::Cyclic, "stretch", "", &|row| {
            rest.stretch(row)
        }),
        panel(rows, ArmKind::Cyclic, "recovery time", "s", &|row| {
            row.recovery_s
        }),
    ];
    if fixed.is_some() {
        panels.push(panel(rows, ArmKind::Static, "stretch", "", &|row| {
            rest.stretch(row)
        }));
    }
    panels.push(panel(
        rows,
        ArmKind::Cyclic,
        "length at start",
        "um",
        &length_between,
    ));
    Some(panels.into_iter().fold(figure.columns(2), Figure::panel))
}

/// A quantity of one arm: over the cycles, or over the time under the static load.
fn panel(
    rows: &[CycleRow],
    arm: ArmKind,
    name: &str,
    unit: &str,
    value: &dyn Fn(&CycleRow) -> f64,
) -> Panel {
    let first = rows
        .iter()
        .filter(|row| row.arm == arm)
        .map(|row| row.cycle)
        .min();
    let (x, title, color) = match arm {
        ArmKind::Cyclic => (Axis::linear("cycle", ""), "over the cycles", 0),
        ArmKind::Static => (
            Axis::linear("time under static load", "s"),
            "held under static load",
            1,
        ),
    };
    let place = |row: &CycleRow| match arm {
        ArmKind::Cyclic => row.cycle as f64 + 1.0,
        ArmKind::Static => (row.cycle - first.unwrap_or(0)) as f64 * row.duration_s,
    };
    let of = |wanted: &dyn Fn(&CycleRow) -> bool| -> Vec<(f64, f64)> {
        (rows.iter().filter(|row| row.arm == arm && wanted(row)))
            .map(|row| (place(row), value(row)))
            .filter(|(_, value)| value.is_finite())
            .collect()
    };
    let mut panel = Panel::new(x, Axis::linear(name, unit))
        .title(title)
        .height_px(170.0);
    let counts = |row: &CycleRow| {
        !on_the_way(row)
            && !was_elsewhere(row)
            && !row.flags.has(CycleFlags::SKIPPED)
            && !row.flags.has(CycleFlags::RAMP)
    };
    let points = of(&counts);
    let (x, y): (Vec<f64>, Vec<f64>) = points.iter().copied().unzip();
    let [at, mean, low, high] = tens(&points);
    panel = panel.series(Series::points("", &x, &y).color(color).thin());
    panel = panel.series(Series::intervals("", &at, &mean, &low, &high).color(color));
    let elsewhere = of(&was_elsewhere);
    if !elsewhere.is_empty() {
        let (x, y): (Vec<f64>, Vec<f64>) = elsewhere.into_iter().unzip();
        panel = panel.series(
            Series::points("elsewhere, in no mean", &x, &y)
                .color(7)
                .thin(),
        );
    }
    panel
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_tenth_hundredth_and_last_whole_cycle_are_drawn_over_each_other() {
        let rows: Vec<CycleRow> = (0..150)
            .map(|cycle| {
                let mut row = CycleRow::empty(cycle, 1 + cycle / 100, ArmKind::Cyclic);
                (row.start_s, row.duration_s) = (cycle as f64 % 100.0, 1.0);
                row
            })
            .collect();
        let found: Vec<(u64, u64)> = courses(&rows)
            .iter()
            .map(|course| (course.number, course.session))
            .collect();
        assert_eq!(found, vec![(1, 1), (10, 1), (100, 1), (150, 2)]);
        assert!(courses(&[]).is_empty());
    }

    #[test]
    fn means_of_ten_have_the_interval_of_their_scatter_about_a_line() {
        // To and fro about a ramp: the ramp is no scatter, and what is left over is in no mean.
        let values: Vec<(f64, f64)> = (0..25)
            .map(|k| {
                let to_and_fro = if (k + 1) % 4 < 2 { 1.0 } else { -1.0 };
                (f64::from(k), 100.0 * f64::from(k) + to_and_fro)
            })
            .collect();
        let [cycle, mean, low, high] = tens(&values);
        assert_eq!((cycle.len(), cycle[0]), (2, 4.5));
        assert!((mean[1] - 1450.0).abs() < 0.5, "{mean:?}");
        // A scatter of some sqrt(10 / 8) over sqrt(10), times t of eight degrees of freedom, 2.306.
        let half = (high[0] - low[0]) / 2.0;
        assert!((half - 2.306 / 8.0_f64.sqrt()).abs() < 0.05, "{half}");
    }
}
