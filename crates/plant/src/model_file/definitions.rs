//! User-defined effects in a file: `[[effects]]` of an effects file, `[[definitions]]` of a model.

use super::table::{Table, Value, nearest};
use super::write::{float, floats, quoted};
use super::{FINITE, range};
use crate::effects::{
    Definition, EffectKind, ParameterSpec, Site, UserParameter, UserState, define,
};
use crate::error::{ModelError, ModelProblem};
use std::fmt::Write as _;
use std::path::Path;
use toml::de::{DeTable, DeValue};

const KEYS: [&str; 7] = [
    "id",
    "place",
    "says",
    "output",
    "states",
    "parameters",
    "step_s",
];
const STEP: ParameterSpec = range("s", 1e-6, 1e3);

impl Definition {
    /// Reads the effects of a file and makes them known.
    ///
    /// # Errors
    /// A file that cannot be read, and all that [`Self::from_toml_str`] refuses.
    pub fn load_file(path: &Path) -> Result<Vec<&'static dyn EffectKind>, ModelError> {
        const MOST_BYTES: u64 = 1 << 20;
        let file = path.display().to_string();
        let text = cellpos_table::read_text(path, MOST_BYTES).map_err(|error| ModelError {
            file: file.clone(),
            at: None,
            problem: Box::new(ModelProblem::Unreadable {
                reason: if error.kind() == std::io::ErrorKind::NotFound {
                    "there is no such file (effects of your own are a TOML file with [[effects]])"
                        .to_owned()
                } else {
                    error.to_string()
                },
            }),
        })?;
        Self::from_toml_str(&text, &file)
    }

    /// Reads effects from the text of a TOML file, `[[effects]]` each, and makes them known; `file_name` is for the messages.
    ///
    /// # Errors
    /// Text that is not TOML, unknown or missing keys, wrong expressions, names unknown at their place, bounds and starts that do
    /// not fit, an id already in use. Each error names line, column, key, value and what would be right.
    pub fn from_toml_str(
        text: &str,
        file_name: &str,
    ) -> Result<Vec<&'static dyn EffectKind>, ModelError> {
        let document = super::parse(text, file_name)?;
        let top = Table {
            file: file_name,
            text,
            path: String::new(),
            span: 0..0,
            entries: document.get_ref(),
        };
        top.only(&["effects"])?;
        let effects = top.need("effects", "one table [[effects]] for each effect")?;
        read_all("effects", &top, effects)
    }

    /// The definition as a table of a TOML file: `head` is `effects` in a file of effects, `definitions` in a model.
    pub fn to_toml_string(&self, head: &str) -> String {
        let mut out = format!("\n[[{head}]]\nid = {}\n", quoted(&self.id));
        let _ = writeln!(out, "place = {}", quoted(self.site.word()));
        let _ = writeln!(out, "says = {}", quoted(&self.says));
        let _ = writeln!(out, "output = {}", quoted(&self.output));
        if let Some(step_s) = self.step_s {
            let _ = writeln!(out, "step_s = {}", float(step_s));
        }
        let _ = writeln!(out, "[{head}.parameters]");
        for p in &self.parameters {
            let _ = writeln!(
                out,
                "{} = {{ unit = {}, lower = {}, upper = {}, start = {} }}",
                p.name,
                quoted(&p.unit),
                float(p.lower),
                float(p.upper),
                match p.start[..] {
                    [one] => float(one),
                    _ => floats(&p.start),
                }
            );
        }
        if !self.states.is_empty() {
            let _ = writeln!(out, "[{head}.states]");
        }
        for s in &self.states {
            let (rate, start) = (quoted(&s.rate), quoted(&s.start));
            let _ = writeln!(out, "{} = {{ rate = {rate}, start = {start} }}", s.name);
        }
        out
    }
}

/// Every effect of a list of tables, made known.
pub(super) fn read_all<'i>(
    name: &str,
    top: &Table<'_, 'i>,
    value: &Value<'i>,
) -> Result<Vec<&'static dyn EffectKind>, ModelError> {
    let what = "an array of tables, one for each effect";
    top.list(name, value, what, |name, v| {
        let table = top.table(name, v)?;
        let definition = read(&table)?;
        define(&definition).map_err(|e| {
            table.refuse(
                span_of(table.entries, &e.key).unwrap_or(table.span.clone()),
                ModelProblem::Inconsistent {
                    message: format!("`{}`: {}", table.key(&e.key), e.message),
                },
            )
        })
    })
}

/// Position of the value of a dotted key, or of the longest part that exists.
fn span_of(entries: &DeTable<'_>, key: &str) -> Option<std::ops::Range<usize>> {
    let (head, rest) = key.split_once('.').unwrap_or((key, ""));
    let value = entries.get(head)?;
    match value.get_ref() {
        DeValue::Table(inner) if !rest.is_empty() => {
            span_of(inner, rest).or_else(|| Some(value.span()))
        }
        _ => Some(value.span()),
    }
}

fn read(table: &Table<'_, '_>) -> Result<Definition, ModelError> {
    table.only(&KEYS)?;
    let text = |key: &str, what: &str| table.text_of(key, table.need(key, what)?);
    let id = text(
        "id",
        "a name for the effect, for example id = \"cubic-stiffness\"",
    )?;
    let place = text("place", "driver, pzt, chip, plant, bead or camera")?;
    let Some(site) = Site::of(&place) else {
        return Err(table.refuse(
            table.need("place", "")?.span(),
            ModelProblem::UnknownName {
                key: table.key("place"),
                suggestion: nearest(&place, &Site::WORDS),
                value: place,
                known: Site::WORDS.iter().map(|w| (*w).to_owned()).collect(),
            },
        ));
    };
    let says = match table.get("says") {
        Some(v) => table.text_of("says", v)?,
        None => String::new(),
    };
    let output = text(
        "output",
        "an expression for what leaves the place, for example output = \"input - cubic*position^3\"",
    )?;
    let step_s = match table.get("step_s") {
        Some(v) => Some(table.number("step_s", v, &STEP)?),
        None => None,
    };
    let parameters = table.need(
        "parameters",
        "a table of the free numbers, for example cubic = { unit = \"1/um^2\", lower = -1.0, upper = 1.0, start = 0.1 }",
    )?;
    let parameters = table.table("parameters", parameters)?;
    let parameters = parameters
        .entries
        .iter()
        .map(|(name, v)| read_parameter(name.get_ref(), &parameters.table(name.get_ref(), v)?))
        .collect::<Result<Vec<_>, _>>()?;
    let states = match table.get("states") {
        None => Vec::new(),
        Some(v) => {
            let states = table.table("states", v)?;
            let one = |(name, v): (&toml::Spanned<_>, &_)| {
                let name: &std::borrow::Cow<'_, str> = name.get_ref();
                read_state(name, &states.table(name, v)?)
            };
            states
                .entries
                .iter()
                .map(one)
                .collect::<Result<Vec<_>, _>>()?
        }
    };
    Ok(Definition {
        id,
        site,
        says,
        output,
        states,
        parameters,
        step_s,
    })
}

fn read_parameter(name: &str, table: &Table<'_, '_>) -> Result<UserParameter, ModelError> {
    table.only(&["unit", "lower", "upper", "start"])?;
    let unit = match table.get("unit") {
        Some(v) => table.text_of("unit", v)?,
        None => String::new(),
    };
    let bound = |key: &str| {
        table.number(
            key,
            table.need(key, "the bounds of a search, both finite")?,
            &FINITE,
        )
    };
    let start = table.need(
        "start",
        "a number from which to search, or a list of numbers to try",
    )?;
    let start = match start.get_ref() {
        DeValue::Array(_) => table.list(
            "start",
            start,
            "a number or a list of numbers",
            |name, v| table.number(name, v, &FINITE),
        )?,
        _ => vec![table.number("start", start, &FINITE)?],
    };
    Ok(UserParameter {
        name: name.to_owned(),
        unit,
        lower: bound("lower")?,
        upper: bound("upper")?,
        start,
    })
}

fn read_state(name: &str, table: &Table<'_, '_>) -> Result<UserState, ModelError> {
    table.only(&["rate", "start"])?;
    let rate = table.need("rate", "an expression for its change per second")?;
    Ok(UserState {
        name: name.to_owned(),
        rate: table.text_of("rate", rate)?,
        start: match table.get("start") {
            Some(v) => table.text_of("start", v)?,
            None => "0".to_owned(),
        },
    })
}
