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

pub(crate) use args::Args;
pub(crate) use error::ProgramError;
pub(crate) use run::run;
