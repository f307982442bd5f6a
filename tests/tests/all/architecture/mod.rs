//! Rules of the project that the compiler does not check: no circle between the files of a crate, and layers that do not know the
//! layers above.

mod source;

use source::{Module, module_path, read_module};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// Folders of the workspace's packages, relative to its root.
fn packages() -> Vec<PathBuf> {
    let mut found: Vec<PathBuf> = std::fs::read_dir(root().join("crates"))
        .unwrap()
        .flatten()
        .map(|entry| Path::new("crates").join(entry.file_name()))
        .filter(|path| root().join(path).join("Cargo.toml").is_file())
        .collect();
    found.extend(["firmware-sim", "tests", "benches"].map(PathBuf::from));
    found.sort();
    found
}

fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
    let Ok(entries) = std::fs::read_dir(folder) else {
        return;
    };
    for path in entries.flatten().map(|entry| entry.path()) {
        if path.is_dir() {
            sources(&path, found);
        } else if path.extension().is_some_and(|ending| ending == "rs") {
            found.push(path);
        }
    }
    found.sort();
}

type Crate = BTreeMap<Vec<String>, Module>;

/// The module whose file defines the item of a path; none outside the crate.
fn defined_in(
    house: &Crate,
    from: &[String],
    path: &[String],
    depth: usize,
) -> Option<Vec<String>> {
    let mut at: Vec<String>;
    let mut rest = path;
    match path.first()?.as_str() {
        "crate" => {
            at = vec![];
            rest = &rest[1..];
        }
        "self" => {
            at = from.to_vec();
            rest = &rest[1..];
        }
        "super" => {
            at = from.to_vec();
            while rest.first().is_some_and(|word| word == "super") {
                at.pop();
                rest = &rest[1..];
            }
        }
        first => {
            at = from.to_vec();
            at.push(first.to_string());
            if !house.contains_key(&at) {
                return None;
            }
            rest = &rest[1..];
        }
    }
    while let Some(word) = rest.first() {
        let mut next = at.clone();
        next.push(word.clone());
        if !house.contains_key(&next) {
            break;
        }
        at = next;
        rest = &rest[1..];
    }
    let module = house.get(&at)?;
    let Some(name) = rest.first() else {
        return Some(at);
    };
    if depth < 8 && !module.defines.contains(name) {
        for (given, path) in &module.passed_on {
            if given == name {
                return defined_in(house, &at, path, depth + 1).or(Some(at));
            }
        }
        for (given, path) in &module.passed_on {
            if given == "*" {
                let mut through = path[..path.len() - 1].to_vec();
                through.push(name.clone());
                let found = defined_in(house, &at, &through, depth + 1);
                if let Some(found) = found.filter(|found| house[found].defines.contains(name)) {
                    return Some(found);
                }
            }
        }
    }
    Some(at)
}

/// Who reaches whom, by arrows of any length.
fn reaches(
    arrows: &BTreeMap<Vec<String>, BTreeSet<Vec<String>>>,
    from: &[String],
) -> BTreeSet<Vec<String>> {
    let mut seen = BTreeSet::new();
    let mut ahead: Vec<&Vec<String>> = arrows.get(from).into_iter().flatten().collect();
    while let Some(next) = ahead.pop() {
        if seen.insert(next.clone()) {
            ahead.extend(arrows.get(next).into_iter().flatten());
        }
    }
    seen
}

fn circles(source: &Path) -> Vec<String> {
    let mut files = vec![];
    sources(source, &mut files);
    // Within the crate: the folder of this test is called `tests` as well.
    files.retain(|file| {
        let inner = file.strip_prefix(source).unwrap();
        !inner.with_extension("").iter().any(|part| {
            let part = part.to_string_lossy();
            part == "tests" || part == "bin" || part.ends_with("_tests")
        })
    });
    assert!(!files.is_empty(), "{}: no source files", source.display());
    let house: Crate = files
        .iter()
        .map(|file| (module_path(source, file), read_module(file)))
        .collect();
    let mut arrows: BTreeMap<Vec<String>, BTreeSet<Vec<String>>> = BTreeMap::new();
    for (from, module) in &house {
        // A re-export is not a use.
        let passed: BTreeSet<&Vec<String>> =
            module.passed_on.iter().map(|(_, path)| path).collect();
        for path in module.names.iter().filter(|path| !passed.contains(path)) {
            if let Some(to) = defined_in(&house, from, path, 0)
                && to != *from
            {
                arrows.entry(from.clone()).or_default().insert(to);
            }
        }
    }
    let mut found = BTreeSet::new();
    for from in house.keys() {
        let mut circle: BTreeSet<Vec<String>> = reaches(&arrows, from);
        if circle.contains(from) {
            circle.retain(|other| reaches(&arrows, other).contains(from));
            let shown = |path: &Vec<String>| {
                let file = house[path].file.strip_prefix(source).unwrap();
                file.display().to_string()
            };
            let names: Vec<String> = circle
                .iter()
                .map(|path| {
                    let known = arrows[path].intersection(&circle).map(shown);
                    let known: Vec<String> = known.collect();
                    format!("{} knows {}", shown(path), known.join(", "))
                })
                .collect();
            found.insert(format!(
                "{}\n    {}",
                source.display(),
                names.join("\n    ")
            ));
        }
    }
    found.into_iter().collect()
}

/// Where circles are left: the outline's steps are methods of one type, written in the files below its own.
const STANDING: (&str, &str) = ("crates/vision/src", "outline/");

#[test]
fn no_files_of_a_crate_stand_in_a_circle() {
    let mut found = vec![];
    for package in packages() {
        found.extend(circles(&root().join(package).join("src")));
    }
    found.retain(|circle| {
        let (source, folder) = STANDING;
        let mut lines = circle.lines();
        !lines.next().is_some_and(|first| first.ends_with(source))
            || !lines.all(|line| line.trim_start().starts_with(folder))
    });
    assert!(
        found.is_empty(),
        "circles of files:\n    {}",
        found.join("\n\n    ")
    );
}

/// Longest file, lines: as much as a reader can take in at once.
const MOST_LINES: usize = 500;

#[test]
fn no_file_is_longer_than_a_reader_takes_in() {
    let mut files = vec![];
    for folder in ["crates", "firmware-sim", "tests", "benches", "examples"] {
        sources(&root().join(folder), &mut files);
    }
    let long: Vec<String> = files
        .iter()
        .map(|file| file.strip_prefix(root()).unwrap())
        .filter(|file| !file.iter().any(|part| part == "target"))
        .filter_map(|file| {
            let text = std::fs::read_to_string(root().join(file)).unwrap();
            let lines = text.lines().count();
            (lines > MOST_LINES).then(|| format!("{}: {lines} lines", file.display()))
        })
        .collect();
    assert!(
        long.is_empty(),
        "longer than {MOST_LINES} lines:\n{}",
        long.join("\n")
    );
}

/// `cargo doc` is read crate by crate: each front page says what the crate is for, and shows code that the tests run.
#[test]
fn every_library_has_a_front_page_with_an_example_that_runs() {
    let mut pages = 0;
    for folder in std::fs::read_dir(root().join("crates")).unwrap().flatten() {
        let Ok(text) = std::fs::read_to_string(folder.path().join("src/lib.rs")) else {
            continue;
        };
        let page: Vec<&str> = text
            .lines()
            .map_while(|line| line.strip_prefix("//!"))
            .collect();
        let name = folder.file_name().display().to_string();
        assert!(
            page.len() >= 8,
            "{name}: a front page of {} lines",
            page.len()
        );
        assert!(
            page.contains(&" ```"),
            "{name}: the front page has no example that runs"
        );
        pages += 1;
    }
    assert!(pages >= 20, "only {pages} libraries");
}

/// What a test that lacks something prints before it returns green; broken in two, so that this file has no such line.
const GREEN_FOR_NOTHING: &str = concat!("println!(\"", "skipped");

#[test]
fn no_test_that_lacks_its_records_is_green() {
    let mut files = Vec::new();
    for package in packages() {
        sources(&root().join(&package), &mut files);
    }
    assert!(files.len() > 300, "{} files", files.len());
    let mut wrong = Vec::new();
    for file in files {
        let text = std::fs::read_to_string(&file).unwrap();
        let at = file
            .strip_prefix(root())
            .unwrap_or(&file)
            .display()
            .to_string();
        if text.contains(GREEN_FOR_NOTHING) {
            wrong.push(format!("{at}: says that it is skipped, and passes"));
        }
        // Records are found by their build script, which has those tests ignored that need more than there is.
        let names = |line: &str| {
            line.contains(concat!("../shared", "/data")) && !line.contains("ignore = ")
        };
        if !at.ends_with("build/measured_data.rs") && text.lines().any(names) {
            wrong.push(format!(
                "{at}: takes records from beside the project, where they may not be"
            ));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// Files with random numbers of their own.
const OWN_CHANCE: [&str; 9] = [
    // A seed fixes the order of a sweep in runs that labs have recorded, and that of the table of adaptation.
    "crates/script/src/shuffle.rs",
    "benches/src/adaptation.rs",
    // A bit in a tick, from a state of eight bytes that is copied.
    "crates/control/src/plant_estimate/dither.rs",
    // Grey levels, as sums of bytes.
    "crates/cellpos/tests/all/vision.rs",
    "crates/drivers/tests/fake_camera.rs",
    // An example that needs no other crate.
    "crates/report/examples/gallery.rs",
    // Written apart from the crates.
    "crates/vision/tests/all/common/mod.rs",
    "tests/src/attack.rs",
    "tests/src/truth/random.rs",
];

#[test]
fn random_numbers_come_from_one_generator() {
    let mut files = Vec::new();
    for package in packages() {
        sources(&root().join(&package), &mut files);
    }
    let is_generator = |line: &str| {
        let multiplies = ["6_364_136_223", "6364136223", "0x2545_f491", "0xbf58_476d"];
        multiplies.iter().any(|factor| line.contains(factor))
            || ["<< 13;", "<< 25;"]
                .iter()
                .any(|by| line.contains("^=") && line.ends_with(by))
    };
    let own = files.iter().filter_map(|file| {
        let at = file.strip_prefix(root()).unwrap().display().to_string();
        let text = std::fs::read_to_string(file).unwrap().to_lowercase();
        let is_here = at == "tests/tests/all/architecture/mod.rs";
        (!is_here && text.lines().any(is_generator)).then_some(at)
    });
    let own: std::collections::BTreeSet<String> = own.collect();
    let known = OWN_CHANCE.map(str::to_owned).into();
    assert_eq!(own, known, "take cellpos_numeric::Random");
}

/// `.ci/nightly` asks the test programs for what they ignore: all of it but tests of this name, and programs that need a feature.
const DRAWS: &str = "draw_";

#[test]
fn an_ignored_test_says_why_and_the_nightly_run_has_it() {
    let nightly = std::fs::read_to_string(root().join(".ci/nightly")).unwrap();
    assert!(nightly.contains(&format!("NOT_TESTS = \"{DRAWS}\"")));
    let (mut ignored, mut drawing) = (0, Vec::new());
    for package in packages() {
        let manifest = std::fs::read_to_string(root().join(&package).join("Cargo.toml")).unwrap();
        let manifest: toml::Table = manifest.parse().unwrap();
        let programs = manifest.get("test").and_then(|tests| tests.as_array());
        for program in programs.into_iter().flatten() {
            let script = program["name"].as_str().unwrap().replace('_', "-") + ".sh";
            let is_always_built = program.get("required-features").is_none();
            assert!(is_always_built || nightly.contains(&script), "{script}");
        }
        let mut files = Vec::new();
        sources(&root().join(&package), &mut files);
        for file in files {
            let text = std::fs::read_to_string(&file).unwrap();
            assert!(!text.contains(concat!("#[ign", "ore]")), "{file:?}");
            let mut is_ignored = false;
            for line in text.lines().map(str::trim_start) {
                is_ignored |= line.contains(concat!("ignore", " = \""));
                if let Some(name) = line.strip_prefix("fn ").filter(|_| is_ignored) {
                    is_ignored = false;
                    ignored += 1;
                    drawing.extend(name.starts_with(DRAWS).then(|| name.to_owned()));
                }
            }
        }
    }
    assert!(ignored > 100, "{ignored} tests are ignored");
    assert_eq!(drawing, ["draw_the_outlines_of_the_documentation() {"]);
}

#[test]
fn a_circle_is_found_where_there_is_one() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
    write("lib.rs", "mod a;\nmod b;\npub use a::First;\n");
    write("a.rs", "use crate::b::second;\npub struct First;\n");
    write("b.rs", "// use crate::a::First;\npub fn second() {}\n");
    assert_eq!(circles(folder.path()), Vec::<String>::new());
    // Through the crate's front page, together with another name.
    write("b.rs", "use crate::{First, x};\npub fn second() {}\n");
    assert_eq!(circles(folder.path()).len(), 1);
    // Named without `use`; in tests it does not count.
    write(
        "b.rs",
        "pub fn second() -> super::a::First { super::a::First }\n",
    );
    assert_eq!(circles(folder.path()).len(), 1);
    write(
        "b.rs",
        "pub fn second() {}\n#[cfg(test)]\nmod tests { use crate::a::First; }\n",
    );
    assert_eq!(circles(folder.path()), Vec::<String>::new());
}

/// Names of the workspace's own packages that a package depends on outside its tests.
fn own_dependencies(package: &str) -> Vec<String> {
    let path = root().join("crates").join(package).join("Cargo.toml");
    let text = std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let mut inside = false;
    let mut found = vec![];
    for line in text.lines() {
        if line.starts_with('[') {
            inside = line.trim() == "[dependencies]";
        } else if inside && let Some(name) = line.strip_prefix("cellpos-") {
            found.push(name.split([' ', '=', '.']).next().unwrap_or("").to_string());
        }
    }
    found
}

#[test]
fn a_layer_knows_only_what_stands_below_it() {
    // What each may know of the house, all below it.
    let ground = ["table", "numeric"];
    let layers: &[(&str, &[&str])] = &[
        ("numeric", &[]),
        ("link", &[]),
        ("board", &["link"]),
        ("plant", &[]),
        ("vision", &[]),
        ("report", &[]),
        ("table", &[]),
        ("control", &["plant"]),
        ("rig", &["vision", "plant"]),
        ("runtime", &["plant", "control", "vision", "rig"]),
        ("script", &["plant", "control", "rig", "runtime", "table"]),
        ("record", &["rig", "control", "runtime", "table"]),
        ("drivers", &["plant", "vision", "link", "rig"]),
        (
            "emulator",
            &["plant", "vision", "link", "board", "rig", "drivers"],
        ),
        ("ident", &["plant"]),
        ("reconcile", &["plant", "ident", "report"]),
        ("live", &[]),
        (
            "session",
            &[
                "plant", "ident", "control", "vision", "emulator", "rig", "drivers", "runtime",
                "record", "live", "script",
            ],
        ),
        (
            "workbench",
            &[
                "plant",
                "control",
                "vision",
                "link",
                "rig",
                "drivers",
                "emulator",
                "runtime",
                "session",
                "record",
                "ident",
                "reconcile",
                "report",
                "script",
            ],
        ),
    ];
    let known: BTreeSet<&str> = layers.iter().map(|(package, _)| *package).collect();
    let all = packages();
    let forgotten: Vec<&PathBuf> = all
        .iter()
        .filter(|path| path.starts_with("crates") && !path.ends_with("cellpos"))
        .filter(|path| {
            let name = path.file_name().unwrap().to_str().unwrap();
            !known.contains(name)
        })
        .collect();
    assert!(forgotten.is_empty(), "without a layer: {forgotten:?}");
    let mut wrong = vec![];
    for (package, may_know) in layers {
        for known in own_dependencies(package) {
            if !may_know.contains(&known.as_str()) && !ground.contains(&known.as_str()) {
                wrong.push(format!("crates/{package} depends on cellpos-{known}"));
            }
        }
    }
    assert!(
        wrong.is_empty(),
        "arrows that run up:\n{}",
        wrong.join("\n")
    );
}
