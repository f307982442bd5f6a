//! `pzt-hysteresis`: the piezo's hysteresis, independent of rate, in three forms.
//!
//! All act on the displacement from the working point.

use super::candidate::grid;
use super::{
    Action, Block, Candidate, Effect, EffectKind, Experiment, FitParameter, Form, ParameterSpec,
    Piece, Place, Scope, Spec, lin, log,
};

/// Bouc-Wen: `x = u - fraction h`, `dh/dt = du/dt - beta |du/dt| h - gamma du/dt |h|`.
///
/// Bouc 1967, Wen 1976 (J. Eng. Mech. Div. ASCE 102:249) with exponent 1 and A = 1, in the form used for piezos (Low, Guo 1995, IEEE
/// Trans. Control Syst. Technol. 3:119). At small amplitude h = u and the gain is `1 - fraction`; at large amplitude h saturates at
/// `1/(beta + gamma)` and the gain approaches 1. The equation is integrated in closed form along each straight change of u.
/// `|gamma| <= beta` keeps the loop dissipative.
pub fn bouc_wen(fraction: f64, beta_per_um: f64, gamma_per_um: f64) -> Effect {
    Effect::new(
        &PztHysteresis,
        BOUC_WEN,
        &[fraction, beta_per_um, gamma_per_um],
        &[],
    )
}

/// The same equation as it is often programmed for sampled commands: one explicit step per change of the command, `h += du - beta |du| h
/// - gamma du |h|`. It differs from [`bouc_wen`] if a single change `du` is not small against `1/(beta + gamma)`.
pub fn bouc_wen_explicit(fraction: f64, beta_per_um: f64, gamma_per_um: f64) -> Effect {
    Effect::new(
        &PztHysteresis,
        EXPLICIT,
        &[fraction, beta_per_um, gamma_per_um],
        &[],
    )
}

/// Play operators (Prandtl-Ishlinskii): `x = v + quadratic_per_um v^2`, `v = sum w_i p_i`,
/// `p_i = max(u - r_i, min(u + r_i, p_i))`.
///
/// Kuhnen 2003, Eur. J. Control 9:407. Thresholds `r_i` in um, rising, not negative, the first usually 0; the quadratic
/// output term is the asymmetry of a piezo driven by voltage.
pub fn play(thresholds_um: &[f64], weights: &[f64], quadratic_per_um: f64) -> Effect {
    let curve = Curve {
        quadratic_per_um,
        ..Curve::default()
    };
    curved_play(thresholds_um, weights, curve)
}

/// Static curves around play operators: `x = v + quadratic_per_um v^2 + cubic_per_um2 v^3 + input_quadratic_per_um u^2`.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Curve {
    /// Of the operators' sum \[1/um\]: the gain differs between the two ends of the stroke.
    pub quadratic_per_um: f64,
    /// Of the operators' sum \[1/um^2\]: the gain differs between the ends and the middle of the stroke.
    pub cubic_per_um2: f64,
    /// Of the input, parallel to the memory \[1/um\]. With an output term of the other sign, loops lose more at one end of the stroke
    /// than at the other.
    pub input_quadratic_per_um: f64,
}

/// Play operators inside static curves, for loops that vary along the stroke.
///
/// Operators and a polynomial of the input as in Gu, Zhu, Su 2014, IEEE Trans. Ind. Electron. 61:1583 (modified
/// Prandtl-Ishlinskii), with a curved output.
pub fn curved_play(thresholds_um: &[f64], weights: &[f64], curve: Curve) -> Effect {
    let scalars = [
        curve.quadratic_per_um,
        curve.cubic_per_um2,
        curve.input_quadratic_per_um,
    ];
    Effect::new(&PztHysteresis, PLAY, &scalars, &[thresholds_um, weights])
}

/// Play operators whose density falls off exponentially with the threshold, `fraction/width exp(-r/width)`, plus `1 - fraction`
/// of the input: large strokes keep their gain.
pub fn exponential_play(fraction: f64, width_um: f64) -> Effect {
    let (radii, shares) = classes();
    let thresholds: Vec<f64> = std::iter::once(0.0)
        .chain(radii.map(|r| r * width_um))
        .collect();
    let weights: Vec<f64> = std::iter::once(1.0 - fraction)
        .chain(shares.map(|s| s * fraction))
        .collect();
    play(&thresholds, &weights, 0.0)
}

#[derive(Debug)]
pub(super) struct PztHysteresis;

/// Indices of the forms.
const BOUC_WEN: usize = 0;
const EXPLICIT: usize = 1;
const PLAY: usize = 2;

const NUMBERS: &[ParameterSpec] = &[
    ParameterSpec::new("fraction", "", 0.0, 1.0),
    ParameterSpec::new("beta_per_um", "1/um", 1e-6, 1e3),
    ParameterSpec::new("gamma_per_um", "1/um", -1e3, 1e3),
];

static SPEC: Spec = Spec {
    id: "pzt-hysteresis",
    place: Place::Pzt,
    equation: "Bouc-Wen, or play operators sum w_i max(u - r_i, min(u + r_i, p_i))",
    signature: "a lag the same at all frequencies that grows with the amplitude; the gain rises with the amplitude; odd harmonics",
    forms: &[
        Form {
            name: "bouc-wen",
            scalars: NUMBERS,
            lists: &[],
        },
        Form {
            name: "bouc-wen-explicit",
            scalars: NUMBERS,
            lists: &[],
        },
        Form {
            name: "play",
            scalars: &[
                ParameterSpec::new("quadratic_per_um", "1/um", -1.0, 1.0).or(0.0),
                ParameterSpec::new("cubic_per_um2", "1/um^2", -1.0, 1.0).or(0.0),
                ParameterSpec::new("input_quadratic_per_um", "1/um", -1.0, 1.0).or(0.0),
            ],
            lists: &[
                ParameterSpec::new("thresholds_um", "um", 0.0, 1e4),
                ParameterSpec::new("weights", "", -1e3, 1e3),
            ],
        },
    ],
    confused_with: &["backlash", "wall-adhesion", "pzt-creep"],
    experiment: Experiment::Amplitudes,
    separate_by: "the same sine at a second amplitude and a second frequency, and its third harmonic",
    ..Spec::PLAIN
};

/// Thresholds of the freely weighted play operators, in parts of the stroke: even, closer together for small loops, and up to the full
/// stroke, which only the widest loops reach.
const LEVELS: [f64; 12] = [
    0.0, 0.03, 0.08, 0.15, 0.25, 0.35, 0.45, 0.55, 0.65, 0.75, 0.85, 0.95,
];
const WEIGHT: FitParameter = lin("weights", -3.0, 5.0, 1e-3);
const QUADRATIC: FitParameter = lin("quadratic_per_um", -0.2, 0.2, 1e-4);
const CUBIC: FitParameter = lin("cubic_per_um2", -0.2, 0.2, 1e-5);
const INPUT_QUADRATIC: FitParameter = lin("input_quadratic_per_um", -0.2, 0.2, 1e-4);
/// Weights, and the curves around them.
const PLAY_NUMBERS: &[FitParameter] = &{
    let mut all = [WEIGHT; LEVELS.len() + 3];
    all[LEVELS.len()] = QUADRATIC;
    all[LEVELS.len() + 1] = CUBIC;
    all[LEVELS.len() + 2] = INPUT_QUADRATIC;
    all
};

const BOUC_WEN_CANDIDATE: Candidate = Candidate {
    name: "bouc-wen",
    ..Candidate::chain(&[
        lin("fraction", 0.0, 1.0, 1e-3),
        log("beta_per_um", 0.02, 50.0),
        lin("gamma_per_um", -20.0, 20.0, 1e-3),
    ])
    .typical(0.0, 0.6)
};

const CANDIDATES: &[Candidate] = &[
    BOUC_WEN_CANDIDATE,
    Candidate {
        name: "exponential play",
        ..Candidate::chain(&[
            lin("fraction", 0.0, 1.0, 1e-3),
            log("width_um", 0.005, 100.0),
        ])
        .typical(0.0, 0.6)
    },
    Candidate {
        name: "free play",
        late: true,
        ..Candidate::chain(PLAY_NUMBERS.split_at(LEVELS.len() + 1).0)
    },
    // Play operators without memory; never a start of the search.
    Candidate {
        name: "curvature",
        late: true,
        ..Candidate::chain(&[QUADRATIC, CUBIC])
    },
    // For records of the piezo itself. Behind a chip, a cubic curve may come from a saturation or a spring, which are separate effects.
    Candidate {
        name: "curved play",
        late: true,
        ..Candidate::chain(PLAY_NUMBERS)
    },
    // Occurs in programs, not in piezos: one step of the equation per command.
    Candidate {
        name: "bouc-wen-explicit",
        late: true,
        ..BOUC_WEN_CANDIDATE
    },
];

impl EffectKind for PztHysteresis {
    fn spec(&self) -> &'static Spec {
        &SPEC
    }

    fn act(&self, effect: &Effect) -> Action {
        let (a, b, c) = (effect.scalar(0), effect.scalar(1), effect.scalar(2));
        Action::Block(if effect.form_index() == PLAY {
            Box::new(Play {
                thresholds: effect.list(0).to_vec(),
                weights: effect.list(1).to_vec(),
                curve: Curve {
                    quadratic_per_um: a,
                    cubic_per_um2: b,
                    input_quadratic_per_um: c,
                },
                p: vec![0.0; effect.list(0).len()],
            })
        } else {
            Box::new(BoucWen {
                fraction: a,
                beta: b,
                gamma: c,
                explicit: effect.form_index() == EXPLICIT,
                h: 0.0,
                input: 0.0,
            })
        })
    }

    fn check(&self, effect: &Effect) -> Result<(), &'static str> {
        if effect.form_index() != PLAY {
            if effect.scalar(2).abs() > effect.scalar(1) {
                return Err(
                    "gamma_per_um must lie within -beta_per_um..beta_per_um, else the loop would feed energy back",
                );
            }
            return Ok(());
        }
        let (thresholds, weights) = (effect.list(0), effect.list(1));
        if thresholds.is_empty() || thresholds.len() != weights.len() {
            return Err(
                "thresholds_um and weights must have the same number of elements, at least one",
            );
        }
        if thresholds.len() > 64 {
            return Err("at most 64 play operators are supported");
        }
        if thresholds.windows(2).any(|w| w[0] >= w[1]) {
            return Err("thresholds_um must rise strictly");
        }
        Ok(())
    }

    fn has_two_gains(&self) -> bool {
        true
    }

    fn memoryless(&self) -> Option<usize> {
        CANDIDATES.iter().position(|c| c.name == "curvature")
    }

    fn has_unlike_forms(&self) -> bool {
        true
    }

    fn candidates(&self) -> &'static [Candidate] {
        CANDIDATES
    }

    fn starts(&self, index: usize, scope: &Scope) -> Vec<Vec<f64>> {
        match index {
            0 | 5 => [0.3, 1.0, 3.0, 8.0]
                .iter()
                .flat_map(|b| [0.1, 0.35].map(|f| vec![f, (b / scope.stroke_um).min(40.0), 0.0]))
                .collect(),
            1 => grid(&[0.05, 0.3], &[0.03, 0.1, 0.3, 1.0])
                .into_iter()
                .map(|v| vec![v[0], v[1] * scope.stroke_um])
                .collect(),
            2 | 4 if index == 2 || scope.sampled_input => [0.02, 0.05]
                .iter()
                .map(|wide| {
                    let mut start = vec![*wide; LEVELS.len()];
                    start[0] = 1.0 - 5.0 * wide;
                    start.resize(CANDIDATES[index].params.len(), 0.0);
                    start
                })
                .collect(),
            _ => Vec::new(),
        }
    }

    fn bind(&self, index: usize, values: &mut [f64]) {
        if let (0 | 5, [_, beta, gamma]) = (index, values) {
            *gamma = gamma.clamp(-*beta, *beta);
        }
    }

    fn build(&'static self, index: usize, values: &[f64], scope: &Scope) -> Effect {
        let at = |i: usize| values.get(i).copied().unwrap_or(0.0);
        let thresholds = LEVELS.map(|l| l * scope.stroke_um);
        match index {
            0 => bouc_wen(at(0), at(1), at(2)),
            1 => exponential_play(at(0), at(1)),
            5 => bouc_wen_explicit(at(0), at(1), at(2)),
            2 | 4 => curved_play(
                &thresholds,
                &values[..LEVELS.len()],
                Curve {
                    quadratic_per_um: at(LEVELS.len()),
                    cubic_per_um2: at(LEVELS.len() + 1),
                    input_quadratic_per_um: at(LEVELS.len() + 2),
                },
            ),
            _ => curved_play(
                &thresholds[..1],
                &[1.0],
                Curve {
                    quadratic_per_um: at(0),
                    cubic_per_um2: at(1),
                    ..Curve::default()
                },
            ),
        }
    }
}

/// Classes of thresholds of an exponential density, by their edges in widths.
const EDGES: [f64; CLASSES + 1] = [
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

/// Number of play operators that approximate an exponential density.
const CLASSES: usize = 14;

/// Thresholds in widths and shares of an exponential density of play operators, each class at its mean.
fn classes() -> ([f64; CLASSES], [f64; CLASSES]) {
    let (mut radii, mut shares) = ([0.0; CLASSES], [0.0; CLASSES]);
    let moment = |r: f64| {
        if r.is_finite() {
            (r + 1.0) * (-r).exp()
        } else {
            0.0
        }
    };
    for i in 0..CLASSES {
        let (a, b) = (EDGES[i], EDGES[i + 1]);
        shares[i] = (-a).exp() - (-b).exp();
        radii[i] = (moment(a) - moment(b)) / shares[i];
    }
    (radii, shares)
}

/// A piece of a rate-independent block: it follows the input to both ends.
fn followed(h_s: f64, input: Piece, mut follow: impl FnMut(f64) -> f64) -> Piece {
    let start = follow(input.start);
    let end = if input.end == input.start {
        start
    } else {
        follow(input.end)
    };
    Piece::line(start, end, h_s)
}

#[derive(Debug, Clone)]
struct BoucWen {
    fraction: f64,
    beta: f64,
    gamma: f64,
    explicit: bool,
    h: f64,
    input: f64,
}

/// Limit of the explicit recursion \[um\]: beyond it the recursion diverges, and no infinity may enter the loop.
const RUNAWAY_UM: f64 = 1e6;

impl BoucWen {
    fn follow(&mut self, u: f64) -> f64 {
        let du = u - self.input;
        if du != 0.0 {
            self.h = if self.explicit {
                let next =
                    self.h + du - self.beta * du.abs() * self.h - self.gamma * du * self.h.abs();
                next.clamp(-RUNAWAY_UM, RUNAWAY_UM)
            } else {
                exact(self.h, self.input, u, self.beta, self.gamma)
            };
            self.input = u;
        }
        u - self.fraction * self.h
    }
}

impl Block for BoucWen {
    fn advance(&mut self, _: f64, h_s: f64, input: Piece) -> Piece {
        followed(h_s, input, |u| self.follow(u))
    }

    fn duplicate(&self) -> Box<dyn Block> {
        Box::new(self.clone())
    }
}

/// Bouc-Wen over a change of input from `from` to `to`, exactly: on each side of h = 0 the equation
/// `dh/du = 1 - (beta s + gamma sgn h) ...` is linear, so h moves along exponentials.
fn exact(h: f64, from: f64, to: f64, beta: f64, gamma: f64) -> f64 {
    let direction = if to > from { 1.0 } else { -1.0 };
    // Mirrored so that the input rises: with g = direction * h, dg/dv = 1 - beta g - gamma |g|, v the distance travelled.
    let mut g = direction * h;
    let mut way = (to - from).abs();
    if g < 0.0 {
        // dg/dv = 1 - (beta - gamma) g up to the crossing of zero.
        let rate = beta - gamma;
        let crossing = if rate.abs() * g.abs() < 1e-9 {
            -g
        } else {
            (1.0 - rate * g).ln() / rate
        };
        if way <= crossing {
            return direction * relax(g, rate, way);
        }
        way -= crossing;
        g = 0.0;
    }
    direction * relax(g, beta + gamma, way)
}

/// `g` after `dg/dv = 1 - rate g` over the distance `way`.
fn relax(g: f64, rate: f64, way: f64) -> f64 {
    let z = -rate * way;
    let exp = z.exp();
    let phi1 = if z.abs() < 1e-5 {
        1.0 + 0.5 * z
    } else {
        z.exp_m1() / z
    };
    g * exp + way * phi1
}

#[derive(Debug, Clone)]
struct Play {
    thresholds: Vec<f64>,
    weights: Vec<f64>,
    curve: Curve,
    p: Vec<f64>,
}

impl Play {
    fn follow(&mut self, u: f64) -> f64 {
        let mut v = 0.0;
        for ((r, w), p) in self.thresholds.iter().zip(&self.weights).zip(&mut self.p) {
            *p = (u - r).max((u + r).min(*p));
            v += w * *p;
        }
        let Curve {
            quadratic_per_um,
            cubic_per_um2,
            input_quadratic_per_um,
        } = self.curve;
        v + v * v * (quadratic_per_um + cubic_per_um2 * v) + input_quadratic_per_um * u * u
    }
}

impl Block for Play {
    fn advance(&mut self, _: f64, h_s: f64, input: Piece) -> Piece {
        followed(h_s, input, |u| self.follow(u))
    }

    fn duplicate(&self) -> Box<dyn Block> {
        Box::new(self.clone())
    }
}
