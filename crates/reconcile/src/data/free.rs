//! Free motions of a record, in the space of innovations. Some are of any size: its level, its start. Others have a size with a prior: a
//! drift, an error of the model.

use crate::data::motion::FlowPaths;
use crate::data::noise::NoiseModel;
use crate::data::whitener::Whitener;
use crate::dot::dot;
use nalgebra::{DMatrix, SymmetricEigen};

/// Orthonormal innovations of the free motions, each with the part to remove.
#[derive(Debug, Clone, Default)]
pub(crate) struct Free {
    directions: Vec<(Vec<f64>, f64)>,
    /// Size of the first motion.
    first_size: f64,
    log_determinant: f64,
}

impl Free {
    /// Of transients of any size, of the drift that the noise has, and of further motions with a standard deviation of 1.
    pub(crate) fn new(
        noise: &NoiseModel,
        whitener: &Whitener,
        transients: &[Vec<f64>],
        flow: &FlowPaths,
        further: &[Vec<f64>],
    ) -> Self {
        let mut free = Self::default();
        for t in transients {
            if let Some((q, size)) = free.direction(whitener, t) {
                if free.directions.is_empty() {
                    free.first_size = size;
                }
                free.directions.push((q, 1.0));
            }
        }
        let times = |path: &[f64], size: f64| path.iter().map(|y| y * size).collect();
        let drift_um = noise.zero_flow.map_or(0.0, |z| z.drift_um);
        let mut with_size: Vec<Vec<f64>> = Vec::new();
        if drift_um > 0.0 {
            // The working point is as old as the record is long, or older: since then the zero flow drifted by as much again.
            let rows = flow.off.len() as f64;
            with_size = vec![
                times(&flow.drift, drift_um),
                times(&flow.off, drift_um * rows),
            ];
        }
        free.add(
            with_size
                .iter()
                .chain(further)
                .map(|path| {
                    let mut e = vec![0.0; path.len()];
                    whitener.apply(path, &mut e);
                    free.take_off(&mut e);
                    e
                })
                .collect(),
        );
        free
    }

    /// Adds innovations of motions of standard deviation 1. They are orthogonal to all before. Along each principal direction they add to
    /// the variance; squares there count 1 / variance.
    fn add(&mut self, motions: Vec<Vec<f64>>) {
        let n = motions.len();
        let products = DMatrix::from_fn(n, n, |i, j| dot(&motions[i], &motions[j]));
        // The decomposition of NaN would never end.
        if n == 0 || products.iter().any(|p| !p.is_finite()) {
            return;
        }
        let eigen = SymmetricEigen::new(products);
        let largest = eigen.eigenvalues.max();
        for (&square, way) in eigen
            .eigenvalues
            .iter()
            .zip(eigen.eigenvectors.column_iter())
        {
            if square <= 1e-9 * largest || square <= 1e-9 {
                continue;
            }
            let mut q = vec![0.0; motions[0].len()];
            for (motion, part) in motions.iter().zip(way.iter()) {
                let part = part / square.sqrt();
                q.iter_mut().zip(motion).for_each(|(q, e)| *q += part * e);
            }
            let variance = 1.0 + square;
            self.directions.push((q, 1.0 - 1.0 / variance.sqrt()));
            self.log_determinant += variance.ln();
        }
    }

    /// The direction of a motion without its part along the earlier directions, and its size.
    fn direction(&self, whitener: &Whitener, motion: &[f64]) -> Option<(Vec<f64>, f64)> {
        let mut w = vec![0.0; motion.len()];
        whitener.apply(motion, &mut w);
        let all = dot(&w, &w);
        self.take_off(&mut w);
        let left = dot(&w, &w);
        if left <= 1e-9 * all || left <= 0.0 {
            return None;
        }
        let size = left.sqrt();
        w.iter_mut().for_each(|w| *w /= size);
        Some((w, size))
    }

    /// Multiplies innovations by the inverse of their covariance with the free motions in it.
    pub(crate) fn weigh(&self, e: &mut [f64]) {
        for (q, part) in &self.directions {
            let share = part * (2.0 - part) * dot(q, e);
            e.iter_mut().zip(q).for_each(|(e, q)| *e -= share * q);
        }
    }

    /// How much of the first motion innovations hold.
    pub(crate) fn size_of_first(&self, e: &[f64]) -> f64 {
        let of = |(q, _): &(Vec<f64>, f64)| dot(q, e) / self.first_size;
        self.directions.first().map_or(0.0, of)
    }

    /// Removes the free motions from innovations.
    pub(crate) fn take_off(&self, e: &mut [f64]) {
        for (q, part) in &self.directions {
            let share = part * dot(q, e);
            e.iter_mut().zip(q).for_each(|(e, q)| *e -= share * q);
        }
    }

    /// What motions with a prior add to the logarithm of the determinant.
    pub(crate) fn log_determinant(&self) -> f64 {
        self.log_determinant
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::motion::ZeroFlow;
    use crate::data::row_noise::RowNoise;

    #[test]
    fn squares_and_determinant_are_those_of_a_covariance_with_the_drift_in_it() {
        // Two increments whose covariance with a drift is written out by hand.
        let noise = NoiseModel {
            zero_flow: Some(ZeroFlow {
                motion_um2: 1e-12,
                time_rows: 10.0,
                drift_um: 0.05,
                loss: None,
            }),
            ..NoiseModel::new(0.33, 1e-3, 0.0)
        };
        let y = [0.0, 0.03, 0.11];
        let whitener = Whitener::new(&noise, &[true; 3], &RowNoise::default());
        let flow = FlowPaths::new(vec![0.0, 1.0, 2.0]);
        let free = Free::new(&noise, &whitener, &[], &flow, &[]);
        let mut e = [0.0; 3];
        whitener.apply(&y, &mut e);
        free.take_off(&mut e);
        let squares: f64 = e.iter().map(|e| e * e).sum();

        // Motions of the drift in the two increments, and of the zero flow that is off: 3 in both.
        let path = &flow.drift;
        let (a, b) = (path[1] - path[0], path[2] - path[1]);
        let (q, d) = (noise.walk_um2, 0.05f64.powi(2));
        let covariance = [
            q + d * (a * a + 9.0),
            d * (a * b + 9.0),
            q + d * (b * b + 9.0),
        ];
        let determinant = covariance[0] * covariance[2] - covariance[1].powi(2);
        let (s, t) = (y[1] - y[0], y[2] - y[1]);
        let by_hand = (covariance[2] * s * s - 2.0 * covariance[1] * s * t + covariance[0] * t * t)
            / determinant;
        assert!(
            (squares / by_hand - 1.0).abs() < 1e-6,
            "{squares} {by_hand}"
        );
        let log = whitener.log_determinant() + free.log_determinant();
        assert!((log - determinant.ln()).abs() < 1e-6, "{log}");
    }
}
