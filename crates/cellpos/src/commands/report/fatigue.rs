//! The fatigue figure: change of the cell over the cycles.

use super::cycles::{on_the_way, was_elsewhere};
use super::ticks::{Course, Ticks};
use cellpos_report::{Axis, Figure, Panel, Report, Series};
use cellpos_script::{ArmKind, AtRest, CycleFlags, CycleRow};

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

/// Means of ten cycles each with their 95 % intervals: cycle, mean, low, high.
pub(super) fn tens(values: &[(f64, f64)]) -> [Vec<f64>; 4] {
    const TEN: usize = 10;
    // Student's t for nine degrees of freedom.
    const T95: f64 = 2.262;
    let mut columns: [Vec<f64>; 4] = Default::default();
    for ten in values.chunks(TEN).filter(|ten| ten.len() == TEN) {
        let n = TEN as f64;
        let mean = |of: fn(&(f64, f64)) -> f64| ten.iter().map(of).sum::<f64>() / n;
        let (cycle, value) = (mean(|p| p.0), mean(|p| p.1));
        let squares: f64 = ten.iter().map(|p| (p.1 - value).powi(2)).sum();
        let half = T95 * (squares / (n - 1.0) / n).sqrt();
        for (column, value) in columns
            .iter_mut()
            .zip([cycle, value, value - half, value + half])
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
    let course = ticks.length.course(0);
    let mut length = Panel::new(Axis::linear("time", "s"), Axis::linear("length", "um"));
    if !ticks.length.is_bare() {
        let band = Series::band(
            "smallest to largest",
            &course.time_s,
            &course.low,
            &course.high,
        );
        length = length.series(band.color(0));
    }
    page.figure(
        Figure::new(
            "length",
            "Length of the cell over the whole run: median of each stretch of time, and envelope.",
        )
        .panel(
            length.series(
                Series::line("median", &course.time_s, &course.median)
                    .color(0)
                    .thin(),
            ),
        ),
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

/// Change of the cell over the cycles: the main figure of a run with a cell.
pub(super) fn figure(rows: &[CycleRow]) -> Option<Figure> {
    let rest = AtRest::of(rows);
    if rest.length_um.is_nan() {
        return None;
    }
    let of = |arm: ArmKind, value: &dyn Fn(&CycleRow) -> f64| -> Vec<(f64, f64)> {
        rows.iter()
            .filter(|row| row.arm == arm && !on_the_way(row) && !was_elsewhere(row))
            .filter(|row| !row.flags.has(CycleFlags::SKIPPED) && !row.flags.has(CycleFlags::RAMP))
            .map(|row| (row.cycle as f64 + 1.0, value(row)))
            .filter(|(_, value)| value.is_finite())
            .collect()
    };
    let elsewhere = |value: &dyn Fn(&CycleRow) -> f64| -> (Vec<f64>, Vec<f64>) {
        (rows.iter().filter(|row| was_elsewhere(row)))
            .map(|row| (row.cycle as f64 + 1.0, value(row)))
            .filter(|(_, value)| value.is_finite())
            .unzip()
    };
    let of_arm = |arm: ArmKind| {
        rows.iter()
            .filter(move |row| row.arm == arm)
            .map(|row| row.cycle)
    };
    let same_cell = match (of_arm(ArmKind::Cyclic).min(), of_arm(ArmKind::Static).min()) {
        (Some(cyclic), Some(fixed)) if cyclic < fixed => {
            " Both arms are of this one run: the static arm is of the cell that went through the cycles, not of a fresh one."
        }
        (Some(_), Some(_)) => {
            " Both arms are of this one run: the cycles are of the cell that was under the static load before."
        }
        _ => "",
    };
    let mut figure = Figure::new(
        "fatigue",
        &format!(
            "Stretch, length at the start and recovery time of every cycle (small points), and of ten cycles in the mean (large) with \
             the 95 % interval of that mean, where it is larger than the point.{same_cell}"
        ),
    );
    type Value<'v> = &'v dyn Fn(&CycleRow) -> f64;
    let quantities: [(&str, &str, Value); 3] = [
        ("stretch", "", &|row| rest.stretch(row)),
        ("length at start", "um", &|row| row.length_start_um),
        ("recovery time", "s", &|row| row.recovery_s),
    ];
    for (name, unit, value) in quantities {
        let mut panel =
            Panel::new(Axis::linear("cycle", ""), Axis::linear(name, unit)).height_px(150.0);
        for (color, arm, label) in [
            (0, ArmKind::Cyclic, "cyclic"),
            (1, ArmKind::Static, "static"),
        ] {
            let points = of(arm, value);
            if points.is_empty() {
                continue;
            }
            let (x, y): (Vec<f64>, Vec<f64>) = points.iter().copied().unzip();
            let [cycle, mean, low, high] = tens(&points);
            if cycle.is_empty() {
                panel = panel.series(Series::points(label, &x, &y).color(color));
            } else {
                panel = panel
                    .series(Series::points("", &x, &y).color(color).thin())
                    .series(Series::intervals(label, &cycle, &mean, &low, &high).color(color));
            }
        }
        let (x, y) = elsewhere(value);
        if !x.is_empty() {
            panel = panel.series(
                Series::points("elsewhere, in no mean", &x, &y)
                    .color(7)
                    .thin(),
            );
        }
        figure = figure.panel(panel);
    }
    Some(figure.share_x())
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
    fn means_of_ten_have_the_interval_of_a_mean() {
        let values: Vec<(f64, f64)> = (0..25)
            .map(|k| (f64::from(k), if k % 2 == 0 { 1.0 } else { 3.0 }))
            .collect();
        let [cycle, mean, low, high] = tens(&values);
        assert_eq!((cycle.len(), cycle[0], mean[1]), (2, 4.5, 2.0));
        // Scatter of sqrt(10 / 9) over sqrt(10), times t.
        let half = 2.262 / 3.0;
        assert!((high[0] - 2.0 - half).abs() < 1e-9 && (2.0 - low[0] - half).abs() < 1e-9);
    }
}
