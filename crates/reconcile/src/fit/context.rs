//! Input and result of a fit.

use crate::fit::catalogue::{Part, Variant};
use crate::fit::position_error::Locking;
use crate::mask::Mask;
use crate::problem::{Prepared, Problem};
use crate::simulate::{Base, Effect, Input, Place, simulate};
use crate::thresholds::THRESHOLDS;
use crate::units::Scales;
use cellpos_plant::Model;
use cellpos_plant::effects::{Action, Candidate, Role, Scope, find};
use nalgebra::DMatrix;

/// What the fit needs to know apart from the data: ranges, and the effects that the model already has.
#[derive(Debug, Clone)]
pub(crate) struct Context<'a> {
    pub problem: &'a Problem,
    pub scope: Scope,
    pub fixed: Vec<Effect>,
    /// Everything that may be tried.
    pub variants: Vec<Variant>,
    /// The base model's gain is free in every fit, the null included: a base fitted to these very records.
    pub free_gain: bool,
    pub white: Option<WhiteEvidence>,
    /// Relative error of the standard deviation of a measured noise.
    pub floor_error: f64,
    /// The positions come in steps that are not small compared with their increments.
    pub quantised: bool,
    /// Figures of the search in the units of the records.
    pub scales: Scales,
}

/// The statement of the white noise's size about averaging in the camera.
///
/// With a held command and a bead that follows at once, the path between two commands is straight, and the mean over an exposure
/// inside that time IS the position in its middle: an exposure Te and a delay Te/2 give the same response. The Brownian motion
/// separates the two: averaged over Te it lowers the white part of the noise by `2 D dt Te/(6 dt)`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct WhiteEvidence {
    /// Estimated from the records \[um^2\].
    pub estimate_um2: f64,
    /// Standard error of that.
    pub error_um2: f64,
    /// What the model's localisation noise gives \[um^2\].
    pub model_um2: f64,
    /// `2 D dt` \[um^2\].
    pub walk_um2: f64,
}

impl WhiteEvidence {
    /// The evidence in the noise of a problem; `trusted` is the number of increments that the noise was estimated from.
    pub(crate) fn of(model: &Model, trusted: usize, problem: &Problem) -> Option<Self> {
        let noise = &problem.noise;
        let exposure_s = problem
            .records
            .first()
            .map_or(0.0, |r| r.sampling.exposure_s);
        let model_um2 = model.noise.localisation_um.powi(2);
        if trusted < 5000 || model_um2 <= 0.0 || noise.coloured.is_some() {
            return None;
        }
        let variance = noise.walk_um2 + 2.0 * noise.white_um2;
        // Only where the walk is that of the model: else the model's noise says nothing about this rig.
        let walk = 2.0 * model.noise.diffusion_um2_per_s * problem.base.sample_s;
        if walk <= 0.0 || (noise.walk_um2 / walk - 1.0).abs() > THRESHOLDS.walk_alike {
            return None;
        }
        Some(Self {
            estimate_um2: noise.white_um2,
            error_um2: 1.5 * variance / (trusted as f64).sqrt(),
            // A known exposure averages a part of the walk off, as [`NoiseModel::from_increments`] says.
            model_um2: model_um2 - noise.walk_um2 * exposure_s / (6.0 * problem.base.sample_s),
            walk_um2: noise.walk_um2,
        })
    }

    /// Squared distance, in standard deviations, between the estimate and the value that a set of parts predicts.
    pub(crate) fn distance(&self, parts: &[Part], scope: &Scope) -> f64 {
        let exposure_s: f64 = parts.iter().map(|p| p.averages_s(scope)).sum();
        let rows = (exposure_s / scope.sample_s).min(2.0);
        let expected = self.model_um2 - self.walk_um2 * rows / 6.0;
        ((self.estimate_um2 - expected) / self.error_um2).powi(2)
    }
}

/// A fitted set of candidates.
#[derive(Debug, Clone)]
pub(crate) struct Fit {
    pub parts: Vec<Part>,
    /// Share of the newest command \[um per um\].
    pub soft: f64,
    /// Displacement from the model's working point to the records', if that is free \[um\].
    pub offset_um: f64,
    /// Factor on the base model's gain; 1 unless it is free.
    pub gain: f64,
    /// Standard errors of `soft` and `gain`.
    pub errors: [f64; 2],
    /// Sine and cosine of each line in each record, and of its multiples \[um\].
    pub lines: Vec<Vec<Vec<[f64; 2]>>>,
    /// Sine and cosine of each position-periodic error \[um\].
    pub positions: Vec<[f64; 2]>,
    /// Those errors by the exact filter, once they are looked at so closely: by part.
    pub locking: Vec<Option<Locking>>,
    /// Sum of squares over the mask.
    pub chi2: f64,
    /// Of a fit without effects: sum of squares that the model's stated error takes off.
    pub absorbed: f64,
    /// Gain of the last round of the descent; nothing once it stops.
    pub last_gain: f64,
    /// Innovations that count under the mask.
    pub count: usize,
    /// Innovations of all rows, masked or not, of all records.
    pub innovations: Vec<Vec<f64>>,
    /// Covariance of the parameters of the parts, in the fit's coordinates, in order.
    pub covariance: DMatrix<f64>,
    /// Logarithm of the determinant of the information on all numbers of the fit, their ranges included.
    pub log_information: f64,
}

impl Fit {
    /// Free parameters that describe effects: of the parts, and the amplitudes of lines.
    pub(crate) fn freedom(&self) -> usize {
        self.parts
            .iter()
            .map(|p| freedom_of(p.variant(), self.innovations.len()))
            .sum()
    }

    /// How many numbers the parts before this one have: the place of its own in the covariance.
    pub(crate) fn numbers_before(&self, index: usize) -> usize {
        self.parts[..index].iter().map(|p| p.theta.len()).sum()
    }

    /// How many parts before this one act in the way that it does.
    pub(crate) fn nth_of_role(&self, index: usize) -> usize {
        let of = |part: &Part| std::mem::discriminant(&part.variant().role);
        let before = &self.parts[..index];
        before
            .iter()
            .filter(|p| of(p) == of(&self.parts[index]))
            .count()
    }

    /// The parts that are lines, in their order.
    pub(crate) fn line_parts(&self) -> impl Iterator<Item = &Part> {
        let is_line = |p: &&Part| matches!(p.variant().role, Role::Line { .. });
        self.parts.iter().filter(is_line)
    }

    /// The parts that are periodic in position, in their order.
    pub(crate) fn position_parts(&self) -> impl Iterator<Item = &Part> {
        (self.parts.iter()).filter(|p| p.variant().role == Role::Position)
    }

    /// Whether a part is a limit of its form: one of its numbers is at the end of its range, or may have any value in it.
    pub(crate) fn is_limit(&self, index: usize) -> bool {
        let part = &self.parts[index];
        let before = self.numbers_before(index);
        let numbers = part.variant().params.iter().zip(&part.theta).enumerate();
        numbers.into_iter().any(|(j, (p, x))| {
            let (low, high) = (p.coordinate(p.lower), p.coordinate(p.upper));
            let (near, at) = (1e-4 * (high - low), before + j);
            let sd = self.covariance[(at, at)].max(0.0).sqrt();
            (p.log && (*x < low + near || 1.96 * sd > 0.5 * (high - low))) || *x > high - near
        })
    }

    pub(crate) fn has(&self, id: &str) -> bool {
        self.parts.iter().any(|p| p.id() == id)
    }

    /// Sum of squares of the innovations under another mask.
    pub(crate) fn chi2_on(&self, mask: &Mask) -> f64 {
        self.innovations
            .iter()
            .zip(mask)
            .map(|(e, ranges)| {
                ranges
                    .iter()
                    .map(|r| e[r.clone()].iter().map(|x| x * x).sum::<f64>())
                    .sum::<f64>()
            })
            .sum()
    }
}

/// Number of free numbers that a variant brings.
pub(crate) fn freedom_of(v: &Candidate, records: usize) -> usize {
    v.params.len()
        + match v.role {
            Role::Chain => 0,
            Role::Line { harmonics } => 2 * harmonics * records,
            Role::Position => 2,
        }
}

/// Step of a tangent, as a share of the stroke: a curve is straight over it, and rounding errors are a millionth of the step.
const SMALL: f64 = 1e-3;

impl Context<'_> {
    /// Mean amplitude of a line at `times` its frequency, over the rows of the records \[um\].
    pub(crate) fn mean_wave_um(&self, line: &[Vec<[f64; 2]>], times: usize) -> f64 {
        let records = &self.problem.records;
        let rows: f64 = records.iter().map(|r| r.u.len() as f64).sum();
        let of = |(r, waves): (&Prepared, &Vec<[f64; 2]>)| {
            let [a, b] = waves.get(times - 1).copied().unwrap_or_default();
            a.hypot(b) * r.u.len() as f64
        };
        records.iter().zip(line).map(of).sum::<f64>() / rows
    }

    /// Whether the plant integrates slowly enough for a nanometre of displacement to become a ramp.
    pub(crate) fn integrates(&self) -> bool {
        let poles = &self.problem.base.zpk.poles;
        poles.iter().any(|p| p.norm() * self.scope.length_s < 1.0)
    }

    /// Whether an effect is no candidate. A bare actuator has neither chip nor bead, and a free gain is no error. A sensor that
    /// counts in steps has no pixels. A constant flow is a number of every fit if the working point is free.
    pub(crate) fn excludes(&self, id: &str) -> bool {
        let Some(kind) = find(id) else {
            return false;
        };
        let of_pixels = kind.candidates().iter().any(|c| c.role == Role::Position);
        let of_bead = matches!(kind.spec().place, Place::Chip | Place::Bead);
        let of_flow = (kind.candidates().iter()).any(|c| c.role == Role::Chain && c.off_response);
        self.quantised && of_pixels
            || self.free_gain && of_bead
            || self.problem.base.free_working_point && of_flow
    }

    /// The longest delay that these records can show \[s\]: a tenth of a second on this rig. On another plant it is as many rows
    /// as its slowest lag, at least a hundred, at most a quarter of a record.
    pub(crate) fn longest_delay_s(&self) -> f64 {
        const ON_THIS_RIG_S: f64 = 0.1;
        const LEAST_ROWS: f64 = 100.0;
        let base = &self.problem.base;
        if !base.free_start {
            return ON_THIS_RIG_S;
        }
        let slowest_s = (base.zpk.poles.iter())
            .map(|p| 1.0 / p.norm())
            .filter(|lag_s| lag_s.is_finite())
            .fold(LEAST_ROWS * base.sample_s, f64::max);
        slowest_s.min(0.25 * self.scope.length_s).max(ON_THIS_RIG_S)
    }

    /// The effects of the model and of a set, as they are simulated.
    pub(crate) fn effects(&self, parts: &[Part]) -> Vec<Effect> {
        let mut effects = self.fixed.clone();
        effects.extend(parts.iter().map(|p| p.effect(&self.scope)));
        effects
    }

    /// Whether the place at which the rig rested before its records is a number of the fit. An unknown zero flow is free in every record;
    /// a chain with memory, or one that bends, also needs the displacement about which it came to rest.
    pub(crate) fn has_free_offset(&self, parts: &[Part]) -> bool {
        let remembers = |effect: &Effect| match effect.act() {
            Action::Linear(z) => !z.poles.is_empty() || !z.zeros.is_empty(),
            Action::Block(_) | Action::Around(_) | Action::Bypass(_) => true,
            _ => false,
        };
        self.problem.base.free_working_point && self.effects(parts).iter().any(remembers)
    }

    /// Simulates a record about a working point that is `offset_um` from the model's.
    pub(crate) fn simulate(
        &self,
        record: &Prepared,
        effects: &[Effect],
        offset_um: f64,
        y: &mut Vec<f64>,
        edge: Option<&mut Vec<f64>>,
    ) {
        self.simulate_input((record, &record.u), effects, offset_um, y, edge);
    }

    /// The same with another input in place of the record's.
    fn simulate_input(
        &self,
        (record, u): (&Prepared, &[f64]),
        effects: &[Effect],
        offset_um: f64,
        y: &mut Vec<f64>,
        edge: Option<&mut Vec<f64>>,
    ) {
        let base = &self.problem.base;
        let input = |u| Input {
            flow_um: &record.flow_um,
            ..Input::new(u, &record.sampling)
        };
        let work = if offset_um == 0.0 {
            simulate(base, input(u), effects, y, edge)
        } else {
            let base = Base {
                working_point_um: base.working_point_um + offset_um,
                ..base.clone()
            };
            let u: Vec<f64> = u.iter().map(|u| u - offset_um).collect();
            simulate(&base, input(&u), effects, y, edge)
        };
        self.problem.spend(work);
    }

    /// Whether a rig can have all of a set.
    pub(crate) fn is_possible(&self, fit: &Fit) -> bool {
        fit.parts.iter().all(|p| p.is_possible(&self.scope))
    }

    /// Rows of each record in which the bead follows less than half of a small change of the zero flow: it sticks, or is held.
    pub(crate) fn stops(&self, fit: &Fit) -> Vec<Vec<bool>> {
        /// Rows after which the change turns round: a leak has not yet taken it back.
        const TURNS: usize = 100;
        let sign = |k: usize| {
            if (k / TURNS).is_multiple_of(2) {
                1.0
            } else {
                -1.0
            }
        };
        let effects = self.effects(&fit.parts);
        let per_um = self.problem.flow_per_um();
        let motion_um2 = self.problem.noise.zero_flow.map_or(0.0, |z| z.motion_um2);
        let change_um = motion_um2.sqrt() / per_um;
        let of = |record: &Prepared| {
            if change_um == 0.0 {
                return Vec::new();
            }
            let with_flow = |added_um: f64| {
                let mut record = record.clone();
                record.flow_um.resize(record.u.len(), 0.0);
                let rows = record.flow_um.iter_mut().enumerate();
                rows.for_each(|(k, f)| *f += sign(k) * added_um);
                let mut y = Vec::new();
                self.simulate(&record, &effects, fit.offset_um, &mut y, None);
                y
            };
            let (low, high) = (with_flow(-change_um), with_flow(change_um));
            let apart: Vec<f64> = high.iter().zip(&low).map(|(h, l)| h - l).collect();
            // The zero flow itself is noise of the position: what a simulation shows of it is what the bead does not follow.
            let whole = 2.0 * change_um * per_um;
            let lost = |k: usize| (apart[k] - apart[k - 1]) / (sign(k - 1) * whole);
            (0..apart.len()).map(|k| k > 0 && lost(k) < -0.5).collect()
        };
        self.problem.records.iter().map(of).collect()
    }

    /// By how much a part next to a set would change the innovations; `sim` is the set's simulation.
    pub(crate) fn change(
        &self,
        fit: &Fit,
        sim: &[Vec<f64>],
        part: &Part,
        mask: &Mask,
    ) -> Vec<Vec<f64>> {
        let mut parts = fit.parts.clone();
        parts.push(part.clone());
        let moved = self.simulated(&parts, fit.offset_um, mask);
        (self.problem.records.iter())
            .zip(moved.iter().zip(sim))
            .map(|(r, (m, s))| {
                let d: Vec<f64> = m.iter().zip(s).map(|(m, s)| fit.gain * (s - m)).collect();
                r.whitened(&d)
            })
            .collect()
    }

    /// Change of a record's simulated position by a small addition to its command, per unit of the addition. It is the tangent of the
    /// chain with all effects of a fit's set, the delay included. `sim` is the position without the addition.
    pub(crate) fn response(
        &self,
        fit: &Fit,
        (record, sim): (&Prepared, &[f64]),
        added_um: &[f64],
    ) -> Vec<f64> {
        let most = added_um.iter().fold(0.0, |most: f64, a| most.max(a.abs()));
        if most == 0.0 {
            return vec![0.0; added_um.len()];
        }
        let step = SMALL * self.scope.stroke_um / most;
        let u: Vec<f64> = (record.u.iter().zip(added_um))
            .map(|(u, a)| u + step * a)
            .collect();
        let mut y = Vec::new();
        let effects = self.effects(&fit.parts);
        self.simulate_input((record, &u), &effects, fit.offset_um, &mut y, None);
        for (y, sim) in y.iter_mut().zip(sim) {
            *y = (*y - sim) / step;
        }
        y
    }

    /// Simulated positions of the records that count under a mask; empty for the others.
    pub(crate) fn simulated(&self, parts: &[Part], offset_um: f64, mask: &Mask) -> Vec<Vec<f64>> {
        let effects = self.effects(parts);
        self.problem
            .records
            .iter()
            .zip(mask)
            .map(|(r, ranges)| {
                let mut y = Vec::new();
                if !ranges.is_empty() {
                    self.simulate(r, &effects, offset_um, &mut y, None);
                }
                y
            })
            .collect()
    }
}
