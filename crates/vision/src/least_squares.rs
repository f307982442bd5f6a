//! Normal equations of a linear fit of a window's pixels, four of them at a time.

use crate::crop::{LANES, Row};
use nalgebra::{SMatrix, SVector};
use wide::f32x4;

/// Four pixels of a row; zeros beyond its end.
#[inline(always)]
pub(crate) fn four(row: &Row, first: usize) -> f32x4 {
    let lanes = row.get(first..first + LANES).unwrap_or_default();
    f32x4::from(<[f32; LANES]>::try_from(lanes).unwrap_or_default())
}

/// Sums of products of `P` columns with each other and with the pixels, and of squares of the pixels.
pub(crate) struct Sums<const P: usize> {
    normal: [[f32x4; P]; P],
    right: [f32x4; P],
    squares: f32x4,
}

impl<const P: usize> Sums<P> {
    pub(crate) fn new() -> Self {
        Self {
            normal: [[f32x4::ZERO; P]; P],
            right: [f32x4::ZERO; P],
            squares: f32x4::ZERO,
        }
    }

    /// Adds four pixels `p` of these weights.
    #[inline(always)]
    pub(crate) fn add(&mut self, columns: &[f32x4; P], weight: f32x4, p: f32x4) {
        for i in 0..P {
            let weighted = weight * columns[i];
            for (sum, column) in self.normal[i].iter_mut().zip(columns).skip(i) {
                *sum += weighted * *column;
            }
            self.right[i] += weighted * p;
        }
        self.squares += weight * p * p;
    }

    /// Matrix and right side of the equations, and the sum of squares.
    pub(crate) fn equations(self) -> (SMatrix<f64, P, P>, SVector<f64, P>, f64) {
        let sum = |lanes: f32x4| f64::from(lanes.reduce_add());
        (
            SMatrix::from_fn(|i, k| sum(self.normal[i.min(k)][i.max(k)])),
            SVector::from_fn(|i, _| sum(self.right[i])),
            sum(self.squares),
        )
    }
}
