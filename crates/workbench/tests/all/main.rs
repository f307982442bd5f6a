//! Work at the bench and experiments on the emulated rig.

mod board_line;
mod lost_bead;
mod pair;
mod prove_board;
