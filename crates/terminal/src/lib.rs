//! Messages and the live line on a terminal that nobody waits for.
//!
//! A terminal can stop taking output for as long as it likes: Ctrl-S, a stalled ssh connection, a pager. A [`Terminal`] has
//! a thread of its own that alone writes to it, fed by a ring of [`RING`] messages. A full ring drops the message and counts
//! it; the number is told once the terminal takes output again. So nothing that holds a rig, records or reacts to a signal
//! ever waits for a screen.
//!
//! What is shown is cleaned ([`clean`]): text that came from a file cannot move the cursor, rename the window or hide what
//! follows. Not for the result of a command, which goes to standard output when nothing waits any more.
//!
//! ```
//! use cellpos_terminal::{Colours, clean};
//! // A note from a file that would clear the screen and rename the window.
//! let note = "cell 7\u{1b}[2J\u{1b}]0;mine\u{7} lost";
//! let shown = clean(note, Colours::Removed);
//! assert!(!shown.contains('\u{1b}') && shown.contains("cell 7"));
//! ```
#![forbid(unsafe_code)]

use std::borrow::Cow;
use std::io::{self, Write};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, OnceLock};
use std::thread;
use std::time::Duration;

/// Messages that wait for the terminal at most.
pub const RING: usize = 256;

enum Message {
    /// A text that stays, with a line end.
    Say(String),
    /// The line at the bottom, in place of the one before.
    Show(String),
    /// The line at the bottom is not replaced any more.
    Leave,
    /// Says when everything before it has been written.
    Flush(SyncSender<()>),
}

/// A terminal, or what takes its place.
#[derive(Debug, Clone)]
pub struct Terminal {
    ring: SyncSender<Message>,
    dropped: Arc<AtomicU64>,
}

impl Terminal {
    /// A thread that writes to `out`. It ends when the last handle is gone, and does not keep the program from ending. Where
    /// no thread can be started everything is dropped and counted.
    pub fn new(out: impl Write + Send + 'static) -> Self {
        let (ring, messages) = sync_channel(RING);
        let dropped = Arc::new(AtomicU64::new(0));
        let counted = Arc::clone(&dropped);
        // Without a thread the receiver is gone and each message counts as dropped.
        let _ = thread::Builder::new()
            .name("cellpos-terminal".to_string())
            .spawn(move || serve(&messages, &counted, out));
        Self { ring, dropped }
    }

    fn send(&self, message: Message) {
        if self.ring.try_send(message).is_err() {
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// A message of its own; a line end is added. Never waits.
    pub fn say(&self, text: &str) {
        self.send(Message::Say(text.to_string()));
    }

    /// The live line, in place of the one before; empty: none any more. Never waits.
    pub fn show(&self, line: &str) {
        self.send(Message::Show(line.to_string()));
    }

    /// The live line stays as it is, and the next one comes below it. Never waits.
    pub fn leave(&self) {
        self.send(Message::Leave);
    }

    /// Messages that found the ring full and have not been told of yet.
    pub fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }

    /// Waits until everything said so far is written, for `patience` at most; says whether it is.
    pub fn flush(&self, patience: Duration) -> bool {
        let (done, written) = sync_channel(1);
        self.ring.try_send(Message::Flush(done)).is_ok() && written.recv_timeout(patience).is_ok()
    }
}

/// The terminal behind standard error, shared by the whole program.
pub fn stderr() -> &'static Terminal {
    static TERMINAL: OnceLock<Terminal> = OnceLock::new();
    TERMINAL.get_or_init(|| Terminal::new(io::stderr()))
}

/// Columns of the terminal behind standard error; 80 where it does not say.
pub fn columns() -> usize {
    rustix::termios::tcgetwinsize(io::stderr())
        .ok()
        .map(|size| usize::from(size.ws_col))
        .filter(|columns| *columns > 0)
        .unwrap_or(80)
}

/// Sends the words of a panic to [`stderr`], so that a thread that fails does not wait for a screen before it is noticed.
pub fn panics_do_not_wait() {
    let plain = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        // The program ends with its main thread: nobody would be left to write.
        if thread::current().name() == Some("main") {
            plain(info);
        } else {
            stderr().say(&info.to_string());
        }
    }));
}

fn serve(messages: &Receiver<Message>, dropped: &AtomicU64, mut out: impl Write) {
    let mut live = false;
    loop {
        let written = match messages.recv_timeout(Duration::from_secs(1)) {
            Ok(Message::Flush(done)) => {
                let flushed = out.flush();
                let _ = done.try_send(());
                flushed
            }
            Ok(Message::Say(text)) => {
                let end = if std::mem::take(&mut live) {
                    "\r\x1b[K"
                } else {
                    ""
                };
                let text = text.strip_suffix('\n').unwrap_or(&text);
                writeln!(out, "{end}{}", clean(text, Colours::Kept)).and_then(|()| out.flush())
            }
            Ok(Message::Show(line)) => {
                live = !line.is_empty();
                write!(out, "\r\x1b[K{}", clean(&line, Colours::Kept)).and_then(|()| out.flush())
            }
            Ok(Message::Leave) if std::mem::take(&mut live) => {
                writeln!(out).and_then(|()| out.flush())
            }
            Ok(Message::Leave) | Err(RecvTimeoutError::Timeout) => Ok(()),
            Err(RecvTimeoutError::Disconnected) => return,
        };
        // A terminal that is gone for good: what comes is dropped and counted.
        if written.is_err_and(|error| error.kind() == io::ErrorKind::BrokenPipe) {
            return;
        }
        let lost = dropped.swap(0, Ordering::Relaxed);
        if lost > 0 {
            let _ = writeln!(
                out,
                "({lost} messages found the terminal not taking output)"
            );
        }
    }
}

/// For loggers that write line by line: each write is a message.
#[derive(Debug, Clone, Copy, Default)]
pub struct Log;

impl Write for Log {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        stderr().say(&String::from_utf8_lossy(bytes));
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// What happens to sequences that set colours.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Colours {
    /// They stay: they change how text looks, nothing else.
    Kept,
    /// They go, like all others.
    Removed,
}

/// A text without anything that a terminal takes for an order: control characters but line ends and tabs, sequences that
/// begin with escape, marks that turn the direction of writing.
pub fn clean(text: &str, colours: Colours) -> Cow<'_, str> {
    if !text.chars().any(is_order) {
        return Cow::Borrowed(text);
    }
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(c) = rest.chars().next() {
        if colours == Colours::Kept
            && let Some(length) = colour_length(rest)
        {
            let (sequence, behind) = rest.split_at(length);
            out.push_str(sequence);
            rest = behind;
            continue;
        }
        out.push(if is_order(c) { '\u{fffd}' } else { c });
        rest = rest.get(c.len_utf8()..).unwrap_or("");
    }
    Cow::Owned(out)
}

fn is_order(c: char) -> bool {
    (c.is_control() && c != '\n' && c != '\t')
        || matches!(c, '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

/// Length of the colour sequence that a text begins with: `ESC [ numbers m`.
fn colour_length(text: &str) -> Option<usize> {
    let numbers = text.strip_prefix("\x1b[")?;
    let end = numbers.find(|c: char| !c.is_ascii_digit() && c != ';')?;
    // 8 hides what follows.
    let hides = numbers[..end].split(';').any(|number| number == "8");
    (!hides && numbers[end..].starts_with('m')).then_some(2 + end + 1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::{Condvar, Mutex};

    /// A terminal that takes output only while it is let.
    #[derive(Clone, Default)]
    struct Screen(Arc<Shown>);

    #[derive(Default)]
    struct Shown {
        takes_output: Mutex<bool>,
        changed: Condvar,
        text: Mutex<Vec<u8>>,
    }

    impl Screen {
        fn go_on(&self) {
            *self.0.takes_output.lock().unwrap() = true;
            self.0.changed.notify_all();
        }

        fn text(&self) -> String {
            String::from_utf8(self.0.text.lock().unwrap().clone()).unwrap()
        }
    }

    impl Write for Screen {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            let mut takes_output = self.0.takes_output.lock().unwrap();
            while !*takes_output {
                takes_output = self.0.changed.wait(takes_output).unwrap();
            }
            self.0.text.lock().unwrap().extend_from_slice(bytes);
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn nobody_waits_for_a_terminal_that_takes_no_output_and_what_is_dropped_is_told() {
        let screen = Screen::default();
        let terminal = Terminal::new(screen.clone());
        // The terminal takes nothing: were anything of this to wait for it, the test would never end.
        for number in 0..10_000 {
            terminal.show(&format!("line {number}"));
            terminal.say("an event");
        }
        assert!(terminal.dropped() > 19_000);
        assert!(!terminal.flush(Duration::from_millis(1)));
        screen.go_on();
        while !terminal.flush(Duration::from_secs(1)) {}
        terminal.say("the end");
        while !terminal.flush(Duration::from_secs(1)) {}
        let text = screen.text();
        assert!(text.contains("messages found the terminal not taking output"));
        assert!(text.ends_with("the end\n"), "{text:?}");
        assert_eq!(terminal.dropped(), 0);
    }

    #[test]
    fn a_terminal_that_is_gone_costs_nothing() {
        struct Gone;
        impl Write for Gone {
            fn write(&mut self, _: &[u8]) -> io::Result<usize> {
                Err(io::ErrorKind::BrokenPipe.into())
            }
            fn flush(&mut self) -> io::Result<()> {
                Ok(())
            }
        }
        let terminal = Terminal::new(Gone);
        terminal.say("a");
        while terminal.dropped() == 0 {
            terminal.say("b");
        }
    }

    #[test]
    fn orders_to_the_terminal_are_taken_out_and_colours_stay_if_wanted() {
        let text = "\x1b[31mred\x1b[0m\x1b]0;title\x07 \x1b[2J\u{202e}x\r\n\ta\u{9b}1m";
        assert_eq!(
            clean(text, Colours::Kept),
            "\x1b[31mred\x1b[0m\u{fffd}]0;title\u{fffd} \u{fffd}[2J\u{fffd}x\u{fffd}\n\ta\u{fffd}1m"
        );
        assert!(!clean(text, Colours::Removed).contains('\x1b'));
        assert!(clean("\x1b[8mhidden", Colours::Kept).starts_with('\u{fffd}'));
        assert!(matches!(
            clean("um, 30 % \n", Colours::Kept),
            Cow::Borrowed(_)
        ));
    }
}
