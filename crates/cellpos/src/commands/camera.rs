//! `cellpos camera`: list of cameras, and a test of one.

use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use cellpos_drivers::sources::{self, Playback, Region};
use cellpos_numeric::units::Seconds;
use cellpos_rig::{Camera, CameraError, Clock, FrameBuffer};
use cellpos_workbench::line_test::Quantiles;
use serde::Serialize;
use std::path::PathBuf;
use std::time::Duration;

/// Arguments of `cellpos camera`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  cellpos camera\n  cellpos camera --address 192.168.1.20 --rate-hz 1000 --region 64x64+200+120\n  \
    cellpos camera --socket /tmp/rig/camera.sock --duration 10s\n  cellpos camera --rig rig.toml --snapshot frame.png --overlay\n  \
    cellpos camera --rig rig.toml --record beads/ --duration 5s\n  cellpos camera --rig rig.toml --find-beads beads.png"
)]
pub(crate) struct Args {
    /// IP address of a GigE camera, or identifier of a USB3 camera (needs the feature aravis).
    #[arg(long, group = "which")]
    address: Option<String>,
    /// Socket of a camera server, such as firmware-sim's.
    #[arg(long, group = "which")]
    socket: Option<PathBuf>,
    /// Recording, played at its frame rate.
    #[arg(long, group = "which")]
    recording: Option<PathBuf>,
    /// Expected frame rate, Hz.
    #[arg(long, default_value_t = 1000.0)]
    rate_hz: f64,
    /// Exposure of an industrial camera, us.
    #[arg(long)]
    exposure_us: Option<f64>,
    /// Camera of this rig.toml; with --snapshot, --record or --find-beads.
    #[arg(long, group = "which", requires = "of_rig")]
    rig: Option<PathBuf>,
    /// Write one frame of the rig's camera as a picture (.png) and print its brightness.
    #[arg(long, value_name = "FILE", requires = "rig", group = "of_rig")]
    snapshot: Option<PathBuf>,
    /// Record the rig's camera for --duration into this new folder, as PNG files for cellpos vision.
    #[arg(long, value_name = "FOLDER", requires = "rig", group = "of_rig")]
    record: Option<PathBuf>,
    /// Find the look of the beads in view, write [vision] into the rig file, and a picture (.png) with the beads marked.
    #[arg(long, value_name = "FILE", requires = "rig", group = "of_rig")]
    find_beads: Option<PathBuf>,
    /// Mark the bead or cell in the picture.
    #[arg(long, requires = "snapshot")]
    overlay: bool,
    /// Part of the sensor or of the recording: WIDTHxHEIGHT+X+Y, px.
    #[arg(long)]
    region: Option<Region>,
    /// From the middle of an exposure to its fastest arrival, ms.
    #[arg(long, default_value_t = 2.0)]
    latency_ms: f64,
    /// Duration.
    #[arg(long, default_value = "5s", value_parser = crate::arguments::positive::<Seconds>)]
    duration: Seconds,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// Upper ends of the histogram's classes, in frame intervals.
const CLASSES: [f64; 8] = [0.5, 0.9, 1.1, 1.5, 2.5, 10.0, 100.0, f64::INFINITY];
/// Share of the promised rate below which the camera does not keep its promise.
const RATE_KEPT: f64 = 0.9;

/// What a camera delivered.
#[derive(Debug, Serialize)]
struct Delivery {
    camera: String,
    width_px: usize,
    height_px: usize,
    watched_s: f64,
    frames: u64,
    rate_promised_hz: f64,
    rate_hz: f64,
    dropped: u64,
    doubled_or_stale: u64,
    longest_gap_ms: f64,
    interval_ms: Quantiles,
    age_ms: Quantiles,
    /// Upper end of each class in frame intervals (none: without end), and intervals in it.
    intervals: Vec<(Option<f64>, u64)>,
    ended: Option<String>,
    losses: Option<Losses>,
}

/// What an industrial camera's driver counted.
#[derive(Debug, Clone, Copy, Serialize)]
struct Losses {
    dropped: u64,
    doubled: u64,
    reordered: u64,
    stale: u64,
    incomplete: u64,
}

/// The cameras that answer.
#[derive(Debug, Serialize)]
struct Listing {
    industrial_cameras_supported: bool,
    cameras: Vec<Listed>,
    hint: String,
}

/// One of them.
#[derive(Debug, Serialize)]
pub(super) struct Listed {
    /// IP address; empty for a USB3 camera.
    pub(super) address: String,
    /// Identifier.
    pub(super) id: String,
    vendor: String,
    model: String,
    protocol: String,
}

/// Lists cameras, or watches one.
pub(crate) fn run(args: Args) -> CommandResult {
    let duration_s = args.duration.value();
    if !(duration_s.is_finite() && (0.1..=86_400.0).contains(&duration_s)) {
        let error = format!("--duration {}s: cannot watch for that long", duration_s);
        return Err(Failure::bad_input(error, "give 0.1s to 86400s"));
    }
    if !(args.rate_hz.is_finite() && (0.01..=1e6).contains(&args.rate_hz)) {
        return Err(Failure::bad_input(
            format!("--rate-hz {}: out of range", args.rate_hz),
            "give 0.01 to 1e6 Hz",
        ));
    }
    if let Some(rig) = &args.rig {
        return super::camera_of_rig::run(&super::camera_of_rig::Job {
            rig,
            snapshot: args.snapshot.as_deref(),
            overlay: args.overlay,
            record: args.record.as_deref(),
            find_beads: args.find_beads.as_deref(),
            duration_s,
            json: args.json,
        });
    }
    if let Some(path) = &args.socket {
        let patience = Duration::from_secs(2);
        let mut camera = cellpos_drivers::socket::SocketCamera::connect(
            path,
            args.rate_hz,
            args.latency_ms,
            patience,
        )
        .map_err(Failure::failed)?;
        return report(&args, watch(&mut camera, &args), None);
    }
    if let Some(path) = &args.recording {
        let recording = sources::open(path).map_err(Failure::input)?;
        let mut camera = Playback::new(recording, Some(args.rate_hz), args.region, Clock::Real)
            .map_err(Failure::input)?;
        return report(&args, watch(&mut camera, &args), None);
    }
    match &args.address {
        Some(address) => industrial(address, &args),
        None => list(&args),
    }
}

#[cfg(feature = "aravis")]
fn industrial(address: &str, args: &Args) -> CommandResult {
    use cellpos_drivers::sources::industrial::{IndustrialCamera, IndustrialSettings};
    let settings = IndustrialSettings {
        address: address.to_string(),
        region: args.region,
        rate_hz: args.rate_hz,
        exposure_us: args.exposure_us,
        bits: 8,
        latency_ms: args.latency_ms,
        buffers: 200,
    };
    let mut camera = IndustrialCamera::open(settings).map_err(Failure::failed)?;
    let delivery = watch(&mut camera, args);
    let c = camera.counts();
    let losses = Losses {
        dropped: c.dropped,
        doubled: c.doubled,
        reordered: c.reordered,
        stale: c.stale,
        incomplete: c.incomplete,
    };
    report(args, delivery, Some(losses))
}

#[cfg(not(feature = "aravis"))]
fn industrial(address: &str, args: &Args) -> CommandResult {
    let exposure = args
        .exposure_us
        .map(|e| format!(" at {e} us"))
        .unwrap_or_default();
    Err(Failure::bad_input(
        format!("camera {address}{exposure}: this program was built without industrial cameras"),
        WITHOUT_ARAVIS,
    ))
}

#[cfg(not(feature = "aravis"))]
const WITHOUT_ARAVIS: &str = "install libaravis-dev and libusb-1.0-0-dev, then build with: cargo build --release --features aravis";

#[cfg(feature = "aravis")]
pub(super) fn cameras() -> (bool, Vec<Listed>, String) {
    let found = sources::industrial::list().unwrap_or_default();
    let listed = found.into_iter().map(|c| Listed {
        address: c.address,
        id: c.id,
        vendor: c.vendor,
        model: c.model,
        protocol: c.protocol,
    });
    let listed: Vec<Listed> = listed.collect();
    let hint = if listed.is_empty() {
        "no industrial camera answers: check power and cable, and whether its address is in this machine's network"
    } else {
        "watch one with: cellpos camera --address ADDRESS"
    };
    (true, listed, hint.to_string())
}

#[cfg(not(feature = "aravis"))]
pub(super) fn cameras() -> (bool, Vec<Listed>, String) {
    (
        false,
        Vec::new(),
        format!("this program was built without industrial cameras: {WITHOUT_ARAVIS}"),
    )
}

fn list(args: &Args) -> CommandResult {
    let (industrial_cameras_supported, cameras, hint) = cameras();
    let listing = Listing {
        industrial_cameras_supported,
        cameras,
        hint,
    };
    if args.json {
        print_json(&listing)?;
        return Ok(Outcome::Done);
    }
    let mut text = String::new();
    for c in &listing.cameras {
        text.push_str(&format!(
            "{:16} {:24} {} {} ({})\n",
            c.address, c.id, c.vendor, c.model, c.protocol
        ));
    }
    text.push_str(&format!("{}\n", listing.hint));
    text.push_str("always there: --recording PATH, --socket PATH (start one with firmware-sim)\n");
    print_text(&text)?;
    Ok(Outcome::Done)
}

fn watch(camera: &mut dyn Camera, args: &Args) -> Delivery {
    let clock = Clock::Real;
    let mut buffer = FrameBuffer::default();
    let (mut arrivals_ms, mut ages_ms): (Vec<f64>, Vec<f64>) = (Vec::new(), Vec::new());
    let (mut dropped, mut not_new, mut last_id) = (0_u64, 0_u64, None::<u64>);
    let mut ended = None;
    let start_ns = clock.now_ns();
    let end_ns = start_ns + (args.duration.value() * 1e9) as i64;
    while clock.now_ns() < end_ns {
        match camera.next_frame(&mut buffer, end_ns.min(clock.now_ns() + 20_000_000)) {
            Ok(None) => {}
            Ok(Some(stamp)) => {
                match last_id {
                    Some(last) if stamp.id <= last => {
                        not_new += 1;
                        continue;
                    }
                    Some(last) => dropped += stamp.id - last - 1,
                    None => {}
                }
                last_id = Some(stamp.id);
                arrivals_ms.push((stamp.arrival_ns - start_ns) as f64 * 1e-6);
                ages_ms.push((stamp.arrival_ns - stamp.mid_exposure_ns) as f64 * 1e-6);
            }
            Err(CameraError::Gone { camera, problem }) => {
                ended = Some(format!("{camera}: {problem}"));
                break;
            }
            Err(error) => {
                ended = Some(error.to_string());
                break;
            }
        }
    }
    let info = camera.info();
    let intervals_ms: Vec<f64> = arrivals_ms.windows(2).map(|w| w[1] - w[0]).collect();
    let nominal_ms = 1e3 / args.rate_hz;
    let mut counts = [0_u64; CLASSES.len()];
    for interval_ms in &intervals_ms {
        let class = CLASSES
            .iter()
            .position(|end| interval_ms / nominal_ms <= *end)
            .unwrap_or(CLASSES.len() - 1);
        counts[class] += 1;
    }
    let span_ms: f64 = intervals_ms.iter().sum();
    Delivery {
        camera: info.name,
        width_px: info.width_px,
        height_px: info.height_px,
        watched_s: (clock.now_ns() - start_ns) as f64 * 1e-9,
        frames: arrivals_ms.len() as u64,
        rate_promised_hz: args.rate_hz,
        rate_hz: if span_ms > 0.0 {
            1e3 * intervals_ms.len() as f64 / span_ms
        } else {
            0.0
        },
        dropped,
        doubled_or_stale: not_new,
        longest_gap_ms: intervals_ms.iter().copied().fold(0.0, f64::max),
        interval_ms: Quantiles::of(&intervals_ms),
        age_ms: Quantiles::of(&ages_ms),
        intervals: CLASSES
            .iter()
            .map(|c| c.is_finite().then_some(*c))
            .zip(counts)
            .collect(),
        ended,
        losses: None,
    }
}

fn report(args: &Args, mut delivery: Delivery, losses: Option<Losses>) -> CommandResult {
    delivery.losses = losses;
    if args.json {
        print_json(&delivery)?;
    } else {
        print_text(&delivery.to_string())?;
    }
    let kept = delivery.frames > 1 && delivery.rate_hz >= RATE_KEPT * delivery.rate_promised_hz;
    Ok(if kept { Outcome::Done } else { Outcome::Broken })
}

impl std::fmt::Display for Delivery {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        writeln!(
            f,
            "{}: {} x {} px",
            self.camera, self.width_px, self.height_px
        )?;
        writeln!(
            f,
            "delivered   {} frames in {:.2} s: {:.1} Hz of {:.1} Hz promised",
            self.frames, self.watched_s, self.rate_hz, self.rate_promised_hz
        )?;
        writeln!(
            f,
            "lost        {} dropped, {} doubled or stale",
            self.dropped, self.doubled_or_stale
        )?;
        if let Some(l) = &self.losses {
            writeln!(
                f,
                "driver      {} dropped, {} doubled, {} reordered, {} stale, {} incomplete",
                l.dropped, l.doubled, l.reordered, l.stale, l.incomplete
            )?;
        }
        let line = |q: &Quantiles| {
            format!(
                "median {:.3} ms, p99 {:.3} ms, max {:.3} ms",
                q.p50, q.p99, q.max
            )
        };
        writeln!(f, "interval    {}", line(&self.interval_ms))?;
        writeln!(
            f,
            "age         {} (mid-exposure to arrival)",
            line(&self.age_ms)
        )?;
        let most = self
            .intervals
            .iter()
            .map(|(_, n)| *n)
            .max()
            .unwrap_or(0)
            .max(1);
        let mut low = 0.0;
        for (end, n) in &self.intervals {
            let bar = "#".repeat((40 * n).div_ceil(most) as usize);
            let range = match end {
                Some(end) => format!("{low:5.1} .. {end:5.1}"),
                None => format!("{low:5.1} ..      "),
            };
            writeln!(f, "  {range} intervals {n:8} {bar}")?;
            low = end.unwrap_or(low);
        }
        match &self.ended {
            Some(why) => writeln!(f, "ended       {why}"),
            None => Ok(()),
        }
    }
}
