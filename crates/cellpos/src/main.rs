//! The `cellpos` program.
#![forbid(unsafe_code)]

fn main() {}
