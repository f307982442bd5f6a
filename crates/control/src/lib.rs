//! Controllers, estimators, references, output limits and loop design.
//!
//! Everything here is a pure step function. Configuration is immutable and separate from the state. A step knows neither
//! device nor clock, allocates nothing and cannot panic. The same [`ControlLoop`] runs on the real clock,
//! on the virtual one, in a replay and in [`design`]'s simulations.
//!
//! Units: micrometres, seconds and 1/s throughout. A displacement is of the PZT unless the name says `bead`.
//!
//! Sampling convention: at tick `k` a command `u_k` takes effect and is held until tick `k + 1`; the position `p_k` is
//! that just before `u_k` takes effect. The measurement that arrives at tick `k` is of the position `delay` earlier.
//!
//! Start with:
//!
//! - [`ControllerFile`]: controller.toml. [`ControllerConfig`] and [`Controller`]: a law with its estimator, ready to step.
//! - [`ControlLoop`]: estimator, law, feed-forward and limits in one step, from [`LoopInput`] to [`LoopOutput`].
//! - [`Pi`], [`Lqg`], [`Mpc`]: the laws; [`ControlLaw`] is the trait for your own.
//! - [`LoopModel`]: the sampled plant with its delay. [`Adaptation`]: its gain and delay, estimated while the loop runs.
//! - [`Reference`] and [`Profile`]: the motion. [`learning`]: the feed-forward learned over cycles.
//! - [`design`]: gains, margins and the lowest possible error. [`SimulatedRig`]: a rig without pictures for tests.
//!
//! ```
//! use cellpos_control::{Controller, ControllerFile, LoopInput, Pi};
//! use cellpos_plant::Model;
//! // PI for Eq. (6) behind a loop delay of 2.5 ms, from rest at 20 um; a tick without a measurement.
//! let file = ControllerFile::from_pi(Pi::new(0.46, 19.5), 2.5e-3);
//! let mut controller = Controller::new(file.loop_config(&Model::eq6()).unwrap()).unwrap();
//! controller.start(20.0, 20.0);
//! let out = controller.step(&LoopInput::default());
//! assert_eq!(out.command_um, 20.0);
//! ```
#![forbid(unsafe_code)]

pub mod active_set;
mod config;
mod control_loop;
mod controller;
pub mod design;
mod deviation;
mod error;
mod estimator;
mod exposure;
mod feedforward;
pub mod law;
pub mod learning;
mod limits;
mod linear;
mod loop_io;
mod loop_model;
mod lqg;
mod mpc;
mod partner;
mod path;
mod pi;
mod plant_estimate;
mod reference;
pub mod riccati;
mod simulation;
mod toml_file;
mod tuning;
mod uncertainty;

pub use config::{ControllerFile, ControllerKind, PiFile};
pub use control_loop::{ControlLoop, LoopState};
pub use controller::{Controller, ControllerConfig, LoopConfig};
pub use error::{BuildError, Parameter};
pub use estimator::{
    Estimate, Estimator, EstimatorConfig, EstimatorState, HISTORY, PredictedState, RecentFixes,
    StillBead, ZERO_FLOW_WALK_UM_PER_SQRT_S, flow_step_log_density,
};
pub use feedforward::FeedForwardState;
pub use law::{
    ControlLaw, LAW_COLUMNS, LawInput, LawOutput, SolverReport, SolverStatus, SolverTerms,
};
pub use learning::{
    CycleLearning, Driven, HarmonicResponse, LearnConfig, LearnError, LearnedHarmonic,
    LearnedTable, Learner, LearnerState,
};
pub use limits::{Limited, Limits};
pub use linear::LinearLaw;
pub use loop_io::{InForce, LoopFlags, LoopInput, LoopOutput, LoopParts, Measurement, Mode};
pub use loop_model::{LoopMode, LoopModel, MODES};
pub use lqg::{Feedback, Lqg, LqgLaw, LqgState};
pub use mpc::{HORIZON, Mpc, MpcLaw, MpcState, SolverKind, TimedSolve};
pub use partner::{
    Partner, PartnerConfig, PartnerInput, PartnerOutput, PartnerState, PartnerStatus, Probe,
};
pub use path::PathState;
pub use pi::{Lead, Pi, PiLaw, PiState};
pub use plant_estimate::{
    ADAPT_COLUMNS, AdaptMode, AdaptNews, AdaptState, Adaptation, PeriodicFlow,
};
pub use reference::{Points, Profile, Reference, Shape, fill_preview};
pub use simulation::{RigConfig, SimulatedRig};
pub use toml_file::ConfigError;
pub use tuning::Tuning;
