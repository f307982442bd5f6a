//! Verdicts on records.

mod labelled;
mod measured;
mod measured_piezo;
mod noise;
mod nulls;
mod traits;
mod units;
mod verdicts;
mod waits;
mod zero_flow;
