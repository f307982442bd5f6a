//! A base model from a table of frequency and response that somebody else has measured.

use super::arrays::read_table;
use super::base::{self, coefficients};
use cellpos_ident::base::Form;
use cellpos_ident::from_response::{Measured, ResponseFit, fit_response};
use cellpos_ident::sampled::Hold;
use cellpos_numeric::statistics::Z95;
use cellpos_plant::Model;
use cellpos_report::number;
use cellpos_session::Failure;
use cellpos_table::{ColumnRef, Table};
use serde_json::json;
use std::f64::consts::TAU;
use std::path::Path;

/// A base model of a measured response.
pub struct OfResponse {
    /// Points that were fitted.
    points: Vec<Measured>,
    fit: ResponseFit,
    /// The model.
    pub model: Model,
}

/// Reads a table and fits a base model to it: of a stated form, or of the simplest that is as good as any up to an order.
///
/// # Errors
/// A table that is no response, and points that no form fits.
pub fn fit(
    path: &Path,
    asked: Option<Form>,
    most_order: usize,
    hold: Hold,
) -> Result<OfResponse, Failure> {
    let points = read(path)?;
    let fit = fit_response(&points, asked, most_order).map_err(|e| {
        Failure::bad_input(
            format!("{}: {e}", path.display()),
            "check the columns, give more frequencies, or another form in --base",
        )
    })?;
    let mut model = base::model_of(&fit.model, hold, 0.0)?;
    model.description = format!(
        "linear model of order {} from a frequency response",
        fit.form.order
    );
    base::say_form(&mut model, fit.form);
    Ok(OfResponse { points, fit, model })
}

impl OfResponse {
    /// Messages about it.
    pub fn words(&self, path: &Path) -> String {
        let (fit, m) = (&self.fit, &self.fit.model);
        format!(
            "{}: {} frequencies\nbase model {}: num {}, den {}, {}\n  off by {} % of the response RMS (every second point, predicted from the others: {} %), at most {} dB and {} deg\n",
            path.display(),
            self.points.len(),
            fit.form,
            coefficients(&m.numerator, &m.numerator_sd),
            coefficients(&m.denominator, &m.denominator_sd),
            match fit.form.delay {
                true => format!(
                    "delay {} +- {} ms",
                    number(1e3 * m.delay_s),
                    number(1e3 * Z95 * m.delay_sd_s)
                ),
                false => "no delay".to_owned(),
            },
            number(100.0 * fit.relative_error),
            number(100.0 * fit.held_out_error),
            number(fit.worst_db),
            number(fit.worst_deg),
        )
    }

    /// The same as JSON.
    pub fn to_json(&self, path: &Path) -> serde_json::Value {
        let (fit, m) = (&self.fit, &self.fit.model);
        json!({ "response": {
            "file": path, "points": self.points.len(), "form": fit.form.to_string(), "order": m.order,
            "num": m.numerator, "den": m.denominator, "delay_ms": 1e3 * m.delay_s,
            "poles_rad_per_s": m.poles.iter().map(|p| [p.re, p.im]).collect::<Vec<_>>(),
            "relative_error": fit.relative_error, "held_out_error": fit.held_out_error,
            "worst_db": fit.worst_db, "worst_deg": fit.worst_deg,
        } })
    }
}

/// The part of a name before its unit, in small letters, and the unit.
fn parts(name: &str) -> (String, String) {
    let lower = name.to_lowercase();
    let (stem, unit) = match lower.split_once(['[', '(']) {
        Some((stem, unit)) => (stem, unit.trim_end_matches([']', ')'])),
        None => lower.rsplit_once('_').unwrap_or((&lower, "")),
    };
    (stem.trim().to_owned(), unit.trim().to_owned())
}

/// The table of a response: frequency, and gain and phase, or real and imaginary part.
fn read(path: &Path) -> Result<Vec<Measured>, Failure> {
    let text = read_table(path).map_err(|e| {
        Failure::bad_input(
            format!("{}: cannot be read ({e})", path.display()),
            "name a table: text (CSV), .npy, or .mat up to version 7",
        )
    })?;
    let table = Table::parse(path, &text).map_err(Failure::input)?;
    let find = |stems: &[&str]| {
        let named = |name: &&String| stems.contains(&parts(name).0.as_str());
        table.names.iter().find(named)
    };
    let column = |name: &str| {
        (table.numbers_or_nan(&ColumnRef::Name(name.to_owned()))).map_err(Failure::input)
    };
    let missing = |what: &str| {
        Failure::bad_input(
            format!(
                "{}: no column is that of the {what}; this file has: {}",
                path.display(),
                table.names.join(", ")
            ),
            "a response has the columns freq [Hz] (or w [rad/s]), gain (or gain [dB]) and phase [deg] (or [rad]); or re and im",
        )
    };
    let frequency = find(&["freq", "frequency", "f", "hz", "w", "omega"])
        .ok_or_else(|| missing("frequency"))?;
    let (stem, unit) = parts(frequency);
    let per_hz = match unit.as_str() {
        "rad/s" | "rads" | "rad" => TAU,
        "khz" => 1e-3,
        "" if matches!(stem.as_str(), "w" | "omega") => TAU,
        _ => 1.0,
    };
    let hz: Vec<f64> = column(frequency)?.iter().map(|v| v / per_hz).collect();
    let real = find(&["re", "real"]);
    let imaginary = find(&["im", "imag", "imaginary"]);
    let points = match (real, imaginary) {
        (Some(re), Some(im)) => measured(&hz, &column(re)?, &column(im)?, Measured::parts),
        _ => {
            let gain = find(&["gain", "mag", "magnitude", "amplitude", "abs"])
                .ok_or_else(|| missing("gain"))?;
            let phase = find(&["phase", "arg", "angle"]).ok_or_else(|| missing("phase"))?;
            let gains = gain_of(path, gain, column(gain)?)?;
            let phases = phase_of(path, phase, column(phase)?)?;
            measured(&hz, &gains, &phases, Measured::polar)
        }
    };
    Ok(points)
}

/// Points of rows that lack nothing; the gain at rest has no phase to fit.
fn measured(hz: &[f64], a: &[f64], b: &[f64], of: fn(f64, f64, f64) -> Measured) -> Vec<Measured> {
    (hz.iter().zip(a).zip(b))
        .map(|((hz, a), b)| of(*hz, *a, *b))
        .filter(|p| p.is_known() && p.hz != 0.0)
        .collect()
}

/// Gains as ratios.
fn gain_of(path: &Path, name: &str, values: Vec<f64>) -> Result<Vec<f64>, Failure> {
    let (_, unit) = parts(name);
    if unit == "db" {
        return Ok(values.iter().map(|v| 10f64.powf(v / 20.0)).collect());
    }
    match values.iter().position(|v| *v <= 0.0) {
        None => Ok(values),
        Some(row) => Err(Failure::bad_input(
            format!(
                "{}: {name} is {} in row {}: no ratio of amplitudes",
                path.display(),
                values[row],
                row + 1
            ),
            "call the column `gain [dB]` where it is in dB",
        )),
    }
}

/// Phases in radians.
fn phase_of(path: &Path, name: &str, values: Vec<f64>) -> Result<Vec<f64>, Failure> {
    let most = values
        .iter()
        .filter(|v| v.is_finite())
        .fold(0.0f64, |a, v| a.max(v.abs()));
    match parts(name).1.as_str() {
        "rad" => Ok(values),
        "deg" | "\u{b0}" => Ok(values.iter().map(|v| v.to_radians()).collect()),
        // More than a turn and a half in radians is no phase that somebody has measured.
        _ if most > 10.0 => Ok(values.iter().map(|v| v.to_radians()).collect()),
        _ => Err(Failure::bad_input(
            format!(
                "{}: {name} goes to {} at most: degrees or radians?",
                path.display(),
                number(most)
            ),
            "call the column `phase [deg]` or `phase [rad]`",
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read_of(text: &str) -> Result<Vec<Measured>, Failure> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("r.csv");
        std::fs::write(&path, text).unwrap();
        read(&path)
    }

    #[test]
    fn the_same_point_in_decibels_ratio_or_parts_is_the_same() {
        let texts = [
            "freq [Hz],gain [dB],phase [deg]\n0,20,0\n1,20,-90\n2,,-120\n",
            "w,magnitude,phase_rad\n6.283185307179586,10,-1.5707963267948966\n",
            "f_kHz;real;imag\n0.001;0;-10\n",
            "frequency,gain,phase\n1,10,-90\n",
        ];
        for text in texts {
            let points = read_of(text).unwrap();
            assert_eq!(points.len(), 1, "{text}");
            assert!((points[0].hz - 1.0).abs() < 1e-9, "{text}");
            let (re, im) = (points[0].response.re, points[0].response.im);
            assert!(re.abs() < 1e-9 && (im + 10.0).abs() < 1e-9, "{text}");
        }
    }

    #[test]
    fn what_is_not_clear_is_asked_for_by_column_and_value() {
        let said = |text: &str| format!("{:?}", read_of(text).unwrap_err());
        assert!(said("f,gain,phase\n1,1,-0.5\n2,0.5,-1\n").contains("degrees or radians"));
        assert!(said("f,gain,phase [deg]\n1,1,-5\n2,-0.5,-10\n").contains("gain is -0.5 in row 2"));
        assert!(said("f,y,phase [deg]\n1,1,-5\n").contains("no column is that of the gain"));
    }
}
