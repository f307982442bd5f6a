//! The minimum of a cost over one number.

/// Minimum between `low` and `high` of a cost with one minimum but flat ends: `looks` equal steps, then `rounds` golden sections
/// about the best. None if an end is the smallest: the minimum is then outside.
pub(super) fn minimum(
    low: f64,
    high: f64,
    looks: u32,
    rounds: u32,
    cost: impl Fn(f64) -> f64,
) -> Option<f64> {
    let at = |k: u32| low + (high - low) * f64::from(k) / f64::from(looks);
    let best = (0..=looks).min_by(|a, b| cost(at(*a)).total_cmp(&cost(at(*b))))?;
    if best == 0 || best == looks {
        return None;
    }
    let golden = (5f64.sqrt() - 1.0) / 2.0;
    let (mut a, mut b) = (at(best - 1), at(best + 1));
    for _ in 0..rounds {
        let (c, d) = (b - golden * (b - a), a + golden * (b - a));
        if cost(c) < cost(d) {
            b = d;
        } else {
            a = c;
        }
    }
    Some(0.5 * (a + b))
}

#[cfg(test)]
mod tests {
    use super::minimum;

    #[test]
    fn a_minimum_within_is_found_and_one_at_an_end_is_none() {
        let found = minimum(-3.0, 5.0, 24, 40, |x| (x - 1.25).powi(2));
        assert!((found.unwrap() - 1.25).abs() < 1e-6);
        assert_eq!(minimum(2.0, 5.0, 24, 40, |x| (x - 1.25).powi(2)), None);
    }
}
