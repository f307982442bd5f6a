//! The calibration file: pixel size, axis and sign, with their date and uncertainty.

use crate::calibration::{Axis, Calibration};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Contents of a calibration file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CalibrationFile {
    /// Size of a pixel in the object plane, um.
    pub pixel_um: f64,
    /// Its standard uncertainty, um.
    pub pixel_um_sd: f64,
    /// Axis of the picture along the channel.
    pub axis: Axis,
    /// +1 when the coordinate rises as the bead moves when the PZT extends, else -1.
    pub sign: i8,
    /// Coordinate of position 0 along the axis, px.
    pub origin_px: f64,
    /// Angle from the axis to the channel, positive towards the rising other coordinate, degrees.
    #[serde(default)]
    pub tilt_deg: f64,
    /// Coordinate of position 0 across the axis, px; of no effect without a tilt.
    #[serde(default)]
    pub origin_across_px: f64,
    /// Day of the calibration, YYYY-MM-DD.
    pub date: String,
    /// Its method: stage micrometer, known step, maker's data.
    pub method: String,
}

/// The reason why a calibration cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CalibrationError {
    /// The file cannot be read.
    #[error(
        "calibration {}: cannot read: {cause}; without a calibration positions are in pixels only",
        path.display()
    )]
    Unreadable {
        /// Which file.
        path: PathBuf,
        /// What the operating system said.
        cause: std::io::Error,
    },
    /// The file is not a calibration.
    #[error("calibration {}: {cause}", path.display())]
    Syntax {
        /// Which file.
        path: PathBuf,
        /// What is wrong, with the line.
        cause: toml::de::Error,
    },
    /// An invalid value.
    #[error("calibration {}: {key} = {value}: must be {must_be}", path.display())]
    Value {
        /// Which file.
        path: PathBuf,
        /// Which key.
        key: &'static str,
        /// Its value.
        value: String,
        /// What would be right.
        must_be: &'static str,
    },
}

impl CalibrationFile {
    /// Reads and checks a file.
    ///
    /// # Errors
    /// The file is missing, is not a calibration, or holds an invalid value.
    pub fn read(path: &Path) -> Result<Self, CalibrationError> {
        let text = std::fs::read_to_string(path).map_err(|cause| CalibrationError::Unreadable {
            path: path.to_path_buf(),
            cause,
        })?;
        Self::parse(&text, path)
    }

    /// Reads the text of a file; `path` is for the errors.
    ///
    /// # Errors
    /// The text is not a calibration, or holds an invalid value.
    pub fn parse(text: &str, path: &Path) -> Result<Self, CalibrationError> {
        let file: Self = toml::from_str(text).map_err(|cause| CalibrationError::Syntax {
            path: path.to_path_buf(),
            cause,
        })?;
        file.check(path)?;
        Ok(file)
    }

    fn check(&self, path: &Path) -> Result<(), CalibrationError> {
        let refuse = |ok: bool, key, value: String, must_be| {
            if ok {
                Ok(())
            } else {
                Err(CalibrationError::Value {
                    path: path.to_path_buf(),
                    key,
                    value,
                    must_be,
                })
            }
        };
        if let Some((key, value, must_be)) = self.calibration().problem() {
            refuse(false, key, value.to_string(), must_be)?;
        }
        let sd_ok = self.pixel_um_sd.is_finite()
            && self.pixel_um_sd >= 0.0
            && self.pixel_um_sd < self.pixel_um;
        refuse(
            sd_ok,
            "pixel_um_sd",
            self.pixel_um_sd.to_string(),
            "0 um or more and below pixel_um",
        )?;
        refuse(
            is_date(&self.date),
            "date",
            format!("{:?}", self.date),
            "a day as YYYY-MM-DD",
        )
    }

    /// The calibration in the form for the loop.
    pub fn calibration(&self) -> Calibration {
        Calibration {
            pixel_um: self.pixel_um,
            origin_px: self.origin_px,
            sign: f64::from(self.sign),
            axis: self.axis,
            tilt_deg: self.tilt_deg,
            origin_across_px: self.origin_across_px,
        }
    }
}

fn is_date(text: &str) -> bool {
    let mut parts = text.split('-');
    let mut number = |len: usize, low: u32, high: u32| {
        parts.next().is_some_and(|p| {
            p.len() == len && p.parse().is_ok_and(|n: u32| (low..=high).contains(&n))
        })
    };
    number(4, 1900, 9999) && number(2, 1, 12) && number(2, 1, 31) && parts.next().is_none()
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: &str = "pixel_um = 0.15193\npixel_um_sd = 0.0004\naxis = \"x\"\nsign = -1\norigin_px = 128.0\n\
        date = \"2026-11-20\"\nmethod = \"stage micrometer\"\n";

    fn parse(text: &str) -> Result<CalibrationFile, CalibrationError> {
        CalibrationFile::parse(text, Path::new("calibration.toml"))
    }

    #[test]
    fn a_calibration_turns_pixels_into_micrometres_with_its_sign() {
        let c = parse(GOOD).unwrap().calibration();
        assert!((c.position_um(138.0, 50.0) + 1.5193).abs() < 1e-12);
    }

    #[test]
    fn every_bad_value_is_refused_by_its_key() {
        for (from, to, key) in [
            ("0.15193", "0.0", "pixel_um"),
            ("0.15193", "nan", "pixel_um"),
            ("0.0004", "-1.0", "pixel_um_sd"),
            ("sign = -1", "sign = 2", "sign"),
            ("128.0", "inf", "origin_px"),
            ("128.0", "128.0\ntilt_deg = 46.0", "tilt_deg"),
            ("128.0", "128.0\norigin_across_px = nan", "origin_across_px"),
            ("2026-11-20", "20.11.2026", "date"),
            ("2026-11-20", "2026-13-20", "date"),
        ] {
            let error = parse(&GOOD.replace(from, to)).unwrap_err();
            assert!(
                matches!(error, CalibrationError::Value { key: k, .. } if k == key),
                "{error}"
            );
        }
        assert!(matches!(
            parse(&format!("{GOOD}pixels = 3\n")),
            Err(CalibrationError::Syntax { .. })
        ));
        assert!(matches!(
            parse(&GOOD.replace("axis = \"x\"\n", "")),
            Err(CalibrationError::Syntax { .. })
        ));
    }

    #[test]
    fn a_missing_file_says_what_follows_from_it() {
        let error = CalibrationFile::read(Path::new("/nowhere/calibration.toml")).unwrap_err();
        assert!(
            error.to_string().contains("positions are in pixels only"),
            "{error}"
        );
    }
}
