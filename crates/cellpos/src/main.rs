//! The `cellpos` program; everything it does is in the library of this crate.
#![forbid(unsafe_code)]

fn main() -> std::process::ExitCode {
    cellpos::main()
}
