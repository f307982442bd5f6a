//! User-defined effects: a place, an expression in the usual notation, parameters with unit, bounds and start.
//!
//! A [`Definition`] comes from an effects file (`cellpos reconcile --effects`) or from a model file. After [`define`], the effect
//! is simulated, searched, named, written and read like any other. This module holds its equations; the module `model_file` reads
//! the file.

mod blocks;
mod core;
mod definition;
mod expression;

pub use core::Seen;
pub use definition::{Definition, DefinitionError, Site, UserParameter, UserState};
pub use expression::FUNCTIONS;

use self::core::Core;
use super::{
    Action, Candidate, Effect, EffectKind, Experiment, FitParameter, Form, ParameterSpec, Scope,
    Spec, find, register,
};
use definition::{Compiled, MOST_STATES};
use nalgebra::{Complex, DMatrix, DVector};
use std::sync::Arc;

/// Size of a motion about rest, um.
const SMALL_UM: f64 = 0.01;

/// A user-defined effect as a kind of effect.
#[derive(Debug)]
struct UserKind {
    definition: Definition,
    compiled: Arc<Compiled>,
    spec: &'static Spec,
    candidates: &'static [Candidate],
    starts: Vec<Vec<f64>>,
}

fn kept(text: &str) -> &'static str {
    Box::leak(text.to_owned().into_boxed_str())
}

/// Makes a user-defined effect known to model files, simulation and search, for the life of the process.
///
/// # Errors
/// A definition that is refused, or another effect with the same id. The same definition again is no error.
pub fn define(definition: &Definition) -> Result<&'static dyn EffectKind, DefinitionError> {
    let compiled = definition.compile()?;
    let taken = |message: &str| DefinitionError {
        id: definition.id.clone(),
        key: "id".to_owned(),
        message: message.to_owned(),
    };
    if let Some(known) = find(&definition.id) {
        return match known.definition() {
            Some(other) if same(other, definition) => Ok(known),
            Some(_) => Err(taken(
                "another effect of this id is defined already, with another equation or other bounds: give another id",
            )),
            None => Err(taken("this is an effect of the catalogue: give another id")),
        };
    }
    let kind: &'static UserKind = Box::leak(Box::new(UserKind::new(definition.clone(), compiled)));
    register(kind).map_err(|e| taken(&e.to_string()))?;
    Ok(kind)
}

/// Whether two definitions mean the same; the starts of their searches may differ.
fn same(a: &Definition, b: &Definition) -> bool {
    let bare = |d: &Definition| {
        let mut d = d.clone();
        d.parameters.iter_mut().for_each(|p| p.start.clear());
        d
    };
    bare(a) == bare(b)
}

/// Every combination of the starts of all numbers, up to a limit.
fn combinations(definition: &Definition) -> Vec<Vec<f64>> {
    const MOST: usize = 48;
    let mut all: Vec<Vec<f64>> = vec![Vec::new()];
    for p in &definition.parameters {
        let many = all.len() * p.start.len() <= MOST;
        let starts = if many { &p.start[..] } else { &p.start[..1] };
        all = all
            .iter()
            .flat_map(|head| {
                starts
                    .iter()
                    .map(move |s| [head.as_slice(), &[*s]].concat())
            })
            .collect();
    }
    all
}

impl UserKind {
    fn new(definition: Definition, compiled: Compiled) -> Self {
        let specs: Vec<ParameterSpec> = definition
            .parameters
            .iter()
            .map(|p| ParameterSpec::new(kept(&p.name), kept(&p.unit), p.lower, p.upper))
            .collect();
        let params: Vec<FitParameter> = definition
            .parameters
            .iter()
            .zip(&specs)
            .map(|(p, spec)| {
                let log = p.lower > 0.0 && p.upper > 30.0 * p.lower;
                let size = p.start.iter().fold(0.0, |a: f64, s| a.max(s.abs()));
                FitParameter {
                    name: spec.name,
                    log,
                    lower: p.lower,
                    upper: p.upper,
                    step: if log {
                        1e-3
                    } else {
                        1e-3 * size.max(1e-2 * (p.upper - p.lower))
                    },
                }
            })
            .collect();
        let forms: &'static [Form] =
            Box::leak(Box::new([Form::only(Box::leak(specs.into_boxed_slice()))]));
        let candidates: &'static [Candidate] = Box::leak(Box::new([Candidate::chain(Box::leak(
            params.into_boxed_slice(),
        ))]));
        let says = kept(&definition.says);
        Self {
            spec: Box::leak(Box::new(Spec {
                id: kept(&definition.id),
                place: definition.site.place(),
                shown_at: definition.site.word(),
                equation: kept(&definition.output),
                signature: says,
                ahead_of_plant: definition.site == Site::Chip,
                forms,
                confused_with: &[],
                inseparable_from: &[],
                experiment: Experiment::Amplitudes,
                separate_by: "the same motion at several amplitudes and frequencies",
            })),
            starts: combinations(&definition),
            definition,
            compiled: Arc::new(compiled),
            candidates,
        }
    }

    fn core(&self, effect: &Effect) -> Core {
        let values: Vec<f64> = (0..self.definition.parameters.len())
            .map(|i| effect.scalar(i))
            .collect();
        let [input, output] = effect.per_unit();
        // Input, plant's output, and effect's output.
        let units = match self.definition.site {
            Site::Driver | Site::Pzt => [input, output, input],
            Site::Chip => [input, output, input],
            Site::Plant => [input, output, output],
            Site::Bead | Site::Camera => [output, output, output],
        };
        Core::new(Arc::clone(&self.compiled), &values, units)
    }
}

impl UserKind {
    /// Longest time step, s: the one that the definition states, or a fifth of the fastest time constant of its states at rest.
    fn step_s(&self, effect: &Effect) -> Option<f64> {
        const PART_OF_TIME_CONSTANT: f64 = 0.2;
        self.definition.step_s.or_else(|| {
            let slopes = self.core(effect).slopes(SMALL_UM);
            let states = slopes.states.min(MOST_STATES);
            // No eigenvalue is larger than the largest sum of a row.
            let row = |rates: &[f64]| rates[3..3 + states].iter().map(|r| r.abs()).sum::<f64>();
            let fastest =
                (slopes.rates[..states].iter()).fold(0.0_f64, |most, rates| most.max(row(rates)));
            (fastest > 0.0).then(|| PART_OF_TIME_CONSTANT / fastest)
        })
    }
}

impl EffectKind for UserKind {
    fn spec(&self) -> &'static Spec {
        self.spec
    }

    fn act(&self, effect: &Effect) -> Action {
        let core = self.core(effect);
        match self.definition.site {
            site @ (Site::Driver | Site::Pzt | Site::Bead) => {
                Action::Block(Box::new(blocks::Inline {
                    core,
                    of_bead: site == Site::Bead,
                    step_s: self.step_s(effect),
                }))
            }
            site @ (Site::Chip | Site::Plant) => Action::Around(Box::new(blocks::Tied {
                core,
                replaces: site == Site::Plant,
                step_s: self.step_s(effect),
            })),
            Site::Camera => Action::Show(Box::new(blocks::Pictured { core })),
        }
    }

    fn candidates(&self) -> &'static [Candidate] {
        self.candidates
    }

    fn starts(&self, _: usize, _: &Scope) -> Vec<Vec<f64>> {
        self.starts.clone()
    }

    fn build(&'static self, _: usize, values: &[f64], scope: &Scope) -> Effect {
        Effect::new(self, 0, values, &[]).counted_in(scope.per_unit)
    }

    fn definition(&self) -> Option<&Definition> {
        Some(&self.definition)
    }

    /// By central differences about rest.
    fn small_motion(&self, effect: &Effect, s: Complex<f64>) -> Option<[Complex<f64>; 3]> {
        let slopes = self.core(effect).slopes(SMALL_UM);
        let n = slopes.states.min(MOST_STATES);
        let resolvent = DMatrix::from_fn(n, n, |i, j| {
            let own = if i == j { s } else { Complex::new(0.0, 0.0) };
            own - slopes.rates[i][3 + j]
        })
        .lu();
        let mut out = [Complex::new(0.0, 0.0); 3];
        for (column, out) in out.iter_mut().enumerate() {
            *out = Complex::new(slopes.output[column], 0.0);
            if n > 0 {
                let drive = DVector::from_fn(n, |i, _| Complex::new(slopes.rates[i][column], 0.0));
                let states = resolvent.solve(&drive)?;
                for (j, x) in states.iter().enumerate() {
                    *out += *x * slopes.output[3 + j];
                }
            }
        }
        Some(out)
    }
}
