//! The rig's own camera: frames recorded, beads of any look found and held, the sheet of the rig.

use crate::common::{cellpos, number, succeed};
use std::path::Path;

/// An emulated rig whose bead looks otherwise than the loop takes it to; with comments that must survive.
fn rig(at: &Path, name: &str, look: &str) {
    let text = format!(
        "# my rig: {name}\n[actuator]\nkind = \"emulated\"   # a board in this process\n[camera]\nkind = \"emulated\"\n\n\
         # a bead of another lab\n[vision]\nwindow_px = 21\nprofile = {{ kind = \"ring\", edge_px = 9.5 }}\n\n[emulator]\nseed = 5\n{look}"
    );
    std::fs::write(at.join(format!("{name}.toml")), text).unwrap();
}

/// Beads of three looks that the file does not describe.
const LOOKS: [(&str, &str); 3] = [
    (
        "ring",
        "bead_look = \"ring\"\nbead_radius_um = 0.4\ncontrast_grey = 60.0\n",
    ),
    (
        "dark-disc",
        "bead_look = \"disc\"\nbead_radius_um = 0.6\ncontrast_grey = -60.0\n",
    ),
    (
        "faint-small",
        "ideal = true\nbead_look = \"spot\"\nbead_radius_um = 0.25\ncontrast_grey = 25.0\n",
    ),
];

#[test]
fn a_bead_that_the_rig_file_does_not_describe_is_found_written_into_it_and_held() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    for (name, look) in LOOKS {
        rig(at, name, look);
        let file = at.join(format!("{name}.toml"));
        let before = std::fs::read_to_string(&file).unwrap();
        // With the settings of another lab nothing is held, or not well; the picture says what to do.
        let blind = cellpos(
            at,
            &format!("camera --rig {name}.toml --snapshot {name}-blind.png --overlay"),
        );
        if blind.code == Some(1) {
            assert!(blind.out.contains("--find-beads"), "{name}: {}", blind.out);
        }
        let found = succeed(
            at,
            &format!("camera --rig {name}.toml --find-beads {name}.png --duration 1s --json"),
        )
        .json();
        let sight = &found["sight"];
        let recall = number(sight, "seen") / number(sight, "frames");
        // Dust and a border that it swims over may cost frames; a bead that is not found costs nearly all.
        assert!(recall > 0.8, "{name}: {found}");
        // A free bead moves; dust would rest.
        assert_eq!(found["rests"], false, "{name}: {found}");
        let after = std::fs::read_to_string(&file).unwrap();
        for line in before.lines().filter(|line| line.contains('#')) {
            assert!(after.contains(line), "{name}: {line:?} is lost in\n{after}");
        }
        assert_ne!(before, after);
        // The picture shows frames with marks.
        let picture = image::open(at.join(format!("{name}.png")))
            .unwrap()
            .to_rgb8();
        let marked = picture.pixels().filter(|p| p.0 == [255, 64, 0]).count();
        assert!(marked > 50, "{name}: {marked} px of marks");
        // To a held bead, through the frames.
        let held = succeed(
            at,
            &format!("track --rig {name}.toml --target 1um --duration 3s --clock virtual --json"),
        )
        .json();
        let rms_nm = number(&held, "rms_true_nm");
        // The bound is about 50 nm; a bead that is lost or taken for dust is um away.
        assert!(rms_nm < 150.0, "{name}: held to {rms_nm} nm");
    }
}

#[test]
fn the_rigs_own_camera_is_recorded_for_vision() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    // Nothing but the bead in view: each frame has one fix.
    rig(at, "rig", &format!("ideal = true\n{}", LOOKS[1].1));
    let recorded = succeed(
        at,
        "camera --rig rig.toml --record beads --duration 1s --json",
    )
    .json();
    let (frames, lost) = (number(&recorded, "frames"), number(&recorded, "lost"));
    assert!(frames + lost > 900.0, "{recorded}");
    assert!(
        (number(&recorded, "rate_hz") - 1000.0).abs() < 1.0,
        "{recorded}"
    );
    let seen = succeed(at, "vision beads --frames 200 --json").json();
    assert_eq!(number(&seen, "fixes"), 200.0, "{seen}");
    assert_eq!(seen["settings"]["vision"]["polarity"], "dark");
    // Nothing is overwritten, and what would not fit into memory is refused before it is tried.
    let again = cellpos(at, "camera --rig rig.toml --record beads --duration 1s");
    assert_eq!(again.code, Some(2), "{}", again.err);
    let long = cellpos(at, "camera --rig rig.toml --record long --duration 24h");
    assert_eq!(long.code, Some(2), "{}", long.err);
    assert!(
        long.err.contains("gigabyte") && !at.join("long").exists(),
        "{}",
        long.err
    );
}

#[test]
fn a_sheet_proves_the_emulated_rig_and_says_what_was_not_tried() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let plain = "[actuator]\nkind = \"emulated\"\n[camera]\nkind = \"emulated\"\n[emulator]\nseed = 5\nideal = true\n";
    std::fs::write(at.join("rig.toml"), plain).unwrap();
    let ran = cellpos(
        at,
        "rig prove rig.toml --duration 2s --out proved.html --json",
    );
    assert!(matches!(ran.code, Some(0 | 1)), "{}", ran.err);
    let sheet = ran.json();
    let lines = sheet["lines"].as_array().unwrap();
    let verdict = |part: &str, name: &str| {
        let line = lines
            .iter()
            .find(|line| line["part"] == part && line["name"] == name);
        line.unwrap_or_else(|| panic!("no line {part}: {name}"))["verdict"].clone()
    };
    // What a machine under load cannot fail.
    for name in [
        "range at the output",
        "slew at the output",
        "holds on silence",
        "parks on silence",
        "refuses a foreign session",
        "disarms",
    ] {
        assert_eq!(verdict("board", name), "passed", "{sheet:#}");
    }
    assert_eq!(verdict("board", "reset in mid-flight"), "not-tried");
    assert_eq!(verdict("socket", "headers"), "not-tried");
    // A bead that nobody holds may leave the view while the sheet is made: the line has a number, whatever it is.
    assert_ne!(verdict("vision", "recall"), "not-tried", "{sheet:#}");
    let page = std::fs::read_to_string(at.join("proved.html")).unwrap();
    for line in lines {
        let name = line["name"].as_str().unwrap().replace('\'', "&#39;");
        assert!(page.contains(&name), "{line}");
    }
    let counted = number(&sheet, "passed") + number(&sheet, "failed") + number(&sheet, "not_tried");
    assert_eq!(counted as usize, lines.len());
}
