//! What a frame makes of a path: its mean over the exposure.

/// Mean of a path over an exposure of `exposure_ticks` whose middle is `ago` ticks old. `at` gives the path at an age in ticks;
/// between ticks it is straight, so that its mean there is that in the middle. `None` where the path is not known so far back.
pub(crate) fn mean(ago: f64, exposure_ticks: f64, at: impl Fn(f64) -> Option<f64>) -> Option<f64> {
    let half = 0.5 * exposure_ticks;
    let (mut from, until) = ((ago - half).max(0.0), ago + half);
    let length = until - from;
    if length < 1e-6 {
        return at(ago);
    }
    let mut sum = 0.0;
    while from < until {
        let to = (from.floor() + 1.0).min(until);
        sum += (to - from) * at(0.5 * (from + to))?;
        from = to;
    }
    Some(sum / length)
}
