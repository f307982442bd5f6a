//! The effects of operating-system signals, in one place for every command that may hold a rig.
//!
//! | signal | a rig is held | no rig is held |
//! |---|---|---|
//! | INT, TERM, HUP | freeze the bead, then park; a second one parks at once | ends the program, as always; `doctor` says first what it has |
//! | QUIT | park at once | ends the program, as always |
//! | USR1 | pause: freeze until the next USR1 | nothing |
//! | USR2 | a script goes on with its next step | nothing |
//! | TSTP (Ctrl-Z), TTIN, TTOU | refused: a stopped program cannot hold a bead | stops the program, as always |
//! | PIPE | nothing: the write fails, the run goes on | the write fails |
//! | HUP, inherited ignored (`nohup`) | nothing | nothing |
//!
//! A session registers before it arms the board and leaves after the board is parked. In between no signal can end the program with the
//! board armed. After a stop request nothing is armed any more.

use crate::say::say;
use cellpos_runtime::Request;
use cellpos_runtime::live::Operator;
use signal_hook::consts::{
    SIGHUP, SIGINT, SIGQUIT, SIGTERM, SIGTSTP, SIGTTIN, SIGTTOU, SIGUSR1, SIGUSR2,
};
use signal_hook::iterator::Signals;
use signal_hook::low_level::{emulate_default_handler, signal_name};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// The holders of a rig, and the stop request, if any.
#[derive(Debug)]
struct Desk {
    listening: bool,
    sessions: Vec<Arc<Operator>>,
    stopped_by: Option<i32>,
    /// A measurement without a rig, which a stop request ends early.
    measuring: Option<Arc<AtomicBool>>,
}

static DESK: Mutex<Desk> = Mutex::new(Desk {
    listening: false,
    sessions: Vec::new(),
    stopped_by: None,
    measuring: None,
});

fn desk() -> MutexGuard<'static, Desk> {
    DESK.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A registration: while it is held, signals go to the session and do not end the program.
#[derive(Debug)]
pub struct Place(Arc<Operator>);

impl Drop for Place {
    fn drop(&mut self) {
        desk()
            .sessions
            .retain(|operator| !Arc::ptr_eq(operator, &self.0));
    }
}

/// A stop was requested before the board was armed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("stopped by {}: the board was not armed", name(*.0))]
pub struct Stopped(i32);

/// Registers a session.
///
/// # Errors
/// A stop was requested already, so nothing may be armed any more.
pub fn hold(operator: &Arc<Operator>) -> Result<Place, Stopped> {
    let mut desk = desk();
    if let Some(signal) = desk.stopped_by {
        return Err(Stopped(signal));
    }
    desk.sessions.push(Arc::clone(operator));
    Ok(Place(Arc::clone(operator)))
}

/// A flag that the first INT, TERM, HUP or QUIT raises instead of ending the program: a long measurement without a rig ends early
/// with its results. The next one ends the program, as always.
pub fn ends_measuring() -> Arc<AtomicBool> {
    let flag = Arc::new(AtomicBool::new(false));
    desk().measuring = Some(Arc::clone(&flag));
    flag
}

/// Name of the signal that requested a stop while a rig was held, if any.
pub fn stopped_by() -> Option<&'static str> {
    desk().stopped_by.map(name)
}

fn name(signal: i32) -> &'static str {
    signal_name(signal).unwrap_or("a signal")
}

/// Whether the program was started with this signal ignored, as `nohup` does with HUP.
fn inherited_ignored(signal: i32) -> bool {
    let ignored = std::fs::read_to_string("/proc/self/status")
        .ok()
        .and_then(|status| {
            let mask = status.lines().find_map(|l| l.strip_prefix("SigIgn:"))?;
            u64::from_str_radix(mask.trim(), 16).ok()
        });
    ignored.is_some_and(|mask| mask >> (signal - 1) & 1 == 1)
}

/// Starts the policy on its own thread. A program calls it first. A library with another policy does not call it, and uses the
/// session's [`Operator`] instead.
///
/// # Errors
/// The operating system refused a handler or a thread.
pub fn listen() -> std::io::Result<()> {
    let mut desk = desk();
    if desk.listening {
        return Ok(());
    }
    let mut wanted = vec![
        SIGINT, SIGTERM, SIGQUIT, SIGUSR1, SIGUSR2, SIGTSTP, SIGTTIN, SIGTTOU,
    ];
    if !inherited_ignored(SIGHUP) {
        wanted.push(SIGHUP);
    }
    let mut signals = Signals::new(wanted)?;
    std::thread::Builder::new()
        .name("cellpos-signals".to_string())
        .spawn(move || {
            for signal in signals.forever() {
                act(signal);
            }
        })?;
    desk.listening = true;
    Ok(())
}

fn act(signal: i32) {
    let mut desk = desk();
    if desk.sessions.is_empty() {
        let stops = matches!(signal, SIGINT | SIGTERM | SIGHUP | SIGQUIT);
        if let Some(flag) = desk.measuring.take_if(|_| stops) {
            flag.store(true, Ordering::Relaxed);
            return;
        }
        if !matches!(signal, SIGUSR1 | SIGUSR2) {
            cellpos_live::terminal::give_back();
            // Registration remains closed meanwhile: nobody can arm a board while the program ends.
            let _ = emulate_default_handler(signal);
        }
        return;
    }
    let name = name(signal);
    match signal {
        SIGINT | SIGTERM | SIGHUP | SIGQUIT => {
            desk.stopped_by.get_or_insert(signal);
            let mut request = Request::Freeze;
            for operator in &desk.sessions {
                if signal == SIGQUIT {
                    operator.ask(Request::Park);
                }
                request = operator.stop();
            }
            say(match request {
                Request::Freeze => {
                    format!("\n{name}: freezing the bead, then parking; once more to park at once")
                }
                _ => format!("\n{name}: parking"),
            });
        }
        SIGUSR1 | SIGUSR2 => {
            for operator in &desk.sessions {
                press(if signal == SIGUSR1 { b'p' } else { b's' }, operator);
            }
        }
        _ => say(format!(
            "\n{name}: refused, a stopped program cannot hold a bead; Ctrl-C ends the run"
        )),
    }
}

/// Executes a key: p or space pauses and continues, s skips to the next step, q stops.
pub fn press(key: u8, operator: &Operator) {
    // Switches between two requests; has no effect after a stop request.
    let toggle = |from, to, back| {
        let _ = operator.change(Request::None, to) || operator.change(from, back);
    };
    match key {
        b'p' | b' ' => toggle(Request::Pause, Request::Pause, Request::None),
        b's' => toggle(Request::Pause, Request::Skip, Request::Skip),
        b'q' => {
            operator.stop();
        }
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn p_pauses_and_goes_on_s_skips_once_and_neither_undoes_a_stop() {
        let operator = Operator::default();
        press(b'p', &operator);
        assert_eq!(operator.take(), Request::Pause);
        assert_eq!(operator.take(), Request::Pause);
        press(b'p', &operator);
        assert_eq!(operator.take(), Request::None);
        press(b's', &operator);
        assert_eq!(operator.take(), Request::Skip);
        assert_eq!(operator.take(), Request::None);
        press(b'q', &operator);
        press(b'p', &operator);
        press(b's', &operator);
        assert_eq!(operator.take(), Request::Freeze);
        press(b'q', &operator);
        assert_eq!(operator.take(), Request::Park);
    }

    #[test]
    fn a_place_is_given_back_when_it_is_dropped() {
        let operator = Arc::new(Operator::default());
        let place = hold(&operator).expect("no stop was asked for");
        assert_eq!(Arc::strong_count(&operator), 3);
        drop(place);
        assert_eq!(Arc::strong_count(&operator), 1);
    }
}
