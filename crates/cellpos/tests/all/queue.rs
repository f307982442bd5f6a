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
