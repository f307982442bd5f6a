//! The program, run as a user runs it.

mod arguments;
mod bead_loss;
mod cell;
mod circle;
mod common;
mod design;
mod error_at_exposure;
mod identify;
mod identify_rig;
mod keeping;
mod kinds_of_runs;
mod newcomer;
mod other_plants;
mod queue;
mod replay;
mod schemas;
mod screen;
mod script_faults;
mod script_runs;
mod scripts;
mod scripts_resumed;
mod signals;
mod terminal;
mod track;
mod vision;
mod wrong_pixel;
