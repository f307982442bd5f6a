//! `cellpos watch`: the live page of a run, from its folder.

use crate::arguments::{positive, run_folder, span};
use crate::outcome::{CommandResult, Outcome};
use cellpos_numeric::units::Seconds;
use cellpos_session::view::{ViewAddress, Watch};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// Arguments of `cellpos watch`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  cellpos watch latest
  cellpos watch runs/20261121T090000Z-track --for 1min

The run may be over, or running in another program. The page may only look. It shows the last ten minutes. Ctrl-C ends it.")]
pub(crate) struct Args {
    /// The run folder.
    #[arg(value_parser = run_folder())]
    run: PathBuf,
    /// Address of the page; port 0: any free one.
    #[arg(long, default_value = "127.0.0.1:0")]
    view: SocketAddr,
    /// Let other machines reach the page, without encryption.
    #[arg(long)]
    view_unsafe_address: bool,
    /// Duration; default: until Ctrl-C.
    #[arg(long = "for", value_parser = positive::<Seconds>)]
    duration: Option<Seconds>,
}

/// Serves the page.
pub(crate) fn run(args: Args) -> CommandResult {
    const LOOK_EVERY: Duration = Duration::from_millis(100);
    /// The page's own thread empties its ring 25 times a second.
    const WHILE_FILLING: Duration = Duration::from_millis(45);
    let at = ViewAddress {
        address: args.view,
        beyond_this_machine: args.view_unsafe_address,
    };
    let mut watch = Watch::open(&args.run, at)?;
    eprintln!("page, to look: {}", watch.link());
    let start = Instant::now();
    let limit = args.duration.map(span);
    while limit.is_none_or(|limit| start.elapsed() < limit) {
        let more = watch.look()?;
        std::thread::sleep(if more { WHILE_FILLING } else { LOOK_EVERY });
    }
    Ok(Outcome::Done)
}
