//! The filter that makes white noise of a bead's wandering.

use crate::error::BuildError;
use crate::riccati::solve_dare;
use nalgebra::{DMatrix, DVector};

/// Kalman filter of a random walk whose drift wanders as well, for fixes at any distance from each other.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Whitener {
    /// Variances per tick of the walk and of the drift's change, and the least of a fix, um^2.
    walk_um2: f64,
    drift_um2: f64,
    least_um2: f64,
    /// Covariance after a fix, where all have come as they should: position, both, drift; um^2.
    settled: Covariance,
    /// Gain of such a fix on position and drift, and the ticks between two.
    gain: [f64; 2],
    ticks: f64,
    /// Variance of the innovations if fixes come regularly, um^2.
    pub noise_um2: f64,
}

/// Covariance after a fix: position, both, drift; um^2.
pub(super) type Covariance = [f64; 3];

/// Correction of every series by a fix: all pass the same filter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Correction {
    /// Ticks since the fix before.
    pub ticks: f64,
    gain: [f64; 2],
    /// Covariance after it.
    pub after: Covariance,
    /// What makes the variance of an innovation that of one of a fix that comes regularly: less than 1 after a gap, more where a fix is better
    /// than was assumed.
    pub weight: f64,
}

/// Position and drift per tick of one series, um.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Track {
    at: f64,
    drift: f64,
}

impl Whitener {
    /// For variances per tick of the walk and of the drift's change, and of a fix, um^2, with `ticks` from fix to fix.
    pub(super) fn new(
        walk_um2: f64,
        drift_um2: f64,
        fix_um2: f64,
        ticks: f64,
    ) -> Result<Self, BuildError> {
        let a = DMatrix::from_row_slice(2, 2, &[1.0, ticks, 0.0, 1.0]);
        let seen = DVector::from_vec(vec![1.0, 0.0]);
        let q = [walk_um2 * ticks, drift_um2 * ticks];
        let q = DMatrix::from_diagonal(&DVector::from_row_slice(&q));
        // Exact fixes leave no equation to solve.
        let least_um2 = 1e-3 * walk_um2 * ticks;
        let fix_um2 = fix_um2.max(least_um2);
        let prior = solve_dare(&a.transpose(), &(&seen * seen.transpose() / fix_um2), &q)?;
        let prior = [prior[(0, 0)], prior[(0, 1)], prior[(1, 1)]];
        let (gain, settled) = corrected(prior, fix_um2);
        Ok(Self {
            walk_um2,
            drift_um2,
            least_um2,
            settled,
            gain,
            ticks,
            noise_um2: prior[0] + fix_um2,
        })
    }

    /// Its frequency response at an angle from fix to fix, rad: real and imaginary part.
    pub(super) fn response(&self, angle: f64) -> [f64; 2] {
        // 1/(1 + L), L = w (K0/(1 - w) + T K1/(1 - w)^2) with w = exp(-i angle).
        let (sin, cos) = angle.sin_cos();
        let (w, beside) = ([cos, -sin], [1.0 - cos, sin]);
        let over = |a: [f64; 2], b: [f64; 2]| {
            let b2 = b[0] * b[0] + b[1] * b[1];
            [
                (a[0] * b[0] + a[1] * b[1]) / b2,
                (a[1] * b[0] - a[0] * b[1]) / b2,
            ]
        };
        let one = over(w, beside);
        let two = over(one, beside);
        let [k0, k1] = [self.gain[0], self.ticks * self.gain[1]];
        over(
            [1.0, 0.0],
            [1.0 + k0 * one[0] + k1 * two[0], k0 * one[1] + k1 * two[1]],
        )
    }

    /// Covariance with which series begin.
    pub(super) fn settled(&self) -> Covariance {
        self.settled
    }

    /// Correction by a fix of this variance, um^2, `ticks` after the one before. `usual_um2` is the variance of the innovations of fixes
    /// that come regularly: what is more than [`Whitener::noise_um2`] is a disturbance. In a gap it goes on and nothing is learned of it.
    /// How it is coloured over the gap is not known, so it counts as if all innovations that are missing had the same sign.
    pub(super) fn correction(
        &self,
        [pp, pd, dd]: Covariance,
        ticks: f64,
        fix_um2: f64,
        usual_um2: f64,
    ) -> Correction {
        let fix_um2 = fix_um2.max(self.least_um2);
        let ticks = ticks.max(0.0);
        let prior = [
            pp + ticks * (2.0 * pd + ticks * dd) + self.walk_um2 * ticks,
            pd + ticks * dd,
            dd + self.drift_um2 * ticks,
        ];
        let (gain, after) = corrected(prior, fix_um2);
        let usual_um2 = usual_um2.max(self.noise_um2);
        let missed = (ticks / self.ticks - 1.0).max(0.0);
        let unseen = 1.0 + missed * (self.gain[0] + 0.5 * self.gain[1] * ticks);
        let disturbed_um2 = unseen * unseen * (usual_um2 - self.noise_um2);
        Correction {
            ticks,
            gain,
            after,
            weight: (usual_um2 / (prior[0] + fix_um2 + disturbed_um2)).sqrt(),
        }
    }

    /// A series that begins here.
    pub(super) fn begin(value: f64) -> Track {
        Track {
            at: value,
            drift: 0.0,
        }
    }
}

/// Gain of a fix, and the covariance after it.
fn corrected([pp, pd, dd]: Covariance, fix_um2: f64) -> ([f64; 2], Covariance) {
    let gain = [pp / (pp + fix_um2), pd / (pp + fix_um2)];
    let left = 1.0 - gain[0];
    (gain, [left * pp, left * pd, dd - gain[1] * pd])
}

impl Correction {
    /// Innovation of a value.
    pub(super) fn innovation(&self, track: &Track, value: f64) -> f64 {
        value - (track.at + track.drift * self.ticks)
    }

    /// A fix with that innovation.
    pub(super) fn step(&self, track: &mut Track, innovation: f64) {
        track.at += track.drift * self.ticks + self.gain[0] * innovation;
        track.drift += self.gain[1] * innovation;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A sine beside the walk, with every second gap of some length: the weighed innovation after a gap is no larger than usual.
    #[test]
    fn what_shakes_the_bead_in_a_gap_makes_the_fix_after_it_worth_less() {
        let whitener = Whitener::new(3.3e-4, 1e-9, 4e-4, 1.0).unwrap();
        for (hz, um) in [(0.7, 2.0), (7.0, 0.5), (50.0, 0.3), (150.0, 0.1)] {
            for gap in [2, 10, 100] {
                let mut random = cellpos_numeric::Random::new(gap);
                let mut filter = whitener.settled();
                let mut track = Whitener::begin(0.0);
                let (mut walk_um, mut last) = (0.0, 0);
                let (mut usual_um2, mut after_um2, mut gaps) = (whitener.noise_um2, 0.0, 0.0);
                for tick in 0..400_000_u64 {
                    walk_um += 3.3e-4_f64.sqrt() * random.normal();
                    if tick % 1997 != 0 && tick % 1997 < gap {
                        continue;
                    }
                    let line_um = um * (std::f64::consts::TAU * hz * 5e-4 * tick as f64).sin();
                    let seen_um = walk_um + line_um + 0.02 * random.normal();
                    let ticks = (tick - last) as f64;
                    let fix = whitener.correction(filter, ticks, 4e-4, usual_um2);
                    let innovation = fix.innovation(&track, seen_um);
                    fix.step(&mut track, innovation);
                    (filter, last) = (fix.after, tick);
                    let weighed_um2 = (fix.weight * innovation).powi(2);
                    if tick > 10_000 && ticks > 1.0 {
                        after_um2 += weighed_um2;
                        gaps += 1.0;
                    } else {
                        usual_um2 += 1e-3 * (weighed_um2 - usual_um2);
                    }
                }
                let part = after_um2 / gaps / usual_um2;
                // A slow line is hardly larger than the noise by which it is measured: 1.6.
                assert!(part < 1.8, "{hz} Hz, {gap} ticks: {part} of {usual_um2}");
            }
        }
    }

    #[test]
    fn fixes_that_come_as_they_should_keep_the_covariance_and_after_a_gap_it_comes_back() {
        for ticks in [1.0, 2.0, 5.0] {
            let whitener = Whitener::new(6.6e-4, 1e-9, 4e-4, ticks).unwrap();
            let near = |a: Covariance, b: Covariance| {
                a.iter()
                    .zip(b)
                    .all(|(a, b)| (a - b).abs() < 1e-9 * b.abs().max(1e-9))
            };
            let one = whitener.correction(whitener.settled(), ticks, 4e-4, 0.0);
            assert!(near(one.after, whitener.settled()), "{one:?}");
            assert!((one.weight - 1.0).abs() < 1e-9, "{one:?}");
            let mut gap = whitener.correction(whitener.settled(), 3.0 * ticks, 4e-4, 0.0);
            assert!(gap.weight < 0.8, "{gap:?}");
            for _ in 0..20_000 {
                gap = whitener.correction(gap.after, ticks, 4e-4, 0.0);
            }
            assert!(near(gap.after, whitener.settled()), "{gap:?}");
        }
    }
}
