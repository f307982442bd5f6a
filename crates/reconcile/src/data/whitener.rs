//! The filter that knows the noise of a record.
//!
//! The free-run residual of a PERFECT model is a random walk plus white noise: its size says nothing. Its innovations in the
//! Kalman filter of that process (state: the walk; measurement: walk plus noise) are white with variance 1 in the units used here,
//! whatever the length of the record. All scores of this crate are sums of squared innovations, so a log-likelihood is half their
//! difference. Missing frames are predictions without an update.

use crate::data::flow_loss::FlowLoss;
use crate::data::loss_filter::Gains;
use crate::data::noise::NoiseModel;
use crate::data::row_noise::RowNoise;

impl NoiseModel {
    /// Standard deviation of the innovation in the steady state \[um\]: the floor.
    pub fn innovation_um(&self) -> f64 {
        let slow_rows =
            (self.coloured.map(|c| c.time_rows)).or_else(|| self.zero_flow.map(|z| z.time_rows));
        if let Some(time_rows) = slow_rows {
            // No closed form: the filter after so many rows that it stands still.
            let rows = 64 + (8.0 * time_rows).min(20_000.0) as usize;
            let filter = Whitener::new(self, &vec![true; rows], &RowNoise::default());
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
    second: Second,
}

/// The further state of the noise.
#[derive(Debug, Clone)]
enum Second {
    None,
    /// Coloured noise, which is added to the position.
    Added(SecondGain),
    /// A zero flow, which is added to the walk in every row.
    Moves(SecondGain),
    /// The same ahead of a chip with a loss.
    Lossy(SecondGain, LossGain),
}

/// The gains of the low-pass filtered zero flow.
#[derive(Debug, Clone)]
struct LossGain {
    gain: Vec<f64>,
    chip: FlowLoss,
}

/// The gains of that state.
#[derive(Debug, Clone)]
struct SecondGain {
    gain: Vec<f64>,
    /// Decay from row to row.
    keep: f64,
}

/// Covariance of the walk and the further state.
#[derive(Debug, Clone, Copy)]
struct Spread {
    walk: f64,
    second: f64,
    both: f64,
}

impl Whitener {
    /// `present[k]`: the frame counts.
    pub(crate) fn new(noise: &NoiseModel, present: &[bool], rows: &RowNoise) -> Self {
        debug_assert!(noise.coloured.is_none() || noise.zero_flow.is_none());
        if let Some((z, chip)) = noise.zero_flow.and_then(|z| Some((z, z.loss?))) {
            let gains = Gains::new(noise, (&z, chip), present, rows);
            return Self {
                gain: gains.walk,
                inverse_sigma: gains.inverse_sigma,
                second: Second::Lossy(
                    SecondGain {
                        gain: gains.flow,
                        keep: z.keep(),
                    },
                    LossGain {
                        gain: gains.filtered,
                        chip,
                    },
                ),
            };
        }
        let n = present.len();
        let (mut gain, mut inverse_sigma) = (vec![0.0; n], vec![0.0; n]);
        let (variance, keep, fresh) = match (&noise.coloured, &noise.zero_flow) {
            (Some(c), _) => {
                let keep = c.keep();
                (c.variance_um2, keep, (1.0 - keep * keep) * c.variance_um2)
            }
            (None, Some(z)) => (z.motion_um2, z.keep(), z.fresh_um2()),
            (None, None) => (0.0, 0.0, 0.0),
        };
        let moves = noise.zero_flow.is_some();
        let added = noise.coloured.is_some();
        let mut second_gain = vec![0.0; if moves || added { n } else { 0 }];
        let mut p = Spread {
            walk: f64::INFINITY,
            second: variance,
            both: 0.0,
        };
        for k in 0..n {
            if k > 0 {
                if moves {
                    p.walk += 2.0 * p.both + p.second;
                    p.both += p.second;
                }
                p.second = keep * keep * p.second + fresh;
                p.both *= keep;
            }
            p.walk += noise.walk_um2 + rows.walk_um2(k);
            if !present[k] {
                continue;
            }
            // What the second state adds to the position itself.
            let white_um2 = noise.white_um2 + rows.white_um2(k);
            let (own, shared) = if added {
                (p.second, p.both)
            } else {
                (0.0, 0.0)
            };
            if !p.walk.is_finite() {
                // The first frame only says where the bead is: the start is a nuisance.
                gain[k] = 1.0;
                p = Spread {
                    walk: white_um2 + own,
                    second: p.second,
                    both: -own,
                };
                continue;
            }
            let s = p.walk + 2.0 * shared + own + white_um2;
            gain[k] = (p.walk + shared) / s;
            inverse_sigma[k] = 1.0 / s.sqrt();
            let of_second = (own + p.both) / s;
            if let Some(g) = second_gain.get_mut(k) {
                *g = of_second;
            }
            p = Spread {
                walk: p.walk - gain[k] * gain[k] * s,
                second: p.second - of_second * of_second * s,
                both: p.both - gain[k] * of_second * s,
            };
        }
        let second = SecondGain {
            gain: second_gain,
            keep,
        };
        Self {
            gain,
            inverse_sigma,
            second: match (moves, added) {
                (true, _) => Second::Moves(second),
                (false, true) => Second::Added(second),
                (false, false) => Second::None,
            },
        }
    }

    /// Innovations of a residual, in standard deviations. The filter is linear: columns of a Jacobian go through it too.
    pub(crate) fn apply(&self, r: &[f64], e: &mut [f64]) {
        let rows = r.iter().zip(e).zip(&self.gain).zip(&self.inverse_sigma);
        let (mut m, mut c) = (0.0, 0.0);
        match &self.second {
            Second::None => {
                for (((r, e), k), s) in rows {
                    let d = r - m;
                    *e = d * s;
                    m += k * d;
                }
            }
            Second::Added(second) => {
                for ((((r, e), k), s), g) in rows.zip(&second.gain) {
                    let d = r - m - c;
                    *e = d * s;
                    m += k * d;
                    c = second.keep * (c + g * d);
                }
            }
            Second::Moves(second) => {
                for ((((r, e), k), s), g) in rows.zip(&second.gain) {
                    let d = r - m;
                    *e = d * s;
                    c += g * d;
                    m += k * d + c;
                    c *= second.keep;
                }
            }
            Second::Lossy(second, filtered) => {
                let (part, share) = (filtered.chip.part, filtered.chip.share);
                let gains = second.gain.iter().zip(&filtered.gain);
                let mut l = 0.0;
                for ((((r, e), k), s), (of_flow, of_filtered)) in rows.zip(gains) {
                    let d = r - m;
                    *e = d * s;
                    c += of_flow * d;
                    l += of_filtered * d;
                    m += k * d + c - part * l;
                    l += share * (c - l);
                    c *= second.keep;
                }
            }
        }
    }

    /// The slow noise at every row from the rows before it alone: a regressor may know it without being correlated with the row's
    /// own innovation.
    pub(crate) fn ahead(&self, r: &[f64]) -> Vec<f64> {
        let mut m = r.first().copied().unwrap_or(0.0);
        let (mut c, mut l) = (0.0, 0.0);
        r.iter()
            .enumerate()
            .map(|(k, r)| {
                let before = match self.second {
                    Second::Added(_) => m + c,
                    _ => m,
                };
                let d = r - before;
                m += self.gain[k] * d;
                match &self.second {
                    Second::None => {}
                    Second::Added(second) => c = second.keep * (c + second.gain[k] * d),
                    Second::Moves(second) => {
                        c += second.gain[k] * d;
                        m += c;
                        c *= second.keep;
                    }
                    Second::Lossy(second, filtered) => {
                        c += second.gain[k] * d;
                        l += filtered.gain[k] * d;
                        m += c - filtered.chip.part * l;
                        l += filtered.chip.share * (c - l);
                        c *= second.keep;
                    }
                }
                before
            })
            .collect()
    }

    /// Sum of the logarithms of the innovations' variances, of the rows that count.
    pub(crate) fn log_determinant(&self) -> f64 {
        let of = |s: &f64| if *s > 0.0 { -2.0 * s.ln() } else { 0.0 };
        self.inverse_sigma.iter().map(of).sum()
    }

    /// The walk at every row from the rows before and after it, but not from the row itself: independent of its noise.
    pub(crate) fn around(&self, r: &[f64]) -> Vec<f64> {
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

    /// The transpose of [`Self::apply`]: the contribution of each row's residual to the weighted sum of innovations.
    pub(crate) fn transpose(&self, weights: &[f64]) -> Vec<f64> {
        let mut z = vec![0.0; weights.len()];
        // What the states before the next row add to the weighted sum.
        let (mut later, mut later_second, mut later_filtered) = (0.0, 0.0, 0.0);
        for k in (0..weights.len()).rev() {
            let mut own = self.inverse_sigma[k] * weights[k] + self.gain[k] * later;
            match &self.second {
                Second::None => {}
                Second::Added(second) => {
                    own += second.keep * second.gain[k] * later_second;
                    later_second = second.keep * later_second - own;
                }
                Second::Moves(second) => {
                    later_second = later + second.keep * later_second;
                    own += second.gain[k] * later_second;
                }
                Second::Lossy(second, filtered) => {
                    let (part, share) = (filtered.chip.part, filtered.chip.share);
                    later_second = later + second.keep * later_second + share * later_filtered;
                    later_filtered = (1.0 - share) * later_filtered - part * later;
                    own += second.gain[k] * later_second + filtered.gain[k] * later_filtered;
                }
            }
            z[k] = own;
            later -= own;
        }
        z
    }

    /// Number of innovations that count.
    pub(crate) fn count(&self) -> usize {
        self.inverse_sigma.iter().filter(|s| **s > 0.0).count()
    }

    /// Whether the innovation of row k counts.
    pub(crate) fn counts(&self, k: usize) -> bool {
        self.inverse_sigma[k] > 0.0
    }

    /// Innovation standard deviation of row k \[um\]; `None` when it does not count.
    #[cfg(test)]
    pub(crate) fn sigma_um(&self, k: usize) -> Option<f64> {
        (self.inverse_sigma[k] > 0.0).then(|| 1.0 / self.inverse_sigma[k])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::motion::ZeroFlow;
    use crate::data::noise::Coloured;

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
        let w = Whitener::new(&n, &vec![true; 2000], &RowNoise::default());
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
        let w = Whitener::new(noise, &present, &RowNoise::default());
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
        let filter = Whitener::new(&n, &[true; 3], &RowNoise::default());
        let expected = (variance * variance - next * next).ln();
        assert!((filter.log_determinant() - expected).abs() < 1e-12);
        transposed_as_applied(&n);
    }

    #[test]
    fn the_filter_of_a_zero_flow_that_moves_whitens_it_and_has_its_transpose() {
        let zero_flow = ZeroFlow {
            motion_um2: 4e-4,
            time_rows: 7.0,
            drift_um: 0.0,
            loss: None,
        };
        let n = NoiseModel {
            zero_flow: Some(zero_flow),
            ..NoiseModel::new(0.33, 1e-3, 0.030)
        };
        // Increments of three rows by hand: a step of the walk, the motion of the row before, and the difference of two white numbers.
        let (q, r, v) = (n.walk_um2, n.white_um2, zero_flow.motion_um2);
        let variance = q + 2.0 * r + v;
        let next = zero_flow.keep() * v - r;
        let filter = Whitener::new(&n, &[true; 3], &RowNoise::default());
        let expected = (variance * variance - next * next).ln();
        assert!((filter.log_determinant() - expected).abs() < 1e-12);
        let y = [0.3, 0.41, 0.37];
        let (a, b) = (y[1] - y[0], y[2] - y[1]);
        let by_hand =
            (variance * (a * a + b * b) - 2.0 * next * a * b) / (variance * variance - next * next);
        let mut e = [0.0; 3];
        filter.apply(&y, &mut e);
        let filtered: f64 = e.iter().map(|e| e * e).sum();
        assert!(
            (filtered / by_hand - 1.0).abs() < 1e-12,
            "{filtered} {by_hand}"
        );
        transposed_as_applied(&n);
    }

    #[test]
    fn the_filter_of_a_flow_ahead_of_a_chip_with_a_loss_whitens_it_and_has_its_transpose() {
        let (keep, v) = ((-1.0f64 / 7.0).exp(), 4e-4);
        let chip = FlowLoss {
            part: 0.8,
            share: 0.3,
        };
        let n = NoiseModel {
            zero_flow: Some(ZeroFlow {
                motion_um2: v,
                time_rows: 7.0,
                drift_um: 0.0,
                loss: Some(chip),
            }),
            ..NoiseModel::new(0.33, 1e-3, 0.030)
        };
        // Covariance of the motions of two rows by the sum over all of the past.
        let response = |k: usize| match k {
            0 => 1.0,
            // What a unit of flow leaves of itself k rows later, less the part of what lasts.
            k => {
                let lasts = |j: usize| 0.3 * 0.7f64.powi((k - 1 - j) as i32) * keep.powi(j as i32);
                keep.powi(k as i32) - 0.8 * (0..k).map(lasts).sum::<f64>()
            }
        };
        let fresh = v * (1.0 - keep * keep);
        let motion = |lag: usize| -> f64 {
            let products = (0..400).map(|k| response(k) * response(k + lag));
            fresh * products.sum::<f64>()
        };
        let (q, r) = (n.walk_um2, n.white_um2);
        let variance = q + 2.0 * r + motion(0);
        let next = motion(1) - r;
        let filter = Whitener::new(&n, &[true; 3], &RowNoise::default());
        let expected = (variance * variance - next * next).ln();
        let found = filter.log_determinant();
        assert!((found - expected).abs() < 1e-10, "{found} {expected}");
        transposed_as_applied(&n);
    }

    #[test]
    fn a_missing_frame_counts_nothing_and_widens_the_next_innovation() {
        let n = NoiseModel::new(0.33, 1e-3, 0.030);
        let mut present = vec![true; 100];
        present[50] = false;
        let w = Whitener::new(&n, &present, &RowNoise::default());
        assert_eq!(w.count(), 98);
        assert!(w.sigma_um(51).unwrap() > w.sigma_um(49).unwrap());
        assert!(w.sigma_um(50).is_none());
    }
}
