//! Datasets with chunks compressed by Zstandard (HDF5 filter 32015). The HDF5 reader does not decode them but gives their places;
//! this module reads and decodes them. It supports two other filters: shuffle, and a checksum, which Zstandard has already.

use hdf5_pure::{DType, Dataset, Error};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

/// Numbers of the filters.
const SHUFFLE: u16 = 2;
const CHECKSUM: u16 = 3;
pub(crate) const ZSTANDARD: u16 = 32_015;
/// Largest accepted chunk, bytes: a header that claims more is damaged.
const LARGEST_CHUNK: u64 = 1 << 30;

/// A dataset read row by row (along its first side), with any compression of its chunks.
#[derive(Debug)]
pub(crate) struct Rows {
    dataset: Dataset,
    packed: Option<Packed>,
}

#[derive(Debug)]
struct Packed {
    file: File,
    /// Place, stored length and filters left out of each chunk, by the place of its first element.
    chunks: Vec<(Vec<u64>, u64, u64, u32)>,
    filters: Vec<u16>,
    shape: Vec<u64>,
    chunk: Vec<u64>,
    size: usize,
    /// The chunks last decoded, by their number: those of one band of rows.
    decoded: Vec<(usize, Vec<u8>)>,
}

impl Rows {
    /// Prepares to read a dataset of the file at `path`.
    pub(super) fn new(dataset: Dataset, path: &Path) -> Result<Self, Error> {
        let filters = dataset.filters();
        let known = |f: &u16| [SHUFFLE, CHECKSUM, ZSTANDARD].contains(f);
        // If the filter is unknown here too, the reader's own error names it.
        if !filters.contains(&ZSTANDARD) || !filters.iter().all(known) {
            return Ok(Rows {
                dataset,
                packed: None,
            });
        }
        let chunks = dataset.chunks()?.into_iter();
        let packed = Packed {
            file: File::open(path)?,
            chunks: chunks
                .map(|c| (c.offset, c.address, c.storage_size, c.filter_mask))
                .collect(),
            filters,
            shape: dataset.shape()?,
            chunk: dataset.chunk_shape()?.unwrap_or_default(),
            size: dataset.element_size()? as usize,
            decoded: Vec::new(),
        };
        Ok(Rows {
            dataset,
            packed: Some(packed),
        })
    }

    pub(super) fn shape(&self) -> Result<Vec<u64>, Error> {
        self.dataset.shape()
    }

    pub(super) fn element_size(&self) -> Result<u64, Error> {
        self.dataset.element_size()
    }

    /// Bytes of one row.
    pub(super) fn bytes(&mut self, row: u64) -> Result<Vec<u8>, Error> {
        match &mut self.packed {
            Some(packed) => packed.rows(row, 1).map_err(Error::from),
            None => self.dataset.read_raw_rows(row, 1),
        }
    }

    /// Numbers of two bytes in one row.
    pub(super) fn words(&mut self, row: u64) -> Result<Vec<u16>, Error> {
        let Some(packed) = &mut self.packed else {
            return self.dataset.read_u16_rows(row, 1);
        };
        let big = matches!(self.dataset.datatype()?, hdf5_pure::Datatype::FixedPoint { byte_order, .. } if byte_order == hdf5_pure::DatatypeByteOrder::BigEndian);
        let bytes = packed.rows(row, 1)?;
        let words = bytes.as_chunks::<2>().0.iter();
        Ok(if big {
            words.map(|b| u16::from_be_bytes(*b)).collect()
        } else {
            words.map(|b| u16::from_le_bytes(*b)).collect()
        })
    }

    /// All numbers of a dataset of one side.
    pub(super) fn numbers(&mut self) -> Result<Vec<f64>, Error> {
        let Some(packed) = &mut self.packed else {
            return self.dataset.read_f64();
        };
        let count = packed.shape.first().copied().unwrap_or(0);
        let bytes = packed.rows(0, count)?;
        macro_rules! of {
            ($kind:ty) => {
                bytes
                    .chunks_exact(size_of::<$kind>())
                    .map(|b| {
                        b.try_into()
                            .map_or(f64::NAN, |b| <$kind>::from_le_bytes(b) as f64)
                    })
                    .collect()
            };
        }
        Ok(match self.dataset.dtype()? {
            DType::F64 => of!(f64),
            DType::F32 => of!(f32),
            DType::U64 => of!(u64),
            DType::I64 => of!(i64),
            DType::U32 => of!(u32),
            DType::I32 => of!(i32),
            DType::U16 => of!(u16),
            DType::I16 => of!(i16),
            _ => Vec::new(),
        })
    }
}

impl Packed {
    /// Bytes of rows, in the order of the dataset.
    fn rows(&mut self, first: u64, count: u64) -> std::io::Result<Vec<u8>> {
        let row: u64 = self.shape.iter().skip(1).product();
        let mut to = vec![0; (count * row) as usize * self.size];
        let fits = self.chunk.len() == self.shape.len() && !self.chunk.contains(&0);
        let Some(&high) = self.chunk.first().filter(|_| fits) else {
            return Err(broken("chunks of another shape than the dataset's"));
        };
        let wanted: Vec<usize> = (0..self.chunks.len())
            .filter(|k| {
                let from = self.chunks[*k].0.first().copied().unwrap_or(0);
                from < first + count && first < from + high
            })
            .collect();
        for k in &wanted {
            let bytes = match self.decoded.iter().position(|(n, _)| n == k) {
                Some(at) => self.decoded.swap_remove(at).1,
                None => self.decode(*k)?,
            };
            self.copy(*k, &bytes, (first, count), &mut to);
            // Kept for the next row: most chunks hold several.
            self.decoded.retain(|(n, _)| wanted.contains(n));
            self.decoded.push((*k, bytes));
        }
        Ok(to)
    }

    /// Copies the intersection of a chunk and the rows, run by run along the last dimension.
    fn copy(&self, k: usize, bytes: &[u8], (first, count): (u64, u64), to: &mut [u8]) {
        let from = &self.chunks[k].0;
        let last = self.shape.len() - 1;
        // Of a dataset of one side each element is a run.
        let (length, sides) = if last == 0 {
            (1, 1)
        } else {
            (self.chunk[last].min(self.shape[last] - from[last]), last)
        };
        let runs: u64 = self.chunk.iter().take(sides).product();
        let stride = if last == 0 { 1 } else { self.chunk[last] };
        for run in 0..runs {
            // The run's place in the dataset, from the last side to the first.
            let (mut rest, mut place, mut step, mut inside) = (run, 0, 1, true);
            for side in (0..sides).rev() {
                let at = from[side] + rest % self.chunk[side];
                rest /= self.chunk[side];
                inside &= at < self.shape[side];
                if side == 0 {
                    inside &= (first..first + count).contains(&at);
                    place += step * at.saturating_sub(first);
                } else {
                    place += step * at;
                    step *= self.shape[side];
                }
            }
            if !inside {
                continue;
            }
            let place = if last == 0 {
                place
            } else {
                place * self.shape[last] + from[last]
            };
            let bytes_at = |element: u64| element as usize * self.size;
            let (place, start, width) = (bytes_at(place), bytes_at(run * stride), bytes_at(length));
            if let (Some(to), Some(part)) = (
                to.get_mut(place..place + width),
                bytes.get(start..start + width),
            ) {
                to.copy_from_slice(part);
            }
        }
    }

    fn decode(&mut self, k: usize) -> std::io::Result<Vec<u8>> {
        let (_, address, stored, left_out) = self.chunks[k];
        let elements: u64 = self.chunk.iter().product();
        let whole = elements.saturating_mul(self.size as u64);
        if stored > LARGEST_CHUNK || whole > LARGEST_CHUNK {
            return Err(broken("a chunk of more than 2^30 bytes"));
        }
        let mut bytes = vec![0; stored as usize];
        self.file.seek(SeekFrom::Start(address))?;
        self.file.read_exact(&mut bytes)?;
        for (n, filter) in self.filters.iter().enumerate().rev() {
            if left_out >> n & 1 == 1 {
                continue;
            }
            match *filter {
                CHECKSUM => bytes.truncate(bytes.len().saturating_sub(4)),
                SHUFFLE => bytes = unshuffled(&bytes, self.size),
                _ => {
                    let mut decoded = Vec::new();
                    let decoder = ruzstd::decoding::StreamingDecoder::new(bytes.as_slice())
                        .map_err(|e| broken(&e.to_string()))?;
                    decoder.take(whole + 4).read_to_end(&mut decoded)?;
                    bytes = decoded;
                }
            }
        }
        if bytes.len() as u64 != whole {
            return Err(broken(&format!(
                "a chunk of {} bytes instead of {whole}",
                bytes.len()
            )));
        }
        Ok(bytes)
    }
}

/// Bytes of equal place in their element lie together.
fn unshuffled(bytes: &[u8], size: usize) -> Vec<u8> {
    let count = bytes.len() / size.max(1);
    let mut to = bytes.to_vec();
    for (k, byte) in bytes.iter().enumerate().take(count * size) {
        to[k % count * size + k / count] = *byte;
    }
    to
}

fn broken(problem: &str) -> std::io::Error {
    std::io::Error::new(std::io::ErrorKind::InvalidData, problem)
}
