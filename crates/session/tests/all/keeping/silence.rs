//! Moments in which the loop cannot act, compared with the best that anything could do in them.

use super::held::{EVENT_S, Row, ticks};
use cellpos_runtime::TickRecord;
use cellpos_session::rig_file::Frames;

/// From a command to the fix that shows its effect, and two ticks, s.
const ANSWER_S: f64 = 5e-3;

/// Largest true distance from the target up to a time, um.
fn furthest_um(ticks: &[TickRecord], until_s: f64) -> f64 {
    let within = |t: &&TickRecord| {
        let at_s = t.time_ns as f64 * 1e-9;
        (EVENT_S - 0.05..=until_s).contains(&at_s)
    };
    let off_um = |t: &TickRecord| (t.true_um - t.target_um).abs();
    ticks.iter().filter(within).map(off_um).fold(0.0, f64::max)
}

/// Furthest true distance of a bead whose line is silent for a time, and that of the same bead, with the same noise, whose PZT stands at
/// the zero flow meanwhile, um.
pub(super) fn silent_um(law: &'static str, seed: u64, for_s: f64) -> [f64; 2] {
    let row = |kind, for_s| Row {
        seconds: EVENT_S + for_s + 0.3,
        frames: Frames::Off,
        ..Row::event(law, kind, for_s)
    };
    let silent = ticks(&row("link-loss", for_s), seed);
    // It stands for longer than it is looked at: what a loop that was not obeyed does afterwards is no measure.
    let stands = ticks(&row("hold-zero-flow", for_s + 0.1), seed);
    // The bead goes two ways from the first tick on in which the line was silent.
    let mut both = silent.iter().zip(&stands);
    let parted = both.find(|(a, b)| a.is_running() && a.true_um != b.true_um);
    let began_s = parted.expect("two ways").0.time_ns as f64 * 1e-9;
    assert!(
        (began_s - EVENT_S).abs() < 0.05,
        "{law}: they part at {began_s} s"
    );
    [
        furthest_um(&silent, f64::INFINITY),
        furthest_um(&stands, began_s + for_s + ANSWER_S),
    ]
}

/// Square of the error of the estimate over its stated variance at the end of a time without a fix that begins so long after the rig was
/// switched on.
pub(super) fn squared_error(law: &'static str, seed: u64, at_s: f64, unseen_s: f64) -> f64 {
    let row = Row {
        at_s,
        seconds: at_s + unseen_s,
        lost_s: 100.0,
        frames: Frames::Off,
        ..Row::event(law, "drop-frames", unseen_s + 1.0)
    };
    let ticks = ticks(&row, seed);
    let last = ticks.last().expect("a tick");
    assert!(last.is_running() && last.measured_um.is_nan(), "{row}");
    ((last.true_um - last.estimate_um) / last.estimate_sd_um).powi(2)
}
