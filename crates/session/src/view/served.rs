//! The page of a run, served; without the feature `page` there is none.

use crate::failure::Failure;
use cellpos_live::{FeedHub, Film, OperatorRequest};
use std::net::SocketAddr;

#[cfg(feature = "page")]
pub(super) use cellpos_live::Server;

/// Where the page is to be served.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ViewAddress {
    /// Address and port; port 0: any that is free.
    pub address: SocketAddr,
    /// Whether one that other machines can reach was asked for by name.
    pub beyond_this_machine: bool,
}

/// Serves the page on threads of its own: the ordinary scheduler, not the loop's.
///
/// # Errors
/// The address cannot be listened on, or others could reach it without having been asked for.
#[cfg(feature = "page")]
pub(super) fn serve(
    at: ViewAddress,
    film: Film,
    hub: FeedHub,
    act: impl Fn(OperatorRequest) + Send + Sync + 'static,
) -> Result<Server, Failure> {
    let config = cellpos_live::ServerConfig {
        address: at.address,
        beyond_this_machine: at.beyond_this_machine,
        on_thread: Some(std::sync::Arc::new(crate::beside::beside_the_loop)),
        film: Some(film),
    };
    Server::start(&config, hub, act)
        .map_err(|error| Failure::bad_input(error, "127.0.0.1:0 takes any free port"))
}

/// A page that is being served: none is.
#[cfg(not(feature = "page"))]
pub(super) enum Server {}

#[cfg(not(feature = "page"))]
pub(super) fn serve(
    _: ViewAddress,
    _: Film,
    _: FeedHub,
    _: impl Fn(OperatorRequest) + Send + Sync + 'static,
) -> Result<Server, Failure> {
    Err(Failure::bad_input(
        "this program was built without the live page",
        "build it with the feature page",
    ))
}

#[cfg(not(feature = "page"))]
impl Server {
    pub(super) fn address(&self) -> SocketAddr {
        match *self {}
    }

    pub(super) fn operator_url(&self) -> String {
        match *self {}
    }

    pub(super) fn viewer_url(&self) -> String {
        match *self {}
    }
}
