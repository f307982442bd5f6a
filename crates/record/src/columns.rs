//! Ticks as columns, and back.

use arrow_array::{
    ArrayRef, Float32Array, Float64Array, Int64Array, RecordBatch, UInt8Array, UInt32Array,
    UInt64Array,
};
use arrow_schema::{ArrowError, DataType, Field, Schema, SchemaRef};
use cellpos_runtime::{LAW_COLUMNS, TickFlags, TickRecord};
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::sync::Arc;

/// Type of a column.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    U64,
    I64,
    F64,
    F32,
    U32,
    U8,
}

impl Kind {
    /// Bytes of one value.
    pub(crate) const fn width(self) -> usize {
        match self {
            Self::U64 | Self::I64 | Self::F64 => 8,
            Self::U32 | Self::F32 => 4,
            Self::U8 => 1,
        }
    }

    fn data_type(self) -> DataType {
        match self {
            Self::U64 => DataType::UInt64,
            Self::I64 => DataType::Int64,
            Self::F64 => DataType::Float64,
            Self::F32 => DataType::Float32,
            Self::U32 => DataType::UInt32,
            Self::U8 => DataType::UInt8,
        }
    }
}

/// Groups of columns that a run has only if it needs them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Group {
    /// Every run.
    Loop,
    /// Length and area: runs that follow a cell.
    Cell,
    /// True position: the emulated rig.
    Truth,
    /// The optimiser's account: model predictive control.
    Solver,
    /// Plan and stage: runs of a script.
    Script,
    /// The slow partner of the PZT: rigs that have one.
    Partner,
    /// When the board had its commands: the real clock.
    Line,
}

/// All groups.
pub(crate) const GROUPS: [Group; 7] = [
    Group::Loop,
    Group::Cell,
    Group::Truth,
    Group::Solver,
    Group::Script,
    Group::Partner,
    Group::Line,
];

/// A column of `ticks.arrow`.
pub(crate) struct Column {
    pub(crate) name: &'static str,
    pub(crate) kind: Kind,
    pub(crate) group: Group,
    /// The value in a row, as its bits.
    pub(crate) get: fn(&TickRecord) -> u64,
    /// Sets the value from its little-endian bits (zero-extended to 64).
    pub(crate) set: fn(&mut TickRecord, u64),
}

/// A value as bits.
trait Bits {
    fn bits(self) -> u64;
    fn of(bits: u64) -> Self;
}

macro_rules! bits {
    ($type:ty, |$value:ident| $to:expr, |$bits:ident| $from:expr) => {
        impl Bits for $type {
            fn bits(self) -> u64 {
                let $value = self;
                $to
            }
            fn of($bits: u64) -> Self {
                $from
            }
        }
    };
}

bits!(u64, |value| value, |bits| bits);
bits!(i64, |value| value.cast_unsigned(), |bits| bits
    .cast_signed());
bits!(f64, |value| value.to_bits(), |bits| f64::from_bits(bits));
bits!(f32, |value| value.to_bits().into(), |bits| f32::from_bits(
    bits as u32
));
bits!(u32, |value| value.into(), |bits| bits as u32);
bits!(u8, |value| value.into(), |bits| bits as u8);
bits!(TickFlags, |value| value.0.into(), |bits| TickFlags(
    bits as u32
));

macro_rules! columns {
    ($($name:ident $kind:ident $group:ident,)*) => {
        /// Every column that a run can have, in the order of the file.
        pub(crate) const COLUMNS: &[Column] = &[$(Column {
            name: stringify!($name),
            kind: Kind::$kind,
            group: Group::$group,
            get: |row| row.$name.bits(),
            set: |row, bits| row.$name = Bits::of(bits),
        },)*];
    };
}

columns! {
    seq U64 Loop,
    time_ns I64 Loop,
    frame_id U64 Loop,
    mid_exposure_ns I64 Loop,
    measured_um F64 Loop,
    variance_um2 F64 Loop,
    verdict U8 Loop,
    target_um F64 Loop,
    error_um F64 Loop,
    estimate_um F64 Loop,
    estimate_sd_um F64 Loop,
    neutral_um F64 Loop,
    requested_um F64 Loop,
    command_um F64 Loop,
    applied_um F64 Loop,
    true_um F64 Truth,
    life U8 Loop,
    flags U32 Loop,
    drained U8 Loop,
    wake_ns U32 Loop,
    compute_ns U32 Loop,
    request U8 Loop,
    board U8 Loop,
    board_fault U8 Loop,
    solver_status U8 Solver,
    solver_iterations U8 Solver,
    solver_active U8 Solver,
    solver_ns U32 Solver,
    track U8 Loop,
    decision U8 Loop,
    plan_ns I64 Script,
    stage U8 Script,
    length_um F64 Cell,
    area_um2 F64 Cell,
    length_sd_um F64 Cell,
    area_sd_um2 F64 Cell,
    partner_command_um F64 Partner,
    partner_applied_um F64 Partner,
    partner_effect_um F64 Partner,
    partner U8 Partner,
    obeyed_before_us F64 Line,
    obeyed_at_us F64 Line,
}

/// Name of the last column of the file: CRC-32 of the values before it in the row, each in its own width, little-endian. It is
/// wrong in a row of a block that the disk never wrote (zeros) or wrote wrongly.
pub(crate) const CHECK: &str = "check";

/// Bytes of a row in the file, with the check, without the frame around batches.
pub(crate) fn row_bytes(groups: &[Group]) -> usize {
    let wanted = COLUMNS.iter().filter(|c| groups.contains(&c.group));
    wanted.map(|c| c.kind.width()).sum::<usize>() + Kind::U32.width()
}

/// A column of the control law that a run cannot have: its name is taken, or it is one more than a row holds.
pub(crate) fn impossible(law: &[String]) -> Option<&str> {
    let taken = |name: &str| name == CHECK || COLUMNS.iter().any(|c| c.name == name);
    law.iter()
        .find(|name| taken(name))
        .or_else(|| law.get(LAW_COLUMNS))
        .map(String::as_str)
}

/// The schema of `ticks.arrow`.
fn schema(groups: &[Group], law: &[String]) -> SchemaRef {
    let wanted = COLUMNS.iter().filter(|c| groups.contains(&c.group));
    let mut fields: Vec<Field> = wanted
        .map(|c| Field::new(c.name, c.kind.data_type(), false))
        .collect();
    fields.extend(
        law.iter()
            .map(|name| Field::new(name, DataType::Float32, false)),
    );
    fields.push(Field::new(CHECK, DataType::UInt32, false));
    let format = ("cellpos.format".to_owned(), crate::FORMAT.to_string());
    Arc::new(Schema::new(fields).with_metadata(HashMap::from([format])))
}

/// The first known value of a row for which the groups have no column.
fn without_column(
    row: &TickRecord,
    unknown: &TickRecord,
    groups: &[Group],
) -> Option<&'static str> {
    COLUMNS
        .iter()
        .filter(|c| !groups.contains(&c.group))
        .find(|c| (c.get)(row) != (c.get)(unknown))
        .map(|c| c.name)
}

/// One column being filled.
enum Values {
    U64(Vec<u64>),
    I64(Vec<i64>),
    F64(Vec<f64>),
    F32(Vec<f32>),
    U32(Vec<u32>),
    U8(Vec<u8>),
}

impl Values {
    fn new(kind: Kind, capacity: usize) -> Self {
        match kind {
            Kind::U64 => Self::U64(Vec::with_capacity(capacity)),
            Kind::I64 => Self::I64(Vec::with_capacity(capacity)),
            Kind::F64 => Self::F64(Vec::with_capacity(capacity)),
            Kind::F32 => Self::F32(Vec::with_capacity(capacity)),
            Kind::U32 => Self::U32(Vec::with_capacity(capacity)),
            Kind::U8 => Self::U8(Vec::with_capacity(capacity)),
        }
    }

    fn push(&mut self, bits: u64) {
        match self {
            Self::U64(values) => values.push(bits),
            Self::I64(values) => values.push(Bits::of(bits)),
            Self::F64(values) => values.push(Bits::of(bits)),
            Self::F32(values) => values.push(Bits::of(bits)),
            Self::U32(values) => values.push(Bits::of(bits)),
            Self::U8(values) => values.push(Bits::of(bits)),
        }
    }

    fn into_array(self) -> ArrayRef {
        match self {
            Self::U64(values) => Arc::new(UInt64Array::from(values)),
            Self::I64(values) => Arc::new(Int64Array::from(values)),
            Self::F64(values) => Arc::new(Float64Array::from(values)),
            Self::F32(values) => Arc::new(Float32Array::from(values)),
            Self::U32(values) => Arc::new(UInt32Array::from(values)),
            Self::U8(values) => Arc::new(UInt8Array::from(values)),
        }
    }
}

/// Rows gathered column by column until they make a batch.
pub(crate) struct Builder {
    columns: Vec<(&'static Column, Values)>,
    /// The control law's own.
    law: Vec<Vec<f32>>,
    checks: Vec<u32>,
    groups: Vec<Group>,
    unknown: TickRecord,
    schema: SchemaRef,
    capacity: usize,
    row: Vec<u8>,
}

impl Builder {
    pub(crate) fn new(capacity: usize, groups: &[Group], law: &[String]) -> Self {
        let wanted = COLUMNS.iter().filter(|c| groups.contains(&c.group));
        Self {
            columns: wanted.map(|c| (c, Values::new(c.kind, capacity))).collect(),
            law: law.iter().map(|_| Vec::with_capacity(capacity)).collect(),
            checks: Vec::with_capacity(capacity),
            groups: groups.to_vec(),
            unknown: TickRecord::unknown(),
            schema: schema(groups, law),
            capacity,
            row: Vec::new(),
        }
    }

    pub(crate) fn schema(&self) -> &SchemaRef {
        &self.schema
    }

    /// Takes a row; returns the name of a value that has no column in this run.
    pub(crate) fn push(&mut self, row: &TickRecord) -> Option<&'static str> {
        self.row.clear();
        for (column, values) in &mut self.columns {
            let bits = (column.get)(row);
            values.push(bits);
            let bytes = bits.to_le_bytes();
            self.row.extend_from_slice(&bytes[..column.kind.width()]);
        }
        for (values, value) in self.law.iter_mut().zip(row.law) {
            values.push(value);
            self.row.extend_from_slice(&value.to_le_bytes());
        }
        self.checks.push(crc32fast::hash(&self.row));
        without_column(row, &self.unknown, &self.groups)
    }

    pub(crate) fn rows(&self) -> usize {
        self.checks.len()
    }

    /// Takes the rows out as a batch.
    pub(crate) fn take(&mut self) -> Result<RecordBatch, ArrowError> {
        let mut arrays: Vec<ArrayRef> = Vec::with_capacity(self.columns.len() + 1);
        for (column, values) in &mut self.columns {
            let full = std::mem::replace(values, Values::new(column.kind, self.capacity));
            arrays.push(full.into_array());
        }
        for values in &mut self.law {
            let full = std::mem::replace(values, Vec::with_capacity(self.capacity));
            arrays.push(Values::F32(full).into_array());
        }
        let empty = Vec::with_capacity(self.capacity);
        let checks = std::mem::replace(&mut self.checks, empty);
        arrays.push(Arc::new(UInt32Array::from(checks)));
        RecordBatch::try_new(Arc::clone(&self.schema), arrays)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_column_comes_back_at_its_own_place() {
        let mut row = TickRecord::unknown();
        for (column, bits) in COLUMNS.iter().zip(100..) {
            (column.set)(&mut row, bits);
        }
        for (column, bits) in COLUMNS.iter().zip(100..) {
            assert_eq!((column.get)(&row), bits, "{}", column.name);
        }
    }

    #[test]
    fn names_of_quantities_carry_their_unit() {
        for column in COLUMNS {
            let name = column.name;
            let number = column.kind == Kind::F64;
            let unit = ["_um", "_um2", "_us"]
                .iter()
                .any(|unit| name.ends_with(unit));
            assert!(!number || unit, "{name}");
        }
    }

    #[test]
    fn a_value_without_a_column_is_named() {
        let mut builder = Builder::new(4, &[Group::Loop], &[]);
        assert_eq!(builder.push(&TickRecord::unknown()), None);
        let mut row = TickRecord::unknown();
        row.length_um = 9.5;
        assert_eq!(builder.push(&row), Some("length_um"));
    }

    #[test]
    fn a_row_of_a_pi_controller_that_moves_a_bead_stays_within_160_bytes_with_the_frame_of_its_batch()
     {
        // Bytes that a batch of half a second adds to each row: description and padding of its buffers.
        const FRAME: usize = 6;
        let groups = [Group::Loop, Group::Truth, Group::Script];
        assert!(row_bytes(&groups) + FRAME <= 160, "{}", row_bytes(&groups));
    }
}
