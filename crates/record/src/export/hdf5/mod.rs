//! A run as one HDF5 file: `/ticks` and `/cycles` with one dataset per column, `/events`, and the metadata as text.
//!
//! Only this module knows the HDF5 library. Deflate is the only filter that all readers of the field have.

mod rtdc;

pub use rtdc::write_rtdc;

use super::columns::{Column, Row, Value, listed, word};
use super::{Exported, Selection, Source, part_of, settle};
use crate::error::RecordError;
use crate::events::Event;
use cellpos_table::Table;
use hdf5_pure::{
    AttrValue, DatasetBuilder, File, FileAccessProperties, FileBuilder, GroupBuilder, MaxExtent,
    SyncPolicy,
};
use std::path::Path;

/// Rows of a chunk, and rows held in memory. The library encodes a chunk's rows in 1, 2, 4 or 8 bytes. HDF5 2.0 requires the
/// fewest possible bytes, and refuses the file otherwise; from 65 536 rows on that would be three.
const CHUNK: usize = 1 << 15;
const _: () = assert!(CHUNK <= u16::MAX as usize);
/// The number for a missing word.
const NO_WORD: u8 = 255;
/// Level of deflate: a higher one gains little on measured numbers.
const LEVEL: u32 = 1;

fn encode(error: &dyn std::fmt::Display) -> RecordError {
    RecordError::Encode {
        what: "HDF5",
        message: error.to_string(),
    }
}

/// Values of a column that wait to be written.
enum Values {
    Number(Vec<f64>),
    Whole(Vec<u64>),
    Code(Vec<u8>),
}

impl Values {
    fn new(column: &Column<'_>) -> Self {
        match column.value {
            Value::Number(_) => Self::Number(Vec::with_capacity(CHUNK)),
            Value::Whole(_) => Self::Whole(Vec::with_capacity(CHUNK)),
            Value::Code(..) => Self::Code(Vec::with_capacity(CHUNK)),
        }
    }

    fn push(&mut self, column: &Column<'_>, row: &Row) {
        match (self, column.value) {
            (Self::Number(values), Value::Number(get)) => values.push(get(row)),
            (Self::Whole(values), Value::Whole(get)) => values.push(get(row)),
            (Self::Code(values), Value::Code(codes, get)) => {
                let number = get(row);
                values.push(word(codes, number).map_or(NO_WORD, |_| number));
            }
            _ => {}
        }
    }

    fn len(&self) -> usize {
        match self {
            Self::Number(values) => values.len(),
            Self::Whole(values) => values.len(),
            Self::Code(values) => values.len(),
        }
    }
}

/// Writes the rows of a run with its cycles, events and metadata, in one step.
///
/// # Errors
/// [`RecordError`] names the file.
pub fn write_hdf5(
    source: &Source,
    selection: &Selection,
    path: &Path,
) -> Result<Exported, RecordError> {
    let columns = selection.columns(source)?;
    let part = part_of(path)?;
    let attempt = || {
        empty(source, &columns, &part)?;
        let access = FileAccessProperties::new().with_sync_policy(SyncPolicy::OnClose);
        let file = File::open_rw_with_options(&part, access).map_err(|error| encode(&error))?;
        let mut waiting: Vec<Values> = columns.iter().map(Values::new).collect();
        let done = source.rows(selection, |rows| {
            for row in rows {
                for (column, values) in columns.iter().zip(&mut waiting) {
                    values.push(column, row);
                }
                if waiting.first().is_some_and(|values| values.len() == CHUNK) {
                    append(&file, &columns, &mut waiting)?;
                }
            }
            Ok(())
        })?;
        append(&file, &columns, &mut waiting)?;
        file.close().map_err(|error| encode(&error))?;
        settle(&part, path).map_err(RecordError::io("cannot write", path))?;
        Ok(done)
    };
    attempt().inspect_err(|_| {
        let _ = std::fs::remove_file(&part);
    })
}

fn append(file: &File, columns: &[Column<'_>], waiting: &mut [Values]) -> Result<(), RecordError> {
    for (column, values) in columns.iter().zip(waiting) {
        let mut dataset = file
            .dataset(&format!("ticks/{}", column.name))
            .map_err(|error| encode(&error))?;
        match values {
            Values::Number(values) => {
                dataset.append(values).map_err(|error| encode(&error))?;
                values.clear();
            }
            Values::Whole(values) => {
                dataset.append(values).map_err(|error| encode(&error))?;
                values.clear();
            }
            Values::Code(values) => {
                dataset.append(values).map_err(|error| encode(&error))?;
                values.clear();
            }
        }
    }
    Ok(())
}

/// A file with everything but the rows.
fn empty(source: &Source, columns: &[Column<'_>], path: &Path) -> Result<(), RecordError> {
    let mut builder = FileBuilder::new();
    builder.set_attr("cellpos_format", AttrValue::U32(crate::FORMAT));
    if let Some(meta) = source.meta() {
        builder.set_attr("run", AttrValue::String(meta.name.clone()));
        builder.set_attr("started_utc", AttrValue::String(meta.started_utc.clone()));
        let text = meta.to_toml()?;
        builder
            .create_dataset("run_toml")
            .with_strings(&[text.as_str()])
            .map_err(|error| encode(&error))?;
    }
    let mut ticks = builder.create_group("ticks");
    for column in columns {
        let dataset = ticks.create_dataset(column.name);
        match column.value {
            Value::Number(_) => dataset.with_f64_data(&[]),
            Value::Whole(_) => dataset.with_u64_data(&[]),
            Value::Code(..) => dataset.with_u8_data(&[]),
        };
        dataset
            .with_shape(&[0])
            .with_maxshape(&[MaxExtent::Unlimited])
            .with_chunks(&[CHUNK as u64])
            .with_shuffle()
            .with_deflate(LEVEL);
        described(dataset, column);
    }
    builder.add_group(ticks.finish());
    let mut cycles = builder.create_group("cycles");
    if let Some((path, text)) = source.cycles()? {
        table(&mut cycles, &Table::parse(&path, &text)?)?;
    }
    builder.add_group(cycles.finish());
    let mut events = builder.create_group("events");
    log(&mut events, &source.events()?)?;
    builder.add_group(events.finish());
    builder.write(path).map_err(|error| encode(&error))
}

fn described(dataset: &mut DatasetBuilder, column: &Column<'_>) {
    dataset.set_attr("description", AttrValue::String(column.about.to_owned()));
    if !column.unit.is_empty() {
        dataset.set_attr("unit", AttrValue::String(column.unit.to_owned()));
    }
    if let Value::Code(codes, _) = column.value {
        dataset.set_attr("codes", AttrValue::String(listed(codes)));
        dataset.set_attr("none", AttrValue::U8(NO_WORD));
    }
}

/// Columns of a table: numbers if all fields are numbers or empty, else text.
fn table(group: &mut GroupBuilder, table: &Table) -> Result<(), RecordError> {
    for (place, name) in table.names.iter().enumerate() {
        let number = |field: &str| match field {
            "" => Some(f64::NAN),
            field => field.parse().ok(),
        };
        let numbers: Option<Vec<f64>> = table.fields(place).map(number).collect();
        let dataset = group.create_dataset(name);
        match numbers {
            Some(numbers) => {
                dataset.with_f64_data(&numbers);
            }
            None => {
                let texts: Vec<&str> = table.fields(place).collect();
                dataset
                    .with_strings(&texts)
                    .map_err(|error| encode(&error))?;
            }
        }
    }
    Ok(())
}

fn log(group: &mut GroupBuilder, events: &[(u64, Event)]) -> Result<(), RecordError> {
    if events.is_empty() {
        return Ok(());
    }
    let sessions: Vec<u64> = events.iter().map(|(session, _)| *session).collect();
    let times: Vec<f64> = events.iter().map(|(_, event)| event.time_s).collect();
    let names: Vec<&str> = events
        .iter()
        .map(|(_, event)| event.event.as_str())
        .collect();
    let data: Vec<String> = events
        .iter()
        .map(|(_, event)| serde_json::Value::Object(event.data.clone()).to_string())
        .collect();
    let data: Vec<&str> = data.iter().map(String::as_str).collect();
    group.create_dataset("session").with_u64_data(&sessions);
    group
        .create_dataset("time_s")
        .with_f64_data(&times)
        .set_attr("unit", AttrValue::String("s".to_owned()));
    for (name, texts) in [("event", names), ("data", data)] {
        group
            .create_dataset(name)
            .with_strings(&texts)
            .map_err(|error| encode(&error))?;
    }
    Ok(())
}
