//! A run on the whole terminal: state, traces, gauge, events and cycles, for a machine with SSH access only.
//!
//! ```text
//! recorder thread -> ring -> screen thread (a picture of cells) -> terminal thread -> terminal
//! ```
//!
//! The screen thread draws ten times a second and never writes: it passes the picture to [`cellpos_live::terminal`], and only the thread
//! there waits for the terminal. If the previous picture is not written yet, the new one is skipped, and the next one is drawn
//! completely.

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

/// The terminal of a run. Without the feature `screen` no run has one.
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
