//! `--view` and `--tui`: the view of a running run.

use cellpos_session::live_line::Typed;
use cellpos_session::rig_file::ClockKind;
use cellpos_session::screen::ScreenConfig;
use cellpos_session::setup::Setup;
use cellpos_session::view::{Page, View, ViewAddress, Wanted};
use cellpos_session::{Failure, Rig};
use std::io::IsTerminal;
use std::net::SocketAddr;

/// Options of commands that show a live page.
#[derive(Debug, clap::Args)]
pub(crate) struct PageArgs {
    /// Show the run in a browser. Prints two links: one to act, one to look. Default address: a free port of this machine.
    #[arg(long, value_name = "ADDRESS", num_args = 0..=1, default_missing_value = "127.0.0.1:0")]
    view: Option<SocketAddr>,
    /// Let other machines reach --view, without encryption: everybody with the link can move the PZT. Safer: ssh -L 8000:127.0.0.1:PORT HOST.
    #[arg(long, requires = "view")]
    view_unsafe_address: bool,
}

/// Options of commands that show a live page, or the run on the whole terminal.
#[derive(Debug, clap::Args)]
pub(crate) struct ViewArgs {
    #[command(flatten)]
    page: PageArgs,
    /// Show the run on the whole terminal.
    #[arg(long)]
    tui: bool,
}

impl PageArgs {
    /// What is wanted of a page.
    ///
    /// # Errors
    /// The virtual clock.
    pub(crate) fn wanted(&self, clock: ClockKind) -> Result<Wanted, Failure> {
        let page = self.view.map(|address| ViewAddress {
            address,
            beyond_this_machine: self.view_unsafe_address,
        });
        if page.is_some() {
            on_real_clock("--view", clock)?;
        }
        Ok(Wanted { page, screen: None })
    }
}

fn on_real_clock(option: &str, clock: ClockKind) -> Result<(), Failure> {
    if clock == ClockKind::Real {
        return Ok(());
    }
    Err(Failure::bad_input(
        format!(
            "{option} shows a run as it happens, but on the virtual clock the run is over before a page is drawn"
        ),
        "leave --clock virtual out, or look at the recorded run: cellpos watch RUN",
    ))
}

impl ViewArgs {
    /// Whether the whole terminal is wanted: no live line is shown then.
    pub(crate) fn tui(&self) -> bool {
        self.tui
    }

    /// What is wanted; `keys` says on the terminal which keys do what.
    ///
    /// # Errors
    /// The virtual clock, or no terminal.
    pub(crate) fn wanted(
        &self,
        clock: ClockKind,
        keys: &'static str,
        typed: &Typed,
    ) -> Result<Wanted, Failure> {
        let mut wanted = self.page.wanted(clock)?;
        if self.tui {
            on_real_clock("--tui", clock)?;
            if !std::io::stderr().is_terminal() {
                return Err(Failure::bad_input(
                    "--tui needs a terminal behind standard error",
                    "leave it out, or do not redirect standard error",
                ));
            }
            let typed = typed.clone();
            wanted.screen = Some(ScreenConfig { keys, typed });
        }
        Ok(wanted)
    }

    /// Shows the next run on a rig and says where, if that is wanted.
    ///
    /// # Errors
    /// As [`ViewArgs::wanted`]; an address that cannot be listened on.
    pub(crate) fn open(
        &self,
        rig: &mut Rig,
        setup: &Setup,
        page: &Page,
        keys: &'static str,
        typed: &Typed,
    ) -> Result<Option<View>, Failure> {
        let wanted = self.wanted(rig.options().clock, keys, typed)?;
        if !wanted.is_any() {
            return Ok(None);
        }
        let view = View::of(&wanted, rig, setup, page)?;
        said(&view);
        Ok(Some(view))
    }
}

/// Says where a page is.
pub(crate) fn said(view: &View) {
    if view.is_reachable() {
        eprintln_or_keep(
            view,
            "warning: other machines can reach the live page; whoever has its link can move the PZT, and nothing is encrypted",
        );
    }
    if let Some(links) = view.links() {
        eprintln_or_keep(view, &links);
    }
}

/// On the terminal; if the screen has it, after the screen has released it.
fn eprintln_or_keep(view: &View, text: &str) {
    if view.has_screen() {
        cellpos_session::say::say(text);
    } else {
        crate::outcome::print_err(text);
    }
}
