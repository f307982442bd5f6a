//! Run folders: append-only columns while running, read back, export.
#![forbid(unsafe_code)]
