//! Whole files written in one step.

use crate::error::{Problem, TableError};
use std::io::Write;
use std::path::Path;

/// Writes a whole file so that no reader, and no crash, ever sees a part of it: into a temporary file beside it, synced
/// to the disk, then renamed over `path`. Folders are made as needed.
///
/// # Errors
/// [`Problem::Write`] with the file's name; the temporary file is removed.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), TableError> {
    let attempt = || {
        if let Some(folder) = path.parent()
            && !folder.as_os_str().is_empty()
        {
            std::fs::create_dir_all(folder)?;
        }
        // The process id keeps two programs that write the same file from sharing a temporary one.
        let mut name = std::ffi::OsString::from(".");
        name.push(path.file_name().unwrap_or_default());
        name.push(format!(".{}.part", std::process::id()));
        let part = path.with_file_name(name);
        let written = std::fs::File::create(&part).and_then(|mut file| {
            file.write_all(bytes)?;
            file.sync_data()
        });
        written
            .and_then(|()| std::fs::rename(&part, path))
            .inspect_err(|_| {
                let _ = std::fs::remove_file(&part);
            })
    };
    attempt().map_err(|source| TableError {
        path: path.to_owned(),
        line: None,
        problem: Problem::Write(source),
    })
}
