//! The candidates of a search: every form of every known effect, and a form with its numbers.

use cellpos_plant::Effect;
use cellpos_plant::effects::{self, Action, Candidate, EffectKind, Scope};

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
    pub(crate) fn id(self) -> &'static str {
        self.kind.spec().id
    }

    /// Whether it is an effect of the user's own.
    pub(crate) fn is_own(self) -> bool {
        self.kind.definition().is_some()
    }

    /// Whether slow motion gets another gain by it than fast motion.
    pub(crate) fn has_two_gains(self) -> bool {
        self.kind.has_two_gains()
    }

    /// Whether it is a curve of its input alone.
    pub(crate) fn is_curve(self) -> bool {
        self.kind.is_curve()
    }

    pub(crate) fn candidate(self) -> &'static Candidate {
        &self.kind.candidates()[self.form]
    }

    pub(crate) fn starts(self, scope: &Scope) -> Vec<Part> {
        self.kind
            .starts(self.form, scope)
            .iter()
            .map(|s| Part::new(self, s))
            .collect()
    }

    /// The same for a form in place of another: if the kind knows the numbers to which the other corresponds, from those.
    pub(crate) fn starts_from(self, part: &Part, scope: &Scope) -> Vec<Part> {
        match part
            .lag_s()
            .and_then(|lag_s| self.kind.start_of_lag(self.form, lag_s))
        {
            Some(start) => vec![Part::new(self, &start)],
            None => self.starts(scope),
        }
    }

    /// Whether it is a factor on all motion.
    pub(crate) fn is_gain(self) -> bool {
        self.kind.is_gain()
    }

    /// The form of the same effect that has its static curve and none of its memory.
    pub(crate) fn memoryless(self) -> Option<Self> {
        let form = self.kind.memoryless()?;
        Some(Self { form, ..self })
    }

    /// Other forms with the same numbers, in equations that few records tell from this one's.
    pub(crate) fn shapes(self) -> impl Iterator<Item = Self> {
        let shapes = self.kind.shapes(self.form).iter();
        shapes.map(move |form| Self {
            form: *form,
            ..self
        })
    }

    /// How many simple forms of the effect are worth following next to a set: of forms that are limits of each other the best one.
    pub(crate) fn forms_worth_following(self) -> usize {
        1 + usize::from(self.kind.has_unlike_forms())
    }

    /// Whether it is a richer form of an effect that no record tells from another.
    pub(crate) fn is_rich_double_of(self, other: Self) -> bool {
        self.candidate().late && (self.kind.spec().inseparable_from).contains(&other.id())
    }

    /// The variant that is a factor on all motion, the base model's gain set free.
    pub(crate) fn gain() -> Option<Self> {
        let kind = effects::all().into_iter().find(|k| k.is_gain())?;
        Some(Self { kind, form: 0 })
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
    pub(crate) fn new(variant: Variant, natural: &[f64]) -> Self {
        let theta = variant
            .candidate()
            .params
            .iter()
            .zip(natural)
            .map(|(p, v)| p.coordinate(*v))
            .collect();
        Self { variant, theta }
    }

    pub(crate) fn id(&self) -> &'static str {
        self.variant.id()
    }

    pub(crate) fn variant(&self) -> &'static Candidate {
        self.variant.candidate()
    }

    /// Parameter values in their units, within their bounds.
    pub(crate) fn natural(&self) -> Vec<f64> {
        let numbers = self.variant().params.iter().zip(&self.theta);
        let mut values: Vec<f64> = numbers.map(|(p, x)| p.natural(*x)).collect();
        self.variant.kind.bind(self.variant.form, &mut values);
        values
    }

    /// Takes the fit's coordinates back within the bounds. Beyond them a number does nothing, and has no derivative to lead it back.
    pub(crate) fn keep_within_bounds(&mut self) {
        *self = Self::new(self.variant, &self.natural());
    }

    /// The band of its frequency, between multiples of half the frame rate.
    pub(crate) fn band(&self, sample_s: f64) -> usize {
        self.variant.kind.band(&self.natural(), sample_s)
    }

    /// The delay of a slow motion by this effect, if it has one \[s\].
    pub(crate) fn lag_s(&self) -> Option<f64> {
        let lag_s = self
            .variant
            .kind
            .lag_s(self.variant.form, &self.natural())?;
        (1e-6..0.1).contains(&lag_s).then_some(lag_s)
    }

    /// Whether it is at least as large as the smallest that matters.
    pub(crate) fn matters(&self) -> bool {
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
    pub(crate) fn memory_s(&self, scope: &Scope) -> f64 {
        self.variant.kind.memory_s(&self.effect(scope))
    }

    /// Over how long the camera averages the motion with it \[s\].
    pub(crate) fn averages_s(&self, scope: &Scope) -> f64 {
        match self.effect(scope).act() {
            Action::Exposure(exposure_s) => exposure_s,
            _ => 0.0,
        }
    }

    /// Whether a camera can do it: a frame is exposed until the next one at most, but for the error of an estimate.
    pub(crate) fn is_possible(&self, scope: &Scope) -> bool {
        const ERROR: f64 = 0.1;
        self.averages_s(scope) <= (1.0 + ERROR) * scope.sample_s
    }

    pub(crate) fn effect(&self, scope: &Scope) -> Effect {
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
