//! How long frames waited for their command.
//!
//! A loop that keeps the clock's time uses a frame when its own step begins. As camera and clock drift apart, frames wait for up to a
//! third of a period, for seconds at a time. This is no property of the rig, and the stamps tell its size. A fit that does not know
//! the waits finds another delay in every record, and a lag that seems to vary with the amplitude.

use crate::data::record::Record;
use crate::simulate::Waits;

/// Rows of the running median: long against the jitter of single frames, short against the drift of two clocks.
const ROWS: usize = 51;
/// Less than this part of a row is the jitter of the stamps.
const LEAST: f64 = 0.01;
/// Share of the rows that are taken to have waited least, if no age is stated: their age is that of the camera's path alone.
const YOUNGEST: f64 = 0.1;

/// Waits of the rows of every record: how much older their frames are than those of the model's delay, else than the youngest. None
/// for a record without ages, and for all if no frame waited.
pub(crate) fn waits(records: &[Record], stated_s: Option<f64>) -> Vec<Waits> {
    let ages: Vec<Vec<f64>> = records.iter().map(|r| smooth(&r.frame_age_s)).collect();
    let mut sorted: Vec<f64> = ages.iter().flatten().copied().collect();
    sorted.sort_by(f64::total_cmp);
    let youngest_s = sorted.get((YOUNGEST * sorted.len() as f64) as usize);
    // Without any age there is nothing to count from, and no wait.
    let from_s = stated_s.or(youngest_s.copied()).unwrap_or(0.0);
    let of = |(ages, r): (&Vec<f64>, &Record)| {
        let step_s = LEAST * r.sample_s;
        if ages.iter().all(|age| (age - from_s).abs() < step_s) {
            return Waits::default();
        }
        let steps = |age: &f64| ((age - from_s) / step_s).round() as i16;
        Waits {
            step_s,
            of_row: ages.iter().map(steps).collect(),
        }
    };
    ages.iter().zip(records).map(of).collect()
}

/// The median of the known ages about each row; before the first known one the first.
fn smooth(age_s: &[f64]) -> Vec<f64> {
    let mut before = match age_s.iter().find(|age| age.is_finite()) {
        Some(first) => *first,
        None => return Vec::new(),
    };
    let half = ROWS / 2;
    (0..age_s.len())
        .map(|k| {
            let near = &age_s[k.saturating_sub(half)..(k + half + 1).min(age_s.len())];
            let mut known: Vec<f64> = near.iter().copied().filter(|a| a.is_finite()).collect();
            if !known.is_empty() {
                let middle = known.len() / 2;
                before = *known.select_nth_unstable_by(middle, f64::total_cmp).1;
            }
            before
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(age_s: Vec<f64>) -> Record {
        let time_s: Vec<f64> = (0..2000).map(|k| f64::from(k) * 1e-3).collect();
        let still = vec![0.0; time_s.len()];
        let record = Record::from_rows("r", &time_s, &still, &still);
        Record {
            frame_age_s: age_s,
            ..record.unwrap_or_else(|e| panic!("{e}"))
        }
    }

    #[test]
    fn waits_are_counted_from_the_youngest_frames_of_all_records_and_jitter_is_none() {
        let jitter = |k: usize| 2e-5 * ((k * 7919) % 101) as f64 / 101.0;
        let late = |k: usize| {
            if (1000..1500).contains(&k) {
                2.5e-4
            } else {
                0.0
            }
        };
        let mut first: Vec<f64> = (0..2000).map(|k| 2e-3 + jitter(k) + late(k)).collect();
        first[1200] = f64::NAN;
        let second: Vec<f64> = (0..2000).map(|k| 2.1e-3 + jitter(k)).collect();
        let records = [record(first.clone()), record(second), record(Vec::new())];
        let all = waits(&records, None);
        let wait_s = |record: usize, row: usize| all[record].of_row_s(row);
        assert!(
            (wait_s(0, 1200) - 2.5e-4).abs() < 1e-5,
            "{}",
            wait_s(0, 1200)
        );
        assert!(wait_s(0, 500).abs() < 1e-5 && (wait_s(1, 700) - 1e-4).abs() < 1e-5);
        assert!(all[2].of_row.is_empty());
        let calm: Vec<f64> = (0..2000).map(|k| 2e-3 + 0.3 * jitter(k)).collect();
        assert!(waits(&[record(calm.clone())], None)[0].of_row.is_empty());
        // A model that was made with frames of 1.9 ms: these waited for 0.1 ms longer.
        let waited = &waits(&[record(calm)], Some(1.9e-3))[0];
        assert!((0..2000).all(|k| (waited.of_row_s(k) - 1e-4).abs() < 1e-5));
    }
}
