//! The wire format.

mod vectors;
mod wire;
