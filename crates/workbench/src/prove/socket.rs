//! Tests whether a camera server conforms to docs/camera-socket.md: headers byte by byte, numbers, times, losses, back-pressure,
//! reconnection.

use super::sheet::Sheet;
use crate::line_test::Quantiles;
use cellpos_link::frames::{FrameHeader, HEADER_LEN};
use cellpos_rig::clock::monotonic_ns;
use std::io::{ErrorKind, Read};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::time::Duration;

/// The lines of a camera server, in the order of the test.
pub const LINES: [&str; 9] = [
    "begins with a whole frame",
    "headers",
    "numbers rise",
    "exposures in order",
    "stamps on CLOCK_MONOTONIC",
    "rate of the stamps",
    "a reader that pauses loses whole frames",
    "frames that waited",
    "a second connection",
];

const fn of(name: &'static str) -> (&'static str, &'static str) {
    ("socket", name)
}

/// A frame as it came.
struct Came {
    header: FrameHeader,
    at_ns: i64,
}

/// What ended the reading.
enum Trouble {
    Silent,
    Closed,
    Broken(String),
}

impl Trouble {
    fn words(&self) -> String {
        match self {
            Self::Silent => "no frame for 2 s".to_string(),
            Self::Closed => "the server closed the connection".to_string(),
            Self::Broken(what) => what.clone(),
        }
    }
}

/// A connection that trusts nothing.
struct Client {
    stream: UnixStream,
    pixels: Vec<u8>,
}

impl Client {
    fn connect(path: &Path) -> Result<Self, String> {
        let stream = UnixStream::connect(path)
            .map_err(|error| format!("{}: cannot connect: {error}", path.display()))?;
        stream
            .set_read_timeout(Some(Duration::from_secs(2)))
            .map_err(|error| error.to_string())?;
        Ok(Self {
            stream,
            pixels: Vec::new(),
        })
    }

    fn fill(stream: &mut UnixStream, out: &mut [u8]) -> Result<(), Trouble> {
        stream.read_exact(out).map_err(|error| match error.kind() {
            ErrorKind::WouldBlock | ErrorKind::TimedOut => Trouble::Silent,
            ErrorKind::UnexpectedEof | ErrorKind::ConnectionReset => Trouble::Closed,
            _ => Trouble::Broken(error.to_string()),
        })
    }

    /// The next frame, its header checked to the last byte.
    fn next(&mut self) -> Result<Came, Trouble> {
        let mut head = [0; HEADER_LEN];
        Self::fill(&mut self.stream, &mut head)?;
        let header =
            FrameHeader::from_bytes(&head).map_err(|error| Trouble::Broken(error.to_string()))?;
        // Fields that the decoder ignores are tested, too: the header's length, and zeros.
        if header.to_bytes() != head {
            let at = (0..HEADER_LEN).find(|at| header.to_bytes().get(*at) != head.get(*at));
            return Err(Trouble::Broken(format!(
                "header of frame {}: byte {} is not what the page says",
                header.frame_id,
                at.unwrap_or(0)
            )));
        }
        self.pixels.resize(header.pixel_bytes(), 0);
        Self::fill(&mut self.stream, &mut self.pixels)?;
        Ok(Came {
            header,
            at_ns: monotonic_ns(),
        })
    }
}

/// Runs every test for a time, with the server of a socket that promises a rate.
pub fn socket(sheet: &mut Sheet, path: &Path, rate_hz: f64, duration_s: f64) {
    match Client::connect(path) {
        Ok(client) => tried(sheet, client, path, rate_hz, duration_s),
        Err(error) => {
            sheet.judge(
                of("begins with a whole frame"),
                false,
                (None, ""),
                "a server listens",
                error,
            );
        }
    }
    sheet.complete("socket", &LINES, "not reached: a line above says why");
}

fn tried(sheet: &mut Sheet, mut client: Client, path: &Path, rate_hz: f64, duration_s: f64) {
    let start_ns = monotonic_ns();
    let first = client.next();
    let ms = (monotonic_ns() - start_ns) as f64 * 1e-6;
    let words = first.as_ref().err().map(Trouble::words);
    sheet.judge(
        of("begins with a whole frame"),
        first.is_ok(),
        (ms, "ms"),
        "a whole frame within 2 s of connecting",
        words.unwrap_or_default(),
    );
    let Ok(first) = first else { return };
    let mut frames = vec![first];
    let end_ns = monotonic_ns() + (duration_s * 1e9) as i64;
    let mut trouble = None;
    while monotonic_ns() < end_ns {
        match client.next() {
            Ok(came) => frames.push(came),
            Err(error) => {
                trouble = Some(error);
                break;
            }
        }
    }
    headers(sheet, &frames, trouble.as_ref());
    numbers(sheet, &frames);
    times(sheet, &frames, rate_hz);
    if trouble.is_none() {
        pauses(sheet, &mut client, rate_hz);
        connects_again(sheet, client, path);
    }
}

fn headers(sheet: &mut Sheet, frames: &[Came], trouble: Option<&Trouble>) {
    let size = |came: &Came| (came.header.width, came.header.height, came.header.bits);
    let same = frames.windows(2).all(|pair| match pair {
        [a, b] => size(a) == size(b),
        _ => true,
    });
    let (width, height, bits) = frames.first().map_or((0, 0, 0), size);
    let note = match trouble {
        Some(trouble) => trouble.words(),
        None if !same => "size or depth changed on the way".to_string(),
        None => format!("{width} x {height} px, {bits} bits"),
    };
    sheet.judge(
        of("headers"),
        same && trouble.is_none(),
        (frames.len() as f64, "frames"),
        "each of 64 bytes as the page says, pixels of the length that it names, one size",
        note,
    );
}

fn numbers(sheet: &mut Sheet, frames: &[Came]) {
    let (mut lost, mut back) = (0, 0);
    for pair in frames.windows(2) {
        if let [a, b] = pair {
            match b.header.frame_id.checked_sub(a.header.frame_id) {
                Some(step @ 1..) => lost += step - 1,
                _ => back += 1,
            }
        }
    }
    sheet.judge(
        of("numbers rise"),
        back == 0,
        (lost as f64, "lost"),
        "each number above the one before; a gap is a loss",
        format!("{back} did not rise"),
    );
}

/// Compares stamps with each other and with the time of arrival.
fn times(sheet: &mut Sheet, frames: &[Came], rate_hz: f64) {
    let period_ns = 1e9 / rate_hz;
    let mid_ns = |came: &Came| came.header.mid_exposure_ns as f64;
    let (mut disordered, mut early, mut long) = (0, 0, 0);
    let mut ages_ms = Vec::new();
    for came in frames {
        let (mid, sent) = (mid_ns(came), came.header.sent_ns as f64);
        early += usize::from(sent < mid || (came.at_ns as f64) < sent);
        long += usize::from(f64::from(came.header.exposure_ns) > period_ns * 1.001);
        ages_ms.push((came.at_ns as f64 - mid) * 1e-6);
    }
    for pair in frames.windows(2) {
        if let [a, b] = pair {
            disordered += usize::from(mid_ns(b) <= mid_ns(a));
        }
    }
    sheet.judge(
        of("exposures in order"),
        disordered == 0 && long == 0,
        (disordered as f64, ""),
        "each later than the one before, and no longer than a period",
        format!(
            "{long} exposures longer than a period of {:.3} ms",
            period_ns * 1e-6
        ),
    );
    let age = Quantiles::of(&ages_ms);
    sheet.judge(
        of("stamps on CLOCK_MONOTONIC"),
        early == 0 && age.p50 < 1000.0,
        (age.p50, "ms"),
        "middle of the exposure before the hand-over, that before the arrival; median age below 1 s",
        format!("{early} out of order; age 99 of 100 below {:.3} ms, largest {:.3} ms", age.p99, age.max),
    );
    let span = frames.first().zip(frames.last()).map(|(a, b)| {
        let exposed = b.header.frame_id.saturating_sub(a.header.frame_id) as f64;
        exposed / ((mid_ns(b) - mid_ns(a)) * 1e-9)
    });
    let rate = span.unwrap_or(f64::NAN);
    // The loop accepts a clock error of 200 ppm. The rate sets the loop's period, so it must be right to a hundredth.
    sheet.judge(
        of("rate of the stamps"),
        (rate / rate_hz - 1.0).abs() < 0.01,
        (rate, "Hz"),
        format!("{rate_hz} Hz to a hundredth, by numbers and stamps"),
        "",
    );
}

/// A reader that pauses for a second must get whole frames afterwards, with a gap in their numbers, and few old ones.
fn pauses(sheet: &mut Sheet, client: &mut Client, rate_hz: f64) {
    const PAUSE: Duration = Duration::from_secs(1);
    let Ok(before) = client.next() else { return };
    std::thread::sleep(PAUSE);
    let resumed_ns = monotonic_ns();
    let (mut waited, mut jump, mut last, mut trouble) =
        (0_u64, 0_u64, before.header.frame_id, None);
    // Frames from before the reader's return have waited; the first newer frame ends the search.
    for _ in 0..(3.0 * rate_hz) as usize + 100 {
        match client.next() {
            Ok(came) => {
                jump = jump.max(came.header.frame_id.saturating_sub(last));
                last = came.header.frame_id;
                if came.header.mid_exposure_ns as i64 > resumed_ns {
                    break;
                }
                waited += 1;
            }
            Err(error) => {
                trouble = Some(error.words());
                break;
            }
        }
    }
    // Frames exposed in the pause that never come were dropped: the numbers must show it.
    let exposed = rate_hz * PAUSE.as_secs_f64();
    let accounted = jump > 1 || waited as f64 > 0.8 * exposed;
    sheet.judge(
        of("a reader that pauses loses whole frames"),
        trouble.is_none() && accounted,
        (jump.saturating_sub(1) as f64, "lost"),
        "after a pause of 1 s whole frames follow, and the gap is in the numbers",
        trouble.unwrap_or_default(),
    );
    sheet.judge(
        of("frames that waited"),
        (waited as f64) < 0.2 * exposed,
        (waited as f64, "frames"),
        format!(
            "below {:.0}: frames that wait in the socket arrive old",
            0.2 * exposed
        ),
        "of a pause of 1 s; the socket's send buffer holds them",
    );
}

fn connects_again(sheet: &mut Sheet, mut old: Client, path: &Path) {
    let start_ns = monotonic_ns();
    let second = Client::connect(path).and_then(|mut client| {
        let first = client.next().map_err(|error| error.words())?;
        Ok((client, first))
    });
    let ms = (monotonic_ns() - start_ns) as f64 * 1e-6;
    // The server continues to serve the old connection, frame by frame, or closes it. It never gets out of step.
    let end_ns = monotonic_ns() + 500_000_000;
    let mut old_ended = String::new();
    while old_ended.is_empty() && monotonic_ns() < end_ns {
        old_ended = match old.next() {
            Ok(_) => continue,
            Err(Trouble::Closed | Trouble::Silent) => "the first one is over".to_string(),
            Err(Trouble::Broken(what)) => format!("broken: {what}"),
        };
    }
    let note = second
        .as_ref()
        .err()
        .cloned()
        .unwrap_or_else(|| match old_ended.as_str() {
            "" => "the first one is served on".to_string(),
            ended => ended.to_string(),
        });
    sheet.judge(
        of("a second connection"),
        second.is_ok() && !old_ended.starts_with("broken"),
        (ms, "ms"),
        "begins with a whole frame; the first one is served on or closed, never out of step",
        note,
    );
}
