//! The sampling step of a column of times, and the place of each row on the even grid.

use crate::error::TableProblem;

/// Rows laid on an even grid.
pub(crate) struct Grid {
    /// Sampling step, s.
    pub(crate) step_s: f64,
    /// Place of each row on the grid; the first is 0. Runs without a break when nothing is missing.
    pub(crate) places: Vec<usize>,
    /// Largest deviation of a step from the grid's, s.
    pub(crate) jitter_s: f64,
}

/// Lays times on an even grid; `tolerance` is the largest relative deviation of a step.
///
/// The error comes with its row.
pub(crate) fn grid(
    time_s: &[f64],
    tolerance: f64,
    gaps: bool,
) -> Result<Grid, (Option<usize>, TableProblem)> {
    let rows = time_s.len();
    let (Some(first), Some(last)) = (time_s.first(), time_s.last()) else {
        return Err((None, TableProblem::TooShort { rows }));
    };
    if rows < 2 {
        return Err((None, TableProblem::TooShort { rows }));
    }
    for (row, pair) in time_s.windows(2).enumerate() {
        if let [before_s, time_s] = *pair
            && (time_s <= before_s || !(time_s - before_s).is_finite())
        {
            return Err((Some(row + 1), TableProblem::TimeOrder { before_s, time_s }));
        }
    }
    let mut steps: Vec<f64> = time_s.windows(2).map(|pair| pair[1] - pair[0]).collect();
    steps.sort_by(f64::total_cmp);
    // The median is the usual step despite a few gaps; gaps are whole multiples of the step.
    let usual_s = steps[steps.len() / 2];

    let mut places = Vec::with_capacity(rows);
    places.push(0usize);
    let mut jitter_s: f64 = 0.0;
    let mut place = 0usize;
    for (row, pair) in time_s.windows(2).enumerate() {
        let step_s = pair[1] - pair[0];
        let whole = (step_s / usual_s).round().max(1.0);
        let off_s = (step_s - whole * usual_s).abs();
        // Times written with few decimals are rounded by up to one unit in the last place per step. That is within the tolerance
        // if the step has at least two significant figures.
        if off_s > tolerance * usual_s || (whole > 1.0 && !gaps) {
            let problem = TableProblem::Sampling {
                step_s,
                expected_s: usual_s,
            };
            return Err((Some(row + 1), problem));
        }
        place = place.saturating_add(whole as usize);
        let missing = place + 1 - (row + 2).min(place + 1);
        // A file that says "a million rows are missing" must not fill the memory with them.
        if missing > rows * 10 + 1000 {
            let problem = TableProblem::TooManyGaps {
                missing,
                present: rows,
            };
            return Err((Some(row + 1), problem));
        }
        jitter_s = jitter_s.max(off_s);
        places.push(place);
    }
    let step_s = (last - first) / place as f64;
    // Rounding of decimal times such as 0.001 would otherwise change the last digits of every result that uses the step.
    let whole_rate_hz = (1.0 / step_s).round();
    let dust = (whole_rate_hz * step_s - 1.0).abs() < 1e-9;
    Ok(Grid {
        step_s: if dust { 1.0 / whole_rate_hz } else { step_s },
        places,
        jitter_s,
    })
}
