//! A run as Apache Parquet: missing numbers are null, words are dictionaries, and each column has its unit and meaning.

use super::columns::{Column, Row, Value, listed, word};
use super::{Exported, Selection, Source, whole};
use crate::error::RecordError;
use arrow_array::builder::StringDictionaryBuilder;
use arrow_array::types::Int8Type;
use arrow_array::{ArrayRef, Float64Array, RecordBatch, StringArray, UInt64Array};
use arrow_schema::{DataType, Field, Schema, SchemaRef};
use parquet::arrow::ArrowWriter;
use parquet::basic::Encoding;
use parquet::file::properties::WriterProperties;
use parquet::schema::types::ColumnPath;
use std::collections::{HashMap, HashSet};
use std::io::BufWriter;
use std::path::Path;
use std::sync::Arc;

/// Rows of a row group, which the writer holds in memory.
const ROW_GROUP: usize = 1 << 17;

fn encode(error: &dyn std::fmt::Display) -> RecordError {
    RecordError::Encode {
        what: "Parquet",
        message: error.to_string(),
    }
}

/// Writes the rows of a run as Parquet, in one step.
///
/// # Errors
/// [`RecordError`] names the file.
pub fn write_parquet(
    source: &Source,
    selection: &Selection,
    path: &Path,
) -> Result<Exported, RecordError> {
    let columns = selection.columns(source)?;
    let schema = schema(&columns, source);
    whole(path, |file| {
        let mut out = Some(BufWriter::new(file));
        let mut writer: Option<ArrowWriter<_>> = None;
        let done = source.rows(selection, |rows| {
            let arrays = columns.iter().map(|column| array(column, rows)).collect();
            let batch = RecordBatch::try_new(Arc::clone(&schema), arrays);
            let batch = batch.map_err(|error| encode(&error))?;
            if let Some(out) = out.take() {
                let made = ArrowWriter::try_new(out, batch.schema(), Some(layout(&columns, rows)));
                writer = Some(made.map_err(|error| encode(&error))?);
            }
            writer
                .as_mut()
                .map_or(Ok(()), |writer| writer.write(&batch))
                .map_err(|error| encode(&error))
        })?;
        if let Some(writer) = writer {
            let out = writer.into_inner().map_err(|error| encode(&error))?;
            out.into_inner().map_err(|error| encode(&error))?;
        }
        Ok(done)
    })
}

/// Encoding of the columns, chosen by the first rows. A number that seldom repeats gets no dictionary, which would hold nearly
/// every value. A whole number that always grows (a tick, a time) is stored as its steps.
fn layout(columns: &[Column<'_>], rows: &[Row]) -> WriterProperties {
    let mut layout = WriterProperties::builder().set_max_row_group_row_count(Some(ROW_GROUP));
    for column in columns {
        let bits: Vec<u64> = match column.value {
            Value::Number(get) => rows.iter().map(|row| get(row).to_bits()).collect(),
            Value::Whole(get) => rows.iter().map(get).collect(),
            Value::Code(..) => continue,
        };
        let different = bits.iter().collect::<HashSet<_>>().len();
        if 4 * different <= bits.len() {
            continue;
        }
        let path = ColumnPath::from(column.name);
        layout = layout.set_column_dictionary_enabled(path.clone(), false);
        if matches!(column.value, Value::Whole(_)) {
            layout = layout.set_column_encoding(path, Encoding::DELTA_BINARY_PACKED);
        }
    }
    layout.build()
}

/// The columns with unit, meaning and words, and the run's description.
fn schema(columns: &[Column<'_>], source: &Source) -> SchemaRef {
    let fields: Vec<Field> = columns
        .iter()
        .map(|column| {
            let mut about: HashMap<String, String> = HashMap::new();
            about.insert("description".to_owned(), column.about.to_owned());
            if !column.unit.is_empty() {
                about.insert("unit".to_owned(), column.unit.to_owned());
            }
            let (kind, nullable) = match column.value {
                Value::Number(_) => (DataType::Float64, true),
                Value::Whole(_) => (DataType::UInt64, false),
                Value::Code(codes, _) => {
                    about.insert("codes".to_owned(), listed(codes));
                    let words = DataType::Utf8.into();
                    (DataType::Dictionary(DataType::Int8.into(), words), true)
                }
            };
            Field::new(column.name, kind, nullable).with_metadata(about)
        })
        .collect();
    let mut about: HashMap<String, String> = HashMap::new();
    about.insert("cellpos.format".to_owned(), crate::FORMAT.to_string());
    if let Some(meta) = source.meta() {
        about.insert("cellpos.run".to_owned(), meta.name.clone());
        // On the virtual clock a seed fixes every bit, so the time of day is left out.
        if meta.clock != "virtual" {
            about.insert("cellpos.started_utc".to_owned(), meta.started_utc.clone());
        }
    }
    Arc::new(Schema::new_with_metadata(fields, about))
}

fn array(column: &Column<'_>, rows: &[Row]) -> ArrayRef {
    match column.value {
        Value::Number(get) => {
            let values = rows
                .iter()
                .map(|row| Some(get(row)).filter(|v| !v.is_nan()));
            Arc::new(values.collect::<Float64Array>())
        }
        Value::Whole(get) => Arc::new(rows.iter().map(get).map(Some).collect::<UInt64Array>()),
        Value::Code(codes, get) => {
            // All words in every batch, in one order, so that all batches share their dictionary.
            let words: StringArray = codes.iter().map(|(_, word)| Some(*word)).collect();
            let builder = StringDictionaryBuilder::<Int8Type>::new_with_dictionary(0, &words);
            let Ok(mut builder) = builder else {
                unreachable!("a dozen words fit into a dictionary")
            };
            for row in rows {
                builder.append_option(word(codes, get(row)));
            }
            Arc::new(builder.finish())
        }
    }
}

/// A column of a small table.
#[derive(Debug, Clone, PartialEq)]
pub enum TableColumn {
    /// Numbers; NaN if missing.
    Numbers(Vec<f64>),
    /// Text.
    Texts(Vec<String>),
}

/// Writes a small table of named columns as Parquet, in one step.
///
/// # Errors
/// [`RecordError`] names the file; columns of different lengths are refused.
pub fn write_table_parquet(
    path: &Path,
    columns: &[(&str, TableColumn)],
) -> Result<(), RecordError> {
    let arrays = columns.iter().map(|(name, column)| {
        let array: ArrayRef = match column {
            TableColumn::Numbers(values) => Arc::new(Float64Array::from(values.clone())),
            TableColumn::Texts(values) => Arc::new(StringArray::from(values.clone())),
        };
        (*name, array)
    });
    let batch = RecordBatch::try_from_iter(arrays).map_err(|error| encode(&error))?;
    let mut bytes = Vec::new();
    let mut writer =
        ArrowWriter::try_new(&mut bytes, batch.schema(), None).map_err(|error| encode(&error))?;
    writer
        .write(&batch)
        .and_then(|()| writer.close().map(|_| ()))
        .map_err(|error| encode(&error))?;
    cellpos_table::write_atomically(path, &bytes)?;
    Ok(())
}
