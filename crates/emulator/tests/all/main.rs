//! The emulated rig.

mod background;
mod cell;
mod imperfections;
mod rig_in_a_box;
mod scene;
mod scene_camera;
mod suggested;
mod world;
mod world_faults;
