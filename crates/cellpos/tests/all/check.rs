//! `cellpos check`: what it refuses, `cellpos run` refuses.

use crate::script_runs::*;
use serde_json::Value;

/// `check` and `run --dry` refuse the same scripts in the same words, on the emulated rig and on one whose camera nobody asks.
#[test]
fn check_refuses_what_a_rehearsal_refuses() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let own = "[actuator]\nkind = \"serial\"\nport = \"none\"\n[camera]\nkind = \"socket\"\nsocket = \"none\"\n[timing]\nperiod_us = 2000.0\n";
    std::fs::write(at.join("own.toml"), own).unwrap();
    let to = |um: u32| format!("do = \"move\"\nto = \"{um}um\"\nduration = \"1s\"");
    let length = "do = \"wait\"\nfor = \"cell-length\"\nabove = \"9um\"\ntimeout = \"9s\"";
    let fast = "do = \"sine\"\namplitude = \"1nm\"\nfrequency = \"300Hz\"\ncycles = 9";
    // What is said on the emulated rig, and on the other one; none: it can run.
    let scripts = [
        (to(12), None, None),
        (to(20), Some("20.000 um asked for, 12.750 um allowed"), None),
        (to(60), Some("12.750 um allowed"), Some("50.000 um allowed")),
        (
            length.into(),
            Some("measures no length"),
            Some("measures no length"),
        ),
        (fast.into(), None, Some("at 500 ticks a second")),
    ];
    for (text, emulated, real) in scripts {
        std::fs::write(at.join("s.toml"), format!("[[step]]\n{text}\n")).unwrap();
        for (rig, refused) in [(&[][..], emulated), (&["--rig", "own.toml"], real)] {
            let (code, out, err) = cellpos(at, &[&["check", "s.toml", "--json"], rig].concat());
            let (dry, _, why) = cellpos(at, &[&["run", "s.toml", "--dry"], rig].concat());
            let said = format!("{text} {rig:?}: {code:?} {dry:?}\n{out}{err}\n{why}");
            assert_eq!(code == Some(0), refused.is_none(), "{said}");
            assert_eq!(dry == Some(0), refused.is_none(), "{said}");
            if let Some(words) = refused {
                let why = why.replace("\n  \u{2502} ", " ");
                assert!(why.contains(words), "{said}");
                let (_, out, err) = cellpos(at, &[&["check", "s.toml"], rig].concat());
                let both = format!("{out}{err}").replace("\n  \u{2502} ", " ");
                assert!(both.contains(words), "{said}\n{both}");
            }
        }
    }
}

#[test]
fn what_the_rig_cannot_do_is_refused_before_anything_moves() {
    let folder = tempfile::tempdir().unwrap();
    let text = "[[step]]\ndo = \"sine\"\namplitude = \"9um\"\nfrequency = \"200Hz\"\ncycles = 20\nramp_in = 4\nramp_out = 4\n";
    std::fs::write(folder.path().join("wild.toml"), text).unwrap();
    std::fs::write(folder.path().join("torn.toml"), "[[step]]\ndo = \"hodl\"\n").unwrap();
    let (code, out, _) = cellpos(folder.path(), &["check", "wild.toml"]);
    assert_eq!(code, Some(1));
    assert!(
        out.contains("wild.toml:1: PZT range") && out.contains("scale all positions by 0."),
        "{out}"
    );
    // A rig with less room allows less, and what is said on the command line counts more.
    let narrow = "first_neutral_um = 10.0\n[limits]\nlow_um = 0.0\nhigh_um = 20.0\nslew_um_per_s = 20000.0\npark_um = 10.0\n";
    std::fs::write(folder.path().join("narrow.toml"), narrow).unwrap();
    let largest = |extra: &[&str]| {
        let args = [&["check", "wild.toml", "--json"], extra].concat();
        let (_, out, _) = cellpos(folder.path(), &args);
        let check: Value = serde_json::from_str(&out).unwrap();
        check["waves"][0]["largest_um"].as_f64().unwrap()
    };
    let wide = largest(&["--slew", "1000000um/s"]);
    let narrow = largest(&["--rig", "narrow.toml", "--slew", "1000000um/s"]);
    assert!((narrow / wide - 0.5).abs() < 1e-6, "{narrow} {wide}");
    let (code, _, err) = cellpos(folder.path(), &["run", "wild.toml", "--dry"]);
    assert_eq!(code, Some(2));
    assert!(err.contains("the rig cannot do it"), "{err}");
    for args in [
        ["check", "torn.toml"].as_slice(),
        &["run", "torn.toml", "--dry"],
    ] {
        let (code, _, err) = cellpos(folder.path(), args);
        assert_eq!(code, Some(2));
        assert!(
            err.contains("torn.toml:2:6") && err.contains("hold"),
            "{err}"
        );
    }
    let (code, _, err) = cellpos(folder.path(), &["run", "absent.toml"]);
    assert_eq!(code, Some(2), "{err}");
    assert!(!folder.path().join("runs").exists(), "nothing was started");
}
