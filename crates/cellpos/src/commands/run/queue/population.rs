//! Mean and spread of the cells of a queue: a row per cell, one page for all.

use crate::commands::run::over::Over;
use cellpos_numeric::statistics::student_t_quantile;
use cellpos_report::{Axis, Column, Emphasis, Figure, Panel, Report, Series, Table, with_interval};
use cellpos_script::{ArmKind, AtRest, CycleFlags, CycleRow, Trend, trend};
use cellpos_session::provenance::command_text;
use cellpos_workbench::run_report::{OF_LENGTH, half95, length_between, rig_of, was_elsewhere};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::Path;

/// A cell. None: not measured.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct CellRow {
    /// Its number in the queue, from 1.
    cell: u64,
    /// `done`, `stopped`, or how the run ended else.
    outcome: String,
    /// Cycles in the run's table.
    cycles: u64,
    /// Of these: changed by what happened in them.
    cycles_disturbed: u64,
    /// Mean length at rest before the first cycle, and its standard deviation \[um\].
    rest_length_um: Option<f64>,
    rest_length_sd_um: Option<f64>,
    /// Longest over length at rest, mean of the first and of the last ten whole cycles of the cyclic arm.
    stretch_first: Option<f64>,
    stretch_last: Option<f64>,
    /// Half width of the 95 % interval of `stretch_first`: scatter of its cycles and the length at rest together.
    stretch_first_ci95: Option<f64>,
    /// Recovery time, in the same way \[s\].
    recovery_first_s: Option<f64>,
    recovery_last_s: Option<f64>,
    /// RMS of the tracking error over the cycles \[nm\].
    cycle_rms_nm: Option<f64>,
    /// The run's folder.
    run: String,
}

/// The whole, undisturbed cycles of the cyclic arm, in which the cell was where the script had it.
fn counted(rows: &[CycleRow]) -> impl Iterator<Item = &CycleRow> {
    rows.iter().filter(|row| {
        row.arm == ArmKind::Cyclic
            && !row.flags.is_disturbed()
            && !row.flags.has(CycleFlags::RAMP)
            && !was_elsewhere(row)
    })
}

fn finite(value: f64) -> Option<f64> {
    value.is_finite().then_some(value)
}

impl CellRow {
    pub(super) fn new(cell: u64, over: &Over) -> Self {
        let rows = &over.cycles;
        let rest = AtRest::of(rows);
        let ends = |of: &dyn Fn(&CycleRow) -> f64| {
            let trend = trend(counted(rows).map(|row| (row.cycle, of(row))));
            (
                trend.as_ref().map(|t| t.first.mean),
                trend.as_ref().map(|t| t.last.mean),
            )
        };
        let (stretch_first, stretch_last) = ends(&|row| rest.stretch(row));
        let scatter =
            trend(counted(rows).map(|row| (row.cycle, rest.stretch(row)))).map(|t| t.first.ci95);
        // The two are independent: the length at rest is of frames before the first cycle.
        let stretch_first_ci95 = stretch_first.zip(scatter).map(|(stretch, scatter)| {
            let of_rest = rest.stretch_ci95() * stretch;
            scatter.hypot(if of_rest.is_finite() { of_rest } else { 0.0 })
        });
        let (recovery_first_s, recovery_last_s) = ends(&|row| row.recovery_s);
        Self {
            cell,
            outcome: over.outcome.to_owned(),
            cycles: rows.len() as u64,
            cycles_disturbed: rows.iter().filter(|row| row.flags.is_disturbed()).count() as u64,
            rest_length_um: finite(rest.length_um),
            rest_length_sd_um: finite(rest.length_sd_um),
            stretch_first,
            stretch_last,
            stretch_first_ci95: stretch_first_ci95.and_then(finite),
            recovery_first_s,
            recovery_last_s,
            cycle_rms_nm: CycleRow::rms_over_um(rows).map(|um| um * 1e3),
            run: over.folder.display().to_string(),
        }
    }

    /// Whether the script came to its end.
    pub(super) fn is_done(&self) -> bool {
        self.outcome == "done"
    }

    fn numbers(&self) -> [(&'static str, Option<f64>, usize); 8] {
        [
            ("rest_length_um", self.rest_length_um, 3),
            ("rest_length_sd_um", self.rest_length_sd_um, 4),
            ("stretch_first", self.stretch_first, 4),
            ("stretch_last", self.stretch_last, 4),
            ("stretch_first_ci95", self.stretch_first_ci95, 4),
            ("recovery_first_s", self.recovery_first_s, 4),
            ("recovery_last_s", self.recovery_last_s, 4),
            ("cycle_rms_nm", self.cycle_rms_nm, 1),
        ]
    }
}

/// The table as CSV; a number that does not exist is an empty field.
pub(super) fn csv(rows: &[CellRow]) -> String {
    let mut out = String::from(
        "cell,outcome,cycles,cycles_disturbed,rest_length_um,rest_length_sd_um,stretch_first,stretch_last,stretch_first_ci95,recovery_first_s,recovery_last_s,\
         cycle_rms_nm,run\n",
    );
    for row in rows {
        let numbers = row
            .numbers()
            .map(|(_, value, _)| value.map_or(String::new(), |value| value.to_string()));
        out.push_str(&format!(
            "{},{},{},{},{},\"{}\"\n",
            row.cell,
            row.outcome,
            row.cycles,
            row.cycles_disturbed,
            numbers.join(","),
            row.run.replace('"', "\"\"")
        ));
    }
    out
}

fn shown(value: Option<f64>, digits: usize) -> String {
    value.map_or_else(|| "-".to_owned(), |value| format!("{value:.digits$}"))
}

/// A line a cell, for the terminal.
pub(super) fn text(rows: &[CellRow]) -> String {
    let line = |row: &CellRow| {
        format!(
            "cell {:<13}{}: {} cycles, stretch {} -> {}, recovery {} -> {} s, {} nm RMS\n",
            row.cell,
            row.outcome,
            row.cycles,
            shown(row.stretch_first, 3),
            shown(row.stretch_last, 3),
            shown(row.recovery_first_s, 3),
            shown(row.recovery_last_s, 3),
            shown(row.cycle_rms_nm, 1)
        )
    };
    rows.iter().map(line).collect()
}

/// Mean over the cells at each cycle that two cells or more have, with its 95 % interval: cycle, mean, low, high. Few cells tell
/// their spread badly at one cycle alone: it is taken from all cycles together.
fn mean_course(courses: &[Vec<(f64, f64)>]) -> [Vec<f64>; 4] {
    let mut at: BTreeMap<u64, Vec<f64>> = BTreeMap::new();
    for (cycle, value) in courses.iter().flatten() {
        at.entry(*cycle as u64).or_default().push(*value);
    }
    at.retain(|_, values| values.len() > 1);
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
    let (squares, freedom) = at.values().fold((0.0, 0), |(squares, freedom), values| {
        let of = mean(values);
        let sum: f64 = values.iter().map(|value| (value - of).powi(2)).sum();
        (squares + sum, freedom + values.len() - 1)
    });
    let sd = (squares / freedom.max(1) as f64).sqrt();
    let mut columns: [Vec<f64>; 4] = Default::default();
    for (cycle, values) in &at {
        let n = values.len();
        // A cell differs from the others in each of its cycles alike: more cycles are no more cells.
        let half = student_t_quantile(0.975, (n - 1) as f64) * sd / (n as f64).sqrt();
        let mean = mean(values);
        for (column, value) in
            columns
                .iter_mut()
                .zip([*cycle as f64, mean, mean - half, mean + half])
        {
            column.push(value);
        }
    }
    columns
}

/// What became of the cells: mean of their first and of their last stretch and recovery, with the interval between cells.
pub(super) fn sentence(done: usize, rows: &[CellRow], cycles: &[Vec<CycleRow>]) -> String {
    let mut text = format!(
        "{done} of {} cells went through the whole script.",
        rows.len()
    );
    type Value = fn(&CycleRow, &AtRest) -> f64;
    let quantities: [(&str, &str, Value); 2] = [
        (
            "Stretch (largest length over that at rest)",
            "",
            |row, rest| rest.stretch(row),
        ),
        ("time constant of its recovery", " s", |row, _| {
            row.recovery_s
        }),
    ];
    let mut parts = Vec::new();
    for (name, unit, value) in quantities {
        let trends: Vec<Trend> = (cycles.iter())
            .filter_map(|rows| {
                let rest = AtRest::of(rows);
                trend(counted(rows).map(|row| (row.cycle, value(row, &rest))))
            })
            .collect();
        let mean = |of: fn(&Trend) -> f64| {
            let values: Vec<f64> = trends.iter().map(of).collect();
            (
                values.iter().sum::<f64>() / values.len() as f64,
                half95(&values),
            )
        };
        if trends.len() > 1 {
            let (first, last) = (
                mean(|trend| trend.first.mean),
                mean(|trend| trend.last.mean),
            );
            let (change, _) = mean(|trend| 100.0 * (trend.last.mean / trend.first.mean - 1.0));
            let change = format!("{change:+.1} %").replace('-', "\u{2212}");
            parts.push(format!(
                "{name} from {} to {}{unit} ({change})",
                with_interval(first.0, first.1),
                with_interval(last.0, last.1)
            ));
        }
    }
    if !parts.is_empty() {
        text.push_str(&format!(
            " {} (mean of the cells, first and last ten cycles of each).",
            parts.join(", ")
        ));
    }
    text
}

/// What was done.
fn lead(rows: &[CellRow], cycles: &[Vec<CycleRow>]) -> String {
    let whole = |rows: &Vec<CycleRow>| counted(rows).count();
    let (least, most) = (
        cycles.iter().map(whole).min().unwrap_or(0),
        cycles.iter().map(whole).max().unwrap_or(0),
    );
    let each = match least == most {
        true => format!("{most} whole cycles each"),
        false => format!("{least} to {most} whole cycles each"),
    };
    let of_one = (cycles.iter().flat_map(|rows| counted(rows)))
        .find(|row| row.stroke_um.is_finite())
        .map_or_else(String::new, |row| {
            format!(
                " of {:.1} um to and fro in {:.1} s",
                2.0 * row.stroke_um,
                row.duration_s
            )
        });
    let rig = match rows.first().map(|row| rig_of(Path::new(&row.run))) {
        None | Some("") => String::new(),
        Some(rig) => format!(" {rig}."),
    };
    format!(
        "Task: the same script for {} cells, one after the other; {each}{of_one}. The loop moves each cell to and fro by camera and piezo \
         (PZT), and measures how far it stretches and how fast it recovers.{rig}",
        rows.len()
    )
}

/// What the intervals are of.
fn sure(cells: usize) -> String {
    match cells {
        0 | 1 => "one cell does not tell how cells differ.".to_owned(),
        n => format!(
            "\u{b1} is the 95 % interval of the mean, from how the {n} cells differ (Student's t with {} degrees of freedom). It holds for \
             cells drawn as these were.",
            n - 1
        ),
    }
}

/// The page: the figure of the population, and the table.
pub(super) fn page(name: &str, rows: &[CellRow], cycles: &[Vec<CycleRow>]) -> Report {
    let mut page = Report::new(&format!("Cells: {name}"));
    let done = rows.iter().filter(|row| row.is_done()).count();
    let status = if done == rows.len() {
        Emphasis::Good
    } else {
        Emphasis::Warning
    };
    page.lead(&lead(rows, cycles));
    page.result(status, &sentence(done, rows, cycles));
    page.certainty(&sure(rows.len()));
    type Value = fn(&CycleRow, &AtRest) -> f64;
    let quantities: [(&str, &str, Value); 3] = [
        ("stretch", "", |row, rest| rest.stretch(row)),
        ("recovery time", "s", |row, _| row.recovery_s),
        ("length at start", "um", |row, _| length_between(row)),
    ];
    let mut figure = Figure::new(
        "population",
        &format!(
            "Thin: each cell. Thick: mean over the cells with its 95 % interval (area), at each cycle that two cells or more have; how far \
             cells differ is taken from all cycles together. Whole, undisturbed cycles. {OF_LENGTH}"
        ),
    )
    .columns(2);
    let mut any = false;
    for (name, unit, value) in quantities {
        let courses: Vec<Vec<(f64, f64)>> = (cycles.iter())
            .map(|rows| {
                let rest = AtRest::of(rows);
                let points = counted(rows).map(|row| (row.cycle as f64 + 1.0, value(row, &rest)));
                points.filter(|(_, value)| value.is_finite()).collect()
            })
            .collect();
        if courses.iter().all(Vec::is_empty) {
            continue;
        }
        any = true;
        let mut panel =
            Panel::new(Axis::linear("cycle", ""), Axis::linear(name, unit)).height_px(180.0);
        for (n, course) in (courses.iter().filter(|course| !course.is_empty())).enumerate() {
            let (x, y): (Vec<f64>, Vec<f64>) = course.iter().copied().unzip();
            let name = if n == 0 { "each cell" } else { "" };
            panel = panel.series(Series::line(name, &x, &y).thin().color(1));
        }
        let [cycle, mean, low, high] = mean_course(&courses);
        if !cycle.is_empty() {
            panel = panel
                .series(Series::band("95 % of the mean", &cycle, &low, &high).color(0))
                .series(Series::line("mean of the cells", &cycle, &mean).color(0));
        }
        figure = figure.panel(panel);
    }
    if any {
        page.figure(figure);
    } else {
        page.paragraph(
            "No length was measured in these runs: the table below is of the tracking alone.",
        );
    }
    page.section("The cells");
    let mut table = Table::new([
        Column::right("cell"),
        Column::left("outcome"),
        Column::right("cycles"),
        Column::right("disturbed"),
        Column::right("length at rest [um]"),
        Column::right("its sd [um]"),
        Column::right("stretch, first ten"),
        Column::right("last ten"),
        Column::right("+- (95 %, of the first)"),
        Column::right("recovery, first ten [s]"),
        Column::right("last ten"),
        Column::right("error RMS [nm]"),
    ]);
    for row in rows {
        let begin = [
            row.cell.to_string(),
            row.outcome.clone(),
            row.cycles.to_string(),
            row.cycles_disturbed.to_string(),
        ];
        let numbers = row.numbers().map(|(_, value, digits)| shown(value, digits));
        table.row(begin.into_iter().chain(numbers));
    }
    page.table(table);
    page.list(
        &rows
            .iter()
            .map(|row| format!("cell {}: {}", row.cell, row.run))
            .collect::<Vec<_>>(),
    );
    page.command(&command_text());
    page
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mean_course_is_of_the_cycles_that_two_cells_have() {
        let courses = vec![
            vec![(1.0, 3.0), (2.0, 2.8), (3.0, 2.6)],
            vec![(1.0, 3.4), (2.0, 3.0)],
            Vec::new(),
        ];
        let [cycle, mean, low, high] = mean_course(&courses);
        assert_eq!(cycle, [1.0, 2.0]);
        assert!((mean[0] - 3.2).abs() < 1e-12 && (mean[1] - 2.9).abs() < 1e-12);
        // Values 0.4 and 0.2 apart: a variance of (0.08 + 0.02) / 2, the mean's is half of it, times t of one degree of freedom. It is
        // the same where two cells happen to meet.
        let half = 12.706_204_736_175 * 0.025_f64.sqrt();
        for k in [0, 1] {
            assert!(
                (high[k] - mean[k] - half).abs() < 1e-9 && (mean[k] - low[k] - half).abs() < 1e-9
            );
        }
        assert!(half95(&[1.0]).is_nan());
    }
}
