//! The project's one generator of random numbers.

use rand_core::{Rng, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;

/// Seeded random numbers, the same on every machine: xoshiro256++, and Marsaglia's polar method for normal ones.
///
/// A seed fixes every bit. Drawing allocates nothing and reads no clock.
#[derive(Debug, Clone)]
pub struct Random {
    generator: Xoshiro256PlusPlus,
    spare: Option<f64>,
}

impl Random {
    /// The sequence of a `seed`.
    pub fn new(seed: u64) -> Self {
        Self {
            generator: Xoshiro256PlusPlus::seed_from_u64(seed),
            spare: None,
        }
    }

    /// Stream number `stream` of `seed`. Each purpose has its own stream, so that switching off one source of noise
    /// does not change the numbers of the others.
    pub fn stream(seed: u64, stream: u64) -> Self {
        // An odd multiplier keeps the streams of one seed apart; the generator's own seeding mixes the rest.
        Self::new(seed.wrapping_add(stream.wrapping_mul(0x9e37_79b9_7f4a_7c15)))
    }

    /// 64 random bits.
    pub fn bits(&mut self) -> u64 {
        self.generator.next_u64()
    }

    /// Uniform in \[0, 1).
    pub fn uniform(&mut self) -> f64 {
        // The upper 53 bits are a double's mantissa.
        (self.bits() >> 11) as f64 * (1.0 / (1_u64 << 53) as f64)
    }

    /// Mean 0, variance 1. Every second call returns the second number of a pair.
    pub fn normal(&mut self) -> f64 {
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

    /// A whole number in `0..below` (0 when `below` is 0).
    pub fn below(&mut self, below: usize) -> usize {
        ((self.uniform() * below as f64) as usize).min(below.saturating_sub(1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normal_numbers_have_the_moments_of_the_normal_distribution() {
        let mut random = Random::new(3);
        let n = 400_000;
        let (mut m1, mut m2, mut m4, mut tail) = (0.0, 0.0, 0.0, 0);
        for _ in 0..n {
            let x = random.normal();
            m1 += x;
            m2 += x * x;
            m4 += x.powi(4);
            tail += i32::from(x.abs() > 3.0);
        }
        // Four standard deviations of each estimate.
        let n = f64::from(n);
        assert!((m1 / n).abs() < 4.0 / n.sqrt());
        assert!((m2 / n - 1.0).abs() < 4.0 * (2.0 / n).sqrt());
        assert!((m4 / n - 3.0).abs() < 4.0 * (96.0 / n).sqrt());
        assert!((f64::from(tail) / n - 0.0027).abs() < 4.0 * (0.0027 / n).sqrt());
    }

    #[test]
    fn a_seed_and_a_stream_fix_every_bit_and_others_differ() {
        let draw = |mut random: Random| -> Vec<u64> {
            (0..64).map(|_| random.normal().to_bits()).collect()
        };
        assert_eq!(draw(Random::new(7)), draw(Random::stream(7, 0)));
        assert_ne!(draw(Random::new(7)), draw(Random::new(8)));
        assert_ne!(draw(Random::stream(7, 1)), draw(Random::stream(7, 2)));
    }

    #[test]
    fn uniform_numbers_stay_below_one_and_whole_ones_below_their_limit() {
        let mut random = Random::new(1);
        let mut seen = [0_u32; 5];
        for _ in 0..5000 {
            assert!((0.0..1.0).contains(&random.uniform()));
            seen[random.below(5)] += 1;
        }
        // Five standard deviations of a count of 1000 of 5000.
        assert!(seen.iter().all(|n| n.abs_diff(1000) < 142), "{seen:?}");
        assert_eq!(random.below(0), 0);
    }
}
