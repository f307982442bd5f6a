//! Closed-loop cell positioner for a PZT-driven PDMS microchannel.
#![forbid(unsafe_code)]
