//! A set of candidates fitted to the innovations of all records together.

#[cfg(test)]
mod agreement;
pub(crate) mod catalogue;
pub(crate) mod context;
pub(crate) mod descent;
mod evaluate;
pub(crate) mod linear;
pub(crate) mod locking;
mod position_error;
mod step;
mod waves;
