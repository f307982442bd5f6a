//! Reads the per-cycle table back, also one that an older version wrote.

use super::CycleRow;
use super::row::{FLOATS, WHOLES};
use crate::plan::ArmKind;

/// Columns that older versions did not write; unknown for their cycles.
const LATER: [&str; 10] = [
    "area_start_um2",
    "area_quarter_um2",
    "area_half_um2",
    "area_three_quarters_um2",
    "area_peak_um2",
    "area_end_um2",
    "length_rest_um",
    "length_rest_sd_um",
    "area_rest_um2",
    "area_rest_sd_um2",
];

/// Why a header is not that of a per-cycle table.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum HeadError {
    /// A column that this version does not know.
    #[error("column `{0}` is not known")]
    Unknown(String),
    /// A column that is there more than once.
    #[error("column `{0}` is there twice")]
    Twice(String),
    /// A column that every version writes.
    #[error("column `{0}` is missing")]
    Missing(&'static str),
}

/// The columns of a per-cycle table, in the order that its head names them.
#[derive(Debug, Clone)]
pub struct CycleColumns(Vec<Column>);

#[derive(Debug, Clone, Copy)]
enum Column {
    Arm,
    Flags,
    Whole(fn(&mut CycleRow, u64)),
    Float(fn(&mut CycleRow, f64)),
}

impl CycleColumns {
    /// The columns that a head names. Columns that older versions did not have may be missing.
    ///
    /// # Errors
    /// [`HeadError`] names the column.
    pub fn of(head: &str) -> Result<Self, HeadError> {
        let named: Vec<&str> = head.split(',').collect();
        for (index, name) in named.iter().enumerate() {
            if named.iter().skip(index + 1).any(|other| other == name) {
                return Err(HeadError::Twice((*name).to_owned()));
            }
        }
        let whole = WHOLES.iter().map(|(name, ..)| *name);
        let float = FLOATS.iter().map(|(name, ..)| *name);
        let needed = whole
            .chain(float)
            .chain(["arm", "flags"])
            .filter(|name| !LATER.contains(name));
        for name in needed {
            if !named.contains(&name) {
                return Err(HeadError::Missing(name));
            }
        }
        let columns = named.iter().map(|name| {
            let whole = WHOLES.iter().find(|(other, ..)| other == name);
            let float = FLOATS.iter().find(|(other, ..)| other == name);
            match (*name, whole, float) {
                ("arm", ..) => Ok(Column::Arm),
                ("flags", ..) => Ok(Column::Flags),
                (_, Some((_, _, set)), _) => Ok(Column::Whole(*set)),
                (_, _, Some((_, _, set))) => Ok(Column::Float(*set)),
                _ => Err(HeadError::Unknown((*name).to_owned())),
            }
        });
        columns.collect::<Result<_, _>>().map(Self)
    }

    /// A line of the table; None for other text.
    pub fn parse(&self, line: &str) -> Option<CycleRow> {
        let mut cells = line.split(',');
        let mut row = CycleRow::empty(0, 0, ArmKind::Cyclic);
        for column in &self.0 {
            let cell = cells.next()?;
            match column {
                Column::Arm => {
                    row.arm = match cell {
                        "cyclic" => ArmKind::Cyclic,
                        "static" => ArmKind::Static,
                        _ => return None,
                    }
                }
                Column::Flags => row.flags = cell.parse().ok()?,
                Column::Whole(set) => set(&mut row, cell.parse().ok()?),
                Column::Float(_) if cell.is_empty() => {}
                Column::Float(set) => set(&mut row, cell.parse().ok()?),
            }
        }
        cells.next().is_none().then_some(row)
    }
}

/// A per-cycle table as it was read.
#[derive(Debug, Clone, PartialEq)]
pub struct ReadCycles {
    /// Its rows.
    pub rows: Vec<CycleRow>,
    /// Lines after the header that are not rows; after a wrong header, every line.
    pub unreadable: usize,
    /// The error of the head.
    pub head: Option<HeadError>,
    /// Whether an older version wrote it, without some of the columns of this one.
    pub older: bool,
}

/// Reads a per-cycle table. A last line without a line end was cut off and is not a row.
pub fn read_cycles(text: &str) -> ReadCycles {
    // It may parse as a row and still differ from the intended one.
    let whole = text.rfind('\n').map_or(0, |end| end + 1);
    let mut read = ReadCycles {
        rows: Vec::new(),
        unreadable: usize::from(whole < text.len()),
        head: None,
        older: false,
    };
    let mut lines = text.get(..whole).unwrap_or("").lines();
    let Some(head) = lines.next() else {
        return read;
    };
    read.older = head != CycleRow::csv_head();
    let columns = match CycleColumns::of(head) {
        Ok(columns) => columns,
        Err(error) => {
            read.head = Some(error);
            read.unreadable += lines.count();
            return read;
        }
    };
    for line in lines {
        match columns.parse(line) {
            Some(row) => read.rows.push(row),
            None => read.unreadable += 1,
        }
    }
    read
}

#[cfg(test)]
mod tests {
    use super::super::CycleFlags;
    use super::*;

    fn row() -> CycleRow {
        let mut row = CycleRow::empty(41, 3, ArmKind::Static);
        row.ticks = 100;
        row.seen = 97;
        row.reached_um = 1.25;
        row.lag_deg = -0.5;
        row.area_half_um2 = 52.5;
        row.flags
            .set(CycleFlags::LOST | CycleFlags::RECORDS_LOST, true);
        row
    }

    #[test]
    fn a_row_reads_back_as_it_was_written_and_a_torn_one_not_at_all() {
        let (head, line) = (CycleRow::csv_head(), row().to_csv());
        assert_eq!(line.split(',').count(), head.split(',').count());
        let columns = CycleColumns::of(&head).unwrap();
        let back = columns.parse(&line).unwrap();
        assert_eq!(back.to_csv(), line);
        assert_eq!((back.cycle, back.session, back.flags), (41, 3, row().flags));
        assert!(back.arm == ArmKind::Static && back.area_half_um2 == 52.5);
        assert!(back.reached_um == 1.25 && back.gain_per_s.is_nan());
        let read = read_cycles(&format!("{head}\n{line}\n{line}"));
        assert_eq!((read.rows.len(), read.unreadable), (1, 1));
        assert!(read.head.is_none() && !read.older);
        for end in 0..line.len() {
            if let Some(part) = columns.parse(&line[..end]) {
                assert!(line[..end].ends_with(['t', ',']), "{part:?}");
            }
        }
        assert_eq!(read_cycles("").rows, []);
        assert_eq!(read_cycles(&head).unreadable, 1);
    }

    /// The table without some columns.
    fn without(text: &str, names: &[&str]) -> String {
        let head = text.lines().next().unwrap();
        let kept: Vec<bool> = head.split(',').map(|name| !names.contains(&name)).collect();
        let line = |line: &str| {
            let cells = line.split(',').zip(&kept).filter(|(_, keep)| **keep);
            let cells: Vec<&str> = cells.map(|(cell, _)| cell).collect();
            cells.join(",") + "\n"
        };
        text.lines().map(line).collect()
    }

    #[test]
    fn a_table_from_before_areas_reads_and_their_areas_are_not_known() {
        let text = format!("{}\n{}\n", CycleRow::csv_head(), row().to_csv());
        let read = read_cycles(&without(&text, &LATER));
        assert_eq!((read.rows.len(), read.unreadable, read.head), (1, 0, None));
        assert!(read.older);
        let back = &read.rows[0];
        assert!(back.area_half_um2.is_nan());
        let expected = CycleRow {
            area_half_um2: f64::NAN,
            ..row()
        };
        assert_eq!(back.to_csv(), expected.to_csv());
    }

    #[test]
    fn a_table_that_is_none_names_the_column() {
        let head = CycleRow::csv_head();
        let line = row().to_csv();
        let text = format!("{head},odour\n{line},3\n{line},4\n");
        let read = read_cycles(&text);
        assert_eq!((read.rows.len(), read.unreadable), (0, 2));
        assert_eq!(read.head, Some(HeadError::Unknown("odour".into())));
        for name in ["cycle", "arm", "rms_um", "flags"] {
            let text = without(&format!("{head}\n{line}\n"), &[name]);
            assert_eq!(read_cycles(&text).head, Some(HeadError::Missing(name)));
        }
        let twice = CycleColumns::of(&format!("{head},rms_um")).unwrap_err();
        assert_eq!(twice.to_string(), "column `rms_um` is there twice");
    }
}
