//! Checks before a run that it fits on the disk.

use crate::columns::{Group, row_bytes};
use crate::error::RecordError;
use std::path::Path;

/// Room for everything but ticks, and for other programs' files meanwhile, bytes.
const BESIDE: u64 = 32 << 20;
/// Bytes that the frames of the batches add to a row.
const FRAME: u64 = 6;

/// Bytes that a run of some ticks takes at most: its columns, the same again as Parquet, and a tenth for events and cycles.
pub fn needed_bytes(ticks: u64, columns: &[Group]) -> u64 {
    let row = row_bytes(columns) as u64 + FRAME;
    let twice = ticks.saturating_mul(2 * row);
    twice.saturating_add(twice / 10).saturating_add(BESIDE)
}

/// Bytes that this user may still write below a folder, which need not exist yet; None if unknown.
pub fn free_bytes(folder: &Path) -> Option<u64> {
    let folder = std::path::absolute(folder).ok()?;
    let there = folder.ancestors().find(|folder| folder.exists())?;
    let disk = rustix::fs::statvfs(there).ok()?;
    Some(disk.f_bavail.saturating_mul(disk.f_frsize))
}

/// Refuses a run without enough room. A run without an end needs room to begin; one with a number of ticks needs room for all.
///
/// # Errors
/// [`RecordError::NoSpace`] with the needed and the free space.
pub fn check(root: &Path, ticks: Option<u64>, columns: &[Group]) -> Result<(), RecordError> {
    match free_bytes(root) {
        Some(free) => enough(root, free, ticks, columns),
        None => Ok(()),
    }
}

fn enough(
    root: &Path,
    free: u64,
    ticks: Option<u64>,
    columns: &[Group],
) -> Result<(), RecordError> {
    let needed = needed_bytes(ticks.unwrap_or(0), columns);
    if needed <= free {
        return Ok(());
    }
    Err(RecordError::NoSpace {
        path: root.to_owned(),
        needed,
        free,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::columns::GROUPS;

    #[test]
    fn a_night_that_does_not_fit_is_refused_with_both_figures() {
        let night = 10 * 3600 * 1000;
        let needed = needed_bytes(night, &GROUPS);
        assert!((10 << 30..18 << 30).contains(&needed), "{needed}");
        let error = enough("runs".as_ref(), 4 << 30, Some(night), &GROUPS).unwrap_err();
        let text = error.to_string();
        assert!(text.contains("runs") && text.contains("4.3 GB"), "{text}");
        assert!(enough("runs".as_ref(), needed, Some(night), &GROUPS).is_ok());
        assert!(enough("runs".as_ref(), 1 << 20, None, &GROUPS).is_err());
    }

    #[test]
    fn room_below_a_folder_that_is_not_there_yet_is_that_of_its_disk() {
        let free = free_bytes("no/such/folder/yet".as_ref());
        assert!(free.is_some_and(|free| free > 0));
    }
}
