//! docs/schemas/rig.json agrees with the types of rig.toml and has the words of docs/rig-toml.md: editors complete and check from
//! it.

use crate::rig_keys::page;
use crate::rig_walk::{UNKNOWN, all_below, expected, keys_of, kinds_of, needs, refusal};
use cellpos_session::quantities::quantities;
use serde_json::{Map, Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// The page's text for each key: the last cell of its line.
fn descriptions() -> BTreeMap<String, String> {
    let page = page();
    let lines = page.lines().filter(|line| line.starts_with("| `"));
    let mut all = BTreeMap::new();
    for line in lines {
        let cells: Vec<&str> = line.trim_matches('|').split('|').collect();
        let (Some(names), Some(said)) = (cells.first(), cells.last()) else {
            continue;
        };
        for name in names.split('`').skip(1).step_by(2) {
            all.insert(name.to_string(), said.trim().to_string());
        }
    }
    all
}

/// What the types say to a text where they want something else.
fn answer(table: &str, key: &str) -> String {
    let kinds = kinds_of(table);
    let ask = |kind: &str| {
        let header = match table {
            "" => String::new(),
            table => format!("{}[{table}]\n{kind}", needs(table)),
        };
        refusal(&format!("{header}{key} = \"{UNKNOWN}\"\n"))
    };
    if kinds.is_empty() {
        return ask("");
    }
    // Of the kinds that have the key.
    let asked = kinds
        .iter()
        .map(|kind| ask(&format!("kind = \"{kind}\"\n")));
    asked
        .filter(|said| !said.contains(&format!("unknown field `{key}`")))
        .max_by_key(|said| said.contains("invalid type"))
        .unwrap_or_default()
}

/// The schema of a key that is no table.
fn leaf(table: &str, key: &str) -> Value {
    if key == "kind" {
        return json!({ "enum": kinds_of(table) });
    }
    let said = answer(table, key);
    let wants = said.split("expected ").nth(1).unwrap_or("");
    let whole = [
        "u8",
        "u16",
        "u32",
        "u64",
        "usize",
        "i8",
        "i16",
        "i32",
        "i64",
        "a nonzero",
    ];
    if said.contains("unknown variant") {
        json!({ "enum": expected(&said) })
    } else if !said.contains("invalid type") {
        json!({ "type": "string" })
    } else if wants.starts_with("f64") || wants.starts_with("f32") {
        json!({ "type": "number" })
    } else if wants.starts_with("a boolean") {
        json!({ "type": "boolean" })
    } else if whole.iter().any(|word| wants.starts_with(word)) {
        json!({ "type": "integer" })
    } else if wants.contains("sequence") || wants.contains("array") {
        json!({ "type": "array" })
    } else {
        json!({ "type": "object" })
    }
}

/// The schema of a table with all below it.
fn table(name: &str, said: &BTreeMap<String, String>) -> Value {
    let mut properties = Map::new();
    for key in keys_of(name).unwrap_or_default() {
        let whole = match name {
            "" => key.clone(),
            name => format!("{name}.{key}"),
        };
        let mut schema = match keys_of(&whole) {
            Some(_) => table(&whole, said),
            None => leaf(name, &key),
        };
        if let (Some(text), Value::Object(schema)) = (said.get(&whole), &mut schema) {
            schema.insert("description".into(), text.clone().into());
        }
        let plain = quantities().find(|known| known.table == name && known.with_unit == key);
        if let Some(known) = plain {
            let text = said.get(&whole).map_or("", String::as_str);
            let unit = format!("{text}; with its unit, in place of {key}");
            let quantity = json!({ "type": "string", "pattern": "^[-+0-9.]", "description": unit.trim_start_matches("; ") });
            properties.insert(known.plain.to_string(), quantity);
        }
        properties.insert(key, schema);
    }
    json!({ "type": "object", "properties": properties, "additionalProperties": false })
}

#[test]
fn the_schema_of_rig_toml_is_what_its_types_take() {
    let mut schema = table("", &descriptions());
    schema["$schema"] = json!("http://json-schema.org/draft-07/schema#");
    schema["title"] = json!("rig.toml of cellpos");
    let period = &schema["properties"]["timing"]["properties"];
    assert_eq!(period["period_us"]["type"], "number", "{period}");
    assert_eq!(period["period"]["type"], "string");
    assert_eq!(period["coast_ticks"]["type"], "integer");
    let arming = &schema["properties"]["arming"]["properties"];
    assert_eq!(arming["check"]["type"], "boolean");
    let camera = &schema["properties"]["camera"]["properties"];
    assert!(
        camera["kind"]["enum"]
            .as_array()
            .is_some_and(|kinds| kinds.len() >= 3),
        "{camera}"
    );
    // Nothing that the walk finds is missing.
    let mut all = BTreeSet::new();
    all_below("", &mut all);
    for key in all {
        let at = |value: &Value, key: &str| value["properties"][key].clone();
        let found = key
            .split('.')
            .fold(schema.clone(), |value, key| at(&value, key));
        assert!(found.is_object(), "{key}");
    }
    let text = serde_json::to_string_pretty(&schema).expect("JSON") + "\n";
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/schemas/rig.json");
    if std::env::var_os("CELLPOS_WRITE_SCHEMAS").is_some() {
        std::fs::write(&path, &text).expect("written");
    }
    let kept = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(
        kept == text,
        "docs/schemas/rig.json is not of these types: CELLPOS_WRITE_SCHEMAS=1 writes it anew"
    );
}
