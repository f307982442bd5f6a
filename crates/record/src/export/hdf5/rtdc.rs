//! The cells of a run in the format of real-time deformability cytometry (`.rtdc`), for dclab and Shape-Out. Each frame with a
//! measured cell is one event.
//!
//! Deformation is not in it: the loop measures length and area of a cell, not its perimeter.

use super::{CHUNK, LEVEL, encode};
use crate::error::RecordError;
use crate::export::columns::Row;
use crate::export::{Exported, Selection, Source, part_of, seconds, settle};
use crate::meta::{RunMeta, number_at, value_at};
use hdf5_pure::{AttrValue, File, FileAccessProperties, FileBuilder, MaxExtent, SyncPolicy};
use std::path::Path;

/// A feature: its name in the format, and how to read it from a row.
type Feature = (&'static str, fn(&Row) -> f64);

/// The features, by the names that the format knows.
const FEATURES: [Feature; 7] = [
    ("area_um", |r| r.tick.area_um2),
    ("size_x", |r| r.tick.length_um),
    ("pos_x", |r| r.tick.measured_um),
    ("time", |r| {
        seconds(r.offset_ns.saturating_add(r.tick.mid_exposure_ns))
    }),
    ("frame", |r| r.tick.frame_id as f64),
    ("userdef0", |r| r.tick.target_um),
    ("userdef1", |r| r.tick.command_um),
];

/// Writes the cells of a run as `.rtdc`, in one step.
///
/// # Errors
/// [`RecordError`] names the file. A run without a measured cell, or without the format's required data on sample, chip and
/// imaging, is refused; the error names what is missing.
pub fn write_rtdc(
    source: &Source,
    selection: &Selection,
    path: &Path,
) -> Result<Exported, RecordError> {
    let is_event = |row: &&Row| row.tick.area_um2.is_finite() && row.tick.length_um.is_finite();
    let mut events = Events::default();
    source.rows(selection, |rows| {
        rows.iter().filter(is_event).for_each(|row| events.add(row));
        Ok(())
    })?;
    let count = events.count;
    if count == 0 {
        return Err(refused(
            "no cell was measured in this run: it holds no events",
        ));
    }
    let part = part_of(path)?;
    let attempt = || {
        empty(source, &events, &part)?;
        let access = FileAccessProperties::new().with_sync_policy(SyncPolicy::OnClose);
        let file = File::open_rw_with_options(&part, access).map_err(|error| encode(&error))?;
        let mut waiting: Vec<Vec<f64>> = FEATURES.iter().map(|_| Vec::new()).collect();
        let done = source.rows(selection, |rows| {
            for row in rows.iter().filter(is_event) {
                for ((_, get), values) in FEATURES.iter().zip(&mut waiting) {
                    values.push(get(row));
                }
                if waiting.first().is_some_and(|values| values.len() == CHUNK) {
                    append(&file, &mut waiting)?;
                }
            }
            Ok(())
        })?;
        append(&file, &mut waiting)?;
        file.close().map_err(|error| encode(&error))?;
        settle(&part, path).map_err(RecordError::io("cannot write", path))?;
        Ok(Exported {
            rows: count,
            lost: done.lost,
        })
    };
    attempt().inspect_err(|_| {
        let _ = std::fs::remove_file(&part);
    })
}

/// Facts about all events that the header needs.
#[derive(Debug, Default)]
struct Events {
    count: u64,
    /// End of the path so far: time \[s\], position \[um\].
    last: Option<(f64, f64)>,
    path_um: f64,
    path_s: f64,
}

impl Events {
    /// Spacing of the points of the path, s: position noise of some 20 nm then adds at most 2 um/s.
    const STEP_S: f64 = 0.01;
    /// A longer pause, s, of a lost cell or between two sessions, is not part of the path.
    const PAUSE_S: f64 = 0.1;

    fn add(&mut self, row: &Row) {
        self.count += 1;
        let now = (
            seconds(row.offset_ns.saturating_add(row.tick.mid_exposure_ns)),
            row.tick.measured_um,
        );
        let Some((time_s, position_um)) = self.last else {
            self.last = Some(now);
            return;
        };
        let passed_s = now.0 - time_s;
        if (Self::STEP_S..=Self::PAUSE_S).contains(&passed_s) && now.1.is_finite() {
            self.path_um += (now.1 - position_um).abs();
            self.path_s += passed_s;
        }
        if passed_s >= Self::STEP_S {
            self.last = Some(now);
        }
    }

    /// Mean speed of the cell, to and fro, um/s.
    fn speed_um_per_s(&self) -> f64 {
        if self.path_s > 0.0 {
            self.path_um / self.path_s
        } else {
            0.0
        }
    }
}

/// Flow through a square channel at a speed, ul/s. The PZT moves the medium to and fro: this is its mean absolute value. The
/// format refuses a flow of zero, so a cell at rest gets the smallest number.
fn flow_ul_per_s(speed_um_per_s: f64, width_um: f64) -> f64 {
    const UL_PER_UM3: f64 = 1e-9;
    (speed_um_per_s * width_um * width_um * UL_PER_UM3).max(f64::MIN_POSITIVE)
}

fn refused(message: &str) -> RecordError {
    RecordError::Encode {
        what: "RT-DC",
        message: message.to_owned(),
    }
}

fn append(file: &File, waiting: &mut [Vec<f64>]) -> Result<(), RecordError> {
    for ((name, _), values) in FEATURES.iter().zip(waiting) {
        let mut dataset = file
            .dataset(&format!("events/{name}"))
            .map_err(|error| encode(&error))?;
        dataset.append(values).map_err(|error| encode(&error))?;
        values.clear();
    }
    Ok(())
}

fn empty(source: &Source, all: &Events, path: &Path) -> Result<(), RecordError> {
    let meta = source
        .meta()
        .ok_or_else(|| refused("run.toml cannot be read, and the format needs it"))?;
    let mut builder = FileBuilder::new();
    for (name, value) in attributes(meta, all)? {
        builder.set_attr(name, value);
    }
    let mut events = builder.create_group("events");
    for (name, _) in FEATURES {
        events
            .create_dataset(name)
            .with_f64_data(&[])
            .with_shape(&[0])
            .with_maxshape(&[MaxExtent::Unlimited])
            .with_chunks(&[CHUNK as u64])
            .with_shuffle()
            .with_deflate(LEVEL);
    }
    builder.add_group(events.finish());
    builder.write(path).map_err(|error| encode(&error))
}

/// The format's required data of a measurement.
fn attributes(meta: &RunMeta, all: &Events) -> Result<Vec<(&'static str, AttrValue)>, RecordError> {
    let config = &meta.config;
    let text = |key: &str| {
        value_at(config, &["rig", "sample", key])
            .and_then(toml::Value::as_str)
            .ok_or_else(|| {
                refused(&format!(
                    "the format asks for `{key}`: say it in the table [sample] of rig.toml or of the script, and run again"
                ))
            })
    };
    let string = |text: &str| AttrValue::String(text.to_owned());
    let whole = |value: f64| AttrValue::I64(value as i64);
    let width_um = number_at(config, &["rig", "sample", "channel_width_um"]).ok_or_else(|| {
        refused("the format asks for `channel_width_um`: say it in the table [sample] of rig.toml")
    })?;
    let emulator = |key: &str| number_at(config, &["rig", "emulator", key]);
    let camera = |key: &str| number_at(config, &["rig", "camera", key]);
    let pixel_um = number_at(config, &["rig", "calibration", "pixel_um"])
        .or_else(|| emulator("pixel_um"))
        .ok_or_else(|| refused("run.toml does not say how large a pixel is"))?;
    let emulated = value_at(config, &["rig", "camera", "kind"]).and_then(toml::Value::as_str)
        == Some("emulated");
    let region = |place: usize| {
        value_at(config, &["rig", "camera", "region"])
            .and_then(|region| region.get(place))
            .and_then(toml::Value::as_integer)
            .map(|px| px as f64)
    };
    let (width_px, height_px) = if emulated {
        (emulator("width_px"), emulator("height_px"))
    } else {
        (region(2), region(3))
    };
    let exposure_us = if emulated {
        emulator("exposure_ms").map(|ms| ms * 1e3)
    } else {
        camera("exposure_us")
    };
    let rate_hz = if emulated {
        emulator("rate_hz")
    } else {
        camera("rate_hz")
    };
    let date = meta.started_utc.get(..10).unwrap_or("1970-01-01");
    let time = meta.started_utc.get(11..19).unwrap_or("00:00:00");
    let version = meta.versions.get("cellpos").map_or("", String::as_str);
    Ok(vec![
        ("experiment:date", string(date)),
        ("experiment:time", string(time)),
        ("experiment:event count", AttrValue::I64(all.count as i64)),
        ("experiment:run index", AttrValue::I64(1)),
        ("experiment:sample", string(text("sample")?)),
        ("setup:channel width", AttrValue::F64(width_um)),
        (
            "setup:chip region",
            string(text("region").unwrap_or("channel")),
        ),
        (
            "setup:flow rate",
            AttrValue::F64(flow_ul_per_s(all.speed_um_per_s(), width_um)),
        ),
        ("setup:identifier", string(&meta.name)),
        ("setup:medium", string(text("medium")?)),
        (
            "setup:software version",
            string(&format!("cellpos {version}")),
        ),
        (
            "imaging:flash device",
            string(if emulated { "emulated" } else { "unknown" }),
        ),
        (
            "imaging:flash duration",
            AttrValue::F64(exposure_us.unwrap_or(0.0)),
        ),
        (
            "imaging:frame rate",
            AttrValue::F64(rate_hz.unwrap_or(1000.0)),
        ),
        ("imaging:pixel size", AttrValue::F64(pixel_um)),
        ("imaging:roi position x", whole(region(0).unwrap_or(0.0))),
        ("imaging:roi position y", whole(region(1).unwrap_or(0.0))),
        ("imaging:roi size x", whole(width_px.unwrap_or(0.0))),
        ("imaging:roi size y", whole(height_px.unwrap_or(0.0))),
    ])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_flow_is_the_mean_speed_of_the_cell_times_the_section_of_the_channel() {
        let mut all = Events::default();
        let row = |ms: i64, position_um: f64| {
            let mut tick = cellpos_runtime::TickRecord::unknown();
            (tick.mid_exposure_ns, tick.measured_um) = (ms * 1_000_000, position_um);
            Row {
                tick,
                session: 1,
                offset_ns: 0,
            }
        };
        // To and fro at 100 um/s for two seconds, with a pause of a second between; a step with a turn in it is too short by half.
        for ms in (0..1000).chain(2000..3000) {
            let phase = (ms % 1000) as f64 * 1e-3;
            all.add(&row(ms, 100.0 * phase.min(1.0 - phase)));
        }
        assert_eq!(all.count, 2000);
        let speed = all.speed_um_per_s();
        assert!((speed / 100.0 - 1.0).abs() < 0.02, "{speed}");
        assert!((flow_ul_per_s(speed, 20.0) / 4e-5 - 1.0).abs() < 0.02);
        assert!(flow_ul_per_s(0.0, 20.0) > 0.0);
    }
}
