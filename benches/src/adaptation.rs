//! A loop that holds a bead while the plant changes: its error against the bound of the plant in force, and its margins there.

use cellpos_control::design::{DesignPlant, bound_rms_um, margins};
use cellpos_control::*;

/// What the plant becomes, over the design's.
#[derive(Debug, Clone, Copy)]
pub struct Regime {
    /// Gain.
    pub gain: f64,
    /// Samples by which fixes are older than they are said to be.
    pub late_ticks: u32,
    /// Time over which the gain drifts there, s; 0: at once.
    pub drift_s: f64,
}

/// How a loop does in a regime.
#[derive(Debug, Clone, Copy)]
pub struct Row {
    /// True hold error from 5 s after the change on, over the lowest possible on that plant.
    pub over_bound: f64,
    /// Ms of the law in force on that plant, the largest at a few times from 5 s after the change on.
    pub ms: f64,
    /// Largest error from the change on, um.
    pub peak_um: f64,
    /// State of adaptation at the end.
    pub adaptation: Option<Adaptation>,
}

/// Time to adapt and time measured, s.
const ADAPT_S: f64 = 5.0;
const MEASURE_S: f64 = 10.0;

/// Gains of the spread.
const GAINS: [f64; 5] = [0.5, 0.71, 1.0, 1.41, 2.0];

/// Every gain with both delays, in an order by the seed; every other way is a drift.
pub fn regimes(seed: u64) -> Vec<Regime> {
    let mut order: Vec<(f64, u32)> = GAINS.iter().flat_map(|g| [(*g, 0), (*g, 1)]).collect();
    // A linear congruential generator (Knuth's) is random enough for an order.
    let mut state = seed
        .wrapping_mul(2_862_933_555_777_941_757)
        .wrapping_add(3_037_000_493);
    for last in (1..order.len()).rev() {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        order.swap(last, ((state >> 33) % (last as u64 + 1)) as usize);
    }
    let drift = |k: usize| {
        if (k + seed as usize).is_multiple_of(2) {
            20.0
        } else {
            0.0
        }
    };
    let regime = |(k, (gain, late_ticks))| Regime {
        gain,
        late_ticks,
        drift_s: drift(k),
    };
    order.into_iter().enumerate().map(regime).collect()
}

/// Ms of the linear equivalent of a law tuned to `gain` and `delay` more samples, on a plant of `regime`; infinite if unstable.
pub fn effective_ms(config: &LoopConfig, gain: f64, delay_samples: f64, regime: Regime) -> f64 {
    let ts = config.model.sample_time_s;
    let model = LoopModel {
        delay_s: config.model.delay_s + delay_samples * ts,
        ..config.model
    };
    let law = (config.controller)
        .linear(&config.estimator, &model)
        .expect("a law for a delay that was tried");
    let plant = DesignPlant {
        sample_time_s: ts,
        delay_s: config.model.delay_s,
        ..DesignPlant::eq6(2.5e-3)
    };
    let plant = plant
        .changed(regime.gain / gain, regime.late_ticks)
        .expect("a gain above 0");
    let margins = margins(&plant, &law).expect("a plant that can be sampled");
    if margins.stable {
        margins.ms
    } else {
        f64::INFINITY
    }
}

/// Holds a bead through the regimes, one after the other.
///
/// # Panics
/// A loop or a rig that cannot be built: a defect.
pub fn hold_through(config: LoopConfig, rig: RigConfig, regimes: &[Regime]) -> Vec<Row> {
    let ts = config.model.sample_time_s;
    let d_um2_per_s = rig.diffusion_um2_per_s;
    let mut rig = SimulatedRig::new(rig).expect("a sound rig");
    let mut controller = Controller::new(config).expect("a sound controller");
    controller.start(20.0, 20.0);
    let preview = vec![0.0; controller.preview_len()];
    let mut gain = 1.0;
    let ticks = |s: f64| (s / ts).round() as u64;
    let mut rows = Vec::new();
    for regime in regimes {
        let from = gain;
        let drift = ticks(regime.drift_s);
        let (settled, end) = (drift + ticks(ADAPT_S), drift + ticks(ADAPT_S + MEASURE_S));
        let (mut peak_um, mut squares, mut ms) = (0.0_f64, 0.0, 0.0_f64);
        for tick in 0..end {
            gain = if tick < drift {
                from * (regime.gain / from).powf(tick as f64 / drift as f64)
            } else {
                regime.gain
            };
            rig.gain = gain;
            rig.late_ticks = regime.late_ticks as usize;
            let error_um = rig.true_um();
            peak_um = peak_um.max(error_um.abs());
            let input = LoopInput {
                measurement: Some(rig.measure()),
                preview_um: &preview,
                ..LoopInput::default()
            };
            rig.advance(controller.step(&input).command_um);
            if tick >= settled {
                squares += error_um * error_um;
                if (tick - settled) % ticks(1.0) == 0 {
                    let now = controller.adaptation();
                    let (gain, delay) = now.map_or((1.0, 0.0), |a| (a.gain, a.delay_samples));
                    ms = ms.max(effective_ms(&config, gain, delay, *regime));
                }
            }
        }
        let delay_s = config.model.delay_s + f64::from(regime.late_ticks) * ts;
        let rms_um = (squares / (end - settled) as f64).sqrt();
        rows.push(Row {
            over_bound: rms_um / bound_rms_um(d_um2_per_s, 0.0, delay_s, ts),
            ms,
            peak_um,
            adaptation: controller.adaptation(),
        });
    }
    rows
}
