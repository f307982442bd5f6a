//! The keys of `[board]` and `[emulator]` that may have a unit.

use cellpos_plant::quantities::Quantity;

const fn board(plain: &'static str, with_unit: &'static str) -> Quantity {
    Quantity::new("board", plain, with_unit)
}

const fn world(plain: &'static str, with_unit: &'static str) -> Quantity {
    Quantity::new("emulator", plain, with_unit)
}

const fn cell(plain: &'static str, with_unit: &'static str) -> Quantity {
    Quantity::new("emulator.cell", plain, with_unit)
}

/// Every length, speed, time and frequency of the tables of [`crate::BoardConfig`] and [`crate::WorldConfig`] in a rig file.
pub const QUANTITIES: [Quantity; 42] = [
    board("low", "low_um"),
    board("high", "high_um"),
    board("slew", "slew_um_per_s"),
    board("ramp", "ramp_um_per_s"),
    board("power_up", "power_up_um"),
    board("park", "park_um"),
    board("update", "update_us"),
    board("watchdog", "watchdog_ms"),
    board("hold_watchdog", "hold_watchdog_ms"),
    board("longest_watchdog", "longest_watchdog_ms"),
    board("late", "late_us"),
    world("neutral", "neutral_um"),
    world("drift", "drift_um_per_s"),
    world("zero_flow_wander", "zero_flow_wander_um"),
    world("zero_flow_wander_time", "zero_flow_wander_time_s"),
    world("zero_flow_drift", "zero_flow_drift_um_per_s"),
    world("start", "start_um"),
    world("lateral", "lateral_um"),
    world("tilt", "tilt_deg"),
    world("focus_time", "focus_time_s"),
    world("exposure_jitter", "exposure_jitter_us"),
    world("arrival_jitter", "arrival_jitter_us"),
    world("pixel", "pixel_um"),
    world("rate", "rate_hz"),
    world("exposure", "exposure_ms"),
    world("latency", "latency_ms"),
    world("bead_radius", "bead_radius_um"),
    world("localisation", "localisation_um"),
    world("new_bead_after", "new_bead_after_ms"),
    cell("entry", "entry_um"),
    cell("mouth", "mouth_um"),
    cell("rest", "rest_um"),
    cell("loading", "loading_s"),
    cell("recovery_first", "recovery_first_s"),
    cell("recovery_last", "recovery_last_s"),
    cell("focus", "focus_um"),
    cell("noise", "noise_um"),
    Quantity::new("emulator.faults", "second_bead", "second_bead_um"),
    Quantity::new("emulator.faults", "flow_step", "flow_step_um"),
    Quantity::new("emulator.faults", "clip", "clip_um"),
    Quantity::new("emulator.faults.event", "at", "at_s"),
    Quantity::new("emulator.faults.event", "for", "for_s"),
];
