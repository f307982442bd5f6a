//! Commands that were handed over late: how late, and the positions as they would be if every command had been on time.
//!
//! A command that is late by part of a row moves the bead less by that part of its step, for good. The rows themselves tell the gain and the
//! delay with which commands move the bead, so nothing has to be known of the rig. Moving the commands within the band of the rows instead
//! would be wrong where lateness follows the excitation: steps hold frequencies beyond that band. What a resonance or a lag adds is slower
//! than a row, and follows from the rows too.

use cellpos_runtime::{TickFlags, TickRecord};
use nalgebra::{DMatrix, DVector};

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

/// Rows in which the chip's response to a command comes to its end: a resonance of 250 Hz rings for 25 ms.
const MEMORY: usize = 40;

/// Part of the squares that a motion leaves which a response must explain. A smaller one changes what is missing of late commands by less
/// than the noise, and stalls leave as much.
const LEAST_SHARE: f64 = 0.1;

/// A bead whose speed goes with the command, some time later.
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
        let [due, came] = integrals(command_um, handed_over, |row| row - self.delay);
        (due.iter().zip(came))
            .map(|(due, came)| self.gain * (due - came))
            .collect()
    }

    /// The position if the command of each row had been handed over with the row, um.
    fn position_um(&self, command_um: &[f64]) -> Vec<f64> {
        let [due, _] = integrals(command_um, &[], |row| row - self.delay);
        due.iter().map(|um| self.gain * um).collect()
    }
}

/// The integrals of the commands if each had been handed over with its row, and as they were, up to an instant of each row.
fn integrals(
    command_um: &[f64],
    handed_over: &[HandedOver],
    at: impl Fn(f64) -> f64,
) -> [Vec<f64>; 2] {
    let on_time = |(row, um): (usize, &f64)| HandedOver {
        row: row as f64,
        um: *um,
    };
    let mut due = Integral::of(command_um.iter().enumerate().map(on_time));
    let mut came = Integral::of(handed_over.iter().copied());
    let rows = || (0..command_um.len()).map(|row| at(row as f64));
    [
        rows().map(|row| due.until(row)).collect(),
        rows().map(|row| came.until(row)).collect(),
    ]
}

/// The response to a step of the command beyond [`Motion`], of a resonance, a lag or a relaxation: after each row, in um per um.
struct Ringing(Vec<f64>);

impl Ringing {
    /// By the increments that a motion leaves. Each of them is as large as the gain of the motion before the rows are seen.
    fn of(motion: Motion, command_um: &[f64], left_um: &[f64], late: &[bool]) -> Option<Self> {
        let rows: Vec<usize> = (MEMORY..left_um.len().saturating_sub(1))
            .filter(|&row| !late[row + 1 - MEMORY..=row].contains(&true))
            .filter(|&row| (left_um[row + 1] - left_um[row]).is_finite())
            .collect();
        let mean = |of: &dyn Fn(usize) -> f64| {
            rows.iter().map(|&row| of(row)).sum::<f64>() / rows.len().max(1) as f64
        };
        let command = mean(&|row| command_um[row]);
        let increment = mean(&|row| left_um[row + 1] - left_um[row]);
        let mut information = DMatrix::<f64>::zeros(MEMORY, MEMORY);
        let mut shared = DVector::<f64>::zeros(MEMORY);
        let mut squares = 0.0;
        for &row in &rows {
            let um = left_um[row + 1] - left_um[row] - increment;
            squares += um * um;
            for i in 0..MEMORY {
                let by = command_um[row - i] - command;
                shared[i] += by * um;
                for j in 0..=i {
                    information[(i, j)] += by * (command_um[row - j] - command);
                }
            }
        }
        let noise = squares / rows.len().max(1) as f64 / (motion.gain * motion.gain);
        // Commands that leave a part of the response as unknown as before do not tell it: a single sine tells nothing of other
        // frequencies. The lower triangle is all that is read.
        let mut beyond = information.clone();
        for i in 0..MEMORY {
            beyond[(i, i)] -= noise;
            information[(i, i)] += noise;
        }
        beyond.cholesky()?;
        let increments = information.cholesky()?.solve(&shared);
        if increments.dot(&shared) < LEAST_SHARE * squares {
            return None;
        }
        // Twice summed: increments of the position by a command of one row, positions by it, and positions by a step.
        let (mut of_row, mut of_step) = (0.0, vec![0.0]);
        for um in &increments {
            of_row += um;
            of_step.push(of_step.last().copied().unwrap_or(0.0) + of_row);
        }
        Some(Self(of_step))
    }

    /// The response `row` and a part of a row after a step, by the polynomial through the six rows around, of [`weights`]. The last
    /// increment goes on.
    fn after(&self, row: usize, weights: &[f64; 6]) -> f64 {
        let last = self.0.len() - 1;
        let at = |row: usize| match row.checked_sub(2) {
            None => 0.0,
            Some(row) if row <= last => self.0[row],
            Some(row) => self.0[last] + (row - last) as f64 * (self.0[last] - self.0[last - 1]),
        };
        weights.iter().zip(row..).map(|(w, row)| w * at(row)).sum()
    }

    /// As [`Motion::missing_um`], of this response.
    fn missing_um(&self, command_um: &[f64], handed_over: &[HandedOver]) -> Vec<f64> {
        let on_time = (command_um.iter().enumerate()).map(|(row, &um)| HandedOver {
            row: row as f64,
            um,
        });
        let rows = command_um.len();
        // Level and slope of what goes on in straight lines, from where they begin.
        let (mut missing, mut begun) = (vec![0.0; rows], vec![[0.0; 2]; rows]);
        let mut add = |commands: &mut dyn Iterator<Item = HandedOver>, sign: f64| {
            let mut held_um = None;
            for HandedOver { row, um } in commands {
                let step = sign * (um - held_um.replace(um).unwrap_or(um));
                let from = row.ceil().max(0.0) as usize;
                let until = from + self.0.len();
                let weights = weights(from as f64 - row);
                for (missing, behind) in missing.iter_mut().take(until).skip(from).zip(0..) {
                    *missing += step * self.after(behind, &weights);
                }
                if let Some([level, slope]) = begun.get_mut(until) {
                    let [there, next] = [0, 1].map(|i| self.after(until - from + i, &weights));
                    *level += step * there;
                    *slope += step * (next - there);
                }
            }
        };
        add(&mut on_time.into_iter(), 1.0);
        add(&mut handed_over.iter().copied(), -1.0);
        let (mut level, mut slope) = (0.0, 0.0);
        for (missing, [more, steeper]) in missing.iter_mut().zip(begun) {
            level += slope + more;
            slope += steeper;
            *missing += level;
        }
        missing
    }
}

/// Weights of the values at -2, -1, 0, 1, 2 and 3 in the polynomial through them, at a place (Lagrange).
fn weights(at: f64) -> [f64; 6] {
    const PLACES: [f64; 6] = [-2.0, -1.0, 0.0, 1.0, 2.0, 3.0];
    PLACES.map(|own| {
        let others = PLACES.iter().filter(|other| **other != own);
        others.map(|other| (at - other) / (own - other)).product()
    })
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
    let plus = |um: &[f64], missing_um: Vec<f64>| -> Vec<f64> {
        um.iter()
            .zip(missing_um)
            .map(|(um, more)| um + more)
            .collect()
    };
    let motion_of = |on_time_um: &[f64]| Motion::of(command_um, on_time_um, late, age);
    let with = |motion: Motion| plus(position_um, motion.missing_um(command_um, handed_over));
    // The first motion is found with the lateness in it, the second without.
    let Some(motion) = motion_of(position_um).and_then(|first| motion_of(&with(first))) else {
        return position_um.to_vec();
    };
    let moved_um = with(motion);
    let followed_um = motion.position_um(command_um);
    let mut on_time_um = moved_um.clone();
    // What rings is found with its own lateness in it, and once more without.
    for _ in 0..2 {
        let left_um: Vec<f64> = (on_time_um.iter().zip(&followed_um))
            .map(|(um, followed)| um - followed)
            .collect();
        let Some(ringing) = Ringing::of(motion, command_um, &left_um, late) else {
            break;
        };
        on_time_um = plus(&moved_um, ringing.missing_um(command_um, handed_over));
    }
    on_time_um
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_numeric::Random;
    use std::f64::consts::TAU;

    /// Positions of a bead whose flow follows the commands with a resonance of 250 Hz and a damping of 0.1, and then with its delay.
    fn resonant(commands: &[HandedOver], rows: usize) -> Vec<f64> {
        const STEPS: usize = 200;
        let (omega, step) = (TAU * 0.25, 1.0 / STEPS as f64);
        let (mut x, mut v, mut position) = (0.0, 0.0, 0.0);
        let mut to_come = commands.iter().peekable();
        let mut held_um = 0.0;
        let late = (2.3 * STEPS as f64).round() as usize;
        let mut path = vec![0.0; late];
        for k in 0..rows * STEPS {
            while let Some(next) = to_come.next_if(|next| next.row <= k as f64 * step + 1e-9) {
                held_um = next.um;
            }
            path.push(position);
            v += step * (omega * omega * (held_um - x) - 0.2 * omega * v);
            x += step * v;
            position += 0.4 * step * x;
        }
        path.into_iter().step_by(STEPS).take(rows).collect()
    }

    #[test]
    fn what_late_commands_leave_out_of_a_ringing_motion_is_added() {
        const ROWS: usize = 8000;
        let mut random = Random::new(5);
        let command_um: Vec<f64> = (0..ROWS).map(|_| 0.2 * random.normal()).collect();
        let handed_over = |late: f64, random: &mut Random| -> Vec<HandedOver> {
            (command_um.iter().enumerate())
                .map(|(row, &um)| HandedOver {
                    row: row as f64 + late * random.uniform().powi(4),
                    um,
                })
                .collect()
        };
        let due = resonant(&handed_over(0.0, &mut random), ROWS);
        let late = handed_over(0.49, &mut random);
        let came = resonant(&late, ROWS);
        let rms = |um: &[f64]| -> f64 {
            let steps = um.windows(2).zip(due.windows(2)).skip(100);
            let squares = steps.map(|(a, b)| ((a[1] - a[0]) - (b[1] - b[0])).powi(2));
            (squares.sum::<f64>() / ROWS as f64).sqrt()
        };
        let on_time = as_if_on_time(&command_um, &came, &late, &vec![false; ROWS], 2.1);
        let (before, after) = (rms(&came), rms(&on_time));
        assert!(after < 0.25 * before, "{after} um of {before} um");
    }
}
