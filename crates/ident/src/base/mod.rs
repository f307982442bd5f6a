//! A linear base model of a plant that is not Eq. (4), fitted to records in time: a rational function of stated or chosen order,
//! with or without a delay, with or without a pole at zero.
//!
//! The model's free run is held against all records at once. Gain, zeros, the state at the start of each record and the sensor's
//! zero enter linearly and are solved for; poles and delay are searched (variable projection). So a plant need not have
//! rested before a record, the input need not repeat, and steps that are held do not leak into a spectrum.
//! Not for records of a loop without a reference ([`crate::feedback`] detects them), and not for nonlinear effects.

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
