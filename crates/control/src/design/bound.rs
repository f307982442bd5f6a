//! The smallest hold error that any controller can reach: the minimum-variance bound.
//!
//! The command of tick k acts on the position of tick k + 1 and knows only measurements up to `d` samples before tick k. So `d +
//! 1` samples of Brownian motion are out of reach, and so is the best filter's error of the position at the newest measurement.
//! Lags between command and bead add to it if their sampled form cannot be inverted: a command that removed an error at once would
//! grow from tick to tick.

use crate::deviation::Deviation;
use crate::loop_model::LoopModel;
use crate::riccati::lq_feedback;

/// Posterior variance (um^2) of the steady-state Kalman filter of a random walk.
///
/// `step_um2` is the variance of the walk per sample, `fix_um2` that of a measurement.
pub fn kalman_posterior_um2(step_um2: f64, fix_um2: f64) -> f64 {
    // M = P + Q, P = M R / (M + R): M^2 - Q M - Q R = 0.
    let prior = 0.5 * (step_um2 + (step_um2 * step_um2 + 4.0 * step_um2 * fix_um2).sqrt());
    (prior - step_um2).max(0.0)
}

/// The bound on the RMS of the true position's error while holding, um.
///
/// `delay_s` is the camera path without the half sample of hold.
///
/// ```
/// use cellpos_control::design::bound_rms_um;
/// assert!((1e3 * bound_rms_um(0.33, 0.0, 2e-3, 1e-3) - 44.5).abs() < 0.05);
/// assert!((1e3 * bound_rms_um(0.33, 0.0, 3e-3, 1e-3) - 51.4).abs() < 0.05);
/// ```
pub fn bound_rms_um(
    diffusion_um2_per_s: f64,
    fix_noise_um: f64,
    delay_s: f64,
    sample_time_s: f64,
) -> f64 {
    let step_um2 = 2.0 * diffusion_um2_per_s * sample_time_s;
    let blind = 2.0 * diffusion_um2_per_s * (delay_s + sample_time_s);
    (blind + kalman_posterior_um2(step_um2, fix_noise_um * fix_noise_um)).sqrt()
}

/// The same for a loop's whole path, lags of an actuator and its period included: minimum variance at the ticks by the state feedback
/// whose commands cost nothing. [`bound_rms_um`] where the path can be inverted.
pub fn bound_rms_of_path_um(diffusion_um2_per_s: f64, fix_noise_um: f64, model: &LoopModel) -> f64 {
    /// Cost of a command over that of the motion that it causes: next to none, for the equation to have a solution.
    const NEXT_TO_NONE: f64 = 1e-6;
    let at_once_um = bound_rms_um(
        diffusion_um2_per_s,
        fix_noise_um,
        model.delay_s,
        model.sample_time_s,
    );
    let d = Deviation::new(model);
    let weight = NEXT_TO_NONE * d.moved_um().powi(2);
    let more = lq_feedback(&d.a, &d.b, &(d.c.transpose() * &d.c), weight)
        // Of a step of the bead one tick passes before anything can be done; the rest is what stays for longer.
        .map_or(0.0, |(_, cost)| (cost[(0, 0)] - 1.0).max(0.0));
    let step_um2 = 2.0 * diffusion_um2_per_s * model.sample_time_s;
    (at_once_um * at_once_um + step_um2 * more).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::loop_model::LoopMode;

    #[test]
    fn a_path_that_can_be_inverted_has_the_closed_form() {
        let model = LoopModel::eq6(2e-3);
        let (of_path, closed) = (
            bound_rms_of_path_um(0.33, 0.02, &model),
            bound_rms_um(0.33, 0.02, 2e-3, 1e-3),
        );
        assert!((of_path / closed - 1.0).abs() < 1e-3, "{of_path} {closed}");
    }

    #[test]
    fn regulator_and_tube_behind_20_ms_cost_what_their_zeros_do() {
        // K/(s (1 + 0.05 s)(1 + 0.02 s)): the sampled form has a zero at -b, outside the unit circle. An error e_k after a step of
        // 1 then has sum e_k (-b)^-k = b/(1 + b), whatever the controller, and the least sum of squares after e_0 is (b - 1)/(b +
        // 1).
        const B: f64 = 2.682_156;
        let (k, one, two) = (428.0, 0.05, 0.02);
        let model = LoopModel {
            modes: [
                LoopMode {
                    pole_rad_per_s: -1.0 / one,
                    residue_per_s: -k * one / (one - two),
                },
                LoopMode {
                    pole_rad_per_s: -1.0 / two,
                    residue_per_s: k * two / (one - two),
                },
            ],
            sample_time_s: 0.02,
            ..LoopModel::integrator(k, 2e-3)
        };
        let um = bound_rms_of_path_um(0.33, 0.025, &model);
        let closed = bound_rms_um(0.33, 0.025, 2e-3, 0.02);
        let more_um2 = 2.0 * 0.33 * 0.02 * (B - 1.0) / (B + 1.0);
        let expected = (closed * closed + more_um2).sqrt();
        assert!((um / expected - 1.0).abs() < 2e-3, "{um} {expected}");
    }

    #[test]
    fn an_independent_calculation_finds_the_same() {
        // State of the sampled path with the positions of the last milliseconds, its Kalman filter by iteration and state feedback whose
        // commands cost 1e-9 (SciPy), nm: regulator, tube (s), fix noise (um), bound with a fix a tick.
        let integrator = LoopModel::integrator(428.0, 2e-3);
        for (regulator_s, tube_s, noise_um, expected_nm) in [
            (0.05, 0.0, 0.00063, 120.50),
            (0.05, 0.0, 0.03, 123.96),
            (0.05, 0.02, 0.00063, 143.36),
            (0.05, 0.02, 0.03, 146.27),
        ] {
            let mode = |own: f64, other: f64| LoopMode {
                pole_rad_per_s: -1.0 / own,
                residue_per_s: -428.0 * own / (own - other),
            };
            let second = match tube_s > 0.0 {
                true => mode(tube_s, regulator_s),
                false => LoopMode::default(),
            };
            let model = LoopModel {
                modes: [mode(regulator_s, tube_s), second],
                sample_time_s: 0.02,
                ..integrator
            };
            let nm = 1e3 * bound_rms_of_path_um(0.33, noise_um, &model);
            assert!((nm / expected_nm - 1.0).abs() < 1e-3, "{nm} {expected_nm}");
        }
    }
}
