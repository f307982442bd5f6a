//! Minimum of a function of one number.

/// Where a function with one minimum between `low` and `high` is least, to `tolerance` as a part of that range.
pub fn golden_section(low: f64, high: f64, tolerance: f64, cost: impl Fn(f64) -> f64) -> f64 {
    // Each step leaves this part of the range; so many reach the rounding of a double.
    const RATIO: f64 = 0.618_033_988_749_894_8;
    const MOST_STEPS: usize = 40;
    let (mut a, mut b) = (low, high);
    let (mut c, mut d) = (b - RATIO * (b - a), a + RATIO * (b - a));
    let (mut at_c, mut at_d) = (cost(c), cost(d));
    for _ in 0..MOST_STEPS {
        if at_c < at_d {
            (b, d, at_d) = (d, c, at_c);
            c = b - RATIO * (b - a);
            at_c = cost(c);
        } else {
            (a, c, at_c) = (c, d, at_d);
            d = a + RATIO * (b - a);
            at_d = cost(d);
        }
        if b - a < tolerance * (high - low) {
            break;
        }
    }
    0.5 * (a + b)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_least_of_a_parabola_is_found_to_the_tolerance() {
        let at = golden_section(-1.0, 3.0, 1e-6, |x| (x - 0.7).powi(2));
        assert!((at - 0.7).abs() < 4e-6, "{at}");
    }
}
