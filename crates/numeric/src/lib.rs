//! Numerical tools shared by all crates: [`units`], seeded random numbers, order [`statistics`], distributions, the [`fft`],
//! the [`golden_section`], and a [`parallel`] map.
//!
//! Each tool exists only here, so that two crates cannot disagree about the meaning of a quantile or a seed. This is not a statistics
//! library: distribution functions come from `statrs`.
//!
//! ```
//! use cellpos_numeric::{Random, statistics};
//! let mut random = Random::new(7);
//! let sample: Vec<f64> = (0..1000).map(|_| random.normal()).collect();
//! assert!(statistics::median(&sample).abs() < 0.2);
//! ```
#![forbid(unsafe_code)]

pub mod fft;
mod golden_section;
pub mod parallel;
mod random;
pub mod statistics;
pub mod units;

pub use golden_section::golden_section;
pub use random::Random;
