//! Names, units, bounds and values of the parameters of effects.

use super::{Effect, EffectKind, Experiment, Place};

/// The fixed properties of an effect apart from its equation.
#[derive(Debug, Clone, Copy)]
pub struct Spec {
    /// The id in files and results.
    pub id: &'static str,
    /// Its place in the chain.
    pub place: Place,
    /// The place as results print it, for an effect that may be at either of two places; empty: the place's own word.
    pub shown_at: &'static str,
    /// The equation in one line, for documents.
    pub equation: &'static str,
    /// How it shows in a record, for documents.
    pub signature: &'static str,
    /// Acts on the plant's input although its place is the chip.
    pub ahead_of_plant: bool,
    /// Its forms, the first is the usual one.
    pub forms: &'static [Form],
    /// Ids with which it is confused.
    pub confused_with: &'static [&'static str],
    /// Ids that no record of command and position separates from it.
    pub inseparable_from: &'static [&'static str],
    /// The kind of record that separates it from the others.
    pub experiment: Experiment,
    /// The same in words.
    pub separate_by: &'static str,
}

impl Spec {
    /// An effect without peculiarities: the base of `..Spec::PLAIN`. Id, equation, signature, forms and `separate_by` are to be given.
    pub const PLAIN: Self = Self {
        id: "",
        place: Place::Chip,
        shown_at: "",
        equation: "",
        signature: "",
        ahead_of_plant: false,
        forms: &[],
        confused_with: &[],
        inseparable_from: &[],
        experiment: Experiment::Long,
        separate_by: "",
    };

    /// The place as results print it.
    pub fn shown_place(&self) -> &'static str {
        if self.shown_at.is_empty() {
            self.place.word()
        } else {
            self.shown_at
        }
    }

    /// Unit of a parameter of any form; empty for a pure number or an unknown name.
    pub fn unit(&self, name: &str) -> &'static str {
        self.forms
            .iter()
            .flat_map(|f| f.scalars.iter().chain(f.lists))
            .find(|p| p.name == name)
            .map_or("", |p| p.unit)
    }
}

/// One form of an effect: its parameters.
#[derive(Debug, Clone, Copy)]
pub struct Form {
    /// Its name in files; empty where there is one.
    pub name: &'static str,
    /// Single numbers.
    pub scalars: &'static [ParameterSpec],
    /// Lists of numbers.
    pub lists: &'static [ParameterSpec],
}

impl Form {
    /// The only form of an effect.
    pub const fn only(scalars: &'static [ParameterSpec]) -> Self {
        Self {
            name: "",
            scalars,
            lists: &[],
        }
    }

    /// The two forms of an effect with different gains for slow and fast motion. The first, the default in files, is for a model
    /// with the gain of slow motion; the second for a model with the gain of fast motion.
    pub const fn anchored(scalars: &'static [ParameterSpec]) -> [Self; 2] {
        [
            Self {
                name: "slow-gain",
                ..Self::only(scalars)
            },
            Self {
                name: "fast-gain",
                ..Self::only(scalars)
            },
        ]
    }
}

/// A parameter that an effect does not have, or a value that it cannot take.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum EffectError {
    /// No effect of that name.
    #[error("there is no effect `{id}`: the known ones are {}", known.join(", "))]
    UnknownEffect {
        /// The id asked for.
        id: String,
        /// The ids that are known.
        known: Vec<&'static str>,
    },
    /// An effect of that name is known already.
    #[error("an effect with the id `{id}` is known already: give another id")]
    Taken {
        /// The id.
        id: &'static str,
    },
    /// No parameter of that name.
    #[error("{id} has no parameter `{name}`: it has {}", known.join(", "))]
    UnknownParameter {
        /// The effect.
        id: &'static str,
        /// The name asked for.
        name: String,
        /// The names it has.
        known: Vec<String>,
    },
    /// Not finite or outside the physical bounds.
    #[error(
        "{id}: `{name}` = {value} {unit}: it must be a finite number in {lower}..{upper} {unit}"
    )]
    OutOfRange {
        /// The effect.
        id: &'static str,
        /// The parameter.
        name: String,
        /// Its value.
        value: f64,
        /// Its unit.
        unit: &'static str,
        /// Lower bound.
        lower: f64,
        /// Upper bound.
        upper: f64,
    },
    /// Values that are each valid but contradict each other.
    #[error("{id}: {message}")]
    Inconsistent {
        /// The effect.
        id: &'static str,
        /// What is wrong, and what would be right.
        message: &'static str,
    },
}

/// The fixed properties of a parameter: name, unit and bounds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ParameterSpec {
    /// The key in files and results.
    pub name: &'static str,
    /// Its unit; empty for a pure number.
    pub unit: &'static str,
    /// Smallest physical value.
    pub lower: f64,
    /// Largest physical value.
    pub upper: f64,
    /// Value when the key is left out; `None` when it must be given.
    pub default: Option<f64>,
}

impl ParameterSpec {
    /// A parameter that must be given.
    pub const fn new(name: &'static str, unit: &'static str, lower: f64, upper: f64) -> Self {
        Self {
            name,
            unit,
            lower,
            upper,
            default: None,
        }
    }

    /// The same for a plant with another unit of length: a length keeps only its sign.
    #[must_use]
    pub fn in_any_unit(self) -> Self {
        if !self.unit.contains("um") {
            return self;
        }
        Self {
            lower: if self.lower < 0.0 { -f64::MAX } else { 0.0 },
            upper: if self.upper > 0.0 { f64::MAX } else { 0.0 },
            ..self
        }
    }

    /// The same with a value when the key is left out.
    pub const fn or(self, default: f64) -> Self {
        Self {
            default: Some(default),
            ..self
        }
    }
}

/// A parameter with its value.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameter {
    /// The key; elements of lists are named `weights[0]`.
    pub name: String,
    /// Its value.
    pub value: f64,
    /// Its unit; empty for a pure number.
    pub unit: &'static str,
    /// Smallest physical value.
    pub lower: f64,
    /// Largest physical value.
    pub upper: f64,
}

impl Effect {
    /// As [`Self::of`] for a kind that need not be in the table.
    ///
    /// # Errors
    /// As [`Self::of`].
    pub fn of_kind(
        kind: &'static dyn EffectKind,
        parameters: &[(&str, f64)],
    ) -> Result<Self, EffectError> {
        let spec = kind.spec();
        let form = &spec.forms[0];
        if let Some((name, _)) = parameters
            .iter()
            .find(|(name, _)| !form.scalars.iter().any(|s| s.name == *name))
        {
            return Err(EffectError::UnknownParameter {
                id: spec.id,
                name: (*name).to_owned(),
                known: form.scalars.iter().map(|s| s.name.to_owned()).collect(),
            });
        }
        let scalars: Vec<f64> = form
            .scalars
            .iter()
            .map(|s| {
                parameters
                    .iter()
                    .find(|(name, _)| *name == s.name)
                    .map(|(_, v)| *v)
                    .or(s.default)
                    // The check below refuses NaN, with the parameter's name.
                    .unwrap_or(f64::NAN)
            })
            .collect();
        let effect = Self::new(kind, 0, &scalars, &[]);
        effect.validate()?;
        Ok(effect)
    }

    fn spec_of_form(&self) -> &'static Form {
        let forms = self.kind().spec().forms;
        &forms[self.form_index().min(forms.len() - 1)]
    }

    /// Names, units, values and physical bounds of all parameters.
    pub fn parameters(&self) -> Vec<Parameter> {
        let form = self.spec_of_form();
        let of = |spec: &ParameterSpec, name: String, value: f64| {
            let spec = match self.any_unit {
                true => spec.in_any_unit(),
                false => *spec,
            };
            Parameter {
                name,
                value,
                unit: spec.unit,
                lower: spec.lower,
                upper: spec.upper,
            }
        };
        let mut all: Vec<Parameter> = form
            .scalars
            .iter()
            .enumerate()
            .map(|(i, spec)| of(spec, spec.name.to_owned(), self.scalar(i)))
            .collect();
        for (j, spec) in form.lists.iter().enumerate() {
            for (i, &v) in self.list(j).iter().enumerate() {
                all.push(of(spec, format!("{}[{i}]", spec.name), v));
            }
        }
        all
    }

    /// The same effect with one parameter changed; elements of lists are named `weights[0]`.
    ///
    /// # Errors
    /// An unknown name, and a value that is not finite or outside its bounds.
    pub fn with_parameter(&self, name: &str, value: f64) -> Result<Self, EffectError> {
        let form = self.spec_of_form();
        let mut changed = self.clone();
        let slot = match form.scalars.iter().position(|s| s.name == name) {
            Some(i) => changed.scalars.get_mut(i),
            None => form
                .lists
                .iter()
                .zip(&mut changed.lists)
                .find_map(|(spec, list)| element(name, spec.name, list)),
        };
        match slot {
            Some(slot) => *slot = value,
            None => {
                return Err(EffectError::UnknownParameter {
                    id: self.id(),
                    name: name.to_owned(),
                    known: self.parameters().into_iter().map(|p| p.name).collect(),
                });
            }
        }
        changed.validate()?;
        Ok(changed)
    }

    /// Checks that every parameter is finite and within its bounds, and that they fit together.
    ///
    /// # Errors
    /// The first parameter that is not, with its name, value, unit and range.
    pub fn validate(&self) -> Result<(), EffectError> {
        let id = self.id();
        for p in self.parameters() {
            if !(p.value.is_finite() && p.value >= p.lower && p.value <= p.upper) {
                return Err(EffectError::OutOfRange {
                    id,
                    name: p.name,
                    value: p.value,
                    unit: p.unit,
                    lower: p.lower,
                    upper: p.upper,
                });
            }
        }
        self.kind()
            .check(self)
            .map_err(|message| EffectError::Inconsistent { id, message })
    }
}

/// The element `list[i]` that a name like `weights[3]` means.
fn element<'a>(name: &str, list: &str, values: &'a mut [f64]) -> Option<&'a mut f64> {
    let index = name
        .strip_prefix(list)?
        .strip_prefix('[')?
        .strip_suffix(']')?;
    values.get_mut(index.parse::<usize>().ok()?)
}
