//! Errors of neighbouring pixels that are alike: by how much the place scatters more than by as much white noise.
//!
//! The fit sets the score of the place to zero, so its residual does not show the part of such errors that has moved the bead. What it
//! shows are other functions of the same pixels that are about as wide. For a narrow bead this is the scatter of the score over
//! squares of pixels ([`observed`]). For a wider one it is a bend: a stretch of the bead along the row, and along the diagonal. Both are
//! orthogonal to place, contrast and level, and in white noise they have its variance. In pictures of a codec they have as much as the
//! place: its errors fill blocks of eight pixels, more than the patches that are taken to be independent.

use crate::observed;
use crate::pool::Pool;
use crate::template::Template;

/// Pairs of bends that are larger than so many times their mean do not count, so that a speck beside one bead, or on it, is no noise of
/// the others. The sum of two squares of normal noise is exponential: a share q = exp(-3) is larger, and the mean of the rest is
/// 1 - 3 q / (1 - q) of that of all. A mean that is too small grows: of what counts then the mean is half of the most.
const MOST: f64 = 3.0;
/// Noise is white at first, as if so many fixes had shown it: the mean of fewer is known to half of itself.
const WHITE_FIXES: f64 = 4.0;

/// What the windows of the last fixes have shown of it.
#[derive(Debug, Clone)]
pub(super) struct Alike {
    /// Variance of the score over that of white noise of the variance that windows have in common.
    scatter: Pool,
    /// The same for the noise of the window at hand.
    pub here: f64,
    /// Scatter of white noise of variance 1.
    white: f64,
    /// Squares of the bends along the row and along the diagonal, over the variance that is stated without them.
    /// Those of beads that were not seen before, and of others besides their own look.
    bends: [[Pool; 2]; 2],
}

impl Alike {
    pub(super) fn new(template: &Template, window_px: usize) -> Self {
        Alike {
            scatter: Pool::default(),
            here: 1.0,
            white: observed::of_white(template, window_px),
            bends: [[Pool::known(1.0, WHITE_FIXES); 2]; 2],
        }
    }

    /// Another template is in use.
    pub(super) fn learn(&mut self, template: &Template, window_px: usize) {
        self.white = observed::of_white(template, window_px);
    }

    /// Takes in the scatter of the score, in a window of some noise variance. It is pooled in the noise that windows have in common: it
    /// would vary with that of each window.
    pub(super) fn take_scatter(&mut self, scatter: f64, common: f64, variance: f64) {
        self.scatter.take_in(scatter / (self.white * common));
        self.here = self.scatter.mean * common / variance;
    }

    /// By how much the place scatters more than stated, by this fix's bends over the stated variance, and those of the last. Both bends
    /// have it. Offsets of rows and columns, which are stated apart, have only the first.
    pub(super) fn beyond(&mut self, bends: [f64; 2], is_known: bool) -> f64 {
        let pools = &mut self.bends[usize::from(is_known)];
        let usual: f64 = pools.iter().map(|pool| pool.mean).sum();
        let larger = (-MOST).exp();
        let rest = 1.0 - MOST * larger / (1.0 - larger);
        if bends.iter().sum::<f64>() <= MOST * usual {
            for (pool, bend) in pools.iter_mut().zip(bends) {
                pool.take_in(bend / rest);
            }
        }
        let [row, diagonal] = pools.map(|pool| pool.mean);
        row.min(diagonal).max(1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::LocaliserConfig;
    use crate::template::ProfileSpec;
    use cellpos_numeric::Random;

    /// After 400 fixes whose bends have variances.
    fn beyond(variances: impl Fn(u32) -> [f64; 2]) -> f64 {
        let spec = ProfileSpec::Gaussian { sigma_px: 1.5 };
        let template = LocaliserConfig::new(spec).template().unwrap();
        let mut alike = Alike::new(&template, 15);
        let mut random = Random::new(3);
        let mut mean = 0.0;
        for k in 0..400 {
            let found = alike.beyond(variances(k).map(|v| v * random.normal().powi(2)), false);
            mean += if k < 100 { 0.0 } else { found / 300.0 };
        }
        mean
    }

    #[test]
    fn noise_that_is_alike_counts_and_offsets_of_rows_and_a_few_specks_do_not() {
        let white = beyond(|_| [1.0, 1.0]);
        assert!(white < 1.1, "{white}");
        let alike = beyond(|_| [4.0, 4.0]);
        assert!((3.0..4.4).contains(&alike), "{alike}");
        let rows = beyond(|_| [9.0, 1.0]);
        assert!(rows < 1.1, "{rows}");
        // One bead in five has one, as the measured beads have.
        let specks = beyond(|k| [if k % 5 == 0 { 1e4 } else { 1.0 }; 2]);
        assert!(specks < 1.2, "{specks}");
    }
}
