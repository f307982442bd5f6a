//! A run with a live page, and its well-behaved and misbehaving clients, in separate processes.

use cellpos_rig::Clock;
use cellpos_runtime::{EndRule, NoSink, Summary};
use cellpos_session::rig_file::{ClockKind, Frames};
use cellpos_session::setup::ReferenceSpec;
use cellpos_session::view::{Page, View, ViewAddress, Viewed, Wanted};
use cellpos_session::{Failure, Options, Rig, RigFile};
use std::io::Read;
use std::net::{SocketAddr, TcpStream};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use tungstenite::client::IntoClientRequest;
use tungstenite::{Message, WebSocket};

/// What a client of the page does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Client {
    /// Reads all that comes.
    Reads,
    /// Opens the line and reads nothing; let go, it comes again.
    Stalls,
    /// Asks as fast as it can for what makes no sense; let go, it comes again.
    Floods,
}

impl Client {
    const ALL: [(Self, &'static str); 3] = [
        (Self::Reads, "reads"),
        (Self::Stalls, "stalls"),
        (Self::Floods, "floods"),
    ];

    fn name(self) -> &'static str {
        Self::ALL
            .iter()
            .find(|(client, _)| *client == self)
            .map_or("", |(_, name)| name)
    }

    fn of(name: &str) -> Option<Self> {
        Self::ALL.iter().find(|(_, n)| *n == name).map(|(c, _)| *c)
    }

    /// Starts one for a page, for `seconds` at most.
    ///
    /// # Errors
    /// The program cannot be started again.
    pub fn start(self, url: &str, seconds: u64) -> std::io::Result<Running> {
        let child = Command::new(std::env::current_exe()?)
            .args(["client", self.name(), url, &seconds.to_string()])
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()?;
        Ok(Running(child))
    }
}

/// A program that ends when it is dropped.
pub struct Running(pub Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Whether the program was started as a client ([`Client::start`]); then it has been one, and is done.
pub fn was_a_client() -> bool {
    let arguments: Vec<String> = std::env::args().collect();
    let [_, first, name, url, seconds] = arguments.as_slice() else {
        return false;
    };
    let (Some(client), Ok(seconds)) = (Client::of(name), seconds.parse()) else {
        return false;
    };
    if first != "client" {
        return false;
    }
    let end = Instant::now() + Duration::from_secs(seconds);
    while Instant::now() < end {
        // Whatever ends it, it comes again.
        let _ = be(client, url, end);
        std::thread::sleep(Duration::from_millis(5));
    }
    true
}

/// The server closes a client that reads nothing for five seconds, once its buffers are full.
const LET_GO_AFTER: Duration = Duration::from_secs(7);

type Socket = WebSocket<TcpStream>;

fn connect(url: &str) -> Result<Socket, Box<dyn std::error::Error>> {
    let rest = url.strip_prefix("http://").ok_or("not a link")?;
    let (address, word) = rest.split_once("/?word=").ok_or("not a link")?;
    let mut request = format!("ws://{address}/live?word={word}").into_client_request()?;
    let origin = format!("http://{address}");
    request.headers_mut().insert("Origin", origin.parse()?);
    let stream = TcpStream::connect(address.parse::<SocketAddr>()?)?;
    stream.set_read_timeout(Some(Duration::from_millis(500)))?;
    stream.set_write_timeout(Some(Duration::from_millis(500)))?;
    let (socket, _) = tungstenite::client(request, stream).map_err(|e| e.to_string())?;
    Ok(socket)
}

fn be(client: Client, url: &str, end: Instant) -> Result<(), Box<dyn std::error::Error>> {
    let mut socket = connect(url)?;
    let begun = Instant::now();
    while Instant::now() < end {
        match client {
            Client::Reads => drop(socket.read()?),
            Client::Floods => socket.send(Message::text(r#"{"do":"nonsense"}"#))?,
            Client::Stalls => {
                std::thread::sleep(Duration::from_millis(200));
                // The server has let it go by now, which it does not see: it reads nothing.
                if begun.elapsed() > LET_GO_AFTER {
                    return Ok(());
                }
            }
        }
    }
    Ok(())
}

/// Holds a bead on the emulated rig for some seconds, with a page or without; `while_it_runs` gets the operator's link.
///
/// # Errors
/// The default rig does not run: a defect.
pub fn hold(
    seconds: u64,
    page: bool,
    while_it_runs: impl FnOnce(Option<&str>),
) -> Result<Summary, Failure> {
    let options = Options {
        clock: ClockKind::Real,
        frames: Frames::On,
        best_effort: false,
    };
    let mut rig = Rig::open(RigFile::load(None)?, options)?;
    let prepared = rig.prepare("eq6", "pi")?;
    let setup = rig.set_up(prepared, ReferenceSpec::Hold { position_um: 0.0 })?;
    let wanted = Wanted {
        page: Some(ViewAddress {
            address: SocketAddr::from(([127, 0, 0, 1], 0)),
            beyond_this_machine: false,
        }),
        screen: None,
    };
    let shown = Page {
        name: "bench".to_string(),
        subtitle: "the cost of a live page".to_string(),
        steered: true,
        script: false,
        notes: false,
    };
    let mut view = if page {
        Some(View::of(&wanted, &mut rig, &setup, &shown)?)
    } else {
        None
    };
    let ticks = (seconds as f64 * 1e6 / setup.config.timing.period_us) as u64;
    let end = EndRule {
        ticks: Some(ticks),
        ..EndRule::default()
    };
    let sink = Viewed::new(NoSink, view.as_mut());
    let running = rig.arm(&setup, setup.core()?, sink, end)?.start()?;
    let urls = view.as_ref().and_then(View::urls);
    while_it_runs(urls.as_ref().map(|[operator, _]| operator.as_str()));
    let finished = running.wait()?;
    Ok(finished.summary)
}

/// Waits until whoever started this program closes its standard input.
pub fn until_told() {
    let _ = std::io::stdin().read_to_end(&mut Vec::new());
}

/// Least squares slope of values over times.
pub fn slope(points: &[(f64, f64)]) -> f64 {
    let n = points.len() as f64;
    let mean = |of: fn(&(f64, f64)) -> f64| points.iter().map(of).sum::<f64>() / n;
    let (x, y) = (mean(|p| p.0), mean(|p| p.1));
    let across: f64 = points.iter().map(|p| (p.0 - x) * (p.1 - y)).sum();
    let along: f64 = points.iter().map(|p| (p.0 - x).powi(2)).sum();
    across / along
}

/// Seconds since some instant by the machine's clock.
pub fn now_s() -> f64 {
    Clock::Real.now_ns() as f64 * 1e-9
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slope_is_that_of_a_line() {
        let points: Vec<(f64, f64)> = (0..10)
            .map(|n| (f64::from(n), 3.0 - 2.0 * f64::from(n)))
            .collect();
        assert!((slope(&points) + 2.0).abs() < 1e-12);
    }

    #[test]
    fn every_client_is_found_by_its_name() {
        for (client, name) in Client::ALL {
            assert_eq!((client.name(), Client::of(name)), (name, Some(client)));
        }
        assert_eq!(Client::of("sleeps"), None);
    }
}
