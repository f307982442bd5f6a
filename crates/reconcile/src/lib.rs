//! Finds where simulation and measurement disagree, names the missing effect, adds it to the model and measures the gap again.
//!
//! [`reconcile`] takes a model and records and returns one of five verdicts:
//! - *named*;
//! - *named with a remainder*;
//! - *ambiguous*: the records cannot separate several effects;
//! - *unknown*: no effect of the catalogue explains enough;
//! - *nothing missing*.
//!
//! All scores are sums of squared innovations of the model's own Kalman filter ([`NoiseModel`]). The free-run residual would
//! not do: for a perfect model of this rig it is a random walk.
//!
//! Not for identifying a plant from nothing (that is `cellpos-ident`), and not for files: records come as columns.
//!
//! - [`reconcile`] with [`Options`]: the search. [`report()`]: its page.
//! - [`Record`]: command and position at equal steps. [`Units`]: what they are measured in.
//! - [`NoiseModel`] and [`FloorSource`]: the noise, and where its size comes from.
//! - [`DiscrepancyMap`]: where, in frequency and amplitude, the model falls short.
//! - [`Hypothesis`]: a formula, if no effect of the catalogue has a name.
//! - [`THRESHOLDS`]: every number that decides, with its reason.
//!
//! ```
//! use cellpos_plant::Model;
//! use cellpos_reconcile::{Options, ReconcileError, Record, reconcile};
//! let time_s: Vec<f64> = (0..3000).map(|k| f64::from(k) * 1e-3).collect();
//! let (pzt_um, bead_um) = (vec![4.0; 3000], vec![0.0; 3000]);
//! let rest = Record::from_rows("rest", &time_s, &pzt_um, &bead_um).unwrap();
//! // A command that never changes tells no effect from another, and is refused with what to record instead.
//! let answer = reconcile(&Model::eq6(), &[rest], &Options::default(), &mut |_| {});
//! assert!(matches!(answer, Err(ReconcileError::ConstantInput)));
//! ```
#![forbid(unsafe_code)]

mod data;
mod dot;
mod error;
mod fit;
mod mask;
mod model_error;
mod problem;
mod report;
mod search;
mod simulate;
mod start;
mod thresholds;
mod units;
mod verdict;

pub use data::actuator::constant_gain;
pub use data::coloured::NoiseKind;
pub use data::estimate::FloorSource;
pub use data::flow_loss::FlowLoss;
pub use data::motion::ZeroFlow;
pub use data::noise::{Coloured, NoiseModel};
pub use data::record::Record;
pub use error::ReconcileError;
pub use report::report;
pub use thresholds::{THRESHOLDS, Thresholds};
pub use units::{Units, figure, figure_of};
pub use verdict::battery::{Hypothesis, Term};
pub use verdict::guard::looks_like_volts;
pub use verdict::map::{Cell, DiscrepancyMap, MapRow};
pub use verdict::response::BandRatio;
pub use verdict::result::{
    BandGap, Effect, Gap, GapStep, Interval, Reconciliation, RecordGap, Remainder, Trace, Traces,
    Verdict,
};
pub use verdict::workflow::{Options, WORK, reconcile};
