//! What is always present: Brownian motion of the bead and white localisation noise, and the filter that knows them.
//!
//! The free-run residual of a PERFECT model is a random walk plus white noise: its size says nothing. Its innovations in
//! the Kalman filter of that process (state: the walk; measurement: walk plus noise) are white with variance 1 in the
//! units used here, whatever the length of the record. All scores of this crate are sums of squares of those
//! innovations, so a log-likelihood is half their difference. Missing frames are predictions without an update.

/// Sizes of the two noises.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct NoiseModel {
    /// Variance gained by the walk in one sample, `2 D dt` \[um^2\].
    pub walk_um2: f64,
    /// Variance of the localisation noise \[um^2\].
    pub white_um2: f64,
    /// Noise of a sensor that is slow and returns.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub coloured: Option<Coloured>,
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
        }
    }

    /// From variance and lag-1 covariance of increments, `q + 2 R` and `-R`, kept physical.
    pub fn from_increments(variance: f64, lag1: f64) -> Self {
        let variance = variance.max(1e-40);
        let white = (-lag1).clamp(0.005 * variance, 0.4995 * variance);
        Self {
            walk_um2: variance - 2.0 * white,
            white_um2: white,
            coloured: None,
        }
    }

    /// The same with at least so much white noise \[um^2\].
    pub fn at_least(self, white_um2: f64) -> Self {
        Self {
            white_um2: self.white_um2.max(white_um2),
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
        }
    }

    /// Diffusion coefficient \[um^2/s\].
    pub fn diffusion_um2_per_s(&self, sample_s: f64) -> f64 {
        self.walk_um2 / (2.0 * sample_s)
    }

    /// Localisation noise, RMS \[um\].
    pub fn localisation_um(&self) -> f64 {
        self.white_um2.sqrt()
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

    /// Standard deviation of the innovation in the steady state \[um\]: the floor.
    pub fn innovation_um(&self) -> f64 {
        if let Some(coloured) = self.coloured {
            // No closed form: the filter after so many rows that it stands still.
            let rows = 64 + (8.0 * coloured.time_rows).min(20_000.0) as usize;
            let filter = Whitener::new(self, &vec![true; rows], None);
            return 1.0 / filter.inverse_sigma[rows - 1];
        }
        let (q, r) = (self.walk_um2, self.white_um2);
        let p = 0.5 * (q + (q * q + 4.0 * q * r).sqrt());
        (p + r).sqrt()
    }
}

/// The whitening filter of one record: gains of its Kalman filter, zero where a frame is missing.
#[derive(Debug, Clone)]
pub(crate) struct Whitener {
    gain: Vec<f64>,
    inverse_sigma: Vec<f64>,
    coloured: Option<ColouredGain>,
}

/// The gains of the state of coloured noise.
#[derive(Debug, Clone)]
struct ColouredGain {
    gain: Vec<f64>,
    /// Decay from row to row.
    keep: f64,
}

/// Covariance of walk and coloured noise.
#[derive(Debug, Clone, Copy)]
struct Spread {
    walk: f64,
    coloured: f64,
    both: f64,
}

impl Whitener {
    /// `present[k]`: the frame counts. `extra_walk[k]`: variance added to the walk before frame k \[um^2\].
    pub fn new(noise: &NoiseModel, present: &[bool], extra_walk: Option<&[f64]>) -> Self {
        let n = present.len();
        let (mut gain, mut inverse_sigma) = (vec![0.0; n], vec![0.0; n]);
        let coloured = noise.coloured.unwrap_or_default();
        let (variance, keep) = (coloured.variance_um2, coloured.keep());
        let mut coloured_gain = noise.coloured.map(|_| vec![0.0; n]);
        let mut p = Spread {
            walk: f64::INFINITY,
            coloured: variance,
            both: 0.0,
        };
        for k in 0..n {
            if k > 0 {
                p.coloured = keep * keep * p.coloured + (1.0 - keep * keep) * variance;
                p.both *= keep;
            }
            p.walk += noise.walk_um2 + extra_walk.map_or(0.0, |w| w[k]);
            if !present[k] {
                continue;
            }
            if !p.walk.is_finite() {
                // The first frame only says where the bead is: the start is a nuisance.
                gain[k] = 1.0;
                p = Spread {
                    walk: noise.white_um2 + p.coloured,
                    coloured: p.coloured,
                    both: -p.coloured,
                };
                continue;
            }
            let s = p.walk + 2.0 * p.both + p.coloured + noise.white_um2;
            gain[k] = (p.walk + p.both) / s;
            inverse_sigma[k] = 1.0 / s.sqrt();
            let of_coloured = (p.coloured + p.both) / s;
            if let Some(g) = &mut coloured_gain {
                g[k] = of_coloured;
            }
            p = Spread {
                walk: p.walk - gain[k] * gain[k] * s,
                coloured: p.coloured - of_coloured * of_coloured * s,
                both: p.both - gain[k] * of_coloured * s,
            };
        }
        Self {
            gain,
            inverse_sigma,
            coloured: coloured_gain.map(|gain| ColouredGain { gain, keep }),
        }
    }

    /// Innovations of a residual, in standard deviations. The filter is linear: columns of a Jacobian go through it too.
    pub fn apply(&self, r: &[f64], e: &mut [f64]) {
        let rows = r.iter().zip(e).zip(&self.gain).zip(&self.inverse_sigma);
        let mut m = 0.0;
        match &self.coloured {
            None => {
                for (((r, e), k), s) in rows {
                    let d = r - m;
                    *e = d * s;
                    m += k * d;
                }
            }
            Some(coloured) => {
                let mut c = 0.0;
                for ((((r, e), k), s), g) in rows.zip(&coloured.gain) {
                    let d = r - m - c;
                    *e = d * s;
                    m += k * d;
                    c = coloured.keep * (c + g * d);
                }
            }
        }
    }

    /// The slow noise at every row from the rows before it alone: what a regressor may know without being correlated with the
    /// row's own innovation.
    pub fn ahead(&self, r: &[f64]) -> Vec<f64> {
        let mut m = r.first().copied().unwrap_or(0.0);
        let mut c = 0.0;
        r.iter()
            .enumerate()
            .map(|(k, r)| {
                let before = m + c;
                let d = r - before;
                m += self.gain[k] * d;
                if let Some(coloured) = &self.coloured {
                    c = coloured.keep * (c + coloured.gain[k] * d);
                }
                before
            })
            .collect()
    }

    /// Sum of the logarithms of the innovations' variances, of the rows that count.
    pub fn log_determinant(&self) -> f64 {
        let of = |s: &f64| if *s > 0.0 { -2.0 * s.ln() } else { 0.0 };
        self.inverse_sigma.iter().map(of).sum()
    }

    /// The walk at every row from the rows before and after it, but not from the row itself: independent of its noise.
    pub fn around(&self, r: &[f64]) -> Vec<f64> {
        let pass = |forward: bool| {
            let mut m = None;
            let mut known = vec![None; r.len()];
            for i in 0..r.len() {
                let k = if forward { i } else { r.len() - 1 - i };
                known[k] = m;
                if self.gain[k] > 0.0 {
                    let g = if self.gain[k] < 1.0 {
                        self.gain[k]
                    } else {
                        0.5
                    };
                    m = Some(m.map_or(r[k], |m: f64| m + g * (r[k] - m)));
                }
            }
            known
        };
        pass(true)
            .into_iter()
            .zip(pass(false))
            .map(|(a, b)| match (a, b) {
                (Some(a), Some(b)) => 0.5 * (a + b),
                (Some(a), None) | (None, Some(a)) => a,
                (None, None) => 0.0,
            })
            .collect()
    }

    /// The transpose of [`Self::apply`]: what a residual at each row adds to the weighted sum of innovations.
    pub fn transpose(&self, weights: &[f64]) -> Vec<f64> {
        let mut z = vec![0.0; weights.len()];
        let (mut later, mut later_coloured) = (0.0, 0.0);
        for k in (0..weights.len()).rev() {
            let mut own = self.inverse_sigma[k] * weights[k] + self.gain[k] * later;
            if let Some(coloured) = &self.coloured {
                own += coloured.keep * coloured.gain[k] * later_coloured;
                later_coloured = coloured.keep * later_coloured - own;
            }
            z[k] = own;
            later -= own;
        }
        z
    }

    /// Number of innovations that count.
    pub fn count(&self) -> usize {
        self.inverse_sigma.iter().filter(|s| **s > 0.0).count()
    }

    /// Whether the innovation of row k counts.
    pub fn counts(&self, k: usize) -> bool {
        self.inverse_sigma[k] > 0.0
    }

    /// Innovation standard deviation of row k \[um\]; `None` when it does not count.
    #[cfg(test)]
    pub fn sigma_um(&self, k: usize) -> Option<f64> {
        (self.inverse_sigma[k] > 0.0).then(|| 1.0 / self.inverse_sigma[k])
    }
}

/// Variance and lag-1 covariance of increments over runs of present frames, and how many increments.
pub(crate) fn increment_moments(r: &[f64], present: &[bool]) -> (f64, f64, usize) {
    let (mut c0, mut c1, mut n0, mut n1, mut mean) = (0.0, 0.0, 0usize, 0usize, 0.0);
    let valid = |k: usize| k >= 1 && present[k] && present[k - 1];
    for k in 1..r.len() {
        if valid(k) {
            mean += r[k] - r[k - 1];
            n0 += 1;
        }
    }
    if n0 == 0 {
        return (0.0, 0.0, 0);
    }
    mean /= n0 as f64;
    for k in 1..r.len() {
        if valid(k) {
            let d = r[k] - r[k - 1] - mean;
            c0 += d * d;
            if valid(k - 1) {
                c1 += d * (r[k - 1] - r[k - 2] - mean);
                n1 += 1;
            }
        }
    }
    (
        c0 / n0 as f64,
        if n1 > 0 { c1 / n1 as f64 } else { 0.0 },
        n0,
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_innovation_floor_of_the_nominal_rig_is_45_nanometres() {
        // theta of the MA(1) increments solves theta/(1+theta^2) = R/(q+2R); the innovation variance is R/theta.
        let n = NoiseModel::new(0.33, 1e-3, 0.030);
        let c = n.white_um2 / (n.walk_um2 + 2.0 * n.white_um2);
        let theta = (1.0 - (1.0 - 4.0 * c * c).sqrt()) / (2.0 * c);
        let expected = (n.white_um2 / theta).sqrt();
        assert!((n.innovation_um() - expected).abs() < 1e-12);
        assert!((n.innovation_um() - 0.045_48).abs() < 1e-4);
    }

    #[test]
    fn whitening_a_ramp_gives_its_closed_form_and_an_offset_gives_nothing() {
        let n = NoiseModel::new(0.33, 1e-3, 0.030);
        let w = Whitener::new(&n, &vec![true; 2000], None);
        let mut e = vec![0.0; 2000];
        w.apply(&vec![7.0; 2000], &mut e);
        assert!(e.iter().all(|e| e.abs() < 1e-9));
        let ramp: Vec<f64> = (0..2000).map(|k| 0.01 * f64::from(k)).collect();
        w.apply(&ramp, &mut e);
        // Steady state of a constant increment v: v / (1 - theta) / sigma.
        let theta = n.white_um2 / n.innovation_um().powi(2);
        let expected = 0.01 / (1.0 - theta) / n.innovation_um();
        assert!((e[1999] - expected).abs() < 1e-9, "{} {expected}", e[1999]);
    }

    /// One row of sixty is missing.
    fn transposed_as_applied(noise: &NoiseModel) {
        let mut present = vec![true; 60];
        present[17] = false;
        let w = Whitener::new(noise, &present, None);
        let wave = |a: f64| -> Vec<f64> { (0..60).map(|k| (a * f64::from(k)).sin()).collect() };
        let (r, weights) = (wave(0.7), wave(1.9));
        let mut e = vec![0.0; 60];
        w.apply(&r, &mut e);
        let direct: f64 = e.iter().zip(&weights).map(|(e, w)| e * w).sum();
        let z = w.transpose(&weights);
        let transposed: f64 = z.iter().zip(&r).map(|(z, r)| z * r).sum();
        assert!(
            (direct / transposed - 1.0).abs() < 1e-10,
            "{direct} {transposed}"
        );
    }

    #[test]
    fn the_transposed_filter_gives_the_same_inner_products() {
        transposed_as_applied(&NoiseModel::new(0.33, 1e-3, 0.030));
    }

    #[test]
    fn the_filter_of_coloured_noise_whitens_it_and_has_its_transpose() {
        let n = NoiseModel {
            coloured: Some(Coloured {
                variance_um2: 0.02,
                time_rows: 9.0,
            }),
            ..NoiseModel::new(0.33, 1e-3, 0.030)
        };
        // Covariance of three rows by hand, the level free: the determinant of the differences is that of the innovations.
        let keep = n.coloured.unwrap().keep();
        let (q, v, r) = (n.walk_um2, 0.02, n.white_um2);
        let variance = q + 2.0 * v * (1.0 - keep) + 2.0 * r;
        let next = v * (2.0 * keep - 1.0 - keep * keep) - r;
        let filter = Whitener::new(&n, &[true; 3], None);
        let expected = (variance * variance - next * next).ln();
        assert!((filter.log_determinant() - expected).abs() < 1e-12);

        transposed_as_applied(&n);
    }

    #[test]
    fn a_missing_frame_counts_nothing_and_widens_the_next_innovation() {
        let n = NoiseModel::new(0.33, 1e-3, 0.030);
        let mut present = vec![true; 100];
        present[50] = false;
        let w = Whitener::new(&n, &present, None);
        assert_eq!(w.count(), 98);
        assert!(w.sigma_um(51).unwrap() > w.sigma_um(49).unwrap());
        assert!(w.sigma_um(50).is_none());
    }
}
