//! Messages and the live line on a terminal, without ever waiting for it.
//!
//! A terminal can stop accepting output for any time: Ctrl-S, a stalled ssh connection, a pager. Only one thread writes to a
//! [`Terminal`], fed by a ring of [`RING`] messages. A full ring drops the message and counts it; the terminal shows the number
//! when it accepts output again. So a thread that controls a rig, records or handles a signal never waits for a screen.
//!
//! A view can take the whole terminal ([`Terminal::open_screen`]). Messages that arrive meanwhile are kept and shown when the
//! view ends, however the program ends ([`give_back`]).
//!
//! All text is cleaned ([`clean`]): text from a file cannot move the cursor, rename the window or hide other text. The result of
//! a command goes to standard output instead, after all messages are written.
//!
//! ```
//! use cellpos_live::terminal::{Colours, clean};
//! // A note from a file that would clear the screen and rename the window.
//! let note = "cell 7\u{1b}[2J\u{1b}]0;mine\u{7} lost";
//! let shown = clean(note, Colours::Removed);
//! assert!(!shown.contains('\u{1b}') && shown.contains("cell 7"));
//! ```
mod people;
mod screen;

pub use people::{for_people, typeset_with};
pub use screen::give_back;

use screen::Screen;
use std::borrow::Cow;
use std::io::{self, Write};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::thread;
use std::time::Duration;

/// Messages that wait for the terminal at most.
pub const RING: usize = 256;

enum Message {
    /// A text that stays, with a line end.
    Say(String),
    /// Replaces the line at the bottom.
    Show(String),
    /// Keeps the line at the bottom; it is not replaced any more.
    Leave,
    /// Reports when everything before it has been written.
    Flush(SyncSender<()>),
    /// The whole terminal is taken.
    Open,
    /// A picture for it, written unchanged.
    Draw(String),
    /// It is released.
    Close,
}

/// A terminal, or its substitute.
#[derive(Debug, Clone)]
pub struct Terminal {
    ring: SyncSender<Message>,
    dropped: Arc<AtomicU64>,
    /// Pictures not yet written.
    pending: Arc<AtomicU64>,
    /// The last message while a view uses the whole terminal; only the threads of terminal and picture use it.
    heard: Arc<Mutex<String>>,
}

impl Terminal {
    /// A thread that writes to `out`. It ends with the last handle, and does not prevent the end of the program. If no thread can
    /// be started, everything is dropped and counted.
    pub fn new(out: impl Write + Send + 'static) -> Self {
        Self::with(out, Screen::default())
    }

    fn with(out: impl Write + Send + 'static, screen: Screen) -> Self {
        let (ring, messages) = sync_channel(RING);
        let dropped = Arc::new(AtomicU64::new(0));
        let (pending, heard) = (Arc::default(), Arc::default());
        let mut writer = Writer {
            out,
            live: false,
            screen,
            pending: Arc::clone(&pending),
            heard: Arc::clone(&heard),
        };
        let counted = Arc::clone(&dropped);
        // Without a thread the receiver is gone and each message counts as dropped.
        let _ = thread::Builder::new()
            .name("cellpos-terminal".to_string())
            .spawn(move || writer.serve(&messages, &counted));
        Self {
            ring,
            dropped,
            pending,
            heard,
        }
    }

    fn send(&self, message: Message) {
        if self.ring.try_send(message).is_err() {
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Writes a message; adds a line end. Never waits.
    pub fn say(&self, text: &str) {
        self.send(Message::Say(text.to_string()));
    }

    /// Replaces the live line; empty: removes it. Never waits.
    pub fn show(&self, line: &str) {
        self.send(Message::Show(line.to_string()));
    }

    /// Keeps the live line; the next one comes below it. Never waits.
    pub fn leave(&self) {
        self.send(Message::Leave);
    }

    /// Takes the whole terminal for pictures. The live line is hidden, and messages are kept until [`Terminal::close_screen`].
    pub fn open_screen(&self) {
        self.send(Message::Open);
    }

    /// Whether the last picture is on the terminal. Before that, no new one is needed.
    pub fn can_draw(&self) -> bool {
        self.pending.load(Ordering::Acquire) == 0
    }

    /// A picture, as sequences for the terminal; `false`: it was not taken. Never waits.
    pub fn draw(&self, picture: String) -> bool {
        self.pending.fetch_add(1, Ordering::AcqRel);
        let taken = self.ring.try_send(Message::Draw(picture)).is_ok();
        if !taken {
            self.pending.fetch_sub(1, Ordering::AcqRel);
        }
        taken
    }

    /// The last message while a view uses the terminal.
    pub fn heard(&self) -> String {
        let heard = self.heard.lock().unwrap_or_else(PoisonError::into_inner);
        heard.clone()
    }

    /// Releases the terminal and writes the messages kept meanwhile. Waits at most `patience` for a terminal that accepts
    /// nothing.
    pub fn close_screen(&self, patience: Duration) {
        self.send(Message::Close);
        self.flush(patience);
    }

    /// Messages dropped by a full ring and not reported yet.
    pub fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }

    /// Waits until all messages so far are written, at most `patience`; returns whether they are.
    pub fn flush(&self, patience: Duration) -> bool {
        let (done, written) = sync_channel(1);
        self.ring.try_send(Message::Flush(done)).is_ok() && written.recv_timeout(patience).is_ok()
    }
}

/// The terminal behind standard error, shared by the whole program.
pub fn stderr() -> &'static Terminal {
    static TERMINAL: OnceLock<Terminal> = OnceLock::new();
    TERMINAL.get_or_init(|| {
        let screen = Screen::default();
        screen.is_that_of_stderr();
        Terminal::with(io::stderr(), screen)
    })
}

/// Columns of the terminal behind standard error; 80 if unknown.
pub fn columns() -> usize {
    rustix::termios::tcgetwinsize(io::stderr())
        .ok()
        .map(|size| usize::from(size.ws_col))
        .filter(|columns| *columns > 0)
        .unwrap_or(80)
}

/// Columns and rows of the terminal behind standard error; 80 x 24 if unknown.
pub fn size() -> (u16, u16) {
    rustix::termios::tcgetwinsize(io::stderr())
        .ok()
        .map(|size| (size.ws_col, size.ws_row))
        .filter(|(columns, rows)| *columns > 0 && *rows > 0)
        .unwrap_or((80, 24))
}

/// Sends the message of a panic to [`stderr`], so that a failing thread does not wait for a screen before it is noticed.
pub fn panics_do_not_wait() {
    let plain = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        // The program ends with its main thread, so no thread could write the message later.
        if thread::current().name() == Some("main") {
            give_back();
            plain(info);
        } else {
            stderr().say(&info.to_string());
        }
    }));
}

/// State of the terminal's own thread.
struct Writer<W> {
    out: W,
    live: bool,
    screen: Screen,
    pending: Arc<AtomicU64>,
    heard: Arc<Mutex<String>>,
}

impl<W: Write> Writer<W> {
    fn serve(&mut self, messages: &Receiver<Message>, dropped: &AtomicU64) {
        loop {
            let written = match messages.recv_timeout(Duration::from_secs(1)) {
                Ok(message) => self.write(message),
                Err(RecvTimeoutError::Timeout) => Ok(()),
                Err(RecvTimeoutError::Disconnected) => return,
            };
            // The terminal is gone: further messages are dropped and counted.
            if written.is_err_and(|error| error.kind() == io::ErrorKind::BrokenPipe) {
                return;
            }
            let lost = dropped.swap(0, Ordering::Relaxed);
            if lost > 0 {
                let _ = self.say(&format!(
                    "({lost} messages found the terminal not taking output)"
                ));
            }
        }
    }

    fn write(&mut self, message: Message) -> io::Result<()> {
        match message {
            Message::Flush(done) => {
                let flushed = self.out.flush();
                let _ = done.try_send(());
                flushed
            }
            Message::Say(text) => self.say(&text),
            Message::Show(_) | Message::Leave if self.screen.is_open() => Ok(()),
            Message::Show(line) => {
                self.live = !line.is_empty();
                let line = for_people(&line);
                let line = clean(&line, Colours::Kept);
                write!(self.out, "\r\x1b[K{line}").and_then(|()| self.out.flush())
            }
            Message::Leave if std::mem::take(&mut self.live) => {
                writeln!(self.out).and_then(|()| self.out.flush())
            }
            Message::Leave => Ok(()),
            Message::Open => self.screen.open(&mut self.out),
            Message::Draw(picture) => {
                let drawn = self.screen.draw(&mut self.out, &picture);
                self.pending.fetch_sub(1, Ordering::AcqRel);
                drawn
            }
            Message::Close => {
                let kept = self.screen.close(&mut self.out)?;
                kept.iter().try_for_each(|text| self.say(text))
            }
        }
    }

    fn say(&mut self, text: &str) -> io::Result<()> {
        let text = text.strip_suffix('\n').unwrap_or(text);
        let text = &*for_people(text);
        if self.screen.is_open() {
            let mut heard = self.heard.lock().unwrap_or_else(PoisonError::into_inner);
            *heard = clean(text.trim(), Colours::Removed).replace('\n', " ");
            self.screen.keep(text);
            return Ok(());
        }
        let end = if std::mem::take(&mut self.live) {
            "\r\x1b[K"
        } else {
            ""
        };
        let text = clean(text, Colours::Kept);
        writeln!(self.out, "{end}{text}").and_then(|()| self.out.flush())
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

/// Treatment of sequences that set colours.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Colours {
    /// They are kept: they change only the look of text.
    Kept,
    /// They are removed, like all others.
    Removed,
}

/// A text without terminal commands: removes control characters (except line ends and tabs), escape sequences, and marks that
/// change the direction of writing.
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
    use std::sync::Condvar;

    /// A terminal that accepts output only while the test allows it.
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
        // The terminal accepts nothing: if any call waited for it, the test would never end.
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
    fn what_is_said_while_the_whole_terminal_is_taken_is_told_when_it_is_given_back() {
        let screen = Screen::default();
        screen.go_on();
        let terminal = Terminal::new(screen.clone());
        terminal.say("before");
        terminal.open_screen();
        terminal.show("no live line");
        terminal.say("\x1b[31man event\x1b[0m");
        assert!(terminal.draw("\x1b[1;1Hpicture".to_string()));
        assert!(terminal.flush(Duration::from_secs(20)));
        assert!(terminal.can_draw());
        assert!(terminal.heard().ends_with("an event\u{fffd}[0m"));
        let text = screen.text();
        assert!(
            text.contains("picture") && !text.contains("an event"),
            "{text:?}"
        );
        terminal.close_screen(Duration::from_secs(20));
        assert!(!terminal.draw("too late".to_string()) || terminal.flush(Duration::from_secs(20)));
        let text = screen.text();
        assert!(
            !text.contains("live line") && !text.contains("too late"),
            "{text:?}"
        );
        let (taken, given) = (text.find("\x1b[?1049h"), text.find("\x1b[?1049l"));
        let told = text.find("an event");
        assert!(taken < given && given < told && told.is_some(), "{text:?}");
    }

    #[test]
    fn a_terminal_that_takes_no_output_gets_one_picture_and_is_not_waited_for() {
        let screen = Screen::default();
        let terminal = Terminal::new(screen.clone());
        terminal.open_screen();
        let drawn = (0..1000).filter(|_| terminal.can_draw() && terminal.draw("p".repeat(5000)));
        assert_eq!(drawn.count(), 1);
        terminal.close_screen(Duration::from_millis(1));
        screen.go_on();
        while !terminal.flush(Duration::from_secs(1)) {}
        assert!(
            screen.text().ends_with("\x1b[?1049l"),
            "{:?}",
            screen.text()
        );
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
