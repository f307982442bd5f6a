//! The emulated rig.

mod background;
mod cell;
mod imperfections;
mod line;
mod rig_in_a_box;
mod scene;
mod suggested;
mod world;
mod world_faults;
