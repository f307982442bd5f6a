//! What a run was: sample, date, machine, devices, controller.

use super::session::Session;
use cellpos_record::RunMeta;
use cellpos_report::{Report, Table};

/// A value of a table by the path of its keys.
pub(super) fn at<'t>(table: &'t toml::Table, path: &[&str]) -> Option<&'t toml::Value> {
    let (first, rest) = path.split_first()?;
    let mut value = table.get(*first)?;
    for key in rest {
        value = value.get(key)?;
    }
    Some(value)
}

fn text(table: &toml::Table, path: &[&str]) -> Option<String> {
    at(table, path).map(|value| match value {
        toml::Value::String(text) => text.clone(),
        other => other.to_string(),
    })
}

/// Size of a pixel on the chip, um.
pub(super) fn pixel_um(meta: &RunMeta) -> Option<f64> {
    let of = |kind: &str| at(&meta.config, &["rig", kind, "pixel_um"])?.as_float();
    of("calibration").or_else(|| of("emulator"))
}

/// What was done, in a line: reference, control law, rig, clock, start.
pub(super) fn lead(meta: &RunMeta) -> String {
    let mut parts = vec![reference(&meta.config)];
    if let Some(law) = text(&meta.controller, &["controller"]) {
        parts.push(format!("control law {law}"));
    }
    let emulated = text(&meta.config, &["rig", "actuator", "kind"])
        .is_some_and(|kind| kind.starts_with("emulated"));
    let clock = if meta.clock == "virtual" {
        ", virtual clock"
    } else {
        ""
    };
    let rig = if emulated { "emulated rig" } else { "rig" };
    parts.push(format!("{rig}{clock}"));
    if let Some(cells) = text(&meta.config, &["rig", "sample", "name"]) {
        parts.push(format!("sample {cells}"));
    }
    if let Some(minute) = meta.started_utc.get(..16) {
        parts.push(format!("{} UTC", minute.replace('T', " ")));
    }
    parts.retain(|part| !part.is_empty());
    format!("{}.", parts.join(" \u{b7} "))
}

/// The reference as people say it.
fn reference(config: &toml::Table) -> String {
    let number = |key: &str| at(config, &["reference", key]).and_then(toml::Value::as_float);
    let kind = text(config, &["reference", "kind"]).unwrap_or_default();
    match (
        kind.as_str(),
        number("amplitude_um"),
        number("frequency_hz"),
    ) {
        ("script", ..) => {
            let file = text(config, &["reference", "file"]).unwrap_or_default();
            format!("Script {file}")
        }
        (_, Some(um), Some(hz)) => format!("Sine of {um} um (half of peak to peak) at {hz} Hz"),
        _ => match number("target_um").or_else(|| number("um")) {
            Some(um) => format!("Hold at {um} um"),
            None => kind,
        },
    }
}

/// Sample, date, machine, devices, controller and gains.
pub(super) fn what_it_was(page: &mut Report, sessions: &[Session]) {
    let Some(meta) = sessions.iter().find_map(|session| session.meta.as_ref()) else {
        return;
    };
    let mut rows: Vec<(String, String)> = Vec::new();
    let sample = at(&meta.config, &["rig", "sample"])
        .and_then(|value| value.clone().try_into::<cellpos_script::Sample>().ok())
        .unwrap_or_default();
    for (name, value) in sample.rows() {
        rows.push((name.to_owned(), value));
    }
    let mut add = |name: &str, value: Option<String>| {
        if let Some(value) = value.filter(|value| !value.is_empty()) {
            rows.push((name.to_owned(), value));
        }
    };
    add("started (UTC)", Some(meta.started_utc.clone()));
    add("host", text(&meta.conditions, &["host"]));
    add("clock", Some(meta.clock.clone()));
    let device = |kind: &str| {
        let of_rig = text(&meta.config, &["rig", kind, "kind"]);
        let name = text(&meta.conditions, &[kind, "name"]);
        match (of_rig, name) {
            (Some(kind), Some(name)) if name != kind => Some(format!("{kind}: {name}")),
            (one, other) => one.or(other),
        }
    };
    add("actuator", device("actuator"));
    add("camera", device("camera"));
    let law = text(&meta.controller, &["controller"]);
    let gains = meta
        .controller
        .get("pi")
        .and_then(toml::Value::as_table)
        .map(|gains| {
            let gains: Vec<String> = gains
                .iter()
                .map(|(key, value)| match value.as_float() {
                    Some(number) => format!("{key} = {number:.4}"),
                    None => format!("{key} = {value}"),
                })
                .collect();
            gains.join(", ")
        });
    add(
        "controller",
        law.map(|law| match (law.as_str(), gains) {
            ("pi", Some(gains)) => format!("pi: {gains}"),
            (_, Some(gains)) => format!("{law} (its fallback PI: {gains})"),
            (_, None) => law,
        }),
    );
    add(
        "loop delay designed for",
        text(&meta.controller, &["delay_ms"]).map(|ms| format!("{ms} ms")),
    );
    let version = |name: &str| meta.versions.get(name).cloned();
    add(
        "cellpos",
        version("cellpos").map(|cellpos| match version("commit") {
            Some(commit) => format!("{cellpos} ({commit})"),
            None => cellpos,
        }),
    );
    add("command", Some(meta.command_line.join(" ")));
    let rows: Vec<(&str, String)> = rows
        .iter()
        .map(|(name, value)| (name.as_str(), value.clone()))
        .collect();
    page.table(Table::key_values(&rows));
}
