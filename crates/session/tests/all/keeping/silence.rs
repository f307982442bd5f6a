//! Moments in which the loop cannot act, compared with the best that anything could do in them.

use super::held::{EVENT_S, Row, ticks};
use cellpos_runtime::TickRecord;
use cellpos_session::rig_file::Frames;

/// From a command to the fix that shows its effect, and two ticks, s.
const ANSWER_S: f64 = 5e-3;
/// From the beginning of a silence on until the board holds zero flow, and the plant has come to rest, s.
const HOLDS_S: f64 = 0.04;
/// Flow for a PZT that stands 1 um off zero flow, Eq. (6), 1/s.
const STEADY_GAIN_PER_S: f64 = 428.1;

/// Largest true distance from the target up to a time, um.
fn furthest_um(ticks: &[TickRecord], until_s: f64) -> f64 {
    let within = |t: &&TickRecord| {
        let at_s = t.time_ns as f64 * 1e-9;
        (EVENT_S - 0.05..=until_s).contains(&at_s)
    };
    let off_um = |t: &TickRecord| (t.true_um - t.target_um).abs();
    ticks.iter().filter(within).map(off_um).fold(0.0, f64::max)
}

/// A silence of the line beside a PZT that stands at the true zero flow meanwhile: the same bead with the same noise.
pub(super) struct Silence {
    /// By how much more the bead went from its target, um.
    pub more_um: f64,
    /// Mean distance of the PZT from the true zero flow while its board held, um.
    pub off_um: f64,
}

/// A silence of a time, s. The bead must have been held for long before.
pub(super) fn silence(law: &'static str, seed: u64, for_s: f64) -> Silence {
    let row = |kind, for_s| Row {
        seconds: EVENT_S + for_s + 0.3,
        frames: Frames::Off,
        ..Row::event(law, kind, for_s)
    };
    let silent = ticks(&row("link-loss", for_s), seed);
    // It stands for longer than it is looked at: what a loop that was not obeyed does afterwards is no measure.
    let stands = ticks(&row("hold-zero-flow", for_s + 0.1), seed);
    let both = || silent.iter().zip(&stands);
    // The bead goes two ways from the first tick on in which the line was silent.
    let parted = both().find(|(a, b)| a.is_running() && a.true_um != b.true_um);
    let began_s = parted.expect("two ways").0.time_ns as f64 * 1e-9;
    assert!(
        (began_s - EVENT_S).abs() < 0.05,
        "{law}: they part at {began_s} s"
    );
    let apart_um = |after_s: f64| {
        let until = ((began_s + after_s) * 1e9) as i64;
        let last = both().take_while(|(a, _)| a.time_ns <= until).last();
        last.map_or(f64::NAN, |(a, b)| a.true_um - b.true_um)
    };
    let held_s = for_s - HOLDS_S;
    let stands_um = furthest_um(&stands, began_s + for_s + ANSWER_S);
    Silence {
        more_um: furthest_um(&silent, f64::INFINITY) - stands_um,
        off_um: (apart_um(for_s) - apart_um(HOLDS_S)) / (STEADY_GAIN_PER_S * held_s),
    }
}

/// Root of the mean square by which a PZT that holds for a time is off the zero flow at least, on the rig of the table, um.
pub(super) fn least_off_um(for_s: f64) -> f64 {
    // Walk of a bead, 0.33 um^2/s, and of the zero flow: 6 nm about its mean within 20 s. A fix that is exact adds nothing to it.
    let walk_um2_per_s: f64 = 2.0 * 0.33;
    let flow_um2_per_s: f64 = 2.0 * 6e-3_f64.powi(2) / 20.0;
    // Kalman and Bucy: dP/dt = flow - (gain P)^2 / walk, from the approach on.
    let answer_per_s = STEADY_GAIN_PER_S * (flow_um2_per_s / walk_um2_per_s).sqrt();
    let watched = answer_per_s * (EVENT_S - 0.2);
    let known_um2 = flow_um2_per_s / (answer_per_s * watched.tanh());
    // What cannot be learnt in that time of a drift of 1 nm/s, and the walk of the zero flow while it cannot be seen.
    let lag_um = 1e-3 / answer_per_s * (1.0 - (-watched).exp());
    (known_um2 + lag_um * lag_um + flow_um2_per_s * for_s / 3.0).sqrt()
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
