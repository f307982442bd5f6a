//! Numbers as people read them.

/// A number with digits fit for reading.
pub fn number(value: f64) -> String {
    if value == 0.0 {
        "0".to_owned()
    } else if !value.is_finite() {
        if value.is_nan() {
            "not known".to_owned()
        } else if value > 0.0 {
            "no bound".to_owned()
        } else {
            "no lower bound".to_owned()
        }
    } else if value.abs() >= 1e7 {
        format!("{value:.2e}")
    } else if value.abs() >= 1000.0 {
        format!("{value:.0}")
    } else if value.abs() >= 100.0 {
        format!("{value:.1}")
    } else if value.abs() >= 1.0 {
        format!("{value:.3}")
    } else if value.abs() >= 1e-3 {
        format!("{value:.4}")
    } else {
        format!("{value:.3e}")
    }
}

/// A value with an interval, to the digits that the interval leaves it.
pub fn with_interval(value: f64, ci95: f64) -> String {
    let digits = digits_of(ci95);
    if !ci95.is_finite() {
        return format!("{value:.digits$} (no interval)");
    }
    // One value, one line.
    format!("{value:.digits$}\u{a0}±\u{a0}{ci95:.digits$}")
}

/// Decimals that an interval leaves a value.
pub fn digits_of(ci95: f64) -> usize {
    match ci95 > 0.0 && ci95.is_finite() {
        true => (1.0 - ci95.log10().floor()).clamp(0.0, 9.0) as usize,
        false => 4,
    }
}
