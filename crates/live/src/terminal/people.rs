//! Text for people; the program provides the spelling of units.

use std::borrow::Cow;
use std::sync::OnceLock;

/// The form in which people read a text: units with their signs.
type Typeset = fn(&str) -> String;

static TYPESET: OnceLock<Typeset> = OnceLock::new();

/// From now on text for people passes through `typeset`. For a terminal on standard error that shows letters beyond ASCII. Only
/// the first call counts.
pub fn typeset_with(typeset: Typeset) {
    let _ = TYPESET.set(typeset);
}

/// A text as people read it on the terminal.
pub fn for_people(text: &str) -> Cow<'_, str> {
    match TYPESET.get() {
        Some(typeset) => Cow::Owned(typeset(text)),
        None => Cow::Borrowed(text),
    }
}
