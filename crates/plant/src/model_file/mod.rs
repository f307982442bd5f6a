//! model.toml: reading with positions and suggestions, writing so that it reads back to the bit.

mod definitions;
mod table;
mod write;

#[cfg(test)]
mod tests;

use crate::effects::{self, Effect, EffectError, ParameterSpec};
use crate::error::{ModelError, ModelProblem, Position};
use crate::model::{Covariance, Model, Noise, is_in_any_unit};
use crate::transfer::TransferFunction;
use std::collections::BTreeMap;
use table::{Table, Value, nearest};
use toml::de::DeTable;
use write::write;

const fn range(unit: &'static str, lower: f64, upper: f64) -> ParameterSpec {
    ParameterSpec::new("", unit, lower, upper)
}

/// Any finite number.
const FINITE: ParameterSpec = range("", -f64::MAX, f64::MAX);
const WORKING_POINT: ParameterSpec = range("um", -1e4, 1e4);
const DIFFUSION: ParameterSpec = range("um^2/s", 0.0, 1e4);
const LOCALISATION: ParameterSpec = range("um", 0.0, 100.0);

const CAMERA_DELAY: ParameterSpec = range("ms", 0.0, 1000.0);

const TOP: [&str; 11] = [
    "definitions",
    "name",
    "description",
    "working_point_um",
    "plant",
    "effects",
    "noise",
    "camera",
    "covariance",
    "intervals",
    "provenance",
];

impl Model {
    /// Reads a model from the text of a TOML file; `file_name` is for the messages only.
    ///
    /// # Errors
    /// Text that is not TOML, unknown keys, missing keys, wrong types, numbers that are not finite or out of range,
    /// coefficients that do not make a plant. Each error names line, column and what would be right.
    pub fn from_toml_str(text: &str, file_name: &str) -> Result<Self, ModelError> {
        read(text, file_name)
    }

    /// The model as the text of a TOML file. Reading it back gives the same model to the bit.
    pub fn to_toml_string(&self) -> String {
        write(self)
    }
}

fn parse<'i>(text: &'i str, file: &str) -> Result<toml::Spanned<DeTable<'i>>, ModelError> {
    DeTable::parse(text).map_err(|error| ModelError {
        file: file.to_owned(),
        at: Some(Position::of(text, error.span().unwrap_or(0..0))),
        problem: Box::new(ModelProblem::Syntax {
            message: error.message().to_owned(),
        }),
    })
}

fn read(text: &str, file: &str) -> Result<Model, ModelError> {
    let document = parse(text, file)?;
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
    let provenance = match top.get("provenance") {
        None => BTreeMap::new(),
        Some(v) => read_provenance(&top.table("provenance", v)?)?,
    };
    let any_unit = is_in_any_unit(&provenance);
    let of_plant = |spec: ParameterSpec| match any_unit {
        true => spec.in_any_unit(),
        false => spec,
    };
    let working_point = top.need(
        "working_point_um",
        "the PZT displacement at which the bead is at rest, for example working_point_um = 4.0",
    )?;
    let working_point_um =
        top.number("working_point_um", working_point, &of_plant(WORKING_POINT))?;
    let plant = top.need(
        "plant",
        "a table with the coefficients num and den, highest power of s first",
    )?;
    let plant = read_plant(&top.table("plant", plant)?)?;
    // User-defined effects come first: those below may use them.
    if let Some(v) = top.get("definitions") {
        definitions::read_all("definitions", &top, v)?;
    }
    let effects = match top.get("effects") {
        None => Vec::new(),
        Some(v) => top.list(
            "effects",
            v,
            "an array of tables, [[effects]]",
            |name, v| read_effect(&top.table(name, v)?, any_unit),
        )?,
    };
    let noise = match top.get("noise") {
        None => Noise::NONE,
        Some(v) => read_noise(&top.table("noise", v)?, &of_plant)?,
    };
    let (camera_delay_s, frame_age_s) = match top.get("camera") {
        None => (None, None),
        Some(v) => {
            let table = top.table("camera", v)?;
            table.only(&["delay_ms", "frame_age_ms"])?;
            let delay = table.need("delay_ms", "the delay of the camera path, for example 2.0")?;
            let delay_s = 1e-3 * table.number("delay_ms", delay, &CAMERA_DELAY)?;
            let age = table.get("frame_age_ms");
            let age_ms = age.map(|age| table.number("frame_age_ms", age, &CAMERA_DELAY));
            (Some(delay_s), age_ms.transpose()?.map(|ms| 1e-3 * ms))
        }
    };
    let covariance = top
        .get("covariance")
        .map(|v| read_covariance(&top.table("covariance", v)?))
        .transpose()?;
    let intervals = match top.get("intervals") {
        None => BTreeMap::new(),
        Some(v) => read_intervals(&top.table("intervals", v)?)?,
    };
    Ok(Model {
        name,
        description,
        plant,
        working_point_um,
        effects,
        noise,
        camera_delay_s,
        frame_age_s,
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
    TransferFunction::new(num, den)
        .map_err(|source| table.refuse(table.span.clone(), ModelProblem::Plant(source)))
}

fn read_provenance(table: &Table<'_, '_>) -> Result<BTreeMap<String, String>, ModelError> {
    let mut map = BTreeMap::new();
    for (key, value) in table.entries {
        let name: &str = key.get_ref();
        map.insert(name.to_owned(), table.text_of(name, value)?);
    }
    Ok(map)
}

fn read_noise(
    table: &Table<'_, '_>,
    of_plant: &dyn Fn(ParameterSpec) -> ParameterSpec,
) -> Result<Noise, ModelError> {
    table.only(&["diffusion_um2_per_s", "localisation_um"])?;
    let number = |name: &str, spec: ParameterSpec| match table.get(name) {
        None => Ok(0.0),
        Some(v) => table.number(name, v, &of_plant(spec)),
    };
    Ok(Noise {
        diffusion_um2_per_s: number("diffusion_um2_per_s", DIFFUSION)?,
        localisation_um: number("localisation_um", LOCALISATION)?,
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

fn read_effect(table: &Table<'_, '_>, any_unit: bool) -> Result<Effect, ModelError> {
    let bounds = |spec: &ParameterSpec| match any_unit {
        true => spec.in_any_unit(),
        false => *spec,
    };
    let unknown = |key: &str, value: &Value<'_>, found: String, known: &[&str]| {
        table.refuse(
            value.span(),
            ModelProblem::UnknownName {
                key: table.key(key),
                suggestion: nearest(&found, known),
                value: found,
                known: known.iter().map(|k| (*k).to_owned()).collect(),
            },
        )
    };
    let ids = effects::ids();
    let id_value = table.need(
        "id",
        format!("the name of the effect, one of {}", ids.join(", ")),
    )?;
    let id = table.text_of("id", id_value)?;
    let Some(kind) = effects::find(&id) else {
        return Err(unknown("id", id_value, id, &ids));
    };
    let forms = kind.spec().forms;
    let mut known = vec!["id"];
    let mut form = 0;
    if forms.len() > 1 {
        known.push("form");
        if let Some(v) = table.get("form") {
            let name = table.text_of("form", v)?;
            let names: Vec<&str> = forms.iter().map(|f| f.name).collect();
            let Some(found) = names.iter().position(|n| *n == name) else {
                return Err(unknown("form", v, name, &names));
            };
            form = found;
        }
    }
    let specs = &forms[form];
    known.extend(specs.scalars.iter().chain(specs.lists).map(|s| s.name));
    table.only(&known)?;
    let mut scalars = Vec::with_capacity(specs.scalars.len());
    for spec in specs.scalars {
        let spec = &bounds(spec);
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
                let value = table.need(spec.name, what)?;
                table.number(spec.name, value, spec)?
            }
        });
    }
    let mut lists = Vec::with_capacity(specs.lists.len());
    for spec in specs.lists {
        let value = table.need(spec.name, "a list of numbers, one per play operator")?;
        lists.push(
            table.list(spec.name, value, "a list of numbers", |name, v| {
                table.number(name, v, &bounds(spec))
            })?,
        );
    }
    let lists: Vec<&[f64]> = lists.iter().map(Vec::as_slice).collect();
    let mut effect = Effect::new(kind, form, &scalars, &lists);
    if any_unit {
        effect = effect.in_any_unit();
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
