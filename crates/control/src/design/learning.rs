//! The closed loop's response to an addition to the command at the harmonics of a periodic reference, for learning.
//!
//! From the running loop itself (estimator, controller, limits) on a noise-free plant. It is the difference of two runs along the
//! same reference, one with a small tone added. So it is the response in force on that reference, with the estimator's gains and
//! the constraints there. The same at the corners of the plant's uncertainty gives the bound for the convergence test.

use crate::controller::{Controller, ControllerConfig, LoopConfig};
use crate::design::plant::DesignPlant;
use crate::design::step::SetUpError;
use crate::learning::{HARMONICS, HIGHEST_PART, HarmonicResponse};
use crate::loop_io::LoopInput;
use crate::mpc::SolverKind;
use crate::reference::{Reference, fill_preview};
use crate::simulation::{RigConfig, SimulatedRig};
use crate::uncertainty::Uncertainty;
use nalgebra::{Complex, DMatrix, DVector};
use std::f64::consts::TAU;

const SETTLE_TICKS: u64 = 400;
/// Shortest and longest time over which a response is fitted, ticks: a period, where that lies between.
const FIT_TICKS: (u64, u64) = (240, 10_000);
/// The tone moves the bead by about this, um.
const TONE_UM: f64 = 0.02;

/// The conditions under which a response is measured.
struct Bench<'a, R: ?Sized> {
    config: &'a LoopConfig,
    reference: &'a R,
    /// From this tick on the reference is in full swing; the response is fitted over the last ticks.
    first_tick: u64,
    fit_ticks: u64,
}

impl<R: Reference + ?Sized> Bench<'_, R> {
    /// First tick of the fit.
    fn fit_from(&self) -> u64 {
        self.first_tick + SETTLE_TICKS
    }

    /// True bead positions over the fitted ticks, with a tone added to the command.
    fn positions(
        &self,
        plant: &DesignPlant,
        tone_hz: f64,
        tone_um: f64,
    ) -> Result<Vec<f64>, SetUpError> {
        let ts = plant.sample_time_s;
        let mut rig = SimulatedRig::new(RigConfig {
            plant: plant.plant.clone(),
            sample_time_s: ts,
            delay_s: plant.delay_s,
            neutral_um: plant.neutral_um,
            diffusion_um2_per_s: 0.0,
            fix_noise_um: 0.0,
            seed: 0,
        })?;
        let mut controller = Controller::new(*self.config)?;
        controller.start(plant.neutral_um, plant.neutral_um);
        let mut preview = vec![0.0; controller.preview_len()];
        let mut path = Vec::with_capacity(self.fit_ticks as usize);
        for k in 0..self.fit_from() + self.fit_ticks {
            if k >= self.fit_from() {
                path.push(rig.true_um());
            }
            let time_s = k as f64 * ts;
            fill_preview(self.reference, k, ts, &mut preview);
            let mut fix = rig.measure();
            // A frame says by its time stamp how old it is.
            fix.offset_samples = (plant.delay_s - self.config.model.delay_s) / ts;
            let input = LoopInput {
                measurement: Some(fix),
                reference_um: self.reference.at_um(time_s),
                preview_um: &preview,
                learned_um: if k >= self.first_tick {
                    tone_um * (TAU * tone_hz * time_s).cos()
                } else {
                    0.0
                },
                ..LoopInput::default()
            };
            let out = controller.step(&input);
            rig.advance(out.command_um);
        }
        Ok(path)
    }
}

/// Response at one frequency: least squares of tone, offset and ramp.
fn response(with: &[f64], without: &[f64], first_tick: u64, ts: f64, hz: f64) -> Complex<f64> {
    let angle = |i: usize| TAU * hz * (first_tick + i as u64) as f64 * ts;
    let design = DMatrix::from_fn(with.len(), 4, |i, j| match j {
        0 => angle(i).cos(),
        1 => -angle(i).sin(),
        2 => 1.0,
        _ => i as f64 / with.len() as f64,
    });
    let moved = DVector::from_iterator(with.len(), with.iter().zip(without).map(|(a, b)| a - b));
    let normal = design.transpose() * &design;
    let fit = normal.lu().solve(&(design.transpose() * moved));
    fit.map_or(Complex::new(f64::NAN, f64::NAN), |x| {
        Complex::new(x[0], x[1])
    })
}

/// Responses at harmonics 1 to `harmonics` of a periodic reference of `frequency_hz` that has its full amplitude from `from_s` on;
/// harmonics above the range of learning are left out.
///
/// # Errors
/// A plant or a loop that cannot be built.
pub fn harmonic_responses(
    plant: &DesignPlant,
    config: &LoopConfig,
    reference: &(impl Reference + ?Sized),
    from_s: f64,
    frequency_hz: f64,
    harmonics: u32,
    uncertainty: Uncertainty,
) -> Result<Vec<HarmonicResponse>, SetUpError> {
    let ts = plant.sample_time_s;
    let mut config = *config;
    // The simulated rig sees points of the path.
    config.estimator.exposure_ms = 0.0;
    // The response of the loop as designed, on a plant that may be another.
    config.estimator.adapt = false;
    if let ControllerConfig::Mpc(mpc, _) = &mut config.controller {
        // Both solvers give the same law; this one takes a tenth of the time.
        mpc.solver = SolverKind::ActiveSet;
    }
    let g = uncertainty.gain_factor.max(1.0);
    let d = uncertainty.delay_s.max(0.0);
    let shifted = |gain: f64, delay_s: f64| -> Result<DesignPlant, SetUpError> {
        let mut other = plant.changed(gain, 0)?;
        other.delay_s = (plant.delay_s + delay_s).max(0.0);
        Ok(other)
    };
    let mut corners = vec![plant.clone()];
    for gain in [g, 1.0 / g] {
        for delay_s in [-d, 0.0, d] {
            corners.push(shifted(gain, delay_s)?);
        }
    }
    let hz = |h: u32| f64::from(h) * frequency_hz;
    let wanted: Vec<u32> = (1..=harmonics.min(HARMONICS as u32))
        .filter(|&h| hz(h) * ts <= HIGHEST_PART)
        .collect();
    let period_ticks = (1.0 / (frequency_hz * ts)).ceil() as u64;
    let bench = Bench {
        config: &config,
        reference,
        first_tick: (from_s / ts).ceil() as u64,
        fit_ticks: period_ticks.clamp(FIT_TICKS.0, FIT_TICKS.1),
    };
    let mut table: Vec<Vec<Complex<f64>>> = Vec::with_capacity(corners.len());
    for corner in &corners {
        let without = bench.positions(corner, 0.0, 0.0)?;
        let mut row = Vec::with_capacity(wanted.len());
        for &h in &wanted {
            let size = corner.plant.response(cellpos_plant::Hertz(hz(h))).norm();
            let tone_um = TONE_UM / size.max(1e-3);
            let with = bench.positions(corner, hz(h), tone_um)?;
            row.push(response(&with, &without, bench.fit_from(), ts, hz(h)) / tone_um);
        }
        table.push(row);
    }
    let Some((nominal, others)) = table.split_first() else {
        return Ok(Vec::new());
    };
    Ok(wanted
        .iter()
        .enumerate()
        .map(|(i, &harmonic)| HarmonicResponse {
            harmonic,
            re_um_per_um: nominal[i].re,
            im_um_per_um: nominal[i].im,
            relative_uncertainty: others
                .iter()
                .map(|row| (row[i] / nominal[i] - 1.0).norm())
                // A response that cannot be computed is not known at all.
                .fold(0.0, |most, x| {
                    if x.is_nan() {
                        f64::INFINITY
                    } else {
                        most.max(x)
                    }
                }),
        })
        .collect())
}
