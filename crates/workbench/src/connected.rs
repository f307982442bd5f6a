//! Opens the devices of a rig file and compares them with it.

use crate::bench::Bench;
use crate::finding::{Finding, Found, Weight};
use crate::line_test::{self, LineTest, Quantiles};
use cellpos_drivers::Axis;
use cellpos_rig::{Camera, Clock, FrameBuffer};
use cellpos_runtime::realtime::Request;
use cellpos_session::rig_file::{ActuatorConfig, CameraConfig};
use cellpos_session::{Failure, FrameAge, FramesSeen, RigFile};
use serde::Serialize;
use std::path::Path;

/// The devices and problems found for a file.
#[derive(Debug, Clone, Serialize)]
pub struct Connected {
    /// The board and its line; none if it could not be opened.
    pub board: Option<LineTest>,
    /// The camera; none if it could not be opened.
    pub camera: Option<CameraSeen>,
    /// Differences from the file.
    pub findings: Vec<Finding>,
}

/// What a camera delivered.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CameraSeen {
    /// Its name.
    pub name: String,
    /// Its frames, px.
    pub size_px: [usize; 2],
    /// Frames a second over a second.
    pub rate_hz: f64,
    /// From mid-exposure to arrival, ms.
    pub age_ms: Quantiles,
    /// From mid-exposure to the end of vision's work; none if vision is not set up.
    pub used: Option<FrameAge>,
}

/// Opens board and camera of a rig file that was read from `path`. Nothing moves. A device that is missing or does not answer is
/// a finding; the other one is still checked.
pub fn connect(bench: &Bench, path: &Path) -> Connected {
    let file = bench.file();
    let mut found = Found::in_file(path);
    let board = board(bench)
        .map_err(|failure| {
            let (key, value) = match &file.actuator {
                ActuatorConfig::Serial { port, .. } => ("port", port.clone()),
                ActuatorConfig::Program { socket, .. } => ("socket", socket.display().to_string()),
                ActuatorConfig::Emulated {} | ActuatorConfig::EmulatedPressure { .. } => {
                    ("kind", "emulated".to_string())
                }
            };
            say_failure(&mut found, ("actuator", key), &value, &failure);
        })
        .ok();
    let camera = camera(bench)
        .map_err(|failure| {
            let (key, value) = match &file.camera {
                CameraConfig::Socket { socket, .. } => ("socket", socket.display().to_string()),
                CameraConfig::Industrial { address, .. } => ("address", address.clone()),
                CameraConfig::Emulated {} => ("kind", "emulated".to_string()),
            };
            say_failure(&mut found, ("camera", key), &value, &failure);
        })
        .ok();
    if let Some(board) = &board {
        judge_board(&mut found, file, board);
    }
    if let Some(camera) = &camera {
        judge_camera(&mut found, file, camera);
    }
    Connected {
        board,
        camera,
        findings: found.findings,
    }
}

fn board(bench: &Bench) -> Result<LineTest, Failure> {
    const PINGS: u32 = 200;
    line_test::run(&mut bench.board()?, PINGS)
}

fn camera(bench: &Bench) -> Result<CameraSeen, Failure> {
    const WATCH_NS: i64 = 1_000_000_000;
    let mut camera = bench.camera()?;
    let mut buffer = FrameBuffer::default();
    let clock = Clock::Real;
    let mut next = |until_ns: i64, buffer: &mut FrameBuffer| {
        camera.next_frame(buffer, until_ns).map_err(Failure::failed)
    };
    // Frames queued since it was opened are old.
    while next(clock.now_ns(), &mut buffer)?.is_some() {}
    let start_ns = clock.now_ns();
    let mut ages_ms = Vec::new();
    while clock.now_ns() < start_ns + WATCH_NS {
        if let Some(stamp) = next(start_ns + WATCH_NS, &mut buffer)? {
            ages_ms.push((stamp.arrival_ns - stamp.mid_exposure_ns) as f64 * 1e-6);
        }
    }
    let rate_hz = ages_ms.len() as f64 / ((clock.now_ns() - start_ns) as f64 * 1e-9);
    let name = camera.info().name;
    // As the loop takes them: through vision.
    let used = bench
        .file()
        .watch(camera, &clock)
        .ok()
        .and_then(|mut source| {
            let request = Request::like_control();
            let seen = FramesSeen::of(source.as_mut(), &clock, WATCH_NS / 2, &request).ok()?;
            seen.age
        });
    Ok(CameraSeen {
        name,
        size_px: [buffer.width, buffer.height],
        rate_hz,
        age_ms: Quantiles::of(&ages_ms),
        used,
    })
}

/// A device that could not be opened.
fn say_failure(found: &mut Found, of: (&str, &str), value: &str, failure: &Failure) {
    let mut what = failure.to_string();
    if !what.contains(value) || !what.contains(of.1) {
        what = format!("{} = {value:?}: {what}", of.1);
    }
    let mut source = std::error::Error::source(failure);
    while let Some(error) = source {
        what.push_str(&format!(": {error}"));
        source = error.source();
    }
    let (Failure::BadInput(report) | Failure::Failed(report)) = failure;
    let remedy = report.help().map_or_else(
        || {
            "is it connected and switched on, and not open in another program? See docs/rig.md, What a refusal means"
                .to_string()
        },
        |help| help.to_string(),
    );
    found.say(Weight::Error, of, &value, what, &remedy);
}

/// Compares range, slew and park with the board's own, and counts losses on its line.
fn judge_board(found: &mut Found, file: &RigFile, line: &LineTest) {
    let (own, info) = (&file.limits, &line.info);
    for (key, value, wider, of_board) in [
        ("low_um", own.low_um, own.low_um < info.low_um, info.low_um),
        (
            "high_um",
            own.high_um,
            own.high_um > info.high_um,
            info.high_um,
        ),
        (
            "slew_um_per_s",
            own.slew_um_per_s,
            own.slew_um_per_s > info.slew_um_per_s,
            info.slew_um_per_s,
        ),
    ] {
        if wider {
            found.say(
                Weight::Warning,
                ("limits", key),
                &value,
                format!("{key} = {value}: wider than the board's own, {of_board}"),
                "the board's value is in force; write it into the file",
            );
        }
    }
    if !(info.low_um..=info.high_um).contains(&own.park_um) {
        found.say(
            Weight::Error,
            ("limits", "park_um"),
            &own.park_um,
            format!(
                "park_um = {}: the board reaches from {} to {} um and refuses to be armed",
                own.park_um, info.low_um, info.high_um
            ),
            "park within the board's range, as near to zero flow as the PZT may be left",
        );
    }
    if line.lost > 0
        && let ActuatorConfig::Serial { port, .. } = &file.actuator
    {
        found.say(
            Weight::Warning,
            ("actuator", "port"),
            port,
            format!(
                "port = {port:?}: {} of {} pings were lost",
                line.lost, line.sent
            ),
            "cable, baud rate, another program on the port?",
        );
    }
}

/// Contradictions between the frames of an open rig and its file, read from `path`.
pub fn of_frames(file: &RigFile, seen: &FramesSeen, path: &Path) -> Vec<Finding> {
    let mut found = Found::in_file(path);
    judge_frames(&mut found, file, seen);
    found.findings
}

/// Compares rate and age of the frames with the file.
fn judge_frames(found: &mut Found, file: &RigFile, seen: &FramesSeen) {
    /// A camera may be off by this much; a lower rate means lost frames.
    const KEPT: f64 = 0.1;
    let stated = match &file.camera {
        CameraConfig::Socket { rate_hz, .. } | CameraConfig::Industrial { rate_hz, .. } => {
            ("camera", *rate_hz)
        }
        CameraConfig::Emulated {} => ("emulator", file.emulator.rate_hz),
    };
    let (table, rate_hz) = stated;
    if (seen.rate_hz / rate_hz - 1.0).abs() > KEPT {
        let faster = seen.rate_hz > rate_hz;
        found.say(
            if faster { Weight::Error } else { Weight::Warning },
            (table, "rate_hz"),
            &rate_hz,
            format!(
                "rate_hz = {rate_hz}: the camera delivers {:.0} frames a second",
                seen.rate_hz
            ),
            if faster {
                "write the camera's rate: the prediction between frames depends on it"
            } else {
                "smaller region, shorter exposure, faster link: cellpos camera shows which frames are missing"
            },
        );
    }
    if let Some((advice, remedy)) = seen.age.and_then(|age| age.advice(&file.timing)) {
        found.say(
            Weight::Warning,
            ("timing", "camera_delay_ms"),
            &file.timing.camera_delay_ms,
            advice,
            remedy,
        );
    }
}

/// Rate and age of the frames against the loop's set-up; the calibration's origin against their size.
fn judge_camera(found: &mut Found, file: &RigFile, camera: &CameraSeen) {
    judge_frames(
        found,
        file,
        &FramesSeen {
            rate_hz: camera.rate_hz,
            age: camera.used.or_else(|| {
                // A frame cannot be used before it arrives; without vision nothing more is known.
                let arrived_ms = camera.age_ms.p50;
                (arrived_ms > file.timing.camera_delay_ms).then_some(FrameAge {
                    early_ms: arrived_ms,
                    median_ms: arrived_ms,
                })
            }),
        },
    );
    if let Some(calibration) = &file.calibration {
        let [width, height] = camera.size_px;
        let across = match calibration.axis {
            Axis::X => width,
            Axis::Y => height,
        };
        let origin_px = calibration.origin_px;
        if !(0.0..=across.saturating_sub(1) as f64).contains(&origin_px) {
            // The table, or the file that replaces it.
            let of = match &file.calibration_file {
                Some(_) => ("", "calibration_file"),
                None => ("calibration", "origin_px"),
            };
            found.say(
                Weight::Warning,
                of,
                &origin_px,
                format!(
                    "origin_px = {origin_px}: outside the picture of {width} x {height} px, position 0 um is never seen ({})",
                    of.1
                ),
                "calibrate again with this region of the sensor",
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_rig::ActuatorInfo;

    const FILE: &str = "[actuator]\nkind = \"serial\"\nport = \"pzt\"\n[camera]\nkind = \"socket\"\nsocket = \"s\"\n\
        [calibration]\npixel = \"0.1um\"\norigin_px = 300.0\nsign = 1.0\n\
        [limits]\nlow = \"-1um\"\nhigh_um = 50.0\nslew = \"50um/ms\"\npark_um = 45.0\n[timing]\ncamera_delay = \"1ms\"\n";

    fn in_file(text: &str, judge: impl Fn(&mut Found, &RigFile)) -> Vec<Finding> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("rig.toml");
        std::fs::write(&path, text).expect("written");
        let file = RigFile::load(Some(&path)).unwrap_or_else(|error| panic!("{error:?}"));
        let mut found = Found::in_file(&path);
        judge(&mut found, &file);
        for finding in &found.findings {
            let (_, key) = finding.key.rsplit_once('.').unwrap_or(("", &finding.key));
            assert!(finding.what.contains(key), "{finding:?}");
            assert!(finding.what.contains(&finding.value), "{finding:?}");
            assert!(!finding.remedy.is_empty(), "{finding:?}");
        }
        found.findings
    }

    #[test]
    fn what_the_devices_say_against_the_file_has_line_key_value_and_remedy() {
        let line = LineTest {
            info: ActuatorInfo {
                name: "a board".to_string(),
                low_um: 0.0,
                high_um: 40.0,
                slew_um_per_s: 40_000.0,
                step_um: 0.0006,
                watchdog_ms: 20,
                hold_watchdog_ms: 2000,
            },
            state: "disarmed".to_string(),
            applied_um: 20.0,
            sent: 200,
            lost: 3,
            round_trip_ms: Quantiles::default(),
            jitter_ms: Quantiles::default(),
            bad_frames: 0,
            ignored: 0,
            late: 0,
            clipped: 0,
            unsent: 0,
            bad_frames_here: 0,
        };
        let camera = CameraSeen {
            name: "a camera".to_string(),
            size_px: [256, 32],
            rate_hz: 500.0,
            age_ms: Quantiles {
                p50: 2.0,
                ..Quantiles::default()
            },
            used: None,
        };
        let found = in_file(FILE, |found, file| {
            judge_board(found, file, &line);
            judge_camera(found, file, &camera);
        });
        let places: Vec<(&str, Option<usize>)> = (found.iter())
            .map(|finding| (finding.key.as_str(), finding.line))
            .collect();
        let expected = [
            ("limits.low_um", Some(12)),
            ("limits.high_um", Some(13)),
            ("limits.slew_um_per_s", Some(14)),
            ("limits.park_um", Some(15)),
            ("actuator.port", Some(3)),
            // The key is left out: its table.
            ("camera.rate_hz", Some(4)),
            ("timing.camera_delay_ms", Some(17)),
            ("calibration.origin_px", Some(9)),
        ];
        assert_eq!(places, expected);
    }

    #[test]
    fn devices_that_are_not_there_are_both_named_with_their_lines() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("rig.toml");
        std::fs::write(&path, FILE).expect("written");
        let file = RigFile::load(Some(&path)).unwrap_or_else(|error| panic!("{error:?}"));
        let bench = Bench::of(file).unwrap_or_else(|error| panic!("{error:?}"));
        let connected = connect(&bench, &path);
        assert!(connected.board.is_none() && connected.camera.is_none());
        let places: Vec<(Weight, &str, Option<usize>)> = (connected.findings.iter())
            .map(|finding| (finding.weight, finding.key.as_str(), finding.line))
            .collect();
        let expected = [
            (Weight::Error, "actuator.port", Some(3)),
            (Weight::Error, "camera.socket", Some(6)),
        ];
        assert_eq!(places, expected, "{connected:?}");
        for finding in &connected.findings {
            assert!(finding.what.contains(&finding.value) && !finding.remedy.is_empty());
        }
    }
}
