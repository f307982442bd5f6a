//! `cellpos run --cells`: one cell after the other.

use crate::common::{cellpos, number, succeed};

#[test]
fn one_cell_after_the_other_goes_through_the_script_into_one_table() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let wave = "name = \"wave\"\n[[step]]\ndo = \"sine\"\namplitude = \"1um\"\nfrequency = \"20Hz\"\ncycles = 30\n";
    std::fs::write(at.join("wave.toml"), wave).unwrap();
    let line = "run wave.toml --cells 3 --clock virtual --frames off --json";
    let queue = succeed(at, line).json();
    let cells = queue["cells"].as_array().unwrap();
    assert_eq!(
        (queue["schema"].as_str(), cells.len()),
        (Some("cellpos.cells"), 3)
    );
    let mut errors = Vec::new();
    for (place, cell) in (1..).zip(cells) {
        assert_eq!(cell["cell"], place);
        assert_eq!(
            (cell["outcome"].as_str(), cell["cycles"].as_u64()),
            (Some("done"), Some(30))
        );
        // Each is a run like any other.
        let run = cell["run"].as_str().unwrap();
        let replay = succeed(at, &format!("replay {run} --json")).json();
        assert_eq!(replay["identical"], replay["ticks"]);
        errors.push(number(cell, "cycle_rms_nm"));
    }
    assert!(
        errors[0] != errors[1] && errors[1] != errors[2],
        "another bead each time: {errors:?}"
    );
    let table = std::fs::read_to_string(at.join(queue["table"].as_str().unwrap())).unwrap();
    assert_eq!(table.lines().count(), 1 + 3);
    let page = std::fs::read_to_string(at.join(queue["page"].as_str().unwrap())).unwrap();
    assert!(page.contains("3 of 3 cells"));
    // A script that stops ends its cell, not the queue; the exit code says that not all came to the end.
    let stops = format!("{wave}[stop]\nafter_cycles = 5\nerror_above = \"1nm\"\n");
    std::fs::write(at.join("stops.toml"), stops).unwrap();
    let ran = cellpos(
        at,
        "run stops.toml --cells 2 --clock virtual --frames off --json",
    );
    assert_eq!(ran.code, Some(1), "{}", ran.err);
    let queue = ran.json();
    assert_eq!(queue["cells"].as_array().map(Vec::len), Some(2), "{queue}");
    assert_eq!(queue["cells"][1]["outcome"], "stopped");
}

/// A cell that has not recovered before the next cycle: its stretch is by its length at first, in the table of the queue as in the
/// report of its run.
#[test]
fn a_cells_stretch_is_one_number_in_the_table_of_the_queue_and_in_the_report_of_its_run() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let script = "name = \"quick\"\n[[step]]\ndo = \"repeat\"\ntimes = 24\n\
                  [[step.step]]\ndo = \"move\"\nto = \"8um\"\nduration = \"200ms\"\n[[step.step]]\ndo = \"hold\"\nduration = \"300ms\"\n\
                  [[step.step]]\ndo = \"move\"\nto = \"0um\"\nduration = \"200ms\"\n[[step.step]]\ndo = \"hold\"\nduration = \"100ms\"\n";
    std::fs::write(at.join("quick.toml"), script).unwrap();
    let rig = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/cell.toml");
    let queue = succeed(
        at,
        &format!(
            "run quick.toml --cells 1 --rig {} --clock virtual --frames off --json",
            rig.display()
        ),
    )
    .json();
    let cell = &queue["cells"][0];
    // A mean over the rest before the first cycle, with its uncertainty: a frame of this camera is known to 0.05 um.
    let (rest_um, sd_um) = (
        number(cell, "rest_length_um"),
        number(cell, "rest_length_sd_um"),
    );
    assert!(sd_um < 0.02, "{cell}");
    assert!((rest_um - 8.0).abs() < 4.0 * sd_um, "{rest_um} +- {sd_um}");
    let (stretch, ci95) = (
        number(cell, "stretch_first"),
        number(cell, "stretch_first_ci95"),
    );
    assert!(
        ci95 >= 1.96 * stretch * sd_um / rest_um,
        "the length at rest is in it: {cell}"
    );
    let report = succeed(
        at,
        &format!("report {} --json", cell["run"].as_str().unwrap()),
    )
    .json();
    for (quantity, first, last) in [
        ("stretch", "stretch_first", "stretch_last"),
        ("recovery time", "recovery_first_s", "recovery_last_s"),
    ] {
        let trends = report["trends"].as_array().unwrap();
        let trend = trends
            .iter()
            .find(|trend| trend["quantity"] == quantity)
            .unwrap();
        for (of_cell, of_report) in [(first, "first"), (last, "last")] {
            let (a, b) = (number(cell, of_cell), number(trend, of_report));
            assert!((a / b - 1.0).abs() < 1e-9, "{quantity}: {a} and {b}");
        }
    }
    let trends = report["trends"].as_array().unwrap();
    let start = trends
        .iter()
        .find(|trend| trend["quantity"] == "length at cycle start")
        .unwrap();
    let left = number(start, "last") / number(cell, "rest_length_um");
    assert!(left > 1.1, "it recovers in time and tells nothing: {left}");
}
