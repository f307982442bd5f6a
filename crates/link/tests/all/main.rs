//! The wire format.

mod vectors;
mod wire;
mod wire_in_c;
