//! What a lab adds to cellpos without touching a file of it: [`bench`], a channel with its own camera ([`camera`]) and its own
//! actuator ([`actuator`]); a control law ([`law`]); and an effect of the plant ([`effect`]). `tests/extend.rs` holds a bead
//! with the first three, simulates the fourth, and lets the search for discrepancies find it.
#![forbid(unsafe_code)]

pub mod actuator;
pub mod bench;
pub mod camera;
pub mod effect;
pub mod law;
