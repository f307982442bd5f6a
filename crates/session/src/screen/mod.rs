//! A run on the whole terminal: state, traces, gauge, events and cycles, for a machine that is reached by SSH alone.
//!
//! ```text
//! recorder thread -> ring -> screen thread (a picture of cells) -> terminal thread -> terminal
//! ```
//!
//! The screen thread draws ten times a second and never writes: its drawing goes to [`cellpos_live::terminal`], and only its thread
//! waits for the terminal. A picture that finds the one before it unwritten is left out, and the next one is drawn whole.

#[cfg(feature = "screen")]
mod ansi;
#[cfg(feature = "screen")]
mod draw;
#[cfg(feature = "screen")]
mod history;
#[cfg(feature = "screen")]
mod shown;

#[cfg(feature = "screen")]
pub use shown::Screen;

use crate::live_line::Typed;

/// Further texts of the screen.
#[derive(Debug, Clone, Default)]
pub struct ScreenConfig {
    /// Which keys do what.
    pub keys: &'static str,
    /// Number that the operator is typing.
    pub typed: Typed,
}

/// The terminal while a run has it: built without the feature `screen`, no run has.
#[cfg(not(feature = "screen"))]
pub enum Screen {}

#[cfg(not(feature = "screen"))]
impl Screen {
    /// Refuses.
    ///
    /// # Errors
    /// Always: the feature is missing.
    pub fn open(_: &ScreenConfig, _: cellpos_live::FeedHub) -> std::io::Result<Self> {
        Err(std::io::Error::other(
            "this program was built without the feature screen, the view on the whole terminal",
        ))
    }
}
