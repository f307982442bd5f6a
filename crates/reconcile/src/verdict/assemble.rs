//! From the search to the answer: names, verdict, the gap, and the augmented model.

use crate::data::floor::Floor;
use crate::data::frames::FrameCounts;
use crate::data::record::Record;
use crate::fit::catalogue::{Part, Variant};
use crate::fit::context::{Context, Fit};
use crate::search::cost::left_over;
use crate::search::found::Found;
use crate::units::figure;
use crate::verdict::augment::augment;
use crate::verdict::counted::Counted;
use crate::verdict::form::Aside;
use crate::verdict::held_out::{self, HeldOut};
use crate::verdict::judge::{Evidence, judge};
use crate::verdict::map;
use crate::verdict::names::names;
use crate::verdict::proposal;
use crate::verdict::result::{Gap, GapStep, Interval, Reconciliation, Traces, Verdict};
use crate::verdict::searching::ByChance;
use crate::verdict::sentences::sentences;
use cellpos_plant::Model;
use std::collections::BTreeMap;

/// What a run was given.
pub(crate) struct Given<'a> {
    pub model: &'a Model,
    pub records: &'a [Record],
    pub frames: &'a FrameCounts,
    pub by_chance: &'a ByChance,
    pub floor: &'a Floor,
    pub threads: usize,
    /// What is to be said where the records hardly go with the model.
    pub unlike: Option<&'a str>,
    /// What was taken out of the names as another form of the others.
    pub aside: &'a Aside,
}

pub(crate) fn assemble(
    given: &Given<'_>,
    ctx: &Context<'_>,
    found: Found,
    held: HeldOut,
) -> Reconciliation {
    let Given {
        model,
        records,
        frames,
        by_chance,
        floor,
        threads,
        unlike,
        aside,
    } = *given;
    let Found {
        fit,
        null,
        steps,
        rivals,
        cut_short,
    } = found;
    let null_map = map::map(ctx, &null);
    let after_map = map::map(ctx, &fit);
    let mut places: Vec<String> = unlike.map(str::to_owned).into_iter().collect();
    places.extend(sentences(ctx, &null, &null_map, floor.source.is_known()));
    let names = names(ctx, &null, &fit, &rivals, threads);
    let counted = Counted::new(ctx, frames, by_chance, left_over(&null));
    let gap = gap(ctx, &held, [&null, &fit], &steps, [&null_map, &after_map]);
    let judgement = judge(
        ctx,
        &Evidence {
            null: &null,
            fit: &fit,
            names: &names,
            held: &held,
            closure: gap.closure(),
            floor,
            null_flagged: null_map.any_flagged(),
            after: &after_map,
            counted: !counted.named.is_empty(),
            cut_short,
            unweighed: rivals.len() < fit.parts.len(),
            unlike,
            aside,
        },
        threads,
    );
    let verdict = judgement.verdict;
    places.extend(counted.places);
    places.extend(judgement.reasons);
    if by_chance.wandering.is_none() {
        places.extend(slow_noise(ctx).or_else(|| zero_flow(ctx)));
    }
    if cut_short {
        places.push("the search ended with its budget of simulations, not because nothing more was to be found: --work 4 gives it four times as much".to_owned());
    }
    let named = if !verdict.names() {
        Vec::new()
    } else {
        let mut effects = names.effects;
        effects.extend(counted.named);
        effects.sort_by(|a, b| {
            b.explained
                .total_cmp(&a.explained)
                .then_with(|| a.id.cmp(&b.id))
        });
        effects
    };
    let with = |verdict| {
        let counted = &counted.of_model;
        augment(model, ctx, &fit, counted, &named, verdict, floor)
    };
    let augmented = with(verdict);
    // The same with the set that was best, whether or not it earned its names.
    let mut best = with(Verdict::NamedWithRemainder);
    best.provenance
        .insert("reconcile.verdict".to_owned(), verdict.word().to_owned());
    let traces = Traces::new(ctx, &null, &fit);
    Reconciliation {
        verdict,
        effects: named,
        places,
        gap,
        base_shift: base_shift(&fit, &held),
        proposal: judgement
            .hypothesis
            .iter()
            .flat_map(|h| proposal::of(ctx, h))
            .collect(),
        hypothesis: judgement.hypothesis,
        remainder: judgement.remainder,
        floor: floor.source,
        noise: ctx.problem.noise,
        sample_s: ctx.problem.base.sample_s,
        augmented,
        best,
        before: null_map,
        after: after_map,
        traces,
        records: records
            .iter()
            .map(|r| (r.name.clone(), r.rows(), r.frames()))
            .collect(),
    }
}

/// What is said where the noise is coloured.
fn slow_noise(ctx: &Context<'_>) -> Option<String> {
    let c = ctx.problem.noise.coloured?;
    Some(format!(
        "the noise itself is slow: {} RMS with a correlation time of {} s beside white noise of {}; errors as small and as slow are not told from it",
        ctx.scales.told(c.variance_um2.sqrt()),
        figure(c.time_rows * ctx.problem.base.sample_s),
        ctx.scales.told(ctx.problem.noise.localisation_um())
    ))
}

/// What is said where the zero flow moves: by how much displacement in a second, from the speed of the bead that it makes.
fn zero_flow(ctx: &Context<'_>) -> Option<String> {
    let z = ctx.problem.noise.zero_flow?;
    let dt = ctx.problem.base.sample_s;
    let speed_per_um = ctx.problem.base.speed_per_um();
    let speed_um_per_s = z.motion_um2.sqrt() / dt;
    let time_s = z.time_rows * dt;
    let in_a_second_um = speed_um_per_s * (2.0 / time_s).min(1.0).sqrt() / speed_per_um;
    Some(format!(
        "the zero flow moves by {} of displacement in a second: noise, and no effect",
        ctx.scales.told(in_a_second_um)
    ))
}

/// How far the gap has shrunk: fits and maps without and with the effects.
fn gap(
    ctx: &Context<'_>,
    held: &HeldOut,
    [null, fit]: [&Fit; 2],
    steps: &[(Vec<&'static str>, f64)],
    [null_map, after_map]: [&map::DiscrepancyMap; 2],
) -> Gap {
    let sigma = ctx.problem.noise.innovation_um();
    let n = null.count as f64;
    let rms = |chi2: f64| sigma * (chi2 / n).max(0.0).sqrt();
    // The noise of these rows: the residual of the full fit, if it is the floor within its error.
    let in_sample = rms(fit.chi2);
    Gap {
        before: held.before_um.hypot(rms(null.absorbed)),
        after: held.after_um,
        floor: if in_sample <= 1.01 * sigma {
            in_sample
        } else {
            sigma
        },
        free_run_before: held.free_before_um,
        free_run_after: held.free_after_um,
        free_run_floor: held.free_floor_um,
        unit: "um".to_owned(),
        quantity: "RMS innovation on held-out records",
        steps: gap_steps(ctx, null, steps, rms),
        per_record: held.per_record.clone(),
        bands: held_out::bands(null_map, after_map),
    }
}

/// The numbers that every fit moves in addition to the effects, with their intervals.
fn base_shift(fit: &Fit, held: &HeldOut) -> BTreeMap<String, Interval> {
    let edge = 1.96 * fit.errors[0];
    let share = Interval {
        value: fit.soft,
        ci95: [fit.soft - edge, fit.soft + edge],
        unit: "um/um".to_owned(),
    };
    BTreeMap::from([
        ("frame_edge_share".to_owned(), share),
        ("gain".to_owned(), held.gain_shift.clone()),
    ])
}

/// The search step by step; after the null model, the gain of a free base gain alone.
fn gap_steps(
    ctx: &Context<'_>,
    null: &Fit,
    steps: &[(Vec<&'static str>, f64)],
    rms: impl Fn(f64) -> f64,
) -> Vec<GapStep> {
    let mut out: Vec<GapStep> = steps
        .iter()
        .map(|(names, chi2)| GapStep {
            effects: names.iter().map(|s| (*s).to_owned()).collect(),
            rms: rms(*chi2),
            base_gain: None,
        })
        .collect();
    if ctx.free_gain {
        if let Some(first) = out.first_mut() {
            first.base_gain = Some(null.gain);
        }
    } else if let Some(v) = Variant::gain() {
        let parts = vec![Part::new(v, &[1.0])];
        let free = ctx.fit_from(parts, Some(null.soft), &ctx.problem.all(), 6);
        let step = GapStep {
            effects: Vec::new(),
            rms: rms(free.chi2),
            base_gain: free.parts.first().map(|p| p.natural()[0]),
        };
        out.insert(1.min(out.len()), step);
    }
    out
}
