//! Records made ready for fitting: commands from the working point, whitening filters, masks.

use crate::data::feedback::answers_frames;
use crate::data::flow_estimate;
use crate::data::flow_loss::FlowLoss;
use crate::data::free::Free;
use crate::data::motion::FlowPaths;
use crate::data::noise::NoiseModel;
use crate::data::record::{Record, command_range_um};
use crate::data::row_noise::RowNoise;
use crate::data::uncertain::{anywhere_at, uncertain_command};
use crate::data::waits::waits;
use crate::data::whitener::Whitener;
use crate::dot::dot;
use crate::mask::Mask;
use crate::model_error::STEP;
use crate::simulate::{Base, Effect, Input, Sampling, simulate};
use crate::start::{run_in, transients};
use crate::thresholds::THRESHOLDS;
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// One record, ready.
#[derive(Debug, Clone)]
pub(crate) struct Prepared {
    pub name: String,
    /// Command from the working point \[um\].
    pub u: Vec<f64>,
    /// Position, 0 if missing \[um\].
    pub y: Vec<f64>,
    pub present: Vec<bool>,
    pub whitener: Whitener,
    /// Noise of single rows.
    pub row_noise: RowNoise,
    pub rest: bool,
    /// When its frames were exposed.
    pub sampling: Sampling,
    /// Motions by which the plant may come to rest from where it was before the record, as they are.
    transients: Vec<Vec<f64>>,
    /// Responses by which the model is off with a standard deviation of 1.
    model_errors: Vec<Vec<f64>>,
    /// The same for the mean by which frames are late, if they are late by random times.
    late_error: Option<Vec<f64>>,
    /// Where a zero flow that is off, and one that drifts, take the bead.
    flow: FlowPaths,
    /// Whether the noise has a zero flow that drifts.
    drifts: bool,
    /// Transients and paths in the space of innovations.
    free: Free,
    /// Where the zero flow was, as the displacement of the PZT that does the same \[um\]; empty: where the working point is.
    pub flow_um: Vec<f64>,
}

impl Prepared {
    /// Innovations of a residual, in standard deviations, without the response to an unknown state at the record's start.
    pub(crate) fn whiten(&self, r: &[f64], e: &mut [f64]) {
        self.whitener.apply(r, e);
        self.free.take_off(e);
    }

    /// The same in separate rows.
    pub(crate) fn whitened(&self, r: &[f64]) -> Vec<f64> {
        let mut e = vec![0.0; r.len()];
        self.whiten(r, &mut e);
        e
    }

    /// Sum of squares of a residual in the rows of a mask, the stated error of the model left out of its covariance.
    pub(crate) fn squares_without_model_errors(
        &self,
        noise: &NoiseModel,
        residual: &[f64],
        rows: &[Range<usize>],
    ) -> f64 {
        let free = Free::new(noise, &self.whitener, &self.transients, &self.flow, &[]);
        let mut e = vec![0.0; residual.len()];
        self.whitener.apply(residual, &mut e);
        free.take_off(&mut e);
        rows.iter().map(|r| dot(&e[r.clone()], &e[r.clone()])).sum()
    }

    /// The filter of a noise, and orthonormal innovations of the transients under it.
    fn set_noise(&mut self, noise: &NoiseModel) {
        self.whitener = Whitener::new(noise, &self.present, &self.row_noise);
        self.drifts = noise.zero_flow.is_some();
        self.free = Free::new(
            noise,
            &self.whitener,
            &self.transients,
            &self.flow,
            &self.model_errors,
        );
    }

    /// Twice the negative log-likelihood of a residual under another noise, without a constant.
    pub(crate) fn unlikelihood(&self, noise: &NoiseModel, residual: &[f64]) -> f64 {
        let (e, log_determinant) = self.innovations(noise, &self.row_noise, residual);
        dot(&e, &e) + log_determinant
    }

    /// Innovations of a residual under other noise, and the logarithm of the determinant of its covariance.
    pub(crate) fn innovations(
        &self,
        noise: &NoiseModel,
        rows: &RowNoise,
        residual: &[f64],
    ) -> (Vec<f64>, f64) {
        let whitener = Whitener::new(noise, &self.present, rows);
        let free = Free::new(
            noise,
            &whitener,
            &self.transients,
            &self.flow,
            &self.model_errors,
        );
        let mut e = vec![0.0; residual.len()];
        whitener.apply(residual, &mut e);
        free.take_off(&mut e);
        let log_determinant = whitener.log_determinant() + free.log_determinant();
        (e, log_determinant)
    }

    /// The filter and the free motions of a noise for which the bead may have gone anywhere in some rows.
    fn blind(&self, noise: &NoiseModel, stops: &[bool]) -> (Whitener, Free) {
        /// Variance of such a row over that of the noise: a thousand rows of it tell a tenth of what one other tells.
        const ANYWHERE: f64 = 1e4;
        let flow_um2 = noise.zero_flow.map_or(0.0, |z| z.motion_um2);
        let anywhere = ANYWHERE * (noise.walk_um2 + flow_um2);
        let walk_um2 = |(k, stops): (usize, &bool)| {
            self.row_noise.walk_um2(k) + if *stops { anywhere } else { 0.0 }
        };
        let rows = RowNoise {
            walk: Some(stops.iter().enumerate().map(walk_um2).collect()),
            white: self.row_noise.white.clone(),
        };
        let whitener = Whitener::new(noise, &self.present, &rows);
        let free = Free::new(noise, &whitener, &self.transients, &self.flow, &[]);
        (whitener, free)
    }

    /// A residual, or its first rows, without the transients, a level and, if asked for, a ramp.
    pub(crate) fn without_start(&self, residual: &[f64], ramp: bool) -> Vec<f64> {
        let n = residual.len();
        let mut columns: Vec<Vec<f64>> = vec![vec![1.0; n]];
        if ramp {
            columns.push((0..n).map(|k| k as f64 / n as f64 - 0.5).collect());
        }
        columns.extend(self.transients.iter().map(|c| c[..n].to_vec()));
        if self.drifts {
            columns.push(self.flow.drift[..n].to_vec());
        }
        let mut basis: Vec<Vec<f64>> = Vec::new();
        let mut left = residual.to_vec();
        let blank = |v: &mut Vec<f64>| {
            v.iter_mut()
                .zip(&self.present)
                .for_each(|(v, p)| *v = if *p { *v } else { 0.0 });
        };
        blank(&mut left);
        for mut c in columns {
            blank(&mut c);
            let size = dot(&c, &c);
            for q in &basis {
                let share = dot(q, &c);
                c.iter_mut().zip(q).for_each(|(c, q)| *c -= share * q);
            }
            let rest = dot(&c, &c);
            if rest > 1e-9 * size && rest > 0.0 {
                let scale = 1.0 / rest.sqrt();
                c.iter_mut().for_each(|c| *c *= scale);
                let share = dot(&c, &left);
                left.iter_mut().zip(&c).for_each(|(l, q)| *l -= share * q);
                basis.push(c);
            }
        }
        left
    }
}

/// A model, and others that are a small step of its stated error off, each with its effects.
#[derive(Debug, Clone, Default)]
pub(crate) struct Errors(pub(crate) Vec<(Base, Vec<Effect>)>);

impl Errors {
    /// Responses to a command by which the first is off, beside further effects.
    fn responses(&self, u: &[f64], sampling: &Sampling, beside: &[Effect]) -> Vec<Vec<f64>> {
        let response = |(base, effects): &(Base, Vec<Effect>)| {
            let mut y = Vec::new();
            let effects = [effects, beside].concat();
            simulate(base, Input::new(u, sampling), &effects, &mut y, None);
            y
        };
        let Some((model, off)) = self.0.split_first().filter(|(_, off)| !off.is_empty()) else {
            return Vec::new();
        };
        let y = response(model);
        let mut responses: Vec<Vec<f64>> = off.iter().map(response).collect();
        for response in &mut responses {
            for (r, y) in response.iter_mut().zip(&y) {
                *r = (*r - y) / STEP;
            }
        }
        responses
    }
}

/// Where a zero flow takes the bead through the plant alone.
fn flow_paths(base: &Base, rows: usize) -> FlowPaths {
    let mut off = Vec::new();
    simulate(
        base,
        Input::new(&vec![1.0; rows], &Sampling::default()),
        &[],
        &mut off,
        None,
    );
    let motion_per_um = base.speed_per_um() * base.sample_s;
    off.iter_mut().for_each(|y| *y /= motion_per_um);
    FlowPaths::new(off)
}

/// Everything that fits share.
#[derive(Debug, Clone)]
pub(crate) struct Problem {
    pub base: Base,
    pub records: Vec<Prepared>,
    /// The model's stated error.
    errors: Errors,
    pub noise: NoiseModel,
    /// Whether the zero flow may wander by more than that of a rig does.
    pub wanders: bool,
    /// What the noise of single rows does to the mean of the positions.
    pub mean: Vec<Effect>,
    /// Bounds of the share of the newest command's direct path that a frame already shows \[um per um\].
    ///
    /// The direct path of Eq. (6) acts at once; a frame whose exposure straddles the command's edge shows a part of it. It is a
    /// nuisance parameter of every fit, the null included: worth at most 19 nm per um of command step.
    pub soft: (f64, f64),
    /// The positions come in steps that are not small compared with their increments.
    pub quantised: bool,
    /// Work of all simulations until now; the copies of a problem count together.
    work: Arc<AtomicU64>,
}

impl Problem {
    /// Prepares records; `repeated[i][k]` marks rows that repeat a frame and count as missing. `errors` tells by which responses the model
    /// may be off, see [`crate::model_error`].
    pub(crate) fn new(
        base: Base,
        records: &[Record],
        repeated: &[Vec<bool>],
        noise: NoiseModel,
        errors: Errors,
    ) -> Self {
        let direct = if base.zpk.zeros.len() == base.zpk.poles.len() {
            base.zpk.gain.abs()
        } else {
            0.0
        };
        let velocity = base.zpk.at(nalgebra::Complex::new(0.0, 125.0)).norm() * 125.0;
        let kick = if base.interpolated_input { 0.0 } else { direct };
        let range_um = command_range_um(records);
        // With a positive gain the bead follows the command at once, or a right angle behind it.
        let follows = base.zpk.at(nalgebra::Complex::new(0.0, 125.0));
        let rises = follows.re >= follows.im;
        let prepared = records
            .iter()
            .zip(repeated)
            .zip(waits(records, base.frame_age_s))
            .map(|((r, repeated), waits)| {
                let u = r.displacement_um(base.working_point_um);
                let run_in = run_in(&base, &u, &noise);
                let present: Vec<bool> = r
                    .bead_um
                    .iter()
                    .zip(repeated)
                    .map(|(b, rep)| b.is_finite() && !rep)
                    .enumerate()
                    .map(|(k, seen)| seen && k >= run_in)
                    .collect();
                let y = r
                    .bead_um
                    .iter()
                    .zip(&present)
                    .map(|(b, p)| if *p { *b } else { 0.0 })
                    .collect();
                let row_noise = RowNoise {
                    walk: uncertain_command(r, velocity * base.sample_s),
                    white: None,
                };
                let whitener = Whitener::new(&noise, &present, &row_noise);
                let flow = flow_paths(&base, r.rows());
                let sampling = Sampling {
                    exposure_s: r.exposure_s,
                    waits,
                    answered: answers_frames(&u, &r.bead_um, &present, rises),
                };
                let mut prepared = Prepared {
                    model_errors: errors.responses(&u, &sampling, &[]),
                    late_error: None,
                    transients: transients(&base, &flow, r.rows()),
                    flow,
                    drifts: false,
                    free: Free::default(),
                    flow_um: Vec::new(),
                    name: r.name.clone(),
                    u,
                    y,
                    present,
                    whitener,
                    row_noise,
                    rest: r.rests_within(THRESHOLDS.rest_share * range_um),
                    sampling,
                };
                prepared.set_noise(&noise);
                prepared
            })
            .collect();
        Self {
            base,
            records: prepared,
            errors,
            noise,
            wanders: false,
            mean: Vec::new(),
            soft: (-0.4 * kick, 1.3 * kick),
            quantised: records.iter().any(Record::is_quantised),
            work: Arc::default(),
        }
    }

    /// Counts the work of a simulation.
    pub(crate) fn spend(&self, work: u64) {
        self.work.fetch_add(work, Ordering::Relaxed);
    }

    /// Work of all simulations until now. It is the same for any number of threads if all are idle.
    pub(crate) fn spent(&self) -> u64 {
        self.work.load(Ordering::Relaxed)
    }

    /// The same problem with other noise.
    pub(crate) fn with_noise(mut self, noise: NoiseModel) -> Self {
        self.noise = noise;
        for r in &mut self.records {
            r.set_noise(&noise);
        }
        self
    }

    /// The same problem with positions that are anywhere from some rows of each record on.
    pub(crate) fn open_at(mut self, rows: impl Fn(usize) -> Vec<usize>) -> Self {
        for (i, r) in self.records.iter_mut().enumerate() {
            let walk = &mut r.row_noise.walk;
            *walk = Some(anywhere_at(&rows(i), &r.y, walk.take()));
            r.set_noise(&self.noise);
        }
        self
    }

    /// The same problem with frames that are late by random times of a standard deviation \[s\]: `mean` is what they are late by in the
    /// mean, and that has an error \[s\]. `speeds` are those of the bead in every record \[um/s\].
    pub(crate) fn with_late_frames(
        mut self,
        (sd_s, (mean, error_s)): (f64, (Option<Effect>, f64)),
        speeds: &[Vec<f64>],
    ) -> Self {
        for (r, speeds) in self.records.iter_mut().zip(speeds) {
            r.row_noise.white = Some(speeds.iter().map(|v| (v * sd_s).powi(2)).collect());
            r.late_error = mean
                .is_some()
                .then(|| speeds.iter().map(|v| v * error_s).collect());
            r.model_errors.extend(r.late_error.clone());
            r.set_noise(&self.noise);
        }
        self.mean = mean.into_iter().collect();
        self
    }

    /// Whether the model states an error of its own.
    pub(crate) fn has_errors(&self) -> bool {
        self.errors.0.len() > 1
    }

    /// The same problem with the responses to the model's stated error beside a set of effects: a delay behind a lag shows as much less.
    pub(crate) fn beside(mut self, effects: &[Effect]) -> Self {
        if !self.has_errors() {
            return self;
        }
        for r in &mut self.records {
            r.model_errors = self.errors.responses(&r.u, &r.sampling, effects);
            r.model_errors.extend(r.late_error.clone());
            r.set_noise(&self.noise);
        }
        self
    }

    /// Loss of a zero flow in the chip, by the effects of the model and further ones.
    pub(crate) fn flow_loss(&self, effects: &[Effect]) -> Option<FlowLoss> {
        let own = self.errors.0.first().map_or(&[][..], |(_, own)| own);
        FlowLoss::of(&[own, effects].concat(), self.base.sample_s)
    }

    /// The same problem with the zero flow where the residuals of a fit say that it was. `stops` are the rows in which the bead does not
    /// follow the flow, none of a record without such rows: there the residual says nothing of it.
    pub(crate) fn with_flow(mut self, residuals: &[Vec<f64>], stops: &[Vec<bool>]) -> Self {
        let per_um = self.flow_per_um();
        let off = self.base.free_working_point;
        for ((r, residual), stops) in self.records.iter_mut().zip(residuals).zip(stops) {
            let blind = stops.contains(&true).then(|| r.blind(&self.noise, stops));
            let by = match &blind {
                Some((whitener, free)) => (whitener, free),
                None => (&r.whitener, &r.free),
            };
            r.flow_um = flow_estimate::motion_um(&self.noise, by, &r.flow, off, residual);
            r.flow_um.iter_mut().for_each(|m| *m /= per_um);
        }
        self
    }

    /// Motion of the bead in a row by a flow like that of a displacement \[um/um\].
    pub(crate) fn flow_per_um(&self) -> f64 {
        self.base.speed_per_um() * self.base.sample_s
    }

    /// Which rows of each record hold a position that counts.
    pub(crate) fn present(&self) -> Vec<Vec<bool>> {
        self.records.iter().map(|r| r.present.clone()).collect()
    }

    /// Sum of the logarithms of the innovations' variances: the determinant in the likelihood.
    pub(crate) fn log_determinant(&self) -> f64 {
        let of = |r: &Prepared| r.whitener.log_determinant() + r.free.log_determinant();
        self.records.iter().map(of).sum()
    }

    /// Twice the negative log-likelihood of residuals under another noise, without a constant.
    pub(crate) fn unlikelihood(&self, noise: &NoiseModel, residuals: &[Vec<f64>]) -> f64 {
        let of = |(r, residual): (&Prepared, &Vec<f64>)| r.unlikelihood(noise, residual);
        self.records.iter().zip(residuals).map(of).sum()
    }

    /// Rows of each record.
    pub(crate) fn rows(&self) -> impl Iterator<Item = usize> {
        self.records.iter().map(|r| r.u.len())
    }

    /// All rows.
    pub(crate) fn all(&self) -> Mask {
        self.rows()
            .map(|n| std::iter::once(0..n).collect())
            .collect()
    }

    /// Number of innovations that count under a mask.
    pub(crate) fn count(&self, mask: &Mask) -> usize {
        self.records
            .iter()
            .zip(mask)
            .map(|(r, ranges)| {
                ranges
                    .iter()
                    .flat_map(Clone::clone)
                    .filter(|&k| r.whitener.counts(k))
                    .count()
            })
            .sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn further_variance_of_every_position_is_that_of_a_worse_fix() {
        let rows = RowNoise {
            walk: None,
            white: Some(vec![3e-4; 40]),
        };
        let n = NoiseModel::new(0.33, 1e-3, 0.030);
        let worse = NoiseModel {
            white_um2: n.white_um2 + 3e-4,
            ..n
        };
        let of = |noise: &NoiseModel, rows: &RowNoise| {
            let filter = Whitener::new(noise, &[true; 40], rows);
            filter.transpose(&[1.0; 40])
        };
        assert_eq!(of(&n, &rows), of(&worse, &RowNoise::default()));
    }
}
