//! The rig at the level of positions: plant, neutral, Brownian motion, drift, delay and localisation noise.
//!
//! For design figures and tests, on the virtual clock: no camera, no board, no files. The truth is a
//! [`DiscretePlant`] without delay, the measurement the same plant with the camera path's delay, so that a fractional
//! delay is exact.

use cellpos_numeric::Random;
use cellpos_plant::{DiscretePlant, DiscreteState, PlantError, Seconds, TransferFunction};
use std::collections::VecDeque;

use crate::loop_io::Measurement;

/// Parts of the simulated rig.
#[derive(Debug, Clone, PartialEq)]
pub struct RigConfig {
    /// The true plant, from displacement relative to neutral to bead position.
    pub plant: TransferFunction,
    /// Sample time, s.
    pub sample_time_s: f64,
    /// Camera path, s: the measurement of a tick is of the position this much earlier.
    pub delay_s: f64,
    /// Displacement at which the bead rests, um.
    pub neutral_um: f64,
    /// Diffusion coefficient D, um^2/s.
    pub diffusion_um2_per_s: f64,
    /// Localisation noise, um RMS.
    pub fix_noise_um: f64,
    /// Seed of the noise.
    pub seed: u64,
}

impl RigConfig {
    /// Eq. (6) with D = 0.33 um^2/s, 20 nm fixes, a 2 ms camera path and neutral at 20 um.
    pub fn eq6(seed: u64) -> Self {
        Self {
            plant: TransferFunction::eq6(),
            sample_time_s: 1e-3,
            delay_s: 2e-3,
            neutral_um: 20.0,
            diffusion_um2_per_s: 0.33,
            fix_noise_um: 0.020,
            seed,
        }
    }

    /// The same without Brownian motion and localisation noise.
    pub fn noise_free(mut self) -> Self {
        self.diffusion_um2_per_s = 0.0;
        self.fix_noise_um = 0.0;
        self
    }
}

/// The simulated rig and its state.
#[derive(Debug, Clone)]
pub struct SimulatedRig {
    config: RigConfig,
    truth: DiscretePlant,
    truth_state: DiscreteState,
    seen: DiscretePlant,
    seen_state: DiscreteState,
    /// Position not caused by the PZT at the ticks of the delay, newest first: at the tick, and the fraction of a
    /// sample before it.
    walk: VecDeque<(f64, f64)>,
    whole: usize,
    fraction: f64,
    /// Drift of the bead, um/s.
    pub drift_um_per_s: f64,
    /// Something holds the bead.
    pub stuck: bool,
    /// Factor on the gain of the plant from now on; 1 at the start.
    pub gain: f64,
    /// Ticks by which fixes are older from now on than they are said to be, at most 7; 0 at the start.
    pub late_ticks: usize,
    /// What fixes without noise showed at this tick and those before, newest first, um.
    shown: [f64; 8],
    held: Option<(f64, VecDeque<f64>)>,
    random: Random,
}

impl SimulatedRig {
    /// A rig at rest: the PZT at neutral, the bead at 0.
    ///
    /// # Errors
    /// A sample time or delay that the discretisation refuses.
    pub fn new(config: RigConfig) -> Result<Self, PlantError> {
        let sample = Seconds(config.sample_time_s);
        let truth = DiscretePlant::new(&config.plant, sample, Seconds(0.0))?;
        let seen = DiscretePlant::new(&config.plant, sample, Seconds(config.delay_s))?;
        let samples = config.delay_s / config.sample_time_s;
        let whole = (samples + 1e-9).floor();
        Ok(Self {
            truth_state: truth.state(0.0),
            seen_state: seen.state(0.0),
            truth,
            seen,
            walk: VecDeque::from(vec![(0.0, 0.0); whole as usize + 1]),
            whole: whole as usize,
            fraction: (samples - whole).max(0.0),
            drift_um_per_s: 0.0,
            stuck: false,
            gain: 1.0,
            late_ticks: 0,
            shown: [0.0; 8],
            held: None,
            random: Random::new(config.seed),
            config,
        })
    }

    /// What it was built from.
    pub fn config(&self) -> &RigConfig {
        &self.config
    }

    /// True position now, just before the next command takes effect, um.
    pub fn true_um(&self) -> f64 {
        match &self.held {
            Some((position_um, _)) => *position_um,
            None => self.free_um(),
        }
    }

    fn free_um(&self) -> f64 {
        self.truth.output_um(&self.truth_state) + self.walk.front().map_or(0.0, |w| w.0)
    }

    /// The fix that arrives now.
    pub fn measure(&mut self) -> Measurement {
        let free =
            self.seen.output_um(&self.seen_state) + self.walk.get(self.whole).map_or(0.0, |w| w.1);
        let position_um = self
            .held
            .as_ref()
            .and_then(|(_, past)| past.get(self.whole).copied())
            .unwrap_or(free);
        self.shown[0] = position_um;
        let position_um = *self.shown.get(self.late_ticks).unwrap_or(&position_um);
        let noise = self.config.fix_noise_um;
        Measurement {
            position_um: position_um + noise * self.random.normal(),
            variance_um2: noise * noise,
            age_samples: 0,
            offset_samples: 0.0,
        }
    }

    /// Holds a command for one tick.
    pub fn advance(&mut self, command_um: f64) {
        let drive = (command_um - self.config.neutral_um) * self.gain;
        self.shown.copy_within(0..7, 1);
        let (now, _) = self.walk.front().copied().unwrap_or_default();
        let before = self.free_um();
        self.truth.step(&mut self.truth_state, drive);
        self.seen.step(&mut self.seen_state, drive);
        let ts = self.config.sample_time_s;
        let spread = (2.0 * self.config.diffusion_um2_per_s * ts).sqrt();
        let drift = self.drift_um_per_s * ts;
        let (early, late) = (1.0 - self.fraction, self.fraction);
        let middle = now + drift * early + spread * early.sqrt() * self.random.normal();
        let next = middle
            + drift * late
            + if late > 0.0 {
                spread * late.sqrt() * self.random.normal()
            } else {
                0.0
            };
        self.walk.push_front((next, middle));
        self.walk.truncate(self.whole + 1);
        self.hold(before);
    }

    /// A held bead does not move; when it comes free, it moves on from there.
    fn hold(&mut self, before_um: f64) {
        let free_um = self.free_um();
        if self.stuck {
            let (position_um, past) = self.held.get_or_insert_with(|| {
                let past = self.walk.iter().map(|_| before_um).collect();
                (before_um, past)
            });
            past.push_front(*position_um);
            past.truncate(self.whole + 1);
        } else if let Some((position_um, past)) = &mut self.held {
            // The bead moves from the held position by its motion in this tick.
            *position_um += free_um - before_um;
            past.push_front(*position_um);
            past.truncate(self.whole + 1);
        }
    }
}
