//! Names, units, bounds and values of the parameters of effects.

use super::{Effect, Hysteresis};

/// A parameter that an effect does not have, or a value that it cannot take.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum EffectError {
    /// No parameter of that name.
    #[error("{id} has no parameter `{name}`: it has {}", known.join(", "))]
    UnknownParameter {
        /// The effect.
        id: &'static str,
        /// The name asked for.
        name: String,
        /// The names it has.
        known: Vec<String>,
    },
    /// Not finite or outside the physical bounds.
    #[error(
        "{id}: `{name}` = {value} {unit}: it must be a finite number in {lower}..{upper} {unit}"
    )]
    OutOfRange {
        /// The effect.
        id: &'static str,
        /// The parameter.
        name: String,
        /// Its value.
        value: f64,
        /// Its unit.
        unit: &'static str,
        /// Lower bound.
        lower: f64,
        /// Upper bound.
        upper: f64,
    },
    /// Values that are each right and together wrong.
    #[error("{id}: {message}")]
    Inconsistent {
        /// The effect.
        id: &'static str,
        /// What is wrong, and what would be right.
        message: &'static str,
    },
}

/// What is fixed about a parameter: name, unit, bounds and how to fit it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ParameterSpec {
    /// The key in files and results.
    pub name: &'static str,
    /// Its unit; empty for a pure number.
    pub unit: &'static str,
    /// Smallest physical value.
    pub lower: f64,
    /// Largest physical value.
    pub upper: f64,
    /// Positive and spread over decades: fit its logarithm.
    pub log_scaled: bool,
    /// Known rather than fitted (the mains frequency, the pixel size).
    pub fixed: bool,
    /// Value when the key is left out; `None` when it must be given.
    pub default: Option<f64>,
}

/// A parameter with its value.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameter {
    /// The key; elements of lists are named `weights[0]`.
    pub name: String,
    /// Its value.
    pub value: f64,
    /// Its unit; empty for a pure number.
    pub unit: &'static str,
    /// Smallest physical value.
    pub lower: f64,
    /// Largest physical value.
    pub upper: f64,
    /// Positive and spread over decades: fit its logarithm.
    pub log_scaled: bool,
    /// Known rather than fitted.
    pub fixed: bool,
}

const fn number(name: &'static str, unit: &'static str, lower: f64, upper: f64) -> ParameterSpec {
    ParameterSpec {
        name,
        unit,
        lower,
        upper,
        log_scaled: false,
        fixed: false,
        default: None,
    }
}

const fn positive(name: &'static str, unit: &'static str, lower: f64, upper: f64) -> ParameterSpec {
    ParameterSpec {
        log_scaled: true,
        ..number(name, unit, lower, upper)
    }
}

const fn or(spec: ParameterSpec, default: f64) -> ParameterSpec {
    ParameterSpec {
        default: Some(default),
        ..spec
    }
}

const fn known(spec: ParameterSpec) -> ParameterSpec {
    ParameterSpec {
        fixed: true,
        ..spec
    }
}

const DRIVER_LAG: &[ParameterSpec] = &[positive("bandwidth_hz", "Hz", 0.1, 1e5)];
const SLEW_LIMIT: &[ParameterSpec] = &[positive("rate_um_per_s", "um/s", 1e-2, 1e8)];
const SATURATION: &[ParameterSpec] = &[
    number("low_um", "um", -1e4, 1e4),
    number("high_um", "um", -1e4, 1e4),
];
const BOUC_WEN: &[ParameterSpec] = &[
    number("fraction", "", 0.0, 1.0),
    positive("beta_per_um", "1/um", 1e-6, 1e3),
    number("gamma_per_um", "1/um", -1e3, 1e3),
];
const PLAY: &[ParameterSpec] = &[or(number("quadratic_per_um", "1/um", -1.0, 1.0), 0.0)];
const THRESHOLD: ParameterSpec = number("thresholds_um", "um", 0.0, 1e4);
const WEIGHT: ParameterSpec = number("weights", "", -1e3, 1e3);
const PZT_CREEP: &[ParameterSpec] = &[number("per_decade", "", -0.2, 0.2)];
const PZT_RESONANCE: &[ParameterSpec] = &[
    positive("frequency_hz", "Hz", 1.0, 1e6),
    positive("damping", "", 1e-4, 5.0),
];
const BACKLASH: &[ParameterSpec] = &[positive("width_um", "um", 0.0, 100.0)];
const PDMS_RELAXATION: &[ParameterSpec] = &[
    positive("time_s", "s", 1e-5, 1e4),
    number("strength", "", -0.95, 20.0),
];
const BUBBLE: &[ParameterSpec] = &[
    positive("lag_s", "s", 1e-6, 100.0),
    or(number("dissolution_per_s", "1/s", -10.0, 10.0), 0.0),
];
const LEAK: &[ParameterSpec] = &[positive("corner_rad_per_s", "rad/s", 1e-6, 1e4)];
const GAIN_ERROR: &[ParameterSpec] = &[number("factor", "", -100.0, 100.0)];
const GAIN_DRIFT: &[ParameterSpec] = &[number("per_s", "1/s", -1.0, 1.0)];
const WALL_ADHESION: &[ParameterSpec] = &[positive("speed_um_per_s", "um/s", 0.0, 1e6)];
const FLOW_DRIFT: &[ParameterSpec] = &[number("um_per_s", "um/s", -1e4, 1e4)];
const TIME_DELAY: &[ParameterSpec] = &[number("delay_s", "s", 0.0, 1.0)];
const EXPOSURE: &[ParameterSpec] = &[number("exposure_s", "s", 0.0, 1.0)];
const CLOCK_SKEW: &[ParameterSpec] = &[number("ppm", "ppm", -1e5, 1e5)];
const RATE: &[ParameterSpec] = &[number("rate", "", 0.0, 0.9)];
const PIXEL_LOCKING: &[ParameterSpec] = &[
    known(positive("pixel_um", "um", 1e-3, 100.0)),
    number("amplitude", "px", -0.5, 0.5),
    or(number("phase_deg", "deg", -360.0, 360.0), 0.0),
];
const MAINS_HUM: &[ParameterSpec] = &[
    known(positive("hz", "Hz", 0.1, 1e4)),
    number("um", "um", -100.0, 100.0),
    or(number("phase_deg", "deg", -360.0, 360.0), 0.0),
];

/// The scalar parameters of an effect by id and, for pzt-hysteresis, form.
pub(crate) fn specs(id: &str, form: Option<&str>) -> Option<&'static [ParameterSpec]> {
    Some(match id {
        "driver-lag" => DRIVER_LAG,
        "slew-limit" => SLEW_LIMIT,
        "saturation" => SATURATION,
        "pzt-hysteresis" => match form {
            Some("play") => PLAY,
            _ => BOUC_WEN,
        },
        "pzt-creep" => PZT_CREEP,
        "pzt-resonance" => PZT_RESONANCE,
        "backlash" => BACKLASH,
        "pdms-relaxation" => PDMS_RELAXATION,
        "bubble" => BUBBLE,
        "leak" => LEAK,
        "gain-error" => GAIN_ERROR,
        "gain-drift" => GAIN_DRIFT,
        "wall-adhesion" => WALL_ADHESION,
        "flow-drift" => FLOW_DRIFT,
        "time-delay" => TIME_DELAY,
        "exposure-averaging" => EXPOSURE,
        "clock-skew" => CLOCK_SKEW,
        "frame-drops" | "frame-repeats" => RATE,
        "pixel-locking" => PIXEL_LOCKING,
        "mains-hum" => MAINS_HUM,
        _ => return None,
    })
}

/// The list-valued parameters of the play form.
pub(crate) const fn play_lists() -> &'static [ParameterSpec] {
    &[THRESHOLD, WEIGHT]
}

impl Effect {
    /// The values of the scalar parameters, in the order of their specifications.
    fn scalars(&self) -> Vec<f64> {
        match *self {
            Self::DriverLag { bandwidth_hz } => vec![bandwidth_hz],
            Self::SlewLimit { rate_um_per_s } => vec![rate_um_per_s],
            Self::Saturation { low_um, high_um } => vec![low_um, high_um],
            Self::PztHysteresis(Hysteresis::BoucWen {
                fraction,
                beta_per_um,
                gamma_per_um,
            })
            | Self::PztHysteresis(Hysteresis::BoucWenExplicit {
                fraction,
                beta_per_um,
                gamma_per_um,
            }) => vec![fraction, beta_per_um, gamma_per_um],
            Self::PztHysteresis(Hysteresis::Play {
                quadratic_per_um, ..
            }) => vec![quadratic_per_um],
            Self::PztCreep { per_decade } => vec![per_decade],
            Self::PztResonance {
                frequency_hz,
                damping,
            } => vec![frequency_hz, damping],
            Self::Backlash { width_um } => vec![width_um],
            Self::PdmsRelaxation { time_s, strength } => vec![time_s, strength],
            Self::Bubble {
                lag_s,
                dissolution_per_s,
            } => vec![lag_s, dissolution_per_s],
            Self::Leak { corner_rad_per_s } => vec![corner_rad_per_s],
            Self::GainError { factor } => vec![factor],
            Self::GainDrift { per_s } => vec![per_s],
            Self::WallAdhesion { speed_um_per_s } => vec![speed_um_per_s],
            Self::FlowDrift { um_per_s } => vec![um_per_s],
            Self::TimeDelay { delay_s } => vec![delay_s],
            Self::ExposureAveraging { exposure_s } => vec![exposure_s],
            Self::ClockSkew { ppm } => vec![ppm],
            Self::FrameDrops { rate } | Self::FrameRepeats { rate } => vec![rate],
            Self::PixelLocking {
                pixel_um,
                amplitude,
                phase_deg,
            } => vec![pixel_um, amplitude, phase_deg],
            Self::MainsHum { hz, um, phase_deg } => vec![hz, um, phase_deg],
        }
    }

    /// An effect from its id and scalar parameters in the order of their specifications (lists of the play form are
    /// put in by the caller). `None` for an unknown id or too few values.
    pub(crate) fn from_scalars(id: &str, form: Option<&str>, v: &[f64]) -> Option<Self> {
        let at = |i: usize| v.get(i).copied();
        Some(match id {
            "driver-lag" => Self::DriverLag {
                bandwidth_hz: at(0)?,
            },
            "slew-limit" => Self::SlewLimit {
                rate_um_per_s: at(0)?,
            },
            "saturation" => Self::Saturation {
                low_um: at(0)?,
                high_um: at(1)?,
            },
            "pzt-hysteresis" if form == Some("play") => Self::PztHysteresis(Hysteresis::Play {
                thresholds_um: Vec::new(),
                weights: Vec::new(),
                quadratic_per_um: at(0)?,
            }),
            "pzt-hysteresis" if form == Some("bouc-wen-explicit") => {
                Self::PztHysteresis(Hysteresis::BoucWenExplicit {
                    fraction: at(0)?,
                    beta_per_um: at(1)?,
                    gamma_per_um: at(2)?,
                })
            }
            "pzt-hysteresis" => Self::PztHysteresis(Hysteresis::BoucWen {
                fraction: at(0)?,
                beta_per_um: at(1)?,
                gamma_per_um: at(2)?,
            }),
            "pzt-creep" => Self::PztCreep { per_decade: at(0)? },
            "pzt-resonance" => Self::PztResonance {
                frequency_hz: at(0)?,
                damping: at(1)?,
            },
            "backlash" => Self::Backlash { width_um: at(0)? },
            "pdms-relaxation" => Self::PdmsRelaxation {
                time_s: at(0)?,
                strength: at(1)?,
            },
            "bubble" => Self::Bubble {
                lag_s: at(0)?,
                dissolution_per_s: at(1)?,
            },
            "leak" => Self::Leak {
                corner_rad_per_s: at(0)?,
            },
            "gain-error" => Self::GainError { factor: at(0)? },
            "gain-drift" => Self::GainDrift { per_s: at(0)? },
            "wall-adhesion" => Self::WallAdhesion {
                speed_um_per_s: at(0)?,
            },
            "flow-drift" => Self::FlowDrift { um_per_s: at(0)? },
            "time-delay" => Self::TimeDelay { delay_s: at(0)? },
            "exposure-averaging" => Self::ExposureAveraging { exposure_s: at(0)? },
            "clock-skew" => Self::ClockSkew { ppm: at(0)? },
            "frame-drops" => Self::FrameDrops { rate: at(0)? },
            "frame-repeats" => Self::FrameRepeats { rate: at(0)? },
            "pixel-locking" => Self::PixelLocking {
                pixel_um: at(0)?,
                amplitude: at(1)?,
                phase_deg: at(2)?,
            },
            "mains-hum" => Self::MainsHum {
                hz: at(0)?,
                um: at(1)?,
                phase_deg: at(2)?,
            },
            _ => return None,
        })
    }

    /// The form of an effect that has several: `"bouc-wen"`, `"bouc-wen-explicit"` or `"play"`.
    pub fn form(&self) -> Option<&'static str> {
        match self {
            Self::PztHysteresis(Hysteresis::BoucWen { .. }) => Some("bouc-wen"),
            Self::PztHysteresis(Hysteresis::BoucWenExplicit { .. }) => Some("bouc-wen-explicit"),
            Self::PztHysteresis(Hysteresis::Play { .. }) => Some("play"),
            _ => None,
        }
    }

    /// Names, units, values and physical bounds of all parameters.
    pub fn parameters(&self) -> Vec<Parameter> {
        let specs = specs(self.id(), self.form()).unwrap_or(&[]);
        let of = |spec: &ParameterSpec, name: String, value: f64| Parameter {
            name,
            value,
            unit: spec.unit,
            lower: spec.lower,
            upper: spec.upper,
            log_scaled: spec.log_scaled,
            fixed: spec.fixed,
        };
        let mut all: Vec<Parameter> = specs
            .iter()
            .zip(self.scalars())
            .map(|(spec, value)| of(spec, spec.name.to_owned(), value))
            .collect();
        if let Self::PztHysteresis(Hysteresis::Play {
            thresholds_um,
            weights,
            ..
        }) = self
        {
            for (i, &r) in thresholds_um.iter().enumerate() {
                let mut p = of(&THRESHOLD, format!("thresholds_um[{i}]"), r);
                p.fixed = true;
                all.push(p);
            }
            for (i, &w) in weights.iter().enumerate() {
                all.push(of(&WEIGHT, format!("weights[{i}]"), w));
            }
        }
        all
    }

    /// The same effect with one parameter changed; elements of lists are named `weights[0]`.
    ///
    /// # Errors
    /// An unknown name, and a value that is not finite or outside its bounds.
    pub fn with_parameter(&self, name: &str, value: f64) -> Result<Self, EffectError> {
        let mut scalars = self.scalars();
        let index = specs(self.id(), self.form())
            .unwrap_or(&[])
            .iter()
            .position(|s| s.name == name);
        let changed = if let Some(i) = index {
            scalars[i] = value;
            let mut changed = Self::from_scalars(self.id(), self.form(), &scalars)
                .unwrap_or_else(|| self.clone());
            if let (
                Self::PztHysteresis(Hysteresis::Play {
                    thresholds_um,
                    weights,
                    ..
                }),
                Self::PztHysteresis(Hysteresis::Play {
                    thresholds_um: r,
                    weights: w,
                    ..
                }),
            ) = (&mut changed, self)
            {
                thresholds_um.clone_from(r);
                weights.clone_from(w);
            }
            changed
        } else {
            let mut changed = self.clone();
            let slot = match &mut changed {
                Self::PztHysteresis(Hysteresis::Play {
                    thresholds_um,
                    weights,
                    ..
                }) => element(name, "thresholds_um", thresholds_um)
                    .or_else(|| element(name, "weights", weights)),
                _ => None,
            };
            match slot {
                Some(slot) => *slot = value,
                None => {
                    return Err(EffectError::UnknownParameter {
                        id: self.id(),
                        name: name.to_owned(),
                        known: self.parameters().into_iter().map(|p| p.name).collect(),
                    });
                }
            }
            changed
        };
        changed.validate()?;
        Ok(changed)
    }

    /// Checks that every parameter is finite and within its bounds, and that they fit together.
    ///
    /// # Errors
    /// The first parameter that is not, with its name, value, unit and range.
    pub fn validate(&self) -> Result<(), EffectError> {
        let id = self.id();
        for p in self.parameters() {
            if !(p.value.is_finite() && p.value >= p.lower && p.value <= p.upper) {
                return Err(EffectError::OutOfRange {
                    id,
                    name: p.name,
                    value: p.value,
                    unit: p.unit,
                    lower: p.lower,
                    upper: p.upper,
                });
            }
        }
        let inconsistent = |message| Err(EffectError::Inconsistent { id, message });
        match self {
            Self::Saturation { low_um, high_um } if low_um >= high_um => {
                inconsistent("low_um must be below high_um")
            }
            Self::GainError { factor } if *factor == 0.0 => {
                inconsistent("factor must not be zero: the bead would never move")
            }
            Self::PztHysteresis(
                Hysteresis::BoucWen {
                    beta_per_um,
                    gamma_per_um,
                    ..
                }
                | Hysteresis::BoucWenExplicit {
                    beta_per_um,
                    gamma_per_um,
                    ..
                },
            ) if gamma_per_um.abs() > *beta_per_um => inconsistent(
                "gamma_per_um must lie within -beta_per_um..beta_per_um, else the loop would feed energy back",
            ),
            Self::PztHysteresis(Hysteresis::Play {
                thresholds_um,
                weights,
                ..
            }) => {
                if thresholds_um.is_empty() || thresholds_um.len() != weights.len() {
                    return inconsistent(
                        "thresholds_um and weights must have the same number of elements, at least one",
                    );
                }
                if thresholds_um.len() > 64 {
                    return inconsistent("at most 64 play operators are supported");
                }
                if thresholds_um.windows(2).any(|w| w[0] >= w[1]) {
                    return inconsistent("thresholds_um must rise strictly");
                }
                Ok(())
            }
            _ => Ok(()),
        }
    }
}

/// The element `list[i]` that a name like `weights[3]` means.
fn element<'a>(name: &str, list: &str, values: &'a mut [f64]) -> Option<&'a mut f64> {
    let index = name
        .strip_prefix(list)?
        .strip_prefix('[')?
        .strip_suffix(']')?;
    values.get_mut(index.parse::<usize>().ok()?)
}
