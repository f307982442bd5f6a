//! Behaviour of scripts: reading, laying out, walking through, checking.

use cellpos_control::Reference;
use cellpos_plant::{Model, SimulateOptions, simulate};
use cellpos_script::{ArmKind, CheckLimits, Plan, Progress, Script, Seen, StopReason, check};
use proptest::prelude::*;
use std::path::{Path, PathBuf};

fn plan(text: &str) -> Plan {
    Plan::new(&Script::parse(text, "t.toml").unwrap()).unwrap()
}

fn error(text: &str) -> String {
    match Script::parse(text, "t.toml").and_then(|script| Plan::new(&script)) {
        Ok(_) => panic!("accepted: {text}"),
        Err(error) => error.to_string(),
    }
}

fn examples() -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/scripts");
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|e| e == "toml"))
        .collect();
    files.sort();
    files
}

#[test]
fn the_examples_can_be_read_and_pass_the_check_on_the_nominal_plant() {
    assert_eq!(examples().len(), 5);
    for path in examples() {
        let script = Script::read(&path).unwrap();
        let check = check(&script, &Model::eq6(), &CheckLimits::default()).unwrap();
        assert!(
            check.violations.is_empty(),
            "{path:?}: {:?}",
            check.violations
        );
        assert!(check.largest_factor >= 1.0 && check.cycles > 0 || path.ends_with("step.toml"));
    }
}

#[test]
fn every_script_in_the_reference_page_is_read() {
    let page = std::fs::read_to_string(
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/scripts.md"),
    )
    .unwrap();
    let blocks: Vec<&str> = page
        .split("```toml\n")
        .skip(1)
        .map(|rest| rest.split("```").next().unwrap())
        .collect();
    assert!(blocks.len() >= 4);
    for block in blocks {
        plan(block);
    }
}

#[test]
fn errors_name_line_column_value_and_what_would_be_right() {
    let head = "[[step]]\ndo = \"sine\"\n";
    for (text, parts) in [
        (
            format!("{head}amplitude = 5\nfrequency = \"1Hz\"\ncycles = 1\n"),
            ["t.toml:3:13", "no unit", "5um"],
        ),
        (
            format!("{head}amplitud = \"5um\"\n"),
            [
                "t.toml:3:1",
                "unknown key `amplitud`",
                "did you mean `amplitude`",
            ],
        ),
        (
            format!("{head}amplitude = \"5V\"\nfrequency = \"1Hz\"\ncycles = 1\n"),
            ["t.toml:3:13", "`V` is not a unit", "5um"],
        ),
        (
            "[[step]]\ndo = \"hodl\"\n".to_owned(),
            ["t.toml:2:6", "\"hodl\"", "did you mean \"hold\""],
        ),
        (
            "[[step]]\ndo = \"hold\"\n".to_owned(),
            ["t.toml:1:1", "`duration` is missing", "1s"],
        ),
        (
            "[[step]]\ndo = \"static\"\nlike = \"x\"\n".to_owned(),
            ["t.toml:1:1", "labelled `x`", "label"],
        ),
        (
            "[[step]]\ndo = \"hold\"\nduration = \"$t\"\n".to_owned(),
            ["t.toml:3:12", "$t", "sweep"],
        ),
        ("a = [".to_owned(), ["t.toml:1", "", ""]),
    ] {
        let error = error(&text);
        for part in parts {
            assert!(error.contains(part), "{error:?} should contain {part:?}");
        }
    }
}

#[test]
fn a_plan_is_continuous_and_takes_the_time_that_its_steps_take() {
    let plan = plan(
        "start = \"1um\"\n[[step]]\ndo = \"move\"\nto = \"5um\"\nspeed = \"40um/s\"\n\
         [[step]]\ndo = \"repeat\"\ntimes = 3\n[[step.step]]\ndo = \"sine\"\namplitude = \"2um\"\n\
         frequency = \"10Hz\"\ncycles = 4\nramp_in = 1\nramp_out = 1\n[[step.step]]\ndo = \"hold\"\nduration = \"50ms\"\n",
    );
    assert!((plan.total_s() - (0.1 + 3.0 * 0.45)).abs() < 1e-12);
    assert_eq!(plan.cycle_count(), 12);
    let first = plan.cycle(4).unwrap();
    assert!((first.start_s - (0.1 + 0.45)).abs() < 1e-12 && (first.duration_s - 0.1).abs() < 1e-12);
    assert_eq!(plan.cycle_at(first.start_s + 0.01).unwrap().number, 4);
    assert!(plan.cycle_at(0.05).is_none() && plan.cycle(12).is_none());
    let fastest = 2.0 * std::f64::consts::TAU * 10.0;
    for k in 0..20_000 {
        let t = f64::from(k) * 1e-4;
        let step = (plan.at_um(t + 1e-4) - plan.at_um(t)).abs();
        assert!(step <= 1.5 * fastest * 1e-4, "jump of {step} um at {t} s");
    }
    assert_eq!(plan.at_um(-1.0), 1.0);
    assert_eq!(plan.at_um(1e9), 5.0);
    // A full-amplitude peak: the second cycle's first quarter.
    assert!((plan.at_um(0.1 + 0.1 + 0.025) - 7.0).abs() < 1e-9);
}

#[test]
fn the_static_arm_takes_the_same_time_at_the_mean_load() {
    let plan = plan(
        "[[step]]\ndo = \"repeat\"\nlabel = \"c\"\ntimes = 5\n[[step.step]]\ndo = \"move\"\nto = \"4um\"\nduration = \"1s\"\n\
         [[step.step]]\ndo = \"hold\"\nduration = \"2s\"\n[[step.step]]\ndo = \"move\"\nto = \"0um\"\nduration = \"1s\"\n\
         [[step]]\ndo = \"static\"\nlike = \"c\"\n",
    );
    assert!((plan.total_s() - 40.0).abs() < 1e-9);
    // Each pass: 2 um for 1 s, 4 um for 2 s, 2 um for 1 s: 3 um in the mean.
    assert!((plan.at_um(30.0) - 3.0).abs() < 1e-12);
    assert_eq!(plan.cycle_count(), 10);
    for (number, arm) in [
        (4, ArmKind::Cyclic),
        (5, ArmKind::Static),
        (9, ArmKind::Static),
    ] {
        let cycle = plan.cycle(number).unwrap();
        assert!(cycle.arm == arm && (cycle.duration_s - 4.0).abs() < 1e-9);
    }
}

#[test]
fn a_random_order_is_a_permutation_that_the_seed_fixes() {
    let order = |seed: u64| -> Vec<f64> {
        let text = format!(
            "seed = {seed}\n[[step]]\ndo = \"sweep\"\nname = \"x\"\nvalues = [\"1um\",\"2um\",\"3um\",\"4um\",\"5um\",\"6um\"]\n\
             order = \"random\"\n[[step.step]]\ndo = \"move\"\nto = \"$x\"\nduration = \"1s\"\n"
        );
        let plan = plan(&text);
        (1..=6)
            .map(|k| plan.at_um(f64::from(k) - 1e-12).round())
            .collect()
    };
    assert_eq!(order(3), order(3));
    assert!((0..5).any(|seed| order(seed) != order(99)));
    let mut sorted = order(3);
    sorted.sort_by(f64::total_cmp);
    assert_eq!(sorted, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
}

#[test]
fn a_wait_stops_the_plans_clock_until_its_condition_is_met() {
    let plan = plan(
        "[[step]]\ndo = \"hold\"\nduration = \"10ms\"\n[[step]]\ndo = \"wait\"\nfor = \"settled\"\nwithin = \"100nm\"\n\
         during = \"5ms\"\ntimeout = \"1s\"\n[[step]]\ndo = \"move\"\nto = \"1um\"\nduration = \"10ms\"\n",
    );
    let mut cursor = plan.start();
    let seen = |x: f64| Seen {
        position_um: Some(x),
        length_um: None,
        error_um: None,
    };
    let mut waiting = 0;
    for tick in 0..1000 {
        let error = if tick < 100 { 1.0 } else { 0.05 };
        let output = plan.step(&mut cursor, 1e-3, &seen(error));
        if output.status == Progress::Waiting {
            waiting += 1;
        }
        if output.status == Progress::Done {
            assert_eq!(output.reference_um, 1.0);
            assert_eq!(tick, 10 + waiting + 10);
            break;
        }
    }
    assert!(
        (94..=96).contains(&waiting),
        "90 ms until settled and 5 ms of settling: {waiting}"
    );
    let mut cursor = plan.start();
    let last = (0..1200)
        .map(|_| plan.step(&mut cursor, 1e-3, &seen(9.0)))
        .last()
        .unwrap();
    assert_eq!(last.status, Progress::Stopped(StopReason::WaitTimeout));
    assert_eq!(last.reference_um, 0.0);
}

#[test]
fn stop_conditions_end_a_script_and_hold_the_reference() {
    let text = |stop: &str| {
        format!(
            "[stop]\n{stop}\n[[step]]\ndo = \"sine\"\namplitude = \"1um\"\nfrequency = \"10Hz\"\ncycles = 100\n"
        )
    };
    for (stop, seen, reason, ticks) in [
        (
            "after_cycles = 3",
            Seen {
                position_um: Some(0.0),
                length_um: None,
                error_um: None,
            },
            StopReason::Cycles,
            300,
        ),
        (
            "after = \"50ms\"",
            Seen {
                position_um: Some(0.0),
                length_um: None,
                error_um: None,
            },
            StopReason::Time,
            50,
        ),
        (
            "lost_longer_than = \"20ms\"",
            Seen::default(),
            StopReason::Lost,
            20,
        ),
        (
            "error_above = \"3um\"",
            Seen {
                position_um: Some(5.0),
                length_um: None,
                error_um: None,
            },
            StopReason::Error,
            0,
        ),
    ] {
        let plan = plan(&text(stop));
        let mut cursor = plan.start();
        let mut tick = 0;
        let stopped = loop {
            let output = plan.step(&mut cursor, 1e-3, &seen);
            if output.status != Progress::Running {
                break output;
            }
            tick += 1;
        };
        assert_eq!(stopped.status, Progress::Stopped(reason));
        assert!((tick - ticks as i64).abs() <= 1, "{stop}: {tick}");
        let after = plan.step(&mut cursor, 1e-3, &seen);
        assert_eq!(after.reference_um, stopped.reference_um);
    }
}

#[test]
fn the_demand_of_the_check_moves_the_plant_along_the_reference() {
    let text = "[[step]]\ndo = \"sine\"\namplitude = \"3um\"\nfrequency = \"20Hz\"\ncycles = 10\nramp_in = 2\nramp_out = 2\n";
    let script = Script::parse(text, "t.toml").unwrap();
    let mut model = Model::eq6();
    model.working_point_um = 20.0;
    let check = check(&script, &model, &CheckLimits::default()).unwrap();
    let bead = simulate(&model, &check.demand_um, 1e-3, &SimulateOptions::default()).unwrap();
    for (row, (x, r)) in bead.iter().zip(&check.reference_um).enumerate() {
        assert!((x - r).abs() < 1e-6, "row {row}: {x} um instead of {r} um");
    }
    // |G| at 20 Hz is 9.88 dB: 3 um of bead ask for 0.96 um of PZT.
    let amplitude = (check.pzt_um.1 - check.pzt_um.0) / 2.0;
    assert!(
        (amplitude - 3.0 / 10f64.powf(9.88 / 20.0)).abs() < 0.03,
        "{amplitude}"
    );
}

#[test]
fn too_much_is_refused_with_the_largest_amplitude_that_would_do() {
    let text = |um: f64| {
        format!(
            "[[step]]\ndo = \"hold\"\nduration = \"10ms\"\n[[step]]\ndo = \"sine\"\namplitude = \"{um}um\"\n\
             frequency = \"100Hz\"\ncycles = 50\nramp_in = 10\nramp_out = 10\n"
        )
    };
    let check = |um: f64| {
        let script = Script::parse(&text(um), "t.toml").unwrap();
        check(
            &script,
            &Model::eq6(),
            &CheckLimits {
                slew_um_per_s: 1e6,
                ..CheckLimits::default()
            },
        )
        .unwrap()
    };
    let big = check(30.0);
    assert_eq!(big.violations[0].line, 4);
    assert_eq!(big.violations[0].what, "PZT range");
    // 18 um of PZT (a tenth is in reserve) at |G| = -4.40 dB give 10.85 um; sampled at 1 kHz the held integrator has
    // 1.017 times that gain, and the ten samples of a cycle may miss the crest by up to cos(18 deg) = 0.951.
    let largest = 30.0 * big.largest_factor;
    assert!((10.85..11.7).contains(&largest), "{largest}");
    let wave = big.waves[0];
    assert_eq!((wave.line, wave.amplitude_um), (4, 30.0));
    assert!((wave.largest_um / largest - 1.0).abs() < 1e-9, "{wave:?}");
    assert!(check(largest * 0.999).violations.is_empty());
    assert!(!check(largest * 1.01).violations.is_empty());
}

#[test]
fn a_night_of_holding_is_checked_without_going_through_its_ticks() {
    let text = "[[step]]\ndo = \"hold\"\nlabel = \"long\"\nduration = \"200h\"\n[[step]]\ndo = \"move\"\nto = \"5um\"\nduration = \"1s\"\n\
                [[step]]\ndo = \"static\"\nlike = \"long\"\n[[step]]\ndo = \"sine\"\namplitude = \"1um\"\nfrequency = \"1mHz\"\ncycles = 20\n";
    let script = Script::parse(text, "t.toml").unwrap();
    let check = check(&script, &Model::eq6(), &CheckLimits::default()).unwrap();
    assert!(check.violations.is_empty());
    assert!((check.duration_s - (400.0 * 3600.0 + 1.0 + 20_000.0)).abs() < 1e-6);
    assert!(check.time_s.len() < 7_000_000);
    assert_eq!(check.position_um, (0.0, 6.0));
}

#[test]
fn ten_thousand_cycles_are_each_there_once() {
    let plan = plan(
        "[[step]]\ndo = \"sine\"\namplitude = \"1um\"\nfrequency = \"10Hz\"\ncycles = 10000\n",
    );
    assert_eq!(plan.cycle_count(), 10_000);
    let mut cursor = plan.start();
    let seen = Seen {
        position_um: Some(0.0),
        length_um: None,
        error_um: None,
    };
    let mut last = None;
    let mut cycles = 0;
    loop {
        let output = plan.step(&mut cursor, 1e-3, &seen);
        if output.status == Progress::Done {
            break;
        }
        // The middle of a tick, so that no cycle's border is met by rounding.
        let number = plan
            .cycle_at(output.plan_s + 5e-4)
            .map(|cycle| cycle.number);
        if number != last {
            assert_eq!(number, Some(cycles));
            cycles += 1;
            last = number;
        }
    }
    assert_eq!(cycles, 10_000);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1000))]

    #[test]
    fn a_mutated_script_is_refused_with_a_line_or_is_a_valid_plan(
        which in 0usize..5,
        edits in proptest::collection::vec((0.0f64..1.0, 0usize..8, ".{0,4}"), 1..6),
    ) {
        let path = &examples()[which];
        let mut text = std::fs::read_to_string(path).unwrap();
        for (place, kind, insert) in &edits {
            let mut at = (text.len() as f64 * place) as usize;
            while !text.is_char_boundary(at) { at -= 1; }
            let line_end = text[at..].find('\n').map_or(text.len(), |n| at + n + 1);
            match kind {
                0 => text.insert_str(at, insert),
                1 => { text.drain(at..line_end); }
                2 => { let line = text[at..line_end].to_owned(); text.insert_str(at, &line); }
                3 => text = text.replacen("um", "V", 1),
                4 => text = text.replacen("\"", "", 1),
                5 => text = text.replacen(|c: char| c.is_ascii_digit(), "9e9", 1),
                6 => text = text.replacen("duration", "times", 1),
                _ => { let end = (at + 1).min(text.len()); if text.is_char_boundary(end) { text.drain(at..end); } }
            }
        }
        match Script::parse(&text, "m.toml").and_then(|script| Plan::new(&script)) {
            Err(error) => {
                prop_assert!(error.line >= 1 && error.column >= 1);
                prop_assert!(!error.message.is_empty());
            }
            Ok(plan) => {
                prop_assert!(plan.total_s().is_finite() && plan.total_s() >= 0.0);
                for k in 0..20 {
                    let t = plan.total_s() * f64::from(k) / 19.0;
                    prop_assert!(plan.at_um(t).is_finite());
                }
            }
        }
    }
}

#[test]
fn a_script_of_twenty_thousand_steps_is_read_and_every_step_knows_its_line() {
    let step = "[[step]]\ndo = \"hold\"\nduration = \"10ms\"\n\n";
    let text = "name = \"long\"\n".to_owned() + &step.repeat(20_000);
    let script = Script::parse(&text, "t.toml").unwrap();
    assert_eq!(script.steps.len(), 20_000);
    for (k, step) in script.steps.iter().enumerate() {
        assert_eq!(step.line, 2 + 4 * k);
    }
    let wrong = text
        .replacen("10ms", "10", 20_000)
        .replacen("\"10\"", "\"10ms\"", 19_999);
    let error = Script::parse(&wrong, "t.toml").unwrap_err();
    assert_eq!(error.line, 2 + 4 * 19_999 + 2);
}
