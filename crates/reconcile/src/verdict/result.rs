//! The result of the workflow: verdict, effects, places, gap, and the data of a report.

use crate::data::estimate::FloorSource;
use crate::data::noise::NoiseModel;
use crate::fit::context::{Context, Fit};
use crate::problem::Prepared;
use crate::verdict::battery::Hypothesis;
use crate::verdict::map::DiscrepancyMap;
use cellpos_plant::Model;
use cellpos_plant::effects::Definition;
use serde::Serialize;
use std::collections::BTreeMap;

/// The five answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// Effects are named; alternatives that no record of command and position can tell apart are listed with them.
    Named,
    /// Effects are named and hold, and something remains: see [`Reconciliation::remainder`].
    NamedWithRemainder,
    /// The data cannot separate the named effect from its alternatives; `separate_by` says what would.
    Ambiguous,
    /// Beyond the floor, and nothing in the catalogue closes enough of the gap.
    Unknown,
    /// At the floor.
    NothingMissing,
}

impl Verdict {
    /// Whether effects are named with it.
    pub(crate) fn names(self) -> bool {
        !matches!(self, Self::Unknown | Self::NothingMissing)
    }

    /// The word used in JSON.
    pub fn word(self) -> &'static str {
        match self {
            Self::Named => "named",
            Self::NamedWithRemainder => "named-with-remainder",
            Self::Ambiguous => "ambiguous",
            Self::Unknown => "unknown",
            Self::NothingMissing => "nothing-missing",
        }
    }
}

/// A value with its 95 % interval.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Interval {
    /// Best value.
    pub value: f64,
    /// Low and high end of the 95 % confidence interval.
    pub ci95: [f64; 2],
    /// Unit; empty for a pure number.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub unit: String,
}

impl Interval {
    /// Widens the interval to another value that explains the records as well, as uncertain as the best.
    pub(crate) fn reach(&mut self, value: f64) {
        let [low, high] = self.ci95;
        self.ci95 = [
            low.min(value - (self.value - low)),
            high.max(value + (high - self.value)),
        ];
    }

    /// Widens the interval to hold another.
    pub(crate) fn cover(&mut self, [low, high]: [f64; 2]) {
        self.ci95 = [self.ci95[0].min(low), self.ci95[1].max(high)];
    }
}

/// One named effect.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Effect {
    /// Id of the vocabulary.
    pub id: String,
    /// Place in the chain.
    pub place: &'static str,
    /// Parameters by name.
    pub parameters: BTreeMap<String, Interval>,
    /// Probability of such a gain by chance in the whole search.
    pub p_value: f64,
    /// Part of the excess over the floor that goes away with this effect and comes back without it, 0..1.
    pub explained: f64,
    /// Ids that explain these records as well in its stead.
    pub alternatives: Vec<String>,
    /// The experiment that would tell them apart.
    pub separate_by: Option<String>,
}

/// The remainder next to the named effects.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Remainder {
    /// Where it shows.
    #[serde(rename = "where")]
    pub places: Vec<String>,
    /// A description in words.
    pub how: String,
    /// Part of the excess over the floor that is left, 0..1.
    pub share: f64,
    /// A formula for it, where one helps on data that it has not seen.
    pub formula: Option<Hypothesis>,
}

/// A step of the search.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct GapStep {
    /// The set at that step.
    pub effects: Vec<String>,
    /// RMS innovation with that set.
    pub rms: f64,
    /// The base model's gain, where it was free in that step: a factor, 1 as in the model.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub base_gain: Option<f64>,
}

/// The gap of one held-out record.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RecordGap {
    /// Record.
    pub record: String,
    /// RMS innovation of the null model \[um\].
    pub before: f64,
    /// RMS innovation of the augmented model fitted to all other records \[um\].
    pub after: f64,
    /// RMS error of the free run of the null model.
    pub free_run_before: f64,
    /// The same of the augmented model fitted to all other records.
    pub free_run_after: f64,
}

/// The gap of one band.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BandGap {
    /// Lower edge \[Hz\].
    pub low_hz: f64,
    /// Upper edge \[Hz\].
    pub high_hz: f64,
    /// RMS innovation density before, as the full-band RMS that it would give \[um\].
    pub before: f64,
    /// The same after.
    pub after: f64,
    /// The same of noise alone.
    pub floor: f64,
}

/// How far simulation and measurement are apart.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Gap {
    /// Null model, on held-out records.
    pub before: f64,
    /// Augmented model, on held-out records.
    pub after: f64,
    /// Noise alone; if [`Reconciliation::floor`] is unknown, the residual of the fit.
    pub floor: f64,
    /// RMS error of the free run of the null model on held-out records, without its start.
    pub free_run_before: f64,
    /// The same of the augmented model.
    pub free_run_after: f64,
    /// The value expected from noise alone.
    pub free_run_floor: f64,
    /// Unit of all figures of the gap.
    pub unit: String,
    /// The quantity of these figures.
    pub quantity: &'static str,
    /// The search, step by step, on all records.
    pub steps: Vec<GapStep>,
    /// Record by record.
    pub per_record: Vec<RecordGap>,
    /// Band by band, on all records.
    pub bands: Vec<BandGap>,
}

impl Gap {
    /// `1 - (after - floor)/(before - floor)`; 1 when there was no gap.
    pub fn closure(&self) -> f64 {
        let d = self.before - self.floor;
        if d <= 0.0 {
            1.0
        } else {
            1.0 - (self.after - self.floor) / d
        }
    }
}

/// Stretches of records for plotting.
#[derive(Debug, Clone, PartialEq)]
pub struct Trace {
    /// Record.
    pub record: String,
    /// Times \[s\].
    pub time_s: Vec<f64>,
    /// Measured position, NaN where missing \[um\].
    pub measured_um: Vec<f64>,
    /// Free run of the null model, moved by the level, the ramp and the start that agree best with this stretch \[um\].
    pub before_um: Vec<f64>,
    /// The same for the augmented model \[um\].
    pub after_um: Vec<f64>,
    /// Measured less this free run \[um\].
    pub residual_before_um: Vec<f64>,
    /// Free-run residual of the augmented model \[um\].
    pub residual_after_um: Vec<f64>,
}

/// All traces.
#[derive(Debug, Clone, PartialEq)]
pub struct Traces {
    /// Record by record.
    pub all: Vec<Trace>,
    /// Whether a constant error of the command becomes a ramp, which is taken off: the plant integrates.
    pub ramp: bool,
}

impl Traces {
    pub(crate) fn new(ctx: &Context<'_>, null: &Fit, fit: &Fit) -> Self {
        let sample_s = ctx.problem.base.sample_s;
        let ramp = ctx.integrates();
        let (before, _) = ctx.residual(null);
        let (after, _) = ctx.residual(fit);
        let trace = |(i, r): (usize, &Prepared)| {
            let n = r.u.len().min((4.0 / sample_s) as usize);
            let seen = |of: &dyn Fn(usize) -> f64| -> Vec<f64> {
                (0..n)
                    .map(|k| if r.present[k] { of(k) } else { f64::NAN })
                    .collect()
            };
            let (left_before, left_after) = (
                r.without_start(&before[i][..n], ramp),
                r.without_start(&after[i][..n], ramp),
            );
            Trace {
                record: r.name.clone(),
                time_s: (0..n).map(|k| k as f64 * sample_s).collect(),
                measured_um: seen(&|k| r.y[k]),
                before_um: seen(&|k| r.y[k] - left_before[k]),
                after_um: seen(&|k| r.y[k] - left_after[k]),
                residual_before_um: seen(&|k| left_before[k]),
                residual_after_um: seen(&|k| left_after[k]),
            }
        };
        Self {
            ramp,
            all: ctx.problem.records.iter().enumerate().map(trace).collect(),
        }
    }
}

/// Everything that the workflow found.
#[derive(Debug, Clone, PartialEq)]
pub struct Reconciliation {
    /// The answer.
    pub verdict: Verdict,
    /// Named effects, the one that explains most first.
    pub effects: Vec<Effect>,
    /// Where the null model fails, in sentences.
    pub places: Vec<String>,
    /// How far apart before and after.
    pub gap: Gap,
    /// Change of base parameters in addition to the effects: a free gain (1 = not at all), and the share of a command's direct
    /// path that the frame at its edge already shows.
    pub base_shift: BTreeMap<String, Interval>,
    /// A formula for what no effect explains.
    pub hypothesis: Option<Hypothesis>,
    /// The same as effects of the user's own, to be edited and run again; without lines.
    pub proposal: Vec<Definition>,
    /// The remainder next to the named effects.
    pub remainder: Option<Remainder>,
    /// Where the noise floor comes from.
    pub floor: FloorSource,
    /// Noise of these records.
    pub noise: NoiseModel,
    /// Sample time \[s\].
    pub sample_s: f64,
    /// The model with the effects added.
    pub augmented: Model,
    /// The model with the best set found, whatever the verdict says of its names. If the verdict is `unknown`, its equations
    /// predict, but are not shown to be true.
    pub best: Model,
    /// Map of the null model.
    pub before: DiscrepancyMap,
    /// Map of the augmented model.
    pub after: DiscrepancyMap,
    /// Stretches for plotting.
    pub traces: Traces,
    /// Name, rows and frames of every record.
    pub records: Vec<(String, usize, usize)>,
}

impl Reconciliation {
    /// The proposal as the text of an effects file, if there is one.
    pub fn proposal_toml(&self) -> Option<String> {
        let effects = self.proposal.iter().map(|d| d.to_toml_string("effects"));
        (!self.proposal.is_empty()).then(|| {
            format!(
                "# What the rest looks like, as effects to edit and to run again with --effects. Take out what makes no sense;\n\
                 # say what a number means by its name; let bounds be those of the thing itself.\n{}",
                effects.collect::<String>()
            )
        })
    }

    /// The JSON object for machines.
    pub fn to_json(&self) -> serde_json::Value {
        serde_json::json!({
            "verdict": self.verdict,
            "effects": self.effects,
            "where": self.places,
            "gap": self.gap,
            "base_shift": self.base_shift,
            "hypothesis": self.hypothesis,
            "effects_toml": self.proposal_toml(),
            "remainder": self.remainder,
            "floor": { "source": self.floor, "known": self.floor.is_known(), "words": self.floor.words() },
            "noise": {
                "diffusion_um2_per_s": self.noise.diffusion_um2_per_s(self.sample_s),
                "localisation_um": self.noise.localisation_um(),
                "innovation_um": self.noise.innovation_um(),
                "coloured_um": self.noise.coloured.map(|c| c.variance_um2.sqrt()),
                "coloured_s": self.noise.coloured.map(|c| c.time_rows * self.sample_s),
                "zero_flow_um_per_s": self.noise.zero_flow.map(|z| z.motion_um2.sqrt() / self.sample_s),
                "zero_flow_s": self.noise.zero_flow.map(|z| z.time_rows * self.sample_s),
            },
        })
    }
}
