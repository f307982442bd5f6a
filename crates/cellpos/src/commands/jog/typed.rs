//! What is typed while the PZT is held: lines, or single keys on a terminal.

use crate::keyboard::{self, Keyboard};
use std::io::BufRead;
use std::sync::mpsc::{Receiver, channel};

/// What single keys do, for the person at the terminal.
pub(super) const HELP: &str = "keys: + or up a step, - or down a step back, g goes to a displacement (5um, Enter), q parks and ends";

/// Makes commands of single keys.
#[derive(Debug, Default)]
struct Keys {
    /// A displacement being typed, after `g`.
    typing: Option<String>,
    /// How much of an arrow's three bytes has come.
    arrow: u8,
}

impl Keys {
    /// Takes a byte; gives the command that it completes, in the words of a line.
    fn push(&mut self, key: u8) -> Option<String> {
        const ESCAPE: u8 = 0x1b;
        if let Some(text) = &mut self.typing {
            match key {
                b'\n' | b'\r' => return self.typing.take(),
                0x7f | 0x08 => drop(text.pop()),
                ESCAPE => self.typing = None,
                _ => text.push(char::from(key)),
            }
            return None;
        }
        let arrow = std::mem::take(&mut self.arrow);
        match (arrow, key) {
            (0, ESCAPE) => self.arrow = 1,
            (1, b'[' | b'O') => self.arrow = 2,
            (2, b'A' | b'C') | (_, b'+' | b'=') => return Some("+".to_string()),
            (2, b'B' | b'D') | (_, b'-' | b'_') => return Some("-".to_string()),
            (_, b'g' | b'G') => self.typing = Some(String::new()),
            // Ctrl-D ends what is typed.
            (_, b'q' | b'Q' | 0x04) => return Some("q".to_string()),
            _ => {}
        }
        None
    }
}

/// Commands as they are typed. Dropped, it gives the terminal back as it was.
pub(super) struct Typed {
    /// Lines: `5um`, `+`, `-`, `+2um`, `q`. Closed at the end of the input.
    pub lines: Receiver<String>,
    /// The keyboard, where there is one.
    pub keyboard: Option<Keyboard>,
}

impl Typed {
    /// Single keys where standard input is a terminal, else its lines.
    pub(super) fn listen() -> Self {
        let (sender, lines) = channel();
        let of_keys = sender.clone();
        let mut keys = Keys::default();
        let keyboard = keyboard::listen(move |typed| {
            for command in typed.iter().filter_map(|key| keys.push(*key)) {
                // Nobody listens any more: the program is ending.
                let _ = of_keys.send(command);
            }
        });
        if keyboard.is_none() {
            std::thread::spawn(move || {
                for line in std::io::stdin().lock().lines() {
                    let Ok(line) = line else { return };
                    if sender.send(line).is_err() {
                        return;
                    }
                }
            });
        }
        Self { lines, keyboard }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_arrows_and_a_typed_displacement_become_commands() {
        let mut keys = Keys::default();
        let typed = b"+-x\x1b[A\x1b[Bg5x\x7fum\ng1\x1b+=q\x04";
        let commands: Vec<String> = typed.iter().filter_map(|key| keys.push(*key)).collect();
        assert_eq!(commands, ["+", "-", "+", "-", "5um", "+", "+", "q", "q"]);
    }
}
