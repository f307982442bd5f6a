//! Experiments on a rig: identification, records for reconcile, and the whole circle of identify, reconcile, design and track.
//!
//! - [`identify`]: the whole identification, on the emulated rig or on yours ([`on_rig`]).
//! - [`collect`]: the experiments that reconcile needs. [`excitation`]: their signals.
//! - [`circle`]: identify, reconcile, design, track. [`partner`]: gain, lag and delay of a slow actuator.
//! - [`paper`]: the numbers of Mizoue et al. 2017.
//!
//! A segment of an experiment, on the emulated rig (another: `RigFile::load` with a path):
//!
//! ```
//! use cellpos_workbench::experiment::excitation::Experiment;
//! use cellpos_workbench::experiment::on_rig::{Listener, OnRig};
//! use cellpos_ident::experiment::Turn;
//! use cellpos_session::{RigFile, rig_file::Frames};
//! # fn main() -> Result<(), cellpos_session::Failure> {
//! let rig = OnRig::new(RigFile::load(None)?, cellpos_plant::Model::eq6(), None, Frames::Off, true)?;
//! let plan = Experiment::Amplitudes.plan(&rig, 0.2, 1)?;
//! let mut listener = Listener { progress: &mut |_| {}, segment: &mut |_| {} };
//! let acquired = rig.acquire(&plan, &[Turn::planned(0)], &mut listener)?;
//! assert!(acquired.trouble.is_none() && acquired.records.len() == 1);
//! # Ok(())
//! # }
//! ```
mod again;
mod camera_rate;
pub mod circle;
pub mod collect;
pub mod excitation;
mod exciting;
pub mod identify;
mod lateness;
pub mod on_rig;
pub mod paper;
pub mod partner;
mod rows;
