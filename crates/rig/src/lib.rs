//! What the loop asks of a rig: where positions come from, and where PZT commands go.
//!
//! Traits and plain types, no device: [`PositionSource`] yields positions, [`Camera`] the frames that a tracker makes
//! positions of, [`Actuator`] takes displacements and reports in its own words what it does with them. Drivers of real
//! devices are in `cellpos-drivers`, the emulated rig in `cellpos-emulator`. What implements the traits may block,
//! allocate and take locks: it runs on I/O threads, never in a tick.
#![forbid(unsafe_code)]

pub mod actuator;
pub mod clock;
pub mod freshness;
pub mod measurement;
pub mod source;

pub use actuator::{
    Actuator, ActuatorError, ActuatorFault, ActuatorInfo, ActuatorReport, ActuatorState,
    ArmRequest, CommandAccount,
};
pub use clock::Clock;
pub use freshness::{FrameAccount, FrameCounts, FrameKind, IdKind, Judged};
pub use measurement::Measurement;
pub use source::{
    Camera, CameraError, FrameBuffer, FrameStamp, FrameWatch, PictureScale, PositionSource,
    SeenFrame, SourceInfo,
};
