//! A model as the text of a TOML file.

use crate::model::Model;
use std::fmt::Write as _;

pub(super) fn float(value: f64) -> String {
    // `{:?}` is the shortest text that reads back to the same bits; TOML wants a digit on both sides of the point.
    let text = format!("{value:?}");
    match text.split_once('e') {
        Some((mantissa, exponent)) if !mantissa.contains('.') => format!("{mantissa}.0e{exponent}"),
        _ => text,
    }
}

pub(super) fn floats(values: &[f64]) -> String {
    let texts: Vec<String> = values.iter().map(|v| float(*v)).collect();
    format!("[{}]", texts.join(", "))
}

pub(super) fn quoted(text: &str) -> String {
    toml::Value::String(text.to_owned()).to_string()
}

/// A key, bare where TOML allows it.
fn key(name: &str) -> String {
    let bare = !name.is_empty()
        && name
            .chars()
            .all(|c| c.is_ascii_alphanumeric() || c == '-' || c == '_');
    if bare { name.to_owned() } else { basic(name) }
}

/// A one-line basic string, the only kind that is allowed as a key.
fn basic(text: &str) -> String {
    let mut out = String::from("\"");
    for c in text.chars() {
        match c {
            '"' => out.push_str("\\\""),
            '\\' => out.push_str("\\\\"),
            c if c.is_control() => {
                let _ = write!(out, "\\U{:08X}", u32::from(c));
            }
            c => out.push(c),
        }
    }
    out.push('"');
    out
}

pub(crate) fn write(model: &Model) -> String {
    let mut out = String::new();
    let mut line = |text: String| {
        out.push_str(&text);
        out.push('\n');
    };
    line(format!("name = {}", quoted(&model.name)));
    if !model.description.is_empty() {
        line(format!("description = {}", quoted(&model.description)));
    }
    line("# PZT displacement at which the bead is at rest".to_owned());
    line(format!(
        "working_point_um = {}",
        float(model.working_point_um)
    ));
    line("\n# bead position [um] over PZT displacement [um]; coefficients of s [rad/s], highest power first\n[plant]".to_owned());
    line(format!("num = {}", floats(model.plant.num())));
    line(format!("den = {}", floats(model.plant.den())));
    line("\n[noise]".to_owned());
    line(format!(
        "diffusion_um2_per_s = {}",
        float(model.noise.diffusion_um2_per_s)
    ));
    line(format!(
        "localisation_um = {}",
        float(model.noise.localisation_um)
    ));
    if let Some(delay_s) = model.camera_delay_s {
        line("\n# from a command to the exposure that shows it and on to the tick that uses it; no part of the plant\n[camera]".to_owned());
        line(format!("delay_ms = {}", float(delay_s * 1e3)));
        if let Some(age_s) = model.frame_age_s {
            line(
                "# of this, from the middle of the exposure on: camera_delay_ms of rig.toml"
                    .to_owned(),
            );
            line(format!("frame_age_ms = {}", float(age_s * 1e3)));
        }
    }
    let mut written: Vec<&str> = Vec::new();
    for effect in &model.effects {
        if let Some(definition) = effect.kind().definition()
            && !written.contains(&effect.id())
        {
            written.push(effect.id());
            line(
                definition
                    .to_toml_string("definitions")
                    .trim_end()
                    .to_owned(),
            );
        }
    }
    for effect in &model.effects {
        line(format!(
            "\n[[effects]] # {}\nid = \"{}\"",
            effect.place(),
            effect.id()
        ));
        if let Some(form) = effect.form() {
            line(format!("form = \"{form}\""));
        }
        for p in effect.parameters() {
            if !p.name.contains('[') {
                line(format!("{} = {}", p.name, float(p.value)));
            }
        }
        for (i, list) in effect.kind().spec().forms[effect.form_index()]
            .lists
            .iter()
            .enumerate()
        {
            line(format!("{} = {}", list.name, floats(effect.list(i))));
        }
    }
    if let Some(covariance) = &model.covariance {
        let names: Vec<String> = covariance.parameters.iter().map(|n| basic(n)).collect();
        line(format!(
            "\n[covariance]\nparameters = [{}]\nmatrix = [",
            names.join(", ")
        ));
        for row in &covariance.matrix {
            line(format!("    {},", floats(row)));
        }
        line("]".to_owned());
    }
    if !model.intervals.is_empty() {
        line("\n# 95 % confidence intervals\n[intervals]".to_owned());
        for (name, interval) in &model.intervals {
            line(format!("{} = {}", key(name), floats(interval)));
        }
    }
    if !model.provenance.is_empty() {
        line("\n[provenance]".to_owned());
        for (name, text) in &model.provenance {
            line(format!("{} = {}", key(name), quoted(text)));
        }
    }
    out
}
