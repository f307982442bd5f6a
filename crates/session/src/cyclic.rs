//! Cyclic motion: `--sine 5um@50Hz`, `--learn`, and the learned table of a run.

use crate::Failure;
use crate::prepared::Prepared;
use crate::rig_file::RigFile;
use cellpos_control::design::{
    CycleFigures, DesignPlant, Uncertainty, cycle_figures, harmonic_responses,
};
use cellpos_control::{
    CycleLearning, HarmonicResponse, LearnConfig, LearnError, LearnedTable, Learner, Profile,
    Reference, Shape,
};
use cellpos_numeric::units::{Hertz, Micrometers};
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::str::FromStr;

/// Amplitude and frequency of a sine, as `5um@50Hz`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sine {
    /// Half of peak to peak.
    pub amplitude: Micrometers,
    /// Frequency.
    pub frequency: Hertz,
}

/// Time over which a sine comes in, s.
pub const FADE_S: f64 = 0.2;

impl FromStr for Sine {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (amplitude, frequency) = text
            .split_once('@')
            .ok_or("write amplitude@frequency, for example 5um@50Hz")?;
        let amplitude: Micrometers = amplitude.parse().map_err(|e| format!("amplitude: {e}"))?;
        let frequency: Hertz = frequency.parse().map_err(|e| format!("frequency: {e}"))?;
        if amplitude.value() <= 0.0 || frequency.value() <= 0.0 {
            return Err("amplitude and frequency must be positive".to_string());
        }
        Ok(Self {
            amplitude,
            frequency,
        })
    }
}

impl Sine {
    /// Whether a loop can follow it at all: its frequency is seen once per frame, and the PZT has to go where the plant needs it.
    ///
    /// # Errors
    /// A frequency from half the loop's rate on; more stroke or slew than `prepared` has.
    pub fn check(&self, prepared: &Prepared, file: &RigFile) -> Result<(), Failure> {
        let (amplitude_um, hz) = (self.amplitude.value(), self.frequency.value());
        let rate_hz = 1e6 / file.timing.period_us;
        if hz >= 0.5 * rate_hz {
            return Err(Failure::bad_input(
                format!(
                    "--sine {}@{}: at {rate_hz:.0} ticks a second, motion at {:.0} Hz or faster looks like a slower one",
                    self.amplitude,
                    self.frequency,
                    0.5 * rate_hz
                ),
                "choose a lower frequency, or a faster loop and camera (period_us in [timing])",
            ));
        }
        let gain = design_plant(prepared, file)?
            .plant
            .response(self.frequency)
            .norm();
        let limits = &prepared.controller.limits;
        let drive_um = amplitude_um / gain;
        let stroke_um = 0.5 * (limits.high_um - limits.low_um);
        let slew_um = limits.slew_um_per_s / (std::f64::consts::TAU * hz);
        // Amplitude after the limits of range and slew, whichever is smaller.
        let share = stroke_um.min(slew_um) / drive_um;
        if share < 1.0 {
            let which = if slew_um < stroke_um {
                format!("a slew of {} um/s", limits.slew_um_per_s)
            } else {
                format!("the range of {} to {} um", limits.low_um, limits.high_um)
            };
            return Err(Failure::bad_input(
                format!(
                    "--sine {}@{}: the PZT would have to swing by +-{drive_um:.1} um, which exceeds {which}",
                    self.amplitude, self.frequency
                ),
                format!(
                    "choose an amplitude of {:.2}um at most, or a lower frequency",
                    0.95 * share * amplitude_um
                ),
            ));
        }
        Ok(())
    }

    /// The sine about 0.
    fn profile(&self) -> Profile {
        Profile::Wave {
            shape: Shape::Sine,
            centre_um: 0.0,
            amplitude_um: self.amplitude.value(),
            frequency_hz: self.frequency.value(),
            fade_s: FADE_S,
        }
    }
}

/// A periodic motion that a loop is to follow.
pub struct Motion<'a> {
    /// In words.
    pub name: String,
    /// The motion alone.
    pub reference: &'a dyn Reference,
    /// From when on it is in full swing, s.
    pub from_s: f64,
    /// Frequency of its cycles, Hz.
    pub frequency_hz: f64,
}

impl Motion<'_> {
    /// What the design predicts without noise.
    ///
    /// # Errors
    /// A model or a controller of which no loop can be made.
    pub fn figures(&self, prepared: &Prepared, file: &RigFile) -> Result<CycleFigures, Failure> {
        let config = prepared
            .controller
            .loop_config(&prepared.model)
            .map_err(Failure::input)?;
        let plant = design_plant(prepared, file)?;
        cycle_figures(
            &plant,
            &config,
            self.reference,
            self.from_s,
            self.frequency_hz,
        )
        .map_err(Failure::input)
    }

    /// Warning about a predicted error above a tenth of this motion's amplitude. Every law follows what the model can do (the loop
    /// knows the reference in advance), so no other controller is advised.
    ///
    /// # Errors
    /// A model or a controller of which no loop can be made.
    pub fn warning(&self, prepared: &Prepared, file: &RigFile) -> Result<Option<String>, Failure> {
        let figures = self.figures(prepared, file)?;
        Ok((figures.rms_um > 0.1 * figures.amplitude_um).then(|| {
            format!(
                "{}: predicted to be missed by {:.2} um RMS at and between ticks; a lower frequency or amplitude, or a shorter \
                 period, brings it down",
                self.name, figures.rms_um
            )
        }))
    }
}

/// Refuses a sine that the loop cannot follow, and gives what to say of one that it will miss; said already, before anything moves.
///
/// # Errors
/// See [`Sine::check`].
pub fn predicted(
    sine: Option<Sine>,
    prepared: &Prepared,
    file: &RigFile,
) -> Result<Option<String>, Failure> {
    let Some(sine) = sine else {
        return Ok(None);
    };
    sine.check(prepared, file)?;
    let motion = Motion {
        name: format!("{}@{}", sine.amplitude, sine.frequency),
        reference: &sine.profile(),
        from_s: FADE_S,
        frequency_hz: sine.frequency.value(),
    };
    let warning = motion.warning(prepared, file)?;
    if let Some(warning) = &warning {
        tracing::warn!("{warning}");
    }
    Ok(warning)
}

/// The plant as a controller was designed for, about the displacement at which this rig's bead first rests.
fn design_plant(setup: &Prepared, file: &RigFile) -> Result<DesignPlant, Failure> {
    let sample_s = file.timing.period_us * 1e-6;
    let delay_s = Some(setup.controller.delay_ms * 1e-3);
    let mut plant =
        DesignPlant::from_model(&setup.model, delay_s, sample_s).map_err(Failure::input)?;
    plant.neutral_um = file.first_neutral_um;
    Ok(plant)
}

/// What is learned in a run, from what: enough for a replay.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LearnSpec {
    /// Frequency of the reference, Hz.
    pub frequency_hz: f64,
    /// How.
    pub config: LearnConfig,
    /// Responses of the closed loop to the addition, with their uncertainty.
    pub responses: Vec<HarmonicResponse>,
    /// Margins of gain and delay that the uncertainty was computed with; none in runs from before this was kept.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub margins: Option<Uncertainty>,
    /// What was known before.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub table: Option<LearnedTable>,
}

/// Harmonics of a sine that are learned: nonlinearities make the third.
const SINE_HARMONICS: u32 = 3;

/// A periodic motion that is to be learned.
pub struct Wanted<'a> {
    /// The motion alone.
    pub reference: &'a dyn Reference,
    /// From when on it is in full swing, s.
    pub from_s: f64,
    /// Frequency of its cycles, Hz.
    pub frequency_hz: f64,
    /// Harmonics that are learned.
    pub harmonics: u32,
}

impl LearnSpec {
    /// For a sine of `cellpos track`; `table`: a learned table to go on from.
    pub fn for_sine(
        setup: &Prepared,
        file: &RigFile,
        sine: Sine,
        table: Option<LearnedTable>,
    ) -> Result<Self, Failure> {
        let frequency_hz = sine.frequency.value();
        let wanted = Wanted {
            reference: &sine.profile(),
            from_s: FADE_S,
            frequency_hz,
            harmonics: SINE_HARMONICS,
        };
        Self::new(setup, file, &wanted, table)
    }

    /// The responses are those of the loop's own model along the reference.
    pub fn new(
        setup: &Prepared,
        file: &RigFile,
        wanted: &Wanted,
        table: Option<LearnedTable>,
    ) -> Result<Self, Failure> {
        let loop_config = setup
            .controller
            .loop_config(&setup.model)
            .map_err(Failure::input)?;
        let plant = design_plant(setup, file)?;
        let margins = Uncertainty::of_model(&setup.model, plant.delay_s);
        let responses = harmonic_responses(
            &plant,
            &loop_config,
            wanted.reference,
            wanted.from_s,
            wanted.frequency_hz,
            wanted.harmonics,
            margins,
        )
        .map_err(Failure::input)?;
        let spec = Self {
            frequency_hz: wanted.frequency_hz,
            config: LearnConfig {
                exposure_s: setup.controller.estimator.exposure_ms * 1e-3,
                ticks_per_fix: setup.controller.estimator.ticks_per_fix,
                ..LearnConfig::default()
            },
            responses,
            margins: Some(margins),
            table,
        };
        spec.learning(plant.sample_time_s)?;
        Ok(spec)
    }

    /// The learner alone.
    pub fn learner(&self, sample_s: f64) -> Result<Learner, LearnError> {
        Learner::new(self.config, self.frequency_hz, sample_s, &self.responses)
            .map(|learner| learner.with_margins(self.margins))
    }

    /// The learner of the loop.
    pub fn learning(&self, sample_s: f64) -> Result<CycleLearning, Failure> {
        let learner = self.learner(sample_s).map_err(|error| match self.margins {
            Some(margins) if matches!(error, LearnError::NotConvergent { .. }) => {
                Failure::bad_input(format!("{error}"), format!("reckoned with: {margins}"))
            }
            _ => Failure::input(error),
        })?;
        let state = match &self.table {
            Some(table) => learner.resume(table).map_err(Failure::input)?,
            None => learner.start(),
        };
        Ok(CycleLearning::new(learner, state))
    }
}

/// Name of the file of what was learned, in a run folder.
pub const LEARNED_TOML: &str = "learned.toml";
/// Larger than what any run learns, bytes.
const MOST_BYTES: u64 = 1 << 26;

/// What was learned on a motion.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NamedTable {
    /// The motion in words.
    pub name: String,
    /// What was learned.
    pub table: LearnedTable,
}

/// The file: of a sine and of a script alike.
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct LearnedFile {
    #[serde(default)]
    motion: Vec<NamedTable>,
}

/// What a run learned; nothing when it left no file. Learning can be repeated: a truncated file gives a warning and is ignored.
pub fn load_learned(folder: &Path) -> Vec<NamedTable> {
    let path = folder.join(LEARNED_TOML);
    let read = match cellpos_table::read_text(&path, MOST_BYTES) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Vec::new(),
        Err(error) => Err(format!("{}: {error}", path.display())),
        Ok(text) => tables(&text, &path.display().to_string()).map_err(|failure| failure.text()),
    };
    read.unwrap_or_else(|problem| {
        tracing::warn!("the learned feed-forward is ignored: {problem}");
        Vec::new()
    })
}

/// The tables of a text. Runs of a sine once held the table alone.
fn tables(text: &str, name: &str) -> Result<Vec<NamedTable>, Failure> {
    match crate::toml_file::parse::<LearnedFile>(text, name) {
        Ok(file) => Ok(file.motion),
        Err(failure) => match toml::from_str(text) {
            Ok(table) => Ok(vec![NamedTable {
                name: "sine".to_owned(),
                table,
            }]),
            Err(_) => Err(failure),
        },
    }
}

/// Writes what was learned into a run folder: whole or not at all.
///
/// # Errors
/// A disk that is full, a folder that is gone.
pub fn save_learned(folder: &Path, motion: Vec<NamedTable>) -> std::io::Result<()> {
    put_learned(folder, motion, cellpos_table::write_atomically)
}

/// As [`save_learned`], without a wait for the disk: for what is learned while the run goes, on the recorder's thread.
///
/// # Errors
/// As [`save_learned`].
pub fn save_learning(folder: &Path, motion: Vec<NamedTable>) -> std::io::Result<()> {
    put_learned(folder, motion, cellpos_table::write_unsynced)
}

fn put_learned(
    folder: &Path,
    motion: Vec<NamedTable>,
    write: impl Fn(&Path, &[u8]) -> Result<(), cellpos_table::TableError>,
) -> std::io::Result<()> {
    if !folder.is_dir() {
        return Err(std::io::Error::other("the run's folder is gone"));
    }
    let file = LearnedFile { motion };
    let text = toml::to_string_pretty(&file).map_err(std::io::Error::other)?;
    write(&folder.join(LEARNED_TOML), text.as_bytes()).map_err(std::io::Error::other)
}

/// Reads the table of a sine, to begin with what was learned on it.
pub fn load_table(path: &Path) -> Result<LearnedTable, Failure> {
    let name = path.display().to_string();
    let help = "name the learned.toml of a run of track with --learn";
    let text = cellpos_table::read_text(path, MOST_BYTES)
        .map_err(|error| Failure::bad_input(format!("{name}: {error}"), help))?;
    let mut motions = tables(&text, &name)?;
    match (motions.pop(), motions.len()) {
        (Some(motion), 0) => Ok(motion.table),
        (None, _) => Err(Failure::bad_input(format!("{name}: holds no table"), help)),
        (Some(_), more) => Err(Failure::bad_input(
            format!("{name}: holds {} motions, of a script", more + 1),
            help,
        )),
    }
}

/// Writes what was learned on a sine into a run folder.
///
/// # Errors
/// As [`save_learned`].
pub fn save_table(folder: &Path, table: &LearnedTable) -> std::io::Result<()> {
    let name = "sine".to_owned();
    let table = table.clone();
    save_learned(folder, vec![NamedTable { name, table }])
}

/// What was learned, in a line.
pub fn learned_text(table: &LearnedTable) -> String {
    let nm =
        |um: Option<f64>| um.map_or_else(|| "-".to_string(), |um| format!("{:.1} nm", um * 1e3));
    format!(
        "{:.0} cycles, measured error {} RMS in the first cycles, {} in the last{}{}",
        table.cycles,
        nm(table.error_before_um),
        nm(table.error_after_um),
        match table.retreats {
            0 => String::new(),
            1 => "; withdrawn once".to_owned(),
            n => format!("; withdrawn {n} times"),
        },
        table
            .margins
            .map_or_else(String::new, |margins| format!("; allowed for: {margins}"))
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sine_is_read_as_amplitude_and_frequency_with_their_units() {
        let sine: Sine = "5um@50Hz".parse().expect("a sine");
        assert_eq!(
            (sine.amplitude.value(), sine.frequency.value()),
            (5.0, 50.0)
        );
        for wrong in ["5um", "5@50Hz", "5um@50", "-1um@50Hz", "5um@0Hz"] {
            assert!(wrong.parse::<Sine>().is_err(), "{wrong}");
        }
    }
}
