//! The model that a reconciliation extends: a file, a gain, or a base fitted to the records. The base is fitted again if that
//! explains the difference.

use super::records::{at_rest_of_records, fitted, of_own_rig, with_camera_delay};
use crate::commands::identify::HoldKind;
use crate::commands::simulate::response;
use crate::outcome::Failure;
use cellpos_ident::base::{Form, Series};
use cellpos_ident::sampled::Hold;
use cellpos_plant::effects::Action;
use cellpos_plant::{
    Effect, Model, Noise, Place, Sampled, SimulateOptions, TransferFunction, simulate,
};
use cellpos_reconcile::{Options, Reconciliation, Record, Verdict, reconcile};
use cellpos_workbench::experiment::collect::refused;
use cellpos_workbench::foreign::base::{self, Base};
use cellpos_workbench::foreign::form;

/// Records and their properties.
pub(super) struct Data<'a> {
    pub records: &'a [Record],
    /// Where the beads of run folders rested, um.
    pub rests_um: &'a [f64],
}

/// The model that is asked for.
pub(super) struct Asked<'a> {
    /// A name, a file, or `fit`.
    pub model: &'a str,
    /// The form of the base that replaces it.
    pub base: Option<form::Asked>,
    /// How the command acts between rows.
    pub hold: Option<HoldKind>,
}

/// The model to extend; says in `options` how its records are to be taken.
pub(super) fn model_of(
    args: &Asked<'_>,
    data: &Data<'_>,
    options: &mut Options,
) -> Result<Model, Failure> {
    if args.model == "fit" && args.base.is_none() {
        options.interpolated_input = true;
        options.free_gain = true;
        return fitted(data.records);
    }
    let mut model = match args.base {
        Some(asked) => {
            let hold = args.hold.unwrap_or(HoldKind::ZeroOrder);
            let base = fit(data.records, &[], hold.into(), asked.form())?;
            for line in base.words().lines() {
                tracing::info!("{line}");
            }
            for advice in &base.advice {
                tracing::warn!("{advice}");
            }
            base.model()?
        }
        None => Model::load(args.model).map_err(Failure::input)?,
    };
    // A model of other data says how its input was sampled; such a plant need not have rested before a record.
    let stated = model.provenance.get(base::HOLD).cloned();
    options.free_start = stated.is_some();
    options.interpolated_input = match args.hold {
        Some(hold) => hold == HoldKind::None,
        None => stated.as_deref() == Some("none"),
    };
    // A rig's own records move what rests on it; the fit of another plant to its data does not.
    let bead = !options.free_start && args.base.is_none();
    options.free_working_point = at_rest_of_records(&mut model, data.records, data.rests_um, bead);
    // Where there is no record yet, one of the rig is to be collected.
    if data.records.is_empty() || of_own_rig(data.records) {
        with_camera_delay(&mut model);
    }
    Ok(model)
}

/// Where the output stands while the model's is zero: of a model that was extended it is no longer where the base had it.
pub(super) fn put_output_at_rest(
    model: &mut Model,
    records: &[Record],
    options: &Options,
) -> Result<(), Failure> {
    /// Part of a record in which its start still shows.
    const START: usize = 5;
    if !model.provenance.contains_key(base::REST_OUTPUT) {
        return Ok(());
    }
    let (mut sum, mut count) = (0.0, 0.0);
    for r in records {
        let plain = SimulateOptions::default();
        let held = !options.interpolated_input;
        let simulated = response(model, &r.pzt_um, r.sample_s, held, &plain)?;
        let from = r.rows() / START;
        for (y, s) in r.bead_um.iter().zip(&simulated).skip(from) {
            if y.is_finite() && s.is_finite() {
                (sum, count) = (sum + y - s, count + 1.0);
            }
        }
    }
    if count > 0.0 {
        let rest = sum / count;
        (model.provenance).insert(base::REST_OUTPUT.to_owned(), rest.to_string());
    }
    Ok(())
}

/// Fits a base behind known effects on its input (`ahead`, row by row of every record; none without effects).
fn fit(
    records: &[Record],
    ahead: &[Vec<f64>],
    hold: Hold,
    form: Option<Form>,
) -> Result<Base, Failure> {
    let rate_hz = base::common_rate(records.iter().map(|r| 1.0 / r.sample_s))?;
    let series: Vec<Series> = (records.iter().enumerate())
        .map(|(i, r)| Series {
            input: ahead.get(i).unwrap_or(&r.pzt_um).clone(),
            output: r.bead_um.clone(),
        })
        .collect();
    let most = form.map_or(form::MOST_ORDER, |form| form.order);
    base::fit(&series, rate_hz, hold, form, most)
}

/// Most times that the base is fitted again.
const ROUNDS: usize = 3;

/// Reconciles. The base was fitted to these records without the named effects, so a linear effect among them may only correct
/// that fit. Therefore the base is fitted again, in the same form, to the input behind the other effects. Then the search runs
/// once more. What is then not needed any longer was no effect.
///
/// # Errors
/// Records or a model about which no verdict is possible.
pub(super) fn reconcile_or_refit(
    model: &Model,
    records: &[Record],
    options: &Options,
    progress: &mut dyn FnMut(&str),
) -> Result<Reconciliation, Failure> {
    let mut found = reconcile(model, records, options, progress).map_err(refused)?;
    // A base that comes from other records has not bent to what is missing in these: what is linear there is a change, and a name.
    let bent = |r: &Record| base::was_fitted_to(model, &r.pzt_um);
    let own = options.free_start && records.iter().any(bent);
    let Some(form) = base::form_of(model).filter(|_| own) else {
        return Ok(found);
    };
    let mut present = model.clone();
    let mut gone: Vec<String> = Vec::new();
    for _ in 0..ROUNDS {
        let lines = linear_of(&found, &present);
        if lines.is_empty() {
            break;
        }
        progress("the base model, fitted again beside what was found");
        let Some(again) = refitted(&found, &present, records, options, form) else {
            break;
        };
        let Ok(next) = reconcile(&again, records, options, progress) else {
            break;
        };
        if has_better_formula(&next, &found) {
            let names: Vec<&str> = found.effects.iter().map(|e| e.id.as_str()).collect();
            let mut next = next;
            next.places.insert(0, format!(
                "{} are no names: beside a base that is fitted again, a formula of fewer numbers explains more than they do",
                names.join(" + ")
            ));
            return Ok(next);
        }
        if !is_simpler(&next, &found, &again, lines.len()) {
            break;
        }
        let left: Vec<&str> = next.effects.iter().map(|e| e.id.as_str()).collect();
        gone.extend(lines.into_iter().filter(|id| !left.contains(&id.as_str())));
        (found, present) = (next, again);
    }
    if let Some(instead) = of_a_richer_base(&found, &present, records, options, form, progress) {
        return Ok(instead);
    }
    if !gone.is_empty() {
        found.places.push(format!(
            "the base model itself was off: fitted again with the same form ({form}) it needs no {}, so that is no name; the plant is now num {:?}, den {:?}",
            gone.join(", "),
            present.plant.num(),
            present.plant.den(),
        ));
    }
    Ok(found)
}

/// The result with a base of one more pole or delay, if that needs fewer linear effects. If the base was fitted to these records
/// in a stated form, such effects only show that the form is too small; they are not names.
fn of_a_richer_base(
    found: &Reconciliation,
    present: &Model,
    records: &[Record],
    options: &Options,
    form: Form,
    progress: &mut dyn FnMut(&str),
) -> Option<Reconciliation> {
    let lines = linear_of(found, present);
    if lines.is_empty() {
        return None;
    }
    for richer in form::richer(form) {
        progress(&format!("beside a base of {richer}"));
        let Some(again) = refitted(found, present, records, options, richer) else {
            continue;
        };
        let Ok(mut next) = reconcile(&again, records, options, progress) else {
            continue;
        };
        if is_simpler(&next, found, &again, lines.len()) {
            next.places.insert(0, format!(
                "the base is too poor: beside {form} there would be {}; beside {richer} these records need no such effect, so that is no name; state --base {richer}, or leave the form open; the plant is now num {:?}, den {:?}",
                lines.join(", "),
                again.plant.num(),
                again.plant.den(),
            ));
            return Some(next);
        }
    }
    None
}

/// Whether a result without a name has a better formula: at most as many terms as the other result has effects, and a larger part
/// of the held-out excess explained.
fn has_better_formula(next: &Reconciliation, found: &Reconciliation) -> bool {
    let left = found.remainder.as_ref().map_or(0.0, |rest| rest.share);
    next.verdict == Verdict::Unknown
        && (next.hypothesis.as_ref()).is_some_and(|formula| {
            formula.terms.len() <= found.effects.len() && formula.held_out_worth > 1.0 - left
        })
}

/// The linear ones among the effects that were named.
fn linear_of(found: &Reconciliation, model: &Model) -> Vec<String> {
    let named = matches!(
        found.verdict,
        Verdict::Named | Verdict::NamedWithRemainder | Verdict::Ambiguous
    );
    let new = found.augmented.effects.iter().filter(|e| {
        let was = model.effect(e.id()).is_some();
        named && !was && is_linear(e)
    });
    new.map(|e| e.id().to_owned()).collect()
}

fn is_linear(effect: &Effect) -> bool {
    matches!(
        effect.act(),
        Action::Linear(_) | Action::Bypass(_) | Action::Delay(_) | Action::Exposure(_)
    )
}

/// The base fitted again behind the effects that were found before it and are not linear.
fn refitted(
    found: &Reconciliation,
    model: &Model,
    records: &[Record],
    options: &Options,
    form: Form,
) -> Option<Model> {
    let early = |e: &&Effect| {
        let spec = e.kind().spec();
        (spec.place < Place::Chip || spec.ahead_of_plant) && !is_linear(e)
    };
    let ahead = Model {
        plant: TransferFunction::new(vec![1.0], vec![1.0]).ok()?,
        working_point_um: model.working_point_um,
        effects: (found.augmented.effects.iter())
            .filter(early)
            .cloned()
            .collect(),
        noise: Noise::NONE,
        ..Model::eq6()
    };
    let mut inputs = Vec::new();
    if !ahead.effects.is_empty() {
        let after = SimulateOptions {
            sampled: Sampled::AfterCommand,
            ..SimulateOptions::default()
        };
        for r in records {
            let from_rest = simulate(&ahead, &r.pzt_um, r.sample_s, &after).ok()?;
            let input = from_rest.iter().map(|v| v + model.working_point_um);
            inputs.push(input.collect());
        }
    }
    let hold = match options.interpolated_input {
        true => Hold::None,
        false => Hold::ZeroOrder,
    };
    let mut again = fit(records, &inputs, hold, Some(form)).ok()?.model().ok()?;
    if !form.integrating || !ahead.effects.is_empty() {
        again.working_point_um = model.working_point_um;
    }
    // What the model had besides its delay stays.
    let kept = model.effects.iter().filter(|e| e.id() != "time-delay");
    again.effects.extend(kept.cloned());
    again.noise = model.noise;
    Some(again)
}

/// Whether a result needs fewer linear effects, or none, and leaves hardly more than another.
fn is_simpler(next: &Reconciliation, found: &Reconciliation, again: &Model, linear: usize) -> bool {
    let fewer = match next.verdict {
        Verdict::NothingMissing => true,
        Verdict::Unknown => false,
        _ => linear_of(next, again).len() < linear,
    };
    let closed = found.gap.before.powi(2) - found.gap.after.powi(2);
    fewer && next.gap.after.powi(2) <= found.gap.after.powi(2) + MORE_LEFT * closed.max(0.0)
}

/// Share of the closed gap that may be open again without the linear effects.
const MORE_LEFT: f64 = 0.01;
