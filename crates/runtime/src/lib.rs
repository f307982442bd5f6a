//! The 1 kHz loop: threads, rings, pacing, deadline account, safe states.
#![forbid(unsafe_code)]

pub mod arming;
pub mod core;
pub mod guide;
pub mod latency;
mod learners;
pub mod life;
pub mod live;
pub mod realtime;
pub mod replay;
pub mod run;
pub mod summary;
mod tick;
mod tick_record;
pub mod ticker;
mod timing;
pub mod virtual_run;

pub use crate::core::{Action, Core, CoreError, TickInput, TickOutput, Timing};
pub use arming::ArmingConfig;
pub use guide::{Guide, GuideInput, GuideOutput, Stage};
pub use learners::Learners;
pub use life::{Event, EventKind, Life, Request, SafeReason};
pub use run::{EndRule, Finished, NoSink, RunError, RunSink};
pub use summary::{End, Statistics, Summary};
pub use tick_record::{CONTROLLER_STATE_LEN, TickFlags, TickRecord};
