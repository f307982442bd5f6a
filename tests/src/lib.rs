//! Whole-system tests.
#![forbid(unsafe_code)]

pub mod truth;
