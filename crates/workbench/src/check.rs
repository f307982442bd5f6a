//! What does not fit together in a rig file that reads well, and what is found when its devices are opened.

use crate::bench::Bench;
use crate::line_test::{self, LineTest, Quantiles};
use cellpos_rig::{Actuator, Clock, FrameBuffer};
use cellpos_session::rig_file::{ActuatorConfig, CameraConfig};
use cellpos_session::{Failure, RigFile};
use serde::Serialize;
use std::path::Path;

/// How much a finding matters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Weight {
    /// It cannot work.
    Error,
    /// It may work, and should be looked at.
    Warning,
}

/// Something that does not fit.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Finding {
    /// How much it matters.
    pub weight: Weight,
    /// Line of the key in the file; none for what is not there.
    pub line: Option<usize>,
    /// Key and value, and why it does not fit.
    pub what: String,
    /// What would be right.
    pub remedy: String,
}

/// What does not fit together in a file that was read from `path`.
pub fn findings(file: &RigFile, path: &Path) -> Vec<Finding> {
    let text = std::fs::read_to_string(path).unwrap_or_default();
    let mut found = Vec::new();
    let mut say = |weight, key: &str, what: String, remedy: &str| {
        found.push(Finding {
            weight,
            line: line_of(&text, key),
            what,
            remedy: remedy.to_string(),
        });
    };
    use Weight::{Error, Warning};
    let timing = &file.timing;
    let period_ms = timing.period_us * 1e-3;
    let (rate_hz, exposure_us) = match &file.camera {
        CameraConfig::Emulated {} => (file.emulator.rate_hz, Some(file.emulator.exposure_ms * 1e3)),
        CameraConfig::Socket { rate_hz, .. } => (*rate_hz, None),
        CameraConfig::Industrial {
            rate_hz,
            exposure_us,
            ..
        } => (*rate_hz, *exposure_us),
    };
    if (rate_hz * timing.period_us * 1e-6 - 1.0).abs() > 0.01 {
        say(
            Error,
            "rate",
            format!(
                "the camera's {rate_hz} Hz is a frame each {} us, [timing] period_us is {}",
                (1e6 / rate_hz).round(),
                timing.period_us
            ),
            "make period_us one million divided by the rate: the loop makes one tick a frame",
        );
    }
    if let Some(us) = exposure_us.filter(|us| *us > 1e6 / rate_hz) {
        say(
            Error,
            "exposure",
            format!("an exposure of {us} us does not fit into a frame of {rate_hz} Hz"),
            "shorten the exposure, or lower the rate",
        );
    }
    if timing.oldest_ms <= timing.camera_delay_ms {
        say(
            Error,
            "oldest",
            format!(
                "oldest_ms = {} is not above camera_delay_ms = {}: every frame would be stale",
                timing.oldest_ms, timing.camera_delay_ms
            ),
            "make oldest_ms the delay plus two periods or more",
        );
    }
    let board = if let ActuatorConfig::Emulated {} = file.actuator {
        [file.board.watchdog_ms, file.board.hold_watchdog_ms].map(Some)
    } else {
        file.watchdogs_ms()
    };
    if let Some(ms) = board[0].filter(|ms| f64::from(*ms) < 5.0 * period_ms) {
        say(
            Warning,
            "watchdog",
            format!("watchdog_ms = {ms} is less than five periods of {period_ms} ms"),
            "20 ms lets a stall of the machine pass; the board holds the bead meanwhile",
        );
    }
    if let [Some(watchdog), Some(hold)] = board
        && hold < watchdog
    {
        say(
            Warning,
            "hold_watchdog",
            format!("hold_watchdog_ms = {hold} is shorter than watchdog_ms = {watchdog}"),
            "two seconds leave a stalled host time to take up again",
        );
    }
    let step_um = 40.0 / 65_535.0;
    let reach_um = file.limits.slew_um_per_s * period_ms * 1e-3;
    if reach_um < 10.0 * step_um {
        say(
            Warning,
            "slew",
            format!(
                "slew_um_per_s = {} is {:.1} nm a tick, a few steps of a 16-bit converter",
                file.limits.slew_um_per_s,
                reach_um * 1e3
            ),
            "the loop needs some um/ms to catch a bead: 20000 is usual",
        );
    }
    if let ActuatorConfig::Serial { baud, port, .. } = &file.actuator {
        /// Longest command on the wire, in bits.
        const COMMAND_BITS: f64 = 360.0;
        if f64::from(*baud) < COMMAND_BITS * 1e3 / period_ms {
            say(
                Error,
                "baud",
                format!("{baud} Bd carries no command each {period_ms} ms (360 bits)"),
                "921600 at least, 3000000 where the adapter can: the time on the wire is delay in the loop",
            );
        }
        if port.is_empty() {
            say(
                Error,
                "port",
                "port is empty".to_string(),
                "cellpos rig new lists the ports",
            );
        }
    }
    if !matches!(file.camera, CameraConfig::Emulated {}) {
        if file.calibration.is_none() {
            say(
                Error,
                "calibration",
                "no [calibration]: a real camera needs to know how large a pixel is".to_string(),
                "cellpos calibrate writes a file; name it with calibration_file",
            );
        }
        if file.vision.is_none() && file.cell.is_none() {
            say(
                Error,
                "vision",
                "no [vision]: what a bead looks like to this camera is not known".to_string(),
                "record some frames with a bead in view; cellpos vision RECORDING prints the table",
            );
        }
    }
    if let Some(calibration) = &file.calibration_file
        && let Some(what) = older_than(calibration, path)
    {
        say(
            Warning,
            "calibration_file",
            what,
            "calibrate again if camera, objective or axis were changed since",
        );
    }
    found
}

/// A sentence when the rig file was changed on a later day than that of its calibration.
fn older_than(calibration: &Path, rig: &Path) -> Option<String> {
    let dated = cellpos_drivers::CalibrationFile::read(calibration)
        .ok()?
        .date;
    let changed = std::fs::metadata(rig).ok()?.modified().ok()?;
    let changed = jiff::Timestamp::try_from(changed)
        .ok()?
        .strftime("%Y-%m-%d")
        .to_string();
    (dated < changed).then(|| {
        format!(
            "{} is of {dated}, the rig file was changed on {changed}",
            calibration.display()
        )
    })
}

/// The line of a key, with or without a unit behind it.
fn line_of(text: &str, key: &str) -> Option<usize> {
    let is_key = |line: &str| {
        let line = line.trim_start();
        let name = line
            .split(['=', ']', '#'])
            .next()
            .unwrap_or("")
            .trim()
            .trim_start_matches('[');
        name == key
            || name
                .strip_prefix(key)
                .is_some_and(|rest| rest.starts_with('_'))
    };
    text.lines().position(is_key).map(|at| at + 1)
}

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
    let mut say = |what: String, remedy: &str| {
        findings.push(Finding {
            weight: Weight::Warning,
            line: None,
            what,
            remedy: remedy.to_string(),
        });
    };
    let promised_hz = 1e6 / file.timing.period_us;
    if rate_hz < 0.9 * promised_hz {
        say(
            format!(
                "the camera delivers {rate_hz:.0} Hz, [timing] period_us promises {promised_hz:.0} Hz"
            ),
            "smaller region, shorter exposure, faster link: cellpos camera shows which frames are missing",
        );
    }
    if (age_ms.p50 - file.timing.camera_delay_ms).abs() > 0.5 * file.timing.period_us * 1e-3 {
        say(
            format!(
                "frames are {:.2} ms old on arrival (median), camera_delay_ms says {}",
                age_ms.p50, file.timing.camera_delay_ms
            ),
            "cellpos identify measures the delay with the LED",
        );
    }
    if line.lost > 0 {
        say(
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

#[cfg(test)]
mod tests {
    use super::*;

    fn of(text: &str) -> Vec<Finding> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("rig.toml");
        std::fs::write(&path, text).expect("written");
        let file = RigFile::load(Some(&path)).unwrap_or_else(|error| panic!("{error:?}"));
        findings(&file, &path)
    }

    #[test]
    fn what_does_not_fit_together_is_named_with_its_line() {
        assert_eq!(of(""), [], "the emulated rig fits");
        let text = "[actuator]\nkind = \"serial\"\nport = \"pzt\"\nbaud = 115200\nwatchdog_ms = 3\nhold_watchdog_ms = 2\n\
                    [camera]\nkind = \"industrial\"\naddress = \"a\"\nrate_hz = 500.0\nexposure_us = 3000.0\n\
                    [limits]\nlow_um = 0.0\nhigh_um = 40.0\nslew_um_per_s = 1.0\npark_um = 20.0\n\
                    [timing]\noldest_ms = 1.5\n";
        let found = of(text);
        let lines: Vec<Option<usize>> = found.iter().map(|f| f.line).collect();
        let expected = [10, 11, 18, 5, 6, 15, 4].map(Some);
        assert_eq!(lines[..7], expected, "{found:#?}");
        assert_eq!(
            lines[7..],
            [None, None],
            "calibration and vision are not there"
        );
        for finding in &found {
            assert!(!finding.what.is_empty() && !finding.remedy.is_empty());
        }
    }

    #[test]
    fn a_calibration_older_than_the_file_is_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let calibration = "pixel_um = 0.1\npixel_um_sd = 0.001\naxis = \"x\"\nsign = 1\norigin_px = 127.5\ndate = \"2001-02-03\"\n\
                           method = \"stage micrometer\"\n";
        std::fs::write(folder.path().join("c.toml"), calibration).expect("written");
        let path = folder.path().join("rig.toml");
        std::fs::write(&path, "calibration_file = \"c.toml\"\n").expect("written");
        let file = RigFile::load(Some(&path)).unwrap_or_else(|error| panic!("{error:?}"));
        let found = findings(&file, &path);
        assert_eq!(found.len(), 1, "{found:?}");
        assert!(
            found[0].what.contains("2001-02-03") && found[0].line == Some(1),
            "{found:?}"
        );
    }
}
