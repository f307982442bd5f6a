//! The clips that were kept of the camera's picture: a strip of frames of each, bounded in number and size.

use super::Session;
use cellpos_report::{Emphasis, Report};
use cellpos_session::clips::{self, Film};
use image::{GrayImage, ImageFormat, Luma};
use std::io::Cursor;

/// Clips that are shown; the others are named.
const MOST: usize = 24;
/// Frames of a strip.
const FRAMES: usize = 6;
/// Widest strip, px: a wider one has every second, third, … pixel.
const WIDEST: u32 = 1200;
/// Rim between two frames, px.
const RIM: u32 = 2;

/// A section, where there are clips.
pub(super) fn section(page: &mut Report, sessions: &[Session]) {
    let found: Vec<(&Session, cellpos_session::view::ClipLine)> = (sessions.iter())
        .flat_map(|session| {
            let clips = clips::list(&session.folder);
            clips.into_iter().map(move |clip| (session, clip))
        })
        .collect();
    if found.is_empty() {
        return;
    }
    page.section("Clips");
    for (session, clip) in found.iter().take(MOST) {
        let path = format!("{}/{}.tif", clips::CLIPS, clip.name);
        let shown = clips::read(&session.folder, &clip.name, FRAMES)
            .map_err(|error| error.to_string())
            .and_then(|film| strip(&film).map(|png| (film, png)));
        match shown {
            Ok((film, png)) => {
                let times: Vec<String> = (film.frames.iter())
                    .map(|frame| format!("{:.3}", session.start_s + frame.time_s))
                    .collect();
                let caption = format!(
                    "{path}, {} frames; shown are those at {} s.",
                    clip.frames,
                    times.join(", ")
                );
                page.picture(&format!("frames of the clip {}", clip.name), &caption, png);
            }
            Err(error) => {
                let text = format!("{path} cannot be shown: {error}");
                page.note(Emphasis::Warning, &text);
            }
        }
    }
    if found.len() > MOST {
        let left = found.len() - MOST;
        let folder = clips::CLIPS;
        page.paragraph(&format!(
            "{left} more clips lie in the folder {folder} of the run; cellpos vision reads them."
        ));
    }
}

/// The frames side by side as a PNG file, their common range of grey stretched to the whole.
fn strip(film: &Film) -> Result<Vec<u8>, String> {
    let count = film.frames.len() as u32;
    if count == 0 || film.width == 0 || film.height == 0 {
        return Err("it has no frames".to_string());
    }
    // Side by side if wide enough, else one below the other.
    let upright = film.width > 2 * film.height;
    let across = if upright { 1 } else { count };
    let every = (across * film.width).div_ceil(WIDEST).max(1);
    let (width, height) = (film.width.div_ceil(every), film.height.div_ceil(every));
    let step = (width + RIM, height + RIM);
    let size = if upright {
        (width, count * step.1 - RIM)
    } else {
        (count * step.0 - RIM, height)
    };
    let shown = |pixels: &[u8], x: u32, y: u32| {
        let at = (y * every * film.width + x * every) as usize;
        pixels.get(at).copied().unwrap_or(0)
    };
    let places = || (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    let (low, high) = (film.frames.iter())
        .flat_map(|frame| places().map(|(x, y)| shown(&frame.pixels, x, y)))
        .fold((255, 0), |(low, high), v| (v.min(low), v.max(high)));
    let stretch = 255.0 / f32::from((high - low).max(1));
    let mut picture = GrayImage::from_pixel(size.0, size.1, Luma([128]));
    for (n, frame) in (0..).zip(&film.frames) {
        let (left, top) = if upright {
            (0, n * step.1)
        } else {
            (n * step.0, 0)
        };
        for (x, y) in places() {
            let grey = f32::from(shown(&frame.pixels, x, y) - low) * stretch;
            picture.put_pixel(left + x, top + y, Luma([grey.round() as u8]));
        }
    }
    let mut png = Cursor::new(Vec::new());
    picture
        .write_to(&mut png, ImageFormat::Png)
        .map_err(|error| error.to_string())?;
    Ok(png.into_inner())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn film(width: u32, height: u32, frames: usize) -> Film {
        let pixels: Vec<u8> = (0..width * height).map(|n| 40 + (n % 50) as u8).collect();
        let frame = cellpos_session::clips::FilmFrame {
            time_s: 0.5,
            centre_px: [1.0, 1.0],
            pixels,
        };
        Film {
            width,
            height,
            frames: vec![frame; frames],
        }
    }

    #[test]
    fn a_strip_is_bounded_and_uses_the_whole_range_of_grey() {
        for (width, height, frames) in [(384, 288, 6), (384, 64, 6), (3, 2, 1), (2000, 40, 4)] {
            let png = strip(&film(width, height, frames)).unwrap();
            let picture = image::load_from_memory(&png).unwrap().to_luma8();
            assert!(picture.width() <= WIDEST + RIM * 6, "{width} x {height}");
            let most = picture.pixels().map(|pixel| pixel.0[0]).max();
            assert_eq!(most, Some(255), "{width} x {height}");
        }
        assert!(strip(&film(3, 2, 0)).is_err());
    }
}
