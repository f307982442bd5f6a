//! Records made ready for fitting: commands from the working point, whitening filters, masks.

use crate::data::Record;
use crate::noise::{Noise, Whitener};
use crate::predict::Base;
use std::ops::Range;

/// Start of a record with an analogue input that is not scored \[s\].
const RUN_IN_S: f64 = 0.5;

/// Which rows of which record count in a fit: ranges per record.
pub(crate) type Mask = Vec<Vec<Range<usize>>>;

/// The first 60 % of every record, to fit on, and the rest, to judge by.
pub(crate) fn split_in_time(records: &[Prepared]) -> (Mask, Mask) {
    let part = |range: fn(usize) -> Range<usize>| -> Mask {
        let of = |r: &Prepared| vec![range(r.u.len())];
        records.iter().map(of).collect()
    };
    (part(|n| 0..n * 6 / 10), part(|n| n * 6 / 10..n))
}

/// One record, ready.
#[derive(Debug, Clone)]
pub(crate) struct Prepared {
    pub name: String,
    /// Command from the working point \[um\].
    pub u: Vec<f64>,
    /// Position, 0 where there is none \[um\].
    pub y: Vec<f64>,
    pub present: Vec<bool>,
    pub whitener: Whitener,
    extra_walk: Option<Vec<f64>>,
    pub rest: bool,
}

/// Everything that fits share.
#[derive(Debug, Clone)]
pub(crate) struct Problem {
    pub base: Base,
    pub records: Vec<Prepared>,
    pub noise: Noise,
    /// Bounds of the share of the newest command's direct path that a frame already shows \[um per um\].
    ///
    /// The direct path of Eq. (6) acts at once; a frame whose exposure straddles the command's edge shows a part of it.
    /// It is a nuisance of every fit, the null included: worth at most 19 nm per um of command step.
    pub soft: (f64, f64),
}

impl Problem {
    /// Prepares records; `repeated[i][k]` marks rows that repeat a frame and count as missing.
    pub fn new(base: Base, records: &[Record], repeated: &[Vec<bool>], noise: Noise) -> Self {
        let direct = if base.zpk.zeros.len() == base.zpk.poles.len() {
            base.zpk.gain.abs()
        } else {
            0.0
        };
        let velocity = base.zpk.at(nalgebra::Complex::new(0.0, 125.0)).norm() * 125.0;
        let kick = if base.interpolated_input { 0.0 } else { direct };
        let prepared = records
            .iter()
            .zip(repeated)
            .map(|(r, repeated)| {
                // How a sampled analogue input came from where it was before the record to its first sample is not known.
                let run_in = if base.interpolated_input {
                    ((RUN_IN_S / base.sample_s) as usize).min(r.rows() / 10)
                } else {
                    0
                };
                let u: Vec<f64> = r.pzt_um.iter().map(|v| v - base.working_point_um).collect();
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
                let extra_walk = uncertain_command(r, velocity * base.sample_s);
                let whitener = Whitener::new(&noise, &present, extra_walk.as_deref());
                Prepared {
                    name: r.name.clone(),
                    u,
                    y,
                    present,
                    whitener,
                    extra_walk,
                    rest: r.is_rest(),
                }
            })
            .collect();
        Self {
            base,
            records: prepared,
            noise,
            soft: (-0.4 * kick, 1.3 * kick),
        }
    }

    /// The same problem with other noise.
    pub fn with_noise(mut self, noise: Noise) -> Self {
        self.noise = noise;
        for r in &mut self.records {
            r.whitener = Whitener::new(&noise, &r.present, r.extra_walk.as_deref());
        }
        self
    }

    /// All rows.
    pub fn all(&self) -> Mask {
        self.records
            .iter()
            .map(|r| std::iter::once(0..r.u.len()).collect())
            .collect()
    }

    /// Number of innovations that count under a mask.
    pub fn count(&self, mask: &Mask) -> usize {
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

/// Where rows were missing their command is a guess: how much the bead may have moved unseen \[um^2 per row\].
fn uncertain_command(r: &Record, gain_per_sample: f64) -> Option<Vec<f64>> {
    if !r.filled.iter().any(|f| *f) {
        return None;
    }
    if r.period_rows().is_some() {
        return None;
    }
    // Size of the error of a straight line between neighbours, measured where the command is known.
    let u = &r.pzt_um;
    let (mut sum, mut n) = (0.0, 0.0);
    for k in 1..u.len() - 1 {
        if !r.filled[k - 1] && !r.filled[k] && !r.filled[k + 1] {
            sum += (u[k] - 0.5 * (u[k - 1] + u[k + 1])).powi(2);
            n += 1.0;
        }
    }
    let variance = if n > 0.0 { sum / n } else { 0.0 } * gain_per_sample * gain_per_sample;
    let mut extra = vec![0.0; u.len()];
    for k in 0..u.len() {
        if r.filled[k] && k + 1 < u.len() {
            extra[k + 1] += variance;
        }
    }
    Some(extra)
}
