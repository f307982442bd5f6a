//! Arithmetic that several crates share: seeded random numbers, order statistics, distributions.
//!
//! Each exists once here, so that two crates cannot disagree about the meaning of a quantile or a seed. It is not a
//! statistics library: distribution functions come from `statrs`.
//!
//! ```
//! use cellpos_numeric::{Random, statistics};
//! let mut random = Random::new(7);
//! let sample: Vec<f64> = (0..1000).map(|_| random.normal()).collect();
//! assert!(statistics::median(&sample).abs() < 0.2);
//! ```
#![forbid(unsafe_code)]

mod random;
pub mod statistics;

pub use random::Random;
