//! Experiments that separate effects: excitations added to the command of a held bead.
//!
//! The names that the records leave open decide which one is needed. All keep the bead in view and run unattended. Experiments that need
//! a person (another bead, the fluid disconnected) are not here.

use crate::experiment::on_rig::OnRig;
use cellpos_ident::excitation::{Signal, Tone};
use cellpos_ident::experiment::{Plan, PlannedSegment};
use cellpos_session::Failure;

/// One experiment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Experiment {
    /// The first record: a band, amplitudes and a rest.
    Survey,
    /// Lines from 2 Hz to near half the rate at once.
    Band,
    /// The same sines at three amplitudes.
    Amplitudes,
    /// Steps both ways, and slow sines.
    Slow,
    /// Large and small sines at the frequencies where the PZT moves fastest.
    Rates,
    /// A minute of the same.
    Long,
}

/// Lines of a band, Hz: odd multiples of 0.5 Hz, whose harmonics miss the others.
const BAND_HZ: [f64; 14] = [
    1.5, 2.5, 4.5, 7.5, 12.5, 20.5, 33.5, 54.5, 87.5, 140.5, 197.5, 293.5, 353.5, 431.5,
];

/// Largest speed of the bead, um/s. Sums of lines peak higher than a sine, and a fix that the tracker refuses as too far looks
/// like a lost frame.
const BEAD_UM_PER_S: f64 = 250.0;

impl Experiment {
    /// The experiment that separates an effect from its alternatives; `None`: no excitation does.
    pub fn separating(id: &str, alternatives: &[String]) -> Option<Self> {
        let among = |names: &[&str]| {
            std::iter::once(id)
                .chain(alternatives.iter().map(String::as_str))
                .any(|name| names.contains(&name))
        };
        let open: Vec<&str> = std::iter::once(id)
            .chain(alternatives.iter().map(String::as_str))
            .collect();
        // The same response from command to bead for any command.
        let same = |a: &str, b: &str| open.len() == 2 && open.contains(&a) && open.contains(&b);
        if alternatives.is_empty() || same("driver-lag", "bubble") {
            return None;
        }
        Some(if among(&["pzt-creep", "pdms-relaxation", "leak"]) {
            Self::Slow
        } else if among(&["saturation", "slew-limit"]) {
            Self::Rates
        } else if among(&["pzt-hysteresis", "backlash", "wall-adhesion"]) {
            Self::Amplitudes
        } else if among(&[
            "time-delay",
            "driver-lag",
            "exposure-averaging",
            "bubble",
            "pzt-resonance",
        ]) {
            Self::Band
        } else {
            Self::Long
        })
    }

    /// Name in file names and results.
    pub fn name(self) -> &'static str {
        match self {
            Self::Survey => "survey",
            Self::Band => "band",
            Self::Amplitudes => "amplitudes",
            Self::Slow => "slow",
            Self::Rates => "rates",
            Self::Long => "long",
        }
    }

    /// Its description in words.
    pub fn what(self) -> &'static str {
        match self {
            Self::Survey => {
                "lines from 1.5 to 431.5 Hz at once, sines of 3, 11 and 47 Hz at three amplitudes, a rest"
            }
            Self::Band => "lines from 1.5 to 431.5 Hz at once, twice",
            Self::Amplitudes => "sines of 3, 11 and 47 Hz at three amplitudes",
            Self::Slow => "steps both ways and sines of 0.5, 1 and 2 Hz",
            Self::Rates => {
                "sines of 29, 83 and 197 Hz, as large as the rig allows and a quarter of it"
            }
            Self::Long => "lines from 1.5 to 431.5 Hz at once for a minute",
        }
    }

    /// The segments for a rig and its assumed model, measured for `share` of the usual time. `seed` fixes the phases.
    pub fn plan(self, rig: &OnRig, share: f64, seed: u64) -> Result<Plan, Failure> {
        let setup = rig.bench_setup();
        let expected = setup.expected()?;
        let period_s = setup.sampling().period_s;
        let bead_um = rig.bead_amplitude_um(8.0)?;
        let limits = |share: f64| rig.limits(bead_um * share, BEAD_UM_PER_S * share, 8.0 * share);
        let band = |seconds: f64, seed: u64| {
            let mut plan = Plan::multisine(
                &BAND_HZ,
                &expected,
                limits(1.0),
                period_s,
                0.5 * seconds,
                seed,
            );
            plan.segments.remove(0)
        };
        let sines = |lines_hz: &[f64], shares: &[f64], seconds: f64| -> Vec<PlannedSegment> {
            shares
                .iter()
                .flat_map(|&share| {
                    let plan =
                        Plan::stepped_sines(lines_hz, &expected, limits(share), period_s, 1.0);
                    plan.segments.into_iter().map(move |mut segment| {
                        segment.label = format!("{}, {share} of full amplitude", segment.label);
                        segment.measure_s = seconds;
                        segment
                    })
                })
                .collect()
        };
        let quiet = |label: &str, signal: Signal, seconds: f64| PlannedSegment {
            label: label.to_owned(),
            signal,
            lines_hz: Vec::new(),
            detection_hz: Vec::new(),
            settle_s: 0.2,
            measure_s: seconds,
        };
        let segments = match self {
            Self::Survey => {
                let mut all = vec![band(10.0, seed)];
                all.extend(sines(&[3.0, 11.0, 47.0], &[1.0, 0.4, 0.15], 2.0));
                all.push(quiet("rest", Signal::Rest, 3.0));
                all
            }
            Self::Band => vec![band(10.0, seed), band(10.0, seed + 1)],
            Self::Amplitudes => sines(&[3.0, 11.0, 47.0], &[1.0, 0.4, 0.15], 3.0),
            Self::Slow => {
                let slow = |frequency_hz: f64| {
                    let tone = Tone {
                        frequency_hz,
                        // The loop acts against it; the bead moves by the sensitivity times the excitation.
                        amplitude_um: 1.0,
                        phase_rad: 0.0,
                    };
                    quiet(
                        &format!("{frequency_hz} Hz"),
                        Signal::Tones {
                            tones: vec![tone],
                            fade_in_s: 0.2,
                        },
                        8.0,
                    )
                };
                let steps = Signal::Steps {
                    height_um: 0.5,
                    hold_s: 2.0,
                };
                vec![quiet("steps", steps, 24.0), slow(0.5), slow(1.0), slow(2.0)]
            }
            Self::Rates => sines(&[29.0, 83.0, 197.0], &[1.0, 0.25], 3.0),
            Self::Long => vec![band(60.0, seed)],
        };
        let mut segments: Vec<PlannedSegment> = segments;
        for segment in &mut segments {
            segment.measure_s *= share;
        }
        Ok(Plan {
            period_s,
            segments,
            lost_frames: 50,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_no_excitation_separates_ask_for_none() {
        let or = |ids: &[&str]| ids.iter().map(|s| (*s).to_owned()).collect::<Vec<_>>();
        assert_eq!(Experiment::separating("driver-lag", &or(&["bubble"])), None);
        assert_eq!(Experiment::separating("gain-error", &[]), None);
        assert_eq!(
            Experiment::separating("driver-lag", &or(&["bubble", "time-delay"])),
            Some(Experiment::Band)
        );
        assert_eq!(
            Experiment::separating("time-delay", &or(&["pzt-hysteresis"])),
            Some(Experiment::Amplitudes)
        );
        assert_eq!(
            Experiment::separating("pzt-creep", &or(&["flow-drift"])),
            Some(Experiment::Slow)
        );
    }
}
