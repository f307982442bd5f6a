//! A user's definition of an effect, and its check.

use super::expression::{ExpressionProblem, Program};
use crate::effects::Place;

/// A definition that is refused: which key, and why.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{id}: `{key}`: {message}")]
pub struct DefinitionError {
    /// The effect.
    pub id: String,
    /// The key within the effect's table, for example `parameters.cubic.lower`.
    pub key: String,
    /// What is wrong, and what would be right.
    pub message: String,
}

/// Place of a user-defined effect, and its signals there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Site {
    /// On the amplifier's output.
    Driver,
    /// On the piezo's displacement.
    Pzt,
    /// On the plant's input; sees the plant's own position and velocity: feedback.
    Chip,
    /// Replaces the plant's output; also sees the plant's input.
    Plant,
    /// On the bead's motion.
    Bead,
    /// On the position that a frame saw.
    Camera,
}

impl Site {
    const ALL: [Self; 6] = [
        Self::Driver,
        Self::Pzt,
        Self::Chip,
        Self::Plant,
        Self::Bead,
        Self::Camera,
    ];

    /// The words of files.
    pub const WORDS: [&'static str; 6] = ["driver", "pzt", "chip", "plant", "bead", "camera"];

    /// The site of a word.
    pub fn of(word: &str) -> Option<Self> {
        Self::WORDS
            .iter()
            .position(|w| *w == word)
            .map(|i| Self::ALL[i])
    }

    /// The word in files.
    pub fn word(self) -> &'static str {
        Self::WORDS[self as usize]
    }

    /// The place in the chain.
    pub fn place(self) -> Place {
        match self {
            Self::Driver => Place::Driver,
            Self::Pzt => Place::Pzt,
            Self::Chip | Self::Plant => Place::Chip,
            Self::Bead => Place::Bead,
            Self::Camera => Place::Camera,
        }
    }

    /// The signals that an expression may name here.
    fn signals(self) -> &'static [&'static str] {
        match self {
            Self::Driver | Self::Pzt => &["input", "output", "time"],
            Self::Chip | Self::Plant | Self::Bead => {
                &["input", "output", "position", "velocity", "time"]
            }
            Self::Camera => &["input", "output", "position", "time"],
        }
    }
}

/// A free number of an effect.
#[derive(Debug, Clone, PartialEq)]
pub struct UserParameter {
    /// Its name in expressions and files.
    pub name: String,
    /// Its unit; empty for a pure number.
    pub unit: String,
    /// Smallest value.
    pub lower: f64,
    /// Largest value.
    pub upper: f64,
    /// Values from which a search begins; the model's value if it has one.
    pub start: Vec<f64>,
}

/// A quantity with its own equation.
#[derive(Debug, Clone, PartialEq)]
pub struct UserState {
    /// Its name in expressions.
    pub name: String,
    /// Its rate of change per second.
    pub rate: String,
    /// Its value at rest; an expression of parameters only.
    pub start: String,
}

/// A user-defined effect, as its file gives it.
///
/// Signals are displacements from the model's rest \[um, or the unit of the records\]. `input` enters at the place, `output` is
/// the effect's result one step before, `position` and `velocity` \[per second\] come from the plant, `time` is in s.
#[derive(Debug, Clone, PartialEq)]
pub struct Definition {
    /// Its name in files and results.
    pub id: String,
    /// Where it acts.
    pub site: Site,
    /// What it means, in a few words.
    pub says: String,
    /// The output of the place, instead of `input` (at `plant`: instead of `position`).
    pub output: String,
    /// Quantities with their own equations.
    pub states: Vec<UserState>,
    /// Its free numbers.
    pub parameters: Vec<UserParameter>,
    /// Longest step in time of its equations \[s\]; left out: a fifth of the plant's fastest time constant.
    pub step_s: Option<f64>,
}

/// Places of the signals among the names of an expression.
pub(super) const INPUT: usize = 0;
pub(super) const OUTPUT: usize = 1;
pub(super) const POSITION: usize = 2;
pub(super) const VELOCITY: usize = 3;
pub(super) const TIME: usize = 4;
pub(super) const SIGNALS: [&str; 5] = ["input", "output", "position", "velocity", "time"];

/// Maximum number of parameters and states of an effect together.
pub(super) const MOST: usize = 16;
/// Maximum number of states of an effect.
pub(super) const MOST_STATES: usize = 6;

/// A definition with its expressions compiled. Names have the order signals, parameters, states.
#[derive(Debug, Clone)]
pub(super) struct Compiled {
    pub output: Program,
    pub rates: Vec<Program>,
    pub starts: Vec<Program>,
}

impl Definition {
    fn wrong(&self, key: impl Into<String>, message: impl Into<String>) -> DefinitionError {
        DefinitionError {
            id: self.id.clone(),
            key: key.into(),
            message: message.into(),
        }
    }

    /// Checks names and numbers, and compiles the expressions.
    pub(super) fn compile(&self) -> Result<Compiled, DefinitionError> {
        self.check_names()?;
        self.check_numbers()?;
        let mut names: Vec<&str> = SIGNALS.to_vec();
        names.extend(self.parameters.iter().map(|p| p.name.as_str()));
        names.extend(self.states.iter().map(|s| s.name.as_str()));
        let last_parameter = SIGNALS.len() + self.parameters.len();
        let of = |key: String, text: &str, known: &[&str]| {
            Program::new(text, known).map_err(|ExpressionProblem(words)| self.wrong(key, words))
        };
        let seen = |key: &str, program: Program| -> Result<Program, DefinitionError> {
            let allowed = self.site.signals();
            match SIGNALS.iter().enumerate().find(|(i, s)| program.uses(*i) && !allowed.contains(s)) {
                None => Ok(program),
                Some((_, signal)) => Err(self.wrong(
                    key,
                    format!(
                        "`{signal}` is not known at the {}: known there are {}; feedback of the position belongs to the places chip and plant",
                        self.site.word(),
                        allowed.join(", ")
                    ),
                )),
            }
        };
        let output = seen("output", of("output".to_owned(), &self.output, &names)?)?;
        let (mut rates, mut starts) = (Vec::new(), Vec::new());
        for s in &self.states {
            let key = format!("states.{}.rate", s.name);
            rates.push(seen(&key, of(key.clone(), &s.rate, &names)?)?);
            let key = format!("states.{}.start", s.name);
            let start = of(key.clone(), &s.start, &names[..last_parameter])?;
            if (0..SIGNALS.len()).any(|i| start.uses(i)) {
                return Err(self.wrong(
                    key,
                    "a start is an expression of parameters and numbers only",
                ));
            }
            starts.push(start);
        }
        Ok(Compiled {
            output,
            rates,
            starts,
        })
    }

    fn check_names(&self) -> Result<(), DefinitionError> {
        let plain = |id: &str| {
            id.chars().next().is_some_and(|c| c.is_ascii_lowercase())
                && id
                    .chars()
                    .all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-')
        };
        if !plain(&self.id) || self.id.len() > 40 {
            return Err(self.wrong(
                "id",
                format!("\"{}\" is no name of an effect: small letters, digits and `-`, at most 40, for example cubic-stiffness", self.id),
            ));
        }
        if self.site == Site::Camera && !self.states.is_empty() {
            return Err(self.wrong(
                "states",
                "a camera sees single frames: put an effect with states at the bead",
            ));
        }
        if self.states.len() > MOST_STATES || self.parameters.len() + self.states.len() > MOST {
            return Err(self.wrong(
                "parameters",
                format!("at most {MOST} parameters and states, and {MOST_STATES} states"),
            ));
        }
        let own = self
            .parameters
            .iter()
            .map(|p| ("parameters", p.name.as_str()))
            .chain(self.states.iter().map(|s| ("states", s.name.as_str())));
        let mut taken: Vec<&str> = SIGNALS.to_vec();
        for (kind, name) in own {
            let key = format!("{kind}.{name}");
            let word = name.chars().next().is_some_and(|c| c.is_ascii_alphabetic())
                && name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
                && name.len() <= 40;
            if !word {
                return Err(self.wrong(
                    key,
                    "a name has letters, digits and `_` and begins with a letter",
                ));
            }
            if taken.contains(&name)
                || super::expression::FUNCTIONS.contains(&name)
                || matches!(name, "id" | "form")
            {
                return Err(self.wrong(
                    key,
                    format!("`{name}` has a meaning already (a signal, a function, or another name of this effect): give another"),
                ));
            }
            taken.push(name);
        }
        Ok(())
    }

    fn check_numbers(&self) -> Result<(), DefinitionError> {
        for p in &self.parameters {
            let key = |k: &str| format!("parameters.{}.{k}", p.name);
            if !(p.lower.is_finite() && p.upper.is_finite() && p.lower < p.upper) {
                return Err(self.wrong(
                    key("upper"),
                    format!(
                        "bounds {} .. {}: both must be finite, the lower one below the upper one",
                        p.lower, p.upper
                    ),
                ));
            }
            if p.start.is_empty() || p.start.len() > 8 {
                return Err(self.wrong(
                    key("start"),
                    "one number, or a list of at most eight to try",
                ));
            }
            if let Some(s) = p.start.iter().find(|s| !(**s >= p.lower && **s <= p.upper)) {
                return Err(self.wrong(
                    key("start"),
                    format!("{s} lies outside of {} .. {}", p.lower, p.upper),
                ));
            }
        }
        if self.parameters.is_empty() {
            return Err(self.wrong(
                "parameters",
                "an effect needs a number that says how strong it is",
            ));
        }
        match self.step_s {
            Some(s) if !(1e-6..=1e3).contains(&s) => {
                Err(self.wrong("step_s", format!("{s} s: it must lie in 1e-6..1000 s")))
            }
            _ => Ok(()),
        }
    }
}
