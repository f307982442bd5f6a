//! Excitation signals for the plant: stepped sines, log sweep, random-phase multisine, steps and rest.
//!
//! Signals are displacements to add to a command (um, peak amplitudes), one value per tick. The expected plant shapes
//! the amplitudes, so that the bead stays in view. In open loop, 1.6 um peak to peak at 2 Hz would move it 54 um. Not
//! for running an experiment: see [`crate::experiment`].

use nalgebra::Complex;

use crate::error::IdentError;
use serde::{Deserialize, Serialize};

/// The ten drive frequencies of the paper's Fig. 4 and 7, Hz.
pub const PAPER_FREQUENCIES_HZ: [f64; 10] = [
    2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 120.0, 150.0, 200.0, 300.0,
];

/// One sine of a signal.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Tone {
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Peak amplitude, um of PZT displacement.
    pub amplitude_um: f64,
    /// Phase at the start of the signal, rad (0: a sine starting at zero, rising).
    pub phase_rad: f64,
}

/// A signal to add to the PZT command.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Signal {
    /// No excitation: noise only.
    Rest,
    /// A sum of sines, faded in over `fade_in_s`.
    Tones {
        /// The sines.
        tones: Vec<Tone>,
        /// Time to rise to full amplitude (half a cosine), s.
        fade_in_s: f64,
    },
    /// A sine whose frequency rises exponentially; its amplitude is proportional to frequency up to `flat_from_hz`
    /// (constant bead amplitude on an integrator), constant above.
    LogSweep {
        /// First frequency, Hz.
        from_hz: f64,
        /// Last frequency, Hz.
        to_hz: f64,
        /// Duration of the sweep, s.
        duration_s: f64,
        /// Peak amplitude above `flat_from_hz`, um.
        amplitude_um: f64,
        /// Frequency from which the amplitude is constant, Hz.
        flat_from_hz: f64,
    },
    /// A repeated signal. Each repetition fades in and out, so that the whole can be measured as periodic.
    Repeated {
        /// The signal.
        signal: Box<Signal>,
        /// Time from start to start, s.
        period_s: f64,
        /// Time of each fade (half a cosine), s.
        fade_s: f64,
    },
    /// A staircase: up, back, down, back, each level held for `hold_s`.
    Steps {
        /// Height, um.
        height_um: f64,
        /// Time on each level, s.
        hold_s: f64,
    },
}

impl Signal {
    /// Period of the signal, s, if only the period defines its lines.
    pub fn repeats_s(&self) -> Option<f64> {
        match self {
            Signal::Repeated { period_s, .. } => Some(*period_s),
            _ => None,
        }
    }

    /// Displacement at `time_s` after the signal's start, um.
    pub fn value_um(&self, time_s: f64) -> f64 {
        let two_pi = 2.0 * std::f64::consts::PI;
        match self {
            Signal::Rest => 0.0,
            Signal::Tones { tones, fade_in_s } => {
                let fade = if time_s < *fade_in_s {
                    0.5 - 0.5 * (std::f64::consts::PI * time_s / fade_in_s).cos()
                } else {
                    1.0
                };
                let sum: f64 = tones
                    .iter()
                    .map(|t| {
                        t.amplitude_um * (two_pi * t.frequency_hz * time_s + t.phase_rad).sin()
                    })
                    .sum();
                fade * sum
            }
            Signal::LogSweep {
                from_hz,
                to_hz,
                duration_s,
                amplitude_um,
                flat_from_hz,
            } => {
                if time_s < 0.0 || time_s > *duration_s {
                    return 0.0;
                }
                let rate = (to_hz / from_hz).ln() / duration_s;
                let frequency = from_hz * (rate * time_s).exp();
                let phase = two_pi * from_hz * (rate * time_s).exp_m1() / rate;
                amplitude_um * (frequency / flat_from_hz).min(1.0) * phase.sin()
            }
            Signal::Repeated {
                signal,
                period_s,
                fade_s,
            } => {
                let within_s = time_s.rem_euclid(*period_s);
                let to_end_s = within_s.min(period_s - within_s);
                let fade = if to_end_s < *fade_s {
                    0.5 - 0.5 * (std::f64::consts::PI * to_end_s / fade_s).cos()
                } else {
                    1.0
                };
                fade * signal.value_um(within_s)
            }
            Signal::Steps { height_um, hold_s } => match (time_s / hold_s) as i64 % 4 {
                0 => *height_um,
                2 => -height_um,
                _ => 0.0,
            },
        }
    }
}

/// Checks that no harmonic up to `harmonics` of any line falls, folded by sampling at `rate_hz`, within
/// `resolution_hz` of another line.
///
/// # Errors
/// [`IdentError::AliasOnGrid`] with the first clash; [`IdentError::OutOfRange`] for a line at or above half the rate.
pub fn check_grid(
    lines_hz: &[f64],
    rate_hz: f64,
    harmonics: usize,
    resolution_hz: f64,
) -> Result<(), IdentError> {
    for &f in lines_hz {
        if !(f > 0.0 && f < 0.5 * rate_hz) {
            return Err(IdentError::OutOfRange {
                key: "frequency_hz",
                value: f,
                unit: "Hz",
                expected: "a frequency must be above 0 and below half the sampling rate",
            });
        }
        for harmonic in 2..=harmonics {
            let folded = fold(f * harmonic as f64, rate_hz);
            if let Some(&onto_hz) = lines_hz
                .iter()
                .find(|&&g| (g - folded).abs() < resolution_hz)
            {
                return Err(IdentError::AliasOnGrid {
                    from_hz: f,
                    harmonic,
                    onto_hz,
                    rate_hz,
                });
            }
        }
    }
    Ok(())
}

/// Frequency at which a sampled record shows it, Hz in 0..rate/2.
pub fn fold(frequency_hz: f64, rate_hz: f64) -> f64 {
    let wrapped = frequency_hz.rem_euclid(rate_hz);
    wrapped.min(rate_hz - wrapped)
}

/// Limits that an excitation must respect.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ExcitationLimits {
    /// Largest bead amplitude (peak) that stays in view, um.
    pub bead_um: f64,
    /// Largest bead speed (peak), um/s: beyond a few pixels per exposure the image is too smeared for a localiser.
    pub bead_um_per_s: f64,
    /// Largest PZT amplitude (peak), um.
    pub pzt_um: f64,
    /// Largest PZT speed, um/s.
    pub slew_um_per_s: f64,
}

/// Amplitude (peak) to add to the command at `frequency_hz` so that neither the bead, the PZT nor its speed leaves
/// `limits`. `plant` is the expected `X2/X1`; `loop_gain` is plant times controller with delay (0 in open loop): the
/// feedback divides the excitation by `1 + loop_gain`.
pub fn shaped_amplitude_um(
    frequency_hz: f64,
    plant: Complex<f64>,
    loop_gain: Complex<f64>,
    limits: ExcitationLimits,
) -> f64 {
    let sensitivity = (1.0 / (1.0 + loop_gain)).norm();
    let w = 2.0 * std::f64::consts::PI * frequency_hz;
    let bead_um = limits.bead_um.min(limits.bead_um_per_s / w);
    let pzt_um = (bead_um / plant.norm())
        .min(limits.pzt_um)
        .min(limits.slew_um_per_s / w);
    pzt_um / sensitivity
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_papers_grid_aliases_onto_itself() {
        let clash = check_grid(&PAPER_FREQUENCIES_HZ, 1000.0, 5, 0.25).unwrap_err();
        assert!(matches!(clash, IdentError::AliasOnGrid { .. }), "{clash}");
        let high = check_grid(&[100.0, 200.0, 300.0], 1000.0, 7, 0.25).unwrap_err();
        assert!(matches!(high, IdentError::AliasOnGrid { .. }));
        assert_eq!(check_grid(&[7.0, 61.0, 211.0], 1000.0, 3, 0.25), Ok(()));
    }

    #[test]
    fn folding_shows_where_a_harmonic_lands() {
        assert_eq!(fold(900.0, 1000.0), 100.0);
        assert_eq!(fold(1200.0, 1000.0), 200.0);
        assert_eq!(fold(293.0, 1000.0), 293.0);
    }

    #[test]
    fn shaped_amplitudes_keep_the_bead_in_view_in_open_and_closed_loop() {
        let limits = ExcitationLimits {
            bead_um_per_s: 1e9,
            bead_um: 8.0,
            pzt_um: 15.0,
            slew_um_per_s: 1e9,
        };
        let plant = Complex::new(0.0, -34.0);
        assert!(
            (shaped_amplitude_um(2.0, plant, Complex::new(0.0, 0.0), limits) * 34.0 - 8.0).abs()
                < 1e-9
        );
        let closed = shaped_amplitude_um(2.0, plant, Complex::new(3.0, -16.0), limits);
        let bead = closed * plant.norm() / Complex::<f64>::new(4.0, -16.0).norm();
        assert!((bead - 8.0).abs() < 1e-9);
    }

    #[test]
    fn a_sweep_passes_its_end_frequencies() {
        let sweep = Signal::LogSweep {
            from_hz: 2.0,
            to_hz: 300.0,
            duration_s: 20.0,
            amplitude_um: 1.0,
            flat_from_hz: 100.0,
        };
        // Zero crossings in the last 0.1 s count the last frequency.
        let crossings = (0..10_000)
            .map(|i| {
                (
                    sweep.value_um(19.9 + i as f64 * 1e-5),
                    sweep.value_um(19.9 + (i + 1) as f64 * 1e-5),
                )
            })
            .filter(|(a, b)| a.signum() != b.signum())
            .count();
        assert!((57..=60).contains(&crossings), "{crossings}");
        assert_eq!(sweep.value_um(25.0), 0.0);
        let repeated = Signal::Repeated {
            signal: Box::new(sweep.clone()),
            period_s: 20.0,
            fade_s: 0.2,
        };
        assert_eq!(repeated.repeats_s(), Some(20.0));
        for time_s in [0.7, 3.21, 11.9] {
            assert_eq!(repeated.value_um(time_s), sweep.value_um(time_s));
            assert!((repeated.value_um(40.0 + time_s) - sweep.value_um(time_s)).abs() < 1e-9);
        }
        // The signal has no jump from one repetition to the next.
        assert!(repeated.value_um(20.0 - 1e-4).abs() < 1e-4);
    }
}
