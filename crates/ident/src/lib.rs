//! Excitation, frequency response, delay, and model fit with confidence intervals.
//!
//! From records of commanded displacement and bead position to a model whose every parameter has an interval and a
//! verdict. Pure computation: no device, no clock, no file. Frequencies are in Hz, angles in degrees at boundaries;
//! angular frequency only inside. A record follows the project's convention: row k holds the command applied from
//! `t_k` on and the position just before it takes effect.
#![forbid(unsafe_code)]

pub mod bare_fft;
pub mod delay;
mod error;
pub mod excitation;
pub mod experiment;
pub mod foreign;
pub mod frequency_response;
pub mod ladder;
pub mod ladder_model;
pub mod least_squares;
pub mod noise;
pub mod random;
pub mod rational;
pub mod sampled;
pub mod spectral;
pub mod stats;
pub mod summary;
pub mod tone_fit;
pub mod verdict;

pub use error::IdentError;
