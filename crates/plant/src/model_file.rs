//! model.toml: reading with positions and suggestions, writing so that it reads back to the bit.

use crate::effect::{EFFECT_IDS, Effect, EffectError, Hysteresis, ParameterSpec};
use crate::effect::{play_lists, specs};
use crate::error::{ModelError, Position};
use crate::model::{Covariance, Model, Noise};
use crate::transfer::TransferFunction;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::ops::Range;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

type Value<'i> = Spanned<DeValue<'i>>;

/// A table of the file with the path to it.
struct Table<'a, 'i> {
    file: &'a str,
    text: &'a str,
    path: String,
    span: Range<usize>,
    entries: &'a DeTable<'i>,
}

impl<'a, 'i> Table<'a, 'i> {
    fn at(&self, span: Range<usize>) -> Position {
        Position::of(self.text, span)
    }

    fn key(&self, name: &str) -> String {
        if self.path.is_empty() {
            name.to_owned()
        } else {
            format!("{}.{name}", self.path)
        }
    }

    fn only(&self, known: &[&str]) -> Result<(), ModelError> {
        for key in self.entries.keys() {
            let name: &str = key.get_ref();
            if !known.contains(&name) {
                return Err(ModelError::UnknownKey {
                    file: self.file.to_owned(),
                    at: self.at(key.span()),
                    key: self.key(name),
                    suggestion: nearest(name, known),
                    known: known.iter().map(|k| (*k).to_owned()).collect(),
                });
            }
        }
        Ok(())
    }

    fn get(&self, name: &str) -> Option<&'a Value<'i>> {
        self.entries.get(name)
    }

    fn need(&self, name: &str, what: impl Into<String>) -> Result<&'a Value<'i>, ModelError> {
        self.get(name).ok_or_else(|| ModelError::MissingKey {
            file: self.file.to_owned(),
            at: self.at(self.span.clone()),
            key: self.key(name),
            what: what.into(),
        })
    }

    fn wrong(&self, name: &str, value: &Value<'_>, expected: &'static str) -> ModelError {
        ModelError::WrongType {
            file: self.file.to_owned(),
            at: self.at(value.span()),
            key: self.key(name),
            found: format!("of type {}", value.get_ref().type_str()),
            expected,
        }
    }

    fn text_of(&self, name: &str, value: &Value<'_>) -> Result<String, ModelError> {
        match value.get_ref() {
            DeValue::String(s) => Ok(s.to_string()),
            _ => Err(self.wrong(name, value, "a text in quotes")),
        }
    }

    /// A number, which may be infinite or not a number.
    fn raw(&self, name: &str, value: &Value<'_>) -> Result<f64, ModelError> {
        let number = match value.get_ref() {
            DeValue::Float(f) => f.as_str().replace('_', "").parse().ok(),
            DeValue::Integer(i) => i128::from_str_radix(i.as_str(), i.radix())
                .ok()
                .map(|i| i as f64),
            _ => return Err(self.wrong(name, value, "a number")),
        };
        number.ok_or_else(|| self.wrong(name, value, "a number that fits 64 bits"))
    }

    fn number(
        &self,
        name: &str,
        value: &Value<'_>,
        spec: &ParameterSpec,
    ) -> Result<f64, ModelError> {
        let number = self.raw(name, value)?;
        if number.is_finite() && number >= spec.lower && number <= spec.upper {
            return Ok(number);
        }
        Err(ModelError::OutOfRange {
            file: self.file.to_owned(),
            at: self.at(value.span()),
            key: self.key(name),
            value: number,
            unit: spec.unit.to_owned(),
            lower: spec.lower,
            upper: spec.upper,
        })
    }

    fn list<T>(
        &self,
        name: &str,
        value: &'a Value<'i>,
        expected: &'static str,
        item: impl Fn(&str, &'a Value<'i>) -> Result<T, ModelError>,
    ) -> Result<Vec<T>, ModelError> {
        let DeValue::Array(array) = value.get_ref() else {
            return Err(self.wrong(name, value, expected));
        };
        array
            .iter()
            .enumerate()
            .map(|(i, v)| item(&format!("{name}[{i}]"), v))
            .collect()
    }

    fn table(&self, name: &str, value: &'a Value<'i>) -> Result<Table<'a, 'i>, ModelError> {
        let DeValue::Table(entries) = value.get_ref() else {
            return Err(self.wrong(name, value, "a table"));
        };
        Ok(Table {
            file: self.file,
            text: self.text,
            path: self.key(name),
            span: value.span(),
            entries,
        })
    }

    fn inconsistent(&self, span: Range<usize>, message: String) -> ModelError {
        ModelError::Inconsistent {
            file: self.file.to_owned(),
            at: self.at(span),
            message,
        }
    }
}

const fn range(unit: &'static str, lower: f64, upper: f64) -> ParameterSpec {
    ParameterSpec {
        name: "",
        unit,
        lower,
        upper,
        log_scaled: false,
        fixed: false,
        default: None,
    }
}

/// Any finite number.
const FINITE: ParameterSpec = range("", -f64::MAX, f64::MAX);
const WORKING_POINT: ParameterSpec = range("um", -1e4, 1e4);
const DIFFUSION: ParameterSpec = range("um^2/s", 0.0, 1e4);
const LOCALISATION: ParameterSpec = range("um", 0.0, 100.0);

const TOP: [&str; 9] = [
    "name",
    "description",
    "working_point_um",
    "plant",
    "effects",
    "noise",
    "covariance",
    "intervals",
    "provenance",
];

const HYSTERESIS_FORMS: [&str; 3] = ["bouc-wen", "bouc-wen-explicit", "play"];

pub(crate) fn read(text: &str, file: &str) -> Result<Model, ModelError> {
    let document = DeTable::parse(text).map_err(|error| ModelError::Syntax {
        file: file.to_owned(),
        at: Position::of(text, error.span().unwrap_or(0..0)),
        message: error.message().to_owned(),
    })?;
    let top = Table {
        file,
        text,
        path: String::new(),
        span: 0..0,
        entries: document.get_ref(),
    };
    top.only(&TOP)?;
    let name = match top.get("name") {
        Some(v) => top.text_of("name", v)?,
        None => String::new(),
    };
    let description = match top.get("description") {
        Some(v) => top.text_of("description", v)?,
        None => String::new(),
    };
    let working_point = top.need(
        "working_point_um",
        "the PZT displacement at which the bead is at rest, for example working_point_um = 4.0",
    )?;
    let working_point_um = top.number("working_point_um", working_point, &WORKING_POINT)?;
    let plant = top.need(
        "plant",
        "a table with the coefficients num and den, highest power of s first",
    )?;
    let plant = read_plant(&top.table("plant", plant)?)?;
    let effects = match top.get("effects") {
        None => Vec::new(),
        Some(v) => top.list(
            "effects",
            v,
            "an array of tables, [[effects]]",
            |name, v| read_effect(&top.table(name, v)?),
        )?,
    };
    let noise = match top.get("noise") {
        None => Noise::NONE,
        Some(v) => read_noise(&top.table("noise", v)?)?,
    };
    let covariance = top
        .get("covariance")
        .map(|v| read_covariance(&top.table("covariance", v)?))
        .transpose()?;
    let intervals = match top.get("intervals") {
        None => BTreeMap::new(),
        Some(v) => read_intervals(&top.table("intervals", v)?)?,
    };
    let provenance = match top.get("provenance") {
        None => BTreeMap::new(),
        Some(v) => {
            let table = top.table("provenance", v)?;
            let mut map = BTreeMap::new();
            for (key, value) in table.entries {
                map.insert(
                    key.get_ref().to_string(),
                    table.text_of(key.get_ref(), value)?,
                );
            }
            map
        }
    };
    Ok(Model {
        name,
        description,
        plant,
        working_point_um,
        effects,
        noise,
        covariance,
        intervals,
        provenance,
    })
}

fn read_plant(table: &Table<'_, '_>) -> Result<TransferFunction, ModelError> {
    table.only(&["num", "den"])?;
    let list = |name: &'static str, what: &str| {
        table.list(
            name,
            table.need(name, what)?,
            "a list of numbers",
            |name, v| table.number(name, v, &FINITE),
        )
    };
    let num = list(
        "num",
        "the numerator's coefficients in um/um, highest power of s first",
    )?;
    let den = list(
        "den",
        "the denominator's coefficients, highest power of s first",
    )?;
    TransferFunction::new(num, den).map_err(|source| ModelError::Plant {
        file: table.file.to_owned(),
        at: table.at(table.span.clone()),
        source,
    })
}

fn read_noise(table: &Table<'_, '_>) -> Result<Noise, ModelError> {
    table.only(&["diffusion_um2_per_s", "localisation_um"])?;
    let number = |name: &str, spec: &ParameterSpec| match table.get(name) {
        None => Ok(0.0),
        Some(v) => table.number(name, v, spec),
    };
    Ok(Noise {
        diffusion_um2_per_s: number("diffusion_um2_per_s", &DIFFUSION)?,
        localisation_um: number("localisation_um", &LOCALISATION)?,
    })
}

fn read_covariance(table: &Table<'_, '_>) -> Result<Covariance, ModelError> {
    table.only(&["parameters", "matrix"])?;
    let parameters = table.list(
        "parameters",
        table.need("parameters", "the names of the parameters")?,
        "a list of names",
        |name, v| table.text_of(name, v),
    )?;
    let matrix = table.list(
        "matrix",
        table.need("matrix", "the covariance, row by row")?,
        "a list of rows",
        |name, v| {
            table.list(name, v, "a list of numbers", |name, v| {
                table.number(name, v, &FINITE)
            })
        },
    )?;
    if matrix.len() != parameters.len() || matrix.iter().any(|r| r.len() != parameters.len()) {
        return Err(table.inconsistent(
            table.span.clone(),
            format!(
                "covariance: matrix must be square with one row and column for each of the {} parameters",
                parameters.len()
            ),
        ));
    }
    Ok(Covariance { parameters, matrix })
}

fn read_intervals(table: &Table<'_, '_>) -> Result<BTreeMap<String, [f64; 2]>, ModelError> {
    let mut map = BTreeMap::new();
    for (key, value) in table.entries {
        let name: &str = key.get_ref();
        let pair = table.list(name, value, "a pair [low, high]", |name, v| {
            table.number(name, v, &FINITE)
        })?;
        match pair[..] {
            [low, high] if low <= high => map.insert(name.to_owned(), [low, high]),
            _ => {
                return Err(table.inconsistent(
                    value.span(),
                    format!(
                        "`{}` must be a pair [low, high] with low <= high",
                        table.key(name)
                    ),
                ));
            }
        };
    }
    Ok(map)
}

fn read_effect(table: &Table<'_, '_>) -> Result<Effect, ModelError> {
    let unknown =
        |key: &str, value: &Value<'_>, found: String, known: &[&str]| ModelError::UnknownName {
            file: table.file.to_owned(),
            at: table.at(value.span()),
            key: table.key(key),
            suggestion: nearest(&found, known),
            value: found,
            known: known.iter().map(|k| (*k).to_owned()).collect(),
        };
    let id_value = table.need(
        "id",
        format!("the name of the effect, one of {}", EFFECT_IDS.join(", ")),
    )?;
    let id = table.text_of("id", id_value)?;
    let mut known = vec!["id"];
    let form = if id == "pzt-hysteresis" {
        known.push("form");
        match table.get("form") {
            None => Some("bouc-wen".to_owned()),
            Some(v) => {
                let form = table.text_of("form", v)?;
                if !HYSTERESIS_FORMS.contains(&form.as_str()) {
                    return Err(unknown("form", v, form, &HYSTERESIS_FORMS));
                }
                Some(form)
            }
        }
    } else {
        None
    };
    let Some(specs) = specs(&id, form.as_deref()) else {
        return Err(unknown("id", id_value, id, &EFFECT_IDS));
    };
    known.extend(specs.iter().map(|s| s.name));
    let lists = if form.as_deref() == Some("play") {
        play_lists()
    } else {
        &[]
    };
    known.extend(lists.iter().map(|s| s.name));
    table.only(&known)?;
    let mut scalars = Vec::with_capacity(specs.len());
    for spec in specs {
        scalars.push(match (table.get(spec.name), spec.default) {
            (Some(v), _) => table.number(spec.name, v, spec)?,
            (None, Some(default)) => default,
            (None, None) => {
                let unit = if spec.unit.is_empty() {
                    "no unit".to_owned()
                } else {
                    spec.unit.to_owned()
                };
                let what = format!(
                    "effect {id} needs it, a number in {}..{} ({unit})",
                    spec.lower, spec.upper
                );
                return Err(table
                    .need(spec.name, what)
                    .err()
                    .unwrap_or_else(|| unknown("id", id_value, id.clone(), &EFFECT_IDS)));
            }
        });
    }
    let mut effect = Effect::from_scalars(&id, form.as_deref(), &scalars)
        .ok_or_else(|| unknown("id", id_value, id.clone(), &EFFECT_IDS))?;
    if let Effect::PztHysteresis(Hysteresis::Play {
        thresholds_um,
        weights,
        ..
    }) = &mut effect
    {
        for (spec, values) in lists.iter().zip([thresholds_um, weights]) {
            let value = table.need(spec.name, "a list of numbers, one per play operator")?;
            *values = table.list(spec.name, value, "a list of numbers", |name, v| {
                table.number(name, v, spec)
            })?;
        }
    }
    effect.validate().map_err(|error| {
        let message = match error {
            EffectError::Inconsistent { message, .. } => {
                format!("{} ({id}): {message}", table.path)
            }
            other => format!("{}: {other}", table.path),
        };
        table.inconsistent(id_value.span(), message)
    })?;
    Ok(effect)
}

/// The known name nearest to a misspelt one, if it is near enough to be meant.
fn nearest(name: &str, known: &[&str]) -> Option<String> {
    known
        .iter()
        .map(|k| (distance(name, k), *k))
        .min()
        .filter(|(d, k)| *d <= 1 + k.len().min(name.len()) / 3)
        .map(|(_, k)| k.to_owned())
}

/// Levenshtein distance, where `-` and `_` count as the same letter and case does not count.
fn distance(a: &str, b: &str) -> usize {
    let letters = |s: &str| -> Vec<char> {
        s.chars()
            .take(64)
            .map(|c| {
                if c == '-' {
                    '_'
                } else {
                    c.to_ascii_lowercase()
                }
            })
            .collect()
    };
    let (a, b) = (letters(a), letters(b));
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, x) in a.iter().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, y) in b.iter().enumerate() {
            let cost = usize::from(x != y);
            let next = (diagonal + cost).min(row[j] + 1).min(row[j + 1] + 1);
            diagonal = row[j + 1];
            row[j + 1] = next;
        }
    }
    row[b.len()]
}

fn float(value: f64) -> String {
    // `{:?}` is the shortest text that reads back to the same bits; TOML wants a digit on both sides of the point.
    let text = format!("{value:?}");
    match text.split_once('e') {
        Some((mantissa, exponent)) if !mantissa.contains('.') => format!("{mantissa}.0e{exponent}"),
        _ => text,
    }
}

fn floats(values: &[f64]) -> String {
    let texts: Vec<String> = values.iter().map(|v| float(*v)).collect();
    format!("[{}]", texts.join(", "))
}

fn quoted(text: &str) -> String {
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
        if let Effect::PztHysteresis(Hysteresis::Play {
            thresholds_um,
            weights,
            ..
        }) = effect
        {
            line(format!("thresholds_um = {}", floats(thresholds_um)));
            line(format!("weights = {}", floats(weights)));
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
