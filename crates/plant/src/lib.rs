//! The plant of Mizoue et al. 2017 (doi 10.3390/mi8030080), Eq. (1)-(7), its discretisation, effect blocks and model
//! files.
//!
//! - [`TransferFunction`] with Eq. (6) built in, [`StateSpace`] for analysis.
//! - [`DiscretePlant`]: exact zero-order hold with any delay, for controllers and estimators.
//! - [`Model`]: plant, [`Effect`]s and [`Noise`]; all commands share it. On disk it is `model.toml`.
//! - [`Chain`]: a model as a time-stepping machine from the command to the true bead position; [`Simulator`] adds the
//!   camera at a fixed sample time; [`simulate`] answers whole records.
//!
//! Sampling convention everywhere: row k holds the displacement commanded from its time on, and the bead's position
//! just before that command takes effect.
//!
//! Not here: controllers, estimation, fitting, images.
//!
//! ```
//! use cellpos_plant::{Model, SimulateOptions, effects, simulate};
//! // A step of 1 um about the working point of 4 um, a row a millisecond, with and without a driver of 80 Hz.
//! let step: Vec<f64> = (0..200).map(|k| if k < 10 { 4.0 } else { 5.0 }).collect();
//! let eq6 = Model::eq6();
//! let slow = eq6.clone().with_effect(effects::driver_lag(80.0));
//! let fast_um = simulate(&eq6, &step, 1e-3, &SimulateOptions::default()).unwrap();
//! let slow_um = simulate(&slow, &step, 1e-3, &SimulateOptions::default()).unwrap();
//! assert!(fast_um[9].abs() < 1e-9);
//! assert!(0.0 < slow_um[15] && slow_um[15] < fast_um[15]);
//! ```
#![forbid(unsafe_code)]

mod chain;
mod discrete;
pub mod effects;
mod error;
mod modal;
mod model;
mod model_file;
mod phi;
pub mod quantities;
mod roots;
mod simulate;
mod state_space;
mod transfer;
mod words;

pub use cellpos_numeric::units::{Decibels, Degrees, Hertz, Micrometers, Seconds};
pub use chain::{Chain, ChainError, TiedPlant};
pub use discrete::{DiscretePlant, DiscreteState};
pub use effects::{Effect, EffectError, Parameter, Place};
pub use error::{ModelError, ModelProblem, PlantError, Position};
pub use modal::Zpk;
pub use model::{Covariance, Model, Noise};
pub use nalgebra::Complex;
pub use simulate::{Sampled, SimulateError, SimulateOptions, Simulator, simulate};
pub use state_space::StateSpace;
pub use transfer::{
    EQ5_LITERAL_PER_S, EQ5_VELOCITY_GAIN_PER_S, MAX_ORDER, ProbablyPerHertz, TransferFunction,
    probably_per_hertz,
};
pub use words::in_words;
