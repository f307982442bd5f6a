//! Figures and tables of several runs.

use super::data::{ARMS, Compared, Quantity, values};
use crate::commands::report::cycles::with_interval;
use crate::commands::report::fatigue::tens;
use cellpos_report::{Axis, Column, Figure, Panel, Series, Table};
use cellpos_script::ArmKind;

/// A curve for each run and arm: means of ten cycles with their 95 % intervals.
pub(super) fn over_cycles(compared: &[Compared], quantities: &[Quantity]) -> Figure {
    let mut figure = Figure::new(
        "comparison",
        "Each run over its cycles: means of ten cycles (lines) with the 95 % interval of each mean (areas); every cycle of a run \
         with fewer than twenty. Dashed: the static arm. Cycles in which bead or cell was elsewhere than the script had it are left out.",
    );
    for quantity in quantities {
        let y = Axis::linear(quantity.name, quantity.unit);
        let mut panel = Panel::new(Axis::linear("cycle", ""), y).height_px(150.0);
        for (color, run) in compared.iter().enumerate() {
            for arm in ARMS {
                let points = values(&run.rows, arm, quantity);
                if points.is_empty() {
                    continue;
                }
                let name = match arm {
                    ArmKind::Cyclic => run.name.clone(),
                    ArmKind::Static => format!("{}, static", run.name),
                };
                let [mut cycle, mut mean, low, high] = tens(&points);
                if cycle.len() < 2 {
                    (cycle, mean) = points.iter().copied().unzip();
                } else {
                    panel = panel.series(Series::band("", &cycle, &low, &high).color(color));
                }
                let line = Series::line(&name, &cycle, &mean).color(color);
                panel = panel.series(match arm {
                    ArmKind::Cyclic => line,
                    ArmKind::Static => line.dashed(),
                });
            }
        }
        figure = figure.panel(panel);
    }
    figure.share_x()
}

/// The error of each run, with its interval and the bound.
pub(super) fn errors(compared: &[Compared]) -> Figure {
    let names: Vec<String> = compared.iter().map(|run| run.name.clone()).collect();
    let at: Vec<f64> = (0..compared.len()).map(|n| n as f64).collect();
    let of = |pick: &dyn Fn(&Compared) -> Option<f64>| -> Vec<f64> {
        compared
            .iter()
            .map(|run| pick(run).unwrap_or(f64::NAN))
            .collect()
    };
    let rms = of(&|run| run.rms_nm);
    let low = of(&|run| Some(run.rms_nm? - run.rms_ci95_nm?));
    let high = of(&|run| Some(run.rms_nm? + run.rms_ci95_nm?));
    let bound = of(&|run| run.bound_rms_nm);
    let mut panel = Panel::new(
        Axis::categories("run", &names),
        Axis::linear("error", "nm RMS"),
    )
    .series(Series::intervals("measured", &at, &rms, &low, &high).color(0));
    if bound.iter().any(|nm| nm.is_finite()) {
        panel = panel.series(Series::points("lowest possible", &at, &bound).color(1));
    }
    Figure::new(
        "errors",
        "Error of the measured position of each run while the loop was closed, with its 95 % interval where it is larger than the \
         point, and the lowest that Brownian motion, delay and localisation noise allow a bead at rest.",
    )
    .panel(panel)
}

/// First and last cycles of every quantity of every run.
pub(super) fn table_of_ends(compared: &[Compared], quantities: &[Quantity]) -> Table {
    let mut table = Table::new([
        Column::left("run"),
        Column::left("arm"),
        Column::left("quantity"),
        Column::right("cycles"),
        Column::right("first ten"),
        Column::right("last ten"),
        Column::right("change"),
    ]);
    for run in compared {
        for ends in &run.ends {
            if !quantities
                .iter()
                .any(|quantity| quantity.name == ends.quantity)
            {
                continue;
            }
            let name = match ends.unit {
                "" => ends.quantity.to_owned(),
                unit => format!("{} ({unit})", ends.quantity),
            };
            let change = with_interval(
                ends.last - ends.first,
                ends.first_ci95.hypot(ends.last_ci95),
            );
            table.row([
                run.name.as_str(),
                ends.arm,
                &name,
                &ends.cycles.to_string(),
                &with_interval(ends.first, ends.first_ci95),
                &with_interval(ends.last, ends.last_ci95),
                &change,
            ]);
        }
    }
    table.caption(
        "Means of the first and the last ten cycles (of each half, where there are fewer than twenty) with their 95 % intervals, and \
         the difference of the two.",
    );
    table
}

/// How each run ended, and its error.
pub(super) fn table_of_runs(compared: &[Compared]) -> Table {
    let mut table = Table::new([
        Column::left("run"),
        Column::left("how it ended"),
        Column::right("duration (s)"),
        Column::right("cycles"),
        Column::right("elsewhere"),
        Column::right("error (nm RMS)"),
        Column::right("possible (nm RMS)"),
    ]);
    for run in compared {
        let error = run
            .rms_nm
            .map(|nm| with_interval(nm, run.rms_ci95_nm.unwrap_or(f64::NAN)));
        table.row_with(
            run.emphasis,
            [
                run.name.as_str(),
                &run.outcome,
                &format!("{:.1}", run.duration_s),
                &run.cycles.to_string(),
                &run.cycles_elsewhere.to_string(),
                &error.unwrap_or_else(|| "-".to_owned()),
                &run.bound_rms_nm
                    .map_or_else(|| "-".to_owned(), |nm| format!("{nm:.1}")),
            ],
        );
    }
    table
}
