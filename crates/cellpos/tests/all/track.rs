//! `cellpos track` as a user runs it, on the virtual clock: how well it holds, what it prints, what it records.

use crate::common::{cellpos, number, succeed};
use cellpos_plant::Model;
use std::path::Path;

fn track(folder: &Path, options: &str) -> serde_json::Value {
    succeed(folder, &format!("track --clock virtual --json {options}")).json()
}

/// A model.toml of the nominal plant with another gain.
fn model_with_gain(folder: &Path, ratio: f64) {
    let text = format!(
        "working_point_um = 20.0\n\n[plant]\nnum = [0.01872, 379.29528, 32667.16752]\nden = [1.0, 76.3, 0.13]\n\n[[effects]]\nid = \"gain-error\"\nfactor = {ratio}\n"
    );
    std::fs::write(folder.join("plant.toml"), text).unwrap();
    std::fs::write(
        folder.join("rig.toml"),
        "[emulator]\nmodel = \"plant.toml\"\n",
    )
    .unwrap();
}

#[test]
fn a_bead_is_held_through_frames_within_reach_of_the_lowest_possible_error() {
    let folder = tempfile::tempdir().unwrap();
    let r = track(
        folder.path(),
        "--target 0um --duration 10s --frames on --ideal --seed 7",
    );
    assert_eq!(r["state"], "running");
    assert_eq!(number(&r, "ticks"), 10_000.0);
    for key in ["late", "skipped", "stale", "frames_lost"] {
        assert_eq!(number(&r, key), 0.0, "{key}");
    }
    let bound = number(&r, "bound_rms_nm");
    assert!((bound - 44.5).abs() < 0.2, "{bound}");
    let rms = number(&r, "rms_true_nm");
    assert!(
        rms <= 1.45 * bound && rms > 0.95 * bound,
        "{rms} against {bound}"
    );
    assert!((number(&r, "loop_delay_ms") - 2.5).abs() < 0.01);
    for stage in ["tick_us", "wake_us"] {
        for quantile in ["p50", "p99", "p999", "max"] {
            assert!(r[stage][quantile].is_number(), "{stage} {quantile}");
        }
    }
    assert!(r["conditions"]["degraded"].is_array());
    assert!(
        folder
            .path()
            .join(r["run"].as_str().unwrap())
            .join("run.toml")
            .is_file()
    );
}

#[test]
fn a_seed_fixes_every_bit_and_a_replay_gives_every_command_again() {
    let folder = tempfile::tempdir().unwrap();
    let ticks = |name: &str| {
        let r = track(
            folder.path(),
            &format!("--target 1um --duration 2s --frames on --seed 7 --name {name}"),
        );
        let run = folder.path().join(r["run"].as_str().unwrap());
        (run.clone(), std::fs::read(run.join("ticks.arrow")).unwrap())
    };
    let (run, first) = ticks("one");
    let (_, second) = ticks("two");
    assert!(first == second, "two runs with one seed differ");

    let run = run.display().to_string();
    let replay = succeed(folder.path(), &format!("replay {run} --json")).json();
    assert_eq!(number(&replay, "ticks"), 2000.0, "{replay}");
    assert_eq!(number(&replay, "identical"), 2000.0, "{replay}");

    succeed(
        folder.path(),
        &format!("export {run} --format csv --out t.csv"),
    );
    let csv = std::fs::read_to_string(folder.path().join("t.csv")).unwrap();
    assert!(csv.starts_with("time_s,pzt_um,bead_um"), "{}", &csv[..80]);
    assert_eq!(csv.lines().count(), 2001);
}

#[test]
fn a_step_of_ten_micrometres_settles_in_60_ms_with_little_overshoot() {
    let folder = tempfile::tempdir().unwrap();
    for seed in 1..=6 {
        let r = track(
            folder.path(),
            &format!("--target 10um --duration 1s --frames off --no-record --seed {seed}"),
        );
        let settling = number(&r["step"], "settling_ms");
        let overshoot = number(&r["step"], "overshoot_percent");
        assert!(
            settling < 60.0 && overshoot < 15.0,
            "seed {seed}: {settling} ms, {overshoot} %"
        );
        assert_eq!(r["state"], "running");
    }
}

#[test]
fn a_drift_leaves_no_steady_error() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(
        folder.path().join("rig.toml"),
        "[emulator]\ndrift_um_per_s = 10.0\n",
    )
    .unwrap();
    let r = track(
        folder.path(),
        "--target 0um --duration 20s --frames off --no-record --rig rig.toml",
    );
    // Brownian motion averages to nothing over 18 s: 58 nm RMS, correlated over some 5 ms, gives 1 nm.
    assert!(number(&r, "mean_error_nm").abs() < 4.0, "{r}");
    assert!(number(&r, "rms_true_nm") < 1.45 * number(&r, "bound_rms_nm"));
}

#[test]
fn the_loop_is_stable_for_half_and_for_twice_the_gain() {
    let folder = tempfile::tempdir().unwrap();
    for ratio in [0.5, 0.7, 1.4, 2.0] {
        model_with_gain(folder.path(), ratio);
        let r = track(
            folder.path(),
            "--target 5um --duration 5s --frames off --no-record --rig rig.toml",
        );
        assert_eq!(r["state"], "running", "gain x {ratio}");
        // At twice the gain the loop rings, which multiplies the Brownian error; unstable, it would be micrometres.
        assert!(number(&r, "rms_true_nm") < 200.0, "gain x {ratio}: {r}");
    }
}

#[test]
fn a_plant_with_the_wrong_sign_or_gain_is_not_run_at_all() {
    let folder = tempfile::tempdir().unwrap();
    for (ratio, refusal) in [(-1.0, "wrong-sign"), (4.0, "wrong-gain")] {
        model_with_gain(folder.path(), ratio);
        let ran = cellpos(
            folder.path(),
            "track --target 0um --duration 3s --clock virtual --frames off --json --rig rig.toml",
        );
        assert_eq!(ran.code, Some(1), "{}\n{}", ran.out, ran.err);
        let r = ran.json();
        assert_eq!(r["safe_reason"], "arming-refused", "{r}");
        let run = folder.path().join(r["run"].as_str().unwrap());
        let events = std::fs::read_to_string(run.join("events.jsonl")).unwrap();
        assert!(events.contains(refusal), "{events}");
    }
}

#[test]
fn what_cannot_be_is_refused_with_what_would_be_right() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
    write("unknown.toml", "[timing]\ncamera_delay = 2.0\n");
    write("nan.toml", "[limits]\nlow_um = nan\n");
    write("cut.toml", "[timing]\ncamera_delay_ms = ");
    write("half.toml", "[camera]\nkind = \"socket\"\nsocket = \"s\"\n");
    for (line, says) in [
        ("track --target 0", "0um"),
        ("track --target 3s", "um"),
        ("track --target 500um", "field of view"),
        ("track --target 0um --duration 10", "10s"),
        ("track --target 0um --duration 0s", "10s"),
        ("track --target 0um --controller fast", "mpc"),
        ("track --target 0um --controller none.toml", "none.toml"),
        ("track --target 0um --model none.toml", "none.toml"),
        ("track --target 0um --rig none.toml", "none.toml"),
        ("track --target 0um --rig unknown.toml", "camera_delay_ms"),
        ("track --target 0um --rig nan.toml", "low_um"),
        ("track --target 0um --rig cut.toml", "cut.toml:2"),
        ("track --target 0um --rig half.toml", "emulated"),
        ("replay nowhere", "nowhere"),
        ("export nowhere --format csv", "nowhere"),
    ] {
        let ran = cellpos(folder.path(), line);
        assert_eq!(ran.code, Some(2), "{line}\n{}", ran.err);
        // The message may be wrapped: compare without the frame that a terminal gets.
        let text: String = ran.err.replace(['│', '\n'], " ");
        let text = text.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(text.contains(says), "{line}: no `{says}` in\n{}", ran.err);
    }
    assert!(
        !folder.path().join("runs").exists(),
        "a refused run left a folder"
    );
}

#[test]
fn the_example_files_load() {
    let folder = tempfile::tempdir().unwrap();
    let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples");
    for name in ["model.toml", "controller.toml"] {
        std::fs::copy(examples.join(name), folder.path().join(name)).unwrap();
    }
    track(
        folder.path(),
        "--target 0um --duration 1s --frames off --no-record --controller controller.toml --model model.toml",
    );
    // The example rig names a port that is not there; an error about that port shows that the file was read.
    let rig = examples.join("rig.toml").display().to_string();
    let ran = cellpos(folder.path(), &format!("track --target 0um --rig {rig}"));
    assert_eq!(ran.code, Some(2));
    assert!(ran.err.contains("[actuator] port"), "{}", ran.err);
}

#[test]
fn previewed_sines_are_followed_within_1_5_times_the_hold_error_where_the_model_is_right() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(
        folder.path().join("rig.toml"),
        "[emulator]\nideal = true\nlocalisation_um = 0.02\n",
    )
    .unwrap();
    for controller in ["lqg", "mpc --solver active-set"] {
        let rms = |sine: &str| {
            let line = format!(
                "--target 0um --controller {controller} --duration 4s --frames off --seed 5 --no-record --rig rig.toml {sine}"
            );
            number(&track(folder.path(), &line), "rms_true_nm")
        };
        let hold = rms("");
        for sine in ["5um@50Hz", "5um@100Hz", "0.5um@300Hz"] {
            let followed = rms(&format!("--sine {sine}"));
            assert!(
                followed <= 1.5 * hold,
                "{controller}, {sine}: {followed} against {hold} nm"
            );
        }
    }
}

#[test]
fn a_sine_of_300_hz_is_learned_to_twice_the_hold_error_with_half_a_millisecond_of_exposure() {
    let folder = tempfile::tempdir().unwrap();
    model_with_gain(folder.path(), 1.2);
    std::fs::write(
        folder.path().join("rig.toml"),
        "[emulator]\nideal = true\nmodel = \"plant.toml\"\n[timing]\ncamera_delay_ms = 1.75\n",
    )
    .unwrap();
    let line = "track --target 0um --controller lqg --duration 4s --clock virtual --frames off --seed 5 --no-record --json --rig rig.toml";
    let hold = number(&succeed(folder.path(), line).json(), "rms_true_nm");
    for sine in ["5um@100Hz", "1um@200Hz", "0.5um@300Hz"] {
        let r = succeed(folder.path(), &format!("{line} --sine {sine} --learn")).json();
        let learned = number(&r, "rms_true_nm");
        assert!(learned <= 2.0 * hold, "{sine}: {learned} against {hold} nm");
    }
}

#[test]
fn a_bead_that_is_drawn_out_over_its_frames_is_seen_in_each_of_them() {
    let folder = tempfile::tempdir().unwrap();
    // One run of three seconds scatters by 2 nm.
    let runs = [3, 4, 5, 6].map(|seed| {
        let line = format!(
            "--target 0um --controller lqg --duration 3s --ideal --seed {seed} --no-record --sine 5um@100Hz"
        );
        let r = track(folder.path(), &line);
        assert!(number(&r, "fixes_lost") < 10.0, "{seed}: {r}");
        number(&r, "rms_true_nm")
    });
    let rms = runs.iter().sum::<f64>() / 4.0;
    assert!(rms < 70.0, "{runs:?} nm");
}

#[test]
fn a_sine_is_learned_kept_with_the_run_replayed_and_gone_on_from() {
    let folder = tempfile::tempdir().unwrap();
    model_with_gain(folder.path(), 0.8);
    let line = "track --target 0um --ideal --sine 5um@100Hz --controller mpc --solver active-set --duration 2.6s --clock virtual --frames off --seed 3 --rig rig.toml --adapt off --json";
    let without = succeed(folder.path(), line).json();
    let with = succeed(folder.path(), &format!("{line} --learn")).json();
    assert!(number(&with, "rms_true_nm") < 100.0, "{with}");
    assert!(number(&without, "rms_true_nm") > 3.0 * number(&with, "rms_true_nm"));
    let run = with["run"].as_str().unwrap();
    let kept = std::fs::read_to_string(folder.path().join(run).join("learned.toml")).unwrap();
    assert!(kept.contains("gain_source = \"assumed\""), "{kept}");
    // With a model whose gain and delay are known, by their intervals.
    let known = Model {
        intervals: [
            ("gain_per_s".to_owned(), [426.0, 430.0]),
            ("delay_ms".to_owned(), [1.9, 2.1]),
        ]
        .into(),
        ..Model::eq6()
    };
    std::fs::write(folder.path().join("known.toml"), known.to_toml_string()).unwrap();
    let by_model = succeed(
        folder.path(),
        &format!("{} --learn --model known.toml", line.replace("2.6s", "1s")),
    )
    .json();
    let margins = &by_model["learned"]["margins"];
    assert_eq!(margins["gain_source"], "floor", "{by_model}");
    assert_eq!(margins["delay_source"], "identified", "{by_model}");
    succeed(folder.path(), &format!("replay {run}"));
    let again = succeed(
        folder.path(),
        &format!("{line} --learn --learned {run}/learned.toml"),
    )
    .json();
    let first = number(&again["learned"], "error_before_um");
    assert!(
        first < 0.15,
        "the first cycles are already good: {first} um"
    );
    let other = cellpos(
        folder.path(),
        &format!(
            "track --target 0um --sine 5um@50Hz --learn --learned {run}/learned.toml --clock virtual --duration 1s"
        ),
    );
    assert_eq!(other.code, Some(2));
    assert!(other.err.contains("100 Hz"), "{}", other.err);
}

#[test]
fn a_sine_that_no_loop_can_follow_is_refused_and_every_law_follows_the_others() {
    let folder = tempfile::tempdir().unwrap();
    let line = "track --target 0um --duration 3s --clock virtual --frames off --no-record";
    for (sine, word) in [
        ("5um@600Hz", "500 Hz"),
        ("5um@500Hz", "500 Hz"),
        ("12um@200Hz", "slew"),
    ] {
        let output = cellpos(folder.path(), &format!("{line} --sine {sine}"));
        assert_eq!(output.code, Some(2), "{sine}: {}", output.err);
        assert!(output.err.contains(word), "{sine}: {}", output.err);
    }
    let narrow = "[limits]\nlow_um = 18.0\nhigh_um = 22.0\npark_um = 20.0\n";
    std::fs::write(folder.path().join("narrow.toml"), narrow).unwrap();
    let output = cellpos(
        folder.path(),
        &format!("{line} --rig narrow.toml --sine 5um@50Hz"),
    );
    assert_eq!(output.code, Some(2), "{}", output.err);
    assert!(output.err.contains("18 to 22 um"), "{}", output.err);
    for law in ["pi", "lqg"] {
        let followed = succeed(
            folder.path(),
            &format!("{line} --sine 5um@100Hz --controller {law}"),
        );
        assert!(!followed.err.contains("predicted"), "{}", followed.err);
    }
    let slow = succeed(
        folder.path(),
        &format!("{line} --sine 2um@1Hz --controller pi"),
    );
    assert!(!slow.err.contains("predicted"), "{}", slow.err);
}
