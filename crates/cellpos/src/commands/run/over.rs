//! A run of a script that is over: what is written behind it, and what is said.

use super::sink::ScriptSink;
use super::{learning, resume, text};
use crate::clips;
use crate::notify::NotifyArgs;
use crate::outcome::{Failure, print_json, print_text};
use cellpos_script::{CycleRow, Plan};
use cellpos_session::clips::Clipped;
use cellpos_session::setup::Setup;
use cellpos_session::view::{View, Viewed};
use cellpos_session::words::of_what_is_followed;
use cellpos_session::{EndKind, Ended, Finished, connect};
use std::path::PathBuf;

/// A run that is over.
pub(super) struct Over {
    pub outcome: &'static str,
    pub ended: Ended,
    /// The run's folder.
    pub folder: PathBuf,
    pub cycles: Vec<CycleRow>,
    /// Whether the script came to its end and everything is on the disk.
    pub whole: bool,
}

/// What is said at the end, and where.
#[derive(Clone, Copy)]
pub(super) struct Telling<'a> {
    /// Who hears of the end besides.
    pub notify: &'a NotifyArgs,
    /// As one object.
    pub json: bool,
    /// Whether anything is printed.
    pub tell: bool,
}

/// Writes the files of a finished run and returns how it ended.
pub(super) fn conclude(
    telling: Telling<'_>,
    setup: &Setup,
    plan: &Plan,
    folder: PathBuf,
    mut warnings: Vec<String>,
    (finished, view): (Finished<Viewed<Clipped<ScriptSink>>>, Option<View>),
) -> Result<Over, Failure> {
    warnings.extend(connect::warnings(&finished));
    let Finished {
        ended,
        rig,
        mut summary,
        conditions,
        learned,
        sink,
        ..
    } = finished;
    let script = sink.within().within().end();
    let ended = match &script.row_stop {
        Some(stop) if ended.kind == EndKind::Operator => Ended::stopped(stop.seen.clone()),
        _ => ended,
    };
    let (sink, kept_clips) = sink.into_inner(&summary, &ended).into_parts();
    // First release the terminal and end the page, then print.
    drop(view);
    warnings.extend(clips::warnings(kept_clips));
    let not_kept = ended.kind == EndKind::NotKept;
    let outcome = match (ended.as_asked(), script.complete()) {
        (false, false) if not_kept && script.is_stop() => "stopped",
        (false, _) => summary.state.name(),
        (true, true) => "done",
        (true, false) if script.is_stop() => "stopped",
        (true, false) => "aborted",
    };
    let (writer, cycle_faults) = sink.close();
    if cycle_faults.rows_lost > 0 {
        warnings.push(format!(
            "{} rows of cycles.csv could not be written: {}",
            cycle_faults.rows_lost,
            cycle_faults.first.clone().unwrap_or_default()
        ));
    }
    let kept = connect::finish(
        writer,
        (outcome, &ended),
        &mut summary,
        &conditions,
        &mut warnings,
    );
    let learned = learning::named(&setup.config.motions, &learned);
    if !learned.is_empty()
        && let Err(error) = learning::save(&folder, learned.clone())
    {
        warnings.push(format!("no {}: {error}", learning::LEARNED_TOML));
    }
    let cycles = resume::cycles(&folder)?;
    if let Err(error) = resume::cycles_parquet(&folder, &cycles) {
        warnings.push(format!("no cycles.parquet: {error}"));
    }
    let said = format!("{outcome}: {}; {ended}", script.name());
    warnings.extend(telling.notify.of_a_script(outcome, &said, &folder));
    let report = text::Report::new(
        text::Ending {
            outcome,
            stage: match outcome {
                "aborted" => "by the operator",
                _ => script.name(),
            },
            ended: &ended,
            alarms: script.alarms,
            run: kept.run,
            folder: folder.display().to_string(),
        },
        &summary,
        &cycles,
        plan.cycle_count(),
        connect::bound_rms_nm(rig.file(), setup, &summary),
        &conditions,
        &warnings,
        &learned,
    );
    match (telling.tell, telling.json) {
        (false, _) => {}
        (true, true) => print_json(&report)?,
        (true, false) => {
            print_text(&of_what_is_followed(
                &report.text(),
                rig.file().follows_a_cell(),
            ))?;
        }
    }
    let whole = outcome == "done" && kept.whole && cycle_faults.rows_lost == 0;
    Ok(Over {
        outcome,
        cycles,
        folder,
        whole,
        ended,
    })
}
