//! The physical world behind the emulated rig: PZT, chip, bead and rendered camera frames.
#![forbid(unsafe_code)]
