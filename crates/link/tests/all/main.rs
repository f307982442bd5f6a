//! The wire format.

mod frame_vectors;
mod vectors;
mod wire;
mod wire_in_c;
