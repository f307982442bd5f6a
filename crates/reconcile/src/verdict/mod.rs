//! What may be said of the set that was found: held-out check, names, verdict, the augmented model.

mod assemble;
mod augment;
pub(crate) mod battery;
mod counted;
mod curve;
pub(crate) mod guard;
mod held_out;
mod hidden;
pub(crate) mod judge;
mod jumps;
mod late_frames;
pub(crate) mod map;
mod names;
mod parameters;
mod profile;
mod proposal;
pub(crate) mod response;
pub(crate) mod result;
mod searching;
mod sentences;
mod shapes;
mod significance;
mod split;
mod tell;
mod unlike;
mod wandering;
pub(crate) mod workflow;
