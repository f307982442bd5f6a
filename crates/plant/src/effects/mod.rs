//! Effects of real rigs that Eq. (6) lacks: one file per effect, and one table over which all users iterate.
//!
//! An effect is one type that implements [`EffectKind`]. It gives its specification (id, place, parameters with units and bounds), its
//! equation as an [`Action`] on the signal at its place, the [`Candidate`] forms that a search may try, and the experiment that separates
//! it from others. Simulator, emulator, design, the search for discrepancies, its report and model files all use this trait and know no
//! effect by name.
//!
//! To add an effect to this crate, write its file here and its line in `table.rs`. From another crate, implement [`EffectKind`] and pass
//! it to [`register`]. Without code, write a [`Definition`] in a file.
//!
//! Chain: command -> driver -> pzt -> chip (with the plant) -> bead -> camera -> record. Effects at one place act in the order of the
//! table. The order in a model file does not matter.

mod action;
mod candidate;
mod parameter;
mod table;

mod backlash;
mod bubble;
mod camera_shake;
mod clock_skew;
mod driver_lag;
mod exposure_averaging;
mod flow_drift;
mod flow_wander;
mod frame_drops;
mod frame_jitter;
mod frame_repeats;
mod gain_drift;
mod gain_error;
mod gain_swing;
mod jumps;
mod leak;
mod lens_distortion;
mod mains_hum;
mod pdms_relaxation;
mod pixel_locking;
mod pump_pulsation;
mod pzt_creep;
mod pzt_hysteresis;
mod pzt_resonance;
mod saturation;
mod slew_limit;
mod speed_law;
mod stick_slip;
mod stiffening;
mod time_delay;
mod user;
mod valve_asymmetry;
mod wall_adhesion;

pub use action::{Action, Around, Block, Piece, Shown};
pub use backlash::backlash;
pub use bubble::bubble;
pub use camera_shake::camera_shake;
pub use candidate::{Candidate, Experiment, FitParameter, Role, Scope, lin, log};
pub use clock_skew::clock_skew;
pub use driver_lag::driver_lag;
pub use exposure_averaging::exposure_averaging;
pub use flow_drift::flow_drift;
pub use flow_wander::flow_wander;
pub use frame_drops::frame_drops;
pub use frame_jitter::{FRAME_JITTER_LEAST_S, frame_jitter, frame_jitter_mean};
pub use frame_repeats::frame_repeats;
pub use gain_drift::gain_drift;
pub use gain_error::gain_error;
pub use gain_swing::gain_swing;
pub use jumps::jumps;
pub use leak::leak;
pub use lens_distortion::lens_distortion;
pub use mains_hum::mains_hum;
pub use parameter::{EffectError, Form, Parameter, ParameterSpec, Spec};
pub use pdms_relaxation::{pdms_relaxation, pdms_relaxation_of_fast_gain};
pub use pixel_locking::pixel_locking;
pub use pump_pulsation::pump_pulsation;
pub use pzt_creep::pzt_creep;
pub use pzt_hysteresis::{Curve, bouc_wen, bouc_wen_explicit, curved_play, exponential_play, play};
pub use pzt_resonance::pzt_resonance;
pub use saturation::saturation;
pub use slew_limit::slew_limit;
pub use stick_slip::stick_slip;
pub use stiffening::{stiffening, stiffening_by_square};
pub use table::{all, built_in, find, ids, register};
pub use time_delay::time_delay;
pub use user::{
    Definition, DefinitionError, FUNCTIONS, Seen, Site, UserParameter, UserState, define,
};
pub use valve_asymmetry::valve_asymmetry;
pub use wall_adhesion::wall_adhesion;

use crate::modal::Zpk;
use nalgebra::Complex;
use std::fmt;

/// Where in the chain an effect acts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Place {
    /// The amplifier, between command and piezo.
    Driver,
    /// The piezo and its coupling to the syringe.
    Pzt,
    /// Syringe, tube and channel: in the loop of Eq. (1)-(3).
    Chip,
    /// The bead in the flow.
    Bead,
    /// Camera, light, table and clock.
    Camera,
}

impl Place {
    /// The word in files and results.
    pub fn word(self) -> &'static str {
        match self {
            Self::Driver => "driver",
            Self::Pzt => "pzt",
            Self::Chip => "chip",
            Self::Bead => "bead",
            Self::Camera => "camera",
        }
    }
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.word())
    }
}

/// The kind of an effect as a trait object: every [`EffectKind`] has it.
pub trait AsEffectKind {
    /// The kind itself.
    fn as_kind(&'static self) -> &'static dyn EffectKind;
}

impl<K: EffectKind> AsEffectKind for K {
    fn as_kind(&'static self) -> &'static dyn EffectKind {
        self
    }
}

/// Everything that is known about one effect, apart from its numbers.
pub trait EffectKind: fmt::Debug + Send + Sync + AsEffectKind {
    /// Id, place, parameters, words.
    fn spec(&self) -> &'static Spec;

    /// The action of the effect with these numbers at its place.
    fn act(&self, effect: &Effect) -> Action;

    /// The linear part at the start of a record, for an effect that changes with time, if any.
    fn at_start(&self, effect: &Effect) -> Option<Zpk> {
        let _ = effect;
        None
    }

    /// The user's definition, for a user-defined effect.
    fn definition(&self) -> Option<&Definition> {
        None
    }

    /// Factors on input, position and velocity for small motions about rest at a complex frequency \[rad/s\], if the effect is not linear
    /// but has such factors.
    fn small_motion(&self, effect: &Effect, s: Complex<f64>) -> Option<[Complex<f64>; 3]> {
        let _ = (effect, s);
        None
    }

    /// Checks that numbers which are each within their bounds also fit together.
    ///
    /// # Errors
    /// What is wrong, and what would be right.
    fn check(&self, effect: &Effect) -> Result<(), &'static str> {
        let _ = effect;
        Ok(())
    }

    /// Whether it is a memoryless curve of its input, so that other curves are forms of the same effect.
    fn is_curve(&self) -> bool {
        false
    }

    /// Whether it gives slow and fast motion different gains. Its form (anchoring) then says which of the two is the model's gain.
    fn has_two_gains(&self) -> bool {
        false
    }

    /// Whether it multiplies all motion by one factor and does nothing else.
    fn is_gain(&self) -> bool {
        false
    }

    /// The candidate with the static curve of the effect but no memory, if any.
    fn memoryless(&self) -> Option<usize> {
        None
    }

    /// Other candidates with the numbers of this one, in equations that few records tell from its own.
    fn shapes(&self, form: usize) -> &'static [usize] {
        let _ = form;
        &[]
    }

    /// Whether its simple forms differ so much that the second best may win together with other effects.
    fn has_unlike_forms(&self) -> bool {
        false
    }

    /// One effect equivalent to two of this kind in series; `None` if there is no such effect.
    fn combined(&'static self, first: &Effect, second: &Effect) -> Option<Effect> {
        let _ = (first, second);
        None
    }

    /// The experiment that separates it from an effect of [`Spec::inseparable_from`], in words.
    fn separate_from_double(&self) -> Option<&'static str> {
        None
    }

    /// Whether a cause outside the catalogue has the same response from command to bead. The report then always names the separating
    /// experiment.
    fn has_doubles(&self) -> bool {
        false
    }

    /// Memory of its input \[s\]; its freer forms are at most a decade slower. Unlimited by default.
    fn memory_s(&self, effect: &Effect) -> f64 {
        let _ = effect;
        f64::INFINITY
    }

    /// The forms that a search may try; empty for an effect that no fit searches for.
    fn candidates(&self) -> &'static [Candidate] {
        &[]
    }

    /// Values from which to start the fit of candidate `index`, in the order of its parameters.
    fn starts(&self, index: usize, scope: &Scope) -> Vec<Vec<f64>> {
        let _ = (index, scope);
        Vec::new()
    }

    /// Keeps values of candidate `index` within what one of them allows another, such as the end of a range above its start.
    fn bind(&self, index: usize, values: &mut [f64]) {
        let _ = (index, values);
    }

    /// The effect of candidate `index`, with these values of its parameters, which [`Self::bind`] leaves as they are. By default they are
    /// the numbers of the form with that index, or of the only form.
    fn build(&'static self, index: usize, values: &[f64], scope: &Scope) -> Effect {
        let _ = scope;
        let form = if index < self.spec().forms.len() {
            index
        } else {
            0
        };
        Effect::new(self.as_kind(), form, values, &[])
    }

    /// The band, between multiples of half the frame rate, of a frequency among the values. Frames show a frequency of one band much like
    /// its image in another, so a fit has a minimum in each. 0 of an effect without a frequency.
    fn band(&self, values: &[f64], sample_s: f64) -> usize {
        let _ = (values, sample_s);
        0
    }

    /// Delay that candidate `index` adds to a slow motion \[s\], if any.
    fn lag_s(&self, index: usize, values: &[f64]) -> Option<f64> {
        let _ = (index, values);
        None
    }

    /// A start of one of its candidates in place of an effect known only to delay slow motion by `lag_s`.
    fn start_of_lag(&self, index: usize, lag_s: f64) -> Option<Vec<f64>> {
        let _ = (index, lag_s);
        None
    }

    /// Candidates (index and values) that delay a slow motion by `lag_s`.
    fn of_lag(&self, lag_s: f64, scope: &Scope) -> Vec<(usize, Vec<f64>)> {
        let _ = (lag_s, scope);
        Vec::new()
    }
}

/// One effect with its numbers.
#[derive(Clone)]
pub struct Effect {
    kind: &'static dyn EffectKind,
    form: usize,
    scalars: Vec<f64>,
    lists: Vec<Vec<f64>>,
    per_unit: [f64; 2],
    any_unit: bool,
}

impl fmt::Debug for Effect {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut s = f.debug_struct(self.id());
        for p in self.parameters() {
            s.field(&p.name, &p.value);
        }
        s.finish()
    }
}

impl PartialEq for Effect {
    fn eq(&self, other: &Self) -> bool {
        self.id() == other.id()
            && self.form == other.form
            && self.scalars == other.scalars
            && self.lists == other.lists
    }
}

impl Effect {
    /// An effect from its kind, the index of its form, and its numbers in the order of the form; nothing is checked
    /// (see [`Self::validate`]). Missing numbers are zero.
    pub fn new(
        kind: &'static dyn EffectKind,
        form: usize,
        scalars: &[f64],
        lists: &[&[f64]],
    ) -> Self {
        let spec = &kind.spec().forms[form.min(kind.spec().forms.len() - 1)];
        let mut scalars = scalars.to_vec();
        scalars.resize(spec.scalars.len(), 0.0);
        let mut lists: Vec<Vec<f64>> = lists.iter().map(|l| l.to_vec()).collect();
        lists.resize(spec.lists.len(), Vec::new());
        Self {
            kind,
            form,
            scalars,
            lists,
            per_unit: [1.0, 1.0],
            any_unit: false,
        }
    }

    /// The same effect for a plant with another unit of length, without bounds in micrometres.
    pub fn in_any_unit(self) -> Self {
        Self {
            any_unit: true,
            ..self
        }
    }

    /// The same in a chain whose records have the given micrometres per unit of command and position. A user-defined effect keeps its
    /// numbers; its signals are converted to its units.
    pub fn counted_in(self, per_unit: [f64; 2]) -> Self {
        Self { per_unit, ..self }
    }

    /// Size of one unit of the command and of the position \[um\].
    pub fn per_unit(&self) -> [f64; 2] {
        self.per_unit
    }

    /// Kind of this effect.
    pub fn kind(&self) -> &'static dyn EffectKind {
        self.kind
    }

    /// The id used in model files and results, for example `"time-delay"`.
    pub fn id(&self) -> &'static str {
        self.kind.spec().id
    }

    /// The place of the effect in the chain.
    pub fn place(&self) -> Place {
        self.kind.spec().place
    }

    /// The action of the effect at its place.
    pub fn act(&self) -> Action {
        self.kind.act(self)
    }

    /// The form of an effect that has several, for example `"play"`.
    pub fn form(&self) -> Option<&'static str> {
        let forms = self.kind.spec().forms;
        (forms.len() > 1).then(|| forms[self.form].name)
    }

    /// Index of the form.
    pub fn form_index(&self) -> usize {
        self.form
    }

    /// Scalar parameter number `i` of the form.
    pub fn scalar(&self, i: usize) -> f64 {
        self.scalars.get(i).copied().unwrap_or(0.0)
    }

    /// List parameter number `i` of the form.
    pub fn list(&self, i: usize) -> &[f64] {
        self.lists.get(i).map_or(&[], Vec::as_slice)
    }

    /// The value of a parameter by name.
    pub fn get(&self, name: &str) -> Option<f64> {
        self.parameters()
            .into_iter()
            .find(|p| p.name == name)
            .map(|p| p.value)
    }

    /// The rank in which effects act, from the command to the record.
    pub fn order(&self) -> (Place, usize) {
        (self.place(), table::position(self.id()))
    }
}
