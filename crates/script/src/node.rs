//! Typed access to a TOML table, with the place of every value for errors.

use crate::error::{ScriptError, nearest};
use cellpos_numeric::units::{Micrometers, Seconds, UnitError};
use std::ops::Range;
use std::str::FromStr;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

/// Longest duration of one step, s: thirty days.
pub(crate) const MAX_S: f64 = 30.0 * 86_400.0;
/// Largest position, um.
pub(crate) const MAX_UM: f64 = 1e4;

/// The text being read, for errors.
#[derive(Clone, Copy)]
pub(crate) struct Source<'a> {
    pub(crate) file: &'a str,
    pub(crate) text: &'a str,
    /// Where each line begins but the first.
    pub(crate) lines: &'a [usize],
}

/// Where each line of a text begins but the first.
pub(crate) fn line_starts(text: &str) -> Vec<usize> {
    text.match_indices('\n').map(|(at, _)| at + 1).collect()
}

impl Source<'_> {
    /// Line of a place, from 1.
    pub(crate) fn line(&self, at: usize) -> usize {
        self.lines.partition_point(|start| *start <= at) + 1
    }

    pub(crate) fn fail(
        &self,
        span: Range<usize>,
        message: impl Into<String>,
        help: Option<&str>,
    ) -> ScriptError {
        ScriptError::new(
            self.file,
            self.text,
            span,
            message.into(),
            help.map(str::to_owned),
        )
    }
}

/// A table of the file.
#[derive(Clone, Copy)]
pub(crate) struct Node<'a> {
    pub(crate) source: Source<'a>,
    pub(crate) table: &'a DeTable<'a>,
    pub(crate) span: (usize, usize),
    /// Values that replace `"$name"`: name and text, innermost last.
    pub(crate) variables: &'a [(String, String)],
}

/// A value and its place.
pub(crate) struct At<T> {
    pub(crate) value: T,
    pub(crate) span: Range<usize>,
}

impl<'a> Node<'a> {
    pub(crate) fn span(&self) -> Range<usize> {
        self.span.0..self.span.1
    }

    /// Refuses keys that are not in the list.
    pub(crate) fn only(&self, keys: &[&str]) -> Result<(), ScriptError> {
        for key in self.table.keys() {
            let name = key.get_ref().as_ref();
            if !keys.contains(&name) {
                let help = nearest(name, keys).map_or_else(
                    || format!("keys here: {}", keys.join(", ")),
                    |near| format!("did you mean `{near}`?"),
                );
                return Err(self.source.fail(
                    key.span(),
                    format!("unknown key `{name}`"),
                    Some(&help),
                ));
            }
        }
        Ok(())
    }

    fn raw(&self, key: &str) -> Option<&'a Spanned<DeValue<'a>>> {
        self.table.get(key)
    }

    /// Position of a key's value, or of the table if the key is absent.
    pub(crate) fn span_of(&self, key: &str) -> Range<usize> {
        self.raw(key).map_or_else(|| self.span(), Spanned::span)
    }

    fn missing(&self, key: &str, help: &str) -> ScriptError {
        self.source
            .fail(self.span(), format!("`{key}` is missing"), Some(help))
    }

    /// A text; `"$name"` is replaced by the value of the sweep of that name.
    pub(crate) fn text(&self, key: &str) -> Result<Option<At<&'a str>>, ScriptError> {
        let Some(value) = self.raw(key) else {
            return Ok(None);
        };
        let Some(text) = value.get_ref().as_str() else {
            let what = value.get_ref().type_str();
            return Err(self.source.fail(
                value.span(),
                format!("`{key}` must be a text in quotes, not {what}"),
                Some("write quantities with their unit in quotes, for example \"5um\""),
            ));
        };
        let text = match text.strip_prefix('$') {
            None => text,
            Some(name) => match self.variables.iter().rev().find(|(other, _)| other == name) {
                Some((_, text)) => text.as_str(),
                None => {
                    return Err(self.source.fail(
                        value.span(),
                        format!("`${name}` is not the name of a sweep around this step"),
                        Some("a sweep has `name = \"...\"` and `values = [...]`"),
                    ));
                }
            },
        };
        Ok(Some(At {
            value: text,
            span: value.span(),
        }))
    }

    pub(crate) fn need_text(&self, key: &str, help: &str) -> Result<At<&'a str>, ScriptError> {
        self.text(key)?.ok_or_else(|| self.missing(key, help))
    }

    /// One of several words.
    pub(crate) fn word<T: Copy>(
        &self,
        key: &str,
        words: &[(&str, T)],
    ) -> Result<Option<T>, ScriptError> {
        let Some(text) = self.text(key)? else {
            return Ok(None);
        };
        if let Some((_, value)) = words.iter().find(|(word, _)| *word == text.value) {
            return Ok(Some(*value));
        }
        let names: Vec<&str> = words.iter().map(|(word, _)| *word).collect();
        let help = nearest(text.value, &names).map_or_else(
            || format!("one of {}", names.join(", ")),
            |near| format!("did you mean \"{near}\"?"),
        );
        Err(self.source.fail(
            text.span,
            format!("`{key}` = \"{}\" is not known", cut(text.value)),
            Some(&help),
        ))
    }

    /// A quantity with its unit, within bounds in its base unit.
    pub(crate) fn quantity<Q>(
        &self,
        key: &str,
        value_of: fn(Q) -> f64,
        (low, high): (f64, f64),
    ) -> Result<Option<f64>, ScriptError>
    where
        Q: FromStr<Err = UnitError> + std::fmt::Display,
    {
        let Some(raw) = self.raw(key) else {
            return Ok(None);
        };
        if raw.get_ref().is_integer() || raw.get_ref().is_float() {
            let number = self.source.text.get(raw.span()).unwrap_or("0");
            let error = number.parse::<Q>().err();
            return Err(self.source.fail(
                raw.span(),
                format!("`{key}` = {number} has no unit"),
                error.map(|error| error.to_string()).as_deref(),
            ));
        }
        let Some(text) = self.text(key)? else {
            return Ok(None);
        };
        let quantity: Q = text.value.parse().map_err(|error: UnitError| {
            let message = format!("`{key}` = \"{}\": {error}", cut(text.value));
            self.source.fail(text.span.clone(), message, None)
        })?;
        let shown = quantity.to_string();
        let value = value_of(quantity);
        if !(low..=high).contains(&value) {
            return Err(self.source.fail(
                text.span,
                format!("`{key}` = {shown} is out of range"),
                Some(&format!(
                    "it must be from {low:e} to {high:e} in the same unit"
                )),
            ));
        }
        Ok(Some(value))
    }

    /// A share, written in percent.
    pub(crate) fn percent(
        &self,
        key: &str,
        (low, high): (f64, f64),
    ) -> Result<Option<f64>, ScriptError> {
        let Some(raw) = self.raw(key) else {
            return Ok(None);
        };
        let help = Some("write it with its sign, for example \"20%\"");
        if raw.get_ref().is_integer() || raw.get_ref().is_float() {
            let number = self.source.text.get(raw.span()).unwrap_or("0");
            let message = format!("`{key}` = {number} has no unit");
            return Err(self.source.fail(raw.span(), message, help));
        }
        let Some(text) = self.text(key)? else {
            return Ok(None);
        };
        let number = text.value.trim().strip_suffix('%');
        let value: Option<f64> = number.and_then(|number| number.trim_end().parse().ok());
        match value {
            Some(value) if (low..=high).contains(&value) => Ok(Some(value * 1e-2)),
            Some(_) => Err(self.source.fail(
                text.span,
                format!("`{key}` = \"{}\" is out of range", cut(text.value)),
                Some(&format!("it must be from {low}% to {high}%")),
            )),
            None => {
                let message = format!("`{key}` = \"{}\" is no percentage", cut(text.value));
                Err(self.source.fail(text.span, message, help))
            }
        }
    }

    /// Yes or no.
    pub(crate) fn flag(&self, key: &str) -> Result<Option<bool>, ScriptError> {
        let Some(raw) = self.raw(key) else {
            return Ok(None);
        };
        match raw.get_ref().as_bool() {
            Some(value) => Ok(Some(value)),
            None => {
                Err(self
                    .source
                    .fail(raw.span(), format!("`{key}` must be true or false"), None))
            }
        }
    }

    /// A whole number within bounds; `"$name"` is replaced as in texts.
    pub(crate) fn whole(
        &self,
        key: &str,
        (low, high): (u64, u64),
    ) -> Result<Option<u64>, ScriptError> {
        let Some(raw) = self.raw(key) else {
            return Ok(None);
        };
        let of_sweep = raw.get_ref().as_str().is_some_and(|s| s.starts_with('$'));
        let value = if of_sweep {
            self.text(key)?.and_then(|text| text.value.parse().ok())
        } else {
            raw.get_ref()
                .as_integer()
                .filter(|integer| integer.radix() == 10)
                .and_then(|integer| integer.as_str().replace('_', "").parse::<u64>().ok())
        };
        match value {
            Some(value) if (low..=high).contains(&value) => Ok(Some(value)),
            _ => Err(self.source.fail(
                raw.span(),
                format!("`{key}` must be a whole number from {low} to {high}"),
                None,
            )),
        }
    }

    /// A table below this one.
    pub(crate) fn table(&self, key: &str) -> Result<Option<Node<'a>>, ScriptError> {
        let Some(raw) = self.raw(key) else {
            return Ok(None);
        };
        match raw.get_ref().as_table() {
            Some(table) => Ok(Some(Node {
                table,
                span: (raw.span().start, raw.span().end),
                ..*self
            })),
            None => Err(self.source.fail(
                raw.span(),
                format!("`{key}` must be a table"),
                Some(&format!("write it as [{key}]")),
            )),
        }
    }

    /// A list of tables below this one.
    pub(crate) fn tables(&self, key: &str) -> Result<Vec<Node<'a>>, ScriptError> {
        let Some(raw) = self.raw(key) else {
            return Ok(Vec::new());
        };
        let fail = |span| {
            self.source.fail(
                span,
                format!("`{key}` must be a list of tables"),
                Some("write each as [[step]], or [[step.step]] inside a repeat"),
            )
        };
        let list = raw.get_ref().as_array().ok_or_else(|| fail(raw.span()))?;
        list.iter()
            .map(|item| {
                let table = item.get_ref().as_table().ok_or_else(|| fail(item.span()))?;
                Ok(Node {
                    table,
                    span: (item.span().start, item.span().end),
                    ..*self
                })
            })
            .collect()
    }

    /// A list of numbers of a kind.
    pub(crate) fn numbers(
        &self,
        key: &str,
        help: &str,
        fits: fn(f64) -> bool,
    ) -> Result<Vec<f64>, ScriptError> {
        let Some(raw) = self.raw(key) else {
            return Ok(Vec::new());
        };
        let fail = |span, message: String| self.source.fail(span, message, Some(help));
        let list = raw
            .get_ref()
            .as_array()
            .ok_or_else(|| fail(raw.span(), format!("`{key}` must be a list of numbers")))?;
        list.iter()
            .map(|item| {
                let text = self.source.text.get(item.span()).unwrap_or("");
                let number = text.replace('_', "").parse().ok();
                number.filter(|n| fits(*n)).ok_or_else(|| {
                    let message = format!("`{key}`: {} cannot be one of them", cut(text));
                    fail(item.span(), message)
                })
            })
            .collect()
    }

    /// A list of texts.
    pub(crate) fn texts(&self, key: &str) -> Result<Vec<String>, ScriptError> {
        let Some(raw) = self.raw(key) else {
            return Ok(Vec::new());
        };
        let help = Some("for example values = [\"1um\", \"2um\"]");
        let fail = |span, message: String| self.source.fail(span, message, help);
        let list = raw
            .get_ref()
            .as_array()
            .ok_or_else(|| fail(raw.span(), format!("`{key}` must be a list of texts")))?;
        list.iter()
            .map(|item| {
                item.get_ref().as_str().map(str::to_owned).ok_or_else(|| {
                    fail(
                        item.span(),
                        format!("a value of `{key}` is not a text in quotes"),
                    )
                })
            })
            .collect()
    }
}

/// A text short enough for a message.
pub(crate) fn cut(text: &str) -> String {
    text.chars().take(40).collect()
}

/// A length of at least `low_um`, um.
pub(crate) fn length(node: &Node, key: &str, low_um: f64) -> Result<Option<f64>, ScriptError> {
    node.quantity::<Micrometers>(key, Micrometers::value, (low_um, MAX_UM))
}

/// A time, s.
pub(crate) fn time(node: &Node, key: &str) -> Result<Option<f64>, ScriptError> {
    node.quantity::<Seconds>(key, Seconds::value, (1e-3, MAX_S))
}
