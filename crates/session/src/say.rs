//! Messages to the terminal that never block: a signal must stop a rig even if nobody reads the terminal.

/// Writes a line to standard error without waiting for it.
pub fn say(line: impl AsRef<str>) {
    cellpos_live::terminal::stderr().say(line.as_ref());
}
