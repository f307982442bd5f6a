//! The finest step of a column of numbers.

/// The finest step that the values show: a power of ten of which all are multiples, or the smallest increment.
pub(crate) fn resolution(values: &[f64]) -> f64 {
    let largest = values
        .iter()
        .filter(|v| v.is_finite())
        .fold(0.0f64, |a, v| a.max(v.abs()));
    // Numbers may be in any unit: ten decades below the largest.
    let top = if largest.is_normal() {
        largest.log10().floor() as i32
    } else {
        0
    };
    for e in 0..10 {
        let step = 10f64.powi(top - e);
        let fits = values.iter().filter(|v| v.is_finite()).take(4000).all(|v| {
            let x = v / step;
            (x - x.round()).abs() < 1e-5 + 1e-12 * x.abs()
        });
        if largest > 0.0 && fits {
            return step.max(least_increment(values));
        }
    }
    least_increment(values)
}

/// The smallest increment that is not zero: the step of a converter whose numbers were scaled.
fn least_increment(values: &[f64]) -> f64 {
    let size = values
        .iter()
        .filter(|v| v.is_finite())
        .fold(0.0f64, |a, v| a.max(v.abs()));
    values
        .windows(2)
        .map(|w| (w[1] - w[0]).abs())
        .filter(|d| *d > 1e-12 * size)
        .fold(f64::INFINITY, f64::min)
        .min(1e9)
}
