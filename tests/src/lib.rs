//! Whole-system tests: what they share.
#![forbid(unsafe_code)]

pub mod programs;
pub mod truth;
