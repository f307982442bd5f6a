//! Noise that belongs to single rows, beside that of the rig.

/// Variances by row \[um^2\]; `None` where all are zero.
#[derive(Debug, Clone, Default)]
pub(crate) struct RowNoise {
    /// What the walk gains before each row: the command there is not known.
    pub walk: Option<Vec<f64>>,
    /// What a position has in addition to the localisation noise: its frame was late by a random time.
    pub white: Option<Vec<f64>>,
}

impl RowNoise {
    /// Gain of the walk before row `k` \[um^2\].
    pub(crate) fn walk_um2(&self, k: usize) -> f64 {
        self.walk.as_ref().map_or(0.0, |w| w[k])
    }

    /// Further variance of the position in row `k` \[um^2\].
    pub(super) fn white_um2(&self, k: usize) -> f64 {
        self.white.as_ref().map_or(0.0, |w| w[k])
    }
}
