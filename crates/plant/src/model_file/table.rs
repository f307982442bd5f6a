//! A table of a TOML file that knows the position of its keys, for error messages.

use crate::effects::ParameterSpec;
use crate::error::{ModelError, ModelProblem, Position};
use std::ops::Range;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

pub(super) type Value<'i> = Spanned<DeValue<'i>>;

/// A table of the file with the path to it.
pub(super) struct Table<'a, 'i> {
    pub file: &'a str,
    pub text: &'a str,
    pub path: String,
    pub span: Range<usize>,
    pub entries: &'a DeTable<'i>,
}

impl<'a, 'i> Table<'a, 'i> {
    pub(super) fn refuse(&self, span: Range<usize>, problem: ModelProblem) -> ModelError {
        ModelError {
            file: self.file.to_owned(),
            at: Some(Position::of(self.text, span)),
            problem: Box::new(problem),
        }
    }

    pub(super) fn key(&self, name: &str) -> String {
        if self.path.is_empty() {
            name.to_owned()
        } else {
            format!("{}.{name}", self.path)
        }
    }

    pub(super) fn only(&self, known: &[&str]) -> Result<(), ModelError> {
        for key in self.entries.keys() {
            let name: &str = key.get_ref();
            if !known.contains(&name) {
                return Err(self.refuse(
                    key.span(),
                    ModelProblem::UnknownKey {
                        key: self.key(name),
                        suggestion: nearest(name, known),
                        known: known.iter().map(|k| (*k).to_owned()).collect(),
                    },
                ));
            }
        }
        Ok(())
    }

    pub(super) fn get(&self, name: &str) -> Option<&'a Value<'i>> {
        self.entries.get(name)
    }

    pub(super) fn need(
        &self,
        name: &str,
        what: impl Into<String>,
    ) -> Result<&'a Value<'i>, ModelError> {
        self.get(name).ok_or_else(|| {
            self.refuse(
                self.span.clone(),
                ModelProblem::MissingKey {
                    key: self.key(name),
                    what: what.into(),
                },
            )
        })
    }

    pub(super) fn wrong(
        &self,
        name: &str,
        value: &Value<'_>,
        expected: &'static str,
    ) -> ModelError {
        self.refuse(
            value.span(),
            ModelProblem::WrongType {
                key: self.key(name),
                found: format!("of type {}", value.get_ref().type_str()),
                expected,
            },
        )
    }

    pub(super) fn text_of(&self, name: &str, value: &Value<'_>) -> Result<String, ModelError> {
        match value.get_ref() {
            DeValue::String(s) => Ok(s.to_string()),
            _ => Err(self.wrong(name, value, "a text in quotes")),
        }
    }

    /// A number, which may be infinite or not a number.
    pub(super) fn raw(&self, name: &str, value: &Value<'_>) -> Result<f64, ModelError> {
        let number = match value.get_ref() {
            DeValue::Float(f) => f.as_str().replace('_', "").parse().ok(),
            DeValue::Integer(i) => i128::from_str_radix(i.as_str(), i.radix())
                .ok()
                .map(|i| i as f64),
            _ => return Err(self.wrong(name, value, "a number")),
        };
        number.ok_or_else(|| self.wrong(name, value, "a number that fits 64 bits"))
    }

    pub(super) fn number(
        &self,
        name: &str,
        value: &Value<'_>,
        spec: &ParameterSpec,
    ) -> Result<f64, ModelError> {
        let number = self.raw(name, value)?;
        if number.is_finite() && number >= spec.lower && number <= spec.upper {
            return Ok(number);
        }
        Err(self.refuse(
            value.span(),
            ModelProblem::OutOfRange {
                key: self.key(name),
                value: number,
                unit: spec.unit,
                lower: spec.lower,
                upper: spec.upper,
            },
        ))
    }

    pub(super) fn list<T>(
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

    pub(super) fn table(
        &self,
        name: &str,
        value: &'a Value<'i>,
    ) -> Result<Table<'a, 'i>, ModelError> {
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

    pub(super) fn inconsistent(&self, span: Range<usize>, message: String) -> ModelError {
        self.refuse(span, ModelProblem::Inconsistent { message })
    }
}

/// The known name nearest to a misspelt one, if it is near enough to be meant.
pub(super) fn nearest(name: &str, known: &[&str]) -> Option<String> {
    cellpos_numeric::units::nearest(name, known.iter().copied()).map(str::to_owned)
}
