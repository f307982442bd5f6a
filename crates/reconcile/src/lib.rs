//! Finds where simulation and measurement disagree, names what is missing, adds it to the model and shows the gap shrink.
#![forbid(unsafe_code)]

mod catalogue;
mod data;
mod error;
mod fit;
mod floor;
mod noise;
mod parallel;
mod predict;
mod problem;
mod screen;
mod search;
mod verdict;

pub use data::Record;
pub use error::ReconcileError;
pub use noise::Noise;
pub use verdict::{debug_search};
