//! The cycles of a run: trends of each motion, and the static arm.

use cellpos_report::{Axis, Column, Emphasis, Figure, Panel, Report, Series, Table, with_interval};
use cellpos_script::{ArmKind, AtRest, CycleFlags, CycleRow, ReadCycles, Trend, trend};
use std::collections::BTreeMap;

/// A quantity of the cycles.
struct Quantity {
    /// Its subject: the bead or cell, or the motion of the rig.
    of_what: &'static str,
    name: &'static str,
    unit: &'static str,
    of: fn(&CycleRow, &AtRest) -> f64,
}

/// Those that the first figure of a cell shows.
const OF_THE_CELL: [&str; 3] = ["stretch", "length at cycle start", "recovery time"];

const fn quantity(
    of_what: &'static str,
    name: &'static str,
    unit: &'static str,
    of: fn(&CycleRow, &AtRest) -> f64,
) -> Quantity {
    Quantity {
        of_what,
        name,
        unit,
        of,
    }
}

const QUANTITIES: [Quantity; 12] = [
    quantity("rig", "reached over commanded amplitude", "", |row, _| {
        row.reached_um / row.commanded_um
    }),
    quantity("rig", "lag", "deg", |row, _| row.lag_deg),
    quantity("rig", "bias", "um", |row, _| row.bias_um),
    quantity("rig", "error RMS", "um", |row, _| row.rms_um),
    quantity("rig", "neutral", "um", |row, _| row.neutral_um),
    quantity("bead", "gain", "1/s", |row, _| row.gain_per_s),
    quantity("cell", "dwell", "s", |row, _| row.dwell_s),
    quantity("cell", "stretch", "", |row, rest| rest.stretch(row)),
    quantity("cell", "areal stretch", "", |row, rest| {
        rest.areal_stretch(row)
    }),
    quantity("cell", "length at cycle start", "um", |row, _| {
        row.length_start_um
    }),
    quantity("cell", "area at cycle start", "um^2", |row, _| {
        row.area_start_um2
    }),
    quantity("cell", "recovery time", "s", |row, _| row.recovery_s),
];

/// Adds the section; gives the trends as they go into the JSON. `of_a_cell`: stretch, length and recovery have a figure of their own.
pub(super) fn section(page: &mut Report, read: &ReadCycles, of_a_cell: bool) -> serde_json::Value {
    let (rows, unreadable) = (read.rows.as_slice(), read.unreadable);
    if rows.is_empty() && unreadable == 0 && read.head.is_none() {
        return serde_json::Value::Null;
    }
    page.section("Cycles");
    if let Some(error) = &read.head {
        page.note(
            Emphasis::Warning,
            &format!(
                "cycles.csv is not read: {error}. Was it changed, or written by a newer version?"
            ),
        );
    } else if unreadable > 0 {
        page.note(
            Emphasis::Warning,
            &format!("{unreadable} lines of cycles.csv are no rows."),
        );
    }
    if rows.is_empty() {
        return serde_json::Value::Null;
    }
    let count = |is: fn(&CycleRow) -> bool| rows.iter().filter(|row| is(row)).count();
    let disturbed = count(|row| row.flags.is_disturbed());
    let touched = count(|row| row.flags.is_touched() && !row.flags.is_disturbed());
    page.paragraph(&format!(
        "{} cycles, {disturbed} of them disturbed; in {touched} more something happened that touched less than a fiftieth of \
         their ticks.",
        rows.len()
    ));
    elsewhere(page, rows);
    let ramps = count(|row| row.flags.has(CycleFlags::RAMP));
    if ramps > 0 {
        page.paragraph(&format!(
            "{ramps} cycles in which a wave comes in or goes out are in cycles.csv, and in no trend."
        ));
    }
    let rest = AtRest::of(rows);
    at_rest(page, &rest);
    let groups = groups(rows);
    let mut table = Table::new([
        Column::left("of"),
        Column::left("quantity"),
        Column::left("motion"),
        Column::right("cycles"),
        Column::right("first cycles"),
        Column::right("last cycles"),
        Column::right("change per cycle"),
        Column::left("trend"),
        Column::left("saturating law"),
    ]);
    table.caption(
        "Means of the first and the last ten cycles (of each half, where there are fewer than twenty) with their 95 % intervals; \
         change per cycle: of a straight line. A trend is one when it is beyond three times the line's 95 % interval. The law: \
         end + (start - end) exp(-cycle/constant), told where the cycles say at what it saturates; * where it describes them \
         better than the line. Each motion by itself, skipped cycles and the static arm's way to its load and back left out. Stretch and areal stretch: largest length and \
         area over those at rest before the first cycle.",
    );
    let mut figure = Figure::new("cycles", "The cycles of the run, by motion.");
    let mut json = Vec::new();
    for quantity in &QUANTITIES {
        let mut panel = Panel::new(
            Axis::linear("cycle", ""),
            Axis::linear(axis_name(quantity.name), quantity.unit),
        )
        .height_px(160.0);
        let mut any = false;
        for group in &groups {
            let values: Vec<(u64, f64)> = group
                .rows
                .iter()
                .map(|row| (row.cycle, (quantity.of)(row, &rest)))
                .filter(|(_, value)| value.is_finite())
                .collect();
            if values.is_empty() {
                continue;
            }
            any = true;
            let x: Vec<f64> = values.iter().map(|(cycle, _)| *cycle as f64).collect();
            let y: Vec<f64> = values.iter().map(|(_, value)| *value).collect();
            panel = panel.series(Series::points(&group.name, &x, &y));
            if let Some(found) = trend(values) {
                row(&mut table, quantity, &group.name, &found);
                json.push(trend_json(quantity, group, &found));
            }
        }
        let shown = of_a_cell && OF_THE_CELL.contains(&quantity.name);
        if any && !shown {
            figure = figure.panel(panel);
        }
    }
    page.table(table);
    page.figure(figure.share_x());
    flags(page, rows);
    serde_json::Value::Array(json)
}

/// States the share of the length at rest in the uncertainty of every stretch.
fn at_rest(page: &mut Report, rest: &AtRest) {
    if let (true, true) = (rest.length_um.is_finite(), rest.length_sd_um.is_finite()) {
        page.paragraph(&format!(
            "Length at rest before the first cycle: {:.3} um, known to {:.3} um (standard deviation of the mean): every stretch is \
             uncertain by {:.2} % more (95 %) than its cycles scatter, all of them alike.",
            rest.length_um,
            rest.length_sd_um,
            100.0 * rest.stretch_ci95()
        ));
    }
}

/// Says how many cycles were not where the script had them.
fn elsewhere(page: &mut Report, rows: &[CycleRow]) {
    let elsewhere = rows.iter().filter(|row| was_elsewhere(row)).count();
    if elsewhere > 0 {
        page.note(
            Emphasis::Warning,
            &format!(
                "In {elsewhere} cycles bead or cell was elsewhere than the script had it (more than a tenth of the stroke from the \
                 target in the mean): they are in cycles.csv, and in no mean and no trend."
            ),
        );
    }
}

/// Cycles of one motion in one arm.
struct Group<'r> {
    arm: ArmKind,
    name: String,
    stroke_um: f64,
    duration_s: f64,
    rows: Vec<&'r CycleRow>,
}

/// Whether bead or cell was away from the script: its mean distance from the target exceeds a tenth of the stroke. In a good cycle it
/// is a few per cent. Its lengths are of another place in the channel.
pub fn was_elsewhere(row: &CycleRow) -> bool {
    const OF_STROKE: f64 = 0.1;
    row.arm == ArmKind::Cyclic && row.bias_um.abs() > OF_STROKE * row.stroke_um.abs()
}

/// Whether the bead moves to its load or back in a cycle of the static arm.
pub(super) fn on_the_way(row: &CycleRow) -> bool {
    const STILL_UM: f64 = 0.01;
    row.arm == ArmKind::Static && row.stroke_um > STILL_UM
}

/// Short name of a quantity for its axis.
fn axis_name(name: &str) -> &str {
    match name {
        "reached over commanded amplitude" => "reached / commanded",
        "neutral" => "zero flow",
        other => other,
    }
}

/// Largest number of motions shown; of a longer sweep the first ones.
const MOST_GROUPS: usize = 8;

/// The cycles by arm, stroke and duration: across amplitudes there is no trend.
fn groups(rows: &[CycleRow]) -> Vec<Group<'_>> {
    let mut groups: Vec<Group> = Vec::new();
    for row in rows {
        if row.flags.has(CycleFlags::RAMP)
            || row.flags.has(CycleFlags::SKIPPED)
            || on_the_way(row)
            || was_elsewhere(row)
        {
            continue;
        }
        let full = groups.len() == MOST_GROUPS;
        let known = groups.iter_mut().find(|group| {
            let stroke_um = match row.arm {
                ArmKind::Cyclic => group.stroke_um,
                // It goes to its load in the first cycle and comes back in the last.
                ArmKind::Static => row.stroke_um,
            };
            group.arm == row.arm && row.moves_as((stroke_um, group.duration_s))
        });
        match known {
            Some(group) => group.rows.push(row),
            // A row without records has no stroke.
            None if !full && row.stroke_um.is_finite() => groups.push(Group {
                arm: row.arm,
                name: String::new(),
                stroke_um: row.stroke_um,
                duration_s: row.duration_s,
                rows: vec![row],
            }),
            None => {}
        }
    }
    let cyclic = groups.iter().filter(|group| group.arm == ArmKind::Cyclic);
    let many = cyclic.count() > 1;
    for group in &mut groups {
        group.name = match (group.arm, many) {
            (ArmKind::Static, _) => "static".to_string(),
            (ArmKind::Cyclic, false) => "cyclic".to_string(),
            (ArmKind::Cyclic, true) => format!(
                "{} um, {} s",
                short(group.stroke_um),
                short(group.duration_s)
            ),
        };
    }
    groups
}

/// A number to three digits, without zeros behind it.
pub(super) fn short(value: f64) -> String {
    let text = format!("{value:.3}");
    text.trim_end_matches('0').trim_end_matches('.').to_string()
}

/// Half the width of the 95 % interval of a mean, by Student's t.
pub fn half95(values: &[f64]) -> f64 {
    let n = values.len();
    let mean = values.iter().sum::<f64>() / n as f64;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    cellpos_script::half95(squares, n.saturating_sub(1), n)
}

fn trend_json(quantity: &Quantity, group: &Group, found: &Trend) -> serde_json::Value {
    serde_json::json!({
        "of": quantity.of_what,
        "quantity": quantity.name,
        "unit": quantity.unit,
        "arm": match group.arm {
            ArmKind::Cyclic => "cyclic",
            ArmKind::Static => "static",
        },
        "motion": group.name,
        "stroke_um": group.stroke_um,
        "duration_s": group.duration_s,
        "cycles": found.cycles,
        "first": found.first.mean,
        "first_ci95": found.first.ci95,
        "first_cycles": found.first.cycles,
        "last": found.last.mean,
        "last_ci95": found.last.ci95,
        "last_cycles": found.last.cycles,
        "per_cycle": found.per_cycle,
        "ci95_per_cycle": found.ci95_per_cycle,
        "line_residual": found.residual,
        "significant": found.is_significant(),
        "saturating": found.saturating.map(|law| serde_json::json!({
            "start": law.start,
            "start_ci95": law.start_ci95,
            "end": law.end,
            "end_ci95": law.end_ci95,
            "cycles": law.cycles,
            "cycles_ci95": law.cycles_ci95,
            "residual": law.residual,
            "better_than_line": law.better_than_line,
        })),
    })
}

fn row(table: &mut Table, quantity: &Quantity, motion: &str, found: &Trend) {
    let name = match (quantity.name, quantity.unit) {
        ("neutral", unit) => format!("zero flow ({unit})"),
        (name, "") => name.to_string(),
        (name, unit) => format!("{name} ({unit})"),
    };
    let law = found.saturating.map_or_else(String::new, |law| {
        format!(
            "{} to {}, {} cycles{}",
            with_interval(law.start, law.start_ci95),
            with_interval(law.end, law.end_ci95),
            with_interval(law.cycles, law.cycles_ci95),
            if law.better_than_line { " *" } else { "" }
        )
    });
    table.row([
        quantity.of_what,
        name.as_str(),
        motion,
        &found.cycles.to_string(),
        &with_interval(found.first.mean, found.first.ci95),
        &with_interval(found.last.mean, found.last.ci95),
        &change(found.per_cycle, found.ci95_per_cycle),
        if found.is_significant() {
            "yes"
        } else {
            "none"
        },
        &law,
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

/// A change per cycle with half its interval; a quantity that never changes has none.
fn change(per_cycle: f64, ci95: f64) -> String {
    if per_cycle == 0.0 && ci95 == 0.0 {
        return "0".to_owned();
    }
    format!("{per_cycle:.1e}\u{a0}±\u{a0}{ci95:.0e}")
}
