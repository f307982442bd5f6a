//! How sure a share of few runs is.

/// 95 % interval of a probability by which something happened `k` times in `n` (Clopper and Pearson).
pub(super) fn interval(k: usize, n: usize) -> [f64; 2] {
    if 2 * k > n {
        let [low, high] = interval(n - k, n);
        return [1.0 - high, 1.0 - low];
    }
    // Probability of at most `most` in n.
    let at_most = |most: usize, p: f64| -> f64 {
        let mut term = (1.0 - p).powi(n as i32);
        let mut sum = term;
        for i in 0..most {
            term *= (n - i) as f64 / (i + 1) as f64 * p / (1.0 - p);
            sum += term;
        }
        sum
    };
    let solve = |is_below: &dyn Fn(f64) -> bool| -> f64 {
        let (mut low, mut high) = (0.0, 1.0);
        for _ in 0..50 {
            let middle = 0.5 * (low + high);
            if is_below(middle) {
                low = middle;
            } else {
                high = middle;
            }
        }
        low
    };
    let low = if k == 0 {
        0.0
    } else {
        solve(&|p| 1.0 - at_most(k - 1, p) < 0.025)
    };
    [low, solve(&|p| at_most(k, p) > 0.025)]
}

#[test]
fn the_interval_of_a_probability_is_that_of_the_tables() {
    for (k, n, [low, high]) in [
        (0, 10, [0.0, 0.3085]),
        (1, 10, [0.0025, 0.4450]),
        (5, 10, [0.1871, 0.8129]),
        (0, 200, [0.0, 0.0183]),
        (200, 200, [0.9817, 1.0]),
    ] {
        let [from, to] = interval(k, n);
        assert!(
            (from - low).abs() < 1e-4 && (to - high).abs() < 1e-4,
            "{k} of {n}: {from} to {to}"
        );
    }
}
