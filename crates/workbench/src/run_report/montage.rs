//! The montage of a cell: its picture at chosen phases (rows) of chosen cycles (columns), from the clips of the run.

use super::origin;
use super::session::Session;
use cellpos_report::{Figure, Mosaic, Tile};
use cellpos_script::CycleRow;
use cellpos_session::clips::{self, Film};
use image::{GrayImage, ImageFormat};
use std::collections::{BTreeMap, BTreeSet};
use std::io::Cursor;

/// Columns at most: of more cycles the first, the last, and evenly between. More would be too small to be read on paper.
const MOST_CYCLES: usize = 8;
/// Rows at most.
const MOST_PHASES: usize = 6;
/// Room about the cell, as a share of its largest length.
const ROOM: f64 = 0.15;
/// A picture is that much higher than the cell is long at its shortest: it shows the walls of the channel.
const HEIGHT: f64 = 1.6;

/// A frame of a cycle at a phase.
struct Shot {
    film: Film,
    time_s: f64,
}

/// The pictures, if the run has clips of cycles of a cell. The clips are named by the number of the cycle, from 1, and the phase.
pub(super) fn figure(sessions: &[Session], rows: &[CycleRow]) -> Option<Figure> {
    let mut found: BTreeMap<(u64, String), (&Session, String, f64)> = BTreeMap::new();
    for (number, session) in (1..).zip(sessions) {
        for clip in clips::list(&session.folder) {
            let Some((cycle, phase)) = parsed(&clip.name) else {
                continue;
            };
            let of_row = |row: &&CycleRow| row.cycle + 1 == cycle && row.session == number;
            let Some(row) = rows.iter().find(of_row) else {
                continue;
            };
            let share: f64 = phase.parse().unwrap_or(f64::NAN);
            let at_s = row.start_s + share * row.duration_s;
            found.insert((cycle, phase), (session, clip.name, at_s));
        }
    }
    let cycles: BTreeSet<u64> = found.keys().map(|(cycle, _)| *cycle).collect();
    let phases: BTreeSet<String> = found.keys().map(|(_, phase)| phase.clone()).collect();
    let cycles = spread(&cycles.into_iter().collect::<Vec<_>>(), MOST_CYCLES);
    let phases = spread(&phases.into_iter().collect::<Vec<_>>(), MOST_PHASES);
    let mut shots: Vec<Option<Shot>> = Vec::new();
    for phase in &phases {
        for cycle in &cycles {
            let shot = (found.get(&(*cycle, phase.clone()))).and_then(|(session, name, at_s)| {
                let film = clips::read_at(&session.folder, name, *at_s).ok()?;
                let time_s = session.start_s + film.frames.first()?.time_s;
                Some(Shot { film, time_s })
            });
            shots.push(shot);
        }
    }
    let meta = sessions.first()?.meta.as_ref()?;
    let pixel_um = origin::pixel_um(meta);
    let part = Part::about(&shots, rows, pixel_um)?;
    let tiles = shots.iter().map(|shot| part.tile(shot.as_ref()?)).collect();
    let columns: Vec<String> = cycles.iter().map(|n| format!("cycle {n}")).collect();
    let mut mosaic = Mosaic::new("time of the frame (s)", &phases, &columns, tiles);
    let mut caption = "The cell at the same phases (rows, fractions of a cycle) of several cycles (columns), all of the same part of \
                       the channel and with the same range of grey."
        .to_owned();
    match pixel_um {
        Some(um) => {
            mosaic = mosaic.scale(um);
            caption.push_str(&format!(" A pixel is {um} um."));
        }
        None => caption.push_str(" The size of a pixel is not known: there is no scale bar."),
    }
    Some(Figure::mosaic("montage", &caption, mosaic))
}

/// Number of the cycle, and phase, of a clip's name.
fn parsed(name: &str) -> Option<(u64, String)> {
    let (cycle, phase) = name.strip_prefix("cycle-")?.split_once("-phase-")?;
    Some((cycle.parse().ok()?, phase.to_owned()))
}

/// At most `most` of some things, the first and the last among them.
fn spread<T: Clone>(all: &[T], most: usize) -> Vec<T> {
    let taken = all.len().min(most);
    let at = |n: usize| n * (all.len() - 1) / (taken - 1).max(1);
    (0..taken).filter_map(|n| all.get(at(n)).cloned()).collect()
}

/// The part of the frames that is shown, px, and the range of grey that becomes black to white.
struct Part {
    left: u32,
    top: u32,
    width: u32,
    height: u32,
    grey: (u8, u8),
}

impl Part {
    /// All places of the cell with its largest length, along the channel; across it as much as its shortest length asks for. The
    /// whole frame if the size of a pixel is not known.
    fn about(shots: &[Option<Shot>], rows: &[CycleRow], pixel_um: Option<f64>) -> Option<Self> {
        let shots: Vec<&Shot> = shots.iter().flatten().collect();
        let first = &shots.first()?.film;
        let (width, height) = (first.width, first.height);
        let lengths_px = |of: fn(&CycleRow) -> f64, pick: fn(f64, f64) -> f64| {
            let lengths = rows.iter().map(of).filter(|um| um.is_finite());
            Some(lengths.reduce(pick)? / pixel_um?)
        };
        let places = |of: usize| {
            let frames = shots.iter().filter_map(|shot| shot.film.frames.first());
            frames
                .map(move |frame| f64::from(frame.centre_px[of]))
                .filter(|px| px.is_finite())
        };
        let span = |of: usize| {
            let (low, high) = (places(of).reduce(f64::min)?, places(of).reduce(f64::max)?);
            Some((low, high))
        };
        let clamp = |low: f64, high: f64, most: u32| {
            let low = low.floor().clamp(0.0, f64::from(most));
            let high = high.ceil().clamp(low, f64::from(most));
            (low as u32, (high - low) as u32)
        };
        let about = || {
            let longest = lengths_px(|row| row.length_peak_um, f64::max)?;
            let shortest = lengths_px(|row| row.length_start_um, f64::min)?;
            let ((x0, x1), (y0, y1)) = (span(0)?, span(1)?);
            let (beside, across) = (longest * (0.5 + ROOM), shortest * HEIGHT / 2.0);
            let (left, width) = clamp(x0 - beside, x1 + beside, width);
            let (top, height) = clamp(y0 - across, y1 + across, height);
            (width > 0 && height > 0).then_some((left, top, width, height))
        };
        let (left, top, width, height) = about().unwrap_or((0, 0, width, height));
        let mut part = Self {
            left,
            top,
            width,
            height,
            grey: (0, 255),
        };
        let values = || shots.iter().flat_map(|shot| part.pixels(&shot.film));
        let grey = (values().min()?, values().max()?);
        part.grey = grey;
        Some(part)
    }

    fn pixels(&self, film: &Film) -> Vec<u8> {
        let wide = film.width as usize;
        let rows = film.frames.first().map_or(&[][..], |frame| &frame.pixels);
        let (from, to) = (self.left as usize, (self.left + self.width) as usize);
        rows.chunks(wide.max(1))
            .skip(self.top as usize)
            .take(self.height as usize)
            .flat_map(|row| row.get(from..to).unwrap_or_default().iter().copied())
            .collect()
    }

    fn tile(&self, shot: &Shot) -> Option<Tile> {
        let (low, high) = self.grey;
        let range = f32::from(high.saturating_sub(low).max(1));
        let pixels: Vec<u8> = (self.pixels(&shot.film).into_iter())
            .map(|v| (f32::from(v.saturating_sub(low)) * 255.0 / range).round() as u8)
            .collect();
        // A frame of another size than the first has not these pixels.
        let picture = GrayImage::from_raw(self.width, self.height, pixels.clone())?;
        let mut png = Cursor::new(Vec::new());
        picture.write_to(&mut png, ImageFormat::Png).ok()?;
        Some(Tile {
            width: self.width,
            height: self.height,
            pixels,
            png: png.into_inner(),
            value: shot.time_s,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_script::ArmKind;
    use cellpos_session::clips::FilmFrame;

    fn shot(centre_px: [f32; 2]) -> Option<Shot> {
        let film = Film {
            width: 200,
            height: 60,
            frames: vec![FilmFrame {
                time_s: 1.0,
                centre_px,
                pixels: (0..200 * 60).map(|n| 40 + (n % 100) as u8).collect(),
            }],
        };
        Some(Shot { film, time_s: 1.0 })
    }

    #[test]
    fn every_picture_shows_the_cell_at_all_its_places_with_one_range_of_grey() {
        let mut row = CycleRow::empty(0, 1, ArmKind::Cyclic);
        (row.length_start_um, row.length_peak_um) = (4.0, 12.0);
        let shots = [shot([70.0, 30.0]), None, shot([130.0, 30.0])];
        let part = Part::about(&shots, &[row], Some(0.2)).unwrap();
        // 60 px long at most: from 70 - 39 to 130 + 39; 20 px at least: 30 - 16 to 30 + 16.
        assert_eq!(
            (part.left, part.width, part.top, part.height),
            (31, 138, 14, 32)
        );
        let tile = part.tile(shots[0].as_ref().unwrap()).unwrap();
        assert_eq!(tile.pixels.len(), 138 * 32);
        let ends = (tile.pixels.iter().min(), tile.pixels.iter().max());
        assert_eq!(ends, (Some(&0), Some(&255)));
        let whole = Part::about(&shots, &[row], None).unwrap();
        assert_eq!((whole.width, whole.height), (200, 60));
    }

    #[test]
    fn clips_of_cycles_are_known_by_their_names() {
        assert_eq!(
            parsed("cycle-000010-phase-0.50"),
            Some((10, "0.50".to_owned()))
        );
        assert_eq!(parsed("0000012.345s-frozen"), None);
        assert_eq!(spread(&[1, 2, 3, 4, 5, 6, 7, 8, 9, 10], 4), [1, 4, 7, 10]);
        assert_eq!((spread(&[3], 4), spread::<u8>(&[], 4)), (vec![3], vec![]));
    }
}
