//! A motion that no loop can follow is refused before anything moves: `cellpos run` with a script, `track` with a rig that does not fit.

use crate::common::{cellpos, number, succeed};

fn wave(frequency: &str) -> String {
    format!(
        "name = \"wave\"\n[[step]]\ndo = \"hold\"\nduration = \"200ms\"\n[[step]]\ndo = \"sine\"\namplitude = \"1um\"\n\
         frequency = \"{frequency}\"\ncycles = 40\n"
    )
}

#[test]
fn a_script_is_followed_by_every_law_and_refused_beyond_half_its_rate() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("fast.toml"), wave("60Hz")).unwrap();
    let run = |controller: &str| {
        let line = format!("run fast.toml --dry --json --controller {controller}");
        succeed(folder.path(), &line)
    };
    for law in ["pi", "mpc"] {
        let ran = run(law);
        let said = format!("{} {}", ran.err, ran.json());
        assert!(!said.contains("predicted to be missed"), "{law}: {said}");
        assert!(number(&ran.json(), "cycle_rms_nm") < 100.0, "{law}: {said}");
    }
    // Three ticks a period: the PZT stands still between them.
    std::fs::write(
        folder.path().join("fast.toml"),
        wave("300Hz").replace("1um", "0.3um"),
    )
    .unwrap();
    let said = run("lqg").json().to_string();
    assert!(said.contains("predicted to be missed"), "{said}");
    // Half of 500 ticks a second.
    std::fs::write(folder.path().join("beyond.toml"), wave("300Hz")).unwrap();
    std::fs::write(
        folder.path().join("slow.toml"),
        "[timing]\nperiod_us = 2000.0\n[emulator]\nrate_hz = 500.0\n",
    )
    .unwrap();
    let ran = cellpos(
        folder.path(),
        "run beyond.toml --rig slow.toml --dry --json",
    );
    assert_eq!(ran.code, Some(2), "{}", ran.err);
    // The terminal breaks lines where it likes.
    let said: Vec<&str> = ran.err.split([' ', '\n', '│']).collect();
    let said: String = said.concat();
    assert!(
        said.contains("at250Hzorfaster") && said.contains("beyond.toml:5"),
        "{}",
        ran.err
    );
}

#[test]
fn track_and_rig_check_say_the_same_of_a_rig_file_and_an_error_ends_both() {
    let folder = tempfile::tempdir().unwrap();
    // Every frame would be stale.
    std::fs::write(
        folder.path().join("rig.toml"),
        "[timing]\nperiod_us = 1000.0\noldest_ms = 1.5\n",
    )
    .unwrap();
    let check = cellpos(folder.path(), "rig check rig.toml");
    let track = "track --rig rig.toml --target 0um --duration 300ms --clock virtual --frames off --no-record";
    let refused = cellpos(folder.path(), track);
    assert_eq!(
        (check.code, refused.code),
        (Some(1), Some(2)),
        "{}",
        refused.err
    );
    for said in [&check.out, &refused.err] {
        assert!(said.contains("oldest_ms = 1.5"), "{said}");
    }
    assert!(refused.err.contains("--anyway"), "{}", refused.err);
    let anyway = cellpos(folder.path(), &format!("{track} --anyway"));
    assert_ne!(anyway.code, Some(2), "{}", anyway.err);
    // A camera that is slower than the loop is predicted through: both say so, and none refuses it.
    std::fs::write(
        folder.path().join("slow.toml"),
        "[emulator]\nrate_hz = 500.0\n",
    )
    .unwrap();
    let check = cellpos(folder.path(), "rig check slow.toml");
    assert_eq!(check.code, Some(0), "{}", check.out);
    let ran = succeed(
        folder.path(),
        "track --rig slow.toml --target 0um --duration 2s --clock virtual --frames off --no-record",
    );
    for said in [&check.out, &ran.err] {
        assert!(said.contains("rate_hz = 500"), "{said}");
    }
}

#[test]
fn the_bound_is_that_of_the_delay_that_was_measured_not_of_the_one_that_was_set() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(
        folder.path().join("rig.toml"),
        "[emulator]\nlatency_ms = 1.0\n[timing]\ncamera_delay_ms = 2.0\n",
    )
    .unwrap();
    let line = "track --rig rig.toml --target 0um --controller pi --duration 6s --clock virtual --frames off --json --no-record";
    let r = succeed(folder.path(), line).json();
    // 2 ms of Brownian motion at 0.33 um^2/s that no command can answer; 44.5 nm for the 3 ms of the file.
    let bound = number(&r, "bound_rms_nm");
    assert!((bound - 36.3).abs() < 1.0, "{bound}");
    assert!(number(&r, "rms_true_nm") > 0.9 * bound, "{r}");
}
