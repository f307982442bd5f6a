//! Contradictions within a valid rig file.

pub use crate::connected::{CameraSeen, Connected, connect, of_frames};
use crate::finding::Found;
pub use crate::finding::{Finding, Weight};
use cellpos_session::RigFile;
use cellpos_session::rig_file::{ActuatorConfig, CameraConfig};
use std::path::Path;

/// Findings about the file, under construction.
struct Findings<'a> {
    file: &'a RigFile,
    found: Found,
}

use Weight::{Error, Warning};

impl Findings<'_> {
    fn say(
        &mut self,
        weight: Weight,
        of: (&str, &str),
        value: &dyn std::fmt::Display,
        what: String,
        remedy: &str,
    ) {
        self.found.say(weight, of, value, what, remedy);
    }

    /// Rate, exposure, age.
    fn times(&mut self) {
        let timing = self.file.timing;
        let (table, rate_hz, exposure) = match &self.file.camera {
            CameraConfig::Emulated {} => {
                let world = &self.file.emulator;
                let exposure = Some(("exposure_ms", world.exposure_ms, 1e3));
                ("emulator", world.rate_hz, exposure)
            }
            CameraConfig::Socket { rate_hz, .. } => ("camera", *rate_hz, None),
            CameraConfig::Industrial {
                rate_hz,
                exposure_us,
                ..
            } => {
                let exposure = exposure_us.map(|us| ("exposure_us", us, 1.0));
                ("camera", *rate_hz, exposure)
            }
        };
        // Largest number of ticks that the estimator predicts between frames of a slower camera.
        const MOST_TICKS_A_FRAME: f64 = 16.0;
        let ticks_a_frame = 1e6 / (rate_hz * timing.period_us);
        // A slow actuator takes the newest of several frames.
        let of_the_newest = self.file.actuator.period_ms().is_some() && ticks_a_frame < 1.0;
        if (ticks_a_frame - 1.0).abs() > 0.01 && !of_the_newest {
            let impossible = ticks_a_frame > MOST_TICKS_A_FRAME;
            self.say(
                if impossible { Error } else { Warning },
                (table, "rate_hz"),
                &rate_hz,
                format!(
                    "rate_hz = {rate_hz}: a frame each {} us, [timing] period_us is {}: {}",
                    (1e6 / rate_hz).round(),
                    timing.period_us,
                    match ticks_a_frame {
                        _ if impossible => "too long to predict from one to the next",
                        more if more > 1.0 => "between frames the loop runs on prediction",
                        _ => "frames are left out",
                    }
                ),
                "one tick a frame is usual: period_us is one million divided by the rate",
            );
        }
        if let Some((key, exposure, us)) = exposure
            && exposure * us > 1e6 / rate_hz
        {
            self.say(
                Error,
                (table, key),
                &exposure,
                format!("{key} = {exposure}: does not fit into a frame of {rate_hz} Hz"),
                "shorten the exposure, or lower the rate",
            );
        }
        if timing.oldest_ms <= timing.camera_delay_ms {
            self.say(
                Error,
                ("timing", "oldest_ms"),
                &timing.oldest_ms,
                format!(
                    "oldest_ms = {}: not above camera_delay_ms = {}, every frame would be stale",
                    timing.oldest_ms, timing.camera_delay_ms
                ),
                "make oldest_ms the delay plus two periods or more",
            );
        }
    }

    /// The loop does not use a slow actuator of unknown gain.
    fn partner(&mut self) {
        let Some(partner) = &self.file.partner else {
            return;
        };
        match partner.gain {
            None => self.say(
                Error,
                ("partner", "kind"),
                &"",
                "gain is missing: the slow actuator's effect on the flow is not known".to_owned(),
                "measure it: cellpos rig partner RIG --write",
            ),
            Some(gain) if partner.gain_ci95 > 0.1 * gain.abs() => {
                let what = format!(
                    "gain_ci95 = {}: more than a tenth of the gain, the slow actuator moves slowly for it",
                    partner.gain_ci95
                );
                let remedy =
                    "measure it for longer: cellpos rig partner RIG --duration 120s --write";
                self.say(
                    Warning,
                    ("partner", "gain_ci95"),
                    &partner.gain_ci95,
                    what,
                    remedy,
                );
            }
            Some(_) => {}
        }
    }

    /// Compares the watchdogs with the period and with each other.
    fn watchdogs(&mut self) {
        let period_ms = self.file.timing.period_us * 1e-3;
        let (table, board) = if self.file.actuator.is_emulated() {
            let board = &self.file.board;
            (
                "board",
                [board.watchdog_ms, board.hold_watchdog_ms].map(Some),
            )
        } else {
            ("actuator", self.file.watchdogs_ms())
        };
        if let Some(ms) = board[0].filter(|ms| f64::from(*ms) < 5.0 * period_ms) {
            self.say(
                Warning,
                (table, "watchdog_ms"),
                &ms,
                format!("watchdog_ms = {ms}: less than five periods of {period_ms} ms"),
                "leave the key out: a run asks for a time that fits its period and delay",
            );
        }
        if let [Some(watchdog), Some(hold)] = board
            && hold < watchdog
        {
            self.say(
                Warning,
                (table, "hold_watchdog_ms"),
                &hold,
                format!("hold_watchdog_ms = {hold}: shorter than watchdog_ms = {watchdog}"),
                "two seconds give a stalled host time to continue",
            );
        }
    }

    /// Compares the slew with the converter's step, and the line with the rate; checks the port and the pairing of
    /// board and camera.
    fn board(&mut self) {
        let file = self.file;
        let period_ms = file.timing.period_us * 1e-3;
        let step_um = 40.0 / 65_535.0;
        let reach_um = file.limits.slew_um_per_s * period_ms * 1e-3;
        if reach_um < 10.0 * step_um {
            self.say(
                Warning,
                ("limits", "slew_um_per_s"),
                &file.limits.slew_um_per_s,
                format!(
                    "slew_um_per_s = {}: {:.1} nm a tick, a few steps of a 16-bit converter",
                    file.limits.slew_um_per_s,
                    reach_um * 1e3
                ),
                "the loop needs some um/ms to catch a bead: 20000 is usual",
            );
        }
        let emulated_camera = matches!(file.camera, CameraConfig::Emulated {});
        if emulated_camera != file.actuator.is_emulated() {
            self.say(
                Error,
                ("camera", "kind"),
                &(if emulated_camera { "emulated" } else { "real" }),
                "kind: board and camera must both be emulated, or neither: the emulated board moves the emulated bead only"
                    .to_string(),
                "run firmware-sim to have both behind a serial port and a socket",
            );
        }
        let ActuatorConfig::Serial { baud, port, .. } = &file.actuator else {
            return;
        };
        /// Longest command on the wire, in bits.
        const COMMAND_BITS: f64 = 360.0;
        if f64::from(*baud) < COMMAND_BITS * 1e3 / period_ms {
            self.say(
                Error,
                ("actuator", "baud"),
                baud,
                format!("baud = {baud}: carries no command each {period_ms} ms (360 bits)"),
                "write at least 921600, or 3000000 if the adapter can: the time on the wire adds to the loop delay",
            );
        }
        if port.is_empty() {
            self.say(
                Error,
                ("actuator", "port"),
                port,
                "port = \"\": names no device".to_string(),
                "cellpos rig new lists the ports",
            );
        }
    }

    /// Frames of the empty channel.
    fn background(&mut self, path: Option<&Path>) {
        const REMEDY: &str =
            "record the empty channel: cellpos background --rig RIG.toml --out empty.tif";
        let key = ("cell", "background");
        match path {
            None => self.say(
                Error,
                key,
                &"",
                "[cell] background is missing: a camera needs frames of the empty channel to see a cell".to_string(),
                REMEDY,
            ),
            Some(path) => {
                let shown = path.display();
                if let Err(error) = cellpos_drivers::sources::open(path) {
                    let what = format!("background = {shown}: {error}");
                    self.say(Error, key, &shown, what, REMEDY);
                }
            }
        }
    }

    /// Requirements of a real camera besides a rate.
    fn camera(&mut self, path: &Path) {
        let file = self.file;
        if !matches!(file.camera, CameraConfig::Emulated {}) {
            if file.calibration.is_none() {
                self.say(
                    Error,
                    ("", "calibration"),
                    &"",
                    "[calibration] is missing: a real camera needs to know how large a pixel is"
                        .to_string(),
                    "cellpos calibrate writes a file; name it with calibration_file",
                );
            }
            if let Some(cell) = &file.cell {
                self.background(cell.background.as_deref());
            }
            if file.vision.is_none() && file.cell.is_none() {
                self.say(
                    Error,
                    ("", "vision"),
                    &"",
                    "[vision] is missing: what a bead looks like to this camera is not known"
                        .to_string(),
                    "bring a bead into view; cellpos camera --rig RIG --find-beads beads.png finds the settings and writes the table",
                );
            }
        }
        if let Some(calibration) = &file.calibration_file
            && let Some(what) = older_than(calibration, path)
        {
            self.say(
                Warning,
                ("", "calibration_file"),
                &calibration.display(),
                what,
                "calibrate again if camera, objective or axis were changed since",
            );
        }
    }
}

/// Contradictions within a file that was read from `path`.
pub fn findings(file: &RigFile, path: &Path) -> Vec<Finding> {
    let mut findings = Findings {
        file,
        found: Found::in_file(path),
    };
    findings.times();
    findings.watchdogs();
    findings.board();
    findings.partner();
    findings.camera(path);
    findings.found.findings
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
            let (_, key) = finding.key.rsplit_once('.').unwrap_or(("", &finding.key));
            assert!(finding.what.contains(key), "{finding:?}");
            assert!(finding.what.contains(&finding.value), "{finding:?}");
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
