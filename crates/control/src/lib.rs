//! Controllers, estimators, references, output limits and loop design.
//!
//! Everything here is a pure step function: configuration is immutable and kept apart from a `Copy` state, no device
//! and no clock is known, and a step neither allocates nor can panic. The same [`ControlLoop`] runs on the real clock,
//! on the virtual one, in a replay and in [`design`]'s simulations.
//!
//! Units: micrometres, seconds and 1/s throughout. A displacement is of the PZT unless the name says `bead`.
//!
//! Sampling convention: at tick `k` a command `u_k` takes effect and is held until tick `k + 1`; the position `p_k` is
//! that just before `u_k` takes effect. The measurement that arrives at tick `k` is of the position `delay` earlier.
#![forbid(unsafe_code)]

pub mod active_set;
mod config;
mod control_loop;
pub mod design;
mod error;
mod estimator;
mod feedback;
mod feedforward;
pub mod learning;
mod limits;
mod linear;
mod loop_io;
mod loop_model;
mod monitor;
mod mpc;
mod pi;
mod reference;
pub mod riccati;
mod simulation;
mod state;
mod toml_file;

pub use config::{ControllerFile, ControllerKind, PiFile};
pub use control_loop::{ControlLoop, Controller};
pub use error::{BuildError, Parameter};
pub use estimator::{Estimator, EstimatorConfig, EstimatorState, HISTORY};
pub use feedback::{Feedback, Lqg};
pub use feedforward::FeedForwardState;
pub use learning::{
    CycleLearning, HarmonicResponse, LearnConfig, LearnError, LearnedHarmonic, LearnedTable,
    Learner, LearnerState,
};
pub use limits::{Limited, Limits};
pub use linear::LinearLaw;
pub use loop_io::{
    ControllerConfig, LoopConfig, LoopFlags, LoopInput, LoopOutput, Measurement, Mode,
    SolverReport, SolverStatus, SolverTerms,
};
pub use loop_model::{LoopMode, LoopModel, MODES};
pub use monitor::{PlantEstimate, PlantMonitor, PlantMonitorState, PlantVerdict};
pub use mpc::{HORIZON, Mpc, SolverKind};
pub use pi::{Lead, Pi, PiState};
pub use reference::{Points, Profile, Reference, Shape, fill_preview};
pub use simulation::{RigConfig, SimulatedRig};
pub use state::{LoopState, STATE_LEN};
pub use toml_file::ConfigError;
