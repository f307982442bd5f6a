//! A rig opened for a run, with all findings that `cellpos rig check` has about it.

use crate::outcome::Failure;
use cellpos_session::{Options, Rig, RigFile};
use cellpos_workbench::check::{self, Finding, Weight};
use std::path::Path;

/// Opens a rig whose file was read from `path` (none: the emulated rig as it is). Contradictions within the file are reported
/// before a device is opened, those between file and frames before anything moves. An error ends the command, unless `anyway`.
///
/// # Errors
/// As [`Rig::open`], or a finding that is an error.
pub(crate) fn open(
    file: RigFile,
    options: Options,
    path: Option<&Path>,
    anyway: bool,
) -> Result<Rig, Failure> {
    /// Some hundred frames.
    const LOOK_NS: i64 = 300_000_000;
    let Some(path) = path else {
        return Rig::open(file, options);
    };
    before_a_run(&check::findings(&file, path), path, anyway)?;
    let mut rig = Rig::open(file, options)?;
    // An emulated camera matches its table.
    if !rig.file().is_emulated() {
        let seen = rig.look(LOOK_NS)?;
        before_a_run(&check::of_frames(rig.file(), &seen, path), path, anyway)?;
    }
    Ok(rig)
}

/// Check of a run before anything moves: warnings are printed, an error ends it unless `anyway`.
fn before_a_run(findings: &[Finding], path: &Path, anyway: bool) -> Result<(), Failure> {
    let place = |finding: &Finding| {
        let line = finding
            .line
            .map_or(String::new(), |line| format!(":{line}"));
        format!("{}{line}: {}", path.display(), finding.what)
    };
    let errors: Vec<&Finding> = findings
        .iter()
        .filter(|f| f.weight == Weight::Error)
        .collect();
    for finding in findings
        .iter()
        .filter(|f| anyway || f.weight == Weight::Warning)
    {
        tracing::warn!("{}; {}", place(finding), finding.remedy);
    }
    match errors.first() {
        Some(first) if !anyway => {
            let all: Vec<String> = errors.iter().map(|finding| place(finding)).collect();
            Err(Failure::bad_input(
                all.join("\n"),
                format!("{}; --anyway runs all the same", first.remedy),
            ))
        }
        _ => Ok(()),
    }
}
