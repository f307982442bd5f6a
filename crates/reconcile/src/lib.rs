//! Finds where simulation and measurement disagree, and names what is missing.
#![forbid(unsafe_code)]
