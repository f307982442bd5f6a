//! Keys during a run. The signals that do the same where there is no keyboard are those of every session.

use crate::keyboard::{self, Keyboard};
use cellpos_runtime::Request;
use cellpos_runtime::live::Operator;
use cellpos_session::live_line::Typed;
use cellpos_session::say::say;
use cellpos_session::signals::press;
use std::sync::Arc;

/// Which keys a hold takes, for the live line.
pub(crate) const OF_A_HOLD: &str = "f freeze, q stop, arrows or 2.5 Enter: target";
/// Which keys a motion takes that is not steered.
pub(crate) const OF_A_MOTION: &str = "f freeze, q stop";

/// Which keys a script takes.
pub(crate) const OF_A_SCRIPT: &str = "p pause, s next step, q stop";

/// Keys of a script: p pauses and continues, s skips, q stops.
pub(crate) fn of_a_script(operator: &Arc<Operator>) -> Option<Keyboard> {
    let operator = Arc::clone(operator);
    keyboard::listen(move |keys| keys.iter().for_each(|key| press(*key, &operator)))
}

/// Keys of a hold, or of a motion that is not steered.
pub(crate) fn of_a_track(mut steering: Steering) -> Option<Keyboard> {
    keyboard::listen(move |keys| steering.take(keys))
}

/// Keys of a run whose target the operator may move. Arrows move it (left and right 0.1 um, down and up 1 um); a number and Enter
/// sets it. f, p or space freezes and continues, q freezes, then parks. Escape deletes the typed number.
pub(crate) struct Steering {
    operator: Arc<Operator>,
    typed: Typed,
    number: String,
    first_um: f64,
    view_um: [f64; 2],
    steered: bool,
}

impl Steering {
    /// Keys for a run that begins at `first_um` and sees `view_um`; a run that is not `steered` takes no target.
    pub(crate) fn new(
        operator: &Arc<Operator>,
        typed: Typed,
        first_um: f64,
        view_um: [f64; 2],
        steered: bool,
    ) -> Self {
        Self {
            operator: Arc::clone(operator),
            typed,
            number: String::new(),
            first_um,
            view_um,
            steered,
        }
    }

    /// Bytes of one read: an arrow has several bytes, which come together.
    fn take(&mut self, keys: &[u8]) {
        let mut rest = keys;
        while let Some((&key, behind)) = rest.split_first() {
            rest = behind;
            if key == 0x1b {
                let arrow = match behind {
                    [b'[' | b'O', arrow, ..] => Some(*arrow),
                    _ => None,
                };
                rest = &behind[if arrow.is_some() { 2 } else { 0 }..];
                match arrow {
                    Some(b'A') => self.step(1.0),
                    Some(b'B') => self.step(-1.0),
                    Some(b'C') => self.step(0.1),
                    Some(b'D') => self.step(-0.1),
                    Some(_) => {}
                    None => self.number.clear(),
                }
            } else {
                self.key(key);
            }
        }
        self.typed.set(&self.number);
    }

    fn key(&mut self, key: u8) {
        match key {
            b'0'..=b'9' | b'-' | b'+' | b'.' | b',' if self.steered && self.number.len() < 12 => {
                self.number
                    .push(if key == b',' { '.' } else { char::from(key) });
            }
            0x7f | 0x08 => drop(self.number.pop()),
            b'\r' | b'\n' => self.enter(),
            b'f' => press(b'p', &self.operator),
            key => press(key, &self.operator),
        }
    }

    fn enter(&mut self) {
        let number = std::mem::take(&mut self.number);
        if number.is_empty() {
            return;
        }
        match number.parse::<f64>() {
            Ok(um) if um.is_finite() => self.steer(um),
            _ => say(format!("{number}: not a number of um, for example -2.5")),
        }
    }

    fn step(&self, by_um: f64) {
        if self.steered {
            let from_um = self.operator.target_um().unwrap_or(self.first_um);
            // Steps of a tenth stay round numbers.
            self.steer(((from_um + by_um) * 1e6).round() / 1e6);
        }
    }

    fn steer(&self, um: f64) {
        let [low_um, high_um] = self.view_um;
        if um < low_um || um > high_um {
            say(format!(
                "{um} um: outside what the camera sees, {low_um:.1} um to {high_um:.1} um"
            ));
        } else if matches!(self.operator.asked(), Request::Freeze | Request::Park) {
            say("the run is being stopped: no new target");
        } else {
            self.operator.steer(um);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn steering(steered: bool) -> (Arc<Operator>, Typed, Steering) {
        let (operator, typed) = (Arc::new(Operator::default()), Typed::default());
        let steering = Steering::new(&operator, typed.clone(), 1.0, [-12.8, 12.8], steered);
        (operator, typed, steering)
    }

    #[test]
    fn arrows_step_and_numbers_go_there_within_view() {
        let (operator, typed, mut steering) = steering(true);
        steering.take(b"\x1b[C\x1b[C\x1b[A");
        assert_eq!(operator.target_um(), Some(2.2));
        steering.take(b"-3,2");
        assert_eq!(typed.text(), "-3.2");
        assert_eq!(operator.target_um(), Some(2.2), "not before Enter");
        steering.take(b"\x7f5\r");
        assert_eq!(
            (operator.target_um(), typed.text()),
            (Some(-3.5), String::new())
        );
        steering.take(b"99\r--1\r");
        assert_eq!(
            operator.target_um(),
            Some(-3.5),
            "neither is a place in view"
        );
        steering.take(b"7\x1b");
        assert_eq!(typed.text(), "");
        steering.take(b"f");
        assert_eq!(operator.asked(), Request::Pause);
        steering.take(b"f");
        assert_eq!(operator.asked(), Request::None);
        steering.take(b"q5\r");
        assert_eq!(
            operator.target_um(),
            Some(-3.5),
            "a run that is stopped stays where it is"
        );
        assert_eq!(operator.asked(), Request::Freeze);
    }

    #[test]
    fn a_motion_that_is_not_steered_takes_no_target() {
        let (operator, typed, mut steering) = steering(false);
        steering.take(b"\x1b[C5\r");
        assert_eq!((operator.target_um(), typed.text()), (None, String::new()));
    }
}
