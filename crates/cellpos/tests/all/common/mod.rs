//! Running the program as a user does.
#![allow(dead_code, reason = "each test file uses what it needs")]

use cellpos_plant::{Effect, Model};
use serde_json::Value;
use std::path::Path;
use std::process::Command;

/// What a command left behind.
pub(crate) struct Ran {
    /// Exit code.
    pub code: Option<i32>,
    /// Standard output.
    pub out: String,
    /// Standard error.
    pub err: String,
}

impl Ran {
    /// The one JSON object on standard output.
    pub(crate) fn json(&self) -> Value {
        serde_json::from_str(&self.out)
            .unwrap_or_else(|error| panic!("{error}\n{}\n{}", self.out, self.err))
    }
}

/// Runs `cellpos` in a folder; the arguments are split at blanks.
pub(crate) fn cellpos(folder: &Path, line: &str) -> Ran {
    let out = Command::new(env!("CARGO_BIN_EXE_cellpos"))
        .args(line.split_whitespace())
        .current_dir(folder)
        .output()
        .unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    Ran {
        code: out.status.code(),
        out: text(out.stdout),
        err: text(out.stderr),
    }
}

/// Runs `cellpos`, which must succeed.
pub(crate) fn succeed(folder: &Path, line: &str) -> Ran {
    let ran = cellpos(folder, line);
    assert_eq!(ran.code, Some(0), "{line}\n{}\n{}", ran.out, ran.err);
    ran
}

/// A number of a JSON object.
pub(crate) fn number(value: &Value, key: &str) -> f64 {
    value[key]
        .as_f64()
        .unwrap_or_else(|| panic!("{key} is no number in {value}"))
}

/// Writes a model file: the paper's plant with an effect that nobody is told of.
pub(crate) fn hide(folder: &Path, name: &str, effect: Effect) {
    let model = Model {
        working_point_um: 20.0,
        ..Model::eq6().with_effect(effect)
    };
    std::fs::write(folder.join(name), model.to_toml_string()).unwrap();
}
