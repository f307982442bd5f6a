//! From a model to the sequence of stages that a [`super::Chain`] advances.

use super::blocks::{Block, HysteresisBlock};
use super::linear::LinearGroup;
use crate::effect::{Effect, Hysteresis, Place};
use crate::modal::Zpk;
use crate::model::Model;
use nalgebra::Complex;
use std::f64::consts::TAU;

/// A stage of the chain.
#[derive(Debug, Clone)]
pub(crate) enum Stage {
    Linear(LinearGroup),
    Block(Block),
}

/// The compiled chain without its state of the front (saturation, slew).
#[derive(Debug, Clone)]
pub(crate) struct Compiled {
    pub stages: Vec<Stage>,
    /// Index of the group that holds the plant and the tap of the PZT displacement.
    pub plant: usize,
    /// Displacements from the working point, um.
    pub low: f64,
    pub high: f64,
    /// um/s; infinite without a slew limit.
    pub rate: f64,
    /// Longest piece, s; infinite when every stage is exact.
    pub substep_s: f64,
    /// Whether a stage needs slopes and integrals of its input.
    pub needs_slopes: bool,
}

fn pole(p: f64) -> Complex<f64> {
    Complex::new(p, 0.0)
}

/// First-order low-pass `w / (s + w)`.
fn low_pass(w: f64) -> Zpk {
    Zpk {
        zeros: Vec::new(),
        poles: vec![pole(-w)],
        gain: w,
    }
}

fn resonance(frequency_hz: f64, damping: f64) -> Zpk {
    let w = TAU * frequency_hz;
    let poles = if damping < 1.0 {
        let im = w * (1.0 - damping * damping).sqrt();
        vec![
            Complex::new(-damping * w, im),
            Complex::new(-damping * w, -im),
        ]
    } else {
        let fast = -w * (damping + (damping * damping - 1.0).sqrt());
        vec![pole(fast), pole(w * w / fast)]
    };
    Zpk {
        zeros: Vec::new(),
        poles,
        gain: w * w,
    }
}

/// Slowest and fastest time constants of the creep bank, s, and how many per decade.
const CREEP_FASTEST_S: f64 = 1e-4;
const CREEP_DECADES: usize = 9;
const CREEP_PER_DECADE: usize = 2;
/// A creeping piezo has its nominal displacement this long after a step, s.
const CREEP_REFERENCE_S: f64 = 0.1;

/// Time constants of the creep bank, s.
pub(crate) fn creep_times() -> impl Iterator<Item = f64> {
    (0..CREEP_DECADES * CREEP_PER_DECADE)
        .map(|i| CREEP_FASTEST_S * 10f64.powf((i as f64 + 0.5) / CREEP_PER_DECADE as f64))
}

/// `1 + sum (g/n) (1/(1 + tau s) - (1 - exp(-t0/tau)))`: the step response is `1 + g log10(t/t0)`.
fn creep(per_decade: f64) -> Zpk {
    if per_decade == 0.0 {
        return Zpk::one();
    }
    let share = per_decade / CREEP_PER_DECADE as f64;
    let rates: Vec<f64> = creep_times().map(|tau| 1.0 / tau).collect();
    let direct = 1.0
        + share
            * rates
                .iter()
                .map(|r| (-CREEP_REFERENCE_S * r).exp_m1())
                .sum::<f64>();
    let value = |s: f64| direct + rates.iter().map(|r| share * r / (s + r)).sum::<f64>();
    // Poles in falling order -r (r falls). A zero lies between each pair of neighbours; the last one lies beyond the
    // fastest pole for g > 0 and between the slowest pole and the origin for g < 0.
    let mut brackets: Vec<(f64, f64)> = rates.windows(2).map(|w| (-w[0], -w[1])).collect();
    if share > 0.0 {
        brackets.push((-rates[0] * 1e3, -rates[0]));
    } else {
        brackets.push((-rates[rates.len() - 1], 0.0));
    }
    let zeros = brackets
        .into_iter()
        .map(|(mut low, mut high)| {
            // Just left of a pole the sum has the sign of -share, just right of it that of share.
            let left_of_high = if high == 0.0 { 1.0 } else { -share.signum() };
            for _ in 0..200 {
                let middle = 0.5 * (low + high);
                if middle <= low || middle >= high {
                    break;
                }
                if value(middle) * left_of_high > 0.0 {
                    high = middle;
                } else {
                    low = middle;
                }
            }
            pole(0.5 * (low + high))
        })
        .collect();
    Zpk {
        zeros,
        poles: rates.iter().map(|r| pole(-r)).collect(),
        gain: direct,
    }
}

fn relaxation(time_s: f64, strength: f64) -> Zpk {
    Zpk {
        zeros: vec![pole(-1.0 / (time_s * (1.0 + strength)))],
        poles: vec![pole(-1.0 / time_s)],
        gain: 1.0 + strength,
    }
}

/// The linear, time-invariant part of an effect as zeros, poles and gain; `None` for the others.
pub(crate) fn linear_part(effect: &Effect) -> Option<Zpk> {
    Some(match *effect {
        Effect::DriverLag { bandwidth_hz } => low_pass(TAU * bandwidth_hz),
        Effect::PztCreep { per_decade } => creep(per_decade),
        Effect::PztResonance {
            frequency_hz,
            damping,
        } => resonance(frequency_hz, damping),
        Effect::PdmsRelaxation { time_s, strength } => relaxation(time_s, strength),
        Effect::Bubble {
            lag_s,
            dissolution_per_s: 0.0,
        } => low_pass(1.0 / lag_s),
        Effect::Leak { corner_rad_per_s } => Zpk {
            zeros: vec![pole(0.0)],
            poles: vec![pole(-corner_rad_per_s)],
            gain: 1.0,
        },
        Effect::GainError { factor } => Zpk {
            gain: factor,
            ..Zpk::one()
        },
        _ => return None,
    })
}

/// What is between the command and the bead, collected stage by stage.
struct Builder {
    stages: Vec<Stage>,
    /// The linear blocks since the last stage.
    pending: Zpk,
    /// The pending blocks up to the end of the PZT, once that place is passed.
    tap: Option<Zpk>,
    plant: usize,
    /// Whether the signal so far can be other than constant while the command is.
    moving: bool,
    fastest: f64,
    substep_s: f64,
    needs_slopes: bool,
}

/// Shortest and longest sub-step where one is needed, s.
const SHORTEST_S: f64 = 2e-5;
const LONGEST_S: f64 = 2.5e-4;
/// Sub-steps are this part of the fastest time constant before the block that needs them.
const PART_OF_TIME_CONSTANT: f64 = 0.25;

impl Builder {
    fn flush(&mut self) {
        if self.pending == Zpk::one() && self.tap.is_none() {
            return;
        }
        let whole = std::mem::replace(&mut self.pending, Zpk::one());
        let tap = self.tap.take();
        if tap.is_some() {
            self.plant = self.stages.len();
        }
        let group = LinearGroup::new(whole, tap.as_ref());
        self.fastest = self.fastest.max(group.fastest());
        self.moving |= group.fastest() > 0.0;
        self.stages.push(Stage::Linear(group));
    }

    /// `curved`: the block's output is not a straight line even where its input is one.
    fn push(&mut self, block: Block, curved: bool) {
        self.flush();
        if curved && self.moving {
            let wanted = PART_OF_TIME_CONSTANT / self.fastest.max(1.0);
            self.substep_s = self.substep_s.min(wanted.clamp(SHORTEST_S, LONGEST_S));
        }
        self.stages.push(Stage::Block(block));
    }
}

pub(crate) fn compile(model: &Model) -> Compiled {
    let mut builder = Builder {
        stages: Vec::new(),
        pending: Zpk::one(),
        tap: None,
        plant: 0,
        moving: false,
        fastest: 0.0,
        substep_s: f64::INFINITY,
        needs_slopes: false,
    };
    let (mut low, mut high, mut rate) = (f64::NEG_INFINITY, f64::INFINITY, f64::INFINITY);
    let effects = model.ordered_effects();
    let plant_first = |b: &mut Builder| {
        b.tap = Some(b.pending.clone());
        b.pending = std::mem::replace(&mut b.pending, Zpk::one()).series(&Zpk::of(&model.plant));
    };
    let mut plant_is_in = false;
    for effect in effects {
        if effect.place() >= Place::Chip && !plant_is_in {
            plant_first(&mut builder);
            plant_is_in = true;
        }
        if let Some(zpk) = linear_part(effect) {
            builder.pending = std::mem::replace(&mut builder.pending, Zpk::one()).series(&zpk);
            continue;
        }
        match *effect {
            Effect::Saturation { low_um, high_um } => {
                low = low.max(low_um - model.working_point_um);
                high = high.min(high_um - model.working_point_um);
            }
            Effect::SlewLimit { rate_um_per_s } => {
                rate = rate.min(rate_um_per_s);
                builder.moving = true;
            }
            Effect::PztHysteresis(ref hysteresis) => {
                builder.push(Block::Hysteresis(hysteresis_block(hysteresis)), true);
            }
            Effect::Backlash { width_um } => builder.push(
                Block::Backlash {
                    half: 0.5 * width_um,
                    x: 0.0,
                },
                true,
            ),
            Effect::Bubble {
                lag_s,
                dissolution_per_s,
            } => {
                builder.push(
                    Block::Dissolving {
                        lag: lag_s,
                        dissolution: dissolution_per_s,
                        y: 0.0,
                        speed: 0.0,
                    },
                    true,
                );
            }
            Effect::GainDrift { per_s } => {
                builder.needs_slopes = true;
                builder.push(Block::GainDrift { per_s, area: 0.0 }, false);
            }
            Effect::FlowDrift { um_per_s } => {
                builder.push(Block::FlowDrift { speed: um_per_s }, false);
            }
            Effect::WallAdhesion { speed_um_per_s } => {
                builder.needs_slopes = true;
                builder.push(
                    Block::Adhesion {
                        threshold: speed_um_per_s,
                        input: 0.0,
                        output: 0.0,
                    },
                    true,
                );
            }
            _ => {}
        }
    }
    if !plant_is_in {
        plant_first(&mut builder);
    }
    builder.flush();
    Compiled {
        stages: builder.stages,
        plant: builder.plant,
        low,
        high,
        rate,
        substep_s: builder.substep_s,
        needs_slopes: builder.needs_slopes,
    }
}

fn hysteresis_block(hysteresis: &Hysteresis) -> HysteresisBlock {
    let explicit = matches!(hysteresis, Hysteresis::BoucWenExplicit { .. });
    match hysteresis {
        Hysteresis::BoucWen {
            fraction,
            beta_per_um,
            gamma_per_um,
        }
        | Hysteresis::BoucWenExplicit {
            fraction,
            beta_per_um,
            gamma_per_um,
        } => HysteresisBlock::BoucWen {
            fraction: *fraction,
            beta: *beta_per_um,
            gamma: *gamma_per_um,
            explicit,
            h: 0.0,
            input: 0.0,
        },
        Hysteresis::Play {
            thresholds_um,
            weights,
            quadratic_per_um,
        } => HysteresisBlock::Play {
            thresholds: thresholds_um.clone(),
            weights: weights.clone(),
            quadratic: *quadratic_per_um,
            p: vec![0.0; thresholds_um.len()],
        },
    }
}
