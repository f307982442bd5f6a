//! The 1 kHz loop: threads, rings, pacing, deadline account, safe states.
#![forbid(unsafe_code)]

pub mod latency;
pub mod realtime;
mod tick_record;

pub use tick_record::{CONTROLLER_STATE_LEN, TickFlags, TickRecord};
