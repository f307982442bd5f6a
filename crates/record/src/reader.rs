//! Reads a run, even a truncated or damaged one.

use crate::error::RecordError;
use crate::events::{Events, read_events};
use crate::export::seconds;
use crate::meta::RunMeta;
use crate::stream::Stream;
use crate::{EVENTS_JSONL, FORMAT, RUN_TOML, TICKS_ARROW};
use cellpos_runtime::TickRecord;
use cellpos_table::{Record, read_text};
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

/// Largest accepted metadata, bytes.
const MOST_META: u64 = 1 << 26;

/// A gap: rows missing between two existing ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Gap {
    /// Number of the last row before.
    pub after_seq: u64,
    /// Number of the first row after.
    pub before_seq: u64,
}

impl Gap {
    /// Rows missing.
    pub fn rows(&self) -> u64 {
        self.before_seq
            .saturating_sub(self.after_seq)
            .saturating_sub(1)
    }
}

/// Missing parts of a run.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Lost {
    /// Breaks in the sequence numbers, the first 1000.
    pub gaps: Vec<Gap>,
    /// Rows missing in all breaks.
    pub rows: u64,
    /// Rows that differ from the written ones: their check is wrong.
    pub damaged_rows: u64,
    /// Rows whose number is not larger than the one before: never in an intact run.
    pub disordered_rows: u64,
    /// Invalid bytes that were skipped.
    pub damaged_bytes: u64,
    /// Bytes of a batch cut off at the end.
    pub torn_bytes: u64,
    /// Whether the file ends with the mark of a finished run.
    pub finished: bool,
    /// The disk refused to read on, in the system's words.
    pub read_error: Option<String>,
}

/// An opened run folder.
#[derive(Debug)]
pub struct RunReader {
    folder: PathBuf,
    meta: Result<RunMeta, String>,
}

impl RunReader {
    /// Opens a run folder. Damaged or missing metadata are not an error ([`RunReader::meta`] reports them): the rows are still readable.
    ///
    /// # Errors
    /// [`RecordError::NotARun`] without `ticks.arrow`, [`RecordError::Newer`] for a format that this version does not know.
    pub fn open(folder: &Path) -> Result<Self, RecordError> {
        if !folder.join(TICKS_ARROW).is_file() {
            return Err(RecordError::NotARun {
                path: folder.to_owned(),
            });
        }
        let path = folder.join(RUN_TOML);
        let meta: Result<RunMeta, String> = read_text(&path, MOST_META)
            .map_err(|error| error.to_string())
            .and_then(|text| {
                toml::from_str(&text).map_err(|error| format!("{}: {error}", path.display()))
            });
        if let Ok(meta) = &meta
            && meta.format > FORMAT
        {
            return Err(RecordError::Newer {
                path,
                found: meta.format,
            });
        }
        Ok(Self {
            folder: folder.to_owned(),
            meta,
        })
    }

    /// The run's folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// The metadata, or the reason for their absence.
    ///
    /// # Errors
    /// A sentence that names the file.
    pub fn meta(&self) -> Result<&RunMeta, &str> {
        self.meta.as_ref().map_err(String::as_str)
    }

    /// Names of the control law's own columns: [`TickRecord::law`] in this order. Empty if the metadata is damaged.
    pub fn law_columns(&self) -> &[String] {
        self.meta.as_ref().map_or(&[], |meta| &meta.law_columns)
    }

    /// The rows, batch by batch, so that memory does not grow with the length of a run.
    ///
    /// # Errors
    /// [`RecordError::Io`] when the file cannot be opened.
    pub fn batches(&self) -> Result<Batches, RecordError> {
        let path = self.folder.join(TICKS_ARROW);
        let stream = File::open(&path)
            .and_then(|file| Stream::new(BufReader::new(file), self.law_columns().len()))
            .map_err(RecordError::io("cannot read", path))?;
        Ok(Batches {
            stream,
            last_seq: None,
            lost: Lost::default(),
        })
    }

    /// The last row that meets a condition, found without reading the earlier rows.
    ///
    /// # Errors
    /// [`RecordError::Io`] when the file cannot be opened, or the disk refuses to read on.
    pub fn last_where(
        &self,
        is: impl Fn(&TickRecord) -> bool,
    ) -> Result<Option<TickRecord>, RecordError> {
        let path = self.folder.join(TICKS_ARROW);
        File::open(&path)
            .and_then(|file| {
                Stream::new(BufReader::new(file), self.law_columns().len())?.last_where(is)
            })
            .map_err(RecordError::io("cannot read", path))
    }

    /// All rows, and the missing parts.
    ///
    /// # Errors
    /// [`RecordError::Io`] when the file cannot be opened.
    pub fn ticks(&self) -> Result<(Vec<TickRecord>, Lost), RecordError> {
        let mut batches = self.batches()?;
        let mut ticks = Vec::new();
        for batch in batches.by_ref() {
            ticks.extend(batch);
        }
        Ok((ticks, batches.lost()))
    }

    /// The events, and how many lines are not readable.
    ///
    /// # Errors
    /// [`RecordError::Io`] when the log exists and cannot be read.
    pub fn events(&self) -> Result<Events, RecordError> {
        read_events(&self.folder.join(EVENTS_JSONL))
    }

    /// The run as a plain record: commanded PZT displacement, and the bead position that the camera had delivered at the time of the
    /// command. So it contains the camera's delay, as any record of two instruments does. Missing rows are filled with the held command
    /// and without a bead. Takes 24 bytes a row; an export has the other columns.
    ///
    /// # Errors
    /// [`RecordError`] if the rows cannot be read, [`cellpos_table::TableProblem::TooShort`] with fewer than two.
    pub fn to_record(&self) -> Result<Record, RecordError> {
        let mut batches = self.batches()?;
        let mut time_s = Vec::new();
        let (mut pzt_um, mut bead_um) = (Vec::new(), Vec::new());
        for tick in batches.by_ref().flatten() {
            time_s.push(seconds(tick.time_ns));
            pzt_um.push(tick.command_um);
            bead_um.push(crate::export::bead_um(&tick));
        }
        periods(&mut time_s);
        Ok(Record::from_rows(
            &self.folder,
            &time_s,
            [pzt_um, bead_um],
            vec![],
            ROUNDING,
        )?)
    }
}

/// Deviation of a step that comes from rounding alone, in steps.
const ROUNDING: f64 = 1e-3;

/// Puts the times of ticks on the even grid of their periods. A tick waits for its frame or for the timer, so the next tick may follow it
/// by only a quarter of a period. Each tick still has its own period. A period counts as one without a tick only if the later ticks
/// remain late by it.
fn periods(time_s: &mut [f64]) {
    /// Lateness that shows a period without a tick: halfway between a tick of the timer, at most 0.5 late, and one of the next period.
    const SKIPPED: f64 = 0.75;
    /// Share of the lateness that a tick keeps: the camera's clock and the computer's differ by some ppm.
    const KEPT: f64 = 0.99;
    let mut steps: Vec<f64> = time_s.windows(2).map(|pair| pair[1] - pair[0]).collect();
    if steps.iter().any(|step| step.is_nan() || *step <= 0.0) {
        return;
    }
    let mut sorted = steps.clone();
    sorted.sort_by(f64::total_cmp);
    let (Some(&usual_s), Some(&first_s)) = (sorted.get(sorted.len() / 2), time_s.first()) else {
        return;
    };
    let (mut place, mut late) = (0.0, 0.0);
    for step in &mut steps {
        late = KEPT * late + *step / usual_s - 1.0;
        let skipped = if late < SKIPPED { 0.0 } else { late.round() };
        late -= skipped;
        place += 1.0 + skipped;
        *step = place;
    }
    let last_s = time_s.last().copied().unwrap_or(first_s);
    let step_s = (last_s - first_s) / place;
    for (time_s, place) in time_s.iter_mut().skip(1).zip(&steps) {
        *time_s = first_s + place * step_s;
    }
}

/// Batches of rows in the order written. See [`RunReader::batches`].
pub struct Batches {
    stream: Stream<BufReader<File>>,
    last_seq: Option<u64>,
    lost: Lost,
}

impl Batches {
    /// Missing rows of the batches so far; complete after the iterator's end.
    pub fn lost(&self) -> Lost {
        Lost {
            damaged_rows: self.stream.damaged_rows,
            damaged_bytes: self.stream.damaged_bytes,
            torn_bytes: self.stream.torn_bytes,
            finished: self.stream.ended,
            ..self.lost.clone()
        }
    }
}

impl Iterator for Batches {
    type Item = Vec<TickRecord>;

    fn next(&mut self) -> Option<Vec<TickRecord>> {
        let batch = match self.stream.next_batch() {
            Ok(batch) => batch?,
            Err(error) => {
                self.lost.read_error = Some(error.to_string());
                return None;
            }
        };
        for row in &batch {
            if let Some(last) = self.last_seq {
                let gap = Gap {
                    after_seq: last,
                    before_seq: row.seq,
                };
                if row.seq <= last {
                    self.lost.disordered_rows += 1;
                } else if gap.rows() > 0 {
                    self.lost.rows = self.lost.rows.saturating_add(gap.rows());
                    if self.lost.gaps.len() < 1000 {
                        self.lost.gaps.push(gap);
                    }
                }
            }
            self.last_seq = Some(row.seq);
        }
        Some(batch)
    }
}

#[cfg(test)]
mod tests {
    use super::periods;

    fn places(steps: &[f64]) -> Vec<i64> {
        let mut at_s = 0.0;
        let mut time_s: Vec<f64> = std::iter::once(0.0)
            .chain(steps.iter().map(|step| {
                at_s += 1e-3 * step;
                at_s
            }))
            .collect();
        periods(&mut time_s);
        let step_s = time_s[1] - time_s[0];
        (time_s.iter())
            .map(|s| (s / step_s).round() as i64)
            .collect()
    }

    #[test]
    fn a_tick_a_quarter_of_a_period_behind_another_has_a_period_of_its_own() {
        // A frame that came too late for its tick, the ticks half a period behind for a while, and the way back.
        let mut steps = vec![1.0, 1.2, 0.25, 0.85];
        steps.extend([1.0; 50]);
        steps.push(1.7);
        steps.extend([1.0; 50]);
        let there = places(&steps);
        let wanted: Vec<i64> = (0..=steps.len() as i64).collect();
        assert_eq!(there, wanted);
    }

    #[test]
    fn a_period_without_a_tick_is_left_out() {
        let there = places(&[1.0, 1.0, 2.1, 0.9, 1.0, 3.0, 1.0]);
        assert_eq!(there, [0, 1, 2, 4, 5, 6, 9, 10]);
    }

    #[test]
    fn a_camera_of_another_clock_has_no_gaps() {
        let mut steps = vec![1.0; 20_000];
        // The usual step is 1, the mean a little more.
        steps.iter_mut().step_by(10).for_each(|step| *step = 1.001);
        assert_eq!(places(&steps).last(), Some(&20_000));
    }
}
