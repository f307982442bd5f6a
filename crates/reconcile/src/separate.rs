//! The experiment that would tell an effect from its rivals.

/// What would tell an effect from its rivals, in words for the result.
pub(crate) fn separate_by(id: &str, alternatives: &[String]) -> String {
    let has = |other: &str| alternatives.iter().any(|a| a == other);
    let text = match id {
        "driver-lag" if has("bubble") => {
            "a lag of the driver and a bubble in the chip give the same response from command to bead: measure the piezo itself (strain gauge or capacitive sensor) with the fluid disconnected, or repeat after an hour: a bubble's lag drifts as it dissolves"
        }
        "bubble" if has("driver-lag") => {
            "a bubble in the chip and a lag of the driver give the same response from command to bead: measure the piezo itself with the fluid disconnected, or repeat after an hour: a bubble's lag drifts as it dissolves"
        }
        "gain-error" => {
            "actuator gain, pixel scale and bead height give the same factor: image a stage micrometer for the pixel scale, measure the piezo's displacement, and refocus on a bead at another height"
        }
        "time-delay" => {
            "excite to 300 Hz: a pole rolls off, an exposure follows a sinc, a delay does neither"
        }
        "driver-lag" | "exposure-averaging" | "bubble" | "pzt-resonance" => {
            "excite to 300 Hz and beyond: a pole rolls off, an exposure follows a sinc, a resonance peaks, a delay changes the phase only"
        }
        "pzt-hysteresis" => {
            "the same sine at a second amplitude and a second frequency, and its third harmonic"
        }
        "backlash" | "wall-adhesion" => {
            "an amplitude sweep: the lag of backlash shrinks to nothing, hysteresis grows, adhesion stops the bead at small amplitude"
        }
        "pzt-creep" | "pdms-relaxation" | "leak" => {
            "steps both ways with holds of a minute: log-time tail (creep), exponential (relaxation), sag to zero (leak)"
        }
        "saturation" | "slew-limit" => {
            "the same amplitude at a tenth of the frequency: a slew limit vanishes, a clip stays"
        }
        "gain-drift" | "clock-skew" => {
            "one long record: compare its first and its last third at a low and at a high frequency"
        }
        _ => "a longer record with the same excitation",
    };
    text.to_owned()
}
