//! Figures and tables of several runs.

use super::data::{ARMS, Compared, Quantity, values};
use crate::run_report::fatigue::{OF_LENGTH, tens};
use cellpos_report::{Axis, Column, Figure, Panel, Series, Table, with_interval};
use cellpos_script::ArmKind;

/// Means of ten cycles of each run, side by side so that each is seen.
pub(super) fn over_cycles(compared: &[Compared], quantities: &[Quantity]) -> Figure {
    let mut figure = Figure::new(
        "comparison",
        &format!(
            "Each run over its cycles: means of ten cycles with the 95 % interval from the scatter within that run, where it is larger \
             than the point; every cycle of a run with fewer than twenty. The runs' points of the same cycles are drawn side by side. \
             Cycles in which bead or cell was elsewhere than the script had it are left out. {OF_LENGTH}"
        ),
    )
    .columns(2);
    for (number, quantity) in quantities.iter().enumerate() {
        for arm in ARMS {
            // What is under a static load is told by its first quantity.
            let panel = panel(compared, arm, quantity);
            if let Some(panel) = panel.filter(|_| arm == ArmKind::Cyclic || number == 0) {
                figure = figure.panel(panel);
            }
        }
    }
    figure
}

/// A quantity of one arm of all runs; none if no run has it.
fn panel(compared: &[Compared], arm: ArmKind, quantity: &Quantity) -> Option<Panel> {
    /// Share of the ten cycles over which the runs' points are spread.
    const SPREAD: f64 = 0.6;
    let title = match arm {
        ArmKind::Cyclic => "over the cycles",
        ArmKind::Static => "held under static load (in cycles' time)",
    };
    let mut panel = Panel::new(
        Axis::linear("cycle", ""),
        Axis::linear(quantity.name, quantity.unit),
    )
    .title(title)
    .height_px(170.0);
    let mut any = false;
    for (color, run) in compared.iter().enumerate() {
        let points = values(&run.rows, arm, quantity);
        any |= !points.is_empty();
        let [cycle, mean, low, high] = tens(&points);
        let place = (color as f64 + 0.5) / compared.len() as f64 - 0.5;
        panel = panel.series(match cycle.len() < 2 {
            true => {
                let (cycle, value): (Vec<f64>, Vec<f64>) = points.into_iter().unzip();
                Series::points(&run.name, &cycle, &value)
                    .color(color)
                    .thin()
            }
            false => {
                let at: Vec<f64> = cycle.iter().map(|c| c + 10.0 * SPREAD * place).collect();
                Series::intervals(&run.name, &at, &mean, &low, &high).color(color)
            }
        });
    }
    any.then_some(panel)
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
    let mut caption = "Error of the measured position of each run while the loop was closed, with its 95 % interval where it is larger \
                       than the point"
        .to_owned();
    if bound.iter().any(|nm| nm.is_finite()) {
        panel = panel.series(Series::points("lowest possible", &at, &bound).color(1));
        caption
            .push_str(", and the lowest that Brownian motion, delay and localisation noise allow");
    }
    Figure::new("errors", &(caption + ".")).panel(panel)
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
