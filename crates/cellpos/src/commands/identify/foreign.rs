//! `cellpos identify --data` and `--response`: anybody's records.

use super::{Args, HoldKind};
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use cellpos_ident::foreign::{Basis, ForeignSettings};
use cellpos_workbench::foreign::base::Base;
use cellpos_workbench::foreign::columns::Wanted;
use cellpos_workbench::foreign::form::Asked;
use cellpos_workbench::foreign::summary::{self, judge};
use cellpos_workbench::foreign::{response, sources};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Runs the command on a measured response.
pub(super) fn run_response(args: &Args, path: &Path) -> CommandResult {
    let asked = args.base.and_then(Asked::form);
    let found = response::fit(path, asked, usize::from(args.order), args.hold.into())?;
    if let Some(out) = &args.out {
        crate::output::write(out, &found.model.to_toml_string())?;
    }
    if args.json {
        print_json(&found.to_json(path))?;
    } else {
        print_text(&found.words(path))?;
    }
    Ok(Outcome::Done)
}

/// Runs the command on records.
pub(super) fn run(args: &Args) -> CommandResult {
    let (hold, most_order) = (args.hold.into(), usize::from(args.order));
    let foreign = args.input.is_some();
    let stated = (args.input.as_deref()).map(|input| Wanted {
        input,
        output: args.output.as_deref(),
        time: args.time_column.as_deref(),
        rate: args.rate,
        factors: [1.0, 1.0],
        rows: args.rows.as_deref(),
        held: args.hold == HoldKind::ZeroOrder,
    });
    let mut results = Vec::new();
    let mut sources = Vec::new();
    for path in &args.data {
        for source in sources::read(path, stated.as_ref())? {
            let settings = ForeignSettings {
                rate_hz: source.rate_hz,
                most_order,
                hold,
            };
            let result = judge(&source, foreign, &settings);
            // A record without a spectrum can still have a model in time.
            match result {
                Ok(result) => results.push((PathBuf::from(&source.name), result)),
                Err(e) if !foreign => {
                    return Err(Failure::bad_input(
                        format!("{}: {e}", source.name),
                        "check --input, --output and --rate, or give a longer record",
                    ));
                }
                Err(e) => tracing::warn!("{}: no frequency response: {e}", source.name),
            }
            sources.push(source);
        }
    }
    let of = (hold, most_order);
    let base = summary::base_of(args.base, foreign, of, &sources, &results)?;
    let model = summary::model(base.as_ref(), &sources, &results)?;
    if let Some(path) = &args.out {
        match &model {
            Some(model) => crate::output::write(path, &model.to_toml_string())?,
            None => eprintln!(
                "WARNING: {}: not written, there is no model",
                path.display()
            ),
        }
    }
    if let Some(path) = &args.report {
        summary::report(&results, base.as_ref())
            .write_with_figures(path)
            .map_err(Failure::failed)?;
    }
    if args.json {
        let files: Vec<Value> = results
            .iter()
            .map(|(p, r)| summary::to_json(p, r))
            .collect();
        print_json(&json!({ "files": files, "base": base.as_ref().map(Base::to_json) }))?;
    } else {
        let mut text: String = (results.iter())
            .map(|(p, r)| summary::to_text(p, r, base.is_none()))
            .collect();
        text += &base.as_ref().map(Base::words).unwrap_or_default();
        print_text(&text)?;
    }
    // A record that says nothing of the plant is no success, nor is a model asked for and not there.
    let silent = results
        .iter()
        .any(|(_, r)| matches!(r.basis, Basis::Nothing { .. }));
    Ok(if silent || (args.out.is_some() && model.is_none()) {
        Outcome::Broken
    } else {
        Outcome::Done
    })
}
