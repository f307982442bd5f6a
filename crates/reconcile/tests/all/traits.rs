//! The search knows an effect by what its kind says of it, never by its name: an effect that is registered from outside is then
//! treated as one of the catalogue.

use cellpos_plant::effects;
use std::path::{Path, PathBuf};

/// Sources of the crate with the name of each, without their test modules.
fn sources(folder: &Path) -> Vec<(PathBuf, String)> {
    let mut out = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            out.extend(sources(&path));
        } else {
            let text = std::fs::read_to_string(&path).unwrap();
            let code = text.split("#[cfg(test)]\nmod ").next().unwrap_or_default();
            out.push((path, code.to_owned()));
        }
    }
    out
}

/// What a text says of an effect by its name: the id as a string, or the function that makes it.
fn named_in(code: &str) -> Vec<&'static str> {
    // What comes by chance is counted or belongs to the noise, and is not searched: the counts and the noise say which effect it is.
    let counted = [
        effects::frame_drops(0.0).id(),
        effects::frame_repeats(0.0).id(),
        effects::jumps(0.0, 0.0).id(),
        effects::frame_jitter(0.0).id(),
        effects::flow_wander(0.0, 1.0).id(),
    ];
    let names = |id: &&str| {
        let made = format!("effects::{}(", id.replace('-', "_"));
        code.contains(&format!("\"{id}\"")) || code.contains(&made) && !counted.contains(id)
    };
    effects::ids().into_iter().filter(names).collect()
}

#[test]
fn no_effect_is_known_by_its_name() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    // Compares both simulators, effect by effect; compiled for tests only.
    let of_tests = |path: &Path| path.ends_with("fit/agreement.rs");
    let all = sources(&folder);
    assert!(all.len() > 30, "{}", all.len());
    for (path, code) in all.iter().filter(|(path, _)| !of_tests(path)) {
        assert_eq!(named_in(code), Vec::<&str>::new(), "{}", path.display());
    }
}

#[test]
fn a_name_in_a_source_is_found() {
    assert_eq!(named_in("if id == \"leak\" {}"), ["leak"]);
    assert_eq!(named_in("effects::time_delay(0.1)"), ["time-delay"]);
    assert_eq!(
        named_in("// a leak, and effects::frame_drops(0.1)"),
        Vec::<&str>::new()
    );
}
