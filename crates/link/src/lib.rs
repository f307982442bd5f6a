//! Wire protocol between the host and the PZT board.
#![forbid(unsafe_code)]
