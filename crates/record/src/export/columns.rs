//! The columns of a run for other programs, with unit and meaning, under the same names in every format.

use cellpos_runtime::{LAW_COLUMNS, TickRecord};

/// A row as it is exported: a tick, the session that it belongs to, and when that began.
#[derive(Debug, Clone, Copy)]
pub struct Row {
    /// The tick.
    pub tick: TickRecord,
    /// Number of the session, from 1.
    pub session: u64,
    /// From the start of the run to the start of the session, ns.
    pub offset_ns: i64,
}

/// Words for the numbers of an enumeration.
pub type Codes = &'static [(u8, &'static str)];

/// What a column holds.
#[derive(Clone, Copy)]
pub enum Value {
    /// Numbers; NaN if missing.
    Number(fn(&Row) -> f64),
    /// Whole numbers.
    Whole(fn(&Row) -> u64),
    /// A word; a number without a word counts as missing.
    Code(Codes, fn(&Row) -> u8),
}

/// A column of an export.
#[derive(Clone, Copy)]
pub struct Column<'a> {
    /// Its name, the same in every form; names of quantities end in their unit.
    pub name: &'a str,
    /// Unit; empty for counts and words.
    pub unit: &'static str,
    /// Meaning, in a sentence.
    pub about: &'static str,
    /// How to read it from a row.
    pub value: Value,
}

impl Column<'_> {
    /// The value of a column that holds numbers; the number of a word otherwise.
    pub fn number(&self, row: &Row) -> f64 {
        match self.value {
            Value::Number(get) => get(row),
            Value::Whole(get) => get(row) as f64,
            Value::Code(codes, get) => match word(codes, get(row)) {
                Some(_) => get(row).into(),
                None => f64::NAN,
            },
        }
    }
}

/// Words and their numbers in a line.
pub(crate) fn listed(codes: Codes) -> String {
    let each: Vec<String> = codes
        .iter()
        .map(|(number, word)| format!("{number} {word}"))
        .collect();
    each.join(", ")
}

/// The word for a number, if it has one.
pub fn word(codes: Codes, number: u8) -> Option<&'static str> {
    codes
        .iter()
        .find(|(other, _)| *other == number)
        .map(|(_, word)| *word)
}

/// Whole nanoseconds in seconds. Dividing gives the number nearest to the decimal fraction; multiplying by 1e-9 does not.
pub(crate) fn seconds(ns: i64) -> f64 {
    ns as f64 / 1e9
}

/// Position of the bead, if it is valid.
pub(crate) fn bead_um(tick: &TickRecord) -> f64 {
    if tick.verdict == 0 {
        tick.measured_um
    } else {
        f64::NAN
    }
}

/// Verdicts of vision.
pub const VERDICT: Codes = &[
    (0, "good"),
    (1, "no-signal"),
    (2, "bad-fit"),
    (3, "at-border"),
    (4, "not-converged"),
];
/// States of the tracker.
pub const TRACK: Codes = &[
    (0, "searching"),
    (1, "tracking"),
    (2, "coasting"),
    (3, "lost"),
];
/// Decisions of the tracker.
pub const DECISION: Codes = &[
    (0, "accepted"),
    (1, "nothing-found"),
    (2, "confirming"),
    (3, "no-signal"),
    (4, "merged"),
    (5, "at-border"),
    (6, "not-converged"),
    (7, "outside-gate"),
    (8, "other-bead"),
    (9, "ambiguous"),
    (10, "regained"),
    (11, "reacquired"),
    (12, "no-frame"),
    (13, "stale"),
    (14, "stays"),
    (15, "in-contact"),
    (16, "near-limit"),
    (17, "passed-over"),
];
/// States of a run.
pub const LIFE: Codes = &[(0, "disarmed"), (1, "armed"), (2, "running"), (3, "safe")];
/// Requests of operator and program.
pub const REQUEST: Codes = &[
    (0, "none"),
    (1, "freeze"),
    (2, "park"),
    (3, "skip"),
    (4, "pause"),
    (5, "unrecorded"),
];
/// States of the board.
pub const BOARD: Codes = &[
    (0, "disarmed"),
    (1, "armed"),
    (2, "running"),
    (3, "frozen"),
    (4, "safe"),
    (5, "holding"),
];
/// Faults that the board latches.
pub const BOARD_FAULT: Codes = &[
    (0, "none"),
    (1, "command-timeout"),
    (2, "freeze-timeout"),
    (3, "arm-timeout"),
    (4, "device"),
];
/// Stages of a script.
pub const STAGE: Codes = &[
    (0, "none"),
    (1, "approach"),
    (2, "running"),
    (3, "waiting"),
    (4, "paused"),
    (5, "done"),
    (10, "stopped-lost"),
    (11, "stopped-error"),
    (12, "stopped-length"),
    (13, "stopped-time"),
    (14, "stopped-cycles"),
    (15, "stopped-wait"),
];
/// Result of the optimiser.
pub const SOLVER: Codes = &[
    (0, "not-used"),
    (1, "solved"),
    (2, "previous-plan"),
    (3, "fallback-pi"),
];

macro_rules! columns {
    ($($name:literal $unit:literal $value:expr, $about:literal;)*) => {
        /// Every column, in order.
        pub const COLUMNS: &[Column<'static>] = &[$(Column {
            name: $name,
            unit: $unit,
            about: $about,
            value: $value,
        },)*];
    };
}

use Value::{Code, Number, Whole};

columns! {
    "time_s" "s" Number(|r| seconds(r.offset_ns.saturating_add(r.tick.time_ns))),
        "Start of the tick since the start of the run, pauses between sessions included.";
    "pzt_um" "um" Number(|r| r.tick.command_um),
        "Commanded PZT displacement, held from time_s until the next row.";
    "bead_um" "um" Number(|r| bead_um(&r.tick)),
        "Measured position at mid_exposure_s; none without a bead.";
    "error_um" "um" Number(|r| r.tick.error_um),
        "bead_um minus the reference at mid_exposure_s.";
    "seq" "" Whole(|r| r.tick.seq),
        "Number of the tick in its session, lost rows counted.";
    "frame_id" "" Whole(|r| r.tick.frame_id),
        "Number of the newest frame, unwrapped.";
    "mid_exposure_s" "s" Number(|r| seconds(r.offset_ns.saturating_add(r.tick.mid_exposure_ns))),
        "Middle of that frame's exposure, on the clock of time_s.";
    "sigma_um" "um" Number(|r| r.tick.variance_um2.sqrt()),
        "Standard deviation of bead_um as vision states it.";
    "target_um" "um" Number(|r| r.tick.target_um),
        "Reference at the tick.";
    "estimate_um" "um" Number(|r| r.tick.estimate_um),
        "Estimated position at the tick.";
    "estimate_sd_um" "um" Number(|r| r.tick.estimate_sd_um),
        "Standard deviation of the estimate; it grows while the bead is not seen.";
    "neutral_um" "um" Number(|r| r.tick.neutral_um),
        "Estimated zero-flow displacement.";
    "requested_um" "um" Number(|r| r.tick.requested_um),
        "Output of the controller before range and slew limits.";
    "applied_um" "um" Number(|r| r.tick.applied_um),
        "PZT displacement that the board last reported.";
    "true_um" "um" Number(|r| r.tick.true_um),
        "True position of the bead at the tick; emulated rig only.";
    "verdict" "" Code(VERDICT, |r| r.tick.verdict),
        "Judgement of vision; none without a frame.";
    "life" "" Code(LIFE, |r| r.tick.life),
        "State of the run's life cycle.";
    "request" "" Code(REQUEST, |r| r.tick.request),
        "Request of operator or program.";
    "board" "" Code(BOARD, |r| r.tick.board),
        "State that the board last reported.";
    "board_fault" "" Code(BOARD_FAULT, |r| r.tick.board_fault),
        "Fault that the board last reported.";
    "flags" "" Whole(|r| r.tick.flags.0.into()),
        "Events of the tick, as bits.";
    "drained" "" Whole(|r| r.tick.drained.into()),
        "Positions that waited at this tick; the newest is used.";
    "wake_us" "us" Number(|r| f64::from(r.tick.wake_ns) / 1e3),
        "From the arrival of the position, or the due time, to the start of the tick; 0 on the virtual clock.";
    "compute_us" "us" Number(|r| f64::from(r.tick.compute_ns) / 1e3),
        "From the start of the tick to the hand-over of the command; 0 on the virtual clock.";
    "obeyed_before_us" "us" Number(|r| r.tick.obeyed_before_us),
        "Age of the slowest command that the board has reported since the last tick.";
    "obeyed_at_us" "us" Number(|r| r.tick.obeyed_at_us),
        "Clock of the board when it had that command.";
    "track" "" Code(TRACK, |r| r.tick.track),
        "State of the tracker; none without a frame or a tracker.";
    "decision" "" Code(DECISION, |r| r.tick.decision),
        "Decision of the tracker; none without a frame or a tracker.";
    "plan_s" "s" Number(|r| if r.tick.plan_ns < 0 { f64::NAN } else { seconds(r.tick.plan_ns) }),
        "Time of the script's plan, which stops during waits and pauses.";
    "stage" "" Code(STAGE, |r| r.tick.stage),
        "Stage of the script.";
    "length_um" "um" Number(|r| r.tick.length_um),
        "Length of the cell along the channel.";
    "area_um2" "um2" Number(|r| r.tick.area_um2),
        "Projected area of the cell.";
    "length_sd_um" "um" Number(|r| r.tick.length_sd_um),
        "Standard deviation of the length, pixel size not included.";
    "area_sd_um2" "um2" Number(|r| r.tick.area_sd_um2),
        "Standard deviation of the area, pixel size not included.";
    "measured_um" "um" Number(|r| r.tick.measured_um),
        "Position from vision, whatever the verdict.";
    "solver_status" "" Code(SOLVER, |r| r.tick.solver_status),
        "Result of the optimiser.";
    "solver_iterations" "" Whole(|r| r.tick.solver_iterations.into()),
        "Iterations of the optimiser, at most 255.";
    "solver_active" "" Whole(|r| r.tick.solver_active.into()),
        "Active constraints at the solution, at most 255.";
    "solver_us" "us" Number(|r| f64::from(r.tick.solver_ns) / 1e3),
        "Time of the optimiser; 0 on the virtual clock.";
    "partner_command_um" "um" Number(|r| r.tick.partner_command_um),
        "Slow actuator: command on its own scale.";
    "partner_applied_um" "um" Number(|r| r.tick.partner_applied_um),
        "Slow actuator: reported position.";
    "partner_effect_um" "um" Number(|r| r.tick.partner_effect_um),
        "Slow actuator: effect, as PZT displacement.";
    "partner" "" Code(BOARD, |r| r.tick.partner),
        "Slow actuator: reported state.";
    "session" "" Whole(|r| r.session),
        "Session: 1, one more per resume.";
}

fn law<const INDEX: usize>(row: &Row) -> f64 {
    row.tick.law.get(INDEX).map_or(f64::NAN, |v| f64::from(*v))
}

/// The values of a control law's columns, by their place in a row.
const LAW: [fn(&Row) -> f64; LAW_COLUMNS] = [
    law::<0>, law::<1>, law::<2>, law::<3>, law::<4>, law::<5>, law::<6>, law::<7>,
];

/// Meaning of the columns of cellpos's laws and their adaptation. Only a foreign law knows its columns.
pub const OF_LAWS: &[(&str, &str)] = &[
    ("pi_integral_um", "Integral part of PI."),
    ("pi_lead_um", "State of the lead."),
    ("lqg_feed_forward_um", "Feed-forward of LQG."),
    ("mpc_feed_forward_um", "Feed-forward of MPC."),
    (
        "mpc_fallback_integral_um",
        "Integral part of the PI that replaces MPC.",
    ),
    (
        "adapt_gain",
        "Gain of the plant that the law is tuned to, over the model's.",
    ),
    (
        "adapt_delay_samples",
        "Delay that the law is tuned to, less the model's, in samples.",
    ),
    (
        "adapt_gain_estimate",
        "Estimated gain of the plant, over the model's.",
    ),
    ("adapt_gain_sd", "Standard deviation of the estimated gain."),
    (
        "adapt_mode",
        "What is known of the plant: 0 learning, 1 known, 2 uncertain (on its way to the estimate), 3 at the end of its range.",
    ),
    (
        "adapt_dither_um",
        "Dither in the command: the random motion by which gain and delay are known.",
    ),
];

/// Columns of the control law, in the order of their names in the metadata, at most as many as fit into a row.
pub fn of_law(names: &[String]) -> Vec<Column<'_>> {
    let unit = |name: &str| {
        let units = ["um", "s", "us", "hz", "deg"];
        let end = name.rsplit('_').next().unwrap_or("");
        units.into_iter().find(|unit| *unit == end).unwrap_or("")
    };
    let about = |name: &str| {
        let known = OF_LAWS.iter().find(|(known, _)| *known == name);
        known.map_or("Of the control law's own.", |(_, about)| about)
    };
    names
        .iter()
        .zip(LAW)
        .map(|(name, get)| Column {
            name,
            unit: unit(name),
            about: about(name),
            value: Value::Number(get),
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_runtime::{Life, Request, Stage};

    #[test]
    fn the_words_are_those_of_the_program() {
        for (number, word) in LIFE {
            assert_eq!(Life::from_number(*number).map(Life::name), Some(*word));
        }
        for (number, word) in REQUEST {
            let json = serde_json::to_string(&Request::from_number(*number)).unwrap();
            assert_eq!(json, format!("\"{word}\""));
        }
        for (number, word) in STAGE {
            let json = serde_json::to_string(&Stage::from_number(*number)).unwrap();
            assert_eq!(json, format!("\"{word}\""));
        }
    }

    #[test]
    fn names_are_unique_and_end_in_their_unit() {
        for column in COLUMNS {
            let same = COLUMNS.iter().filter(|other| other.name == column.name);
            assert_eq!(same.count(), 1, "{}", column.name);
            if !column.unit.is_empty() {
                assert!(column.name.ends_with(&format!("_{}", column.unit)));
            }
            assert!(column.about.ends_with('.'), "{}", column.about);
        }
    }
}
