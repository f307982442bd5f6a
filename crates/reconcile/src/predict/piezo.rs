//! Driver, piezo and chip blocks on a grid.

use super::block::{self, Block, DOMAINS, PLAY_LEVELS};
use super::modal::Zpk;
use nalgebra::Complex;

/// The creep bank, as in `cellpos-plant`: so many lags, two per decade, the first a quarter of a decade above 0.1 ms.
const CREEP_LAGS: usize = 18;
const CREEP_FASTEST_S: f64 = 1.778_279_41e-4;

/// Appends a linear block to a chain; anything else is left out.
pub(crate) fn append_linear(b: &Block, zpk: &mut Zpk) {
    match *b {
        Block::DriverLag { w } => zpk.lag_lead(None, Some(w)),
        Block::Creep { g } => creep(g, zpk),
        Block::Resonance { w, zeta } => {
            let c = Complex::new(zeta * zeta - 1.0, 0.0).sqrt();
            if c.im != 0.0 {
                zpk.poles.push(Complex::new(-zeta * w, w * c.im.abs()));
                zpk.poles.push(Complex::new(-zeta * w, -w * c.im.abs()));
            } else {
                zpk.poles.push(Complex::new(-w * (zeta + c.re), 0.0));
                zpk.poles.push(Complex::new(-w * (zeta - c.re), 0.0));
            }
            zpk.gain *= w * w;
        }
        Block::Relaxation { time_s, strength } => {
            zpk.lag_lead(Some(1.0 / ((1.0 + strength) * time_s)), Some(1.0 / time_s));
        }
        Block::Bubble { lag_s, .. } => zpk.lag_lead(None, Some(1.0 / lag_s)),
        Block::Leak { corner } => {
            zpk.zeros.push(Complex::new(0.0, 0.0));
            zpk.poles.push(Complex::new(-corner, 0.0));
        }
        Block::Gain { factor } => zpk.gain *= factor,
        _ => {}
    }
}

/// Logarithmic creep as a bank of lags: `1 + g/2 (sum 1/(1 + tau s) - n0)`, where n0 makes the step response 1 at 0.1 s.
fn creep(g: f64, zpk: &mut Zpk) {
    let taus_s: [f64; CREEP_LAGS] =
        std::array::from_fn(|i| CREEP_FASTEST_S * 10f64.powf(0.5 * i as f64));
    let n0: f64 = taus_s.iter().map(|t| 1.0 - (-0.1 / t).exp()).sum();
    let direct = 1.0 - 0.5 * g * n0;
    // Zeros interlace with the poles: one between each pair, one beyond the fastest. Bisection on w = -s.
    let value = |w: f64| direct + 0.5 * g * taus_s.iter().map(|t| 1.0 / (1.0 - t * w)).sum::<f64>();
    if g <= 0.0 || direct <= 0.0 {
        return;
    }
    let mut poles: Vec<f64> = taus_s.iter().map(|t| 1.0 / t).collect();
    poles.sort_by(f64::total_cmp);
    let mut gain = direct;
    for i in 0..poles.len() {
        let low = poles[i];
        let high = poles.get(i + 1).copied().unwrap_or(low * 1e3);
        let (mut a, mut b) = (low * (1.0 + 1e-12), high * (1.0 - 1e-12));
        // Just right of a pole (in w) its term is -infinity; just left of the next it is +infinity.
        for _ in 0..60 {
            let m = (a * b).sqrt();
            if value(m) < 0.0 {
                a = m;
            } else {
                b = m;
            }
        }
        let w = (a * b).sqrt();
        zpk.zeros.push(Complex::new(-w, 0.0));
        zpk.poles.push(Complex::new(-low, 0.0));
    }
    if !gain.is_finite() {
        gain = 1.0;
    }
    zpk.gain *= gain;
}

/// Rate limit; each step holds the mean of the ramp over the step, so that its integral is exact.
pub(crate) fn slew(x: &mut [f64], rate: f64, h: f64) {
    let most = rate * h;
    let mut at = 0.0f64;
    for v in x.iter_mut() {
        let d = (*v - at).clamp(-most, most);
        let share = if most > 0.0 { d.abs() / most } else { 0.0 };
        // The ramp takes `share` of the step, then rests at its end.
        *v = at + d * (1.0 - 0.5 * share);
        at += d;
    }
}

/// Bouc-Wen, one explicit step per increment of its input: h += du - beta |du| h - gamma du |h|, x = u - fraction h.
pub(crate) fn bouc_wen(x: &mut [f64], fraction: f64, beta: f64, gamma: f64) {
    let (mut before, mut z) = (0.0f64, 0.0f64);
    for v in x.iter_mut() {
        let du = *v - before;
        before = *v;
        z += du - beta * du.abs() * z - gamma * du * z.abs();
        *v -= fraction * z;
    }
}

/// Prandtl-Ishlinskii: weighted play operators and a quadratic output term.
pub(crate) fn play(
    x: &mut [f64],
    stroke_um: f64,
    weights: &[f64; PLAY_LEVELS.len()],
    quadratic: f64,
) {
    let radii = PLAY_LEVELS.map(|l| l * stroke_um);
    let mut p = [0.0f64; PLAY_LEVELS.len()];
    for v in x.iter_mut() {
        let mut sum = 0.0;
        for i in 0..PLAY_LEVELS.len() {
            p[i] = p[i].min(*v + radii[i]).max(*v - radii[i]);
            sum += weights[i] * p[i];
        }
        *v = sum + quadratic * sum * sum;
    }
}

/// Play operators of an exponential density, beside the input itself.
pub(crate) fn domains(x: &mut [f64], fraction: f64, width_um: f64) {
    let (radii, shares) = block::domains();
    let radii = radii.map(|r| r * width_um);
    let mut p = [0.0f64; DOMAINS];
    for v in x.iter_mut() {
        let mut sum = 0.0;
        for i in 0..DOMAINS {
            p[i] = p[i].min(*v + radii[i]).max(*v - radii[i]);
            sum += shares[i] * p[i];
        }
        *v += fraction * (sum - *v);
    }
}

/// Play of full width `width_um`.
pub(crate) fn backlash(x: &mut [f64], width_um: f64) {
    let r = 0.5 * width_um;
    let mut p = 0.0f64;
    for v in x.iter_mut() {
        p = p.min(*v + r).max(*v - r);
        *v = p;
    }
}

/// First-order lag whose time constant decays, by the mean over each step.
pub(crate) fn dissolving_lag(x: &mut [f64], lag_s: f64, dissolution: f64, h: f64) {
    let mut z = 0.0f64;
    for (j, v) in x.iter_mut().enumerate() {
        let tau = (lag_s * (-dissolution * j as f64 * h).exp()).max(1e-9);
        let a = (-h / tau).exp();
        let end = *v + (z - *v) * a;
        *v += (z - *v) * (1.0 - a) * tau / h;
        z = end;
    }
}
