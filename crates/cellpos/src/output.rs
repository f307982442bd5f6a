//! Files that a command writes: looked at before the work begins, never written over unasked; and what holds for the whole
//! command line.

use cellpos_session::Failure;
use indicatif::{ProgressDrawTarget, TermLike};
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError, RwLock};

/// Options of every command.
#[derive(Debug, Clone, Default)]
pub(crate) struct Settings {
    /// Name of the command.
    pub command: String,
    /// Whether files that are there already may be written over.
    pub force: bool,
    /// Whether progress is not shown.
    pub quiet: bool,
}

static SETTINGS: RwLock<Settings> = RwLock::new(Settings {
    command: String::new(),
    force: false,
    quiet: false,
});

/// Keeps these options.
pub(crate) fn configure(settings: Settings) {
    *SETTINGS.write().unwrap_or_else(PoisonError::into_inner) = settings;
}

/// These options.
pub(crate) fn settings() -> Settings {
    SETTINGS
        .read()
        .unwrap_or_else(PoisonError::into_inner)
        .clone()
}

/// A progress bar, or a spinner without a length; hidden where nobody wants to see it.
pub(crate) fn progress_bar(length: Option<u64>) -> indicatif::ProgressBar {
    let bar = match length {
        Some(length) => indicatif::ProgressBar::new(length),
        None => indicatif::ProgressBar::new_spinner(),
    };
    let seen = !settings().quiet && std::io::stderr().is_terminal();
    bar.set_draw_target(if seen {
        ProgressDrawTarget::term_like(Box::new(Screen::default()))
    } else {
        ProgressDrawTarget::hidden()
    });
    bar
}

/// The terminal as a progress bar sees it: one line that nobody waits for.
#[derive(Debug, Default)]
struct Screen {
    line: Mutex<String>,
}

impl Screen {
    fn line(&self) -> MutexGuard<'_, String> {
        self.line.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl TermLike for Screen {
    fn width(&self) -> u16 {
        let size = rustix::termios::tcgetwinsize(std::io::stderr());
        size.map_or(80, |size| size.ws_col.max(20))
    }
    fn move_cursor_up(&self, _: usize) -> std::io::Result<()> {
        Ok(())
    }
    fn move_cursor_down(&self, _: usize) -> std::io::Result<()> {
        Ok(())
    }
    fn move_cursor_right(&self, _: usize) -> std::io::Result<()> {
        Ok(())
    }
    fn move_cursor_left(&self, _: usize) -> std::io::Result<()> {
        Ok(())
    }
    fn write_line(&self, text: &str) -> std::io::Result<()> {
        self.write_str(text)
    }
    fn write_str(&self, text: &str) -> std::io::Result<()> {
        self.line().push_str(text);
        Ok(())
    }
    fn clear_line(&self) -> std::io::Result<()> {
        self.line().clear();
        Ok(())
    }
    fn flush(&self) -> std::io::Result<()> {
        cellpos_live::terminal::stderr().show(self.line().trim_end());
        Ok(())
    }
}

/// Checks the output files before anything is measured. Each must be new, unless `--force` is given, and its
/// folder there or possible to make, with room for a file in it.
///
/// # Errors
/// Bad input that names the file.
pub(crate) fn ready<'a>(paths: impl IntoIterator<Item = &'a PathBuf>) -> Result<(), Failure> {
    paths
        .into_iter()
        .try_for_each(|path| ready_one(path, settings().force))
}

fn ready_one(path: &Path, force: bool) -> Result<(), Failure> {
    let name = path.display();
    if path.is_dir() {
        return Err(Failure::bad_input(
            format!("{name}: is a folder"),
            "name a file",
        ));
    }
    // A device or a pipe (/dev/stdout, /dev/null) is nothing that could be lost.
    let kept = std::fs::metadata(path).is_ok_and(|found| found.is_file());
    if kept && !force {
        return Err(Failure::bad_input(
            format!("{name}: is there already"),
            "name another file, or write over it with --force",
        ));
    }
    let refused = |error: std::io::Error| {
        Failure::bad_input(
            format!("{name}: cannot be written: {}", why(path, &error)),
            "name a file in a folder that you may write to",
        )
    };
    if std::fs::metadata(path).is_ok() {
        return std::fs::OpenOptions::new()
            .append(true)
            .open(path)
            .map(|_| ())
            .map_err(refused);
    }
    if let Some(folder) = path
        .parent()
        .filter(|folder| !folder.as_os_str().is_empty())
    {
        std::fs::create_dir_all(folder).map_err(refused)?;
    }
    // Makes a file and removes it: permission bits alone do not show whether writing works.
    std::fs::OpenOptions::new()
        .write(true)
        .create_new(true)
        .open(path)
        .map_err(refused)?;
    std::fs::remove_file(path).map_err(refused)
}

/// Why a file cannot be written, where the system's own words ("File exists") would mislead.
fn why(path: &Path, error: &std::io::Error) -> String {
    let nearest = path.ancestors().skip(1).find(|folder| folder.exists());
    match nearest.filter(|folder| !folder.is_dir()) {
        Some(file) => format!("{} is a file, not a folder", file.display()),
        None if path.is_symlink() => "it is a link that leads nowhere".to_owned(),
        None => error.to_string(),
    }
}

/// Writes a file whole or not at all; its folder is made.
///
/// # Errors
/// A failure that names the file.
pub(crate) fn write(path: &Path, text: &str) -> Result<(), Failure> {
    let refused = |error: &dyn std::fmt::Display| {
        Failure::Failed(miette::miette!(
            "{}: cannot be written: {error}",
            path.display()
        ))
    };
    if let Some(folder) = path
        .parent()
        .filter(|folder| !folder.as_os_str().is_empty())
    {
        std::fs::create_dir_all(folder).map_err(|error| refused(&error))?;
    }
    if std::fs::metadata(path).is_ok_and(|found| !found.is_file()) {
        return std::fs::write(path, text).map_err(|error| refused(&error));
    }
    cellpos_table::write_atomically(path, text.as_bytes()).map_err(|error| refused(&error))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_that_is_there_is_not_written_over_and_a_folder_that_is_missing_is_made() {
        let folder = tempfile::tempdir().unwrap();
        let old = folder.path().join("old.csv");
        std::fs::write(&old, "old").unwrap();
        let said = ready_one(&old, false).unwrap_err().text();
        assert!(
            said.contains("old.csv") && said.contains("already"),
            "{said}"
        );
        ready_one(&old, true).unwrap();
        assert_eq!(std::fs::read_to_string(&old).unwrap(), "old");
        let new = folder.path().join("deep/er/new.csv");
        ready_one(&new, false).unwrap();
        assert!(!new.exists());
        write(&new, "text").unwrap();
        assert_eq!(std::fs::read_to_string(&new).unwrap(), "text");
        let below_a_file = old.join("new.csv");
        let said = ready_one(&below_a_file, false).unwrap_err().text();
        assert!(said.contains("new.csv"), "{said}");
        assert!(ready_one(folder.path(), true).is_err());
    }
}
