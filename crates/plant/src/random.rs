//! Seeded Gaussian numbers that are the same on every machine, for Brownian motion and localisation noise.

use rand_core::{Rng, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;

/// Standard normal numbers from a seed: xoshiro256++ and Marsaglia's polar method.
///
/// The natural logarithm and square root used are those of the standard library; no table, no clock, no allocation.
#[derive(Debug, Clone)]
pub struct Gaussian {
    generator: Xoshiro256PlusPlus,
    spare: Option<f64>,
}

impl Gaussian {
    /// A stream of numbers fixed by the seed.
    pub fn new(seed: u64) -> Self {
        Self {
            generator: Xoshiro256PlusPlus::seed_from_u64(seed),
            spare: None,
        }
    }

    /// A number uniform in \[0, 1).
    pub fn uniform(&mut self) -> f64 {
        // The upper 53 bits are a double's mantissa.
        (self.generator.next_u64() >> 11) as f64 * (1.0 / 9_007_199_254_740_992.0)
    }

    /// A number of mean 0 and variance 1.
    pub fn next_normal(&mut self) -> f64 {
        if let Some(spare) = self.spare.take() {
            return spare;
        }
        loop {
            let x = 2.0 * self.uniform() - 1.0;
            let y = 2.0 * self.uniform() - 1.0;
            let s = x * x + y * y;
            if s < 1.0 && s > 0.0 {
                let factor = (-2.0 * s.ln() / s).sqrt();
                self.spare = Some(y * factor);
                return x * factor;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normal_numbers_have_the_moments_of_the_normal_distribution() {
        let mut g = Gaussian::new(3);
        let n = 200_000;
        let (mut m1, mut m2, mut m4, mut tail) = (0.0, 0.0, 0.0, 0);
        for _ in 0..n {
            let x = g.next_normal();
            m1 += x;
            m2 += x * x;
            m4 += x.powi(4);
            tail += i32::from(x.abs() > 3.0);
        }
        let n = f64::from(n);
        assert!((m1 / n).abs() < 4.0 / n.sqrt());
        assert!((m2 / n - 1.0).abs() < 4.0 * (2.0 / n).sqrt());
        assert!((m4 / n - 3.0).abs() < 4.0 * (96.0 / n).sqrt());
        assert!((f64::from(tail) / n - 0.0027).abs() < 4.0 * (0.0027 / n).sqrt());
    }

    #[test]
    fn a_seed_fixes_every_bit_and_another_seed_differs() {
        let draw = |seed| {
            let mut g = Gaussian::new(seed);
            (0..64)
                .map(|_| g.next_normal().to_bits())
                .collect::<Vec<_>>()
        };
        assert_eq!(draw(7), draw(7));
        assert_ne!(draw(7), draw(8));
    }
}
