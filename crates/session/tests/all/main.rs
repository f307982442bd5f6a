//! Sessions with a rig.

mod between_runs;
mod common;
mod keeping;
mod multi_rate;
mod rig_defaults;
mod rig_keys;
mod rig_schema;
mod rig_walk;
mod session;
mod still_beads;
