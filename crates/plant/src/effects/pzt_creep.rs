//! `pzt-creep`: the displacement continues with the logarithm of time.

use super::candidate::{grid, one};
use super::{
    Action, Candidate, Effect, EffectKind, Experiment, Form, ParameterSpec, Place, Scope, Spec,
    lin, log,
};
use crate::modal::Zpk;
use nalgebra::Complex;

/// Creep: `x = x0 (1 + g log10(t / 0.1 s))` after a step, `g` the part of the step gained per decade of time.
///
/// The block is a bank of first-order lags, two per decade from 0.1 ms to 1000 s, each of weight g/2. It is linear, and differs
/// from the logarithm by at most 0.1 % of g from 1 ms to 300 s (Kuhnen, Janocha 1998, linear creep operators).
pub fn pzt_creep(per_decade: f64) -> Effect {
    Effect::new(&PztCreep, AT_REST, &[per_decade], &[])
}

/// The model's gain is that of a step after 0.1 s.
const AT_REST: usize = 0;
/// The model's gain is that of a step after 1 ms.
const AT_SPEED: usize = 1;
/// Creep begins later than the model's fast motion.
const WITH_ONSET: usize = 2;
/// The same, no lag being shorter than the onset.
const WITH_SHARP_ONSET: usize = 3;

const PER_DECADE: ParameterSpec = ParameterSpec::new("per_decade", "", -0.2, 0.2);
const ONSET: ParameterSpec = ParameterSpec::new("onset_s", "s", 1e-4, 100.0);

const FORMS: [Form; 4] = {
    let [slow, fast] = Form::anchored(&[PER_DECADE]);
    let onset = Form {
        name: "onset",
        ..Form::only(&[PER_DECADE, ONSET])
    };
    let sharp = Form {
        name: "sharp-onset",
        ..onset
    };
    [slow, fast, onset, sharp]
};

const PER_DECADE_FREE: super::FitParameter = lin("per_decade", 1e-5, 0.19, 1e-3);
const FREE: Candidate = Candidate::chain(&[PER_DECADE_FREE])
    .typical(0.0, 0.06)
    .smallest(0, 0.003);

#[derive(Debug)]
pub(super) struct PztCreep;

static SPEC: Spec = Spec {
    id: "pzt-creep",
    place: Place::Pzt,
    equation: "x = x0 (1 + g log10(t/0.1 s)) after a step; t/1 ms where the model's gain is that of fast motion; 1 + t/onset where creep begins later; 1 + g log10(1 + 1/(onset s)) where it has no shorter lag",
    signature: "a tail in the logarithm of time that flips with the sign of the step; a constant phase of about -39 g deg",
    forms: &FORMS,
    confused_with: &["pdms-relaxation", "leak", "pzt-hysteresis"],
    experiment: Experiment::Slow,
    separate_by: "steps both ways with holds of a minute: log-time tail (creep), exponential (relaxation), sag to zero (leak)",
    ..Spec::PLAIN
};

impl EffectKind for PztCreep {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        let since = match effect.form_index() {
            WITH_ONSET => Since::Onset(effect.scalar(1)),
            WITH_SHARP_ONSET => Since::SharpOnset(effect.scalar(1)),
            AT_SPEED => Since::Always(FAST_REFERENCE_S),
            _ => Since::Always(CREEP_REFERENCE_S),
        };
        Action::Linear(creep(effect.scalar(0), since))
    }

    fn has_two_gains(&self) -> bool {
        true
    }

    fn shapes(&self, form: usize) -> &'static [usize] {
        match form {
            WITH_ONSET => &[WITH_SHARP_ONSET],
            WITH_SHARP_ONSET => &[WITH_ONSET],
            _ => &[],
        }
    }

    fn candidates(&self) -> &'static [Candidate] {
        const ALL: [Candidate; 4] = {
            let [slow, fast] = FREE.anchored();
            // An onset below the shortest row gives the form before this one; an onset beyond the records gives no creep.
            let onset = Candidate {
                name: "onset",
                params: &[PER_DECADE_FREE, log("onset_s", 1e-3, 3.0)],
                ..FREE
            };
            let sharp = Candidate {
                name: "sharp-onset",
                ..onset
            };
            [slow, fast, onset, sharp]
        };
        const { &ALL }
    }

    fn starts(&self, form: usize, _: &Scope) -> Vec<Vec<f64>> {
        match form {
            WITH_ONSET | WITH_SHARP_ONSET => grid(&[0.03], &[0.01, 0.1]),
            _ => one([0.01, 0.05]),
        }
    }
}

/// Slowest and fastest time constants of the creep bank, s, and how many per decade.
const CREEP_FASTEST_S: f64 = 1e-4;
const CREEP_DECADES: usize = 9;
const CREEP_PER_DECADE: usize = 2;
/// A creeping piezo has its nominal displacement this long after a step, s.
const CREEP_REFERENCE_S: f64 = 0.1;
/// The same for the gain of fast motion.
const FAST_REFERENCE_S: f64 = 1e-3;

/// Time constants of the creep bank from the fastest on, s.
fn creep_times(fastest_s: f64) -> impl Iterator<Item = f64> {
    let slowest_s = CREEP_FASTEST_S * 10f64.powi(CREEP_DECADES as i32);
    (0..CREEP_DECADES * CREEP_PER_DECADE)
        .map(move |i| fastest_s * 10f64.powf((i as f64 + 0.5) / CREEP_PER_DECADE as f64))
        .take_while(move |tau| *tau < slowest_s)
}

/// Origin of the logarithm.
#[derive(Debug, Clone, Copy)]
enum Since {
    /// The step: the displacement is the nominal one this long after it \[s\].
    Always(f64),
    /// A time after the step \[s\].
    Onset(f64),
    /// The shortest lag \[s\].
    SharpOnset(f64),
}

/// Lags whose share is below this part of the others' are left out: pole and zero would coincide.
const LEAST_SHARE: f64 = 1e-6;

/// `1 + sum (g/n) (1/(1 + tau s) - (1 - exp(-t0/tau)))`: the step response is `1 + g log10(t/t0)`. With an onset the shares are
/// `(g/n) exp(-onset/tau)`: the integral of `(1 - exp(-t/tau)) exp(-onset/tau)` over `ln tau` is `ln(1 + t/onset)` (Frullani).
fn creep(per_decade: f64, since: Since) -> Zpk {
    if per_decade == 0.0 {
        return Zpk::one();
    }
    let share = per_decade / CREEP_PER_DECADE as f64;
    // Lags in cells of equal ratio: those of a sharp onset begin there.
    let first_s = match since {
        Since::SharpOnset(onset_s) => onset_s,
        _ => CREEP_FASTEST_S,
    };
    let lags: Vec<(f64, f64)> = creep_times(first_s)
        .map(|tau| match since {
            Since::Always(_) | Since::SharpOnset(_) => (1.0 / tau, share),
            Since::Onset(onset_s) => (1.0 / tau, share * (-onset_s / tau).exp()),
        })
        .filter(|(_, of_lag)| of_lag.abs() >= LEAST_SHARE * share.abs())
        .collect();
    let rates: Vec<f64> = lags.iter().map(|(rate, _)| *rate).collect();
    let before = |(rate, of_lag): &(f64, f64)| match since {
        Since::Always(reference_s) => of_lag * (-reference_s * rate).exp_m1(),
        Since::Onset(_) | Since::SharpOnset(_) => 0.0,
    };
    let direct = 1.0 + lags.iter().map(before).sum::<f64>();
    let value = |s: f64| {
        direct
            + lags
                .iter()
                .map(|(r, of_lag)| of_lag * r / (s + r))
                .sum::<f64>()
    };
    // Poles in falling order -r (r falls). One zero is between each pair of neighbours. The last one is beyond the fastest pole
    // for g > 0, and between the slowest pole and the origin for g < 0.
    let mut brackets: Vec<(f64, f64)> = rates.windows(2).map(|w| (-w[0], -w[1])).collect();
    if share > 0.0 {
        brackets.push((-rates[0] * 1e3, -rates[0]));
    } else {
        brackets.push((-rates[rates.len() - 1], 0.0));
    }
    let zeros = brackets
        .into_iter()
        .map(|(mut low, mut high)| {
            // Just left of a pole the sum has the sign of -share, just right the sign of share.
            let left_of_high = if high == 0.0 { 1.0 } else { -share.signum() };
            for _ in 0..200 {
                let middle = 0.5 * (low + high);
                if middle <= low || middle >= high {
                    break;
                }
                if value(middle) * left_of_high > 0.0 {
                    high = middle;
                } else {
                    low = middle;
                }
            }
            real(0.5 * (low + high))
        })
        .collect();
    Zpk {
        zeros,
        poles: rates.iter().map(|r| real(-r)).collect(),
        gain: direct,
    }
}

fn real(p: f64) -> Complex<f64> {
    Complex::new(p, 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn creep_with_an_onset_is_the_logarithm_of_one_and_the_time_in_onsets() {
        for onset_s in [2e-3, 0.02, 0.3] {
            let zpk = creep(0.06, Since::Onset(onset_s));
            for t in [0.3 * onset_s, onset_s, 10.0 * onset_s, 30.0] {
                // The step response by the residues at its poles.
                let step: f64 = zpk
                    .poles
                    .iter()
                    .map(|p| {
                        let above: f64 = zpk.zeros.iter().map(|z| p.re - z.re).product();
                        let others = zpk.poles.iter().filter(|q| *q != p);
                        let below: f64 = others.map(|q| p.re - q.re).product();
                        zpk.gain * above / below / p.re * (p.re * t).exp_m1()
                    })
                    .sum::<f64>()
                    + zpk.gain;
                let expected = 1.0 + 0.06 * (1.0 + t / onset_s).log10();
                assert!(
                    (step - expected).abs() < 2e-4,
                    "{onset_s} {t}: {step} {expected}"
                );
            }
        }
    }
}
