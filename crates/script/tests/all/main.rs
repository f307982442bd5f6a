//! Scripts, their cycles and their tables.

mod common;
mod fatigue;
mod mutants;
mod night;
mod scripts;
