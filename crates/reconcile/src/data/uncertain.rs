//! Motion that is not known: by commands in rows that were missing and in stalls, and by jumps.

use crate::data::record::Record;

/// How much the bead may have moved by commands that are not known, in each row \[um^2\]; `None` if all are.
pub(crate) fn uncertain_command(r: &Record, gain_per_sample: f64) -> Option<Vec<f64>> {
    let guessed = r.filled.contains(&true) && r.period_rows().is_none();
    if !guessed && !r.late_command.contains(&true) && r.late_motion_um.is_empty() {
        return None;
    }
    let mut extra = vec![0.0; r.rows()];
    if guessed {
        add_guessed(r, gain_per_sample, &mut extra);
    }
    add_late(r, gain_per_sample, &mut extra);
    for (extra, sd_um) in extra.iter_mut().zip(&r.late_motion_um) {
        *extra += if sd_um.is_finite() {
            sd_um * sd_um
        } else {
            0.0
        };
    }
    Some(extra)
}

/// Adds that the bead may have gone anywhere in these rows: as far as it went in the whole record.
pub(crate) fn anywhere_at(rows: &[usize], bead_um: &[f64], extra: Option<Vec<f64>>) -> Vec<f64> {
    let ends = (f64::INFINITY, f64::NEG_INFINITY);
    let (low, high) = (bead_um.iter()).fold(ends, |(a, b), um| (a.min(*um), b.max(*um)));
    let mut extra = extra.unwrap_or_else(|| vec![0.0; bead_um.len()]);
    for row in rows.iter().filter(|row| **row < bead_um.len()) {
        extra[*row] = (high - low).powi(2);
    }
    extra
}

/// Where rows were missing their command is a guess.
fn add_guessed(r: &Record, gain_per_sample: f64, extra: &mut [f64]) {
    // Size of the error of a straight line between neighbours, measured where the command is known.
    let u = &r.pzt_um;
    let (mut sum, mut n) = (0.0, 0.0);
    for k in 1..u.len() - 1 {
        if !r.filled[k - 1] && !r.filled[k] && !r.filled[k + 1] {
            sum += (u[k] - 0.5 * (u[k - 1] + u[k + 1])).powi(2);
            n += 1.0;
        }
    }
    let variance = if n > 0.0 { sum / n } else { 0.0 } * gain_per_sample * gain_per_sample;
    for k in 0..u.len() {
        if r.filled[k] && k + 1 < u.len() {
            extra[k + 1] += variance;
        }
    }
}

/// Of some commands nobody knows when they acted. Until then the PZT is anywhere that commands were: where it was before, or where the
/// board holds the bead. It shows in the frames until that of the next row, and these are as old as the record says.
fn add_late(r: &Record, gain_per_sample: f64, extra: &mut [f64]) {
    let rows = r.rows() as f64;
    let mean_um = r.pzt_um.iter().sum::<f64>() / rows;
    let spread_um2 = (r.pzt_um.iter())
        .map(|um| (um - mean_um).powi(2))
        .sum::<f64>()
        / rows;
    let ages = r.frame_age_s.iter().filter(|age| age.is_finite());
    let (sum_s, count) = ages.fold((0.0, 0.0), |(sum, n), age| (sum + age, n + 1.0));
    let age_rows = if count > 0.0 {
        sum_s / count / r.sample_s
    } else {
        0.0
    };
    let shows = 2 + age_rows.max(0.0).ceil() as usize;
    let known = |row: usize| r.late_motion_um.get(row).is_some_and(|um| um.is_finite());
    let unknown = |row: usize| r.late_command[row] && !known(row);
    for (row, extra) in extra.iter_mut().enumerate() {
        if (row.saturating_sub(shows)..row).any(unknown) {
            *extra += gain_per_sample * gain_per_sample * spread_um2;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_late_command_leaves_the_motion_open_until_its_frames_are_over() {
        let time_s: Vec<f64> = (0..40).map(|k| 1e-3 * f64::from(k)).collect();
        // Commands of +-1 um: their mean square is 1.
        let pzt_um: Vec<f64> = (0..40).map(|k| f64::from(1 - 2 * (k % 2))).collect();
        let mut record = Record::from_rows("r", &time_s, &pzt_um, &[0.0; 40]).expect("a record");
        assert_eq!(uncertain_command(&record, 0.4), None);
        record.frame_age_s = vec![2.2e-3; 40];
        record.late_command = (0..40).map(|k| k == 10 || k == 11 || k == 38).collect();
        let extra = uncertain_command(&record, 0.4).expect("late rows");
        for (row, extra) in extra.iter().enumerate() {
            // Of row 11 on: its own step, the three rows of the frames' age, and the row in which the next command begins.
            let open = (11..=16).contains(&row) || row == 39;
            let expected = if open { 0.16 } else { 0.0 };
            assert!((extra - expected).abs() < 1e-12, "row {row}: {extra}");
        }
    }
    #[test]
    fn a_late_command_that_came_at_a_known_time_leaves_open_what_its_record_says() {
        let time_s: Vec<f64> = (0..40).map(|k| 1e-3 * f64::from(k)).collect();
        let pzt_um: Vec<f64> = (0..40).map(|k| f64::from(1 - 2 * (k % 2))).collect();
        let mut record = Record::from_rows("r", &time_s, &pzt_um, &[0.0; 40]).expect("a record");
        record.late_command[10] = true;
        record.late_command[30] = true;
        record.late_motion_um = vec![0.0; 40];
        (record.late_motion_um[12], record.late_motion_um[30]) = (0.01, f64::NAN);
        let extra = uncertain_command(&record, 0.4).expect("late rows");
        for (row, extra) in extra.iter().enumerate() {
            let expected = match row {
                12 => 1e-4,
                31 | 32 => 0.16,
                _ => 0.0,
            };
            assert!((extra - expected).abs() < 1e-12, "row {row}: {extra}");
        }
    }

    #[test]
    fn a_board_that_moves_in_ramps_moves_less_in_the_row_of_a_step() {
        let time_s: Vec<f64> = (0..20).map(|k| 1e-3 * f64::from(k)).collect();
        let pzt_um: Vec<f64> = (0..20).map(|k| if k < 8 { 20.0 } else { 21.0 }).collect();
        let mut record = Record::from_rows("r", &time_s, &pzt_um, &[0.0; 20]).expect("a record");
        record.slew_um_per_s = 5000.0;
        let u = record.displacement_um(20.0);
        // A ramp of 0.2 ms: a tenth of the step is missing in the row's mean.
        assert!((u[8] - 0.9).abs() < 1e-12, "{}", u[8]);
        assert!(u[..8].iter().all(|u| *u == 0.0) && u[9..].iter().all(|u| *u == 1.0));
    }
}
