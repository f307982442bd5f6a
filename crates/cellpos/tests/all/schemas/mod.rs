//! docs/schemas agrees with the program's input and output. With CELLPOS_WRITE_SCHEMAS=1 the tests write the schemas again, those
//! of JSON objects with their new keys.

mod files;
mod objects;

pub(crate) use objects::hold;

use serde_json::Value;
use std::path::{Path, PathBuf};

fn path(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("../../docs/schemas/{name}.json"))
}

fn writes() -> bool {
    std::env::var_os("CELLPOS_WRITE_SCHEMAS").is_some()
}

fn kept(name: &str) -> Option<Value> {
    let text = std::fs::read_to_string(path(name)).ok()?;
    Some(serde_json::from_str(&text).unwrap())
}

fn write(name: &str, schema: &Value) {
    let text = serde_json::to_string_pretty(schema).unwrap() + "\n";
    std::fs::write(path(name), text).unwrap();
}

/// What does not fit a schema of the kind that stands here: `type`, `enum`, `properties`, `required`, `items`.
fn misfits(schema: &Value, value: &Value, at: &str, found: &mut Vec<String>) {
    let kind = match value {
        Value::Null => "null",
        Value::Bool(_) => "boolean",
        Value::Number(_) => "number",
        Value::String(_) => "string",
        Value::Array(_) => "array",
        Value::Object(_) => "object",
    };
    let allowed = match &schema["type"] {
        Value::String(one) => vec![one.as_str()],
        Value::Array(many) => many.iter().filter_map(Value::as_str).collect(),
        _ => Vec::new(),
    };
    if !allowed.is_empty() && !allowed.contains(&kind) {
        found.push(format!("{at}: {kind}, not {allowed:?}"));
    }
    if let Some(words) = schema["enum"].as_array()
        && !words.contains(value)
    {
        found.push(format!("{at}: {value} is none of {words:?}"));
    }
    for (place, item) in value.as_array().into_iter().flatten().enumerate() {
        misfits(&schema["items"], item, &format!("{at}[{place}]"), found);
    }
    let (Some(properties), Some(object)) = (schema["properties"].as_object(), value.as_object())
    else {
        return;
    };
    for key in schema["required"].as_array().into_iter().flatten() {
        if key.as_str().is_some_and(|key| !object.contains_key(key)) {
            found.push(format!("{at}: {key} is missing"));
        }
    }
    for (key, value) in object {
        match properties.get(key) {
            Some(schema) => misfits(schema, value, &format!("{at}.{key}"), found),
            None => found.push(format!("{at}.{key} is not in the schema")),
        }
    }
}
