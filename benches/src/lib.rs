//! Benchmarks with conditions and competitors.
#![forbid(unsafe_code)]
