//! Finds where simulation and measurement disagree, names what is missing, adds it to the model and shows the gap shrink.
//!
//! [`reconcile`] takes a model and records and answers with one of four verdicts: effects are *named*, the records leave
//! it *ambiguous* between several, it is *unknown* to the catalogue, or *nothing is missing*. All scores are sums of
//! squared innovations of the model's own Kalman filter ([`Noise`]), because the free-run residual of a perfect model of
//! this rig is a random walk.
//!
//! Not for identifying a plant from nothing (that is `cellpos-ident`), and not for files: records come as columns.
#![forbid(unsafe_code)]

mod actuator;
mod assemble;
mod augment;
mod catalogue;
mod data;
mod error;
mod evaluate;
mod fit;
mod floor;
mod frames;
mod guard;
mod held_out;
mod hypothesis;
mod linear;
mod locking;
mod map;
mod noise;
mod parallel;
mod pixel;
mod predict;
mod problem;
mod report;
mod result;
mod screen;
mod search;
mod separate;
mod significance;
mod verdict;

pub use actuator::constant_gain;
pub use data::Record;
pub use error::ReconcileError;
pub use hypothesis::{Hypothesis, Term};
pub use map::{BAND_EDGES_HZ, BandRatio, Cell, DiscrepancyMap, MapRow, band_labels};
pub use noise::Noise;
pub use report::report;
pub use result::{
    BandGap, Effect, Gap, GapStep, Interval, Reconciliation, RecordGap, Trace, Traces, Verdict,
};
pub use verdict::{Options, reconcile};
