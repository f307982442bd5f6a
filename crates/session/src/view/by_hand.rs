//! The page of a PZT moved by hand, without a closed loop and without a recording.

use super::last_word;
use super::live_view::View;
use super::watcher::Watcher;
use crate::words::Level;
use cellpos_live::{Banner, Row};

/// One millisecond of a PZT moved by hand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HandStep {
    /// Time since the board was armed, ns.
    pub time_ns: i64,
    /// Commanded displacement, um.
    pub command_um: f64,
    /// Last seen position of the bead, um; NaN: none, or no camera.
    pub bead_um: f64,
    /// How late the command was, us.
    pub wake_us: f64,
}

/// Its feed of the page.
pub struct ByHand {
    watcher: Watcher,
    ticks: u64,
    told_ns: i64,
}

impl ByHand {
    /// Takes a view's page; `None`: another run has it.
    pub fn of(view: &mut View) -> Option<Self> {
        Some(Self {
            watcher: view.watcher.take()?,
            ticks: 0,
            told_ns: i64::MIN,
        })
    }

    /// Shows a millisecond and, a few times a second, the `state` (`running`, `frozen`) and its reason.
    pub fn step(&mut self, step: &HandStep, state: &'static str, reason: &str) {
        const TELL_EVERY_NS: i64 = 100_000_000;
        self.watcher.row(&Row {
            seq: self.ticks as u32,
            time_s: step.time_ns as f64 * 1e-9,
            measured_um: step.bead_um as f32,
            command_um: step.command_um as f32,
            wake_us: step.wake_us as f32,
            ..Row::default()
        });
        self.ticks += 1;
        if step.time_ns.saturating_sub(self.told_ns) >= TELL_EVERY_NS {
            self.told_ns = step.time_ns;
            self.watcher.state.time_s = step.time_ns as f64 * 1e-9;
            self.watcher.state.ticks = self.ticks;
            self.watcher.state.banner = Banner {
                state,
                reason: reason.to_string(),
            };
            self.watcher.tell_state();
        }
    }

    /// Tells what happened.
    pub fn tell(&mut self, time_ns: i64, text: String) {
        self.watcher.tell(time_ns, Level::Info, text);
    }

    /// Ends the page, for a reason in a sentence.
    pub fn over(mut self, reason: &str) {
        self.watcher.over(last_word::of_reason("stopped", reason));
    }
}
