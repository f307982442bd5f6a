//! Camera and Actuator traits, drivers, and the emulated rig.
#![forbid(unsafe_code)]
