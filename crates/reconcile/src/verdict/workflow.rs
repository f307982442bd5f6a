//! The workflow: guards, null model, search, held-out check.

use crate::data::coloured::NoiseKind;
use crate::data::estimate::FloorSource;
use crate::data::floor;
use crate::data::frames;
use crate::data::motion::ZeroFlow;
use crate::data::noise::NoiseModel;
use crate::data::record::{Record, canonical};
use crate::error::ReconcileError;
use crate::fit::context::{Context, Fit};
use crate::fit::locking;
use crate::model_error;
use crate::problem::{Errors, Problem};
use crate::search::cost::{gap, left_over};
use crate::search::effort::Effort;
use crate::search::found::Found;
use crate::search::sequential::{ids, settle};
use crate::simulate::{Base, Zpk};
use crate::thresholds::THRESHOLDS;
use crate::units::{Scales, Units};
use crate::verdict::assemble;
use crate::verdict::augment::COLOURED;
use crate::verdict::form::{self, Aside};
use crate::verdict::guard;
use crate::verdict::held_out::{self, HeldOut};
use crate::verdict::judge;
use crate::verdict::result::Reconciliation;
use crate::verdict::searching::{Searched, Searching};
use crate::verdict::small;
use crate::verdict::split;
use cellpos_plant::Model;
use cellpos_plant::effects::Scope;

/// The work that a search is given: advances of one mode of the plant by one step. About 20 s of one processor of 2020.
pub const WORK: f64 = 1.5e10;

/// How to run.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Threads for candidates; the result does not depend on it.
    pub threads: usize,
    /// Most effects to add.
    pub max_effects: usize,
    /// The command is an analogue signal sampled together with the output, not held between rows.
    pub interpolated_input: bool,
    /// The base model is a constant gain fitted to these records, of a bare actuator and its displacement sensor. So the gain is
    /// free in every fit, the null included, and effects of the chip and of the bead are not looked for.
    pub free_gain: bool,
    /// The plant need not have rested at its working point before a record: its transients are free in every record.
    pub free_start: bool,
    /// The working point was taken from these records. An error of it makes a ramp of a bead's position, which is free in every
    /// record, and no flow is named for it.
    pub free_working_point: bool,
    /// Work of simulations after which the search looks for no further effect, and says so; in units of [`WORK`].
    pub work: f64,
    /// The noise that the records are taken to have.
    pub noise: NoiseKind,
    /// Units of the records, and of the results.
    pub units: Units,
    /// Ids of the user's effects to look for next to the catalogue; others that a model file has defined are simulated and not
    /// looked for.
    pub own_effects: Vec<&'static str>,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            threads: 2,
            max_effects: 4,
            work: 1.0,
            noise: NoiseKind::Auto,
            interpolated_input: false,
            free_gain: false,
            free_start: false,
            free_working_point: false,
            units: Units::default(),
            own_effects: Vec::new(),
        }
    }
}

/// Finds and names the effects that a model lacks, and adds them.
///
/// `progress` receives sentences on the work. The result depends only on the model, the records and the options. The order of the
/// records and the number of threads change nothing, and a record cut in two is joined again.
///
/// # Errors
/// Records or a model about which no verdict is possible: see [`ReconcileError`].
pub fn reconcile(
    model: &Model,
    records: &[Record],
    options: &Options,
    progress: &mut dyn FnMut(&str),
) -> Result<Reconciliation, ReconcileError> {
    let foreign = options.free_start || options.free_gain;
    let scales = Scales::of(records, &options.units, foreign);
    let mut result = within(model, records, options, &scales, progress)?;
    result.tell(&scales);
    Ok(result)
}

/// The workflow, with records of other units at the size of this rig's.
fn within(
    given: &Model,
    records: &[Record],
    options: &Options,
    scales: &Scales,
    progress: &mut dyn FnMut(&str),
) -> Result<Reconciliation, ReconcileError> {
    let model = &scales.model(given)?;
    let as_given = records;
    let records = canonical(scales.records(records));
    guard::records(&records, !options.free_start && !options.free_gain)?;
    if !options.free_start {
        guard::working_point(as_given, given.working_point_um)?;
    }
    let frames = frames::count(&records, !options.free_start && !options.free_gain);
    let none: Vec<Vec<bool>> = records.iter().map(|r| vec![false; r.rows()]).collect();
    let repeated = if frames.repeats_named() {
        &frames.repeated
    } else {
        &none
    };
    let base = base_of(model, &records, options)?;
    let scope = scope_of(model, &records, &base, scales);
    let stated = stated_noise(model, base.sample_s);
    let start = stated.unwrap_or_else(|| NoiseModel::new(0.33, base.sample_s, 0.03));
    let errors = errors_of(model, &base);
    let problem = Problem::new(base, &records, repeated, start, errors);
    let present = problem.present();
    let searching = Searching {
        model,
        scope,
        fixed: &model.effects,
        own_effects: &options.own_effects,
        free_gain: options.free_gain,
        kind: options.noise,
        scales,
    };

    progress("null model and noise floor");
    let first = searching
        .context(&problem, 0)
        .fit(Vec::new(), &problem.all(), 4);
    let residual = free_of_start(&searching.context(&problem, 0), &first);
    // Brownian motion of a bead is a walk; coloured noise is that of a sensor.
    let of_bead = model.noise.diffusion_um2_per_s > 0.0 && !options.free_start;
    let kind = match options.noise {
        NoiseKind::Auto if of_bead => NoiseKind::Walk,
        kind => kind,
    };
    let floor = floor::estimate(&records, &present, &residual, stated, kind);
    let problem = problem.with_noise(floor.noise);
    let unlike = guard::motion(&searching.context(&beside_any_flow(&searching, &problem), 0))?;

    let effort = Effort {
        threads: options.threads,
        // Without a floor no set gets a name: one effect is enough to say how the rest looks.
        max_effects: if floor.source.is_known() {
            options.max_effects
        } else {
            options.max_effects.min(1)
        },
        work: (options.work * WORK) as u64,
        to_beat: f64::INFINITY,
    };
    let (searched, by_chance) = searching.beside_chance(problem, &floor, effort, &mut *progress);
    let Searched { mut found, problem } = searched;
    let ctx = searching.context(&problem, floor.rows);
    progress(&format!(
        "held-out check (the search took {:.2} of its work)",
        problem.spent() as f64 / (options.work.max(1e-9) * WORK)
    ));
    explains_something(&mut found);
    take_back(&ctx, &mut found, effort);
    // Without a floor, or next to a model of another rig, no small effect gets a name.
    let small = floor.source.is_known() && unlike.is_none();
    let (mut held, aside) = companions(&ctx, &mut found, effort, small, progress);
    // A set that predicts rows worse than no effect at all is none.
    if held.after_um > held.before_um {
        progress(&format!(
            "{} predicts held-out data worse than the model alone: taken back",
            ids(&found.fit).join(" + ")
        ));
        found.fit = found.null.clone();
        found.rivals = Vec::new();
        held = held_out::check(&ctx, &found.fit, effort.threads);
    }
    found.fit.locking = (0..found.fit.parts.len())
        .map(|i| locking::refine(&ctx, &found.fit, i, options.threads))
        .collect();
    progress("map and verdict");
    let given = assemble::Given {
        model: given,
        records: &records,
        frames: &frames,
        by_chance: &by_chance,
        floor: &floor,
        threads: options.threads,
        unlike: unlike.as_deref(),
        aside: &aside,
    };
    Ok(assemble::assemble(&given, &ctx, found, held))
}

/// Removes companions that only replace the form of the others. If there are none, adds (`small`) the small effects. Makes the
/// held-out check of the final set.
fn companions(
    ctx: &Context<'_>,
    found: &mut Found,
    effort: Effort,
    small: bool,
    progress: &mut dyn FnMut(&str),
) -> (HeldOut, Aside) {
    let held = confirmed(ctx, found, effort.threads, progress);
    let count = found.fit.parts.len();
    let aside = form::set_aside(ctx, found, effort.threads);
    if small && aside.companions.is_empty() && !found.cut_short {
        small::add(ctx, found, effort, progress);
    }
    if found.fit.parts.len() == count {
        return (held, aside);
    }
    (confirmed(ctx, found, effort.threads, progress), aside)
}

/// Takes back what does not help where it was not fitted: it is not named.
fn confirmed(
    ctx: &Context<'_>,
    found: &mut Found,
    threads: usize,
    progress: &mut dyn FnMut(&str),
) -> HeldOut {
    const SCATTERS: &str = "differs too much between parts of the records";
    loop {
        let held = held_out::check(ctx, &found.fit, threads);
        let scattered = || Some((split::scattered(ctx, &found.fit, threads)?, SCATTERS));
        let unconfirmed = held
            .unconfirmed
            .first()
            .map(|i| (*i, "does not hold on held-out data"));
        let Some((i, why)) = unconfirmed.or_else(scattered) else {
            return held;
        };
        progress(&format!("{} {why}: taken back", ids(&found.fit)[i]));
        let mut parts = found.fit.parts.clone();
        parts.remove(i);
        let without = ctx.fit(parts, &ctx.problem.all(), 12);
        found.lose(ctx, i, without, threads);
    }
}

/// The problem with a zero flow as large as the commands, of a plant that integrates: slow motion then says nothing of the response.
fn beside_any_flow(searching: &Searching<'_>, problem: &Problem) -> Problem {
    let base = &problem.base;
    if base.free_start || !searching.context(problem, 0).integrates() {
        return problem.clone();
    }
    let motion_um = searching.scope.stroke_um * base.speed_per_um() * base.sample_s;
    problem.clone().with_noise(NoiseModel {
        zero_flow: Some(ZeroFlow {
            motion_um2: motion_um * motion_um,
            time_rows: searching.scope.length_s / base.sample_s,
            drift_um: 0.0,
            loss: None,
        }),
        coloured: None,
        ..problem.noise
    })
}

/// The noise that a model states, unless it says that its figures are a fit's own residual.
fn stated_noise(model: &Model, sample_s: f64) -> Option<NoiseModel> {
    let noise = &model.noise;
    let guessed = model
        .provenance
        .get("noise")
        .is_some_and(|w| w == FloorSource::Unknown.words());
    let some = noise.diffusion_um2_per_s > 0.0 || noise.localisation_um > 0.0;
    let coloured = model.provenance.contains_key(COLOURED);
    (some && !guessed && !coloured)
        .then(|| NoiseModel::new(noise.diffusion_um2_per_s, sample_s, noise.localisation_um))
}

/// Raw residuals without the response to an unknown state at the start.
fn free_of_start(ctx: &Context<'_>, fit: &Fit) -> Vec<Vec<f64>> {
    let (residual, _) = ctx.residual(fit);
    if !ctx.problem.base.free_start {
        return residual;
    }
    ctx.problem
        .records
        .iter()
        .zip(residual)
        .map(|(r, e)| r.without_start(&e, false))
        .collect()
}

/// Takes back the whole set if there is nothing to explain. Without it the records are then no further from the model than the
/// noise, and the set gains less than a term that counts as left over.
fn explains_something(found: &mut Found) {
    let excess = found.null.chi2 - found.null.count as f64;
    let gained = found.null.chi2 - found.fit.chi2;
    if excess <= 0.0 && gained < THRESHOLDS.term_least {
        found.fit = found.null.clone();
        found.rivals = Vec::new();
    }
}

/// Removes effects that are too small or at a bound.
fn take_back(ctx: &Context<'_>, found: &mut Found, effort: Effort) {
    drop_small(ctx, found, effort.threads);
    drop_bound(ctx, found, effort);
}

/// Removes effects too small to matter if others explain the rest.
fn drop_small(ctx: &Context<'_>, found: &mut Found, threads: usize) {
    let all = ctx.problem.all();
    let mut i = 0;
    while i < found.fit.parts.len() {
        if found.fit.parts[i].matters() {
            i += 1;
            continue;
        }
        let without = ctx.fit_without(&found.fit, i, &all, 8);
        let gained = (found.null.chi2 - found.fit.chi2).max(1e-12);
        if (without.chi2 - found.fit.chi2) / gained > THRESHOLDS.small_share {
            i += 1;
            continue;
        }
        found.lose(ctx, i, without, threads);
    }
}

/// Removes a part that stopped at a bound if the set is complete without it. Such a part took up the residual that the equations
/// of the others leave, because they are not exactly nature's. If the set is not complete, the part stays, and there is no name.
fn drop_bound(ctx: &Context<'_>, found: &mut Found, effort: Effort) {
    let all = ctx.problem.all();
    while found.fit.parts.len() > 1
        && let Some((i, _)) = judge::first_at_bound(ctx, &found.fit)
    {
        let without = ctx.fit_without(&found.fit, i, &all, 12);
        let open = 1.0 - THRESHOLDS.closed_whole;
        if left_over(&without) > open * gap(&found.null) {
            return;
        }
        (found.fit, found.rivals) = settle(ctx, without, None, &all, effort);
    }
}

fn base_of(model: &Model, records: &[Record], options: &Options) -> Result<Base, ReconcileError> {
    let zpk = Zpk::of(&model.plant);
    if zpk.poles.iter().any(|p| p.re > 1e-6) {
        return Err(ReconcileError::Model(
            "the plant is unstable: a free run of it cannot be compared with a record".to_owned(),
        ));
    }
    Ok(Base {
        zpk,
        working_point_um: model.working_point_um,
        sample_s: records[0].sample_s,
        interpolated_input: options.interpolated_input,
        free_start: options.free_start,
        free_working_point: options.free_working_point,
        frame_age_s: model.frame_age_s,
    })
}

/// The model and its stated error. The plant of other data was fitted without a prior of its input: its covariance is that of the fit alone.
fn errors_of(model: &Model, base: &Base) -> Errors {
    let off = match base.free_start {
        true => Vec::new(),
        false => model_error::off_by_a_step(model),
    };
    let of = |model: &Model| {
        let base = Base {
            zpk: Zpk::of(&model.plant),
            ..base.clone()
        };
        (base, model.effects.clone())
    };
    Errors(std::iter::once(model).chain(&off).map(of).collect())
}

fn scope_of(model: &Model, records: &[Record], base: &Base, scales: &Scales) -> Scope {
    let (low, high) = records
        .iter()
        .map(Record::pzt_range_um)
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), (c, d)| {
            (a.min(c), b.max(d))
        });
    let w = model.working_point_um;
    Scope {
        working_point_um: w,
        low_um: low,
        high_um: high,
        // A sampled analogue input starts anywhere; what counts are the swings.
        stroke_um: if base.interpolated_input {
            (0.5 * (high - low)).max(1e-6)
        } else {
            (high - w).abs().max((w - low).abs()).max(1e-6)
        },
        travel_um: records.iter().map(Record::travel_um).fold(1e-6, f64::max),
        sample_s: base.sample_s,
        length_s: records.iter().map(Record::duration_s).fold(0.0, f64::max),
        sampled_input: base.interpolated_input,
        per_unit: scales.per_unit(),
    }
}
