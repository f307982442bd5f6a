//! Checks a plan against a model and limits before anything moves.
//!
//! The PZT displacement of a plan comes from the exact inverse of the model's plant under a zero-order hold (strictly
//! proper form, minimum phase): y_(k+1) gives u_k. A reserve covers noise, drift and a wrong gain.

use crate::error::ScriptError;
use crate::plan::{Motion, Plan, Segment};
use crate::script::{Script, WaveShape};
use cellpos_control::Reference;
use cellpos_numeric::units::Seconds;
use cellpos_plant::{DiscretePlant, Model, PlantError};

/// Capabilities of the rig.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CheckLimits {
    /// Smallest PZT displacement, um.
    pub low_um: f64,
    /// Largest PZT displacement, um.
    pub high_um: f64,
    /// Largest speed of the PZT, um/s.
    pub slew_um_per_s: f64,
    /// PZT displacement at which the bead rests, um.
    pub neutral_um: f64,
    /// Half of the field of view along the channel, um.
    pub view_um: f64,
    /// Share of range and slew kept free for feedback, noise and drift.
    pub reserve: f64,
    /// Sample time of the loop, s.
    pub sample_s: f64,
}

impl Default for CheckLimits {
    /// The paper's drive (0..40 um) from its middle, at 1 kHz, with a tenth in reserve.
    fn default() -> Self {
        Self {
            low_um: 0.0,
            high_um: 40.0,
            slew_um_per_s: 10_000.0,
            neutral_um: 20.0,
            view_um: 50.0,
            reserve: 0.1,
            sample_s: 1e-3,
        }
    }
}

/// A demand that the rig cannot meet.
#[derive(Debug, Clone, PartialEq)]
pub struct Violation {
    /// The exceeded limit: `PZT range`, `PZT slew`, `field of view`.
    pub what: &'static str,
    /// Line of the step in the script.
    pub line: usize,
    /// First time, s (of the plan with its repeats shortened).
    pub time_s: f64,
    /// The largest demand, in `unit`.
    pub asked: f64,
    /// What is allowed, in `unit`.
    pub allowed: f64,
    /// Unit of both.
    pub unit: &'static str,
}

/// A wave and its largest possible amplitude.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WaveCheck {
    /// Line of the step in the script.
    pub line: usize,
    /// Its shape.
    pub shape: WaveShape,
    /// Its frequency, Hz.
    pub frequency_hz: f64,
    /// Its amplitude, um.
    pub amplitude_um: f64,
    /// The largest amplitude that the rig could do there, um.
    pub largest_um: f64,
}

/// The part of a limit that a script uses.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LimitUse {
    /// The limit: `PZT range`, `PZT slew`, `field of view`.
    pub what: &'static str,
    /// Largest share of the allowed value, after the reserve; above 1 the script is refused.
    pub share: f64,
}

/// The result of a check.
#[derive(Debug, Clone, PartialEq)]
pub struct Check {
    /// Duration without waits, s.
    pub duration_s: f64,
    /// Cycles.
    pub cycles: u64,
    /// Lowest and highest position, um.
    pub position_um: (f64, f64),
    /// Highest speed of the bead, um/s.
    pub speed_um_per_s: f64,
    /// Lowest and highest PZT displacement, um.
    pub pzt_um: (f64, f64),
    /// Highest speed of the PZT, um/s.
    pub pzt_speed_um_per_s: f64,
    /// Largest allowed factor on all positions (from the start); below 1 the script is refused.
    pub largest_factor: f64,
    /// How much of each limit is used.
    pub used: Vec<LimitUse>,
    /// Cycles in the reference below, in which long repeats are shortened.
    pub cycles_shown: u64,
    /// Every wave of the script, with the largest amplitude that the rig could do.
    pub waves: Vec<WaveCheck>,
    /// Demands that the rig cannot meet; empty: the script can run.
    pub violations: Vec<Violation>,
    /// Times of the reference and PZT demand below, s.
    pub time_s: Vec<f64>,
    /// The reference, with long repeats shortened, um.
    pub reference_um: Vec<f64>,
    /// The PZT demand, um.
    pub demand_um: Vec<f64>,
}

/// A check that could not be made.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CheckError {
    /// The script cannot be laid out.
    #[error(transparent)]
    Script(#[from] ScriptError),
    /// The model cannot be discretised.
    #[error(transparent)]
    Plant(#[from] PlantError),
    /// A limit that makes no sense, or a model that cannot be inverted.
    #[error("{0}")]
    Limits(&'static str),
    /// Too many different steps to check.
    #[error(
        "the steps last {duration_s} s even with repeats shortened; at most {most_s} s can be checked"
    )]
    TooLong {
        /// Duration, s.
        duration_s: f64,
        /// Longest, s.
        most_s: f64,
    },
}

/// Longest hold that is checked tick by tick.
const MOST_TICKS: f64 = 20e6;

/// Checks a script against a model and limits.
///
/// # Errors
/// [`CheckError`]. A script that demands too much is not an error but gives [`Check::violations`].
pub fn check(script: &Script, model: &Model, limits: &CheckLimits) -> Result<Check, CheckError> {
    let room_up = (limits.high_um - limits.neutral_um) * (1.0 - limits.reserve);
    let room_down = (limits.neutral_um - limits.low_um) * (1.0 - limits.reserve);
    let slew = limits.slew_um_per_s * (1.0 - limits.reserve);
    let sound = room_up > 0.0 && room_down > 0.0 && slew > 0.0 && limits.view_um > 0.0;
    if !sound || !(0.0..1.0).contains(&limits.reserve) {
        return Err(CheckError::Limits(
            "limits: neutral must lie inside the range, slew and view be positive, reserve from 0 to below 1",
        ));
    }
    let full = Plan::new(script)?;
    let plan = Plan::shortened(script)?;
    let h = limits.sample_s;
    let ticks = (plan.total_s() / h).ceil();
    if ticks > MOST_TICKS {
        return Err(CheckError::TooLong {
            duration_s: plan.total_s(),
            most_s: MOST_TICKS * h,
        });
    }
    let plant = DiscretePlant::new(&model.plant, Seconds(h), Seconds(0.0))?;
    let mut probe = plant.state(0.0);
    plant.step(&mut probe, 1.0);
    let per_um = plant.output_um(&probe);
    if !(per_um.is_finite() && per_um.abs() > 1e-9) {
        return Err(CheckError::Limits(
            "the model's bead does not answer within one sample: its demand cannot be computed",
        ));
    }

    let start_um = plan.start_um();
    let mut state = plant.state(0.0);
    let mut out = Check {
        duration_s: full.total_s(),
        cycles: full.cycle_count(),
        position_um: (start_um, start_um),
        speed_um_per_s: 0.0,
        pzt_um: (limits.neutral_um, limits.neutral_um),
        pzt_speed_um_per_s: 0.0,
        largest_factor: f64::INFINITY,
        used: Vec::new(),
        cycles_shown: plan.cycle_count(),
        waves: Vec::new(),
        violations: Vec::new(),
        time_s: Vec::new(),
        reference_um: Vec::new(),
        demand_um: Vec::new(),
    };
    let (mut before_um, mut before_u) = (start_um, 0.0);
    for tick in 0..ticks as u64 {
        let time_s = tick as f64 * h;
        let next_um = plan.at_um(time_s + h);
        // First the response without a command, then the command that closes the difference.
        let mut free = state.clone();
        plant.step(&mut free, 0.0);
        let u = (next_um - start_um - plant.output_um(&free)) / per_um;
        plant.step(&mut state, u);
        let segment = plan.segment_at(time_s);
        let line = segment.map_or(0, |segment| segment.line);
        let view_um = (next_um - start_um).abs().max(next_um.abs());
        let pzt_speed = (u - before_u).abs() / h;
        out.position_um = (
            out.position_um.0.min(next_um),
            out.position_um.1.max(next_um),
        );
        out.speed_um_per_s = out.speed_um_per_s.max((next_um - before_um).abs() / h);
        let pzt_um = limits.neutral_um + u;
        out.pzt_um = (out.pzt_um.0.min(pzt_um), out.pzt_um.1.max(pzt_um));
        out.pzt_speed_um_per_s = out.pzt_speed_um_per_s.max(pzt_speed);
        let room = if u > 0.0 { room_up } else { room_down };
        if let Some(segment) = segment {
            let times = (room / u.abs()).min(slew / pzt_speed);
            out.wave(segment, times, limits.view_um);
        }
        for (what, asked, allowed, unit) in [
            ("PZT range", u.abs(), room, "um"),
            ("PZT slew", pzt_speed, slew, "um/s"),
            ("field of view", view_um, limits.view_um, "um"),
        ] {
            out.uses(what, asked / allowed);
            if asked > 0.0 {
                out.largest_factor = out.largest_factor.min(allowed / asked);
            }
            if asked > allowed {
                out.violation(Violation {
                    what,
                    line,
                    time_s,
                    asked,
                    allowed,
                    unit,
                });
            }
        }
        out.time_s.push(time_s);
        out.reference_um.push(plan.at_um(time_s));
        out.demand_um.push(pzt_um);
        (before_um, before_u) = (next_um, u);
    }
    Ok(out)
}

impl Check {
    /// Accounts for a tick of a wave whose PZT demand could be larger by this factor.
    fn wave(&mut self, segment: &Segment, times: f64, view_um: f64) {
        let Motion::Wave {
            shape,
            amplitude_um,
            frequency_hz,
            ..
        } = segment.motion
        else {
            return;
        };
        // A position needs no PZT displacement, because the bead can rest anywhere. It does need field of view.
        let most_um = (amplitude_um * times).min(view_um - segment.from_um.abs());
        let same = |known: &&mut WaveCheck| {
            (known.line, known.amplitude_um, known.frequency_hz)
                == (segment.line, amplitude_um, frequency_hz)
        };
        // The last one added is in force, unless steps are repeated.
        match self.waves.iter_mut().rev().find(same) {
            Some(known) => known.largest_um = known.largest_um.min(most_um),
            None => self.waves.push(WaveCheck {
                line: segment.line,
                shape,
                frequency_hz,
                amplitude_um,
                largest_um: most_um,
            }),
        }
    }

    /// Keeps the largest share of each limit.
    fn uses(&mut self, what: &'static str, share: f64) {
        match self.used.iter_mut().find(|known| known.what == what) {
            Some(known) => known.share = known.share.max(share),
            None => self.used.push(LimitUse { what, share }),
        }
    }

    /// The limit that a larger script would reach first; none if nothing moves.
    pub fn tightest(&self) -> Option<LimitUse> {
        let moved = self.used.iter().filter(|one| one.share > 0.0);
        moved.max_by(|a, b| a.share.total_cmp(&b.share)).copied()
    }

    /// Keeps the worst demand of each kind at each line.
    fn violation(&mut self, new: Violation) {
        let known = self
            .violations
            .iter_mut()
            .find(|old| old.what == new.what && old.line == new.line);
        match known {
            Some(old) => old.asked = old.asked.max(new.asked),
            None => self.violations.push(new),
        }
    }
}
