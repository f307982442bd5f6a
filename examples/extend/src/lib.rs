//! What a lab can add without changing a file of cellpos: a channel ([`bench`]) with its own camera ([`camera`]) and actuator
//! ([`actuator`]), a control law ([`law`]), an effect of the plant ([`effect`]). `tests/extend.rs` holds a bead
//! with the first three, simulates the fourth, and lets the search for discrepancies find it.
#![forbid(unsafe_code)]

pub mod actuator;
pub mod bench;
pub mod camera;
pub mod effect;
pub mod law;
