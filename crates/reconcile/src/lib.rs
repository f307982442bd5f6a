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
mod battery;
mod catalogue;
mod data;
mod dot;
mod error;
mod evaluate;
mod fit;
mod floor;
mod frames;
mod guard;
mod held_out;
mod judge;
mod linear;
mod lines;
mod locking;
mod map;
mod names;
mod noise;
mod parallel;
mod pixel;
mod predict;
mod problem;
mod report;
mod result;
mod screen;
mod search;
mod significance;
mod split;
mod thresholds;
mod verdict;

pub use actuator::constant_gain;
pub use battery::{Hypothesis, Term};
pub use data::Record;
pub use error::ReconcileError;
pub use floor::FloorSource;
pub use judge::figure;
pub use map::{BAND_EDGES_HZ, BandRatio, Cell, DiscrepancyMap, MapRow, band_labels};
pub use noise::Noise;
pub use report::report;
pub use result::{
    BandGap, Effect, Gap, GapStep, Interval, Reconciliation, RecordGap, Remainder, Trace, Traces,
    Verdict,
};
pub use thresholds::{THRESHOLDS, Thresholds};
pub use verdict::{Options, reconcile};
