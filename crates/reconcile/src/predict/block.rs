//! The effects of the vocabulary in the flat form that the predictor runs on.

/// One effect with its numbers. Order of variants is the order in the chain.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Block {
    /// Absolute displacement limits \[um\].
    Saturation { low_um: f64, high_um: f64 },
    /// um/s.
    SlewLimit { rate: f64 },
    /// Corner \[rad/s\].
    DriverLag { w: f64 },
    /// `x = u - fraction h`, one step of h per increment of u.
    BoucWen {
        fraction: f64,
        beta: f64,
        gamma: f64,
    },
    /// Weights of play operators with thresholds `i`-th of [`PLAY_LEVELS`] times `stroke_um`, and the quadratic term.
    Play {
        stroke_um: f64,
        weights: [f64; PLAY_LEVELS.len()],
        quadratic: f64,
    },
    /// Play operators whose density falls off exponentially with the threshold, `fraction/width exp(-r/width)`, beside
    /// `1 - fraction` of the input itself: large strokes keep their gain.
    Domains { fraction: f64, width_um: f64 },
    /// Per decade.
    Creep { g: f64 },
    /// rad/s and damping ratio.
    Resonance { w: f64, zeta: f64 },
    /// Full width \[um\].
    Backlash { width_um: f64 },
    /// `(1 + (1 + strength) time s)/(1 + time s)`.
    Relaxation { time_s: f64, strength: f64 },
    /// `1/(1 + lag s)`, lag decaying at `dissolution` per second.
    Bubble { lag_s: f64, dissolution: f64 },
    /// `s/(s + corner)`.
    Leak { corner: f64 },
    /// Factor.
    Gain { factor: f64 },
    /// `1 + rate t`.
    GainDrift { per_s: f64 },
    /// um/s added.
    FlowDrift { um_per_s: f64 },
    /// Dead zone of speed \[um/s\].
    Adhesion { um_per_s: f64 },
    /// parts (not ppm).
    ClockSkew { e: f64 },
    /// s.
    Delay { s: f64 },
    /// s.
    Exposure { s: f64 },
    /// Line; the amplitude and phase are linear and per record, held outside.
    Hum { hz: f64 },
    /// Locking; sine and cosine are linear and common, held outside.
    PixelLocking { pixel_um: f64 },
}

/// Thresholds of the play operators in parts of the stroke.
pub(crate) const PLAY_LEVELS: [f64; 8] = [0.0, 0.03, 0.08, 0.15, 0.25, 0.4, 0.6, 0.8];

/// Classes of thresholds of [`Block::Domains`], by their edges in widths.
const DOMAIN_EDGES: [f64; DOMAINS + 1] = [
    0.0,
    0.04,
    0.1,
    0.18,
    0.28,
    0.4,
    0.55,
    0.75,
    1.0,
    1.3,
    1.7,
    2.2,
    3.0,
    4.5,
    f64::INFINITY,
];

/// Number of play operators that stand for an exponential density.
pub(crate) const DOMAINS: usize = 14;

/// Thresholds in widths and shares of an exponential density of play operators, each class at its mean.
pub(crate) fn domains() -> ([f64; DOMAINS], [f64; DOMAINS]) {
    let (mut radii, mut shares) = ([0.0; DOMAINS], [0.0; DOMAINS]);
    let moment = |r: f64| {
        if r.is_finite() {
            (r + 1.0) * (-r).exp()
        } else {
            0.0
        }
    };
    for i in 0..DOMAINS {
        let (a, b) = (DOMAIN_EDGES[i], DOMAIN_EDGES[i + 1]);
        shares[i] = (-a).exp() - (-b).exp();
        radii[i] = (moment(a) - moment(b)) / shares[i];
    }
    (radii, shares)
}

impl Block {
    /// Rank in the chain.
    pub fn rank(&self) -> u8 {
        match self {
            Self::Saturation { .. } => 0,
            Self::SlewLimit { .. } => 1,
            Self::DriverLag { .. } => 2,
            Self::BoucWen { .. } | Self::Play { .. } | Self::Domains { .. } => 3,
            Self::Creep { .. } => 4,
            Self::Resonance { .. } => 5,
            Self::Backlash { .. } => 6,
            Self::Relaxation { .. } => 7,
            Self::Bubble { .. } => 8,
            Self::Leak { .. } => 9,
            Self::Gain { .. } => 10,
            Self::GainDrift { .. } => 11,
            Self::FlowDrift { .. } => 12,
            Self::Adhesion { .. } => 13,
            Self::ClockSkew { .. } => 14,
            Self::Delay { .. } => 15,
            Self::Exposure { .. } => 16,
            Self::Hum { .. } => 17,
            Self::PixelLocking { .. } => 18,
        }
    }
}
