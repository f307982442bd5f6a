//! What is always present: Brownian motion of the bead and white localisation noise; what may be: a sensor that is slow, a zero flow
//! that moves.

use crate::data::flow_loss::FlowLoss;
use crate::data::motion::ZeroFlow;

/// Sizes of the two noises.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct NoiseModel {
    /// Variance gained by the walk in one sample, `2 D dt` \[um^2\].
    pub walk_um2: f64,
    /// Variance of the localisation noise, less the part of the walk that the exposure averages out \[um^2\].
    pub white_um2: f64,
    /// Noise of a sensor that is slow and returns.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub coloured: Option<Coloured>,
    /// Motion of the zero flow; never together with [`Self::coloured`], which belongs to a sensor without a bead.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub zero_flow: Option<ZeroFlow>,
}

/// A first-order Gauss-Markov process.
#[derive(Debug, Clone, Copy, PartialEq, Default, serde::Serialize)]
pub struct Coloured {
    /// Its variance \[um^2\].
    pub variance_um2: f64,
    /// Its correlation time \[rows\].
    pub time_rows: f64,
}

impl Coloured {
    /// What is left of a value a row later.
    pub fn keep(&self) -> f64 {
        if self.time_rows > 0.0 {
            (-1.0 / self.time_rows).exp()
        } else {
            0.0
        }
    }
}

impl NoiseModel {
    /// Brownian motion of coefficient `d_um2_per_s` sampled every `sample_s`, and white noise of `localisation_um` RMS.
    pub fn new(d_um2_per_s: f64, sample_s: f64, localisation_um: f64) -> Self {
        Self {
            walk_um2: 2.0 * d_um2_per_s * sample_s,
            white_um2: localisation_um * localisation_um,
            coloured: None,
            zero_flow: None,
        }
    }

    /// Correlation of successive increments if next to all of them is white noise.
    pub(crate) const LEAST_CORRELATION: f64 = -0.4995;
    /// The same of a walk that is averaged over the whole row: `q/6` of `q - 2 q/6`.
    pub(crate) const MOST_CORRELATION: f64 = 0.25;

    /// From variance and lag-1 covariance of increments, `q + 2 R` and `-R`, kept physical: a camera that averages over its
    /// exposure lowers the white part by up to `q / 6`, for an exposure of a whole row.
    pub fn from_increments(variance: f64, lag1: f64) -> Self {
        let variance = variance.max(1e-40);
        let correlation = (lag1 / variance).clamp(Self::LEAST_CORRELATION, Self::MOST_CORRELATION);
        let white = -correlation * variance;
        Self {
            walk_um2: variance - 2.0 * white,
            white_um2: white,
            coloured: None,
            zero_flow: None,
        }
    }

    /// The same with at least so much localisation noise \[um^2\]; increments have the variance that they had. The exposure may lower
    /// the white part, as [`Self::from_increments`] says.
    pub fn at_least(self, localisation_um2: f64) -> Self {
        let least_um2 = localisation_um2 - self.walk_um2 / 6.0;
        let more = (least_um2 - self.white_um2).max(0.0);
        Self {
            walk_um2: (self.walk_um2 - 2.0 * more).max(0.0),
            white_um2: self.white_um2 + more,
            ..self
        }
    }

    /// The same times a factor in variance.
    pub fn scaled(self, factor: f64) -> Self {
        Self {
            walk_um2: factor * self.walk_um2,
            white_um2: factor * self.white_um2,
            coloured: self.coloured.map(|c| Coloured {
                variance_um2: factor * c.variance_um2,
                ..c
            }),
            zero_flow: self.zero_flow.map(|z| ZeroFlow {
                motion_um2: factor * z.motion_um2,
                drift_um: factor.sqrt() * z.drift_um,
                ..z
            }),
        }
    }

    /// The same with another loss of the zero flow in the chip.
    pub(crate) fn with_loss(self, loss: Option<FlowLoss>) -> Self {
        Self {
            zero_flow: self.zero_flow.map(|z| ZeroFlow { loss, ..z }),
            ..self
        }
    }

    /// Diffusion coefficient \[um^2/s\].
    pub fn diffusion_um2_per_s(&self, sample_s: f64) -> f64 {
        self.walk_um2 / (2.0 * sample_s)
    }

    /// Localisation noise, RMS \[um\].
    pub fn localisation_um(&self) -> f64 {
        self.white_um2.max(0.0).sqrt()
    }

    /// Variance of the position of a row as known from the rows around it \[um^2\].
    pub fn position_um2(&self) -> f64 {
        let (q, r) = (self.walk_um2, self.white_um2);
        0.25 * (q + (q * q + 4.0 * q * r).sqrt())
    }

    /// Part of an error periodic in position over `pixel_um` that a position so uncertain still shows, 0..1.
    pub fn sharpness(&self, pixel_um: f64) -> f64 {
        (-0.5 * self.position_um2() * (std::f64::consts::TAU / pixel_um).powi(2)).exp()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_finest_step_of_the_file_leaves_the_white_noise_that_an_exposure_took_away() {
        // A walk whose camera averages over half of each row: 1/12 of it is missing in the white noise.
        let noise = NoiseModel::from_increments(1.0 - 2.0 / 12.0, 1.0 / 12.0);
        assert_eq!(noise.at_least(0.0), noise);
        assert_eq!(noise.at_least(1e-6), noise);
        // A step that is coarse for this walk shows all the same.
        let coarse = noise.at_least(1.0);
        assert!((coarse.white_um2 - (1.0 - noise.walk_um2 / 6.0)).abs() < 1e-12);
        let variance = |n: &NoiseModel| n.walk_um2 + 2.0 * n.white_um2;
        let small = noise.at_least(0.1);
        assert!((variance(&small) - variance(&noise)).abs() < 1e-12);
    }
}
