//! Where a command repeats itself, and where it rests, in part of a record: a lead-in, several amplitudes one after the other.

use crate::data::record::{Record, differences, variance};
use crate::thresholds::THRESHOLDS;
use std::ops::Range;

/// Rows of a record that follow the same command as the rows this far before.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Repeats {
    /// How many rows before.
    pub rows: usize,
    pub ranges: Vec<Range<usize>>,
}

/// Lags that are tried, those first at which the command differs least.
const LAGS: usize = 6;

/// Rows differ by at most this part of the command's RMS where it repeats itself.
const SAME: f64 = 0.05;

/// Fewest changes of the command in a stretch that repeats: fewer may be chance.
const CHANGES: usize = 5;

/// The part of a stretch in which what went before it may still show.
const RUN_IN: f64 = 1.0 / 3.0;

/// Where the command of a whole record repeats itself.
pub(crate) fn whole_periods(r: &Record) -> Option<Repeats> {
    let p = r.period_rows()?;
    // The run-in counts for one period in all.
    let from = if r.rows() >= 4 * p { 2 * p } else { p };
    Some(Repeats {
        rows: p,
        ranges: std::iter::once(from..r.rows()).collect(),
    })
}

/// Where the command of a loop comes back to itself, but for what the loop answered to the noise. An estimate of the noise leaves out the
/// linear response to that difference.
pub(crate) fn nearly_repeats(r: &Record) -> Option<Repeats> {
    /// Most by which the command differs, as a part of its RMS. A response that bends by all of itself then adds at most a quarter of its
    /// own power to the noise, and stands out from it all the same.
    const NEAR: f64 = 0.5;
    let power = variance(&r.pzt_um);
    let apart = differences(&r.pzt_um);
    let away = (apart.iter()).position(|apart| *apart > power)?;
    // Two periods of run-in, and as much again that is used.
    let lags = away.max(20)..r.rows() / 4;
    let rows = lags.min_by(|a, b| apart[*a].total_cmp(&apart[*b]))?;
    (apart[rows] <= NEAR.powi(2) * power).then(|| Repeats {
        rows,
        ranges: std::iter::once(2 * rows..r.rows()).collect(),
    })
}

/// Stretches in which the command repeats itself.
pub(crate) fn repeats(r: &Record) -> Option<Repeats> {
    let n = r.rows();
    let power = variance(&r.pzt_um);
    if n < 3 * THRESHOLDS.floor_rows || power <= 0.0 {
        return None;
    }
    let apart = differences(&r.pzt_um);
    let mut lags: Vec<usize> = (20..apart.len().saturating_sub(1))
        .filter(|&p| apart[p] < apart[p - 1] && apart[p] < apart[p + 1])
        .collect();
    lags.sort_by(|a, b| apart[*a].total_cmp(&apart[*b]));
    lags.truncate(LAGS);
    (lags.into_iter())
        .map(|p| Repeats {
            rows: p,
            ranges: stretches(&r.pzt_um, p, SAME * power.sqrt()),
        })
        .filter(|found| !found.ranges.is_empty())
        .max_by_key(|found| found.ranges.iter().map(Range::len).sum::<usize>())
}

/// Stretches, their run-in left out, in which the command is that of `p` rows before.
fn stretches(u: &[f64], p: usize, near: f64) -> Vec<Range<usize>> {
    let mut found = Vec::new();
    let mut start = p;
    for k in p..=u.len() {
        if k < u.len() && (u[k] - u[k - p]).abs() <= near {
            continue;
        }
        let changes = (start + 1..k)
            .filter(|&i| (u[i] - u[i - 1]).abs() > near)
            .count();
        if changes >= CHANGES && k - start >= THRESHOLDS.floor_rows.max(p / 3) {
            found.push(start + (RUN_IN * (k - start) as f64) as usize..k);
        }
        start = k + 1;
    }
    found
}

/// Long stretches with a constant command: their later halves.
pub(crate) fn rests(r: &Record) -> Vec<Range<usize>> {
    let u = &r.pzt_um;
    let near = THRESHOLDS.rest_share * (variance(u).sqrt());
    let mut found = Vec::new();
    let mut start = 0;
    for k in 1..=u.len() {
        if k < u.len() && (u[k] - u[start]).abs() <= near {
            continue;
        }
        if k - start >= 2 * THRESHOLDS.floor_rows {
            found.push(start + (k - start) / 2..k);
        }
        start = k;
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Levels of ten rows that look like chance.
    fn levels(seed: usize, rows: usize, size: f64) -> Vec<f64> {
        let level = |i: usize| ((i + 31 * seed) as f64 * 12.9898).sin() * 43_758.545_3;
        (0..rows)
            .map(|k| size * (level(k / 10) - level(k / 10).floor()))
            .collect()
    }

    fn record(u: &[f64]) -> Record {
        let t: Vec<f64> = (0..u.len()).map(|k| k as f64).collect();
        Record::from_rows("r", &t, u, &vec![0.0; u.len()]).unwrap()
    }

    #[test]
    fn a_period_twice_behind_a_rest_repeats_and_its_rest_is_one() {
        let once = levels(1, 900, 4.0);
        let u = [vec![2.0; 850], once.clone(), once].concat();
        let found = repeats(&record(&u)).unwrap();
        assert_eq!(found.rows, 900);
        assert_eq!(found.ranges.first(), Some(&(2050..2650)));
        assert_eq!(rests(&record(&u)).first(), Some(&(425..850)));
    }

    #[test]
    fn two_amplitudes_repeat_each_in_its_own_stretch() {
        let (large, small) = (levels(1, 900, 4.0), levels(2, 900, 1.5));
        let u = [large.clone(), large, small.clone(), small].concat();
        let found = repeats(&record(&u)).unwrap();
        assert_eq!(found.rows, 900);
        assert_eq!(found.ranges.len(), 2);
    }

    #[test]
    fn a_sine_whose_loop_answers_the_noise_nearly_repeats() {
        let mut random = cellpos_numeric::Random::new(5);
        let mut loop_of = |noise: f64| -> Vec<f64> {
            let sine = |k: u32| (std::f64::consts::TAU * f64::from(k) / 100.0).sin();
            (0..6000)
                .map(|k| sine(k) + noise * random.normal())
                .collect()
        };
        // The difference of two rows has an RMS of twice the noise's, as a part of the sine's.
        let r = record(&loop_of(0.1));
        assert_eq!(whole_periods(&r), None);
        assert_eq!(nearly_repeats(&r).unwrap().rows % 100, 0);
        assert_eq!(nearly_repeats(&record(&loop_of(0.4))), None);
        assert_eq!(nearly_repeats(&record(&levels(3, 6000, 4.0))), None);
        assert_eq!(nearly_repeats(&record(&[2.0; 6000])), None);
    }

    #[test]
    fn levels_by_chance_neither_repeat_nor_rest() {
        let u = levels(3, 6000, 4.0);
        assert_eq!(repeats(&record(&u)), None);
        assert_eq!(rests(&record(&u)), []);
        let two: Vec<f64> = levels(4, 6000, 1.0).iter().map(|v| v.round()).collect();
        assert_eq!(repeats(&record(&two)), None);
    }
}
