//! Keys while a script runs: p pauses and goes on, s skips, q stops. The signals that do the same where there is no keyboard
//! are those of every session.

use crate::keyboard::{self, Keyboard};
use cellpos_runtime::live::Operator;
use cellpos_session::signals::press;
use std::sync::Arc;

/// Listens, if there is a keyboard to listen to.
pub fn listen(operator: &Arc<Operator>) -> Option<Keyboard> {
    let operator = Arc::clone(operator);
    keyboard::listen(move |key| press(key, &operator))
}
