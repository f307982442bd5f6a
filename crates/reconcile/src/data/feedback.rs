//! Whether the command of a row answers the frame of that row.
//!
//! In a closed loop the command is made from the frame, so the frame was taken first. If a simulated frame saw the command of its row,
//! the answer to the frame would explain the frame.

use nalgebra::{DMatrix, DVector};

/// Increments of position and command before a row, of each, that tell what both would do without the row's noise.
const BEFORE: usize = 3;

/// Standard deviations beyond which a correlation is no chance.
const SURE: f64 = 6.0;

/// Whether a command falls when the bead has just risen, by more than the rows before predict. `rises`: a higher command moves the
/// bead up.
pub(crate) fn answers_frames(
    command_um: &[f64],
    bead_um: &[f64],
    present: &[bool],
    rises: bool,
) -> bool {
    let rows = command_um.len().min(bead_um.len()).min(present.len());
    let known = |k: &usize| present[k - BEFORE - 1..=*k].iter().all(|p| *p);
    let used: Vec<usize> = (BEFORE + 1..rows).filter(known).collect();
    let numbers = 2 * BEFORE + 1;
    if used.len() < 20 * numbers {
        return false;
    }
    let step = |x: &[f64], k: usize| x[k] - x[k - 1];
    // The row's own step of the bead first.
    let of_row = |k: usize| -> Vec<f64> {
        let bead = (0..=BEFORE).map(|lag| step(bead_um, k - lag));
        let command = (1..=BEFORE).map(|lag| step(command_um, k - lag));
        bead.chain(command).collect()
    };
    let mut normal = DMatrix::<f64>::zeros(numbers, numbers);
    let mut right = DVector::<f64>::zeros(numbers);
    let mut power = 0.0;
    for &k in &used {
        let (x, u) = (DVector::from_vec(of_row(k)), step(command_um, k));
        normal.ger(1.0, &x, &x, 1.0);
        right.axpy(u, &x, 1.0);
        power += u * u;
    }
    let Some(inverse) = normal.try_inverse() else {
        return false;
    };
    let answers = &inverse * &right;
    let left = (power - answers.dot(&right)).max(0.0) / (used.len() - numbers) as f64;
    let error = (left * inverse[(0, 0)].max(0.0)).sqrt();
    let answer = if rises { answers[0] } else { -answers[0] };
    answer < -SURE * error && error > 0.0
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An integrator with noise; the command of a row is a sine, less `gain` times the position of that row.
    fn record(gain: f64, seen_at_once: f64) -> bool {
        let mut random = cellpos_numeric::Random::new(5);
        let (mut x, mut bead, mut command) = (0.0, Vec::new(), Vec::new());
        for k in 0..3000 {
            let sine = (0.06 * f64::from(k)).sin() + 0.1 * random.normal();
            let noise = 0.03 * random.normal();
            let own = sine - gain * (x + noise);
            bead.push(x + noise + seen_at_once * own);
            command.push(own);
            x += 0.3 * own + 0.02 * random.normal();
        }
        answers_frames(&command, &bead, &vec![true; bead.len()], true)
    }

    #[test]
    fn a_loop_answers_its_frames_and_a_command_from_a_table_does_not() {
        assert!(record(0.5, 0.0));
        assert!(!record(0.0, 0.0));
        // A camera whose clock runs ahead sees the command of its row.
        assert!(!record(0.0, 0.2));
    }
}
