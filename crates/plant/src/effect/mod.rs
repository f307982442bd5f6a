//! What a real rig does that Eq. (6) does not: the effect blocks of a [`crate::Model`].
//!
//! Every effect has an id, a place in the chain, an equation and named parameters with units and physical bounds.
//! The catalogue is closed: it is the vocabulary of the reconcile workflow. The blocks act in the order of
//! [`Effect::order`] whatever the order in a file, so that a model means the same however it is written.
//!
//! Chain: command -> driver -> pzt -> chip (with the plant) -> bead -> camera -> record.

mod parameter;

pub use parameter::{EffectError, Parameter, ParameterSpec};
pub(crate) use parameter::{play_lists, specs};

use serde::{Deserialize, Serialize};
use std::fmt;

/// Where in the chain an effect acts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Place {
    /// The amplifier, between command and piezo.
    Driver,
    /// The piezo and its coupling to the syringe.
    Pzt,
    /// Syringe, tube and channel: in the loop of Eq. (1)-(3).
    Chip,
    /// The bead in the flow.
    Bead,
    /// Camera, light, table and clock.
    Camera,
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Driver => "driver",
            Self::Pzt => "pzt",
            Self::Chip => "chip",
            Self::Bead => "bead",
            Self::Camera => "camera",
        })
    }
}

/// Forms of the piezo's hysteresis. All act on the displacement from the working point and are independent of rate.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "form", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Hysteresis {
    /// Bouc-Wen: `x = u - fraction h`, `dh/dt = du/dt - beta |du/dt| h - gamma du/dt |h|`.
    ///
    /// Bouc 1967, Wen 1976 (J. Eng. Mech. Div. ASCE 102:249) with exponent 1 and A = 1, in the form used for piezos
    /// (Low, Guo 1995, IEEE Trans. Control Syst. Technol. 3:119). At small amplitude h = u and the gain is
    /// `1 - fraction`; at large amplitude h saturates at `1/(beta + gamma)` and the gain approaches 1. The equation is
    /// integrated in closed form along the straight way of each change of u.
    BoucWen {
        /// Part of the stroke lost at small amplitude, 0..1.
        fraction: f64,
        /// Width of the loop, 1/um.
        beta_per_um: f64,
        /// Shape of the loop, 1/um; `|gamma| <= beta` keeps the loop dissipative.
        gamma_per_um: f64,
    },
    /// The same equation as it is often programmed for sampled commands: one explicit step per change of the command,
    /// `h += du - beta |du| h - gamma du |h|`. It differs from [`Hysteresis::BoucWen`] where a single change `du` is
    /// not small against `1/(beta + gamma)`.
    BoucWenExplicit {
        /// Part of the stroke lost at small amplitude, 0..1.
        fraction: f64,
        /// Width of the loop, 1/um.
        beta_per_um: f64,
        /// Shape of the loop, 1/um.
        gamma_per_um: f64,
    },
    /// Play operators (Prandtl-Ishlinskii): `x = v + quadratic_per_um v^2`,
    /// `v = sum w_i p_i`, `p_i = max(u - r_i, min(u + r_i, p_i))`.
    ///
    /// Kuhnen 2003, Eur. J. Control 9:407. The quadratic output term is the asymmetry of a piezo driven by voltage.
    Play {
        /// Thresholds `r_i`, um, rising, not negative; the first is usually 0.
        thresholds_um: Vec<f64>,
        /// Weights `w_i`, one per threshold.
        weights: Vec<f64>,
        /// Asymmetry, 1/um.
        #[serde(default)]
        quadratic_per_um: f64,
    },
}

/// One effect with its parameters.
///
/// Serialised with `id` beside the parameters: `{ id = "time-delay", delay_s = 0.002 }`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "id", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Effect {
    /// Driver. First-order low-pass of the amplifier: `x' = w (u - x)`, `w = 2 pi bandwidth`.
    DriverLag {
        /// -3 dB frequency, Hz.
        bandwidth_hz: f64,
    },
    /// Driver. Current limit of the amplifier into the piezo's capacity: `|dx/dt| <= rate`.
    SlewLimit {
        /// Largest speed of the displacement, um/s.
        rate_um_per_s: f64,
    },
    /// Driver. Clips the commanded displacement to `[low, high]`.
    Saturation {
        /// Smallest displacement, um (absolute, not from the working point).
        low_um: f64,
        /// Largest displacement, um (absolute).
        high_um: f64,
    },
    /// PZT. Hysteresis in one of two forms, see [`Hysteresis`].
    PztHysteresis(Hysteresis),
    /// PZT. Creep: `x = x0 (1 + g log10(t / 0.1 s))` after a step.
    ///
    /// Realised as a bank of first-order lags, two per decade from 0.1 ms to 1000 s, each of weight g/2: linear,
    /// within 0.1 % of g of the logarithm from 1 ms to 300 s (Kuhnen, Janocha 1998, linear creep operators).
    PztCreep {
        /// Part of the step gained per decade of time, g.
        per_decade: f64,
    },
    /// PZT. Mechanical resonance: `w^2 / (s^2 + 2 zeta w s + w^2)`.
    PztResonance {
        /// Undamped natural frequency, Hz.
        frequency_hz: f64,
        /// Damping ratio zeta.
        damping: f64,
    },
    /// PZT. Play in the coupling to the syringe: `x = max(u - width/2, min(u + width/2, x))`.
    Backlash {
        /// Full width of the gap, um.
        width_um: f64,
    },
    /// Chip. The wall as a standard linear solid: its stiffness, and with it the numerator of Eq. (A4), gets the
    /// factor `(1 + (1 + strength) time s) / (1 + time s)`.
    ///
    /// In the denominator of Eq. (A4) the wall enters with the weight `alpha A2/A1`, about 2e-8: neglected.
    PdmsRelaxation {
        /// Relaxation time, s.
        time_s: f64,
        /// Gain far above the relaxation frequency is `1 + strength` times that below. Negative: a softening wall.
        strength: f64,
    },
    /// Chip. A gas bubble, compliance `C = V/(n P)` behind the flow resistance R: `1 / (1 + lag s)`, `lag = R C`.
    Bubble {
        /// `R C`, s.
        lag_s: f64,
        /// The bubble dissolves: `lag(t) = lag exp(-dissolution t)`, 1/s. Zero for a lasting bubble.
        #[serde(default)]
        dissolution_per_s: f64,
    },
    /// Chip. Leak past the piston: `s / (s + corner)`.
    Leak {
        /// Corner, rad/s.
        corner_rad_per_s: f64,
    },
    /// Bead or camera. The bead's displacement is `factor` times the plant's (bead height in the slit, pixel scale).
    GainError {
        /// Factor.
        factor: f64,
    },
    /// Bead. The velocity gain drifts: `K(t) = K0 (1 + per_s t)`.
    GainDrift {
        /// Relative change per second, 1/s.
        per_s: f64,
    },
    /// Bead. Sticks to the wall unless the flow past it is faster than a threshold.
    WallAdhesion {
        /// Threshold, um/s.
        speed_um_per_s: f64,
    },
    /// Bead. A constant flow added to the plant's.
    FlowDrift {
        /// Speed, um/s.
        um_per_s: f64,
    },
    /// Camera. `y(t - delay)`.
    TimeDelay {
        /// Delay, s.
        delay_s: f64,
    },
    /// Camera. The mean over the exposure that ends with the frame: gain `sinc(f Te)`, phase `-180 f Te` deg.
    ExposureAveraging {
        /// Exposure Te, s.
        exposure_s: f64,
    },
    /// Camera clock. Row k is taken at `t_k (1 + 1e-6 ppm)` of the drive's clock.
    ClockSkew {
        /// Skew, parts per million.
        ppm: f64,
    },
    /// Camera. Frames are missing at random.
    FrameDrops {
        /// Probability per frame.
        rate: f64,
    },
    /// Camera. A frame is delivered twice at random: the row repeats the position of the row before.
    FrameRepeats {
        /// Probability per frame.
        rate: f64,
    },
    /// Camera. `x + amplitude pixel sin(2 pi x / pixel + phase)`: the bias of a centroid within a pixel.
    PixelLocking {
        /// Pixel size in the object plane, um.
        pixel_um: f64,
        /// Amplitude in parts of a pixel.
        amplitude: f64,
        /// Phase at x = 0, deg.
        #[serde(default)]
        phase_deg: f64,
    },
    /// Camera, light or table. A line: `um sin(2 pi hz t + phase)`, not tied to the input.
    MainsHum {
        /// Frequency, Hz.
        hz: f64,
        /// Amplitude, um.
        um: f64,
        /// Phase at the record's start, deg.
        #[serde(default)]
        phase_deg: f64,
    },
}

/// The ids of all effects, in the order of the chain.
pub const EFFECT_IDS: [&str; 21] = [
    "saturation",
    "slew-limit",
    "driver-lag",
    "pzt-hysteresis",
    "pzt-creep",
    "pzt-resonance",
    "backlash",
    "pdms-relaxation",
    "bubble",
    "leak",
    "gain-error",
    "gain-drift",
    "flow-drift",
    "wall-adhesion",
    "clock-skew",
    "time-delay",
    "exposure-averaging",
    "mains-hum",
    "pixel-locking",
    "frame-drops",
    "frame-repeats",
];

impl Effect {
    /// The id used in model files and results, for example `"time-delay"`.
    pub fn id(&self) -> &'static str {
        match self {
            Self::DriverLag { .. } => "driver-lag",
            Self::SlewLimit { .. } => "slew-limit",
            Self::Saturation { .. } => "saturation",
            Self::PztHysteresis(_) => "pzt-hysteresis",
            Self::PztCreep { .. } => "pzt-creep",
            Self::PztResonance { .. } => "pzt-resonance",
            Self::Backlash { .. } => "backlash",
            Self::PdmsRelaxation { .. } => "pdms-relaxation",
            Self::Bubble { .. } => "bubble",
            Self::Leak { .. } => "leak",
            Self::GainError { .. } => "gain-error",
            Self::GainDrift { .. } => "gain-drift",
            Self::WallAdhesion { .. } => "wall-adhesion",
            Self::FlowDrift { .. } => "flow-drift",
            Self::TimeDelay { .. } => "time-delay",
            Self::ExposureAveraging { .. } => "exposure-averaging",
            Self::ClockSkew { .. } => "clock-skew",
            Self::FrameDrops { .. } => "frame-drops",
            Self::FrameRepeats { .. } => "frame-repeats",
            Self::PixelLocking { .. } => "pixel-locking",
            Self::MainsHum { .. } => "mains-hum",
        }
    }

    /// The place of the effect in the chain.
    pub fn place(&self) -> Place {
        match self {
            Self::DriverLag { .. } | Self::SlewLimit { .. } | Self::Saturation { .. } => {
                Place::Driver
            }
            Self::PztHysteresis(_)
            | Self::PztCreep { .. }
            | Self::PztResonance { .. }
            | Self::Backlash { .. } => Place::Pzt,
            Self::PdmsRelaxation { .. } | Self::Bubble { .. } | Self::Leak { .. } => Place::Chip,
            Self::GainError { .. }
            | Self::GainDrift { .. }
            | Self::WallAdhesion { .. }
            | Self::FlowDrift { .. } => Place::Bead,
            Self::TimeDelay { .. }
            | Self::ExposureAveraging { .. }
            | Self::ClockSkew { .. }
            | Self::FrameDrops { .. }
            | Self::FrameRepeats { .. }
            | Self::PixelLocking { .. }
            | Self::MainsHum { .. } => Place::Camera,
        }
    }

    /// The rank in which effects act, from the command to the record; the index in [`EFFECT_IDS`].
    pub fn order(&self) -> usize {
        let id = self.id();
        EFFECT_IDS
            .iter()
            .position(|known| *known == id)
            .unwrap_or(EFFECT_IDS.len())
    }

    /// Whether twice the input gives twice the output (additive terms apart), whatever the amplitude.
    pub fn is_linear(&self) -> bool {
        !matches!(
            self,
            Self::SlewLimit { .. }
                | Self::Saturation { .. }
                | Self::PztHysteresis(_)
                | Self::Backlash { .. }
                | Self::WallAdhesion { .. }
                | Self::FrameDrops { .. }
                | Self::FrameRepeats { .. }
                | Self::PixelLocking { .. }
        )
    }

    /// Whether the output depends on absolute time (drifting gain, dissolving bubble, clock skew, hum, drift).
    pub fn is_time_varying(&self) -> bool {
        match self {
            Self::Bubble {
                dissolution_per_s, ..
            } => *dissolution_per_s != 0.0,
            Self::GainDrift { .. }
            | Self::ClockSkew { .. }
            | Self::MainsHum { .. }
            | Self::FlowDrift { .. } => true,
            _ => false,
        }
    }
}
