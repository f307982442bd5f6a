//! Margins of a control law on any model, nonlinear effects included, from the response to small sines.
//!
//! Hysteresis and backlash have no transfer function; a holding loop sees their response to motion of its own size. This module
//! simulates that response line by line without noise. So the same figures exist for the model of the design and for the rig.

use cellpos_control::LinearLaw;
use cellpos_ident::tone_fit::{ToneFit, Whitening, fit_block};
use cellpos_plant::{Complex, Hertz, Model, SimulateOptions, simulate};
use cellpos_session::Failure;
use serde::Serialize;
use std::f64::consts::{PI, TAU};

/// Lines of the response, and the range of the search for margins, Hz.
const LOW_HZ: f64 = 1.0;
const HIGH_HZ: f64 = 450.0;
const LINES: usize = 36;
/// Amplitudes of the bead, and the largest of the PZT, um. The first is that of holding against Brownian motion and drift; the
/// next is used if a dead zone swallows the first.
pub const AMPLITUDES_UM: [f64; 3] = [0.3, 1.0, 3.0];

/// Bead over command as a record shows it, delay and hold included.
#[derive(Debug, Clone, PartialEq)]
pub struct Response {
    /// Frequencies, Hz, rising.
    pub hz: Vec<f64>,
    /// Response.
    pub value: Vec<Complex<f64>>,
}

impl Response {
    /// The response of a model to sines that move the bead by `amplitude_um`, or the PZT if that is less.
    pub fn of(model: &Model, amplitude_um: f64, sample_s: f64) -> Result<Self, Failure> {
        let mut response = Self {
            hz: Vec::with_capacity(LINES),
            value: Vec::with_capacity(LINES),
        };
        for i in 0..LINES {
            let wanted_hz = LOW_HZ * (HIGH_HZ / LOW_HZ).powf(i as f64 / (LINES - 1) as f64);
            // Whole periods in the rows that are fitted.
            let periods = (wanted_hz * 0.4).ceil().max(2.0);
            let rows = (periods / (wanted_hz * sample_s)).round() as usize;
            let hz = periods / (rows as f64 * sample_s);
            let pzt_um = amplitude_um / model.linear_response(Hertz(hz)).norm().max(1.0);
            let settle = (0.3 / sample_s) as usize / rows * rows + rows;
            let command_um: Vec<f64> = (0..settle + rows)
                .map(|k| model.working_point_um + pzt_um * (TAU * hz * k as f64 * sample_s).sin())
                .collect();
            let bead_um = simulate(model, &command_um, sample_s, &SimulateOptions::default())
                .map_err(Failure::input)?;
            let fit = ToneFit {
                drift_degree: 1,
                whitening: Whitening::Levels,
            };
            let phasor = |signal: &[f64]| {
                fit_block(signal, settle, settle + rows, sample_s, &[hz], fit)
                    .and_then(|block| block.phasors.first().copied())
            };
            if let (Some(y), Some(u)) = (phasor(&bead_um), phasor(&command_um)) {
                response.hz.push(hz);
                response.value.push(y / u);
            }
        }
        Ok(response)
    }

    /// Interpolates gain and phase linearly in the logarithm of frequency.
    fn dense(&self, points: usize) -> Vec<(f64, Complex<f64>)> {
        let mut phase = Vec::with_capacity(self.value.len());
        let mut last = 0.0;
        for v in &self.value {
            let turn = ((v.arg() - last) / TAU).round();
            last = v.arg() - turn * TAU;
            phase.push(last);
        }
        let mut out = Vec::new();
        for i in 1..self.hz.len() {
            let at = |k: usize| (self.hz[k].ln(), self.value[k].norm().ln(), phase[k]);
            let ((f0, g0, p0), (f1, g1, p1)) = (at(i - 1), at(i));
            for j in 0..points {
                let x = j as f64 / points as f64;
                out.push((
                    (f0 + x * (f1 - f0)).exp(),
                    Complex::from_polar((g0 + x * (g1 - g0)).exp(), p0 + x * (p1 - p0)),
                ));
            }
        }
        out
    }
}

/// Margins of a loop. For an unstable loop they only describe the curve of the open loop.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LoopMargins {
    /// Whether the closed loop is stable, by the poles of the linear model in place of the response.
    pub stable: bool,
    /// Peak of the sensitivity.
    pub ms: f64,
    /// Peak of the complementary sensitivity.
    pub mt: f64,
    /// Smallest phase margin over all gain crossovers, deg.
    pub pm_deg: f64,
    /// That crossover, Hz.
    pub crossover_hz: f64,
    /// Smallest factor above 1 on the gain that makes the loop unstable, dB; null without a phase crossover.
    pub gm_db: Option<f64>,
    /// Smallest additional delay that makes the loop unstable, ms.
    pub delay_margin_ms: f64,
}

/// Margins of a law on a response; `stable` is copied. `None` without a gain crossover.
pub fn margins(
    response: &Response,
    law: &LinearLaw,
    sample_s: f64,
    stable: bool,
) -> Option<LoopMargins> {
    let curve: Vec<(f64, Complex<f64>)> = response
        .dense(40)
        .into_iter()
        .map(|(hz, p)| {
            (
                hz,
                law.at(Complex::from_polar(1.0, TAU * hz * sample_s)) * p,
            )
        })
        .collect();
    let peak =
        |f: &dyn Fn(Complex<f64>) -> f64| curve.iter().map(|(_, l)| f(*l)).fold(0.0, f64::max);
    let mut m = LoopMargins {
        stable,
        ms: peak(&|l| (l + 1.0).inv().norm()),
        mt: peak(&|l| (l / (l + 1.0)).norm()),
        pm_deg: f64::INFINITY,
        crossover_hz: f64::NAN,
        gm_db: None,
        delay_margin_ms: f64::INFINITY,
    };
    for pair in curve.windows(2) {
        let [(f0, l0), (f1, l1)] = [pair[0], pair[1]];
        let (g0, g1) = (l0.norm().ln(), l1.norm().ln());
        // Fraction of the way from one point to the next at which the function changes its sign.
        let at = |a: f64, b: f64| if a == b { 0.0 } else { a / (a - b) };
        if g0 * g1 <= 0.0 {
            let x = at(g0, g1);
            let hz = f0 * (f1 / f0).powf(x);
            let l = l0 + (l1 - l0) * x;
            // Angle from -180 deg, on the side from which more lag brings it there.
            let pm = (l.arg() + PI).rem_euclid(TAU);
            m.delay_margin_ms = m.delay_margin_ms.min(1e3 * pm / (TAU * hz));
            let nearest = pm.min(TAU - pm).to_degrees();
            if nearest < m.pm_deg {
                (m.pm_deg, m.crossover_hz) = (nearest, hz);
            }
        }
        if l0.im * l1.im <= 0.0 && l0.re < 0.0 && l1.re < 0.0 {
            let gain = (l0 + (l1 - l0) * at(l0.im, l1.im)).norm();
            if gain < 1.0 && gain > 0.0 {
                let db = -20.0 * gain.log10();
                m.gm_db = Some(m.gm_db.map_or(db, |least| least.min(db)));
            }
        }
    }
    m.pm_deg.is_finite().then_some(m)
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_control::Pi;
    use cellpos_control::design::{DesignPlant, margins as exact};
    use cellpos_plant::effects;

    fn law() -> LinearLaw {
        LinearLaw::Pi {
            pi: Pi::new(0.46, 19.5),
            sample_time_s: 1e-3,
        }
    }

    fn with_delay(delay_s: f64) -> Model {
        Model::eq6().with_effect(effects::time_delay(delay_s))
    }

    #[test]
    fn a_linear_model_has_the_margins_of_its_transfer_function() {
        for delay_s in [2e-3, 3.3e-3] {
            let simulated = Response::of(&with_delay(delay_s), 0.3, 1e-3).unwrap();
            let m = margins(&simulated, &law(), 1e-3, true).unwrap();
            let e = exact(&DesignPlant::eq6(delay_s + 0.5e-3), &law()).unwrap();
            let near = |a: f64, b: f64| assert!((a / b - 1.0).abs() < 0.02, "{a} {b}: {m:?} {e:?}");
            near(m.ms, e.ms);
            near(m.mt, e.mt);
            near(m.pm_deg, e.pm_deg);
            near(m.crossover_hz, e.crossover_hz);
            near(m.gm_db.unwrap(), e.gm_db);
            near(m.delay_margin_ms, 1e3 * e.delay_margin_s);
        }
    }

    #[test]
    fn hysteresis_that_gives_way_to_small_motion_lowers_the_crossover() {
        // Play operators: below its threshold the second branch does not move at all.
        let play = effects::play(&[0.0, 5.0], &[0.7, 0.3], 0.0);
        let at = |model: &Model| {
            let simulated = Response::of(model, 0.3, 1e-3).unwrap();
            margins(&simulated, &law(), 1e-3, true).unwrap()
        };
        let without = at(&with_delay(2e-3));
        let with = at(&with_delay(2e-3).with_effect(play));
        let ratio = with.crossover_hz / without.crossover_hz;
        assert!((0.6..0.8).contains(&ratio), "{ratio}");
        assert!(with.ms < without.ms);
    }
}
