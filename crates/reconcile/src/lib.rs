//! Finds where simulation and measurement disagree, names what is missing, adds it to the model and shows the gap shrink.
//!
//! [`reconcile`] takes a model and records and answers with one of four verdicts: effects are *named*, the records leave
//! it *ambiguous* between several, it is *unknown* to the catalogue, or *nothing is missing*. All scores are sums of
//! squared innovations of the model's own Kalman filter ([`Noise`]), because the free-run residual of a perfect model of
//! this rig is a random walk.
//!
//! Not for identifying a plant from nothing (that is `cellpos-ident`), and not for files: records come as columns.
#![forbid(unsafe_code)]

mod data;
mod dot;
mod error;
mod fit;
mod parallel;
mod problem;
mod report;
mod search;
mod simulate;
mod thresholds;
mod verdict;

pub use data::actuator::constant_gain;
pub use data::floor::FloorSource;
pub use data::noise::Noise;
pub use data::record::Record;
pub use error::ReconcileError;
pub use report::report;
pub use thresholds::{THRESHOLDS, Thresholds};
pub use verdict::battery::{Hypothesis, Term};
pub use verdict::judge::figure;
pub use verdict::map::{BAND_EDGES_HZ, BandRatio, Cell, DiscrepancyMap, MapRow, band_labels};
pub use verdict::result::{
    BandGap, Effect, Gap, GapStep, Interval, Reconciliation, RecordGap, Remainder, Trace, Traces,
    Verdict,
};
pub use verdict::workflow::{Options, reconcile};
