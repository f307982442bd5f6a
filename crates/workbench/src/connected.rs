//! What is found when the devices of a rig file are opened.

use crate::bench::Bench;
use crate::check::{Finding, Weight};
use crate::line_test::{self, LineTest, Quantiles};
use cellpos_rig::{Actuator, Clock, FrameBuffer};
use cellpos_session::Failure;
use serde::Serialize;

/// What was found behind the file.
#[derive(Debug, Clone, Serialize)]
pub struct Connected {
    /// The board and its line.
    pub board: LineTest,
    /// The camera's name.
    pub camera: String,
    /// Its frames, px.
    pub size_px: [usize; 2],
    /// Frames a second over a second.
    pub rate_hz: f64,
    /// From mid-exposure to arrival, ms.
    pub age_ms: Quantiles,
    /// What does not fit to the file.
    pub findings: Vec<Finding>,
}

/// Opens board and camera. Nothing moves.
///
/// # Errors
/// One of them is not there, or does not answer.
pub fn connect(bench: &Bench) -> Result<Connected, Failure> {
    const PINGS: u32 = 200;
    const WATCH_NS: i64 = 1_000_000_000;
    let file = bench.file();
    let mut board = bench.board()?;
    let line = line_test::run(&mut board, PINGS)?;
    let info = board.info();
    let mut camera = bench.camera()?;
    let mut buffer = FrameBuffer::default();
    let clock = Clock::Real;
    // What had piled up while the board was asked is old.
    while camera
        .next_frame(&mut buffer, clock.now_ns())
        .map_err(Failure::failed)?
        .is_some()
    {}
    let start_ns = clock.now_ns();
    let mut ages_ms = Vec::new();
    while clock.now_ns() < start_ns + WATCH_NS {
        if let Some(stamp) = camera
            .next_frame(&mut buffer, start_ns + WATCH_NS)
            .map_err(Failure::failed)?
        {
            ages_ms.push((stamp.arrival_ns - stamp.mid_exposure_ns) as f64 * 1e-6);
        }
    }
    let rate_hz = ages_ms.len() as f64 / ((clock.now_ns() - start_ns) as f64 * 1e-9);
    let age_ms = Quantiles::of(ages_ms);
    let mut findings = Vec::new();
    let mut say = |key: &str, what: String, remedy: &str| {
        findings.push(Finding {
            weight: Weight::Warning,
            line: None,
            key: key.to_string(),
            value: String::new(),
            what,
            remedy: remedy.to_string(),
        });
    };
    let promised_hz = 1e6 / file.timing.period_us;
    if rate_hz < 0.9 * promised_hz {
        say(
            "timing.period_us",
            format!(
                "the camera delivers {rate_hz:.0} Hz, [timing] period_us promises {promised_hz:.0} Hz"
            ),
            "smaller region, shorter exposure, faster link: cellpos camera shows which frames are missing",
        );
    }
    if (age_ms.p50 - file.timing.camera_delay_ms).abs() > 0.5 * file.timing.period_us * 1e-3 {
        say(
            "timing.camera_delay_ms",
            format!(
                "frames are {:.2} ms old on arrival (median), camera_delay_ms says {}",
                age_ms.p50, file.timing.camera_delay_ms
            ),
            "cellpos identify measures the delay with the LED",
        );
    }
    if line.lost > 0 {
        say(
            "",
            format!("{} of {} pings were lost", line.lost, line.sent),
            "cable, baud rate, another program on the port?",
        );
    }
    let own = &file.limits;
    if own.low_um < info.low_um
        || own.high_um > info.high_um
        || own.slew_um_per_s > info.slew_um_per_s
    {
        say(
            "limits",
            format!(
                "[limits] are wider than the board's {} to {} um at {} um/s",
                info.low_um, info.high_um, info.slew_um_per_s
            ),
            "the board's hold; write them into the file so that it says what is so",
        );
    }
    Ok(Connected {
        board: line,
        camera: camera.info().name,
        size_px: [buffer.width, buffer.height],
        rate_hz,
        age_ms,
        findings,
    })
}
