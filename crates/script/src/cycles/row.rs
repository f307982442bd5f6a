//! One row of the per-cycle table, as text and back.

use crate::plan::ArmKind;

/// The disturbances of a cycle, as bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct CycleFlags(pub u32);

/// Names of the bits, in order.
const NAMES: [&str; 19] = [
    "lost",
    "stale",
    "dropped",
    "coasted",
    "frozen",
    "saturated",
    "late",
    "skipped-ticks",
    "records-lost",
    "skipped",
    "solver-fallback",
    "gated",
    "safe",
    "waited",
    "paused",
    "stuck",
    "outlier",
    "ramp",
    "disturbed",
];

impl CycleFlags {
    /// Frames without a valid position.
    pub const LOST: u32 = 1;
    /// Stale or repeated frames.
    pub const STALE: u32 = 1 << 1;
    /// Frames missing.
    pub const DROPPED: u32 = 1 << 2;
    /// Ticks on prediction alone.
    pub const COASTED: u32 = 1 << 3;
    /// The bead was frozen: by the operator, or because it was not seen for too long.
    pub const FROZEN: u32 = 1 << 4;
    /// Commands clipped to range or slew.
    pub const SATURATED: u32 = 1 << 5;
    /// Commands handed over late.
    pub const LATE: u32 = 1 << 6;
    /// Ticks that never came.
    pub const SKIPPED_TICKS: u32 = 1 << 7;
    /// Records lost on the way to the recorder.
    pub const RECORDS_LOST: u32 = 1 << 8;
    /// The cycle, or the rest of it, was skipped by the operator.
    pub const SKIPPED: u32 = 1 << 9;
    /// The optimiser gave no plan in time.
    pub const SOLVER_FALLBACK: u32 = 1 << 10;
    /// Positions refused as too far from the prediction.
    pub const GATED: u32 = 1 << 11;
    /// Safe was latched.
    pub const SAFE: u32 = 1 << 12;
    /// It contains a wait of the script (not a disturbance, but it took longer).
    pub const WAITED: u32 = 1 << 13;

    /// The operator paused it.
    pub const PAUSED: u32 = 1 << 14;
    /// The bead stuck to a wall.
    pub const STUCK: u32 = 1 << 15;
    /// The error differs much from that of earlier undisturbed cycles with the same stroke and duration: an unreported fault.
    pub const OUTLIER: u32 = 1 << 16;

    /// The amplitude of the script's own wave grew or fell in it (not a disturbance, but not the motion at full amplitude).
    pub const RAMP: u32 = 1 << 17;
    /// An event changed the cycle: see [`CycleFlags::is_disturbed`].
    pub const DISTURBED: u32 = 1 << 18;

    /// Events of any duration that change a cycle: the motion was not that of the script, or not that of the bead.
    const GRAVE: u32 =
        Self::FROZEN | Self::SKIPPED | Self::SAFE | Self::PAUSED | Self::STUCK | Self::OUTLIER;

    /// Share of a cycle's ticks from which one kind of trouble counts as a disturbance. The prediction bridges an occasional lost
    /// frame, which changes a cycle's figures by less than Brownian motion does.
    pub const WORTH_COUNTING: f64 = 0.02;

    /// Whether all bits of `mask` are set.
    pub fn has(self, mask: u32) -> bool {
        self.0 & mask == mask
    }

    pub(crate) fn set(&mut self, mask: u32, when: bool) {
        if when {
            self.0 |= mask;
        }
    }

    /// Whether events changed the cycle: frozen, paused, skipped, in Safe, stuck, an outlier, or one kind of trouble in a
    /// fiftieth of its ticks ([`Self::WORTH_COUNTING`]).
    pub fn is_disturbed(self) -> bool {
        self.0 & (Self::DISTURBED | Self::GRAVE) != 0
    }

    /// Whether the cycle has any unwanted event.
    pub fn is_touched(self) -> bool {
        self.0 & !(Self::WAITED | Self::RAMP) != 0
    }

    /// Sets whether the cycle is disturbed. `worst`: the largest share of its ticks with one kind of trouble.
    pub(super) fn judge(&mut self, worst: f64) {
        self.set(
            Self::DISTURBED,
            self.is_disturbed() || worst >= Self::WORTH_COUNTING,
        );
    }
}

impl std::fmt::Display for CycleFlags {
    /// Names joined by `+`; nothing when nothing happened.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mut first = true;
        for (bit, name) in NAMES.iter().enumerate() {
            if self.0 >> bit & 1 == 1 {
                write!(f, "{}{name}", if first { "" } else { "+" })?;
                first = false;
            }
        }
        Ok(())
    }
}

impl std::str::FromStr for CycleFlags {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        let mut flags = Self::default();
        if text.is_empty() {
            return Ok(flags);
        }
        for word in text.split('+') {
            let bit = NAMES.iter().position(|name| *name == word).ok_or(())?;
            flags.0 |= 1 << bit;
        }
        Ok(flags)
    }
}

/// The figures of one cycle. A missing number is NaN, and an empty cell in the table.
///
/// Each position is compared with the reference at its exposure, so the camera's delay is not in these figures.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CycleRow {
    /// Number, from 0 through the whole script.
    pub cycle: u64,
    /// Session: 1 for the first, one more for each time that the run was resumed.
    pub session: u64,
    /// Its arm.
    pub arm: ArmKind,
    /// Start since the start of the session, s; NaN without a record.
    pub start_s: f64,
    /// Start by the plan, s.
    pub plan_s: f64,
    /// Duration by the plan, s.
    pub duration_s: f64,
    /// Its recorded ticks.
    pub ticks: u64,
    /// Ticks with a valid position.
    pub seen: u64,
    /// Frames without a valid position, and ticks without a frame.
    pub lost: u64,
    /// Ticks on prediction alone.
    pub coasted: u64,
    /// Ticks with the command at range or slew limit.
    pub saturated: u64,
    /// Ticks frozen.
    pub frozen: u64,
    /// Ticks in which the optimiser gave no plan in time.
    pub solver_fallbacks: u64,
    /// Half of peak to peak of the reference, um.
    pub stroke_um: f64,
    /// Commanded amplitude at the cycle's frequency, um.
    pub commanded_um: f64,
    /// Reached amplitude at the cycle's frequency, um.
    pub reached_um: f64,
    /// Lag of the bead behind the reference, degrees of a cycle.
    pub lag_deg: f64,
    /// Mean of position minus reference, um.
    pub bias_um: f64,
    /// RMS of position minus reference, um.
    pub rms_um: f64,
    /// Largest distance of position from reference, um.
    pub peak_um: f64,
    /// Change of position minus reference over the cycle per time, um/s.
    pub drift_um_per_s: f64,
    /// Mean of the estimated displacement at which the bead rests, um.
    pub neutral_um: f64,
    /// Bead speed per PZT displacement away from neutral, as measured, 1/s.
    pub gain_per_s: f64,
    /// Time that the bead spent within a tenth of the stroke of the far end, s.
    pub dwell_s: f64,
    /// Length of the cell at the start, um.
    pub length_start_um: f64,
    /// Length of the cell after a quarter of the cycle, um.
    pub length_quarter_um: f64,
    /// Length of the cell after half of the cycle, um.
    pub length_half_um: f64,
    /// Length of the cell after three quarters of the cycle, um.
    pub length_three_quarters_um: f64,
    /// Largest length of the cell, um.
    pub length_peak_um: f64,
    /// Length of the cell at the end, um.
    pub length_end_um: f64,
    /// Time constant of the recovery of the cell's length after its largest, s.
    pub recovery_s: f64,
    /// Projected area of the cell at the start, um^2.
    pub area_start_um2: f64,
    /// Projected area of the cell after a quarter of the cycle, um^2.
    pub area_quarter_um2: f64,
    /// Projected area of the cell after half of the cycle, um^2.
    pub area_half_um2: f64,
    /// Projected area of the cell after three quarters of the cycle, um^2.
    pub area_three_quarters_um2: f64,
    /// Largest projected area of the cell, um^2.
    pub area_peak_um2: f64,
    /// Projected area of the cell at the end, um^2.
    pub area_end_um2: f64,
    /// Mean length of the cell at rest at the cycle's first position, before the cycle, um.
    pub length_rest_um: f64,
    /// Standard deviation of that mean, um.
    pub length_rest_sd_um: f64,
    /// Mean projected area of the cell at rest, um^2.
    pub area_rest_um2: f64,
    /// Standard deviation of that mean, um^2.
    pub area_rest_sd_um2: f64,
    /// What disturbed it.
    pub flags: CycleFlags,
}

/// Columns of the table that hold numbers with a fraction, with access to them.
macro_rules! floats {
    ($($name:ident),*) => {
        pub(super) const FLOATS: &[(&str, fn(&CycleRow) -> f64, fn(&mut CycleRow, f64))] =
            &[$((stringify!($name), |row| row.$name, |row, value| row.$name = value)),*];
    };
}
/// Columns that hold whole numbers.
macro_rules! wholes {
    ($($name:ident),*) => {
        pub(super) const WHOLES: &[(&str, fn(&CycleRow) -> u64, fn(&mut CycleRow, u64))] =
            &[$((stringify!($name), |row| row.$name, |row, value| row.$name = value)),*];
    };
}
wholes!(
    cycle,
    session,
    ticks,
    seen,
    lost,
    coasted,
    saturated,
    frozen,
    solver_fallbacks
);
floats!(
    start_s,
    plan_s,
    duration_s,
    stroke_um,
    commanded_um,
    reached_um,
    lag_deg,
    bias_um,
    rms_um,
    peak_um,
    drift_um_per_s,
    neutral_um,
    gain_per_s,
    dwell_s,
    length_start_um,
    length_quarter_um,
    length_half_um,
    length_three_quarters_um,
    length_peak_um,
    length_end_um,
    recovery_s,
    area_start_um2,
    area_quarter_um2,
    area_half_um2,
    area_three_quarters_um2,
    area_peak_um2,
    area_end_um2,
    length_rest_um,
    length_rest_sd_um,
    area_rest_um2,
    area_rest_sd_um2
);

impl CycleRow {
    /// Error over cycles, um RMS; `None` if no cycle has one.
    pub fn rms_over_um(rows: &[Self]) -> Option<f64> {
        let squares = rows.iter().map(|row| row.rms_um * row.rms_um);
        let (count, sum) = squares
            .filter(|square| square.is_finite())
            .fold((0u64, 0.0), |(count, sum), square| {
                (count + 1, sum + square)
            });
        (count > 0).then(|| (sum / count as f64).sqrt())
    }

    /// A cycle of which nothing is known yet.
    pub fn empty(cycle: u64, session: u64, arm: ArmKind) -> Self {
        let mut row = Self {
            cycle,
            session,
            arm,
            start_s: 0.0,
            plan_s: 0.0,
            duration_s: 0.0,
            ticks: 0,
            seen: 0,
            lost: 0,
            coasted: 0,
            saturated: 0,
            frozen: 0,
            solver_fallbacks: 0,
            stroke_um: 0.0,
            commanded_um: 0.0,
            reached_um: 0.0,
            lag_deg: 0.0,
            bias_um: 0.0,
            rms_um: 0.0,
            peak_um: 0.0,
            drift_um_per_s: 0.0,
            neutral_um: 0.0,
            gain_per_s: 0.0,
            dwell_s: 0.0,
            length_start_um: 0.0,
            length_quarter_um: 0.0,
            length_half_um: 0.0,
            length_three_quarters_um: 0.0,
            length_peak_um: 0.0,
            length_end_um: 0.0,
            recovery_s: 0.0,
            area_start_um2: 0.0,
            area_quarter_um2: 0.0,
            area_half_um2: 0.0,
            area_three_quarters_um2: 0.0,
            area_peak_um2: 0.0,
            area_end_um2: 0.0,
            length_rest_um: 0.0,
            length_rest_sd_um: 0.0,
            area_rest_um2: 0.0,
            area_rest_sd_um2: 0.0,
            flags: CycleFlags::default(),
        };
        for (_, _, set) in FLOATS {
            set(&mut row, f64::NAN);
        }
        row
    }

    /// Whether stroke (um) and duration (s) equal those of another cycle's motion to a hundredth. Both come from places in the
    /// plan, so rounding differs from cycle to cycle.
    pub fn moves_as(&self, (stroke_um, duration_s): (f64, f64)) -> bool {
        let same = |a: f64, b: f64| (a - b).abs() <= 1e-2 * a.abs().max(b.abs()).max(1e-6);
        same(self.stroke_um, stroke_um) && same(self.duration_s, duration_s)
    }

    /// The head of the table.
    pub fn csv_head() -> String {
        let mut names: Vec<&str> = WHOLES.iter().map(|(name, ..)| *name).collect();
        names.insert(2, "arm");
        names.extend(FLOATS.iter().map(|(name, ..)| *name));
        names.push("flags");
        names.join(",")
    }

    /// Names and values of all columns that hold numbers, in the order of the table.
    pub fn numbers(&self) -> Vec<(&'static str, f64)> {
        let wholes = WHOLES
            .iter()
            .map(|(name, get, _)| (*name, get(self) as f64));
        wholes
            .chain(FLOATS.iter().map(|(name, get, _)| (*name, get(self))))
            .collect()
    }

    /// The row as a line of the table, without its end.
    pub fn to_csv(&self) -> String {
        let mut cells: Vec<String> = WHOLES
            .iter()
            .map(|(_, get, _)| get(self).to_string())
            .collect();
        let arm = match self.arm {
            ArmKind::Cyclic => "cyclic",
            ArmKind::Static => "static",
        };
        cells.insert(2, arm.to_owned());
        cells.extend(FLOATS.iter().map(|(_, get, _)| {
            let value = get(self);
            if value.is_finite() {
                format!("{}", round(value))
            } else {
                String::new()
            }
        }));
        cells.push(self.flags.to_string());
        cells.join(",")
    }
}

/// To a thousandth of a nanometre or a nanosecond: more digits would be noise in the file.
fn round(value: f64) -> f64 {
    (value * 1e6).round() / 1e6
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_column_of_the_table_with_a_number_is_among_the_numbers() {
        let row = CycleRow::empty(0, 1, ArmKind::Cyclic);
        let numbers: Vec<&str> = row.numbers().iter().map(|(name, _)| *name).collect();
        let head = CycleRow::csv_head();
        let columns: Vec<&str> = head
            .split(',')
            .filter(|name| !["arm", "flags"].contains(name))
            .collect();
        assert_eq!(numbers, columns);
    }

    #[test]
    fn names_of_quantities_carry_their_unit() {
        for (name, ..) in FLOATS {
            let unit = ["_um", "_um2", "_s", "_deg"]
                .iter()
                .any(|unit| name.ends_with(unit));
            assert!(unit, "{name}");
        }
    }
}
