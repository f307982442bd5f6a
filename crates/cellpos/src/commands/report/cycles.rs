//! The cycles of a run: their trends, with the static arm beside.

use cellpos_report::{Axis, Column, Figure, Panel, Report, Series, Status, Table};
use cellpos_script::{ArmKind, CycleRow, ReadCycles, Trend, trend};
use std::collections::BTreeMap;

/// A quantity of the cycles.
struct Quantity {
    /// What it says something of: the bead or cell itself, or how well the rig moved it.
    of_what: &'static str,
    name: &'static str,
    unit: &'static str,
    of: fn(&CycleRow, &Rest) -> f64,
}

/// The cell before the first cycle; NaN where it was not measured.
struct Rest {
    length_um: f64,
    area_um2: f64,
}

impl Rest {
    fn of(rows: &[CycleRow]) -> Self {
        let first = |of: fn(&CycleRow) -> f64| {
            let mut values = rows.iter().map(of);
            values.find(|value| value.is_finite()).unwrap_or(f64::NAN)
        };
        Self {
            length_um: first(|row| row.length_start_um),
            area_um2: first(|row| row.area_start_um2),
        }
    }
}

const QUANTITIES: [Quantity; 12] = [
    Quantity {
        of_what: "rig",
        name: "reached over commanded amplitude",
        unit: "",
        of: |row, _| row.reached_um / row.commanded_um,
    },
    Quantity {
        of_what: "rig",
        name: "lag",
        unit: "deg",
        of: |row, _| row.lag_deg,
    },
    Quantity {
        of_what: "rig",
        name: "bias",
        unit: "um",
        of: |row, _| row.bias_um,
    },
    Quantity {
        of_what: "rig",
        name: "error RMS",
        unit: "um",
        of: |row, _| row.rms_um,
    },
    Quantity {
        of_what: "rig",
        name: "neutral",
        unit: "um",
        of: |row, _| row.neutral_um,
    },
    Quantity {
        of_what: "bead",
        name: "gain",
        unit: "1/s",
        of: |row, _| row.gain_per_s,
    },
    Quantity {
        of_what: "cell",
        name: "dwell",
        unit: "s",
        of: |row, _| row.dwell_s,
    },
    Quantity {
        of_what: "cell",
        name: "stretch",
        unit: "",
        of: |row, rest| row.length_peak_um / rest.length_um,
    },
    Quantity {
        of_what: "cell",
        name: "areal stretch",
        unit: "",
        of: |row, rest| row.area_peak_um2 / rest.area_um2,
    },
    Quantity {
        of_what: "cell",
        name: "length at cycle start",
        unit: "um",
        of: |row, _| row.length_start_um,
    },
    Quantity {
        of_what: "cell",
        name: "area at cycle start",
        unit: "um^2",
        of: |row, _| row.area_start_um2,
    },
    Quantity {
        of_what: "cell",
        name: "recovery time",
        unit: "s",
        of: |row, _| row.recovery_s,
    },
];

/// Adds the section; gives the trends as they go into the JSON.
pub fn section(page: &mut Report, read: &ReadCycles) -> serde_json::Value {
    let (rows, unreadable) = (read.rows.as_slice(), read.unreadable);
    if rows.is_empty() && unreadable == 0 && read.head.is_none() {
        return serde_json::Value::Null;
    }
    page.section("Cycles");
    if let Some(error) = &read.head {
        page.note(
            Status::Warning,
            &format!(
                "cycles.csv is not read: {error}. Was it changed, or written by a newer version?"
            ),
        );
    } else if unreadable > 0 {
        page.note(
            Status::Warning,
            &format!("{unreadable} lines of cycles.csv are no rows."),
        );
    }
    if rows.is_empty() {
        return serde_json::Value::Null;
    }
    let disturbed = rows.iter().filter(|row| row.flags.is_disturbed()).count();
    page.paragraph(&format!(
        "{} cycles, {disturbed} of them disturbed.",
        rows.len()
    ));
    let rest = Rest::of(rows);
    let mut table = Table::new([
        Column::left("of"),
        Column::left("quantity"),
        Column::left("arm"),
        Column::right("cycles"),
        Column::right("first"),
        Column::right("last"),
        Column::right("per cycle"),
        Column::right("95 %"),
        Column::left("trend"),
    ]);
    table.caption(
        "Straight lines through all cycles of an arm. A trend is one when it is beyond three times its 95 % interval. Stretch and \
         areal stretch: largest length and area over those at the start of the first cycle.",
    );
    let mut figure = Figure::new("cycles", "The cycles of the run, cyclic and static arm.");
    let mut json = Vec::new();
    for quantity in &QUANTITIES {
        let mut panel = Panel::new(
            Axis::linear("cycle", ""),
            Axis::linear(quantity.name, quantity.unit),
        )
        .height_px(160.0);
        let mut any = false;
        for (arm, name) in [(ArmKind::Cyclic, "cyclic"), (ArmKind::Static, "static")] {
            let values: Vec<(u64, f64)> = rows
                .iter()
                .filter(|row| row.arm == arm)
                .map(|row| (row.cycle, (quantity.of)(row, &rest)))
                .filter(|(_, value)| value.is_finite())
                .collect();
            if values.is_empty() {
                continue;
            }
            any = true;
            let x: Vec<f64> = values.iter().map(|(cycle, _)| *cycle as f64).collect();
            let y: Vec<f64> = values.iter().map(|(_, value)| *value).collect();
            panel = panel.series(Series::points(name, &x, &y));
            if let Some(found) = trend(values) {
                row(&mut table, quantity, name, &found);
                json.push(serde_json::json!({
                    "of": quantity.of_what,
                    "quantity": quantity.name,
                    "unit": quantity.unit,
                    "arm": name,
                    "cycles": found.cycles,
                    "first": found.first,
                    "last": found.last,
                    "per_cycle": found.per_cycle,
                    "ci95_per_cycle": found.ci95_per_cycle,
                    "significant": found.is_significant(),
                }));
            }
        }
        if any {
            figure = figure.panel(panel);
        }
    }
    page.table(table);
    page.figure(figure.share_x());
    flags(page, rows);
    serde_json::Value::Array(json)
}

fn row(table: &mut Table, quantity: &Quantity, arm: &str, found: &Trend) {
    let significant = found.is_significant();
    let name = if quantity.unit.is_empty() {
        quantity.name.to_string()
    } else {
        format!("{} ({})", quantity.name, quantity.unit)
    };
    table.row([
        quantity.of_what,
        name.as_str(),
        arm,
        &found.cycles.to_string(),
        &format!("{:.4}", found.first),
        &format!("{:.4}", found.last),
        &format!("{:.3e}", found.per_cycle),
        &format!("{:.1e}", found.ci95_per_cycle),
        if significant { "yes" } else { "none" },
    ]);
}

fn flags(page: &mut Report, rows: &[CycleRow]) {
    let mut counts: BTreeMap<String, u64> = BTreeMap::new();
    for row in rows.iter().filter(|row| row.flags.0 != 0) {
        for word in row.flags.to_string().split('+') {
            *counts.entry(word.to_string()).or_default() += 1;
        }
    }
    if counts.is_empty() {
        return;
    }
    let mut table = Table::new([Column::left("what happened"), Column::right("in cycles")]);
    for (word, count) in &counts {
        table.row([word.as_str(), &count.to_string()]);
    }
    page.table(table);
}
