//! The files that people write: scripts and models. (docs/schemas/rig.json is tested where its types are.)

use super::{kept, misfits, write, writes};
use cellpos_plant::effects;
use cellpos_plant::effects::ParameterSpec;
use cellpos_script::Script;
use serde_json::{Map, Value, json};
use std::path::Path;

const DRAFT: &str = "http://json-schema.org/draft-07/schema#";
const NOBODYS: &str = "zzzzqq";

/// The schema in the folder is this one.
fn hold(name: &str, mut schema: Value, title: &str) {
    schema["$schema"] = json!(DRAFT);
    schema["title"] = json!(title);
    if writes() {
        write(name, &schema);
    }
    assert!(
        kept(name) == Some(schema),
        "docs/schemas/{name}.json is not what the program takes: CELLPOS_WRITE_SCHEMAS=1 writes it anew"
    );
}

fn refusal(script: &str) -> String {
    let closed = |_: &str| Ok("time_s,position_um\n0,0\n0.1,1\n0.2,0\n".to_owned());
    match Script::parse_with(script, "s", &closed) {
        Ok(_) => String::new(),
        Err(error) => error.to_string(),
    }
}

/// The words that a refusal lists behind `word`.
fn listed(refusal: &str, word: &str) -> Vec<String> {
    let list = refusal.split(word).nth(1).unwrap_or("");
    list.split(", ")
        .map(|key| key.trim().to_owned())
        .filter(|key| !key.is_empty())
        .collect()
}

/// What a kind of step needs, each with a value, for the others to be looked at.
fn needed(kind: &str) -> &'static [(&'static str, &'static str)] {
    match kind {
        "hold" => &[("duration", "\"1s\"")],
        "move" => &[("to", "\"1um\""), ("duration", "\"1s\"")],
        "sine" | "triangle" | "trapezoid" => &[
            ("amplitude", "\"1um\""),
            ("frequency", "\"1Hz\""),
            ("cycles", "10"),
        ],
        "waveform" => &[("file", "\"a.csv\"")],
        "repeat" => &[("times", "2")],
        "sweep" => &[("name", "\"a\""), ("values", "[\"1um\"]")],
        "wait" => &[("for", "\"settled\""), ("timeout", "\"1s\"")],
        "mark" => &[("text", "\"a\"")],
        _ => &[("like", "\"a\"")],
    }
}

/// A script with one key, in a step of a kind or in a table.
fn with(place: &str, key: &str, value: &str) -> String {
    let hold = "[[step]]\ndo = \"hold\"\nlabel = \"a\"\nduration = \"1s\"\n";
    match place {
        "" => format!("{key} = {value}\n{hold}"),
        "stop" | "sample" | "clips" => format!("{hold}[{place}]\n{key} = {value}\n"),
        kind => {
            // Of `wait for position` the level is looked at, of a move the speed in place of the duration.
            let level = ["above", "below"].contains(&key);
            let rest: String = (needed(kind).iter())
                .filter(|(name, _)| *name != key && !(key == "speed" && *name == "duration"))
                .map(|(name, value)| match (*name, level) {
                    ("for", true) => "for = \"position\"\n".to_owned(),
                    _ => format!("{name} = {value}\n"),
                })
                .collect();
            let inner = match kind {
                "repeat" | "sweep" => "[[step.step]]\ndo = \"hold\"\nduration = \"1s\"\n",
                _ => "",
            };
            let key = if key == "do" {
                String::new()
            } else {
                format!("{key} = {value}\n")
            };
            format!("{hold}[[step]]\ndo = \"{kind}\"\n{rest}{key}{inner}")
        }
    }
}

/// The schema of a key, from the reader's reaction to a number and to a word.
fn leaf(place: &str, key: &str) -> Value {
    let number = refusal(&with(place, key, "1.5"));
    let word = refusal(&with(place, key, &format!("\"{NOBODYS}\"")));
    if word.contains("one of ") {
        json!({ "enum": listed(&word, "one of ") })
    } else if number.contains("whole number") {
        json!({ "type": ["integer", "string"], "pattern": "^\\$", "description": "a whole number, or \"$name\" in a sweep" })
    } else if number.contains("true or false") {
        json!({ "type": "boolean" })
    } else if number.contains("list of numbers") {
        json!({ "type": "array", "items": { "type": "number" } })
    } else if number.contains("list")
        || number.contains("missing or empty")
        || number.contains("array")
    {
        json!({ "type": "array", "items": { "type": "string" } })
    } else if number.contains("has no unit") {
        let needs = number.split("has no unit; ").nth(1).unwrap_or("");
        json!({ "type": "string", "description": needs })
    } else {
        assert!(number.contains("text"), "{place} {key}: {number}");
        json!({ "type": "string" })
    }
}

/// The schema of a table, or of a step of one kind.
fn table(place: &str) -> Value {
    let keys = listed(&refusal(&with(place, NOBODYS, "1")), "keys here: ");
    assert!(!keys.is_empty(), "{place}");
    let mut properties = Map::new();
    for key in keys {
        let schema = match key.as_str() {
            "step" => {
                json!({ "type": "array", "minItems": 1, "items": { "$ref": "#/definitions/step" } })
            }
            "do" => json!({ "const": place }),
            "stop" | "sample" | "clips" if place.is_empty() => table(&key),
            key => leaf(place, key),
        };
        properties.insert(key, schema);
    }
    json!({ "type": "object", "properties": properties, "additionalProperties": false })
}

#[test]
fn the_schema_of_scripts_is_what_their_reader_takes() {
    let kinds = listed(&refusal("[[step]]\ndo = \"zzzzqq\"\n"), "one of ");
    assert!(kinds.len() >= 11, "{kinds:?}");
    let mut schema = table("");
    // Editors complete from `properties`; which keys go with which kind, `allOf` says.
    let mut all = Map::new();
    let mut choice = Vec::new();
    for kind in &kinds {
        let step = table(kind);
        for (key, schema) in step["properties"].as_object().unwrap() {
            all.entry(key.clone()).or_insert_with(|| schema.clone());
        }
        let is = json!({ "properties": { "do": { "const": kind } } });
        choice.push(json!({ "if": is, "then": step }));
    }
    all.insert("do".into(), json!({ "enum": kinds }));
    let step = json!({ "type": "object", "required": ["do"], "properties": all, "allOf": choice });
    schema["definitions"] = json!({ "step": step });
    schema["required"] = json!(["step"]);
    let of = |kind: &str, key: &str| leaf(kind, key);
    assert_eq!(
        of("wait", "on_timeout"),
        json!({ "enum": ["stop", "continue"] })
    );
    assert_eq!(of("move", "speed")["type"], "string");
    assert_eq!(of("sine", "cycles")["type"][0], "integer");
    hold("script", schema, "Setpoint script of cellpos");
}

fn number(spec: &ParameterSpec) -> Value {
    let mut schema = json!({ "type": "number" });
    if !spec.unit.is_empty() {
        schema["description"] = json!(spec.unit);
    }
    for (key, bound) in [("minimum", spec.lower), ("maximum", spec.upper)] {
        if bound.abs() < 1e300 {
            schema[key] = json!(bound);
        }
    }
    if let Some(default) = spec.default {
        schema["default"] = json!(default);
    }
    schema
}

/// One effect in one of its forms.
fn effect(spec: &effects::Spec, form: usize) -> Value {
    let of = &spec.forms[form];
    let mut properties = Map::from_iter([("id".to_owned(), json!({ "const": spec.id }))]);
    let mut required = vec!["id"];
    if spec.forms.len() > 1 {
        properties.insert("form".into(), json!({ "const": of.name }));
        if form > 0 {
            required.push("form");
        }
    }
    for scalar in of.scalars {
        properties.insert(scalar.name.into(), number(scalar));
        if scalar.default.is_none() {
            required.push(scalar.name);
        }
    }
    for list in of.lists {
        properties.insert(
            list.name.into(),
            json!({ "type": "array", "items": number(list) }),
        );
        required.push(list.name);
    }
    json!({
        "type": "object", "description": spec.equation, "properties": properties, "required": required,
        "additionalProperties": false
    })
}

#[test]
fn the_schema_of_models_is_the_catalogue_of_effects() {
    let numbers = json!({ "type": "array", "items": { "type": "number" }, "minItems": 1 });
    let text = json!({ "type": "string" });
    let kinds: Vec<Value> = (effects::all().iter())
        .flat_map(|kind| (0..kind.spec().forms.len()).map(|form| effect(kind.spec(), form)))
        // An effect of the file's own [[definitions]] has the parameters that it defines.
        .chain([json!({ "type": "object", "required": ["id"],
            "properties": { "id": { "type": "string", "not": { "enum": effects::ids() } } } })])
        .collect();
    let table = |properties: Value| json!({ "type": "object", "properties": properties, "additionalProperties": false });
    let zero_up = json!({ "type": "number", "minimum": 0 });
    let schema = json!({
        "type": "object",
        "required": ["working_point_um", "plant"],
        "additionalProperties": false,
        "properties": {
            "name": text, "description": text,
            "working_point_um": { "type": "number", "description": "PZT displacement at which the bead is at rest" },
            "plant": table(json!({ "num": numbers, "den": numbers })),
            "noise": table(json!({ "diffusion_um2_per_s": zero_up, "localisation_um": zero_up })),
            "camera": table(json!({ "delay_ms": zero_up, "frame_age_ms": zero_up })),
            "effects": { "type": "array", "items": { "anyOf": kinds } },
            "definitions": { "type": "array", "items": { "type": "object" } },
            "covariance": table(json!({
                "parameters": { "type": "array", "items": text },
                "matrix": { "type": "array", "items": numbers }
            })),
            "intervals": { "type": "object", "additionalProperties": numbers },
            "provenance": { "type": "object", "additionalProperties": text }
        }
    });
    // The reader refuses every other key, and names those that it knows.
    let mut found = Vec::new();
    let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples");
    for name in ["model.toml", "hidden.toml"] {
        let file: toml::Value =
            toml::from_str(&std::fs::read_to_string(examples.join(name)).unwrap()).unwrap();
        misfits(
            &schema,
            &serde_json::to_value(file).unwrap(),
            name,
            &mut found,
        );
    }
    assert!(found.is_empty(), "{found:?}");
    for key in schema["properties"].as_object().unwrap().keys() {
        let error =
            cellpos_plant::Model::from_toml_str(&format!("{key} = {{ {NOBODYS} = 1 }}\n"), "m")
                .unwrap_err();
        assert!(
            !error.to_string().contains(&format!("unknown key `{key}`")),
            "{error}"
        );
    }
    let error = cellpos_plant::Model::from_toml_str(&format!("{NOBODYS} = 1\n"), "m").unwrap_err();
    assert!(error.to_string().contains("unknown"), "{error}");
    hold("model", schema, "model.toml of cellpos");
}
