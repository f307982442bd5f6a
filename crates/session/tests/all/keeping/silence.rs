//! Moments in which the loop cannot act.

use super::held::{EVENT_S, Row, ticks};
use cellpos_session::rig_file::Frames;

/// Square of the error of the estimate over its stated variance at the end of a time without a fix.
pub(super) fn squared_error(law: &'static str, seed: u64, unseen_s: f64) -> f64 {
    let row = Row {
        seconds: EVENT_S + unseen_s,
        lost_s: 100.0,
        frames: Frames::Off,
        ..Row::event(law, "drop-frames", unseen_s + 1.0)
    };
    let ticks = ticks(&row, seed);
    let last = ticks.last().expect("a tick");
    assert!(last.is_running() && last.measured_um.is_nan(), "{row}");
    ((last.true_um - last.estimate_um) / last.estimate_sd_um).powi(2)
}
