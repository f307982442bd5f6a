//! The minimum of a cost over one number.

use cellpos_numeric::golden_section;

/// Minimum between `low` and `high` of a cost with one minimum but flat ends: `looks` equal steps, then the golden
/// section about the best. None if an end is the smallest: the minimum is then outside.
pub(super) fn minimum(low: f64, high: f64, looks: u32, cost: impl Fn(f64) -> f64) -> Option<f64> {
    let at = |k: u32| low + (high - low) * f64::from(k) / f64::from(looks);
    let best = (0..=looks).min_by(|a, b| cost(at(*a)).total_cmp(&cost(at(*b))))?;
    if best == 0 || best == looks {
        return None;
    }
    Some(golden_section(at(best - 1), at(best + 1), 0.0, cost))
}

#[cfg(test)]
mod tests {
    use super::minimum;

    #[test]
    fn a_minimum_within_is_found_and_one_at_an_end_is_none() {
        let found = minimum(-3.0, 5.0, 24, |x| (x - 1.25).powi(2));
        assert!((found.unwrap() - 1.25).abs() < 1e-6);
        assert_eq!(minimum(2.0, 5.0, 24, |x| (x - 1.25).powi(2)), None);
    }
}
