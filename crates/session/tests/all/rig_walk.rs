//! What the types of rig.toml take, asked of the types themselves.

use cellpos_session::RigFile;
use std::collections::BTreeSet;

pub(crate) const UNKNOWN: &str = "no_such_key";

/// Keys or variants in backquotes behind the word `expected`.
pub(crate) fn expected(message: &str) -> Vec<String> {
    let list = message.split("expected").nth(1).unwrap_or("");
    list.split('`')
        .skip(1)
        .step_by(2)
        .map(ToString::to_string)
        .collect()
}

pub(crate) fn refusal(text: &str) -> String {
    match toml::from_str::<RigFile>(text) {
        Ok(_) => String::new(),
        Err(error) => error.message().to_string(),
    }
}

/// What a table needs before it looks at its keys.
pub(crate) fn needs(table: &str) -> &'static str {
    match table {
        "camera.region" => "[camera]\nkind = \"industrial\"\naddress = \"a\"\n",
        "vision.noise" | "vision.learning" => {
            "[vision]\nprofile = { kind = \"ring\", edge_px = 5.0 }\nwindow_px = 21\n"
        }
        _ => "",
    }
}

/// Tables that look at nothing else before they know their `kind`; below them there is one table with its own needs.
pub(crate) const OF_A_KIND: [&str; 4] = ["actuator", "camera", "vision.profile", "vision.noise"];

/// The kinds of a table that has kinds.
pub(crate) fn kinds_of(table: &str) -> Vec<String> {
    let text = |kind: &str| format!("{}[{table}]\n{kind}{UNKNOWN} = 1\n", needs(table));
    if !refusal(&text("")).contains("missing field `kind`") {
        return Vec::new();
    }
    expected(&refusal(&text(&format!("kind = \"{UNKNOWN}\"\n"))))
}

/// The keys of a table (empty: of none) and of all its kinds; `None` if it is no table.
pub(crate) fn keys_of(table: &str) -> Option<BTreeSet<String>> {
    let below = |of: &str| (table.strip_prefix(of)).is_some_and(|rest| rest.starts_with('.'));
    if OF_A_KIND.iter().any(|of| below(of)) && needs(table).is_empty() {
        return None;
    }
    let header = |kind: &str| {
        let kind = match kind {
            "" => String::new(),
            kind => format!("kind = \"{kind}\"\n"),
        };
        match table {
            "" => format!("{UNKNOWN} = 1\n"),
            table => format!("{}[{table}]\n{kind}{UNKNOWN} = 1\n", needs(table)),
        }
    };
    let said = refusal(&header(""));
    if said.contains("missing field `kind`") {
        let kinds = expected(&refusal(&header(UNKNOWN)));
        assert!(!kinds.is_empty(), "[{table}]: no kinds");
        let mut keys = BTreeSet::from(["kind".to_string()]);
        for kind in kinds {
            let said = refusal(&header(&kind));
            keys.extend(expected(&said));
        }
        return Some(keys);
    }
    said.contains(&format!("unknown field `{UNKNOWN}`"))
        .then(|| expected(&said).into_iter().collect())
}

/// All keys of a table and below, with their tables.
pub(crate) fn all_below(table: &str, all: &mut BTreeSet<String>) {
    for key in keys_of(table).unwrap_or_default() {
        let whole = match table {
            "" => key,
            table => format!("{table}.{key}"),
        };
        let is_table = keys_of(&whole).is_some();
        if is_table {
            all_below(&whole, all);
        }
        // A table is listed if it is a choice; its keys show the rest.
        if !is_table || whole.contains('.') {
            all.insert(whole);
        }
    }
}
