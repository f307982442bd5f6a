//! The model that a reconciliation extends: a file, a gain, or a base that is fitted to the records; and fitted once more where
//! that is all that was missing.

use super::Args;
use super::records::{at_rest_of_runs, fitted, with_camera_delay};
use crate::commands::base::{self, Base};
use crate::commands::identify::HoldKind;
use crate::outcome::Failure;
use cellpos_experiment::collect::refused;
use cellpos_ident::base::{Form, Series};
use cellpos_ident::sampled::Hold;
use cellpos_plant::Model;
use cellpos_reconcile::{Options, Reconciliation, Record, Verdict, reconcile};

/// Records, and what is known of them.
pub(super) struct Data<'a> {
    pub records: &'a [Record],
    /// Where the beads of run folders rested, um.
    pub rests_um: &'a [f64],
    /// Whether all of them are run folders.
    pub of_runs: bool,
}

/// The model to extend; says in `options` how its records are to be taken.
pub(super) fn model_of(
    args: &Args,
    data: &Data<'_>,
    options: &mut Options,
) -> Result<Model, Failure> {
    if args.model == "fit" && args.base.is_none() {
        options.interpolated_input = true;
        options.free_gain = true;
        return fitted(data.records);
    }
    let mut model = match args.base {
        Some(form) => {
            let hold = args.hold.unwrap_or(HoldKind::ZeroOrder);
            let base = fit(data.records, base::hold_of(hold), form)?;
            for line in base.words().lines() {
                tracing::info!("{line}");
            }
            for advice in &base.advice {
                tracing::warn!("{advice}");
            }
            base.model()?
        }
        None => Model::load(&args.model).map_err(Failure::input)?,
    };
    // A model of other data says how its input was sampled; such a plant need not have rested before a record.
    let stated = model.provenance.get(base::HOLD).cloned();
    options.free_start = stated.is_some();
    options.interpolated_input = match args.hold {
        Some(hold) => hold == HoldKind::None,
        None => stated.as_deref() == Some("none"),
    };
    at_rest_of_runs(&mut model, data.records, data.rests_um);
    if data.of_runs {
        with_camera_delay(&mut model);
    }
    Ok(model)
}

fn fit(records: &[Record], hold: Hold, form: Form) -> Result<Base, Failure> {
    let rate_hz = base::common_rate(records.iter().map(|r| 1.0 / r.sample_s))?;
    let series: Vec<Series> = (records.iter())
        .map(|r| Series {
            input: r.pzt_um.clone(),
            output: r.bead_um.clone(),
        })
        .collect();
    base::fit(&series, rate_hz, hold, Some(form), form.order)
}

/// Part of what an effect closes, beyond which the base itself, fitted again, is what was wrong.
const LEAST_PART: f64 = 0.8;

/// Reconciles; where an effect is named and the base model of these data, fitted again to these records with the same form, closes
/// as much without any effect, the base was what was off, and the records are looked at again with that one.
///
/// # Errors
/// Records or a model about which no verdict is possible.
pub(super) fn reconcile_or_refit(
    model: &Model,
    records: &[Record],
    options: &Options,
    progress: &mut dyn FnMut(&str),
) -> Result<Reconciliation, Failure> {
    let found = reconcile(model, records, options, progress).map_err(refused)?;
    let named = matches!(
        found.verdict,
        Verdict::Named | Verdict::NamedWithRemainder | Verdict::Ambiguous
    );
    let Some(form) = base::form_of(model).filter(|_| named && options.free_start) else {
        return Ok(found);
    };
    let hold = match options.interpolated_input {
        true => Hold::None,
        false => Hold::ZeroOrder,
    };
    let Ok(again) = fit(records, hold, form) else {
        return Ok(found);
    };
    let mut again = again.model()?;
    // Effects that the model had besides its delay stay.
    for effect in &model.effects {
        if effect.id() != "time-delay" {
            again = again.with_effect(effect.clone());
        }
    }
    again.noise = model.noise;
    progress("the base model, fitted again to these records");
    let alone = Options {
        max_effects: 0,
        ..options.clone()
    };
    let Ok(without) = reconcile(&again, records, &alone, progress) else {
        return Ok(found);
    };
    let closed = |left: f64| found.gap.before.powi(2) - left.powi(2);
    if closed(without.gap.after) < LEAST_PART * closed(found.gap.after) {
        return Ok(found);
    }
    let mut result = reconcile(&again, records, options, progress).map_err(refused)?;
    let names: Vec<&str> = found.effects.iter().map(|e| e.id.as_str()).collect();
    result.places.push(format!(
        "the base model itself was off: fitted again to these records with the same form ({form}) it closes {:.0} % of what {} would close, \
         so that is no name; plant now num {:?}, den {:?}",
        100.0 * closed(without.gap.after) / closed(found.gap.after),
        names.join(" + "),
        again.plant.num(),
        again.plant.den(),
    ));
    Ok(result)
}
