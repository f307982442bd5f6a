//! Serves the page of a run; without the feature `page` there is no page.

use crate::failure::Failure;
use cellpos_live::{FeedHub, Film, OperatorRequest};
use std::net::SocketAddr;

#[cfg(feature = "page")]
pub(super) use cellpos_live::Server;

/// Address of the page.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ViewAddress {
    /// Address and port; port 0: any that is free.
    pub address: SocketAddr,
    /// Whether the user explicitly requested an address that other machines can reach.
    pub beyond_this_machine: bool,
}

/// Serves the page on separate threads under the ordinary scheduler, not the loop's.
///
/// # Errors
/// The address cannot be used, or other machines could reach it although the user did not request that.
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

/// The type of a served page; without the feature it has no value.
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
