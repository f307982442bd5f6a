//! The plant of Mizoue et al. 2017, Eq. (1)-(7), its discretisation, effect blocks and model files.
#![forbid(unsafe_code)]

mod chain;
mod discrete;
mod effect;
mod error;
mod frames;
mod modal;
mod model;
mod model_file;
mod phi;
mod physical;
mod random;
mod roots;
mod simulate;
mod state_space;
mod transfer;

pub use cellpos_units::{Decibels, Degrees, Hertz, Micrometers, Seconds};
pub use chain::{Chain, ChainError};
pub use discrete::{DiscretePlant, DiscreteState};
pub use effect::{EFFECT_IDS, Effect, EffectError, Hysteresis, Parameter, ParameterSpec, Place};
pub use error::{ModelError, ModelProblem, PlantError, Position};
pub use frames::{FrameFate, apply_frame_fates, frame_fates};
pub use model::{Covariance, Model, Noise};
pub use nalgebra::Complex;
pub use physical::{NotIdentifiable, PhysicalParameters, SecondOrder};
pub use random::Gaussian;
pub use simulate::{Sampled, SimulateError, SimulateOptions, Simulator, simulate, simulate_at};
pub use state_space::StateSpace;
pub use transfer::{
    EQ5_LITERAL_PER_S, EQ5_VELOCITY_GAIN_PER_S, MAX_ORDER, ProbablyPerHertz, TransferFunction,
    probably_per_hertz,
};
