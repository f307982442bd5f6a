//! Combines measured points and a delay test into one result: judged parameters, compensated response, model, warnings.
//!
//! The result that `cellpos identify` prints, as a library call. Not for acquiring data.

use std::collections::BTreeMap;

use cellpos_plant::{Covariance, Model, Noise, PlantError, TransferFunction, probably_per_hertz};
use nalgebra::{Complex, DMatrix};

use crate::candidate_model::CandidateModel;
use crate::delay::DelayEstimate;
use crate::error::IdentError;
use crate::experiment::Measured;
use crate::identifiability::{Judged, judge};
use crate::order_selection::{
    CandidateFits, CandidateOrder, DelayPrior, OrderSelection, index, model_of,
};
use crate::rest::of_one_delay;
use crate::sampled::Sampling;
use cellpos_numeric::statistics::{Z95, f_exceeds};

/// One line of the compensated response.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CompensatedPoint {
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Gain of the plant, hold and exposure taken off, dB.
    pub gain_db: f64,
    /// Standard deviation of the gain, dB.
    pub gain_sd_db: f64,
    /// Phase as the record shows it, hold and delay included, deg in (-360, 0].
    pub raw_phase_deg: f64,
    /// Phase with the hold taken off and the delay left in, deg, continued below -180.
    pub delayed_phase_deg: f64,
    /// Phase of the plant: hold, exposure and delay taken off, deg.
    pub phase_deg: f64,
    /// Standard deviation of the phase, deg, with that of the delay that was taken off.
    pub phase_sd_deg: f64,
    /// Coherence.
    pub coherence: f64,
}

/// Everything that an identification of the rig found.
#[derive(Debug, Clone, PartialEq)]
pub struct Identification {
    /// The measured points and the noise.
    pub measured: Measured,
    /// How the record was sampled.
    pub sampling: Sampling,
    /// The candidate orders, fitted.
    pub selection: CandidateFits,
    /// Parameters with verdicts, and the model to use.
    pub judged: Judged,
    /// The delay test, if one was run.
    pub led: Option<DelayEstimate>,
    /// Contradiction between LED test and phase slope, s.
    pub disagreement_s: Option<f64>,
    /// The response with hold, exposure and delay taken off.
    pub compensated: Vec<CompensatedPoint>,
    /// Localisation noise that vision reported while the plant was measured, um RMS, if it did.
    pub stated_noise_um: Option<f64>,
    /// What a user must know before using the model.
    pub warnings: Vec<String>,
}

/// A command acts with the next step of the board's output (docs/board.md), up to so much later, s. The place in a step at which commands
/// arrive wanders slowly, as the difference of two clocks does. So all of a line has one error, which is uniform within a step.
const OUTPUT_STEP_S: f64 = 1e-4;

/// Response of the plant at a measured point: the record's response, divided by that of the model with sampling and delay, times that
/// of the model alone. Exact for a correct model, and insensitive otherwise, because only the ratio of the model with and without
/// sampling enters.
pub fn compensated(
    measured: Complex<f64>,
    frequency_hz: f64,
    model: &CandidateModel,
    sampling: Sampling,
) -> Complex<f64> {
    measured * model.response(frequency_hz) / model.sampled_response(frequency_hz, sampling)
}

/// Fits, judges and compensates. `bootstrap` replicates (0: none) are drawn with `seed`. `stated_per_s` is the velocity gain assumed
/// before; there is a warning if it is the measured one divided by 2 pi. `two_lags`: the plant may be a regulator with a tube behind it.
///
/// # Errors
/// Those of [`OrderSelection::new`] and [`OrderSelection::fit`].
pub fn summarise(
    mut measured: Measured,
    sampling: Sampling,
    led: Option<DelayEstimate>,
    bootstrap: usize,
    seed: u64,
    stated_per_s: Option<f64>,
    two_lags: bool,
) -> Result<Identification, IdentError> {
    measured.points = of_one_delay(measured.points, sampling, two_lags)?;
    let problem = OrderSelection::new(&measured.points, sampling, None)?.with_two_lags(two_lags);
    let (problem, selection) = problem.fit_straying(OUTPUT_STEP_S / 12f64.sqrt())?;
    let stray_s = problem.stray_s();
    let prior = led.map(|l| DelayPrior {
        delay_s: l.delay_s,
        // What is not accounted for may be anything within its bounds.
        sd_s: l.sd_s.hypot(l.not_accounted_s / 3f64.sqrt()).max(1e-7),
        half95_s: (0.5 * (l.ci95_s[1] - l.ci95_s[0])).max(1e-7),
        not_accounted_s: l.not_accounted_s,
    });
    let judged = judge(&problem, &selection, prior, bootstrap, seed);
    let disagreement = judged.contradiction_s;
    let delay_sd_s = judged
        .parameter("delay_ms")
        .map(|p| (p.ci95[1] - p.ci95[0]) * 1e-3 / 3.92)
        .filter(|sd_s| sd_s.is_finite())
        .unwrap_or(0.0)
        .hypot(stray_s);
    let compensated = measured
        .points
        .iter()
        .map(|p| {
            let plant = compensated(p.response, p.frequency_hz, &judged.model, sampling);
            let phase_deg = continued(plant.arg().to_degrees(), -90.0);
            CompensatedPoint {
                frequency_hz: p.frequency_hz,
                gain_db: 20.0 * plant.norm().log10(),
                gain_sd_db: p.gain_sd_db(),
                raw_phase_deg: continued(p.phase_deg(), -180.0),
                delayed_phase_deg: phase_deg - 360.0 * p.frequency_hz * judged.model.delay_s,
                phase_deg,
                phase_sd_deg: (p.phase_sd_deg()).hypot(360.0 * p.frequency_hz * delay_sd_s),
                coherence: p.coherence,
            }
        })
        .collect();
    let mut result = Identification {
        measured,
        sampling,
        selection,
        judged,
        led,
        disagreement_s: disagreement,
        compensated,
        stated_noise_um: None,
        warnings: Vec::new(),
    };
    result.warnings = warnings(&result, stated_per_s);
    Ok(result)
}

/// A phase moved by whole turns to within half a turn of `near`.
fn continued(phase_deg: f64, near: f64) -> f64 {
    phase_deg - 360.0 * ((phase_deg - near) / 360.0).round()
}

/// Recognises a stated gain that is a measured one divided by 2 pi: Eq. (5)'s `63/s`, where 63 is the gain at 1 Hz. Returns measured over
/// stated gain if it is within 12 % of 2 pi.
pub fn literal_per_hertz(measured_per_s: f64, stated_per_s: f64) -> Option<f64> {
    let ratio = measured_per_s / stated_per_s;
    let turn = 2.0 * std::f64::consts::PI;
    ((ratio / turn - 1.0).abs() < 0.12).then_some(ratio)
}

/// If noise alone makes residuals this large with a smaller probability, a warning says so: one false warning in a thousand
/// identifications.
const BEYOND_NOISE: f64 = 1e-3;

fn warnings(result: &Identification, stated_per_s: Option<f64>) -> Vec<String> {
    let mut out = Vec::new();
    if let (Some(gap), Some(led)) = (result.disagreement_s, result.led) {
        out.push(format!(
            "the LED test's delay ({:.3} ms) and the phase slope's ({:.3} to {:.3} ms) miss each other by {:.3} ms: \
             something between the board's output and the bead delays too (amplifier, tube), or one of the tests is wrong. The phase of \
             the plant is off by as much ({:.0} degrees at 200 Hz), whichever it is",
            led.delay_s * 1e3,
            result.judged.phase_delay95_s[0] * 1e3,
            result.judged.phase_delay95_s[1] * 1e3,
            gap * 1e3,
            360.0 * 200.0 * gap
        ));
    }
    let best = result.selection.best();
    let beyond_noise = f_exceeds(
        best.chi2 / best.dof,
        best.dof,
        result.selection.interval_dof,
    );
    if beyond_noise < BEYOND_NOISE {
        out.push(format!(
            "the residuals of the best order are {:.1} times the noise (as standard deviations): the plant holds something that \
             Eq. (4) does not, or the delay varied while it was measured (cellpos doctor --why); the intervals were widened by that factor",
            result.selection.scale.sqrt()
        ));
    }
    if let Some(noise) = result.measured.noise.filter(|noise| !noise.used) {
        out.push(format!(
            "the scatter of the lines is no Brownian motion with a noise of fixes (p = {:.4}): the diffusion of {:.2} um2/s holds what \
             else shook the bead or the clocks, and is an upper limit",
            noise.p_value, noise.diffusion_um2_per_s
        ));
    }
    let gain = result.judged.model.gain_per_s;
    if let Some(stated) = stated_per_s
        && let Some(ratio) = literal_per_hertz(gain, stated)
    {
        let source = if probably_per_hertz(stated).is_some() {
            " (Eq. (5) prints 63/s, where 63 is the gain at 1 Hz: the plant is 2 pi 63/s = 396/s)"
        } else {
            ""
        };
        out.push(format!(
            "the measured gain, {gain:.0}/s, is {ratio:.2} times that of the model given, {stated:.1}/s: a factor of 2 pi, a gain \
             per hertz taken for one per rad/s{source}. A controller designed on it has 6.3 times too much loop gain"
        ));
    } else if let Some(hint) = probably_per_hertz(gain) {
        out.push(format!("the measured gain: {hint}"));
    }
    if gain < 0.0 {
        out.push("the gain is negative: check the camera's axis or the sign of the PZT before closing a loop".to_owned());
    }
    let distorted: Vec<String> = result
        .measured
        .segments
        .iter()
        .filter_map(|s| {
            let point = s.points.first()?;
            let worst = s
                .detection
                .iter()
                .filter(|d| d.p_value < 1e-4 && d.output.norm() > 0.01 * point.output.norm())
                .max_by(|a, b| a.output.norm().total_cmp(&b.output.norm()))?;
            // Feedback passes on a harmonic of the input: only harmonics that the input lacks show a nonlinearity.
            let linear = point.response.norm() * worst.input.norm() * 3.0;
            (worst.output.norm() > linear).then(|| {
                format!(
                    "{} Hz ({:.1} % at {:.1} Hz)",
                    point.frequency_hz,
                    100.0 * worst.output.norm() / point.output.norm(),
                    worst.frequency_hz
                )
            })
        })
        .collect();
    if !distorted.is_empty() {
        out.push(format!(
            "the output holds harmonics that no linear model explains, driven at {}",
            distorted.join(", ")
        ));
    }
    out
}

impl Identification {
    /// Localisation noise for a model, um RMS: from the scatter of the lines, or as stated by vision if Brownian motion dominates
    /// the scatter; 0 if neither is known.
    fn localisation_um(&self) -> f64 {
        let measured_um = self.measured.noise.map_or(0.0, |n| n.localisation_um);
        match self.stated_noise_um {
            Some(stated_um) if measured_um < 0.5 * stated_um => stated_um,
            _ => measured_um,
        }
    }

    /// The identified plant as a model file: transfer function without the delay, noise, intervals, covariance of the
    /// coefficients, and the delay of the camera path.
    ///
    /// # Errors
    /// [`PlantError`] when the coefficients make no plant.
    pub fn model(
        &self,
        name: &str,
        working_point_um: f64,
        provenance: BTreeMap<String, String>,
    ) -> Result<Model, PlantError> {
        let best = self.judged.model;
        let (num, den) = best.polynomials();
        let plant = TransferFunction::new(num, den)?;
        let mut intervals = BTreeMap::new();
        for p in &self.judged.parameters {
            if p.verdict.is_identified() && p.ci95.iter().all(|v| v.is_finite()) {
                intervals.insert(p.name.to_owned(), p.ci95);
            }
        }
        let mut provenance = provenance;
        provenance.insert("delay_ms".to_owned(), format!("{:.4}", best.delay_s * 1e3));
        provenance.insert(
            "model-order".to_owned(),
            self.selection.best().order.formula().to_owned(),
        );
        for p in &self.judged.parameters {
            provenance.insert(format!("verdict.{}", p.name), p.verdict.label().to_owned());
        }
        let noise = self.measured.noise.map_or(Noise::NONE, |n| Noise {
            diffusion_um2_per_s: n.diffusion_um2_per_s,
            localisation_um: self.localisation_um(),
        });
        Ok(Model {
            name: name.to_owned(),
            description: format!(
                "identified from {} lines, {}",
                self.measured.points.len(),
                self.selection.best().order.formula()
            ),
            plant,
            working_point_um,
            effects: Vec::new(),
            noise,
            camera_delay_s: Some(best.delay_s),
            frame_age_s: None,
            covariance: Some(self.coefficient_covariance()),
            intervals,
            provenance,
        })
    }

    /// Covariance of the transfer function's coefficients and of the delay, carried over from that of the fitted parameters.
    fn coefficient_covariance(&self) -> Covariance {
        let best = self.judged.model;
        let order = if best.slow_pole_rad_per_s != 0.0 {
            CandidateOrder::Eq4
        } else if best.second_pole_rad_per_s.is_some() {
            if best.zero_rad_per_s.is_finite() {
                CandidateOrder::TwoLagsZero
            } else {
                CandidateOrder::TwoLags
            }
        } else if best.far_lead_s != 0.0 {
            CandidateOrder::FarZero
        } else if best.zero_rad_per_s != best.pole_rad_per_s {
            CandidateOrder::PoleZeroPair
        } else {
            CandidateOrder::Integrator
        };
        let source = self
            .selection
            .candidates
            .iter()
            .find(|r| r.order == order)
            .unwrap_or(self.selection.best());
        let mut x = vec![0.0; source.order.parameters()];
        let values = [
            (index::LN_GAIN, best.gain_per_s.ln()),
            (index::EFFECTIVE_DELAY_MS, best.effective_delay_s() * 1e3),
            (index::LN_ZERO, best.zero_rad_per_s.ln()),
            (index::LN_POLE, best.pole_rad_per_s.ln()),
            (index::FAR_LEAD_MS, best.far_lead_s * 1e3),
            (
                index::FEEDTHROUGH_SHARE,
                best.feedthrough_share.unwrap_or(0.5),
            ),
            (index::SLOW_POLE, best.slow_pole_rad_per_s),
        ];
        let lags = best.second_pole_rad_per_s.map(|second| {
            [
                (index::LN_SECOND_POLE, second.ln()),
                (index::LN_ZERO_OF_LAGS, best.zero_rad_per_s.ln()),
            ]
        });
        for (i, value) in values.into_iter().chain(lags.into_iter().flatten()) {
            if let Some(place) = x.get_mut(i) {
                *place = value;
            }
        }
        let coefficients = |x: &[f64]| -> Vec<f64> {
            let model = model_of(x, source.order);
            let (num, den) = model.polynomials();
            let plant = num.into_iter().chain(den.into_iter().skip(1));
            plant.chain([model.delay_s]).collect()
        };
        let here = coefficients(&x);
        let mut jacobian = DMatrix::zeros(here.len(), x.len());
        for j in 0..x.len() {
            let step = 1e-6 * x[j].abs().max(1.0);
            let mut moved = x.clone();
            moved[j] += step;
            for (i, (a, b)) in coefficients(&moved).iter().zip(&here).enumerate() {
                jacobian[(i, j)] = (a - b) / step;
            }
        }
        let spread = source
            .covariance
            .map(|v| if v.is_finite() { v } else { 0.0 });
        let matrix = &jacobian * spread * jacobian.transpose();
        let (num, _) = model_of(&x, source.order).polynomials();
        let names = (0..num.len())
            .map(|i| format!("plant.num[{i}]"))
            .chain((1..here.len() - num.len()).map(|i| format!("plant.den[{i}]")))
            .chain([Model::CAMERA_DELAY.to_owned()])
            .collect();
        Covariance {
            parameters: names,
            matrix: (0..here.len())
                .map(|i| matrix.row(i).iter().copied().collect())
                .collect(),
        }
    }

    /// Band of the fitted plant at `frequency_hz`: gain (dB) and phase (deg), each low and high at 95 %, delay
    /// excluded. From the covariance of the chosen order.
    pub fn band(&self, frequency_hz: f64) -> ([f64; 2], [f64; 2]) {
        let best = self.selection.best();
        let here = best.model.response(frequency_hz);
        let (mut gain_variance, mut phase_variance) = (0.0, 0.0);
        let n = best.parameters.len();
        let gradient: Vec<(f64, f64)> = (0..n)
            .map(|j| {
                let step = 1e-5 * best.parameters[j].abs().max(0.1);
                let mut moved = best.parameters.clone();
                moved[j] += step;
                let ratio = model_of(&moved, best.order).response(frequency_hz) / here;
                (
                    20.0 * ratio.norm().log10() / step,
                    ratio.arg().to_degrees() / step,
                )
            })
            .collect();
        for i in 0..n {
            for j in 0..n {
                let c = best.covariance[(i, j)];
                gain_variance += gradient[i].0 * c * gradient[j].0;
                phase_variance += gradient[i].1 * c * gradient[j].1;
            }
        }
        let model = self.judged.model.response(frequency_hz);
        let (gain, phase) = (
            20.0 * model.norm().log10(),
            continued(model.arg().to_degrees(), -90.0),
        );
        let (g, p) = (
            Z95 * gain_variance.max(0.0).sqrt(),
            Z95 * phase_variance.max(0.0).sqrt(),
        );
        ([gain - g, gain + g], [phase - p, phase + p])
    }
}
