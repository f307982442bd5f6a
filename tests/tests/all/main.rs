//! Whole-system tests, one program: while one waits for a rig in real time, the other core computes.

mod architecture;
mod attacks;
mod book;
mod cell_rig;
mod firmware_qemu;
mod live_page;
mod reconcile;
mod rig_in_a_box;
mod rig_page;
mod rig_prove;
mod scripts;
mod ten_boxes;
