//! The rig: where bead positions come from and where PZT commands go.
//!
//! Two traits, [`PositionSource`] and [`Actuator`], are all that the loop knows. Behind the first stand cameras (trait
//! [`Camera`]) with a tracker and a calibration, or positions without pictures; behind the second the PZT board, at
//! the end of any byte [`Port`]: a serial line, or the emulated board in this process. Drivers may block, allocate and
//! take locks: they run on the I/O threads, never in a tick.
#![forbid(unsafe_code)]

pub mod actuator;
pub mod background;
pub mod board;
pub mod calibration;
pub mod calibration_file;
pub mod clock;
pub mod emulated;
pub mod flow;
pub mod measurement;
pub mod serial;
pub mod socket;
pub mod source;
pub mod sources;
pub mod vision_source;

pub use actuator::{Actuator, ActuatorError, ActuatorInfo, BoardReport};
pub use board::{BoardHost, Port};
pub use calibration::{Axis, Calibration};
pub use calibration_file::{CalibrationError, CalibrationFile};
pub use clock::Clock;
pub use emulated::EmulatedRig;
pub use flow::{CommandedFlow, FlowTap};
pub use measurement::Measurement;
pub use source::{Camera, CameraError, FrameBuffer, FrameStamp, PositionSource, SourceInfo};
pub use vision_source::{Followed, VisionSource};
