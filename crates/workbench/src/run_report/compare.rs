//! Several runs on one page: cells and beads of a study, each with its uncertainty.

mod data;
mod shown;

use super::cycles::half95;
use super::session::folder_name;
use super::{Written, write};
use cellpos_report::{Emphasis, Report, digits_of, with_interval};
use cellpos_script::ArmKind;
use cellpos_session::Failure;
use data::{ARMS, BEAD, CELL, Compared, Ends, Quantity};
use serde::Serialize;
use shown::{errors, over_cycles, table_of_ends, table_of_runs};
use std::path::{Path, PathBuf};

/// Names of the runs; where two are alike, of their folders.
fn names(runs: &[PathBuf]) -> Vec<String> {
    let folders: Vec<String> = runs.iter().map(|run| folder_name(run)).collect();
    let short = |folder: &str| match folder.split_once('-') {
        Some((time, name)) if time.ends_with('Z') => name.to_owned(),
        _ => folder.to_owned(),
    };
    let shorts: Vec<String> = folders.iter().map(|folder| short(folder)).collect();
    (folders.iter().zip(&shorts))
        .map(|(folder, name)| {
            let alike = shorts.iter().filter(|other| *other == name).count() > 1;
            if alike { folder.clone() } else { name.clone() }
        })
        .collect()
}

/// Figures of a page of several runs.
#[derive(Debug, Serialize)]
pub struct FiguresOfMany {
    runs: Vec<Compared>,
}

/// Writes the page of several runs; without `out`, comparison.html here.
///
/// # Errors
/// As [`super::one`].
pub fn compared(runs: &[PathBuf], out: Option<&Path>) -> Result<Written<FiguresOfMany>, Failure> {
    let mut compared = Vec::new();
    for (run, name) in runs.iter().zip(names(runs)) {
        compared.push(Compared::open(run, name)?);
    }
    let (page, result) = page(&compared);
    Ok(Written {
        out: write(
            &page,
            out.map_or_else(|| PathBuf::from("comparison.html"), Path::to_owned),
        )?,
        result,
        figures: FiguresOfMany { runs: compared },
    })
}

/// What the page compares: the quantities that at least one run has.
fn quantities(compared: &[Compared]) -> &'static [Quantity] {
    let has = |quantity: &Quantity| {
        let mut runs = compared.iter();
        runs.any(|run| {
            ARMS.iter()
                .any(|arm| run.end(*arm, quantity.name).is_some())
        })
    };
    match (has(&CELL[0]), BEAD.iter().any(has)) {
        (true, _) => &CELL,
        (false, true) => &BEAD,
        (false, false) => &[],
    }
}

fn page(compared: &[Compared]) -> (Report, String) {
    let mut page = Report::new(&format!("{} runs compared", compared.len()));
    page.lead(&lead(compared));
    let quantities = quantities(compared);
    let mut parts: Vec<String> = ARMS
        .iter()
        .filter_map(|arm| of_an_arm(compared, *arm, quantities))
        .collect();
    let sure = match (parts.is_empty(), compared.len()) {
        (true, _) => {
            "\u{b1} is the 95 % interval of each run, from its own length. Errors have the noise of the camera in them.".to_owned()
        }
        (false, 1) => "\u{b1} is the 95 % interval within this one run.".to_owned(),
        (false, n) => format!(
            "\u{b1} is the 95 % interval of the mean of {n} runs, from how they differ (Student's t); first and last: ten cycles of each \
             run. Runs of one sample that are alike tell nothing about other samples. Stretch: largest length over that at rest; recovery \
             time: its time constant."
        ),
    };
    if parts.is_empty() {
        parts.extend(of_holds(compared));
    }
    let done = compared
        .iter()
        .filter(|run| run.emphasis == Emphasis::Good)
        .count();
    if done < compared.len() {
        parts.push(format!(
            "{done} of {} runs came to their end.",
            compared.len()
        ));
    }
    let sentence = parts.join(" ");
    let status = match done == compared.len() {
        true => Emphasis::Good,
        false => Emphasis::Warning,
    };
    page.result(status, &sentence);
    page.certainty(&sure);
    page.figure(match quantities.is_empty() {
        true => errors(compared),
        false => over_cycles(compared, quantities),
    });
    page.section("The runs");
    if !quantities.is_empty() {
        page.table(table_of_ends(compared, quantities));
    }
    page.table(table_of_runs(compared));
    if !quantities.is_empty() {
        page.figure(errors(compared));
    }
    page.section("What was run");
    // The first line of the page has the tasks.
    let said = compared.iter().map(|run| {
        let (name, started) = (&run.name, &run.started);
        format!("{name}: {started}, {}", run.run.display())
    });
    page.list(&said.collect::<Vec<_>>());
    (page, sentence)
}

/// What the runs had in common, or the task of each.
fn lead(compared: &[Compared]) -> String {
    let names: Vec<&str> = compared.iter().map(|run| run.name.as_str()).collect();
    let names = names.join(", ");
    match compared.split_first() {
        Some((first, others)) if others.iter().all(|run| run.task == first.task) => {
            format!("{} Done {} times: {names}.", first.task, compared.len())
        }
        _ => {
            let tasks = compared.iter().map(|run| {
                let task = run.task.strip_prefix("Task: ").unwrap_or(&run.task);
                format!("{}: {task}", run.name)
            });
            tasks.collect::<Vec<_>>().join(" ")
        }
    }
}

/// What became of an arm: mean over the runs of the first and of the last cycles, and whether the change is beyond chance.
fn of_an_arm(compared: &[Compared], arm: ArmKind, quantities: &[Quantity]) -> Option<String> {
    let mut said = Vec::new();
    let mut most = 0;
    // The third of a cell's, its length, is in table and figure.
    for quantity in quantities.iter().take(2) {
        let ends: Vec<&Ends> = compared
            .iter()
            .filter_map(|run| run.end(arm, quantity.name))
            .collect();
        let count = ends.len() as f64;
        most = most.max(ends.len());
        let unit = match quantity.unit {
            "" => String::new(),
            unit => format!(" {unit}"),
        };
        let text = match ends.as_slice() {
            [] => continue,
            [one] => format!(
                "{} from {} to {}{unit}",
                quantity.name,
                with_interval(one.first, one.first_ci95),
                with_interval(one.last, one.last_ci95)
            ),
            many => {
                let mean = |of: &dyn Fn(&Ends) -> f64| {
                    let values: Vec<f64> = many.iter().map(|ends| of(ends)).collect();
                    (values.iter().sum::<f64>() / count, half95(&values))
                };
                let (first, last) = (mean(&|ends| ends.first).0, mean(&|ends| ends.last).0);
                let (change, ci95) = mean(&|ends| ends.last - ends.first);
                let changed = with_interval(change.abs(), ci95);
                let digits = digits_of(ci95);
                match change.abs() > ci95 {
                    true => format!(
                        "{} {} by {changed}{unit}, from {first:.digits$} to {last:.digits$}{unit}",
                        quantity.name,
                        if change < 0.0 { "fell" } else { "rose" },
                    ),
                    false => format!(
                        "{} was {first:.digits$} at first and {last:.digits$}{unit} at last, no change beyond the scatter between runs (\u{b1}\u{a0}{ci95:.digits$}{unit})",
                        quantity.name
                    ),
                }
            }
        };
        said.push(text);
    }
    let of = match (most, arm) {
        (0, _) => return None,
        (1, ArmKind::Cyclic) => "Over the cycles of one run".to_owned(),
        (1, ArmKind::Static) => "Under a static load, in one run".to_owned(),
        (n, ArmKind::Cyclic) => format!("Over the cycles, mean of {n} runs"),
        (n, ArmKind::Static) => format!("Under a static load, mean of {n} runs"),
    };
    Some(format!("{of}: {}.", said.join(", ")))
}

/// Beads that were held: the smallest and the largest error.
fn of_holds(compared: &[Compared]) -> Option<String> {
    let held = || compared.iter().filter_map(|run| Some((run, run.rms_nm?)));
    let least = held().min_by(|a, b| a.1.total_cmp(&b.1))?;
    let most = held().max_by(|a, b| a.1.total_cmp(&b.1))?;
    let ci95_nm = |run: &Compared| run.rms_ci95_nm.unwrap_or(f64::NAN);
    let said = |(run, nm): (&Compared, f64)| {
        let error = with_interval(nm, ci95_nm(run));
        let possible = run
            .bound_rms_nm
            .map(|nm| format!(" (lowest possible {nm:.0})"));
        format!(
            "in {}, {error} nm RMS{}",
            run.name,
            possible.unwrap_or_default()
        )
    };
    let chance_nm = ci95_nm(least.0).hypot(ci95_nm(most.0));
    let difference = match most.1 - least.1 > chance_nm {
        true => "a difference beyond chance",
        false if chance_nm.is_nan() => "what of it is chance is not known",
        false => "no difference beyond chance",
    };
    Some(format!(
        "The error was smallest {} and largest {}: {difference}.",
        said(least),
        said(most)
    ))
}

#[cfg(test)]
mod tests {
    use super::data::{arm_name, values};
    use super::*;
    use cellpos_script::{CycleRow, trend};

    fn run(name: &str, arm: ArmKind, fall: f64) -> Compared {
        let rows: Vec<CycleRow> = (0..40)
            .map(|cycle| {
                let mut row = CycleRow::empty(cycle, 1, arm);
                (row.start_s, row.duration_s) = (cycle as f64, 1.0);
                row.length_start_um = 5.0;
                row.recovery_s = 3.8 - fall * cycle as f64;
                row
            })
            .collect();
        let points = values(&rows, arm, &CELL[1]);
        let found = trend(points.iter().map(|(cycle, value)| (*cycle as u64, *value))).unwrap();
        Compared {
            run: PathBuf::from(name),
            name: name.to_owned(),
            outcome: String::new(),
            duration_s: 40.0,
            cycles: rows.len(),
            cycles_elsewhere: 0,
            rms_nm: Some(50.0),
            rms_ci95_nm: Some(1.0),
            bound_rms_nm: Some(44.0),
            ends: vec![Ends {
                arm: arm_name(arm),
                quantity: "recovery time",
                unit: "s",
                cycles: found.cycles,
                first: found.first.mean,
                first_ci95: found.first.ci95,
                last: found.last.mean,
                last_ci95: found.last.ci95,
            }],
            emphasis: Emphasis::Good,
            task: String::new(),
            started: String::new(),
            rows,
        }
    }

    /// Cyclic cells that change alike have changed; static ones that scatter about nothing have not.
    #[test]
    fn a_change_is_stated_only_beyond_the_scatter_between_runs() {
        let study = [
            run("a", ArmKind::Cyclic, 0.010),
            run("b", ArmKind::Cyclic, 0.011),
            run("c", ArmKind::Cyclic, 0.009),
            run("d", ArmKind::Static, 0.001),
            run("e", ArmKind::Static, -0.001),
        ];
        let cyclic = of_an_arm(&study, ArmKind::Cyclic, &CELL).unwrap();
        assert!(
            cyclic.starts_with("Over the cycles, mean of 3 runs"),
            "{cyclic}"
        );
        // Thirty cycles lie between the middles of the first and the last ten.
        assert!(
            cyclic.contains("fell by 0.300\u{a0}±\u{a0}0.075 s, from 3."),
            "{cyclic}"
        );
        let fixed = of_an_arm(&study, ArmKind::Static, &CELL).unwrap();
        assert!(fixed.contains("no change beyond the scatter"), "{fixed}");
        assert!(of_an_arm(&study[..3], ArmKind::Static, &CELL).is_none());
    }

    #[test]
    fn runs_of_one_name_are_told_apart_by_their_folders() {
        let runs = |names: &[&str]| names.iter().map(PathBuf::from).collect::<Vec<_>>();
        let two = runs(&["runs/20261121T190000Z-cell", "runs/20261122T190000Z-cell"]);
        assert_eq!(
            names(&two),
            ["20261121T190000Z-cell", "20261122T190000Z-cell"]
        );
        let others = runs(&["runs/20261121T190000Z-a-b", "runs/other"]);
        assert_eq!(names(&others), ["a-b", "other"]);
    }

    #[test]
    fn holds_are_compared_by_their_errors() {
        let mut study = [
            run("a", ArmKind::Cyclic, 0.0),
            run("b", ArmKind::Cyclic, 0.0),
        ];
        (study[1].rms_nm, study[1].bound_rms_nm) = (Some(80.0), None);
        let text = of_holds(&study).unwrap();
        assert_eq!(
            text,
            "The error was smallest in a, 50.0\u{a0}±\u{a0}1.0 nm RMS (lowest possible 44) and largest in b, 80.0\u{a0}±\u{a0}1.0 nm RMS: a difference beyond chance."
        );
    }
}
