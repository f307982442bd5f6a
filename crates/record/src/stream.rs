//! A tolerant reader of `ticks.arrow`.
//!
//! The format is Arrow's IPC stream; any Arrow library reads a complete file. This reader parses the messages itself: from a
//! truncated or damaged file it must give every row around the damage, without a panic and without excessive memory. So it checks
//! every length against the file first.

use crate::columns::{CHECK, COLUMNS, Column, Kind};
use arrow_ipc::{MessageHeader, Type, root_as_message};
use cellpos_runtime::{ReferenceHistory, TickRecord};
use std::io::{self, Read, Seek, SeekFrom};

/// Marks the start of a message.
const CONTINUATION: [u8; 4] = [0xff; 4];
/// Longest accepted description of a message.
const MAX_META: u64 = 1 << 20;
/// Longest accepted body of a message.
const MAX_BODY: u64 = 1 << 30;
/// Bytes per step of the search for the next message after damage.
const SEARCH: usize = 1 << 16;

/// Header of a message's rows.
struct Head {
    kind: MessageHeader,
    /// The description; empty for the end mark.
    meta: Vec<u8>,
    /// Where the body begins.
    body: u64,
    end: u64,
}

/// The rows of a batch, and the number of damaged rows.
struct Rows {
    rows: Vec<TickRecord>,
    damaged: u64,
}

/// A column of the file.
#[derive(Clone, Copy)]
struct Place {
    kind: Kind,
    meaning: Meaning,
}

/// Contents of a column of the file.
#[derive(Clone, Copy)]
enum Meaning {
    /// A value of the row.
    Value(&'static Column),
    /// The control law's own value of this number.
    Law(usize),
    /// The check of the row.
    Check,
    /// Something that this version does not know.
    Unknown,
}

/// Kind of a message.
enum Message {
    /// The schema, or something without rows.
    NoRows,
    /// Rows.
    Rows(Rows),
    /// The end mark of a finished stream.
    End,
}

/// Messages of a stream, one after the other, across any damage.
pub(crate) struct Stream<R> {
    from: R,
    length: u64,
    position: u64,
    layout: Vec<Place>,
    /// For files from before the error was recorded.
    references: ReferenceHistory,
    /// Rows whose check is wrong: never written, or damaged.
    pub(crate) damaged_rows: u64,
    /// Invalid bytes that were skipped before a valid message.
    pub(crate) damaged_bytes: u64,
    /// Bytes after the last valid message: a batch cut off.
    pub(crate) torn_bytes: u64,
    /// Whether the end mark was seen last.
    pub(crate) ended: bool,
    /// Whether incomplete bytes at the end may still become a message.
    follows: bool,
}

impl<R: Read + Seek> Stream<R> {
    /// A stream from its beginning. `law` is the number of the control law's columns, in case the schema is damaged.
    pub(crate) fn new(mut from: R, law: usize) -> io::Result<Self> {
        let length = from.seek(SeekFrom::End(0))?;
        Ok(Self {
            from,
            length,
            position: 0,
            // The layout of this version, in case the schema itself is damaged.
            layout: COLUMNS
                .iter()
                .map(|column| Place {
                    kind: column.kind,
                    meaning: Meaning::Value(column),
                })
                .chain((0..law).map(|index| Place {
                    kind: Kind::F32,
                    meaning: Meaning::Law(index),
                }))
                .chain([Place {
                    kind: Kind::U32,
                    meaning: Meaning::Check,
                }])
                .collect(),
            references: ReferenceHistory::default(),
            damaged_rows: 0,
            damaged_bytes: 0,
            torn_bytes: 0,
            ended: false,
            follows: false,
        })
    }

    /// Reads the file at its present length; an incomplete message at the end is left for the next time.
    pub(crate) fn follow(&mut self) -> io::Result<()> {
        self.length = self.from.seek(SeekFrom::End(0))?;
        self.follows = true;
        Ok(())
    }

    /// The rows of the next batch; None at the end.
    ///
    /// # Errors
    /// Only when the file system refuses to read.
    pub(crate) fn next_batch(&mut self) -> io::Result<Option<Vec<TickRecord>>> {
        while self.position < self.length {
            match self.message(self.position)? {
                Some((message, end)) => {
                    self.position = end;
                    self.ended = matches!(message, Message::End);
                    if let Message::Rows(mut batch) = message {
                        self.fill_errors(&mut batch.rows);
                        self.damaged_rows += batch.damaged;
                        return Ok(Some(batch.rows));
                    }
                }
                None => match self.search(self.position + 8)? {
                    Some(found) => {
                        self.damaged_bytes += found - self.position;
                        self.position = found;
                    }
                    None if self.follows => break,
                    None => {
                        self.torn_bytes = self.length - self.position;
                        self.position = self.length;
                    }
                },
            }
        }
        Ok(None)
    }

    /// Computes the error of rows that were written without it.
    fn fill_errors(&mut self, rows: &mut [TickRecord]) {
        let recorded =
            |place: &Place| matches!(place.meaning, Meaning::Value(c) if c.name == "error_um");
        if self.layout.iter().any(recorded) {
            return;
        }
        for row in rows {
            self.references.add(row.time_ns, row.target_um);
            row.error_um = row.error_at_exposure_um(&self.references);
        }
    }

    /// Reads exactly `out.len()` bytes at a place known to be inside the file.
    fn read_at(&mut self, position: u64, out: &mut [u8]) -> io::Result<()> {
        self.from.seek(SeekFrom::Start(position))?;
        self.from.read_exact(out)
    }

    /// The header of the message at a position; None without one, or for a kind that recordings lack.
    fn head(&mut self, position: u64) -> io::Result<Option<Head>> {
        let left = self.length.saturating_sub(position);
        if left < 8 {
            return Ok(None);
        }
        let mut mark = [0u8; 8];
        self.read_at(position, &mut mark)?;
        let [a, b, c, d, e, f, g, h] = mark;
        if [a, b, c, d] != CONTINUATION {
            return Ok(None);
        }
        let meta_length = u64::from(u32::from_le_bytes([e, f, g, h]));
        let body = position + 8 + meta_length;
        if meta_length == 0 {
            return Ok(Some(Head {
                kind: MessageHeader::NONE,
                meta: Vec::new(),
                body,
                end: body,
            }));
        }
        if meta_length > MAX_META || meta_length > left - 8 {
            return Ok(None);
        }
        let mut meta = vec![0u8; meta_length as usize];
        self.read_at(position + 8, &mut meta)?;
        let Ok(message) = root_as_message(&meta) else {
            return Ok(None);
        };
        let kind = message.header_type();
        if ![MessageHeader::Schema, MessageHeader::RecordBatch].contains(&kind) {
            return Ok(None);
        }
        let Ok(body_length) = u64::try_from(message.bodyLength()) else {
            return Ok(None);
        };
        if body_length > MAX_BODY || body_length > left - 8 - meta_length {
            return Ok(None);
        }
        Ok(Some(Head {
            kind,
            meta,
            body,
            end: body + body_length,
        }))
    }

    /// The message at a position and its end; None without one.
    fn message(&mut self, position: u64) -> io::Result<Option<(Message, u64)>> {
        let Some(head) = self.head(position)? else {
            return Ok(None);
        };
        if head.meta.is_empty() {
            return Ok(Some((Message::End, head.end)));
        }
        let Ok(message) = root_as_message(&head.meta) else {
            return Ok(None);
        };
        if head.kind == MessageHeader::Schema {
            if let Some(layout) = layout(&message) {
                self.layout = layout;
                return Ok(Some((Message::NoRows, head.end)));
            }
            return Ok(None);
        }
        let mut body = vec![0u8; (head.end - head.body) as usize];
        self.read_at(head.body, &mut body)?;
        Ok(decode(&message, &body, &self.layout).map(|rows| (Message::Rows(rows), head.end)))
    }

    /// The last row that meets a condition. It skips earlier batches by their lengths without reading them, so it finds the end
    /// of a long recording at once.
    ///
    /// # Errors
    /// Only when the file system refuses to read.
    pub(crate) fn last_where(
        &mut self,
        is: impl Fn(&TickRecord) -> bool,
    ) -> io::Result<Option<TickRecord>> {
        let mut batches = Vec::new();
        let mut position = 0;
        while position < self.length {
            let head = self.head(position)?;
            if head
                .as_ref()
                .is_some_and(|h| h.kind == MessageHeader::Schema)
            {
                self.message(position)?;
            }
            position = match head {
                Some(head) => {
                    if head.kind == MessageHeader::RecordBatch {
                        batches.push(position);
                    }
                    head.end
                }
                None => match self.search(position + 8)? {
                    Some(found) => found,
                    None => break,
                },
            };
        }
        for position in batches.into_iter().rev() {
            if let Some((Message::Rows(batch), _)) = self.message(position)?
                && let Some(row) = batch.rows.iter().rfind(|row| is(row))
            {
                return Ok(Some(*row));
            }
        }
        Ok(None)
    }

    /// Position of the first message at or after `from`. Messages start at multiples of eight.
    fn search(&mut self, from: u64) -> io::Result<Option<u64>> {
        let mut base = from - from % 8;
        let mut block = vec![0u8; SEARCH];
        while base + 8 <= self.length {
            let size = (self.length - base).min(SEARCH as u64) as usize;
            let Some(part) = block.get_mut(..size) else {
                return Ok(None);
            };
            self.from.seek(SeekFrom::Start(base))?;
            self.from.read_exact(part)?;
            let candidates: Vec<u64> = part
                .chunks_exact(8)
                .enumerate()
                .filter(|(_, word)| word.starts_with(&CONTINUATION))
                .map(|(index, _)| base + index as u64 * 8)
                .collect();
            for candidate in candidates {
                // Two NaN in a row look like an end mark, so only messages with content count here.
                if let Some((Message::Rows(_) | Message::NoRows, _)) = self.message(candidate)? {
                    return Ok(Some(candidate));
                }
            }
            base += SEARCH as u64;
        }
        Ok(None)
    }
}

/// Places and types of the columns that a schema message names; None if one has a type that this reader does not know.
fn layout(message: &arrow_ipc::Message) -> Option<Vec<Place>> {
    let fields = message.header_as_schema()?.fields()?;
    let mut law = 0;
    fields
        .iter()
        .map(|field| {
            let kind = match field.type_type() {
                Type::Int => {
                    let int = field.type_as_int()?;
                    match (int.bitWidth(), int.is_signed()) {
                        (64, false) => Kind::U64,
                        (64, true) => Kind::I64,
                        (32, false) => Kind::U32,
                        (8, false) => Kind::U8,
                        _ => return None,
                    }
                }
                Type::FloatingPoint => match field.type_as_floating_point()?.precision() {
                    arrow_ipc::Precision::DOUBLE => Kind::F64,
                    arrow_ipc::Precision::SINGLE => Kind::F32,
                    _ => return None,
                },
                _ => return None,
            };
            let name = field.name().unwrap_or("");
            let known = COLUMNS.iter().find(|c| c.name == name && c.kind == kind);
            let meaning = match known {
                Some(column) => Meaning::Value(column),
                None if name == CHECK && kind == Kind::U32 => Meaning::Check,
                // Whatever its name: the law named it.
                None if kind == Kind::F32 => {
                    law += 1;
                    Meaning::Law(law - 1)
                }
                None => Meaning::Unknown,
            };
            Some(Place { kind, meaning })
        })
        .collect()
}

/// Rows of a batch; None unless every column is whole. Rows whose check is wrong are left out and counted.
fn decode(message: &arrow_ipc::Message, body: &[u8], layout: &[Place]) -> Option<Rows> {
    let batch = message.header_as_record_batch()?;
    if batch.compression().is_some() {
        return None;
    }
    let rows = usize::try_from(batch.length()).ok()?;
    // A row has at least one byte in the body, so no length can require more memory than the file has bytes.
    if rows > body.len() {
        return None;
    }
    let nodes = batch.nodes()?;
    let buffers = batch.buffers()?;
    if nodes.len() != layout.len() || buffers.len() != 2 * layout.len() {
        return None;
    }
    let mut out = vec![TickRecord::unknown(); rows];
    let mut checks = None;
    let mut sums = vec![crc32fast::Hasher::new(); rows];
    for (index, place) in layout.iter().enumerate() {
        let node = nodes.get(index);
        if usize::try_from(node.length()) != Ok(rows) || node.null_count() != 0 {
            return None;
        }
        let buffer = buffers.get(2 * index + 1);
        let start = usize::try_from(buffer.offset()).ok()?;
        let width = place.kind.width();
        let bytes = rows.checked_mul(width)?;
        if usize::try_from(buffer.length()).ok()? < bytes {
            return None;
        }
        let data = body.get(start..start.checked_add(bytes)?)?;
        if matches!(place.meaning, Meaning::Check) {
            checks = Some(data);
            continue;
        }
        for ((row, sum), value) in out.iter_mut().zip(&mut sums).zip(data.chunks_exact(width)) {
            sum.update(value);
            let mut bits = [0u8; 8];
            bits.get_mut(..width)?.copy_from_slice(value);
            let bits = u64::from_le_bytes(bits);
            match place.meaning {
                Meaning::Value(column) => (column.set)(row, bits),
                Meaning::Law(index) => {
                    if let Some(own) = row.law.get_mut(index) {
                        *own = f32::from_bits(bits as u32);
                    }
                }
                Meaning::Check | Meaning::Unknown => {}
            }
        }
    }
    let Some(checks) = checks else {
        // A file from before rows were checked.
        return Some(Rows {
            rows: out,
            damaged: 0,
        });
    };
    let sound = checks
        .chunks_exact(Kind::U32.width())
        .zip(sums)
        .map(|(check, sum)| sum.finalize().to_le_bytes() == check);
    let kept: Vec<TickRecord> = out
        .into_iter()
        .zip(sound)
        .filter_map(|(row, sound)| sound.then_some(row))
        .collect();
    let damaged = (rows - kept.len()) as u64;
    Some(Rows {
        rows: kept,
        damaged,
    })
}
