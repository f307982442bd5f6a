//! The thread that draws, and the terminal while it has it.

use super::ScreenConfig;
use super::ansi::Ansi;
use super::draw;
use super::history::History;
use crate::beside::beside_the_loop;
use cellpos_live::terminal::Terminal;
use cellpos_live::{FeedHub, Line};
use ratatui::Terminal as Cells;
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// Time between two pictures.
const EVERY: Duration = Duration::from_millis(100);
/// Longest wait for the terminal when the screen releases it.
const PATIENCE: Duration = Duration::from_secs(1);

/// The terminal while a run has it. Dropping it releases the terminal.
pub struct Screen {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Screen {
    /// Takes the terminal behind standard error.
    ///
    /// # Errors
    /// Standard error is not a terminal, or no thread could be started.
    pub fn open(config: &ScreenConfig, hub: FeedHub) -> io::Result<Self> {
        if !io::IsTerminal::is_terminal(&io::stderr()) {
            return Err(io::Error::other(
                "--tui needs a terminal behind standard error",
            ));
        }
        let terminal = cellpos_live::terminal::stderr();
        terminal.open_screen();
        let stop = Arc::new(AtomicBool::new(false));
        let mut shown = Shown {
            hub,
            history: History::default(),
            config: config.clone(),
        };
        let asked = Arc::clone(&stop);
        let thread = std::thread::Builder::new()
            .name("cellpos-screen".to_string())
            .spawn(move || {
                beside_the_loop();
                shown.serve(terminal, &asked);
            });
        match thread {
            Ok(thread) => Ok(Self {
                stop,
                thread: Some(thread),
            }),
            Err(error) => {
                terminal.close_screen(PATIENCE);
                Err(error)
            }
        }
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            // A thread that panicked has drawn nothing further.
            let _ = thread.join();
        }
        cellpos_live::terminal::stderr().close_screen(PATIENCE);
    }
}

struct Shown {
    hub: FeedHub,
    history: History,
    config: ScreenConfig,
}

impl Shown {
    fn serve(&mut self, terminal: &Terminal, stop: &AtomicBool) {
        let Ok(mut cells) = Cells::new(Ansi::default());
        while !stop.load(Ordering::Acquire) {
            self.take();
            self.history.said = terminal.heard();
            if terminal.can_draw() {
                self.picture(&mut cells);
                let sequence = cells.backend_mut().take();
                if !terminal.draw(sequence) {
                    // The contents of the terminal are unknown now.
                    let _ = cells.clear();
                }
            }
            std::thread::sleep(EVERY);
        }
    }

    fn take(&mut self) {
        let cell = self.hub.hello().cell;
        while let Some(row) = self.hub.next_row() {
            self.history.row(&row);
        }
        while let Some(line) = self.hub.next_line() {
            match line {
                Line::State(state) => self.history.state(*state, cell),
                Line::Event(event) => self.history.event(event, cell),
                Line::Cycle(cycle) => self.history.cycle(cycle),
                Line::Clip(_) => {}
            }
        }
    }

    fn picture(&mut self, cells: &mut Cells<Ansi>) {
        let (hello, typed) = (self.hub.hello(), self.config.typed.text());
        // Drawing into memory cannot fail.
        let _ = cells.draw(|frame| {
            draw::screen(frame, hello, &self.history, self.config.keys, &typed);
        });
    }
}
