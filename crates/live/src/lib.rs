//! The views of a running run: the live page in a browser, and the [`terminal`].
//!
//! A [`Feed`] takes rows, pictures, events and the state from the threads of a run. None of its calls waits. If a ring is full,
//! the item is dropped and counted. [`Server::start`] serves one page, which is part of the program, on its own threads:
//!
//! | thread | does | waits for |
//! |---|---|---|
//! | live-hub | rings -> messages, 25 times a second, into each client's queue | 40 ms |
//! | live-accept | new connections, at most [`MOST_CLIENTS`] | a connection |
//! | live-client | one client: its queue out, its requests in | 10 ms |
//!
//! A client's queue holds two seconds. If the client does not read it, the oldest message is dropped and counted. After five
//! seconds without progress the connection is closed. So a client can only slow itself down.
//!
//! There are two links, each with a random word: the operator's link may freeze, park and move; the viewer's link shows only. The
//! server checks host and origin of each request, so a page from elsewhere cannot reach it through the browser.
//!
//! The crate knows no camera, board or loop: the program that runs them fills a [`Feed`] and acts on [`OperatorRequest`]s.
//!
//! ```
//! use cellpos_live::{Feed, Hello, Row, Server, ServerConfig};
//!
//! let (mut feed, hub) = Feed::new(Hello { name: "hold".into(), period_us: 1000.0, ..Hello::default() });
//! let server = Server::start(&ServerConfig::default(), hub, |command| println!("{command:?}"))?;
//! println!("operator: {}", server.operator_url());
//! feed.row(&Row { time_s: 0.001, measured_um: 0.05, ..Row::default() });
//! drop(server); // ends its threads
//! # Ok::<(), cellpos_live::LiveError>(())
//! ```
#![forbid(unsafe_code)]
// Without the server, some parts of a feed have no reader.
#![cfg_attr(not(feature = "server"), allow(dead_code))]

#[cfg(feature = "server")]
mod access;
#[cfg(feature = "server")]
mod client;
mod command;
mod feed;
mod film;
#[cfg(feature = "server")]
mod http;
#[cfg(feature = "server")]
mod hub;
#[cfg(feature = "server")]
mod page;
#[cfg(feature = "server")]
mod queue;
mod row;
#[cfg(feature = "server")]
mod server;
#[cfg(feature = "server")]
mod shared;
mod state;
pub mod terminal;

#[cfg(feature = "server")]
pub use access::{Role, Secrets};
pub use command::{CommandError, OperatorRequest};
pub use feed::{Feed, FeedHub, Line, Lost, PictureFeed};
pub use film::{Film, FilmFrame, film_bytes};
pub use row::{OUTLINE_POINTS, PICTURE_MARGIN, Picture, Row};
#[cfg(feature = "server")]
pub use server::{LiveError, MOST_CLIENTS, Server, ServerConfig};
pub use state::{Banner, ClipLine, CycleRow, EventLine, Hello, LastWord, State};
