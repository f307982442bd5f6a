//! The candidates of a search: every form of every known effect, and a form with its numbers.

use cellpos_plant::Effect;
use cellpos_plant::effects::{self, Candidate, EffectKind, Scope};

/// One form of an effect.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Variant {
    kind: &'static dyn EffectKind,
    form: usize,
}

impl PartialEq for Variant {
    fn eq(&self, other: &Self) -> bool {
        self.id() == other.id() && self.form == other.form
    }
}

impl Variant {
    pub fn id(self) -> &'static str {
        self.kind.spec().id
    }

    /// Whether it is an effect of the user's own.
    pub fn is_own(self) -> bool {
        self.kind.definition().is_some()
    }

    /// Whether slow motion gets another gain by it than fast motion.
    pub fn has_two_gains(self) -> bool {
        self.kind.has_two_gains()
    }

    /// Whether it is a curve of its input alone.
    pub fn is_curve(self) -> bool {
        self.kind.is_curve()
    }

    pub fn candidate(self) -> &'static Candidate {
        &self.kind.candidates()[self.form]
    }

    pub fn starts(self, scope: &Scope) -> Vec<Part> {
        self.kind
            .starts(self.form, scope)
            .iter()
            .map(|s| Part::new(self, s))
            .collect()
    }

    /// The same for a form in the stead of another: where the kind knows what the other comes to, from there.
    pub fn starts_from(self, part: &Part, scope: &Scope) -> Vec<Part> {
        match part
            .lag_s()
            .and_then(|lag_s| self.kind.start_of_lag(self.form, lag_s))
        {
            Some(start) => vec![Part::new(self, &start)],
            None => self.starts(scope),
        }
    }

    /// The form of an effect by its name among the forms.
    pub fn named(id: &str, form: &str) -> Option<Self> {
        let kind = effects::find(id)?;
        let form = kind.candidates().iter().position(|c| c.name == form)?;
        Some(Self { kind, form })
    }
}

/// Every form of every known effect; of the user's own those that are asked for.
pub(crate) fn variants(own: &[&str]) -> Vec<Variant> {
    effects::all()
        .into_iter()
        .filter(|kind| kind.definition().is_none() || own.contains(&kind.spec().id))
        .flat_map(|kind| (0..kind.candidates().len()).map(move |form| Variant { kind, form }))
        .collect()
}

/// One candidate with its parameters, in the fit's coordinates.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Part {
    pub variant: Variant,
    pub theta: Vec<f64>,
}

impl Part {
    /// From natural values.
    pub fn new(variant: Variant, natural: &[f64]) -> Self {
        let theta = variant
            .candidate()
            .params
            .iter()
            .zip(natural)
            .map(|(p, v)| p.coordinate(*v))
            .collect();
        Self { variant, theta }
    }

    pub fn id(&self) -> &'static str {
        self.variant.id()
    }

    pub fn variant(&self) -> &'static Candidate {
        self.variant.candidate()
    }

    /// Parameter values in their units.
    pub fn natural(&self) -> Vec<f64> {
        self.variant()
            .params
            .iter()
            .zip(&self.theta)
            .map(|(p, x)| p.natural(*x))
            .collect()
    }

    /// By how much it delays a slow motion, if that is what it does \[s\].
    pub fn lag_s(&self) -> Option<f64> {
        let lag_s = self
            .variant
            .kind
            .lag_s(self.variant.form, &self.natural())?;
        (1e-6..0.1).contains(&lag_s).then_some(lag_s)
    }

    /// Whether it is at least as large as the smallest that matters.
    pub fn matters(&self) -> bool {
        match self.variant().smallest {
            Some((at, least)) => {
                let neutral = self.variant().neutral;
                let values = self.natural();
                values.get(at).is_none_or(|v| (v - neutral).abs() >= least)
            }
            None => true,
        }
    }

    /// For how long it remembers what went into it \[s\].
    pub fn memory_s(&self, scope: &Scope) -> f64 {
        self.variant.kind.memory_s(&self.effect(scope))
    }

    pub fn effect(&self, scope: &Scope) -> Effect {
        self.variant
            .kind
            .build(self.variant.form, &self.natural(), scope)
    }
}

/// The forms that delay a slow motion by `lag_s`.
pub(crate) fn of_lag(lag_s: f64, scope: &Scope) -> Vec<Part> {
    effects::all()
        .into_iter()
        .flat_map(|kind| {
            kind.of_lag(lag_s, scope)
                .into_iter()
                .map(move |(form, values)| Part::new(Variant { kind, form }, &values))
        })
        .collect()
}
