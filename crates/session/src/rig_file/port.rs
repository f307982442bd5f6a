//! The serial line of a board, and the reason if it cannot be opened.

use crate::Failure;
use cellpos_drivers::serial::SerialLine;
use std::io::{Error, ErrorKind};
use std::path::Path;

/// Opens a port.
///
/// # Errors
/// The port cannot be opened; the error names the program that has it, or what is missing.
pub(super) fn open(port: &str, baud: u32) -> Result<SerialLine, Failure> {
    SerialLine::open(port, baud).map_err(|error| cannot_open(port, &error))
}

fn cannot_open(port: &str, error: &Error) -> Failure {
    match error.kind() {
        // The first is the error of a held lock, the second that of TIOCEXCL.
        ErrorKind::WouldBlock | ErrorKind::ResourceBusy => Failure::bad_input(
            format!("[actuator] port = \"{port}\": {} has it open", holder(port)),
            "end that program, or wait until it has parked the PZT",
        ),
        ErrorKind::PermissionDenied => Failure::bad_input(
            format!("[actuator] port = \"{port}\": {error}"),
            "join the group of the port: sudo usermod -aG dialout $USER, then log in again; docs/rig.md, Permissions",
        ),
        _ => Failure::bad_input(
            format!("[actuator] port = \"{port}\": {error}"),
            "is the board plugged in (or firmware-sim running)? cellpos rig new lists the ports; docs/rig.md, Permissions",
        ),
    }
}

/// Name and process of the program that has a file open, as far as this user may see it. If there are several, it prefers another
/// process of this program, because `firmware-sim` keeps its own end of the line open.
fn holder(path: &str) -> String {
    let wanted = std::fs::canonicalize(path).unwrap_or_else(|_| path.into());
    let has_it = |process: &Path| {
        let open = std::fs::read_dir(process.join("fd"));
        (open.into_iter().flatten().flatten())
            .any(|file| std::fs::read_link(file.path()).is_ok_and(|file| file == wanted))
    };
    let name_of = |process: &Path| {
        let name = std::fs::read_to_string(process.join("comm")).unwrap_or_default();
        name.trim().to_owned()
    };
    let own = name_of(Path::new("/proc/self"));
    let processes = std::fs::read_dir("/proc").into_iter().flatten().flatten();
    let found = (processes.map(|entry| entry.path()))
        .filter(|process| {
            let number = process.file_name().and_then(|name| name.to_str());
            number.is_some_and(|name| name.bytes().all(|c| c.is_ascii_digit())) && has_it(process)
        })
        .min_by_key(|process| name_of(process) != own);
    let Some(process) = found else {
        return "another program".to_owned();
    };
    let number = process.file_name().unwrap_or_default().to_string_lossy();
    match name_of(&process) {
        name if name == own => format!("another {name} (process {number})"),
        name => format!("{name} (process {number})"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_port_that_somebody_has_names_the_program() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("port");
        let _held = std::fs::File::create(&path).expect("a file");
        let path = path.display().to_string();
        // Another program also has it open, such as the one at the other end of a pseudo-terminal.
        let mut other = std::process::Command::new("sleep")
            .arg("60")
            .stdin(std::fs::File::open(&path).expect("a file"))
            .spawn()
            .expect("sleep");
        let own = format!("(process {})", std::process::id());
        for kind in [ErrorKind::WouldBlock, ErrorKind::ResourceBusy] {
            let said = cannot_open(&path, &kind.into()).text();
            assert!(
                said.contains("another ") && said.contains(&own) && said.contains("has it open"),
                "{said}"
            );
        }
        other.kill().expect("sleep ends");
        let _ = other.wait();
        assert_eq!(holder("/nowhere/at/all"), "another program");
        let said = format!(
            "{:?}",
            cannot_open(&path, &ErrorKind::PermissionDenied.into())
        );
        assert!(said.contains("dialout") && !said.contains(&own), "{said}");
    }

    #[test]
    fn a_port_that_is_not_there_is_named() {
        let failure = open("/dev/does-not-exist", 1_000_000).expect_err("an error");
        let said = failure.text();
        assert!(said.contains("/dev/does-not-exist"), "{said}");
        assert!(format!("{failure:?}").contains("plugged in"), "{failure:?}");
    }
}
