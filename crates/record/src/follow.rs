//! Reads a run during its recording or afterwards: the rows since the last call.

use crate::error::RecordError;
use crate::events::Event;
use crate::meta::RunEnd;
use crate::reader::RunReader;
use crate::stream::Stream;
use crate::{EVENTS_JSONL, TICKS_ARROW};
use cellpos_runtime::TickRecord;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

/// Most bytes of events per call.
const MOST_EVENTS: u64 = 1 << 20;

/// Follows a writer in another process, without locks and without the writer's knowledge.
pub struct Follow {
    reader: RunReader,
    stream: Stream<BufReader<File>>,
    events_at: u64,
}

impl Follow {
    /// Begins with the first row.
    ///
    /// # Errors
    /// [`RecordError`] if the folder is not a run, or if a newer version wrote it.
    pub fn open(folder: &Path) -> Result<Self, RecordError> {
        let reader = RunReader::open(folder)?;
        let path = folder.join(TICKS_ARROW);
        let stream = File::open(&path)
            .and_then(|file| Stream::new(BufReader::new(file), reader.law_columns().len()))
            .map_err(RecordError::io("cannot read", path))?;
        Ok(Self {
            reader,
            stream,
            events_at: 0,
        })
    }

    /// The run's folder and metadata as they were when it was opened.
    pub fn reader(&self) -> &RunReader {
        &self.reader
    }

    /// Passes on the new rows, batch by batch.
    ///
    /// # Errors
    /// The file system refuses to read.
    pub fn rows(&mut self, mut take: impl FnMut(&[TickRecord])) -> Result<(), RecordError> {
        let path = self.reader.folder().join(TICKS_ARROW);
        let stream = &mut self.stream;
        let mut read = || {
            stream.follow()?;
            while let Some(batch) = stream.next_batch()? {
                take(&batch);
            }
            Ok(())
        };
        read().map_err(RecordError::io("cannot read", path))
    }

    /// The new events. An unfinished line is left for the next call; a damaged one is skipped.
    ///
    /// # Errors
    /// The log exists and cannot be read.
    pub fn events(&mut self) -> Result<Vec<Event>, RecordError> {
        let path = self.reader.folder().join(EVENTS_JSONL);
        let mut bytes = Vec::new();
        let read = File::open(&path).and_then(|mut file| {
            file.seek(SeekFrom::Start(self.events_at))?;
            file.take(MOST_EVENTS).read_to_end(&mut bytes)
        });
        match read {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
            other => other.map_err(RecordError::io("cannot read", path))?,
        };
        let whole = bytes
            .iter()
            .rposition(|byte| *byte == b'\n')
            .map_or(0, |end| end + 1);
        self.events_at += whole as u64;
        Ok(bytes
            .get(..whole)
            .unwrap_or(&[])
            .split(|byte| *byte == b'\n')
            .filter_map(|line| serde_json::from_slice(line).ok())
            .collect())
    }

    /// How the run ended, once it has.
    pub fn end(&self) -> Option<RunEnd> {
        let again = RunReader::open(self.reader.folder()).ok()?;
        again.meta().ok()?.end.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{RunMeta, RunWriter};

    fn row(seq: u64) -> TickRecord {
        TickRecord {
            seq,
            time_ns: seq as i64 * 1_000_000,
            ..TickRecord::unknown()
        }
    }

    #[test]
    fn rows_and_events_are_seen_once_as_they_come_and_the_end_too() {
        let root = tempfile::tempdir().unwrap();
        let mut writer = RunWriter::create(root.path(), RunMeta::new("a", "real")).unwrap();
        let mut follow = Follow::open(writer.folder()).unwrap();
        let mut seen = Vec::new();
        for part in 0..5_u64 {
            for seq in part * 300..(part + 1) * 300 {
                writer.tick(&row(seq));
            }
            writer.event(&Event::new(part as f64, "mark").with("text", "x"));
            writer.flush();
            follow
                .rows(|rows| seen.extend(rows.iter().map(|r| r.seq)))
                .unwrap();
            assert_eq!(seen, (0..(part + 1) * 300).collect::<Vec<_>>());
            assert_eq!(follow.events().unwrap().len(), 1);
        }
        assert_eq!(follow.end(), None);
        writer.finish(RunEnd::new("done"));
        follow.rows(|rows| assert!(rows.is_empty())).unwrap();
        assert_eq!(follow.end().unwrap().outcome, "done");
    }

    #[test]
    fn a_batch_that_is_half_written_is_waited_for() {
        let root = tempfile::tempdir().unwrap();
        let mut writer = RunWriter::create(root.path(), RunMeta::new("a", "real")).unwrap();
        (0..100).for_each(|seq| writer.tick(&row(seq)));
        writer.flush();
        let path = writer.folder().join(TICKS_ARROW);
        let whole = std::fs::read(&path).unwrap();
        let copy = root.path().join("copy");
        std::fs::create_dir(&copy).unwrap();
        std::fs::copy(
            writer.folder().join(crate::RUN_TOML),
            copy.join(crate::RUN_TOML),
        )
        .unwrap();
        let mut follow = None;
        let mut seen = 0;
        for length in (0..=whole.len()).step_by(101).chain([whole.len()]) {
            std::fs::write(copy.join(TICKS_ARROW), &whole[..length]).unwrap();
            let follow = follow.get_or_insert_with(|| Follow::open(&copy).unwrap());
            follow.rows(|rows| seen += rows.len()).unwrap();
        }
        assert_eq!(seen, 100);
    }
}
