//! Sessions with a rig.

mod between_runs;
mod rig_keys;
mod session;
