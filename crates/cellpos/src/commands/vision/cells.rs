//! Cells of a recording, against the empty channel.

use super::{Args, Reader, end_row};
use crate::commands::vision_sheet::{CellMark, Sheet};
use crate::commands::vision_summary::Tally;
use crate::outcome::Failure;
use cellpos_drivers::{CalibrationFile, background};
use cellpos_rig::FrameBuffer;
use cellpos_session::rig_file::RigFile;
use cellpos_vision::{Cell, CellConfig, CellFinder};
use std::fmt::Write as _;
use std::time::Instant;

/// A cell that is where one was in this many frames before, to a share of its width, stays: a wall, dust.
const STAYS: (u32, f64) = (20, 0.1);
/// Farthest that a cell goes from frame to frame, in its own lengths.
const MOST_LENGTHS: f64 = 2.0;
/// Frames of which the noise is learnt where the recording holds its background.
const NOISE_FRAMES: usize = 20;
/// Change of the area from frame to frame by which a cell is still the same.
const MOST_CHANGE: f64 = 1.4;

/// A cell being followed.
#[derive(Debug, Clone, Copy)]
struct Known {
    number: u32,
    cell: Cell,
    /// Where it was seen first, and the frames since then in which it stayed there.
    first: (f64, f64),
    stayed: u32,
    seen: usize,
}

/// Numbers that stay with cells from frame to frame, for a recording.
#[derive(Debug, Default)]
struct Numbers {
    known: Vec<Known>,
    next: u32,
}

impl Numbers {
    /// The number of a cell of frame `n`, and whether it has stayed where it was.
    fn of(&mut self, n: usize, cell: &Cell) -> (u32, bool) {
        let reach_px = MOST_LENGTHS * cell.axes_px().0;
        let distance = |k: &Known| f64::hypot(k.cell.x_px - cell.x_px, k.cell.y_px - cell.y_px);
        let same = |k: &Known| {
            let ratio = k.cell.area_px / cell.area_px;
            k.seen < n && distance(k) < reach_px && ratio < MOST_CHANGE && ratio * MOST_CHANGE > 1.0
        };
        let free = self.known.iter_mut().filter(|k| same(k));
        let nearest = free.min_by(|a, b| distance(a).total_cmp(&distance(b)));
        if let Some(known) = nearest {
            let still_px = STAYS.1 * cell.axes_px().1;
            let moved = f64::hypot(known.first.0 - cell.x_px, known.first.1 - cell.y_px) > still_px;
            if moved {
                (known.first, known.stayed) = ((cell.x_px, cell.y_px), 0);
            } else {
                known.stayed += 1;
            }
            (known.cell, known.seen) = (*cell, n);
            return (known.number, known.stayed >= STAYS.0);
        }
        let number = self.next;
        self.next += 1;
        self.known.push(Known {
            number,
            cell: *cell,
            first: (cell.x_px, cell.y_px),
            stayed: 0,
            seen: n,
        });
        (number, false)
    }

    /// Forgets cells that the last frames did not show.
    fn forget(&mut self, n: usize) {
        self.known.retain(|k| k.seen + 5 > n);
    }
}

/// Finds the cells of each frame; returns their table.
pub(super) fn find(
    args: &Args,
    calibration: Option<&CalibrationFile>,
    reader: &mut Reader,
    sheet: &mut Sheet,
    tally: &mut Tally,
) -> Result<String, Failure> {
    let config = match &args.rig {
        Some(path) => RigFile::load(Some(path))?.cell.unwrap_or_default().finder,
        None => CellConfig::default(),
    };
    let mut buffer = FrameBuffer::default();
    let (mut finder, first) = finder(args, config, reader)?;
    let mut csv = String::from(
        "frame,cell,x_px,y_px,sd_x_px,sd_y_px,area_px,sd_area_px,length_px,sd_length_px,width_px,angle_deg,rim_grey,halo_grey,\
         snr,verdict",
    );
    csv.push_str(if calibration.is_some() {
        ",bead_um\n"
    } else {
        "\n"
    });
    let mut numbers = Numbers::default();
    for n in first..reader.frames {
        reader.read(n, &mut buffer)?;
        let frame = buffer.frame();
        let start = Instant::now();
        finder.find(&frame).map_err(Failure::input)?;
        finder.refresh(&frame);
        tally.time_us.push(start.elapsed().as_secs_f64() * 1e6);
        let mut marks = Vec::new();
        let mut good = 0;
        for (k, c) in finder.found().iter().enumerate() {
            let (number, stays) = numbers.of(n, c);
            let verdict = if c.at_border {
                "at-border"
            } else if c.in_contact {
                "in-contact"
            } else if stays {
                "stays"
            } else {
                "good"
            };
            row(&mut csv, reader.number(n), number, c, verdict);
            end_row(&mut csv, calibration, c.x_px, c.y_px);
            if verdict == "good" {
                tally.cell(c);
                good += 1;
            } else {
                tally.refuse(verdict);
            }
            marks.push(CellMark {
                number,
                cell: *c,
                outline: finder.outline(k),
                good: verdict == "good",
            });
        }
        for _ in 0..finder.dust() {
            tally.refuse("too-small");
        }
        numbers.forget(n);
        tally.frame(good);
        sheet.add_cells(n, &frame, &marks);
    }
    Ok(csv)
}

fn row(csv: &mut String, frame: u64, number: u32, c: &Cell, verdict: &str) {
    let along = (c.angle_rad().cos(), c.angle_rad().sin());
    let (length_px, width_px) = c.axes_px();
    let _ = write!(
        csv,
        "{frame},{number},{:.3},{:.3},{:.4},{:.4},{:.2},{:.2},{length_px:.3},{:.4},{width_px:.3},{:.2},{:.2},{:.2},{:.1},{verdict}",
        c.x_px,
        c.y_px,
        c.var_x_px2.sqrt(),
        c.var_y_px2.sqrt(),
        c.area_px,
        c.var_area_px2.sqrt(),
        c.extent_sd_px(along),
        c.angle_rad().to_degrees(),
        c.body_grey,
        c.halo_grey,
        c.snr,
    );
}

/// A finder that knows the empty channel, and the first frame to look at.
fn finder(
    args: &Args,
    config: CellConfig,
    reader: &mut Reader,
) -> Result<(CellFinder, usize), Failure> {
    if let Some(path) = &args.background {
        let finder = background::load(path, config).map_err(|error| {
            Failure::bad_input(error, "record the empty channel again: cellpos background")
        })?;
        return Ok((finder, 0));
    }
    let count = args.background_frames;
    if let Some(finder) = own_background(config, reader)? {
        return Ok((finder, 0));
    }
    if count < 2 || count >= reader.frames {
        return Err(Failure::bad_input(
            format!(
                "--background-frames {count}: not possible with {} frames",
                reader.frames
            ),
            "give 2 or more frames without a cell, and leave some to look at",
        ));
    }
    let mut frames = Vec::with_capacity(count);
    for n in 0..count {
        let mut frame = FrameBuffer::default();
        reader.read(n, &mut frame)?;
        frames.push(frame);
    }
    let from = args.source.display().to_string();
    let finder = background::finder(&frames, &from, config).map_err(|error| {
        Failure::bad_input(
            error,
            "give fewer --background-frames, or a recording of the empty channel with --background",
        )
    })?;
    Ok((finder, count))
}

/// A finder from the background that the recording itself holds, if it does; the noise is that of its pictures.
fn own_background(config: CellConfig, reader: &mut Reader) -> Result<Option<CellFinder>, Failure> {
    let Some(mut empty) = reader.recording.background().map_err(Failure::input)? else {
        return Ok(None);
    };
    if let Some(region) = reader.region {
        region.cut(&mut empty).map_err(Failure::input)?;
    }
    let mut finder = CellFinder::new(empty.width, empty.height, config).map_err(Failure::input)?;
    finder
        .set_background(&empty.frame())
        .map_err(Failure::input)?;
    let mut buffer = FrameBuffer::default();
    for n in 0..reader.frames.min(NOISE_FRAMES) {
        reader.read(n, &mut buffer)?;
        finder
            .learn_noise(&buffer.frame())
            .map_err(Failure::input)?;
    }
    Ok(Some(finder))
}
