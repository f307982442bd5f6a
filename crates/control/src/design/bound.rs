//! The smallest hold error that any controller can reach: the minimum-variance bound.
//!
//! The command of tick k acts on the position of tick k + 1 and knows measurements up to `d` samples before tick k
//! only: `d + 1` samples of Brownian motion are out of reach, and so is what the best filter does not know of the
//! position at the time of the newest measurement.

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
