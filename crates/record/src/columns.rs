//! Ticks as columns, and back.

use arrow_array::{
    ArrayRef, Float64Array, Int64Array, RecordBatch, UInt8Array, UInt32Array, UInt64Array,
};
use arrow_schema::{ArrowError, DataType, Field, Schema, SchemaRef};
use cellpos_runtime::{CONTROLLER_STATE_LEN, TickFlags, TickRecord};
use std::sync::Arc;

/// Type of a column.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    U64,
    I64,
    F64,
    U32,
    U8,
}

impl Kind {
    /// Bytes of one value.
    pub(crate) const fn width(self) -> usize {
        match self {
            Self::U64 | Self::I64 | Self::F64 => 8,
            Self::U32 => 4,
            Self::U8 => 1,
        }
    }

    fn data_type(self) -> DataType {
        match self {
            Self::U64 => DataType::UInt64,
            Self::I64 => DataType::Int64,
            Self::F64 => DataType::Float64,
            Self::U32 => DataType::UInt32,
            Self::U8 => DataType::UInt8,
        }
    }
}

/// The columns before the controller's state, in the order of [`visit`].
const FIXED: [(&str, Kind); 32] = [
    ("seq", Kind::U64),
    ("time_ns", Kind::I64),
    ("frame_id", Kind::U64),
    ("mid_exposure_ns", Kind::I64),
    ("measured_um", Kind::F64),
    ("variance_um2", Kind::F64),
    ("verdict", Kind::U8),
    ("target_um", Kind::F64),
    ("estimate_um", Kind::F64),
    ("neutral_um", Kind::F64),
    ("requested_um", Kind::F64),
    ("command_um", Kind::F64),
    ("applied_um", Kind::F64),
    ("true_um", Kind::F64),
    ("life", Kind::U8),
    ("flags", Kind::U32),
    ("drained", Kind::U8),
    ("wake_ns", Kind::U32),
    ("compute_ns", Kind::U32),
    ("request", Kind::U8),
    ("board", Kind::U8),
    ("board_fault", Kind::U8),
    ("solver_status", Kind::U8),
    ("solver_iterations", Kind::U8),
    ("solver_active", Kind::U8),
    ("solver_ns", Kind::U32),
    ("track", Kind::U8),
    ("decision", Kind::U8),
    ("plan_ns", Kind::I64),
    ("stage", Kind::U8),
    ("length_um", Kind::F64),
    ("area_um2", Kind::F64),
];

/// Name and type of every column.
pub(crate) fn columns() -> Vec<(String, Kind)> {
    FIXED
        .iter()
        .map(|(name, kind)| ((*name).to_owned(), *kind))
        .chain((0..CONTROLLER_STATE_LEN).map(|index| (format!("state_{index:02}"), Kind::F64)))
        .collect()
}

/// The schema of `ticks.arrow` and `ticks.parquet`.
pub(crate) fn schema() -> SchemaRef {
    let fields: Vec<Field> = columns()
        .into_iter()
        .map(|(name, kind)| Field::new(name, kind.data_type(), false))
        .collect();
    Arc::new(Schema::new(fields))
}

/// A value of any column, as its bits.
pub(crate) trait Take {
    fn u64(&mut self, value: u64);
    fn i64(&mut self, value: i64);
    fn f64(&mut self, value: f64);
    fn u32(&mut self, value: u32);
    fn u8(&mut self, value: u8);
}

/// Hands the values of a row over in the order of [`columns`].
fn visit(row: &TickRecord, to: &mut impl Take) {
    to.u64(row.seq);
    to.i64(row.time_ns);
    to.u64(row.frame_id);
    to.i64(row.mid_exposure_ns);
    to.f64(row.measured_um);
    to.f64(row.variance_um2);
    to.u8(row.verdict);
    to.f64(row.target_um);
    to.f64(row.estimate_um);
    to.f64(row.neutral_um);
    to.f64(row.requested_um);
    to.f64(row.command_um);
    to.f64(row.applied_um);
    to.f64(row.true_um);
    to.u8(row.life);
    to.u32(row.flags.0);
    to.u8(row.drained);
    to.u32(row.wake_ns);
    to.u32(row.compute_ns);
    to.u8(row.request);
    to.u8(row.board);
    to.u8(row.board_fault);
    to.u8(row.solver_status);
    to.u8(row.solver_iterations);
    to.u8(row.solver_active);
    to.u32(row.solver_ns);
    to.u8(row.track);
    to.u8(row.decision);
    to.i64(row.plan_ns);
    to.u8(row.stage);
    to.f64(row.length_um);
    to.f64(row.area_um2);
    for value in row.controller_state {
        to.f64(value);
    }
}

/// A row in which nothing is known: what a missing column reads as.
pub(crate) fn unknown() -> TickRecord {
    TickRecord {
        seq: 0,
        time_ns: 0,
        frame_id: 0,
        mid_exposure_ns: 0,
        measured_um: f64::NAN,
        variance_um2: f64::NAN,
        verdict: 255,
        track: 255,
        decision: 255,
        target_um: f64::NAN,
        estimate_um: f64::NAN,
        neutral_um: f64::NAN,
        requested_um: f64::NAN,
        command_um: f64::NAN,
        applied_um: f64::NAN,
        true_um: f64::NAN,
        life: 0,
        request: 0,
        board: 255,
        board_fault: 0,
        flags: TickFlags(0),
        drained: 0,
        wake_ns: 0,
        compute_ns: 0,
        solver_status: 0,
        solver_iterations: 0,
        solver_active: 0,
        solver_ns: 0,
        plan_ns: -1,
        stage: 0,
        length_um: f64::NAN,
        area_um2: f64::NAN,
        controller_state: [f64::NAN; CONTROLLER_STATE_LEN],
    }
}

/// Sets the value of a column from its little-endian bits (zero-extended to 64).
pub(crate) fn set(row: &mut TickRecord, column: usize, bits: u64) {
    let float = f64::from_bits(bits);
    match column {
        0 => row.seq = bits,
        1 => row.time_ns = bits.cast_signed(),
        2 => row.frame_id = bits,
        3 => row.mid_exposure_ns = bits.cast_signed(),
        4 => row.measured_um = float,
        5 => row.variance_um2 = float,
        6 => row.verdict = bits as u8,
        7 => row.target_um = float,
        8 => row.estimate_um = float,
        9 => row.neutral_um = float,
        10 => row.requested_um = float,
        11 => row.command_um = float,
        12 => row.applied_um = float,
        13 => row.true_um = float,
        14 => row.life = bits as u8,
        15 => row.flags = TickFlags(bits as u32),
        16 => row.drained = bits as u8,
        17 => row.wake_ns = bits as u32,
        18 => row.compute_ns = bits as u32,
        19 => row.request = bits as u8,
        20 => row.board = bits as u8,
        21 => row.board_fault = bits as u8,
        22 => row.solver_status = bits as u8,
        23 => row.solver_iterations = bits as u8,
        24 => row.solver_active = bits as u8,
        25 => row.solver_ns = bits as u32,
        26 => row.track = bits as u8,
        27 => row.decision = bits as u8,
        28 => row.plan_ns = bits.cast_signed(),
        29 => row.stage = bits as u8,
        30 => row.length_um = float,
        31 => row.area_um2 = float,
        _ => {
            if let Some(state) = column
                .checked_sub(FIXED.len())
                .and_then(|index| row.controller_state.get_mut(index))
            {
                *state = float;
            }
        }
    }
}

/// One column being filled.
enum Column {
    U64(Vec<u64>),
    I64(Vec<i64>),
    F64(Vec<f64>),
    U32(Vec<u32>),
    U8(Vec<u8>),
}

/// Rows gathered column by column until they make a batch.
pub(crate) struct Builder {
    columns: Vec<Column>,
    schema: SchemaRef,
    rows: usize,
    capacity: usize,
}

struct Filler<'a>(std::slice::IterMut<'a, Column>);

macro_rules! take {
    ($name:ident, $variant:ident, $type:ty) => {
        fn $name(&mut self, value: $type) {
            if let Some(Column::$variant(values)) = self.0.next() {
                values.push(value);
            }
        }
    };
}

impl Take for Filler<'_> {
    take!(u64, U64, u64);
    take!(i64, I64, i64);
    take!(f64, F64, f64);
    take!(u32, U32, u32);
    take!(u8, U8, u8);
}

impl Builder {
    pub(crate) fn new(capacity: usize) -> Self {
        Self {
            columns: empty(capacity),
            schema: schema(),
            rows: 0,
            capacity,
        }
    }

    pub(crate) fn schema(&self) -> &SchemaRef {
        &self.schema
    }

    pub(crate) fn push(&mut self, row: &TickRecord) {
        visit(row, &mut Filler(self.columns.iter_mut()));
        self.rows += 1;
    }

    pub(crate) fn rows(&self) -> usize {
        self.rows
    }

    /// Takes the rows out as a batch.
    pub(crate) fn take(&mut self) -> Result<RecordBatch, ArrowError> {
        self.rows = 0;
        let columns = std::mem::replace(&mut self.columns, empty(self.capacity));
        let arrays = columns
            .into_iter()
            .map(|column| match column {
                Column::U64(values) => Arc::new(UInt64Array::from(values)) as ArrayRef,
                Column::I64(values) => Arc::new(Int64Array::from(values)),
                Column::F64(values) => Arc::new(Float64Array::from(values)),
                Column::U32(values) => Arc::new(UInt32Array::from(values)),
                Column::U8(values) => Arc::new(UInt8Array::from(values)),
            })
            .collect();
        RecordBatch::try_new(Arc::clone(&self.schema), arrays)
    }
}

fn empty(capacity: usize) -> Vec<Column> {
    columns()
        .into_iter()
        .map(|(_, kind)| match kind {
            Kind::U64 => Column::U64(Vec::with_capacity(capacity)),
            Kind::I64 => Column::I64(Vec::with_capacity(capacity)),
            Kind::F64 => Column::F64(Vec::with_capacity(capacity)),
            Kind::U32 => Column::U32(Vec::with_capacity(capacity)),
            Kind::U8 => Column::U8(Vec::with_capacity(capacity)),
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const COUNT: usize = FIXED.len() + CONTROLLER_STATE_LEN;

    struct Bits(Vec<u64>);

    impl Take for Bits {
        fn u64(&mut self, value: u64) {
            self.0.push(value);
        }
        fn i64(&mut self, value: i64) {
            self.0.push(value.cast_unsigned());
        }
        fn f64(&mut self, value: f64) {
            self.0.push(value.to_bits());
        }
        fn u32(&mut self, value: u32) {
            self.0.push(value.into());
        }
        fn u8(&mut self, value: u8) {
            self.0.push(value.into());
        }
    }

    #[test]
    fn every_column_comes_back_at_its_own_place() {
        let mut row = unknown();
        for column in 0..COUNT {
            set(&mut row, column, 100 + column as u64);
        }
        let mut bits = Bits(Vec::new());
        visit(&row, &mut bits);
        let expected: Vec<u64> = (0..COUNT).map(|column| 100 + column as u64).collect();
        assert_eq!(bits.0, expected);
        assert_eq!(columns().len(), COUNT);
    }

    #[test]
    fn names_of_quantities_carry_their_unit() {
        for (name, kind) in columns() {
            let number = kind == Kind::F64 && !name.starts_with("state_");
            assert!(
                !number || name.ends_with("_um") || name.ends_with("_um2"),
                "{name}"
            );
        }
    }
}
