//! The interface between loop and rig: traits and plain types, no device.
//!
//! - [`PositionSource`] yields positions ([`Measurement`]) to the loop; [`Camera`] yields frames ([`FrameBuffer`]), from which a
//!   tracker makes positions.
//! - [`Actuator`] takes displacements and reports its state ([`ActuatorReport`]), its limits ([`ActuatorInfo`]) and its faults
//!   ([`ActuatorFault`]).
//! - [`FrameAccount`] decides which frames are new, doubled, late, lost or stale.
//! - [`Clock`] is the real clock or a virtual one.
//! - [`FrameWatch`] sees each frame without delaying the loop; [`PictureScale`] converts its pixels.
//!
//! Drivers of real devices are in `cellpos-drivers`, the emulated rig is in `cellpos-emulator`. Implementations may block,
//! allocate and take locks: they run on I/O threads, never in a tick.
//!
//! ```
//! use cellpos_rig::{FrameAccount, FrameKind, IdKind};
//! // A camera of 1000 frames/s whose frame 2 is lost and whose frame 3 comes twice.
//! let mut account = FrameAccount::new(IdKind::Wide, 1_000_000, i64::MAX);
//! let mut kind = |id: u64| account.step(id, id as i64 * 1_000_000, id as i64 * 1_000_000 + 500_000).kind;
//! assert_eq!(kind(1), FrameKind::First);
//! assert_eq!(kind(3), FrameKind::New { missed: 1 });
//! assert_eq!(kind(3), FrameKind::Doubled);
//! assert_eq!(account.counts().lost, 1);
//! ```
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
    Rejections, SeenFrame, SourceInfo,
};
