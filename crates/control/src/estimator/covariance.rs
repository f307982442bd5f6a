//! The covariance of position and zero flow, `[p11, p12, p22]`: a tick on, at rest, and after a correction.

/// Walk of the zero flow that the stated uncertainty counts with, um/sqrt(s): 6 nm about its mean within 20 s, sd sqrt(2 / time), as a rig
/// at rest does. The gains are made for eight times of that, so that they follow a rig that is worse.
pub const ZERO_FLOW_WALK_UM_PER_SQRT_S: f64 = 1.9e-3;

/// A covariance one tick later: `gain` is the way for a displacement of 1 um, then the variances of the walks of bead and zero flow.
pub(super) fn advanced(
    [p11, p12, p22]: [f64; 3],
    gain: f64,
    walk_um2: f64,
    flow_um2: f64,
) -> [f64; 3] {
    let far = (p22 + flow_um2).min(1e6);
    let p11n = p11 - 2.0 * gain * p12 + gain * gain * p22 + walk_um2;
    if p11n < 1e6 {
        [p11n, p12 - gain * p22, far]
    } else {
        [1e6, 0.0, far]
    }
}

/// The same for a bead that something holds.
pub(super) fn at_rest([p11, _, p22]: [f64; 3], flow_um2: f64) -> [f64; 3] {
    [p11, 0.0, (p22 + flow_um2).min(1e6)]
}

/// A covariance after a correction with any gains (Joseph's form); `h` is the sensitivity of a fix to neutral.
pub(super) fn corrected(
    [p11, p12, p22]: [f64; 3],
    h: f64,
    [k1, k2]: [f64; 2],
    variance_um2: f64,
) -> [f64; 3] {
    // (1 - k h) P (1 - k h)^T + k r k^T, with the innovation's covariance s = h P h^T + r.
    let (ph1, ph2) = (p11 + h * p12, p12 + h * p22);
    let s = ph1 + h * ph2 + variance_um2;
    [
        (p11 - 2.0 * k1 * ph1 + k1 * k1 * s).max(0.0),
        p12 - k1 * ph2 - k2 * ph1 + k1 * k2 * s,
        (p22 - 2.0 * k2 * ph2 + k2 * k2 * s).max(0.0),
    ]
}
