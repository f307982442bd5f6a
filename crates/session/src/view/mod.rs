//! The live page of a run: a sink that feeds it beside the recording, and the operator's requests that come back.
//!
//! [`View::open`] starts the server; [`Viewed`] wraps the run's own sink. Everything happens on the recorder's thread and on
//! the server's own threads; the loop knows nothing of it but the target, which it reads once a tick.

mod pictures;
mod watch;
mod watcher;

pub use cellpos_live::{CycleRow, EventLine, State};
pub use watch::Watch;
pub use watcher::{Shown, Viewed};

use crate::connect;
use crate::failure::Failure;
use crate::rig::Rig;
use crate::setup::Setup;
use cellpos_control::design::bound_rms_um;
use cellpos_live::{Command, Feed, Hello, Server, ServerConfig};
use cellpos_rig::FrameWatch;
use cellpos_runtime::Request;
use cellpos_runtime::live::Operator;
use pictures::Pictures;
use std::f64::consts::PI;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};

/// Where the page is to be served.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ViewAddress {
    /// Address and port; port 0: any that is free.
    pub address: SocketAddr,
    /// Whether one that other machines can reach was asked for by name.
    pub beyond_this_machine: bool,
}

/// The page of a run.
pub struct View {
    server: Server,
    feed: Option<Feed>,
    notes: Option<Receiver<String>>,
}

/// What the page says of the run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Page {
    /// Its name.
    pub name: String,
    /// What runs, in a few words.
    pub subtitle: String,
    /// Whether the operator may set the target.
    pub steered: bool,
    /// Whether a script says where the bead is to be.
    pub script: bool,
}

/// Serves the page of the next run on a rig: its frames are shown, and its operator takes the page's requests.
///
/// # Errors
/// See [`View::open`].
pub fn open(at: ViewAddress, rig: &mut Rig, setup: &Setup, page: &Page) -> Result<View, Failure> {
    let hello = hello(rig, setup, page);
    let mut view = View::open(at, hello, rig.operator())?;
    if let Some(pictures) = view.pictures() {
        rig.watch(pictures);
    }
    Ok(view)
}

fn hello(rig: &Rig, setup: &Setup, page: &Page) -> Hello {
    let source = rig.source();
    let diffusion = connect::diffusion_um2_per_s(rig.file(), &setup.model);
    Hello {
        view_um: source.field_um,
        pictures: source.width_px > 0,
        ..hello_of(setup, diffusion, page)
    }
}

/// What set-up and diffusion coefficient (um^2/s) say of a run.
fn hello_of(setup: &Setup, diffusion: f64, page: &Page) -> Hello {
    let limits = setup.controller.limits;
    let timing = &setup.config.timing;
    let period_s = timing.period_us * 1e-6;
    let delay_s = timing.camera_delay_ms * 1e-3;
    Hello {
        name: page.name.clone(),
        subtitle: page.subtitle.clone(),
        period_us: timing.period_us,
        range_um: [limits.low_um, limits.high_um],
        slew_um_per_s: limits.slew_um_per_s,
        budget_us: timing.budget_us,
        bound_nm: (diffusion > 0.0).then(|| 1e3 * bound_rms_um(diffusion, 0.0, delay_s, period_s)),
        bound_spectrum: lowest_spectrum(diffusion, delay_s + period_s, 0.5 / period_s),
        steered: page.steered,
        script: page.script,
        ..Hello::default()
    }
}

/// Amplitude spectral density (nm/sqrt(Hz), one-sided) of the lowest possible error: Brownian motion of the last `blind_s`
/// seconds, which no command could answer yet, up to `end_hz`. Its square integrates to 2 D times `blind_s`.
fn lowest_spectrum(diffusion_um2_per_s: f64, blind_s: f64, end_hz: f64) -> Vec<[f64; 2]> {
    const POINTS: usize = 300;
    if diffusion_um2_per_s.is_nan() || diffusion_um2_per_s <= 0.0 {
        return vec![];
    }
    let low_hz = 0.5_f64.min(0.1 * end_hz);
    (0..=POINTS)
        .map(|n| {
            let hz = low_hz * (end_hz / low_hz).powf(n as f64 / POINTS as f64);
            let per_s = PI * hz;
            let density = 4.0 * diffusion_um2_per_s * ((per_s * blind_s).sin() / per_s).powi(2);
            [hz, 1e3 * density.sqrt()]
        })
        .collect()
}

impl View {
    /// Serves the page. The operator's requests go to `operator`.
    ///
    /// # Errors
    /// The address cannot be listened on, or others could reach it without having been asked for.
    pub fn open(at: ViewAddress, hello: Hello, operator: &Arc<Operator>) -> Result<Self, Failure> {
        let (feed, hub) = Feed::new(hello);
        let (noted, notes) = channel();
        let operator = Arc::clone(operator);
        let config = ServerConfig {
            address: at.address,
            beyond_this_machine: at.beyond_this_machine,
            on_thread: None,
        };
        let server = Server::start(&config, hub, move |command| act(command, &operator, &noted))
            .map_err(|error| Failure::bad_input(error, "--view 127.0.0.1:0 takes any free port"))?;
        Ok(Self {
            server,
            feed: Some(feed),
            notes: Some(notes),
        })
    }

    /// The links, to be printed.
    pub fn links(&self) -> String {
        format!(
            "live page, to act:  {}\nlive page, to look: {}",
            self.server.operator_url(),
            self.server.viewer_url()
        )
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.server.address()
    }

    /// What shows it the camera's frames; once.
    pub fn pictures(&mut self) -> Option<Box<dyn FrameWatch>> {
        let feed = self.feed.as_mut()?.take_pictures()?;
        Some(Box::new(Pictures::new(feed)))
    }
}

fn act(command: Command, operator: &Operator, noted: &Sender<String>) {
    match command {
        // A freeze that does not end the run: whoever looks on may want to go on.
        Command::Freeze | Command::Pause => operator.ask(Request::Pause),
        Command::Resume => {
            let _ = operator.change(Request::Pause, Request::None);
        }
        Command::Park => operator.ask(Request::Park),
        Command::Skip => operator.ask(Request::Skip),
        Command::Target { um } => operator.steer(um),
        // The run is over: nobody takes notes any more.
        Command::Note { text } => drop(noted.send(text)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_lowest_spectrum_integrates_to_the_lowest_error() {
        let (diffusion, blind_s) = (0.33, 3e-3);
        let spectrum = lowest_spectrum(diffusion, blind_s, 50_000.0);
        let below = spectrum[0][0] * spectrum[0][1].powi(2);
        let squares: f64 = spectrum
            .windows(2)
            .map(|pair| 0.5 * (pair[1][0] - pair[0][0]) * (pair[0][1].powi(2) + pair[1][1].powi(2)))
            .sum();
        let rms_nm = (squares + below).sqrt();
        let bound_nm = 1e3 * bound_rms_um(diffusion, 0.0, 2e-3, 1e-3);
        assert!(
            (rms_nm / bound_nm - 1.0).abs() < 0.02,
            "{rms_nm} {bound_nm}"
        );
        assert!(lowest_spectrum(0.0, blind_s, 500.0).is_empty());
    }
}
