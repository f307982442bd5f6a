//! A zero flow that moves: strength and time from the residuals of a fit, by maximum posterior probability.
//!
//! In a closed loop the command follows the zero flow. A noise model without that state biases every slow effect of the response and
//! gives false ones.

use crate::data::motion::ZeroFlow;
use crate::data::noise::NoiseModel;

/// Zero flow of syringe, tube and reservoir (95 %): a displacement of 1 to 50 nm RMS with a correlation time of 3 to 100 s. Median, and
/// standard deviation of the logarithm. Without this prior a leak is mistaken for a zero flow that follows the command.
const DISPLACEMENT_UM: (f64, f64) = (0.007, 1.0);
const TIME_S: (f64, f64) = (17.0, 0.9);
/// The same for a flow that wanders beyond that of a rig, and has a name (`flow-wander`): 1 to 20 um/s RMS, 0.2 to 10 s.
const WANDER_UM_PER_S: (f64, f64) = (4.5, 0.75);
const WANDER_S: (f64, f64) = (1.4, 1.0);
/// Standard deviations from the medians within which it is noise: 95 % of the rigs. What moves by more is an effect that has a name, or the
/// misfit of a set that lacks one, and no noise hides it.
const MOST: f64 = 2.0;
/// Standard deviation of the drift \[um/s\]: 95 % of the rigs drift by less than 5 nm/s.
const DRIFT_UM_PER_S: f64 = 0.0025;

/// Prior of a zero flow, in rows and in motions of the bead.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Prior {
    sample_s: f64,
    /// Motion of the bead in a row over displacement.
    motion_per_um: f64,
    /// Median of the displacement \[um\], and standard deviation of its logarithm.
    displacement_um: (f64, f64),
    /// The same of the time \[s\].
    time_s: (f64, f64),
}

impl Prior {
    /// For a bead whose speed is `speed_per_um` \[1/s\] times the displacement.
    pub(crate) fn new(speed_per_um: f64, sample_s: f64) -> Self {
        Self {
            sample_s,
            motion_per_um: speed_per_um * sample_s,
            displacement_um: DISPLACEMENT_UM,
            time_s: TIME_S,
        }
    }

    /// The same for a flow that wanders more than that of a rig does.
    pub(crate) fn of_wandering(self) -> Self {
        let (median, sd) = WANDER_UM_PER_S;
        Self {
            displacement_um: (median * self.sample_s / self.motion_per_um, sd),
            time_s: WANDER_S,
            ..self
        }
    }

    /// The zero flow at a number of standard deviations from the medians of displacement and time.
    fn at(&self, way: [f64; 2]) -> ZeroFlow {
        let [size, time] = way.map(|x| x.clamp(-MOST, MOST));
        let displacement_um = self.displacement_um.0 * (self.displacement_um.1 * size).exp();
        ZeroFlow {
            motion_um2: (displacement_um * self.motion_per_um).powi(2),
            time_rows: self.time_s.0 * (self.time_s.1 * time).exp() / self.sample_s,
            drift_um: DRIFT_UM_PER_S * self.sample_s * self.motion_per_um,
            loss: None,
        }
    }

    /// Displacement and time as standard deviations from the medians.
    fn of(&self, z: &ZeroFlow) -> [f64; 2] {
        let displacement_um = z.motion_um2.sqrt() / self.motion_per_um;
        let time_s = z.time_rows * self.sample_s;
        [
            (displacement_um / self.displacement_um.0).ln() / self.displacement_um.1,
            (time_s / self.time_s.0).ln() / self.time_s.1,
        ]
    }

    fn noise_at(&self, noise: &NoiseModel, x: [f64; 2]) -> NoiseModel {
        NoiseModel {
            zero_flow: Some(ZeroFlow {
                loss: noise.zero_flow.and_then(|z| z.loss),
                ..self.at(x)
            }),
            ..*noise
        }
    }

    /// The same noise with the zero flow of the medians.
    pub(crate) fn median(&self, noise: &NoiseModel) -> NoiseModel {
        self.noise_at(noise, [0.0; 2])
    }

    /// Cost of the zero flow of a noise in twice the log-likelihood, if it was estimated from the same residuals. It has two
    /// parts: the distance from the medians, and the factor by which size and time are known better than by the prior (Laplace's
    /// approximation of the evidence).
    pub(crate) fn price(
        &self,
        noise: &NoiseModel,
        unlikelihood: impl Fn(&NoiseModel) -> f64,
    ) -> f64 {
        let Some(z) = &noise.zero_flow else {
            return 0.0;
        };
        let [size, time, cross] = self.information(noise, z, unlikelihood);
        let determinant = (1.0 + size) * (1.0 + time) - cross * cross;
        let way = self.of(z);
        way.iter().map(|x| x * x).sum::<f64>() + determinant.max(1.0).ln()
    }

    /// Standard errors of the logarithms of size and time of the zero flow of a noise.
    pub(crate) fn errors(
        &self,
        noise: &NoiseModel,
        unlikelihood: impl Fn(&NoiseModel) -> f64,
    ) -> [f64; 2] {
        let Some(z) = &noise.zero_flow else {
            return [f64::INFINITY; 2];
        };
        let [size, time, cross] = self.information(noise, z, unlikelihood);
        let determinant = ((1.0 + size) * (1.0 + time) - cross * cross).max(1.0);
        let [of_size, of_time] = [1.0 + time, 1.0 + size].map(|i| (i / determinant).sqrt());
        [self.displacement_um.1 * of_size, self.time_s.1 * of_time]
    }

    /// Information of the records on size, time and both, in the prior's standard deviations.
    fn information(
        &self,
        noise: &NoiseModel,
        z: &ZeroFlow,
        unlikelihood: impl Fn(&NoiseModel) -> f64,
    ) -> [f64; 3] {
        const STEP: f64 = 0.3;
        let x = self.of(z);
        let value = |way: [f64; 2], step: f64| {
            unlikelihood(&self.noise_at(noise, [x[0] + step * way[0], x[1] + step * way[1]]))
        };
        let here = value([0.0; 2], 0.0);
        // Half the second derivative is the information, that of the prior is 1.
        let [size, time, both] = WAYS.map(|way| {
            let bend = value(way, STEP) + value(way, -STEP) - 2.0 * here;
            0.5 * bend / (STEP * STEP)
        });
        [size.max(0.0), time.max(0.0), 0.5 * (both - size - time)]
    }

    /// The same noise with the most probable zero flow; `unlikelihood` is twice the negative log-likelihood of the residuals.
    pub(crate) fn estimate(
        &self,
        noise: &NoiseModel,
        unlikelihood: impl Fn(&NoiseModel) -> f64,
    ) -> NoiseModel {
        let begun = noise.zero_flow.map_or([0.0, 0.0], |z| self.of(&z));
        let x = descend(begun, 0.05, |x| {
            unlikelihood(&self.noise_at(noise, x)) + x.iter().map(|x| x * x).sum::<f64>()
        });
        self.noise_at(noise, x)
    }
}

/// Along the size, along the time, and along both together, of which short records tell the ratio alone.
const WAYS: [[f64; 2]; 3] = [[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]];

/// Descends by steps that become smaller, down to `finest`.
pub(crate) fn descend(begun: [f64; 2], finest: f64, value: impl Fn([f64; 2]) -> f64) -> [f64; 2] {
    let (mut x, mut least) = (begun, value(begun));
    let mut step = 1.6;
    while step > finest {
        let best = WAYS
            .iter()
            .flat_map(|w| [-step, step].map(|s| [x[0] + s * w[0], x[1] + s * w[1]]))
            .map(|x| (x, value(x)))
            .min_by(|a, b| a.1.total_cmp(&b.1));
        match best {
            Some((at, c)) if c < least - 1e-2 => (x, least) = (at, c),
            _ => step *= 0.5,
        }
    }
    x
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::free::Free;
    use crate::data::motion::FlowPaths;
    use crate::data::row_noise::RowNoise;
    use crate::data::whitener::Whitener;
    use crate::dot::dot;

    /// A bead of the nominal rig over a zero flow of a motion a row (RMS) and a time, or of a steady change.
    fn series(rows: usize, motion_um: f64, time_rows: f64, drift: f64, seed: u64) -> Vec<f64> {
        let n = NoiseModel::new(0.33, 1e-3, 0.030);
        let mut random = cellpos_numeric::Random::new(seed);
        let keep = (-1.0 / time_rows).exp();
        let mut v = motion_um * random.normal();
        let mut m = 0.0;
        (0..rows)
            .map(|k| {
                m += v + drift * k as f64 + n.walk_um2.sqrt() * random.normal();
                v = keep * v + (1.0 - keep * keep).sqrt() * motion_um * random.normal();
                m + n.white_um2.sqrt() * random.normal()
            })
            .collect()
    }

    fn estimated(series: &[f64]) -> (NoiseModel, f64) {
        let present = vec![true; series.len()];
        let still = NoiseModel::new(0.33, 1e-3, 0.030);
        let prior = Prior::new(400.0, 1e-3);
        let unlikelihood = |noise: &NoiseModel| {
            let whitener = Whitener::new(noise, &present, &RowNoise::default());
            let flow = FlowPaths::new((0..series.len()).map(|k| k as f64).collect());
            let free = Free::new(noise, &whitener, &[], &flow, &[]);
            let mut e = vec![0.0; series.len()];
            whitener.apply(series, &mut e);
            free.take_off(&mut e);
            dot(&e, &e) + whitener.log_determinant() + free.log_determinant()
        };
        let moving = prior.estimate(&still, unlikelihood);
        let gain =
            unlikelihood(&still) - unlikelihood(&moving) - prior.price(&moving, unlikelihood);
        (moving, gain)
    }

    #[test]
    fn a_zero_flow_that_moves_is_found_with_its_strength() {
        // 5 nm of displacement that move the bead by 2 nm a row, for five seconds.
        for seed in 1..5 {
            let (noise, gain) = estimated(&series(40_000, 0.002, 5000.0, 0.0, seed));
            let z = noise.zero_flow.expect("a zero flow");
            // The motion gained in a second is better known than size or time alone: the record has eight correlation times.
            let found = z.motion_um2 / z.time_rows / (4e-6 / 5000.0);
            assert!(gain > 20.0, "{gain}");
            assert!(found.ln().abs() < 1.4, "{found} {z:?}");
        }
    }

    #[test]
    fn a_zero_flow_that_stands_still_gains_nothing() {
        for seed in 1..7 {
            let (noise, gain) = estimated(&series(20_000, 0.0, 1.0, 0.0, seed));
            assert!(gain < 0.0, "{gain} {noise:?}");
        }
    }

    #[test]
    fn a_drift_of_the_zero_flow_is_told_from_its_wandering() {
        // 0.4 nm a row more in every second: 1 nm/s of displacement at 400 1/s.
        let (noise, gain) = estimated(&series(38_000, 0.0, 1.0, 0.4e-6, 3));
        let z = noise.zero_flow.expect("a zero flow");
        assert!(gain > 100.0, "{gain} {z:?}");
    }
}
