//! [`Model`]: the plant with its working point, effects and noise. All commands share it: identify writes it, the emulator runs it,
//! design reads it, reconcile extends it, and track carries it.

use crate::effects::{Action, Effect, Place};
use crate::error::{ModelError, ModelProblem};
use crate::transfer::TransferFunction;
use cellpos_numeric::units::Hertz;
use nalgebra::Complex;
use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::path::Path;

/// Noise that is always present. It is a discrepancy only if its size is wrong.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Noise {
    /// Diffusion coefficient D of the bead, um^2/s: increments over dt have the variance 2 D dt.
    pub diffusion_um2_per_s: f64,
    /// Standard deviation of the localisation noise, um RMS, white.
    pub localisation_um: f64,
}

impl Noise {
    /// Neither Brownian motion nor localisation noise.
    pub const NONE: Self = Self {
        diffusion_um2_per_s: 0.0,
        localisation_um: 0.0,
    };
}

/// Covariance of fitted parameters, as identify and reconcile write it.
#[derive(Debug, Clone, PartialEq)]
pub struct Covariance {
    /// Names of the parameters, for example `plant.num[0]`, `time-delay.delay_s`, or [`Model::CAMERA_DELAY`].
    pub parameters: Vec<String>,
    /// Row by row, in the units of the parameters.
    pub matrix: Vec<Vec<f64>>,
}

/// A plant with its effects and noise, read from and written to model.toml.
#[derive(Debug, Clone, PartialEq)]
pub struct Model {
    /// A short name.
    pub name: String,
    /// The modelled object; may be empty.
    pub description: String,
    /// From PZT displacement (from the working point, um) to bead position (um).
    pub plant: TransferFunction,
    /// The displacement at which the bead is at rest, um.
    pub working_point_um: f64,
    /// Effects, in any order: they act in the order of [`Effect::order`].
    pub effects: Vec<Effect>,
    /// Brownian motion and localisation noise.
    pub noise: Noise,
    /// Delay measured with the plant, s: from a command to the middle of the exposure that shows it, and on to the tick that uses it. It
    /// belongs to the rig and is not in [`Self::plant`]. A loop's delay is this plus half a period of hold.
    pub camera_delay_s: Option<f64>,
    /// Age of the frames when that delay was measured, s. The rest of the delay is the path of a command to the bead: line, board and
    /// amplifier.
    pub frame_age_s: Option<f64>,
    /// Covariance of the fitted parameters, if they were fitted.
    pub covariance: Option<Covariance>,
    /// 95 % confidence intervals \[low, high\] by parameter name.
    pub intervals: BTreeMap<String, [f64; 2]>,
    /// Where the model comes from: free keys and texts (command, data files and their hashes, versions).
    pub provenance: BTreeMap<String, String>,
}

/// Keys of the provenance of a model whose lengths are in the units of its records: the sampling of the input, and reconcile's mark for a
/// base fitted to the records.
const UNITS_OF_RECORDS: [&str; 2] = ["hold", Model::UNITS];

/// [`Model::is_in_any_unit`] of a provenance.
pub(crate) fn is_in_any_unit(provenance: &BTreeMap<String, String>) -> bool {
    let has = |key: &&str| provenance.contains_key(*key);
    UNITS_OF_RECORDS.iter().any(has)
}

impl Model {
    /// Name of [`Self::camera_delay_s`] in a covariance.
    pub const CAMERA_DELAY: &str = "camera.delay_s";
    /// Key of the provenance with the units of a model's records, if they are not micrometres.
    pub const UNITS: &str = "units";

    /// Whether lengths are in the units of the model's records; bounds in micrometres then do not apply.
    pub fn is_in_any_unit(&self) -> bool {
        is_in_any_unit(&self.provenance)
    }

    /// Eq. (6) about a working point of 4 um, without effects, with the Brownian motion of a 1 um bead in mid-slit
    /// (D = 0.33 um^2/s) and 30 nm of localisation noise.
    pub fn eq6() -> Self {
        Self {
            name: "eq6".to_owned(),
            description: "Eq. (6) of Mizoue et al. 2017, the nominal plant".to_owned(),
            plant: TransferFunction::eq6(),
            working_point_um: 4.0,
            effects: Vec::new(),
            noise: Noise {
                diffusion_um2_per_s: 0.33,
                localisation_um: 0.03,
            },
            camera_delay_s: None,
            frame_age_s: None,
            covariance: None,
            intervals: BTreeMap::new(),
            provenance: BTreeMap::new(),
        }
    }

    /// The model of a name or a path: `eq6` is built in, anything else is a file.
    ///
    /// # Errors
    /// A file that cannot be read, and all that [`Self::from_toml_str`] refuses.
    pub fn load(name_or_path: &str) -> Result<Self, ModelError> {
        if name_or_path == "eq6" {
            Ok(Self::eq6())
        } else {
            Self::load_file(Path::new(name_or_path))
        }
    }

    /// Reads a model file.
    ///
    /// # Errors
    /// A file that cannot be read, and all that [`Self::from_toml_str`] refuses.
    pub fn load_file(path: &Path) -> Result<Self, ModelError> {
        let file = path.display().to_string();
        /// Far beyond any model.
        const MOST_BYTES: u64 = 1 << 24;
        let text = cellpos_table::read_text(path, MOST_BYTES).map_err(|error| ModelError {
            file: file.clone(),
            at: None,
            problem: Box::new(ModelProblem::Unreadable {
                reason: if error.kind() == std::io::ErrorKind::NotFound {
                    "there is no such file (a model is a TOML file; `eq6` is built in)".to_owned()
                } else {
                    error.to_string()
                },
            }),
        })?;
        Self::from_toml_str(&text, &file)
    }

    /// The frequency response of all that is linear: plant, linear effects, delay and exposure, from command to record.
    ///
    /// It omits nonlinear effects, clock skew and additive ones (drift, hum). A drifting gain and a dissolving bubble have their state at
    /// the start.
    pub fn linear_response(&self, frequency: Hertz) -> Complex<f64> {
        let w = TAU * frequency.value();
        let s = Complex::new(0.0, w);
        let one = Complex::new(1.0, 0.0);
        let (mut value, mut before, mut camera) = (self.plant.at(s), one, one);
        let mut beside = Vec::new();
        let mut tied = Vec::new();
        for effect in self.ordered_effects() {
            match effect.act() {
                Action::Linear(zpk) => {
                    let factor = zpk.at(s);
                    value *= factor;
                    if effect.place() < Place::Chip {
                        before *= factor;
                    }
                }
                Action::Delay(delay_s) => camera *= Complex::from_polar(1.0, -w * delay_s),
                Action::Exposure(exposure_s) => {
                    let half = 0.5 * w * exposure_s;
                    let sinc = if half.abs() < 1e-9 {
                        1.0
                    } else {
                        half.sin() / half
                    };
                    camera *= Complex::from_polar(sinc, -half);
                }
                Action::Bypass(zpk) => beside.push(zpk.at(s)),
                // A block that is linear at its start counts with that state: see above.
                Action::Block(_) => {
                    value *= match effect.kind().small_motion(effect, s) {
                        Some([input, position, velocity]) => input + position + velocity * s,
                        None => effect.kind().at_start(effect).map_or(one, |zpk| zpk.at(s)),
                    };
                }
                Action::Around(tie) => tied.push((tie.replaces_output(), effect)),
                Action::Show(shown) if shown.is_static() => {
                    if let Some([input, position, _]) = effect.kind().small_motion(effect, s) {
                        camera *= input + position;
                    }
                }
                _ => {}
            }
        }
        if tied.is_empty() {
            return (value + before * beside.into_iter().sum::<Complex<f64>>()) * camera;
        }
        let plant = self.plant.at(s);
        let (mut drive, mut fed_back) = (one, Complex::new(0.0, 0.0));
        for (_, effect) in tied.iter().filter(|(replaces, _)| !replaces) {
            if let Some([input, position, velocity]) = effect.kind().small_motion(effect, s) {
                drive *= input;
                fed_back = fed_back * input + position + velocity * s;
            }
        }
        // y = P (drive u + fed_back y), and the replacement of y sees the plant's input.
        let mut answer = plant * drive / (one - plant * fed_back);
        let entered = answer / plant;
        for (_, effect) in tied.iter().filter(|(replaces, _)| *replaces) {
            if let Some([input, position, velocity]) = effect.kind().small_motion(effect, s) {
                answer = input * entered + (position + velocity * s) * answer;
            }
        }
        value *= answer / plant;
        (value + before * beside.into_iter().sum::<Complex<f64>>()) * camera
    }

    /// The first effect with this id.
    pub fn effect(&self, id: &str) -> Option<&Effect> {
        self.effects.iter().find(|e| e.id() == id)
    }

    /// The same model with an effect added.
    pub fn with_effect(mut self, effect: Effect) -> Self {
        self.effects.push(effect);
        self
    }

    /// The effects in the order in which they act.
    pub fn ordered_effects(&self) -> Vec<&Effect> {
        let mut effects: Vec<&Effect> = self.effects.iter().collect();
        effects.sort_by_key(|e| e.order());
        effects
    }
}
