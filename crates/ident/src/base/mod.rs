//! A linear base model, fitted to records in time, for a plant that is not Eq. (4).
//!
//! The model is a rational function of stated or chosen order, with or without a delay and a pole at zero. The fit compares its
//! free run with all records at once. Gain, zeros, the state at the start of each record and the sensor's zero enter linearly and
//! are solved for; poles and delay are searched (variable projection). So the plant need not rest before a record, the input need
//! not repeat, and held steps cause no leakage as in a spectrum. Not for nonlinear effects, and not for records of a loop without
//! a reference ([`crate::feedback`] detects them).

mod choose;
mod design;
mod fit;
mod form;
mod response;
mod types;

pub use choose::choose;
pub use form::{Form, FormError, MOST_ORDER};
pub use response::Grid;
pub use types::{BaseFit, Series};

#[cfg(test)]
mod tests;
