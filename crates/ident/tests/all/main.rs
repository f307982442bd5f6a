//! Identification from records.

mod closed_loop;
mod common;
mod frequency_response;
mod measured_piezo;
mod slow_actuator;
mod straying;
