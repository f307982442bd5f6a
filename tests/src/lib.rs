//! Whole-system tests: shared code.
#![forbid(unsafe_code)]

pub mod attack;
pub mod browser;
pub mod programs;
pub mod truth;
