//! The operator's view of a run, in a browser or on the whole terminal. A sink feeds it alongside the recording, and it returns the
//! operator's requests.
//!
//! [`View::open`] serves the page; [`Viewed`] wraps the run's own sink. Everything runs on the threads of recorder, page and screen.
//! The loop only reads the target, once a tick.

mod by_hand;
mod cycle;
mod hello;
mod last_word;
mod live_view;
mod pictures;
mod possible;
mod served;
mod tail;
mod viewed;
mod watch;
mod watcher;

pub use by_hand::{ByHand, HandStep};
pub use cellpos_live::{ClipLine, CycleRow, EventLine, Hello, State};
pub use cycle::cycle_row;
pub use hello::Page;
pub use live_view::{Pages, View, Wanted};
pub use served::ViewAddress;
pub use viewed::Viewed;
pub use watch::Watch;
pub use watcher::Shown;
