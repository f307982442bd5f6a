//! Drivers: the traits of `cellpos-rig` for real devices.
//!
//! There are three kinds of [`Camera`](cellpos_rig::Camera): a camera server's socket ([`socket`]), GigE and USB3 Vision cameras
//! (`sources::industrial`, feature `aravis`), and recordings on disk ([`sources`]). [`VisionSource`] joins a camera with a
//! tracker and a calibration to a stream of positions. The [`Actuator`](cellpos_rig::Actuator) is the PZT board at the end of any
//! byte [`Port`].
//!
//! Drivers do not know the emulator. They may block, allocate and take locks, because they run on I/O threads, never in a tick.
//!
//! ```
//! use cellpos_drivers::Calibration;
//! // 0.1 um a pixel along the rows, position 0 at column 128.
//! let calibration = Calibration::along_rows(0.1, 128.0, 1.0);
//! assert!((calibration.position_um(138.0, 16.0) - 1.0).abs() < 1e-12);
//! // The variance in pixels becomes one in um^2: 0.2 px are 20 nm.
//! assert!((calibration.variance_um2(0.04, 0.04, 0.0).sqrt() - 0.02).abs() < 1e-12);
//! ```
#![forbid(unsafe_code)]

pub mod background;
pub mod board;
pub mod calibration;
pub mod calibration_file;
pub mod flow;
mod outbox;
pub mod pair;
mod port;
pub mod program;
pub mod serial;
pub mod socket;
pub mod sources;
pub mod vision_source;

pub use board::BoardHost;
pub use calibration::{Axis, Calibration};
pub use calibration_file::{CalibrationError, CalibrationFile};
pub use flow::{CommandedFlow, FlowTap};
pub use pair::{Pair, PartnerRequest};
pub use port::Port;
pub use vision_source::{Followed, VisionSource};
