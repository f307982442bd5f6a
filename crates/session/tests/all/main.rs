//! Sessions with a rig.

mod rig_keys;
mod session;
