//! Whole files written in one step.

use crate::error::{TableError, TableProblem};
use std::fs::File;
use std::io::{self, Read, Write};
use std::path::Path;

/// Writes a whole file so that no reader and no crash leaves a partial one. It writes a temporary file in the same folder, syncs
/// it to the disk and renames it to `path`. It makes folders as needed. A device or a pipe of this name gets the bytes and is not
/// replaced.
///
/// # Errors
/// [`TableProblem::Write`] with the file's name; the temporary file is removed.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), TableError> {
    replace(path, bytes, File::sync_data)
}

/// As [`write_atomically`], without waiting for the disk: no reader sees a partial file, but after a system crash the file may be
/// cut off. For data that can be made again.
///
/// # Errors
/// As [`write_atomically`].
pub fn write_unsynced(path: &Path, bytes: &[u8]) -> Result<(), TableError> {
    replace(path, bytes, |_| Ok(()))
}

fn replace(
    path: &Path,
    bytes: &[u8],
    sync: impl Fn(&File) -> io::Result<()>,
) -> Result<(), TableError> {
    let attempt = || {
        if std::fs::metadata(path).is_ok_and(|found| !found.is_file() && !found.is_dir()) {
            return File::options().write(true).open(path)?.write_all(bytes);
        }
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
        // Make a new file: a symbolic link of this name would lead elsewhere. Remove a file left by a dead process with this
        // number.
        let _ = std::fs::remove_file(&part);
        let created = std::fs::OpenOptions::new()
            .write(true)
            .create_new(true)
            .open(&part);
        let written = created.and_then(|mut file| {
            file.write_all(bytes)?;
            sync(&file)
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
        problem: TableProblem::Write(source),
    })
}

/// More than any record of a day has, bytes.
pub const MOST_OF_A_RECORD: u64 = 32 << 30;

/// Reads a text file that a person or a program has written, with the limits of [`read_bytes`].
///
/// # Errors
/// Those of [`read_bytes`]; [`io::ErrorKind::InvalidData`] if it is not text.
pub fn read_text(path: &Path, most: u64) -> io::Result<String> {
    String::from_utf8(read_bytes(path, most)?)
        .map_err(|_| io::Error::new(io::ErrorKind::InvalidData, "is not text in UTF-8"))
}

/// Reads a file, or a pipe up to its end. It refuses an endless device and more than `most` bytes.
///
/// # Errors
/// [`io::Error`] with a sentence if it is not such a file; other errors, such as [`io::ErrorKind::NotFound`], unchanged.
pub fn read_bytes(path: &Path, most: u64) -> io::Result<Vec<u8>> {
    let file = File::open(path)?;
    let meta = file.metadata()?;
    if meta.is_dir() {
        return Err(io::Error::other("is a folder, not a file"));
    }
    #[cfg(unix)]
    {
        use std::os::unix::fs::FileTypeExt;
        let kind = meta.file_type();
        if kind.is_char_device() || kind.is_block_device() {
            return Err(io::Error::other("is a device, not a file"));
        }
    }
    let mut bytes = Vec::new();
    file.take(most.saturating_add(1)).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > most {
        let text = format!("is larger than {} MB: not a file of this kind", most >> 20);
        return Err(io::Error::other(text));
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_text_file_is_refused_with_a_sentence() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.toml");
        std::fs::write(&path, "a = 1").unwrap();
        assert_eq!(read_text(&path, 5).unwrap(), "a = 1");
        let long = read_text(&path, 4).unwrap_err();
        assert!(long.to_string().contains("larger"), "{long}");
        std::fs::write(&path, [0xff, 0xfe]).unwrap();
        assert!(read_text(&path, 5).is_err());
        assert!(read_text(folder.path(), 5).is_err());
        if Path::new("/dev/zero").exists() {
            let device = read_text("/dev/zero".as_ref(), 5).unwrap_err();
            assert!(device.to_string().contains("device"), "{device}");
        }
    }

    #[cfg(unix)]
    #[test]
    fn a_pipe_is_written_to_and_stays() {
        use std::os::unix::fs::FileTypeExt;
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join("pipe");
        let made = std::process::Command::new("mkfifo").arg(&pipe).status();
        assert!(made.unwrap().success());
        let reader = std::thread::spawn({
            let pipe = pipe.clone();
            move || std::fs::read_to_string(pipe).unwrap()
        });
        write_atomically(&pipe, b"through").unwrap();
        assert_eq!(reader.join().unwrap(), "through");
        assert!(std::fs::metadata(&pipe).unwrap().file_type().is_fifo());
    }

    #[cfg(unix)]
    #[test]
    fn a_symbolic_link_where_a_file_is_written_leads_nowhere() {
        let folder = tempfile::tempdir().unwrap();
        let victim = folder.path().join("victim");
        std::fs::write(&victim, "whole").unwrap();
        let path = folder.path().join("a.toml");
        let part = format!(".a.toml.{}.part", std::process::id());
        std::os::unix::fs::symlink(&victim, folder.path().join(part)).unwrap();
        std::os::unix::fs::symlink(&victim, &path).unwrap();
        write_atomically(&path, b"new").unwrap();
        assert_eq!(std::fs::read_to_string(&victim).unwrap(), "whole");
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "new");
    }
}
