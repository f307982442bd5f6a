//! The columns of a file: one reader for `identify`, `reconcile` and `simulate`, so that all read the same files.

use super::arrays::read_table;
use crate::experiment::collect::{
    EXPOSURE, FRAME_AGE, FRAME_CAME, LATE_COMMAND, LATE_MOTION, SLEW, record_name, refused,
};
use cellpos_numeric::units::Hertz;
use cellpos_reconcile::Record;
use cellpos_session::Failure;
use cellpos_table::{ColumnRef, Table};
use std::path::Path;

/// Columns of a record, and how they are to be taken.
#[derive(Debug, Clone)]
pub struct Wanted<'a> {
    /// Column of the input.
    pub input: &'a str,
    /// Column of the output; None where only the input is wanted.
    pub output: Option<&'a str>,
    /// Column of the time; None for the one that is called so.
    pub time: Option<&'a str>,
    /// Rows per second of a file without a column of time.
    pub rate: Option<Hertz>,
    /// Factors on input and output.
    pub factors: [f64; 2],
    /// Rows FROM:TO.
    pub rows: Option<&'a str>,
    /// Whether the input keeps its value until the next row.
    pub held: bool,
}

/// Names that a column of time has where nobody says which it is.
const TIMES: [&str; 6] = ["time", "t", "zeit", "timestamp", "tiempo", "temps"];

/// Reads a file as a record on an even grid.
///
/// # Errors
/// What cannot be read, with what would be right.
pub fn read(path: &Path, wanted: &Wanted<'_>) -> Result<Record, Failure> {
    let text = read_table(path).map_err(|e| {
        Failure::bad_input(
            format!("{}: cannot be read ({e})", path.display()),
            "name a record: text (CSV), .npy, or .mat up to version 7; or a run folder",
        )
    })?;
    let table = Table::parse(path, &text).map_err(Failure::input)?;
    let column = |name: &str| {
        table.numbers_or_nan(&ColumnRef::from(name)).map_err(|e| {
            Failure::bad_input(
                e.to_string(),
                "columns are named by the header or by their number from 1: --help says which option names which",
            )
        })
    };
    let mut u = column(wanted.input)?;
    let mut y = match wanted.output {
        Some(output) => column(output)?,
        None => vec![f64::NAN; u.len()],
    };
    let mut t: Vec<f64> = match wanted.rate {
        Some(rate) => (0..u.len()).map(|k| k as f64 / rate.value()).collect(),
        None => {
            let (name, unit_s) = time_column(path, &table, wanted.time)?;
            let mut t = column(&name)?;
            t.iter_mut().for_each(|t| *t *= unit_s);
            t
        }
    };
    // What a loop knows of its frames stands beside position and command.
    let beside = |name: &str| table.numbers_or_nan(&ColumnRef::from(name)).ok();
    let mut age = beside(FRAME_AGE).unwrap_or_default();
    let mut came = beside(FRAME_CAME).unwrap_or_default();
    let mut late = beside(LATE_COMMAND).unwrap_or_default();
    let mut late_motion = beside(LATE_MOTION).unwrap_or_default();
    if let Some(rows) = wanted.rows {
        let range = range_of(rows, u.len())?;
        for values in [&mut age, &mut came, &mut late, &mut late_motion] {
            *values = (values.get(range.clone())).map_or_else(Vec::new, <[f64]>::to_vec);
        }
        (u, y, t) = (
            u[range.clone()].to_vec(),
            y[range.clone()].to_vec(),
            t[range].to_vec(),
        );
    }
    u.iter_mut().for_each(|v| *v *= wanted.factors[0]);
    y.iter_mut().for_each(|v| *v *= wanted.factors[1]);
    // A row whose input or time is not there is a row that is missing.
    let known: Vec<usize> = (0..u.len())
        .filter(|&k| u[k].is_finite() && t[k].is_finite())
        .collect();
    let pick = |values: &[f64]| known.iter().map(|&k| values[k]).collect::<Vec<_>>();
    let (mut u, mut y, mut t) = (pick(&u), pick(&y), pick(&t));
    for values in [&mut age, &mut came, &mut late, &mut late_motion] {
        if !values.is_empty() {
            *values = pick(values);
        }
    }
    if let Some(even) = evened(&t, &u, &y, wanted.held) {
        tracing::warn!(
            "{}: sampled unevenly: taken every {:.6} s, between the rows by interpolation",
            path.display(),
            even.0[1] - even.0[0]
        );
        (t, u, y) = even;
        age.clear();
        came.clear();
        late.clear();
        late_motion.clear();
    }
    let mut record = Record::from_rows(&record_name(path), &t, &u, &y).map_err(refused)?;
    if wanted.held {
        hold_over_gaps(&mut record);
        record.frame_age_s = in_rows(&record, &t, &age);
        let late = in_rows(&record, &t, &late);
        if !late.is_empty() {
            record.late_command = late.iter().map(|late| *late == 1.0).collect();
        }
        record.late_motion_um = in_rows(&record, &t, &late_motion);
        (record.late_motion_um.iter_mut()).for_each(|um| *um *= wanted.factors[1]);
        let came = in_rows(&record, &t, &came);
        if !came.is_empty() {
            record.unseen = (came.iter().zip(&record.bead_um))
                .map(|(came, bead)| *came == 1.0 && bead.is_nan())
                .collect();
        }
        let constant = |name: &str| {
            let known = beside(name)?.into_iter().find(|value| value.is_finite());
            known.filter(|value| *value > 0.0)
        };
        record.exposure_s = constant(EXPOSURE).unwrap_or(0.0);
        record.slew_um_per_s = constant(SLEW).unwrap_or(0.0) * wanted.factors[0];
    }
    Ok(record)
}

/// Values of rows with their times on the rows of a record; NaN for a row that was missing.
fn in_rows(record: &Record, t: &[f64], values: &[f64]) -> Vec<f64> {
    if values.is_empty() {
        return Vec::new();
    }
    let mut out = vec![f64::NAN; record.rows()];
    for (t, value) in t.iter().zip(values) {
        let row = ((t - record.start_s) / record.sample_s).round();
        if let Some(at) = out.get_mut(row as usize) {
            *at = *value;
        }
    }
    out
}

/// A command that was interpolated over missing rows keeps the value before them, as a held one does.
fn hold_over_gaps(record: &mut Record) {
    let u = &mut record.pzt_um;
    let mut k = 1;
    while k < u.len() {
        let end = (k..u.len()).find(|&i| !record.filled[i]).unwrap_or(u.len());
        if end > k && end < u.len() {
            let (before, after) = (u[k - 1], u[end]);
            let line =
                |i: usize| before + (after - before) * (i + 1 - k) as f64 / (end + 1 - k) as f64;
            let size = 1e-9 * (before.abs() + after.abs());
            // What another period told stays.
            if (k..end).all(|i| (u[i] - line(i)).abs() <= size) {
                u[k..end].fill(before);
            }
        }
        k = end + 1;
    }
}

/// The names of columns as in the file; as requested if it has none.
pub fn names_in(path: &Path, asked: [&str; 2]) -> [String; 2] {
    let header = read_table(path).ok();
    let table = header
        .as_deref()
        .and_then(|text| Table::parse(path, text).ok());
    asked.map(|asked| {
        let place = table.as_ref().and_then(|t| t.find(&ColumnRef::from(asked)));
        let name = table.as_ref().zip(place).map(|(t, place)| &t.names[place]);
        name.map_or_else(|| asked.to_owned(), Clone::clone)
    })
}

/// The unit of a column as its name says it: in brackets, or behind the last `_`; None where it says none that is known.
pub fn unit_of(name: &str) -> Option<&str> {
    const KNOWN: [&str; 40] = [
        "V", "mV", "kV", "A", "mA", "W", "kW", "N", "mN", "kN", "Nm", "m", "mm", "cm", "um", "nm",
        "degC", "\u{b0}C", "C", "K", "bar", "mbar", "Pa", "kPa", "MPa", "rpm", "rad", "deg", "Hz",
        "L", "l", "%", "lmin", "Lmin", "m3h", "rads", "mT", "T", "g", "kg",
    ];
    if let Some((_, rest)) = name.split_once(['[', '(']) {
        let unit = rest.trim_end_matches([']', ')']).trim();
        return (!unit.is_empty() && unit.chars().count() <= 10).then_some(unit);
    }
    let (_, unit) = name.rsplit_once('_')?;
    KNOWN.contains(&unit).then_some(unit)
}

/// Seconds in the unit that the name of a column of time gives; one where it gives none.
fn seconds_in(name: &str) -> f64 {
    let bracketed = name.split_once(['[', '(']);
    let unit = match bracketed {
        Some((_, rest)) => rest.trim_end_matches([']', ')']).trim(),
        None => name.rsplit_once('_').map_or("", |(_, unit)| unit),
    };
    seconds_of(&unit.to_lowercase()).unwrap_or(1.0)
}

fn seconds_of(unit: &str) -> Option<f64> {
    Some(match unit {
        "s" | "sec" | "seconds" => 1.0,
        "ms" | "msec" => 1e-3,
        "us" | "\u{b5}s" | "\u{3bc}s" | "usec" => 1e-6,
        "ns" => 1e-9,
        "min" => 60.0,
        "h" | "hours" => 3600.0,
        "d" | "days" => 86400.0,
        _ => return None,
    })
}

/// The column of time, and the seconds of its unit.
fn time_column(
    path: &Path,
    table: &Table<'_>,
    asked: Option<&str>,
) -> Result<(String, f64), Failure> {
    if let Some(asked) = asked {
        let place = table.find(&ColumnRef::from(asked));
        let name = place.map_or(asked, |place| table.names[place].as_str());
        return Ok((asked.to_owned(), seconds_in(name)));
    }
    let called = |name: &&String| {
        let plain = name.to_lowercase();
        let mut words = plain
            .split(['[', '(', '_', ' ', ']', ')'])
            .filter(|word| !word.is_empty());
        let stem = words.next().unwrap_or("");
        // `T [degC]` is a temperature.
        let of_time = words.next().is_none_or(|unit| seconds_of(unit).is_some());
        TIMES.contains(&stem) && of_time
    };
    let mut found = table.names.iter().filter(called);
    match (found.next(), found.next()) {
        (Some(name), None) => Ok((name.clone(), seconds_in(name))),
        _ => Err(Failure::bad_input(
            format!("{}: no column is clearly that of the time", path.display()),
            format!(
                "give --rate (200Hz), or --time-column; this file has: {}",
                table.names.join(", ")
            ),
        )),
    }
}

fn range_of(rows: &str, all: usize) -> Result<std::ops::Range<usize>, Failure> {
    let wrong = || {
        Failure::bad_input(
            format!("--rows {rows}: not FROM:TO within 0..{all}"),
            "for example --rows 0:6000",
        )
    };
    let (from, to) = rows.split_once(':').ok_or_else(wrong)?;
    let number = |text: &str| text.trim().parse::<usize>().ok();
    match (number(from), number(to)) {
        (Some(from), Some(to)) if from < to && to <= all => Ok(from..to),
        _ => Err(wrong()),
    }
}

/// Resamples rows with uneven times; None if the times are even, except for gaps and rounding.
fn evened(t: &[f64], u: &[f64], y: &[f64], held: bool) -> Option<(Vec<f64>, Vec<f64>, Vec<f64>)> {
    let steps: Vec<f64> = t.windows(2).map(|w| w[1] - w[0]).collect();
    if steps.len() < 15 || steps.iter().any(|s| s.is_nan() || *s <= 0.0) {
        return None;
    }
    let mut sorted = steps.clone();
    sorted.sort_by(f64::total_cmp);
    let usual = sorted[sorted.len() / 2];
    let near: Vec<f64> = steps.iter().copied().filter(|s| *s < 1.5 * usual).collect();
    let off = near.iter().map(|s| (s / usual - 1.0).powi(2)).sum::<f64>() / near.len() as f64;
    sorted.dedup_by(|a, b| (*a - *b).abs() < 1e-6 * usual);
    // Rounded times come in a few steps only.
    if off.sqrt() < 0.03 || sorted.len() <= 6 {
        return None;
    }
    // Steps that are far longer are gaps of several rows.
    let count: f64 = (steps.iter())
        .map(|s| {
            if *s > 2.5 * usual {
                (s / usual).round()
            } else {
                1.0
            }
        })
        .sum();
    let step = (t[t.len() - 1] - t[0]) / count;
    let rows = ((t[t.len() - 1] - t[0]) / step).floor() as usize + 1;
    if rows > 20 * t.len() + 1000 {
        return None;
    }
    let (mut times, mut inputs, mut outputs) = (Vec::new(), Vec::new(), Vec::new());
    let mut k = 0;
    for i in 0..rows {
        let at = t[0] + i as f64 * step;
        while k + 2 < t.len() && t[k + 1] <= at {
            k += 1;
        }
        let share = ((at - t[k]) / (t[k + 1] - t[k])).clamp(0.0, 1.0);
        let line = |v: &[f64]| v[k] + share * (v[k + 1] - v[k]);
        let gap = t[k + 1] - t[k] > 2.5 * step;
        times.push(at);
        inputs.push(if held && share < 1.0 { u[k] } else { line(u) });
        outputs.push(if gap { f64::NAN } else { line(y) });
    }
    Some((times, inputs, outputs))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wanted<'a>(input: &'a str, output: &'a str) -> Wanted<'a> {
        Wanted {
            input,
            output: Some(output),
            time: None,
            rate: None,
            factors: [1.0, 1.0],
            rows: None,
            held: true,
        }
    }

    fn read_of(text: &str, wanted: &Wanted<'_>) -> Result<Record, Failure> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("r.csv");
        std::fs::write(&path, text).unwrap();
        read(&path, wanted)
    }

    #[test]
    fn time_is_found_by_its_name_and_taken_in_its_unit() {
        let rows: String = (0..40)
            .map(|k| format!("{};{},5;{}\n", 50 * k, k, k * k))
            .collect();
        let text = format!("Zeit [ms];U [V];n\n{rows}");
        let record = read_of(&text, &wanted("U", "n")).unwrap();
        assert!((record.sample_s - 0.05).abs() < 1e-12);
        assert_eq!((record.pzt_um[3], record.bead_um[3]), (3.5, 9.0));
        let text = text.replace("Zeit [ms]", "row");
        let Err(error) = read_of(&text, &wanted("U", "n")) else {
            panic!("a file without a time was read");
        };
        assert!(format!("{error:?}").contains("--rate"), "{error:?}");
    }

    #[test]
    fn a_row_without_its_input_is_a_row_that_is_missing() {
        let rows: String = (0..40)
            .map(|k| match k {
                7 => "7,NA,1\n".to_owned(),
                _ => format!("{k},{k},{}\n", 2 * k),
            })
            .collect();
        let record = read_of(&format!("t,a,b\n{rows}"), &wanted("a", "b")).unwrap();
        assert_eq!(record.rows(), 40);
        assert!(record.filled[7] && record.bead_um[7].is_nan());
        assert_eq!(record.bead_um[8], 16.0);
        assert_eq!(record.pzt_um[7], 6.0, "a held command stays where it was");
    }

    #[test]
    fn rows_between_the_marks_of_an_even_clock_are_put_on_them() {
        let mut text = "t,a,b\n".to_owned();
        for k in 0..200 {
            let t = 0.1 * f64::from(k) + 0.02 * (1.7 * f64::from(k)).sin();
            text += &format!("{t:.6},1.0,{:.6}\n", 3.0 * t);
        }
        let record = read_of(&text, &wanted("a", "b")).unwrap();
        assert!((record.sample_s - 0.1).abs() < 1e-3, "{}", record.sample_s);
        assert!(record.filled.iter().all(|filled| !filled));
        let slope = |k: usize| (record.bead_um[k + 1] - record.bead_um[k]) / record.sample_s;
        assert!((1..190).all(|k| (slope(k) - 3.0).abs() < 1e-3));
    }

    #[test]
    fn units_are_those_that_names_give() {
        assert_eq!(unit_of("p [bar]"), Some("bar"));
        assert_eq!(unit_of("speed_rpm"), Some("rpm"));
        assert_eq!(unit_of("V_out"), None);
        assert_eq!(unit_of("y"), None);
    }
}
