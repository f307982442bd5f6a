//! One error of a run: the summary's, the exports' and the recorded stream's are the same number.

use crate::common::{number, succeed};

/// Columns of a CSV by name; an empty field is NaN, a word is NaN.
fn column(csv: &str, name: &str) -> Vec<f64> {
    let mut lines = csv.lines();
    let place = lines
        .next()
        .and_then(|head| head.split(',').position(|column| column == name))
        .unwrap_or_else(|| panic!("no column {name}"));
    lines
        .map(|line| {
            let field = line.split(',').nth(place).unwrap();
            field.parse().unwrap_or(f64::NAN)
        })
        .collect()
}

fn rms(values: impl Iterator<Item = f64>) -> f64 {
    let (mut n, mut sum) = (0.0, 0.0);
    for value in values.filter(|value| value.is_finite()) {
        (n, sum) = (n + 1.0, sum + value * value);
    }
    (sum / n).sqrt()
}

#[test]
fn the_error_of_a_moving_bead_is_the_same_in_the_summary_and_in_the_exports() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let run = succeed(
        at,
        "track --target 0um --sine 5um@20Hz --duration 6s --clock virtual --frames off --name moves --json",
    )
    .json();
    succeed(at, "export latest-moves --out ticks.csv --json");
    let csv = std::fs::read_to_string(at.join("ticks.csv")).unwrap();
    let (time_s, error_um) = (column(&csv, "time_s"), column(&csv, "error_um"));
    let (bead_um, target_um) = (column(&csv, "bead_um"), column(&csv, "target_um"));
    let end_s = time_s.last().unwrap();
    // Arming takes part of the first second; errors count from two seconds after it.
    let running = csv
        .lines()
        .skip(1)
        .position(|line| line.contains(",running,"));
    let from_s = time_s[running.unwrap()] + 2.0;
    let counted = |values: &[f64]| {
        let late = time_s
            .iter()
            .zip(values)
            .filter(|(s, _)| **s >= from_s - 1e-9);
        rms(late.map(|(_, value)| *value)) * 1e3
    };
    assert!(*end_s > from_s + 2.0);
    let stated_nm = number(&run, "rms_measured_nm");
    let exported_nm = counted(&error_um);
    assert!(
        // The summary counts moments without a fix through the estimate; an export has an error for each fix.
        (exported_nm / stated_nm - 1.0).abs() < 1e-2,
        "{exported_nm} exported, {stated_nm} stated"
    );
    // The reference moves by up to 1.2 um while a frame is on its way, so the reference of the row gives another number.
    let at_tick = bead_um.iter().zip(&target_um).map(|(b, t)| b - t);
    let apart = at_tick
        .zip(&error_um)
        .map(|(tick, error)| (tick - error).abs());
    let most_um = apart.filter(|um| um.is_finite()).fold(0.0, f64::max);
    assert!((1.0..1.4).contains(&most_um), "{most_um} um apart");
}
