//! The candidates: every effect of the vocabulary with its parameters, where to start looking, and what tells it apart.

use crate::fit::Part;
use crate::predict::{Block, PLAY_LEVELS, domains};
use cellpos_plant::{Effect, Hysteresis};
use std::f64::consts::TAU;

/// A parameter of a candidate as the fit sees it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Param {
    /// Name in model files and results.
    pub name: &'static str,
    /// Fitted as a logarithm.
    pub log: bool,
    pub lower: f64,
    pub upper: f64,
    /// Step of the numeric derivative in the fit's coordinate.
    pub step: f64,
}

const fn log(name: &'static str, lower: f64, upper: f64) -> Param {
    Param {
        name,
        log: true,
        lower,
        upper,
        step: 1e-3,
    }
}

const fn lin(name: &'static str, lower: f64, upper: f64, step: f64) -> Param {
    Param {
        name,
        log: false,
        lower,
        upper,
        step,
    }
}

impl Param {
    /// Natural value from the fit's coordinate, kept inside the bounds.
    pub fn natural(&self, x: f64) -> f64 {
        let v = if self.log { x.exp() } else { x };
        v.clamp(self.lower, self.upper)
    }

    /// Fit coordinate of a natural value.
    pub fn coordinate(&self, v: f64) -> f64 {
        let v = v.clamp(self.lower, self.upper);
        if self.log { v.ln() } else { v }
    }
}

/// What the records allow: ranges from which starting values are taken.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Scope {
    pub working_point_um: f64,
    pub low_um: f64,
    pub high_um: f64,
    /// Largest excursion from the working point \[um\].
    pub stroke_um: f64,
    pub sample_s: f64,
}

/// One way of building an effect: most have one, hysteresis and saturation several.
pub(crate) struct Variant {
    pub id: &'static str,
    pub params: &'static [Param],
    pub build: fn(&[f64], &Scope) -> Block,
    pub starts: fn(&Scope) -> Vec<Vec<f64>>,
    /// Range of the main (first) parameter that a real rig shows; outside it another name is likelier when fits tie.
    pub typical: (f64, f64),
    /// Its signature cannot come from the response to the command: no misfit of a response can look like it.
    pub off_response: bool,
    pub kind: Kind,
}

impl Variant {
    /// Whether its parameters include a gain of the whole chain.
    pub fn holds_gain(&self) -> bool {
        self.params
            .iter()
            .any(|p| p.name == "weights" || p.name == "factor")
    }
}

/// How a variant enters the fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    /// A block of the chain.
    Chain,
    /// A line with amplitude and phase per record.
    Line,
    /// Periodic in position, sine and cosine common to all records.
    Position,
}

fn one<const N: usize>(values: [f64; N]) -> Vec<Vec<f64>> {
    values.iter().map(|v| vec![*v]).collect()
}

fn grid(a: &[f64], b: &[f64]) -> Vec<Vec<f64>> {
    a.iter()
        .flat_map(|x| b.iter().map(move |y| vec![*x, *y]))
        .collect()
}

fn play_block(v: &[f64], s: &Scope) -> Block {
    let mut weights = [0.0; PLAY_LEVELS.len()];
    weights.copy_from_slice(&v[..PLAY_LEVELS.len()]);
    Block::Play {
        stroke_um: s.stroke_um,
        weights,
        quadratic: v[PLAY_LEVELS.len()],
    }
}

/// The static curvature that play operators hold beside their memory: no effect of the vocabulary.
pub(crate) const CURVATURE: &str = "curvature";

const ANY: (f64, f64) = (f64::NEG_INFINITY, f64::INFINITY);

const WEIGHT: Param = lin("weights", -3.0, 5.0, 1e-3);

/// All candidates, in the order in which equal fits are named.
pub(crate) static VARIANTS: &[Variant] = &[
    Variant {
        id: "gain-error",
        params: &[lin("factor", 0.05, 20.0, 1e-3)],
        build: |v, _| Block::Gain { factor: v[0] },
        starts: |_| one([0.9, 1.1]),
        typical: (0.4, 2.5),
        off_response: false,
        kind: Kind::Chain,
    },
    Variant {
        id: "time-delay",
        params: &[lin("delay_s", 0.0, 0.1, 1e-5)],
        build: |v, _| Block::Delay { s: v[0] },
        starts: |s| one([0.1, 0.3, 1.0, 2.0, 4.0, 8.0].map(|k| k * s.sample_s)),
        typical: (0.0002, 0.05),
        off_response: false,
        kind: Kind::Chain,
    },
    Variant {
        id: "driver-lag",
        params: &[log("bandwidth_hz", 0.5, 2e5)],
        build: |v, _| Block::DriverLag { w: TAU * v[0] },
        starts: |_| one([15.0, 50.0, 120.0, 300.0, 800.0, 2000.0]),
        typical: (50.0, 5000.0),
        off_response: false,
        kind: Kind::Chain,
    },
    Variant {
        id: "bubble",
        params: &[log("lag_s", 1e-6, 1.0)],
        build: |v, _| Block::Bubble {
            lag_s: v[0],
            dissolution: 0.0,
        },
        starts: |_| one([1e-4, 5e-4, 2e-3, 6e-3, 0.02, 0.06]),
        typical: (0.0032, 0.15),
        off_response: false,
        kind: Kind::Chain,
    },
    Variant {
        id: "bubble",
        params: &[
            log("lag_s", 1e-6, 1.0),
            lin("dissolution_per_s", -1.0, 1.0, 1e-4),
        ],
        build: |v, _| Block::Bubble {
            lag_s: v[0],
            dissolution: v[1],
        },
        starts: |_| grid(&[1e-3, 8e-3, 0.05], &[0.03]),
        typical: ANY,
        off_response: false,
        kind: Kind::Chain,
    },
    Variant {
        id: "exposure-averaging",
        params: &[lin("exposure_s", 1e-6, 0.02, 1e-5)],
        build: |v, _| Block::Exposure { s: v[0] },
        starts: |s| one([0.2, 0.5, 0.9].map(|k| k * s.sample_s)),
        typical: (0.0, 0.0011),
        off_response: false,
        kind: Kind::Chain,
    },
    Variant {
        id: "pzt-resonance",
        params: &[log("frequency_hz", 20.0, 4e4), log("damping", 0.002, 0.9)],
        build: |v, _| Block::Resonance {
            w: TAU * v[0],
            zeta: v[1],
        },
        starts: |_| {
            grid(
                &[120.0, 200.0, 260.0, 330.0, 450.0, 700.0, 1200.0],
                &[0.03, 0.15, 0.6],
            )
        },
        typical: (150.0, 4e4),
        off_response: false,
        kind: Kind::Chain,
    },
    Variant {
        id: "pzt-hysteresis",
        params: &[
            lin("fraction", 0.0, 1.0, 1e-3),
            log("beta_per_um", 0.02, 50.0),
            lin("gamma_per_um", -20.0, 20.0, 1e-3),
        ],
        build: |v, _| Block::BoucWen {
            fraction: v[0],
            beta: v[1],
            gamma: v[2].clamp(-v[1], v[1]),
        },
        starts: |s| {
            [0.3, 1.0, 3.0, 8.0]
                .iter()
                .flat_map(|b| [0.1, 0.35].map(|f| vec![f, (b / s.stroke_um).min(40.0), 0.0]))
                .collect()
        },
        typical: (0.0, 0.6),
        off_response: false,
        kind: Kind::Chain,
    },
    Variant {
        id: "pzt-hysteresis",
        params: &[
            lin("fraction", 0.0, 1.0, 1e-3),
            log("width_um", 0.005, 100.0),
        ],
        build: |v, _| Block::Domains {
            fraction: v[0],
            width_um: v[1],
        },
        starts: |s| {
            grid(&[0.05, 0.3], &[0.03, 0.1, 0.3, 1.0])
                .into_iter()
                .map(|v| vec![v[0], v[1] * s.stroke_um])
                .collect()
        },
        typical: (0.0, 0.6),
        off_response: false,
        kind: Kind::Chain,
    },
    Variant {
        id: "pzt-hysteresis",
        params: &[
            WEIGHT,
            WEIGHT,
            WEIGHT,
            WEIGHT,
            WEIGHT,
            WEIGHT,
            WEIGHT,
            WEIGHT,
            lin("quadratic_per_um", -0.2, 0.2, 1e-4),
        ],
        build: play_block,
        starts: |_| {
            vec![
                vec![0.9, 0.02, 0.02, 0.02, 0.02, 0.02, 0.02, 0.02, 0.0],
                vec![0.7, 0.05, 0.05, 0.05, 0.05, 0.05, 0.05, 0.05, 0.0],
            ]
        },
        typical: ANY,
        off_response: false,
        kind: Kind::Chain,
    },
    // Never looked for: what is left of play operators when they remember nothing. See `Context::mostly_curvature`.
    Variant {
        id: CURVATURE,
        params: &[lin("quadratic_per_um", -0.2, 0.2, 1e-4)],
        build: |v, s| {
            let mut weights = [0.0; PLAY_LEVELS.len()];
            weights[0] = 1.0;
            Block::Play {
                stroke_um: s.stroke_um,
                weights,
                quadratic: v[0],
            }
        },
        starts: |_| Vec::new(),
        typical: ANY,
        off_response: false,
        kind: Kind::Chain,
    },
    Variant {
        id: "pzt-creep",
        params: &[lin("per_decade", 1e-5, 0.19, 1e-3)],
        build: |v, _| Block::Creep { g: v[0] },
        starts: |_| one([0.01, 0.05]),
        typical: (0.0, 0.06),
        off_response: false,
        kind: Kind::Chain,
    },
    Variant {
        id: "backlash",
        params: &[log("width_um", 1e-3, 20.0)],
        build: |v, _| Block::Backlash { width_um: v[0] },
        starts: |_| one([0.01, 0.03, 0.1, 0.25, 0.5, 1.0]),
        typical: (0.0, 1.0),
        off_response: false,
        kind: Kind::Chain,
    },
    Variant {
        id: "saturation",
        params: &[
            lin("low_um", -1e3, 1e4, 1e-3),
            lin("high_um", -1e3, 1e4, 1e-3),
        ],
        build: |v, _| Block::Saturation {
            low_um: v[0],
            high_um: v[1].max(v[0] + 1e-3),
        },
        starts: |s| {
            [0.2, 0.35, 0.5, 0.7, 0.9]
                .iter()
                .map(|c| {
                    vec![
                        s.working_point_um + c * (s.low_um - s.working_point_um),
                        s.working_point_um + c * (s.high_um - s.working_point_um),
                    ]
                })
                .collect()
        },
        typical: ANY,
        off_response: false,
        kind: Kind::Chain,
    },
    Variant {
        id: "saturation",
        params: &[lin("high_um", -1e3, 1e4, 1e-3)],
        build: |v, s| Block::Saturation {
            low_um: (s.low_um - 1.0).min(0.0),
            high_um: v[0],
        },
        starts: |s| {
            one([0.2, 0.35, 0.5, 0.7, 0.9]
                .map(|c| s.working_point_um + c * (s.high_um - s.working_point_um)))
        },
        typical: ANY,
        off_response: false,
        kind: Kind::Chain,
    },
    Variant {
        id: "saturation",
        params: &[lin("low_um", -1e3, 1e4, 1e-3)],
        build: |v, s| Block::Saturation {
            low_um: v[0],
            high_um: (s.high_um + 1.0).max(40.0),
        },
        starts: |s| {
            one([0.2, 0.35, 0.5, 0.7, 0.9]
                .map(|c| s.working_point_um + c * (s.low_um - s.working_point_um)))
        },
        typical: ANY,
        off_response: false,
        kind: Kind::Chain,
    },
    Variant {
        id: "slew-limit",
        params: &[log("rate_um_per_s", 1.0, 1e6)],
        build: |v, _| Block::SlewLimit { rate: v[0] },
        starts: |_| one([20.0, 60.0, 150.0, 350.0, 700.0, 1200.0, 2000.0, 8000.0]),
        typical: ANY,
        off_response: false,
        kind: Kind::Chain,
    },
    Variant {
        id: "pdms-relaxation",
        params: &[log("time_s", 1e-3, 50.0), lin("strength", -0.8, 5.0, 1e-3)],
        build: |v, _| Block::Relaxation {
            time_s: v[0],
            strength: v[1],
        },
        starts: |_| grid(&[0.01, 0.03, 0.1, 0.3, 1.0, 3.0], &[-0.1, 0.1]),
        typical: (0.03, 2.0),
        off_response: false,
        kind: Kind::Chain,
    },
    Variant {
        id: "leak",
        params: &[log("corner_rad_per_s", 1e-4, 300.0)],
        build: |v, _| Block::Leak { corner: v[0] },
        starts: |_| one([0.01, 0.05, 0.3, 1.0, 3.0, 10.0, 30.0]),
        typical: (0.005, 20.0),
        off_response: false,
        kind: Kind::Chain,
    },
    Variant {
        id: "gain-drift",
        params: &[lin("per_s", -0.5, 0.5, 1e-4)],
        build: |v, _| Block::GainDrift { per_s: v[0] },
        starts: |_| one([-0.01, -0.002, 0.002, 0.01]),
        typical: ANY,
        off_response: false,
        kind: Kind::Chain,
    },
    Variant {
        id: "wall-adhesion",
        params: &[log("speed_um_per_s", 0.05, 2e3)],
        build: |v, _| Block::Adhesion { um_per_s: v[0] },
        starts: |_| one([2.0, 6.0, 20.0, 50.0, 120.0]),
        typical: (0.5, 300.0),
        off_response: false,
        kind: Kind::Chain,
    },
    Variant {
        id: "flow-drift",
        params: &[lin("um_per_s", -2e3, 2e3, 1e-2)],
        build: |v, _| Block::FlowDrift { um_per_s: v[0] },
        starts: |_| one([-5.0, 5.0]),
        typical: ANY,
        off_response: true,
        kind: Kind::Chain,
    },
    Variant {
        id: "clock-skew",
        params: &[lin("ppm", -5e4, 5e4, 1.0)],
        build: |v, _| Block::ClockSkew { e: 1e-6 * v[0] },
        starts: |_| one([-400.0, -100.0, -20.0, 20.0, 100.0, 400.0]),
        typical: ANY,
        off_response: false,
        kind: Kind::Chain,
    },
    Variant {
        id: "mains-hum",
        params: &[lin("hz", 45.0, 65.0, 1e-3)],
        build: |v, _| Block::Hum { hz: v[0] },
        starts: |_| one([50.0, 60.0]),
        typical: ANY,
        off_response: true,
        kind: Kind::Line,
    },
    Variant {
        id: "pixel-locking",
        params: &[log("pixel_um", 0.03, 5.0)],
        build: |v, _| Block::PixelLocking { pixel_um: v[0] },
        // Found by a scan over pixel sizes; see `scan`.
        starts: |_| Vec::new(),
        typical: (0.05, 1.5),
        off_response: true,
        kind: Kind::Position,
    },
];

/// The forms that delay a slow motion by `lag_s`: those with one number, and a lightly damped resonance where that is at
/// a frequency which a piezo can have. Faster than the frames its ringing shows by its phase from one frame to the next
/// only: such a resonance starts from each quarter of a cycle, because the sum of squares has a valley in each.
pub(crate) fn of_lag(lag_s: f64, sample_s: f64) -> Vec<Part> {
    const DAMPING: f64 = 0.1;
    let resonance_hz = 2.0 * DAMPING / (TAU * lag_s);
    let quarters: &[f64] = if resonance_hz * sample_s > 1.0 {
        &[0.0, -0.5, -0.25, 0.25, 0.5]
    } else {
        &[0.0]
    };
    VARIANTS
        .iter()
        .enumerate()
        .flat_map(|(i, v)| {
            if v.id == "pzt-resonance" {
                return quarters
                    .iter()
                    .map(|q| resonance_hz + q / sample_s)
                    .filter(|hz| (v.typical.0..v.typical.1).contains(hz))
                    .map(|hz| Part::new(i, &[hz, 0.5 * TAU * hz * lag_s]))
                    .collect();
            }
            if v.params.len() != 1 {
                return Vec::new();
            }
            let value = match v.id {
                "time-delay" | "bubble" => lag_s,
                "driver-lag" => 1.0 / (TAU * lag_s),
                "exposure-averaging" => 2.0 * lag_s,
                _ => return Vec::new(),
            };
            vec![Part::new(i, &[value])]
        })
        .collect()
}

/// Fraction and width of play operators that stand for an exponential density, as [`crate::augment`] writes them.
fn domains_of(thresholds_um: &[f64], weights: &[f64]) -> Option<(f64, f64)> {
    let (radii, shares) = domains();
    let ([zero, thresholds_um @ ..], [rest, weights @ ..]) = (thresholds_um, weights) else {
        return None;
    };
    if *zero != 0.0 || thresholds_um.len() != radii.len() || weights.len() != shares.len() {
        return None;
    }
    let (fraction, width_um) = (1.0 - rest, thresholds_um[0] / radii[0]);
    let alike = |given: &[f64], own: &[f64], unit: f64| {
        given
            .iter()
            .zip(own)
            .all(|(g, o)| (g - unit * o).abs() < 1e-6 * unit.abs())
    };
    (alike(thresholds_um, &radii, width_um) && alike(weights, &shares, fraction))
        .then_some((fraction, width_um))
}

/// The flat form of an effect of a model file; `None` for those that are no part of the response.
pub(crate) fn block_of(effect: &Effect, scope: &Scope) -> Option<Block> {
    Some(match *effect {
        Effect::DriverLag { bandwidth_hz } => Block::DriverLag {
            w: TAU * bandwidth_hz,
        },
        Effect::SlewLimit { rate_um_per_s } => Block::SlewLimit {
            rate: rate_um_per_s,
        },
        Effect::Saturation { low_um, high_um } => Block::Saturation { low_um, high_um },
        Effect::PztHysteresis(
            Hysteresis::BoucWen {
                fraction,
                beta_per_um,
                gamma_per_um,
            }
            | Hysteresis::BoucWenExplicit {
                fraction,
                beta_per_um,
                gamma_per_um,
            },
        ) => Block::BoucWen {
            fraction,
            beta: beta_per_um,
            gamma: gamma_per_um,
        },
        Effect::PztHysteresis(Hysteresis::Play {
            ref thresholds_um,
            ref weights,
            quadratic_per_um,
        }) => {
            // Only thresholds in this crate's own proportions can be held as a flat block.
            if let Some((fraction, width_um)) = domains_of(thresholds_um, weights)
                && quadratic_per_um == 0.0
            {
                return Some(Block::Domains { fraction, width_um });
            }
            let stroke_um = thresholds_um.last().copied().unwrap_or(scope.stroke_um)
                / PLAY_LEVELS[PLAY_LEVELS.len() - 1];
            let mut w = [0.0; PLAY_LEVELS.len()];
            for (i, l) in PLAY_LEVELS.iter().enumerate() {
                w[i] = thresholds_um
                    .iter()
                    .position(|r| (r - l * stroke_um).abs() < 1e-6 * stroke_um.max(1e-9))
                    .and_then(|j| weights.get(j).copied())
                    .unwrap_or(0.0);
            }
            Block::Play {
                stroke_um,
                weights: w,
                quadratic: quadratic_per_um,
            }
        }
        Effect::PztCreep { per_decade } => Block::Creep { g: per_decade },
        Effect::PztResonance {
            frequency_hz,
            damping,
        } => Block::Resonance {
            w: TAU * frequency_hz,
            zeta: damping,
        },
        Effect::Backlash { width_um } => Block::Backlash { width_um },
        Effect::PdmsRelaxation { time_s, strength } => Block::Relaxation { time_s, strength },
        Effect::Bubble {
            lag_s,
            dissolution_per_s,
        } => Block::Bubble {
            lag_s,
            dissolution: dissolution_per_s,
        },
        Effect::Leak { corner_rad_per_s } => Block::Leak {
            corner: corner_rad_per_s,
        },
        Effect::GainError { factor } => Block::Gain { factor },
        Effect::GainDrift { per_s } => Block::GainDrift { per_s },
        Effect::WallAdhesion { speed_um_per_s } => Block::Adhesion {
            um_per_s: speed_um_per_s,
        },
        Effect::FlowDrift { um_per_s } => Block::FlowDrift { um_per_s },
        Effect::TimeDelay { delay_s } => Block::Delay { s: delay_s },
        Effect::ExposureAveraging { exposure_s } => Block::Exposure { s: exposure_s },
        Effect::ClockSkew { ppm } => Block::ClockSkew { e: 1e-6 * ppm },
        Effect::FrameDrops { .. }
        | Effect::FrameRepeats { .. }
        | Effect::PixelLocking { .. }
        | Effect::MainsHum { .. } => {
            return None;
        }
    })
}
