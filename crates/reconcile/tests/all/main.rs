//! Verdicts on records.

mod closed_loop;
mod closed_loop_table;
mod cut;
mod labelled;
mod measured;
mod measured_piezo;
mod model_error;
mod noise;
mod nulls;
mod same;
mod traits;
mod units;
mod verdicts;
mod waits;
mod zero_flow;
