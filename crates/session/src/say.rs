//! Words to the person at the terminal that nothing waits for: a signal must stop a rig whether or not anybody reads about it.

/// Says a line on standard error, without ever waiting for it.
pub fn say(line: impl AsRef<str>) {
    cellpos_live::terminal::stderr().say(line.as_ref());
}
