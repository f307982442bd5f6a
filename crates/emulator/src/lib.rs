//! The emulated rig: the board's own state machine, the physical world behind it and a rendered camera.
//!
//! [`World`] takes the board's output and the time, and delivers frames with the timing of a camera. A frame shows a bead with a
//! ring profile, or a cell in its channel, blurred along its true path during the exposure. It has shot and read noise, dust,
//! uneven light and a wandering focus (`Imperfections`). Runs that need no pictures get positions with the equivalent noise. The
//! world also gives the true positions. Faults come from a schedule ([`Faults`]). The only clock is the time that the caller
//! passes.
//!
//! [`RigInABox`] joins the world to a [`Board`] on one clock; [`EmulatedRig`] puts both behind the traits of `cellpos-rig`, on
//! the real clock or a virtual one. A seed fixes every bit of the output.
//!
//! ```
//! use cellpos_emulator::{World, WorldConfig};
//! use cellpos_plant::Model;
//! // The PZT stands at the displacement of zero flow: the bead drifts at 3 um/s and diffuses.
//! let mut world = World::new(&WorldConfig::default(), &Model::eq6(), 0).unwrap();
//! let mut seen = 0;
//! for k in 1..=100 {
//!     world.advance_to(k * 1_000_000, 20.0);
//!     while let Some(fix) = world.take_position() {
//!         assert!(fix.x_um.abs() < 3.0);
//!         seen += 1;
//!     }
//! }
//! assert!(seen > 90);
//! ```
#![forbid(unsafe_code)]

mod board_config;
mod camera;
mod cell;
mod cell_picture;
mod config;
mod emulated_rig;
mod error;
mod faults;
mod imperfections;
mod light;
mod look;
mod partner;
mod quantities;
mod render;
mod rig_in_a_box;
mod second_bead;
mod world;
mod zero_flow;

pub use board_config::{BoardConfig, BoardConfigError};
pub use camera::{FrameInfo, PositionFix};
pub use cell::CellConfig;
pub use cellpos_board::Board;
pub use config::WorldConfig;
pub use emulated_rig::{EmulatedCamera, EmulatedPort, EmulatedPositions, EmulatedRig};
pub use error::WorldError;
pub use faults::{FaultEvent, FaultKind, Faults};
pub use imperfections::Imperfections;
pub use look::BeadLook;
pub use partner::PressureConfig;
pub use quantities::QUANTITIES;
pub use rig_in_a_box::{BoxError, RigInABox};
pub use world::World;
