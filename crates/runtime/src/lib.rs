//! The 1 kHz loop: threads, rings, pacing, deadline account, safe states.
#![forbid(unsafe_code)]

pub mod arming;
pub mod core;
pub mod latency;
pub mod life;
pub mod realtime;
pub mod summary;
mod tick_record;
pub mod ticker;

pub use crate::core::{Action, Core, CoreError, TickInput, TickOutput, Timing};
pub use arming::ArmingConfig;
pub use life::{Event, EventKind, Life, Request, SafeReason};
pub use tick_record::{CONTROLLER_STATE_LEN, TickFlags, TickRecord};
