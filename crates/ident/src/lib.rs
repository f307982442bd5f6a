//! Excitation, frequency response, delay, and model fit with confidence intervals.
#![forbid(unsafe_code)]
