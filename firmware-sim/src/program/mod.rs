//! The program around the box: arguments, pseudo-terminal, socket, log, pacing.

mod args;
mod around;
mod error;
mod frame_server;
mod line;
mod log;
mod pace;
mod run;
mod usb;

pub use args::Args;
pub use error::ProgramError;
pub use run::run;
