//! An analogue input that was sampled with the output: what it did between its samples.

/// Samples on each side from which a value between two samples is made.
const SIDE: usize = 8;

/// Weights of the samples around a place `at` between two of them, in parts of their distance from the first: a sinc under a Hann window.
/// Half of the samples lie on each side.
fn weights(at: f64) -> [f64; 2 * SIDE] {
    let mut all = [0.0; 2 * SIDE];
    for (i, w) in all.iter_mut().enumerate() {
        let x = std::f64::consts::PI * (at + (SIDE - 1) as f64 - i as f64);
        let sinc = if x.abs() < 1e-9 { 1.0 } else { x.sin() / x };
        *w = 0.5 * sinc * (1.0 + (x / SIDE as f64).cos());
    }
    let sum: f64 = all.iter().sum();
    all.map(|w| w / sum)
}

/// An analogue input between its samples, on a grid `fine` times as fine, in its own unit. It holds no frequency above half the rate, or
/// its samples would not tell it: up to 0.7 of that the window leaves it within half a percent. Each step of the grid holds the value at
/// its end, so that a plant without dynamics is exact at the samples.
pub fn between(u: &[f64], fine: usize) -> Vec<f64> {
    let between: Vec<[f64; 2 * SIDE]> = (1..=fine)
        .map(|i| weights(i as f64 / fine as f64))
        .collect();
    let (Some(first), Some(last)) = (u.first(), u.last()) else {
        return Vec::new();
    };
    let mut around = vec![*first; SIDE - 1];
    around.extend_from_slice(u);
    around.resize(u.len() + 2 * SIDE - 1, *last);
    let mut x = Vec::with_capacity(fine * u.len());
    for near in around.windows(2 * SIDE) {
        x.extend((between.iter()).map(|w| w.iter().zip(near).map(|(w, u)| w * u).sum::<f64>()));
    }
    x
}

/// Replaces values at the steps' ends by the mean over each step of a smooth signal that goes through them, exact to the third power: what
/// a plant without a direct path answers to. The mean of a straight line would take `(w h)^2/12` off a frequency `w`.
pub fn means(x: &mut [f64]) {
    let first = x.first().copied().unwrap_or(0.0);
    let last = x.last().copied().unwrap_or(0.0);
    let (mut a, mut b) = (first, first);
    for j in 0..x.len() {
        let (c, d) = (x[j], x.get(j + 1).copied().unwrap_or(last));
        x[j] = (13.0 * (b + c) - a - d) / 24.0;
        (a, b) = (b, c);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sine_of_seven_tenths_of_half_the_rate_goes_on_between_its_samples_and_in_their_means() {
        const FINE: usize = 4;
        for w in [0.1, 0.7 * std::f64::consts::PI] {
            let at = |k: f64| (w * k).sin();
            let u: Vec<f64> = (0..200).map(|k| at(f64::from(k))).collect();
            let mut x = between(&u, FINE);
            for (j, x) in x.iter().enumerate().take(700).skip(100) {
                let right = at((j + 1) as f64 / FINE as f64);
                assert!((x - right).abs() < 0.01, "{w} {j}: {x} {right}");
            }
            means(&mut x);
            let area = |k: f64| -(w * k).cos() / w;
            for (j, x) in x.iter().enumerate().take(700).skip(100) {
                let (a, b) = (j as f64 / FINE as f64, (j + 1) as f64 / FINE as f64);
                let right = (area(b) - area(a)) / (b - a);
                assert!((x - right).abs() < 0.012, "{w} {j}: {x} {right}");
            }
        }
    }
}
