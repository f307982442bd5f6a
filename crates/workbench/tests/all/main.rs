//! The bench's conformance tests against boards that keep the protocol and boards that do not.

mod board_line;
mod prove_board;
