//! Excitation, frequency response, delay, and model fit with confidence intervals.
//!
//! Turns records of commanded displacement and bead position into a model. Every parameter of the model has an interval and a
//! verdict. Pure computation: no device, no clock, no file. Frequencies are in Hz, angles in degrees at boundaries; angular
//! frequency only inside. A record follows the project's convention: row k holds the command applied from `t_k` on and the
//! position just before it takes effect.
//!
//! - [`excitation`] and [`experiment`]: the signals, and the plan of a measurement.
//! - [`frequency_response`], [`tone_fit`], [`spectral`]: gain and phase with standard deviations.
//! - [`delay`]: the camera's delay from the edges of an LED.
//! - [`rational`], [`from_response`], [`sampled`]: fits of a transfer function. [`base`]: a stated form, such as `order=2,delay`.
//! - [`late_commands`]: positions as they would be if every command had come on time.
//! - [`analogue`]: an input that is not held between its samples.
//! - [`order_selection`]: how many poles the data support. [`identifiability`]: which parameters they determine.
//! - [`summary`]: the result, ready for a model file.
//!
//! ```
//! use cellpos_ident::tone_fit::{ToneFit, fit_block};
//! // A sine of 2 um at 10 Hz on a drift of 5 um/s, as a record at 1 kHz.
//! let row = |k: usize| {
//!     let t = k as f64 * 1e-3;
//!     2.0 * (std::f64::consts::TAU * 10.0 * t).cos() + 5.0 * t
//! };
//! let signal: Vec<f64> = (0..1000).map(row).collect();
//! let block = fit_block(&signal, 0, 1000, 1e-3, &[10.0], ToneFit::default()).expect("enough rows");
//! assert!((block.phasors[0].norm() - 2.0).abs() < 1e-9, "the drift is no part of it");
//! ```
#![forbid(unsafe_code)]

pub mod analogue;
pub mod bare_fft;
pub mod base;
mod bootstrap;
pub mod candidate_model;
mod candidate_order;
pub mod delay;
mod delay_parameters;
mod error;
pub mod excitation;
pub mod experiment;
pub mod feedback;
pub mod foreign;
pub mod frequency_response;
pub mod from_response;
pub mod identifiability;
mod identified_parameter;
pub mod late_commands;
pub mod least_squares;
pub mod noise;
pub mod order_selection;
pub mod rational;
mod rest;
pub mod sampled;
mod segments;
pub mod spectral;
pub mod summary;
pub mod tone_fit;

pub use error::IdentError;
