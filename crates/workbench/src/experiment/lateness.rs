//! Commands that were handed over late: how late, and the positions as they would be if every command had been on time.
//!
//! A command that is late by part of a row moves the bead less by that part of its step, for good. The rows themselves tell the gain and the
//! delay with which commands move the bead, so nothing has to be known of the rig. Moving the commands within the band of the rows instead
//! would be wrong where lateness follows the excitation: steps hold frequencies beyond that band.

use cellpos_runtime::{TickFlags, TickRecord};

pub(crate) fn is_new_frame(tick: &TickRecord) -> bool {
    !tick.flags.has(TickFlags::TIMER) && !tick.flags.has(TickFlags::STALE)
}

pub(crate) fn with_new_frame(ticks: &[TickRecord]) -> impl Iterator<Item = &TickRecord> {
    ticks.iter().filter(|tick| is_new_frame(tick))
}

/// How old a tick's frame is, by its own stamp, ns.
pub(crate) fn age_ns(tick: &TickRecord) -> i64 {
    tick.time_ns - tick.mid_exposure_ns
}

/// The median, which a stall does not shift; `None` of an empty list.
pub(crate) fn median(values: impl Iterator<Item = i64>) -> Option<i64> {
    let mut values: Vec<i64> = values.collect();
    values.sort_unstable();
    values.get(values.len() / 2).copied()
}

/// How much later than usual the command of each tick was handed over, ns. Usual is counted from the exposure of the newest frame, as the
/// median of a second, in which clocks drift by a negligible amount. `None` before the first frame.
pub(crate) fn lateness_ns(ticks: &[TickRecord], period_ns: i64) -> Vec<Option<i64>> {
    const SECOND: usize = 1000;
    let handed_over_ns = |tick: &TickRecord| age_ns(tick) + i64::from(tick.compute_ns);
    let mut late_ns = Vec::with_capacity(ticks.len());
    // When the command of the newest frame was due, and that frame's tick.
    let mut due = None;
    for (second, ticks) in ticks.chunks(SECOND).enumerate() {
        let usual_ns = median(with_new_frame(ticks).map(handed_over_ns)).unwrap_or(0);
        for (tick, index) in ticks.iter().zip(SECOND * second..) {
            let came_ns = tick.time_ns + i64::from(tick.compute_ns);
            if is_new_frame(tick) {
                due = Some((tick.mid_exposure_ns + usual_ns, index));
            }
            late_ns
                .push(due.map(|(due_ns, of)| came_ns - due_ns - (index - of) as i64 * period_ns));
        }
    }
    late_ns
}

/// Upper limit of the delay from a command to its effect, in periods: at 1 kHz over USB or a serial line, with the lateness of a tick
/// included.
const LINE_PERIODS: f64 = 1.0;

/// A bead that goes with the speed of the command, some time later.
#[derive(Debug, Clone, Copy)]
struct Motion {
    /// Motion in a row over the command.
    gain: f64,
    /// From a row's command to the first motion, in rows.
    delay: f64,
}

impl Motion {
    /// The motion that fits best to rows whose commands were on time and whose frames are so many rows old. `None` if the commands do not
    /// vary, or too few rows are left.
    fn of(command_um: &[f64], position_um: &[f64], late: &[bool], age: f64) -> Option<Self> {
        /// Delays are tried in steps of this part of a row.
        const STEP: f64 = 0.01;
        let reach = (age + LINE_PERIODS) as usize + 1;
        let increments: Vec<(usize, f64)> = (reach..position_um.len().saturating_sub(1))
            .filter(|&row| !late[row - reach..=row].contains(&true))
            .map(|row| (row, position_um[row + 1] - position_um[row]))
            .filter(|(_, um)| um.is_finite())
            .collect();
        let rows = increments.len() as f64;
        let y: f64 = increments.iter().map(|(_, um)| um).sum();
        let yy: f64 = increments.iter().map(|(_, um)| um * um).sum();
        // A delay between two rows mixes their commands, so that the sums of all delays follow from those of the rows.
        let sums = |whole: usize| {
            let mut sums = [0.0; 7];
            for &(row, um) in &increments {
                let (a, b) = (command_um[row - whole], command_um[row - whole - 1]);
                let parts = [a, b, a * a, a * b, b * b, a * um, b * um];
                sums.iter_mut()
                    .zip(parts)
                    .for_each(|(sum, part)| *sum += part);
            }
            sums
        };
        let mut of_rows = (usize::MAX, [0.0; 7]);
        let of_delay = |delay: f64| {
            let (whole, p) = (delay.floor() as usize, delay.fract());
            if of_rows.0 != whole {
                of_rows = (whole, sums(whole));
            }
            let ([a, b, aa, ab, bb, ay, by], q) = (of_rows.1, 1.0 - p);
            let u = q * a + p * b;
            let variance = q * q * aa + 2.0 * p * q * ab + p * p * bb - u * u / rows;
            let shared = q * ay + p * by - u * y / rows;
            let gain = shared / variance;
            (Self { gain, delay }, yy - y * y / rows - gain * shared)
        };
        (0..)
            .map(|i| age + STEP * f64::from(i))
            .take_while(|delay| *delay < age + LINE_PERIODS)
            .map(of_delay)
            .filter(|(motion, left)| motion.gain.is_finite() && left.is_finite())
            .min_by(|(_, left), (_, other)| left.total_cmp(other))
            .map(|(motion, _)| motion)
    }

    /// How far the bead would be farther in each row if the command of each row had been handed over with the row, um.
    fn missing_um(&self, command_um: &[f64], handed_over: &[HandedOver]) -> Vec<f64> {
        let on_time = |(row, um): (usize, &f64)| HandedOver {
            row: row as f64,
            um: *um,
        };
        let mut due = Integral::of(command_um.iter().enumerate().map(on_time));
        let mut came = Integral::of(handed_over.iter().copied());
        (0..command_um.len())
            .map(|row| row as f64 - self.delay)
            .map(|row| self.gain * (due.until(row) - came.until(row)))
            .collect()
    }
}

/// A command that was handed over.
#[derive(Debug, Clone, Copy)]
pub(crate) struct HandedOver {
    /// When, in rows.
    pub(crate) row: f64,
    /// The command.
    pub(crate) um: f64,
}

/// The integral of held commands from the first row on. Before the first command that one was held.
struct Integral<I: Iterator<Item = HandedOver>> {
    to_come: std::iter::Peekable<I>,
    held_um: f64,
    /// Up to which row, and the integral up to there.
    row: f64,
    sum: f64,
}

impl<I: Iterator<Item = HandedOver>> Integral<I> {
    fn of(commands: I) -> Self {
        let mut to_come = commands.peekable();
        Self {
            held_um: to_come.peek().map_or(0.0, |first| first.um),
            to_come,
            row: 0.0,
            sum: 0.0,
        }
    }

    /// Up to a row, no earlier than that of the call before.
    fn until(&mut self, row: f64) -> f64 {
        while let Some(next) = self.to_come.next_if(|next| next.row <= row) {
            self.advance(next.row);
            self.held_um = next.um;
        }
        self.advance(row);
        self.sum
    }

    fn advance(&mut self, row: f64) {
        if row > self.row {
            self.sum += self.held_um * (row - self.row);
            self.row = row;
        }
    }
}

/// Positions as they would be if the command of each row had been handed over with the row. A row is `late` if its command came half a
/// row late or never; `age` is that of the frames in rows.
pub(crate) fn as_if_on_time(
    command_um: &[f64],
    position_um: &[f64],
    handed_over: &[HandedOver],
    late: &[bool],
    age: f64,
) -> Vec<f64> {
    let mut on_time_um = position_um.to_vec();
    // The first motion is found with the lateness in it, the second without.
    for _ in 0..2 {
        let Some(motion) = Motion::of(command_um, &on_time_um, late, age) else {
            return position_um.to_vec();
        };
        let missing_um = motion.missing_um(command_um, handed_over);
        on_time_um = (position_um.iter().zip(missing_um))
            .map(|(um, missing_um)| um + missing_um)
            .collect();
    }
    on_time_um
}
