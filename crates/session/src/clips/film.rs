//! Reads clips back: their names in a run folder, and their frames in 8 bits.

use super::CLIPS;
use cellpos_live::{ClipLine, FilmFrame, film_bytes};
use std::fs::File;
use std::io::{self, BufReader};
use std::path::Path;
use tiff::decoder::{Decoder, DecodingResult};

/// Largest table of a clip that is read, bytes.
const MOST_TABLE: u64 = 4 << 20;
/// Largest frame that is read, px: a clip's own are smaller.
const MOST_PIXELS: usize = 1 << 22;

/// Some frames of a clip, evenly spread over it.
#[derive(Debug, Clone, PartialEq)]
pub struct Film {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// The frames.
    pub frames: Vec<FilmFrame>,
}

impl Film {
    /// As the live page takes it.
    pub fn to_bytes(&self) -> Vec<u8> {
        film_bytes(self.width, self.height, &self.frames)
    }
}

/// Names of the complete clips of a run folder.
pub fn list(run: &Path) -> Vec<ClipLine> {
    let Ok(entries) = std::fs::read_dir(run.join(CLIPS)) else {
        return vec![];
    };
    let mut found: Vec<ClipLine> = entries
        .flatten()
        .filter_map(|entry| {
            let name = entry.file_name().into_string().ok()?;
            let name = name.strip_suffix(".csv")?;
            let times = times(run, name).ok()?;
            Some(ClipLine {
                name: name.to_string(),
                time_s: times.first()?.0,
                frames: times.len() as u64,
            })
        })
        .collect();
    found.sort_by(|a, b| {
        a.time_s
            .total_cmp(&b.time_s)
            .then_with(|| a.name.cmp(&b.name))
    });
    found
}

/// Whether a name can be that of a clip, which never leads out of the folder.
fn is_a_name(name: &str) -> bool {
    let allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_');
    !name.is_empty() && name.len() < 200 && !name.starts_with('.') && name.chars().all(allowed)
}

/// Time and centre of each frame.
fn times(run: &Path, name: &str) -> io::Result<Vec<(f64, [f32; 2])>> {
    let path = run.join(CLIPS).join(format!("{name}.csv"));
    let text = cellpos_table::read_text(&path, MOST_TABLE).map_err(io::Error::other)?;
    Ok(text
        .lines()
        .skip(1)
        .map(|line| {
            let cells: Vec<&str> = line.split(',').collect();
            let number = |n: usize| cells.get(n).and_then(|cell| cell.parse::<f64>().ok());
            let place = |n: usize| number(n).map_or(f32::NAN, |value| value as f32);
            (number(1).unwrap_or(f64::NAN), [place(5), place(6)])
        })
        .collect())
}

/// A clip of a run folder, at most `most` of its frames.
///
/// # Errors
/// No clip has that name, or the file is something else.
pub fn read(run: &Path, name: &str, most: usize) -> io::Result<Film> {
    if !is_a_name(name) {
        return Err(io::ErrorKind::NotFound.into());
    }
    let times = times(run, name)?;
    frames(run, name, &times, chosen(times.len(), most))
}

/// The frame of a clip that was exposed nearest to a time of the run, s.
///
/// # Errors
/// As [`read`]; a clip without frames.
pub fn read_at(run: &Path, name: &str, time_s: f64) -> io::Result<Film> {
    if !is_a_name(name) {
        return Err(io::ErrorKind::NotFound.into());
    }
    let times = times(run, name)?;
    let off = |n: &usize| (times[*n].0 - time_s).abs();
    let nearest = (0..times.len()).min_by(|a, b| off(a).total_cmp(&off(b)));
    let nearest = nearest.ok_or(io::ErrorKind::UnexpectedEof)?;
    frames(run, name, &times, vec![nearest])
}

/// The frames with these numbers, in rising order.
fn frames(
    run: &Path,
    name: &str,
    times: &[(f64, [f32; 2])],
    wanted: Vec<usize>,
) -> io::Result<Film> {
    let file = File::open(run.join(CLIPS).join(format!("{name}.tif")))?;
    let mut stack = Decoder::new(BufReader::new(file)).map_err(io::Error::other)?;
    let (width, height) = stack.dimensions().map_err(io::Error::other)?;
    if width as usize * height as usize > MOST_PIXELS {
        return Err(io::Error::other("larger than a clip's frames are"));
    }
    let mut deep = Vec::with_capacity(wanted.len());
    let mut at = 0;
    for number in wanted {
        while at < number && stack.more_images() {
            stack.next_image().map_err(io::Error::other)?;
            at += 1;
        }
        if at != number {
            break;
        }
        let pixels = match stack.read_image().map_err(io::Error::other)? {
            DecodingResult::U8(pixels) => pixels.into_iter().map(u16::from).collect(),
            DecodingResult::U16(pixels) => pixels,
            _ => return Err(io::Error::other("neither 8 nor 16 bits")),
        };
        deep.push((number, pixels));
    }
    let brightest = deep.iter().flat_map(|(_, pixels)| pixels).max();
    let shift = brightest.map_or(0, |most| (16 - most.leading_zeros()).saturating_sub(8));
    let frames = deep
        .into_iter()
        .map(|(number, pixels): (usize, Vec<u16>)| FilmFrame {
            time_s: times[number].0,
            centre_px: times[number].1,
            pixels: pixels.iter().map(|v| (v >> shift) as u8).collect(),
        })
        .collect();
    Ok(Film {
        width,
        height,
        frames,
    })
}

/// At most `most` of `count` numbers, evenly spread, the first and the last among them.
fn chosen(count: usize, most: usize) -> Vec<usize> {
    let taken = count.min(most.max(1));
    (0..taken)
        .map(|n| {
            if taken > 1 {
                n * (count - 1) / (taken - 1)
            } else {
                0
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_chosen_evenly_and_none_twice() {
        assert_eq!(chosen(501, 6), [0, 100, 200, 300, 400, 500]);
        assert_eq!(chosen(3, 6), [0, 1, 2]);
        assert_eq!(chosen(5, 1), [0]);
        assert!(chosen(0, 6).is_empty());
    }

    #[test]
    fn no_name_leads_out_of_the_folder() {
        for name in ["", "..", "../run", "a/b", ".hidden", "a\\b", "%2e%2e"] {
            assert!(!is_a_name(name), "{name}");
        }
        assert!(is_a_name("0000012.345s-frozen") && is_a_name("cycle-000010-phase-0.50"));
    }
}
