//! [`Chain`]: a model as a time-stepping machine, from the command to the bead.
//!
//! Between two changes of the command the linear part is exact for any length of step, so the plant's far zero, a driver lag and a
//! resonance need no small steps. Hysteresis and backlash on a held command are exact as well. If a nonlinear block follows one with
//! dynamics (a driver lag before hysteresis, the plant before wall adhesion), the fastest time constant before it sets the sub-steps.
//!
//! Not here: the camera (see [`crate::Simulator`]).

mod compile;
mod linear;
mod tied;

use crate::effects::{EffectError, Piece};
use crate::model::Model;
use cellpos_numeric::Random;
use compile::{Compiled, Stage};
pub use tied::TiedPlant;

/// A model that cannot be run.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ChainError {
    /// An effect with parameters out of range.
    #[error(transparent)]
    Effect(#[from] EffectError),
    /// A number of the model that is not finite or out of range.
    #[error("{name} = {value} {unit}: it must be a finite number in {lower}..{upper} {unit}")]
    OutOfRange {
        /// The quantity.
        name: &'static str,
        /// Its value.
        value: f64,
        /// Its unit.
        unit: &'static str,
        /// Lower bound.
        lower: f64,
        /// Upper bound.
        upper: f64,
    },
    /// The model contains an effect twice that can act only once.
    #[error("{id} stands twice in the model: it can act only once")]
    Repeated {
        /// The effect.
        id: &'static str,
    },
}

pub(crate) fn in_range(
    name: &'static str,
    value: f64,
    unit: &'static str,
    lower: f64,
    upper: f64,
) -> Result<(), ChainError> {
    if value.is_finite() && value >= lower && value <= upper {
        Ok(())
    } else {
        Err(ChainError::OutOfRange {
            name,
            value,
            unit,
            lower,
            upper,
        })
    }
}

/// The rig from the command to the bead: driver, PZT, chip and bead of a model.
///
/// At rest at the working point when new. [`Chain::advance`] allocates nothing, cannot panic and is deterministic; a
/// clone is a snapshot. A step of 1 ms of Eq. (6) is two multiply-adds per pole.
///
/// ```
/// use cellpos_plant::{Chain, Model};
/// let mut chain = Chain::new(&Model::eq6()).unwrap();
/// for _ in 0..10 {
///     chain.advance(5.0, 1e-3); // 1 um beyond the working point of 4 um, for 10 ms
/// }
/// assert!((chain.bead_um() - 3.95).abs() < 0.02); // 379 um/s at first, rising to 428 um/s
/// ```
#[derive(Debug, Clone)]
pub struct Chain {
    compiled: Compiled,
    working_point_um: f64,
    brownian: Option<Brownian>,
    time_s: f64,
    command_um: f64,
    driver_um: f64,
    /// Displacement that acts on the flow in addition to the PZT's, um.
    beside_um: f64,
    output: Piece,
    offset_um: f64,
    area_um_s: f64,
    wants_area: bool,
}

/// Diffusion of the bead.
#[derive(Debug, Clone)]
struct Brownian {
    diffusion_um2_per_s: f64,
    gaussian: Random,
}

impl Chain {
    /// The chain of a model, without Brownian motion.
    ///
    /// # Errors
    /// Parameters out of range (a model read from a file has none).
    pub fn new(model: &Model) -> Result<Self, ChainError> {
        for effect in &model.effects {
            effect.validate()?;
        }
        let most = match model.is_in_any_unit() {
            true => f64::MAX,
            false => 1e4,
        };
        let (point, diffusion) = (model.working_point_um, model.noise.diffusion_um2_per_s);
        in_range("working_point_um", point, "um", -most, most)?;
        in_range("diffusion_um2_per_s", diffusion, "um^2/s", 0.0, most)?;
        let mut chain = Self {
            compiled: compile::compile(model),
            working_point_um: model.working_point_um,
            brownian: None,
            time_s: 0.0,
            command_um: 0.0,
            driver_um: 0.0,
            beside_um: 0.0,
            output: Piece::default(),
            offset_um: 0.0,
            area_um_s: 0.0,
            wants_area: false,
        };
        chain.rest();
        Ok(chain)
    }

    /// The chain of a model with the bead's Brownian motion, fixed by the seed.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn with_brownian_motion(model: &Model, seed: u64) -> Result<Self, ChainError> {
        let mut chain = Self::new(model)?;
        for (i, stage) in chain.compiled.stages.iter_mut().enumerate() {
            if let Stage::Block(block) = stage {
                block.seed(seed.wrapping_add(0x632b_e59b_d9b4_e019_u64.wrapping_mul(i as u64 + 1)));
            }
        }
        chain.brownian = Some(Brownian {
            diffusion_um2_per_s: model.noise.diffusion_um2_per_s,
            gaussian: Random::new(seed),
        });
        Ok(chain)
    }

    /// Keeps the integral of the bead position from now on, for exposures.
    pub(crate) fn keep_area(&mut self) {
        self.wants_area = true;
    }

    /// Applies the initial level of equations that replace the plant: if it is not 0, it exists before the first command.
    fn rest(&mut self) {
        let begins = |s: &Stage| matches!(s, Stage::Tied(tied) if tied.replaces_output());
        if self.compiled.stages.iter().any(begins) {
            self.piece(0.0, 0.0, 0.0);
        }
    }

    /// Holds a command \[um of PZT displacement, absolute\] for `dt_s`.
    ///
    /// `dt_s = 0` applies the command while no time passes: the bead is then just after its jump. A command or time that is not finite
    /// and a negative time are ignored: the last command is held.
    pub fn advance(&mut self, command_um: f64, dt_s: f64) {
        if command_um.is_finite() {
            self.command_um = command_um - self.working_point_um;
        }
        if !(dt_s.is_finite() && dt_s >= 0.0) {
            return;
        }
        let target = self
            .command_um
            .max(self.compiled.low)
            .min(self.compiled.high);
        let way = target - self.driver_um;
        let reach_s = way.abs() / self.compiled.rate;
        if reach_s > 0.0 && dt_s > 0.0 {
            // First the ramp to the target, or as far as the time allows, then rest at the target. So no piece contains a corner.
            let ramp_s = reach_s.min(dt_s);
            let end = if reach_s <= dt_s {
                target
            } else {
                self.driver_um + self.compiled.rate.copysign(way) * dt_s
            };
            self.divided(ramp_s, self.driver_um, end);
            self.driver_um = end;
            if dt_s > ramp_s {
                self.divided(dt_s - ramp_s, end, end);
            }
        } else {
            if reach_s == 0.0 {
                self.driver_um = target;
            }
            self.divided(dt_s, self.driver_um, self.driver_um);
        }
    }

    /// Sets a further cause of flow from now on: the pressure of a second actuator, or reservoirs whose heights differ. The value is the
    /// PZT displacement with the same effect \[um\]. It enters the chip, but neither driver nor PZT. A value that is not finite is
    /// ignored.
    ///
    /// ```
    /// use cellpos_plant::{Chain, Model};
    /// let mut chain = Chain::new(&Model::eq6()).unwrap();
    /// chain.set_beside_um(-1.0);
    /// chain.advance(5.0, 0.1); // 1 um beyond the working point of 4 um: the two cancel
    /// assert_eq!(chain.bead_um(), 0.0);
    /// assert_eq!(chain.pzt_um(), 5.0);
    /// ```
    pub fn set_beside_um(&mut self, beside_um: f64) {
        if beside_um.is_finite() {
            self.beside_um = beside_um;
        }
    }

    /// A straight line of the driver's output, in sub-steps if necessary.
    fn divided(&mut self, h_s: f64, start: f64, end: f64) {
        if h_s <= self.compiled.substep_s {
            self.piece(h_s, start, end);
            return;
        }
        let n = (h_s / self.compiled.substep_s).ceil().min(1e6);
        let h = h_s / n;
        let rise = (end - start) / n;
        let mut i = 0.0;
        while i < n {
            self.piece(h, start + rise * i, start + rise * (i + 1.0));
            i += 1.0;
        }
    }

    fn piece(&mut self, h_s: f64, start: f64, end: f64) {
        let want = self.compiled.needs_slopes || self.wants_area;
        let mut signal = Piece::line(start, end, h_s);
        let mut beside = Piece::default();
        for (i, stage) in self.compiled.stages.iter_mut().enumerate() {
            if i == self.compiled.plant {
                for group in &mut self.compiled.bypass {
                    let way = group.advance(h_s, signal, want);
                    beside.start += way.start;
                    beside.end += way.end;
                    beside.integral += way.integral;
                    beside.speed_start += way.speed_start;
                    beside.speed_end += way.speed_end;
                }
                signal.start += self.beside_um;
                signal.end += self.beside_um;
                signal.integral += self.beside_um * h_s;
            }
            signal = match stage {
                Stage::Linear(group) => group.advance(h_s, signal, want),
                Stage::Block(block) => block.advance(self.time_s, h_s, signal),
                Stage::Tied(tied) => tied.advance(self.time_s, h_s, signal),
            };
        }
        signal.end += beside.end;
        signal.integral += beside.integral;
        self.output = signal;
        if self.wants_area {
            self.area_um_s += signal.integral + h_s * self.offset_um;
        }
        if let Some(b) = &mut self.brownian
            && h_s > 0.0
        {
            let variance = 2.0 * b.diffusion_um2_per_s * h_s;
            let step = variance.sqrt() * b.gaussian.normal();
            if self.wants_area {
                // The integral of a Brownian path given its ends: mean of the ends, variance 2 D h^3/12.
                self.area_um_s +=
                    h_s * (0.5 * step + (variance / 12.0).sqrt() * b.gaussian.normal());
            }
            self.offset_um += step;
        }
        self.time_s += h_s;
    }

    /// Time since the start, s.
    pub fn time_s(&self) -> f64 {
        self.time_s
    }

    /// The true bead position now, um.
    pub fn bead_um(&self) -> f64 {
        self.output.end + self.offset_um
    }

    /// Integral of the bead position since the start, um s; kept only after [`Self::keep_area`].
    pub(crate) fn area_um_s(&self) -> f64 {
        self.area_um_s
    }

    /// The displacement that the PZT has reached, um, absolute: after driver, hysteresis, creep, resonance and backlash.
    pub fn pzt_um(&self) -> f64 {
        let reached = match self.compiled.stages.get(self.compiled.plant) {
            Some(Stage::Linear(group)) => group.tapped() - self.beside_um,
            _ => self.driver_um,
        };
        self.working_point_um + reached
    }

    /// The speed of the flow that carries the bead, um/s, before adhesion holds the bead back.
    pub fn flow_um_per_s(&self) -> f64 {
        let mut speed = 0.0;
        for stage in &self.compiled.stages {
            match stage {
                Stage::Linear(group) => speed = group.speed(),
                Stage::Block(block) => speed = block.speed(self.time_s, speed),
                Stage::Tied(tied) => speed = tied.velocity(),
            }
        }
        speed
    }
}
