//! Controllers, estimators, references, output limits and loop design.
#![forbid(unsafe_code)]
