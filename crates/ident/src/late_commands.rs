//! Commands that came late: the positions as they would be if every command had been on time.
//!
//! A command that is late by part of a row moves the bead less by that part of its step, for good. The rows themselves tell the gain and the
//! delay with which commands move the bead, so nothing has to be known of the rig. Moving the commands within the band of the rows instead
//! would be wrong where lateness follows the excitation: steps hold frequencies beyond that band. A resonance or a lag adds a motion that
//! is slower than a row and follows from the rows too.

use nalgebra::{DMatrix, DVector};

/// Upper limit of the delay from a command to its effect, in periods, at 1 kHz over USB or a serial line. It includes the lateness of a
/// tick.
const LINE_PERIODS: f64 = 1.0;

/// Rows in which the chip's response to a command comes to its end: a resonance of 250 Hz rings for 25 ms.
const MEMORY: usize = 40;

/// Most rows from which the forty values of that response are found.
const ROWS: usize = 8000;

/// Least part that a response must explain of the squares that a motion leaves. The motion left over by stalls is as large.
const LEAST_SHARE: f64 = 0.1;

/// Increments of a position by row, from row `first` on, where no command of the row and of `reach` rows before it was late.
fn increments(um: &[f64], late: &[bool], first: usize, reach: usize) -> Vec<(usize, f64)> {
    (first..um.len().saturating_sub(1))
        .filter(|&row| !late[row - reach..=row].contains(&true))
        .map(|row| (row, um[row + 1] - um[row]))
        .filter(|(_, um)| um.is_finite())
        .collect()
}

/// A bead whose speed is proportional to the command, some time later.
#[derive(Debug, Clone, Copy)]
struct Motion {
    /// Motion in a row over the command.
    gain: f64,
    /// From a row's command to the first motion, in rows.
    delay: f64,
}

impl Motion {
    /// The motion that fits best to rows whose commands were on time and whose frames are `age` rows old. `None` if the commands do not
    /// vary, or too few rows are left.
    fn of(command_um: &[f64], position_um: &[f64], late: &[bool], age: f64) -> Option<Self> {
        /// Delays are tried in steps of this part of a row.
        const STEP: f64 = 0.01;
        let reach = (age + LINE_PERIODS) as usize + 1;
        let increments = increments(position_um, late, reach, reach);
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

    /// The position in each row under these commands, um.
    fn position_um(&self, commands: impl Iterator<Item = Arrival>, rows: usize) -> Vec<f64> {
        let mut integral = Integral::of(commands);
        (0..rows)
            .map(|row| self.gain * integral.until(row as f64 - self.delay))
            .collect()
    }
}

/// The response to a step of the command beyond [`Motion`], of a resonance, a lag or a relaxation: after each row, in um per um.
struct Ringing(Vec<f64>);

impl Ringing {
    /// By the increments that a motion leaves. Before the rows are seen, the response in each row may be as large as that of the motion.
    fn of(motion: Motion, command_um: &[f64], left_um: &[f64], late: &[bool]) -> Option<Self> {
        let mut rows = increments(left_um, late, MEMORY, MEMORY - 1);
        let every = 1 + rows.len() / ROWS;
        rows = rows.into_iter().step_by(every).collect();
        let count = rows.len().max(1) as f64;
        let mut commands = DMatrix::from_fn(rows.len(), MEMORY, |k, i| command_um[rows[k].0 - i]);
        let mut increments = DVector::from_fn(rows.len(), |k, _| rows[k].1);
        let command = commands.sum() / (count * MEMORY as f64);
        commands.add_scalar_mut(-command);
        increments.add_scalar_mut(-increments.sum() / count);
        let squares = increments.norm_squared();
        let mut information = commands.tr_mul(&commands);
        let shared = commands.tr_mul(&increments);
        let noise = squares / count / (motion.gain * motion.gain);
        // Commands that leave a part of the response as unknown as before do not tell it: a single sine tells nothing of other
        // frequencies.
        let mut beyond = information.clone();
        for i in 0..MEMORY {
            beyond[(i, i)] -= noise;
            information[(i, i)] += noise;
        }
        beyond.cholesky()?;
        let by_row = information.cholesky()?.solve(&shared);
        if by_row.dot(&shared) < LEAST_SHARE * squares {
            return None;
        }
        // Twice summed: increments of the position by a command of one row, positions by it, and positions by a step.
        let (mut of_row, mut of_step) = (0.0, vec![0.0]);
        for um in &by_row {
            of_row += um;
            of_step.push(of_step.last().copied().unwrap_or(0.0) + of_row);
        }
        Some(Self(of_step))
    }

    /// How far the bead would be farther in each row by this response if every command had been on time, um.
    fn missing_um(&self, command_um: &[f64], arrivals: &[Arrival]) -> Vec<f64> {
        // Steps between rows as steps in the rows around, so that the response to the second is the polynomial through that of the first.
        let mut steps = vec![0.0; command_um.len()];
        let mut add = |commands: &mut dyn Iterator<Item = Arrival>, sign: f64| {
            let mut held_um = None;
            for Arrival { row, um } in commands {
                let step = sign * (um - held_um.replace(um).unwrap_or(um));
                let next = row.ceil();
                for (weight, place) in weights(next - row).into_iter().zip(PLACES) {
                    let row = next - place;
                    if let Some(sum) = steps.get_mut(row as usize).filter(|_| row >= 0.0) {
                        *sum += step * weight;
                    }
                }
            }
        };
        add(&mut on_time(command_um), 1.0);
        add(&mut arrivals.iter().copied(), -1.0);
        // Behind its last row the response is a straight line with its last increment.
        let last = self.0.len() - 1;
        let increment = self.0[last] - self.0[last - 1];
        let (mut level, mut slope) = (0.0, 0.0);
        (0..steps.len())
            .map(|row| {
                if let Some(old) = row.checked_sub(last + 1) {
                    level += increment * slope + self.0[last] * steps[old];
                    slope += steps[old];
                    // The step is one row beyond the response by now.
                    level += increment * steps[old];
                }
                let recent = self.0.iter().zip(steps[..=row].iter().rev());
                level + recent.map(|(after, step)| after * step).sum::<f64>()
            })
            .collect()
    }
}

/// Rows about a place between the rows 0 and 1.
const PLACES: [f64; 6] = [-2.0, -1.0, 0.0, 1.0, 2.0, 3.0];

/// Weights of the values at [`PLACES`] in the polynomial through them, at a place (Lagrange).
fn weights(at: f64) -> [f64; 6] {
    PLACES.map(|own| {
        let others = PLACES.iter().filter(|other| **other != own);
        others.map(|other| (at - other) / (own - other)).product()
    })
}

/// A command as it came to the board.
#[derive(Debug, Clone, Copy)]
pub struct Arrival {
    /// When, in rows.
    pub row: f64,
    /// The command.
    pub um: f64,
}

/// The command of each row, on time.
fn on_time(command_um: &[f64]) -> impl Iterator<Item = Arrival> {
    (command_um.iter().enumerate()).map(|(row, &um)| Arrival {
        row: row as f64,
        um,
    })
}

/// The integral of held commands from the first row on. Before the first command that one was held.
struct Integral<I: Iterator<Item = Arrival>> {
    to_come: std::iter::Peekable<I>,
    held_um: f64,
    /// Up to which row, and the integral up to there.
    row: f64,
    sum: f64,
}

impl<I: Iterator<Item = Arrival>> Integral<I> {
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

/// Positions as they would be if every command had come on time.
#[derive(Debug, Clone)]
pub struct OnTime {
    /// Position of each row, um; NaN without a bead.
    pub position_um: Vec<f64>,
    /// Standard deviation of the correction of each row's motion from the row before, um. The correction is linear, and the chip need
    /// not be. Empty if the rows do not tell how a command moves the bead.
    pub open_um: Vec<f64>,
}

/// Positions as they would be if the command of each row had come with the row. Commands (um), positions (um, NaN without a bead) and `late`
/// have one value for each row, `arrivals` rises in time. A row is `late` if nobody knows when its command came; `age` is that of the
/// frames in rows. Where the rows do not tell how a command moves the bead, the positions stay as they are.
///
/// # Panics
/// Of the columns one is shorter than the commands.
pub fn as_if_on_time(
    command_um: &[f64],
    position_um: &[f64],
    arrivals: &[Arrival],
    late: &[bool],
    age: f64,
) -> OnTime {
    /// Each round finds the motion with the lateness in it that the round before left.
    const ROUNDS: usize = 3;
    let rows = command_um.len();
    let plus = |um: &[f64], more: &[f64]| -> Vec<f64> {
        um.iter().zip(more).map(|(um, more)| um + more).collect()
    };
    let less = |um: &[f64], other: &[f64]| -> Vec<f64> {
        um.iter().zip(other).map(|(um, other)| um - other).collect()
    };
    let mut on_time_um = position_um.to_vec();
    let mut found = None;
    for _ in 0..ROUNDS {
        let Some(motion) = Motion::of(command_um, &on_time_um, late, age) else {
            break;
        };
        let due_um = motion.position_um(on_time(command_um), rows);
        let moved_um = less(&due_um, &motion.position_um(arrivals.iter().copied(), rows));
        on_time_um = plus(position_um, &moved_um);
        found = Some((motion, due_um, moved_um));
    }
    let Some((motion, mut due_um, moved_um)) = found else {
        return OnTime {
            position_um: on_time_um,
            open_um: Vec::new(),
        };
    };
    let mut missing_um = moved_um.clone();
    let mut ringing = None;
    for _ in 0..ROUNDS {
        let left_um = less(&on_time_um, &due_um);
        ringing = Ringing::of(motion, command_um, &left_um, late);
        let Some(ringing) = &ringing else {
            break;
        };
        missing_um = plus(&moved_um, &ringing.missing_um(command_um, arrivals));
        on_time_um = plus(position_um, &missing_um);
    }
    if let Some(ringing) = ringing {
        // Of commands that never came all is missing.
        due_um = plus(&due_um, &ringing.missing_um(command_um, &[]));
    }
    let share = left_share(&on_time_um, &due_um, late);
    let steps = missing_um
        .windows(2)
        .map(|pair| share * (pair[1] - pair[0]).abs());
    OnTime {
        open_um: std::iter::once(0.0).chain(steps).collect(),
        position_um: on_time_um,
    }
}

/// RMS of the increments of the position without the linear motion, over the RMS of the increments of that motion. The nonlinear share of
/// the chip is smaller, because this ratio contains the noise.
fn left_share(position_um: &[f64], due_um: &[f64], late: &[bool]) -> f64 {
    let all = vec![0.0; position_um.len()];
    let squares = |less: &[f64]| -> f64 {
        let left: Vec<f64> = (position_um.iter().zip(less))
            .map(|(um, less)| um - less)
            .collect();
        increments(&left, late, 0, 0)
            .iter()
            .map(|(_, um)| um * um)
            .sum()
    };
    let left = squares(due_um);
    (left / (squares(&all) - left).max(left)).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_numeric::Random;
    use std::f64::consts::TAU;

    /// Positions of a bead whose flow follows the commands with a resonance of 250 Hz and a damping of 0.1, and then with its delay.
    fn resonant(commands: &[Arrival], rows: usize) -> Vec<f64> {
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

    /// Increments of what late commands leave of a path, before and after they are put right, RMS in um; and what is said
    /// to be open.
    fn put_right(late_rows: impl Fn(&mut Random) -> f64) -> (f64, f64, f64) {
        const ROWS: usize = 8000;
        let mut random = Random::new(5);
        let command_um: Vec<f64> = (0..ROWS).map(|_| 0.2 * random.normal()).collect();
        let due = resonant(&on_time(&command_um).collect::<Vec<_>>(), ROWS);
        let mut last = 0.0f64;
        let arrivals: Vec<Arrival> = on_time(&command_um)
            .map(|Arrival { row, um }| {
                last = last.max(row + late_rows(&mut random));
                Arrival { row: last, um }
            })
            .collect();
        let came = resonant(&arrivals, ROWS);
        let left = |um: &[f64]| -> Vec<f64> {
            let steps = um.windows(2).zip(due.windows(2)).skip(100);
            steps.map(|(a, b)| (a[1] - a[0]) - (b[1] - b[0])).collect()
        };
        let rms = |um: &[f64]| (um.iter().map(|um| um * um).sum::<f64>() / um.len() as f64).sqrt();
        let on_time = as_if_on_time(&command_um, &came, &arrivals, &vec![false; ROWS], 2.1);
        let after = left(&on_time.position_um);
        (rms(&left(&came)), rms(&after), rms(&on_time.open_um))
    }

    #[test]
    fn what_late_commands_leave_out_of_a_ringing_motion_is_added() {
        let (before, after, open) = put_right(|random| 0.49 * random.uniform().powi(4));
        println!("{before:.5} um become {after:.5}, said to be {open:.5}");
        assert!(after < 0.25 * before, "{after} um of {before} um");
        assert!(
            after < 1.5 * open && open < 4.0 * after,
            "{open} um for {after} um"
        );
    }

    #[test]
    fn commands_that_are_late_by_rows_are_put_right_if_it_is_known_when_they_came() {
        let stalls = |random: &mut Random| {
            if random.uniform() < 0.1 {
                2.5 * random.uniform()
            } else {
                0.0
            }
        };
        let (before, after, open) = put_right(stalls);
        println!("{before:.5} um become {after:.5}, said to be {open:.5}");
        assert!(after < 0.25 * before, "{after} um of {before} um");
        assert!(
            after < 1.5 * open && open < 4.0 * after,
            "{open} um for {after} um"
        );
    }
}
