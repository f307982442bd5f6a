//! What a run was: sample, date, machine, devices, controller.

use super::cycles::short;
use super::session::Session;
use cellpos_record::RunMeta;
use cellpos_report::{Report, Table};
use cellpos_script::{ArmKind, CycleFlags, CycleRow};

/// A value of a table by the path of its keys.
pub(super) fn at<'t>(table: &'t toml::Table, path: &[&str]) -> Option<&'t toml::Value> {
    let (first, rest) = path.split_first()?;
    let mut value = table.get(*first)?;
    for key in rest {
        value = value.get(key)?;
    }
    Some(value)
}

fn text_at(table: &toml::Table, path: &[&str]) -> Option<String> {
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

/// What was done: task, loop, rig, start.
pub(super) fn lead(meta: &RunMeta, rows: &[CycleRow]) -> String {
    format!("{} {}", task(meta, rows), place(meta))
}

/// Whether a cell is followed, not a bead.
pub(super) fn is_cell(meta: &RunMeta) -> bool {
    let has = |path: &[&str]| at(&meta.config, path).is_some();
    has(&["rig", "cell"]) || has(&["rig", "emulator", "cell"])
}

/// What is followed.
pub(super) fn subject(meta: Option<&RunMeta>) -> &'static str {
    match meta.is_some_and(is_cell) {
        true => "cell",
        false => "bead",
    }
}

/// Whether the rig is one.
pub(super) fn rig(meta: &RunMeta) -> &'static str {
    let emulated = text_at(&meta.config, &["rig", "actuator", "kind"])
        .is_some_and(|kind| kind.starts_with("emulated"));
    match (emulated, meta.clock.as_str()) {
        (true, "virtual") => "Emulated rig (a simulation, not in real time)",
        (true, _) => "Emulated rig (a simulation, in real time)",
        (false, _) => "On a rig",
    }
}

/// How the loop was closed, on which rig, and when.
fn place(meta: &RunMeta) -> String {
    let mut text = String::new();
    let period_us = at(&meta.config, &["timing", "period_us"]).and_then(toml::Value::as_float);
    if let Some(us) = period_us.filter(|us| *us > 0.0) {
        let hz = (1e6 / us).round();
        text.push_str(&format!(
            "Camera and piezo (PZT) close the loop {hz} times a second"
        ));
        if let Some(law) = text_of_law(meta) {
            text.push_str(&format!("; control law: {law}"));
        }
        text.push_str(". ");
    }
    text.push_str(rig(meta));
    if let Some(cells) = text_at(&meta.config, &["rig", "sample", "name"]) {
        text.push_str(&format!(", sample {cells}"));
    }
    if let Some(minute) = meta.started_utc.get(..16) {
        text.push_str(&format!(", {} UTC", minute.replace('T', " ")));
    }
    text.push('.');
    text
}

/// The control law as people write it.
fn text_of_law(meta: &RunMeta) -> Option<String> {
    let law = text_at(&meta.controller, &["controller"])?;
    Some(match law.as_str() {
        "pi" | "lqg" | "mpc" => law.to_uppercase(),
        "lead" => "PI with lead".to_owned(),
        _ => law,
    })
}

/// What the run was to do, as people say it.
pub(super) fn task(meta: &RunMeta, rows: &[CycleRow]) -> String {
    let config = &meta.config;
    let number = |key: &str| at(config, &["reference", key]).and_then(toml::Value::as_float);
    let kind = text_at(config, &["reference", "kind"]).unwrap_or_default();
    let what = subject(Some(meta));
    let (amplitude, frequency) = (number("amplitude_um"), number("frequency_hz"));
    match (kind.as_str(), amplitude, frequency) {
        ("script", ..) => {
            let file = text_at(config, &["reference", "file"]).unwrap_or_default();
            let file = file.rsplit('/').next().unwrap_or_default();
            format!("Task: script {file}{}.", cycles_of(rows, what))
        }
        (_, Some(um), Some(hz)) => {
            format!("Task: move a {what} to and fro on a sine, {um} um to each side at {hz} Hz.")
        }
        _ => match number("position_um") {
            Some(um) => format!("Task: hold a {what} at {um} um along the channel."),
            None => format!("Task: {kind}."),
        },
    }
}

/// The cycles of a script and its static arm.
fn cycles_of(rows: &[CycleRow], what: &str) -> String {
    let of = |arm: ArmKind| {
        let rows = rows.iter().filter(move |row| row.arm == arm);
        rows.filter(|row| !row.flags.has(CycleFlags::RAMP))
    };
    let (cyclic, fixed) = (
        of(ArmKind::Cyclic).count(),
        of(ArmKind::Static).map(|row| row.duration_s).sum::<f64>(),
    );
    let mut text = String::new();
    if let Some(first) = of(ArmKind::Cyclic).find(|row| row.stroke_um.is_finite()) {
        let motion = (first.stroke_um, first.duration_s);
        text.push_str(&format!(", {cyclic} cycles"));
        if of(ArmKind::Cyclic).all(|row| row.moves_as(motion)) {
            let [um, s] = [2.0 * first.stroke_um, first.duration_s].map(short);
            text.push_str(&format!(" of the {what}, {um} um to and fro in {s} s each"));
        }
    }
    if fixed > 0.0 {
        let then = match (of(ArmKind::Cyclic).next(), of(ArmKind::Static).next()) {
            (Some(cyclic), Some(fixed)) if cyclic.cycle < fixed.cycle => {
                ", then a static arm: the same "
            }
            _ => "; a static arm: the ",
        };
        text.push_str(&format!("{then}{what} held under load for {fixed:.0} s"));
    }
    text
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
    add("host", text_at(&meta.conditions, &["host"]));
    add("clock", Some(meta.clock.clone()));
    let device = |kind: &str| {
        let of_rig = text_at(&meta.config, &["rig", kind, "kind"]);
        let name = text_at(&meta.conditions, &[kind, "name"]);
        match (of_rig, name) {
            (Some(kind), Some(name)) if name != kind => Some(format!("{kind}: {name}")),
            (one, other) => one.or(other),
        }
    };
    add("actuator", device("actuator"));
    add("camera", device("camera"));
    let law = text_at(&meta.controller, &["controller"]);
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
        text_at(&meta.controller, &["delay_ms"]).map(|ms| format!("{ms} ms")),
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
