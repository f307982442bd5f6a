//! The interface between loop and rig: the source of positions, and the receiver of PZT commands.
//!
//! Traits and plain types, no device. A [`PositionSource`] yields positions. A [`Camera`] yields frames, from which a tracker
//! makes positions. An [`Actuator`] takes displacements and reports its state. Drivers of real devices are in
//! `cellpos-drivers`, the emulated rig is in `cellpos-emulator`. Implementations may block, allocate and take locks: they
//! run on I/O threads, never in a tick.
#![forbid(unsafe_code)]

pub mod actuator;
pub mod clock;
pub mod freshness;
pub mod measurement;
pub mod source;

pub use actuator::{
    Actuator, ActuatorError, ActuatorFault, ActuatorInfo, ActuatorReport, ActuatorState,
    ArmRequest, CommandAccount, PartnerReport,
};
pub use clock::Clock;
pub use freshness::{FrameAccount, FrameCounts, FrameKind, IdKind, Judged};
pub use measurement::Measurement;
pub use source::{
    Camera, CameraError, FrameBuffer, FrameStamp, FrameWatch, PictureScale, PositionSource,
    SeenFrame, SourceInfo,
};
