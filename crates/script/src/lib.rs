//! Setpoint scripts.
#![forbid(unsafe_code)]
