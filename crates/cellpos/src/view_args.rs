//! `--view`: the live page of a run.

use cellpos_session::rig_file::ClockKind;
use cellpos_session::setup::Setup;
use cellpos_session::view::{self, Page, View, ViewAddress};
use cellpos_session::{Failure, Rig};
use std::net::SocketAddr;

/// Options of commands that show a live page.
#[derive(Debug, clap::Args)]
pub struct ViewArgs {
    /// Show the run in a browser: picture, traces, events, stop keys. Prints two links, one to act and one to look. Without an
    /// address: a free port of this machine.
    #[arg(long, value_name = "ADDRESS", num_args = 0..=1, default_missing_value = "127.0.0.1:0")]
    view: Option<SocketAddr>,
    /// Let other machines reach --view: whoever has the link can move the PZT, and nothing is encrypted. An SSH tunnel is safer:
    /// ssh -L 8000:127.0.0.1:PORT HOST.
    #[arg(long, requires = "view")]
    view_unsafe_address: bool,
}

impl ViewArgs {
    /// Serves the page and says where, if it is wanted.
    pub fn open(&self, rig: &mut Rig, setup: &Setup, page: &Page) -> Result<Option<View>, Failure> {
        let Some(address) = self.view else {
            return Ok(None);
        };
        if rig.options().clock == ClockKind::Virtual {
            return Err(Failure::bad_input(
                "--view shows a run as it happens, and on the virtual clock it is over before a page is drawn",
                "leave --clock virtual out, or look at the recorded run: cellpos watch RUN",
            ));
        }
        let at = ViewAddress {
            address,
            beyond_this_machine: self.view_unsafe_address,
        };
        let view = view::open(at, rig, setup, page)?;
        if !address.ip().is_loopback() {
            eprintln!(
                "warning: other machines can reach the live page; whoever has its link can move the PZT, and nothing is encrypted"
            );
        }
        eprintln!("{}", view.links());
        Ok(Some(view))
    }
}
