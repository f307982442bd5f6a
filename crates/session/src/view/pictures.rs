//! The camera's frames on the live page.

use crate::crop::{self, Crop};
use cellpos_live::{OUTLINE_POINTS, Picture, PictureFeed};
use cellpos_rig::{FrameWatch, SeenFrame};
use cellpos_vision::Pixels;
use std::sync::mpsc::Sender;

/// Steps in which a crop follows the bead: a crop that moves with every pixel would hide the bead's motion.
const STEPS: usize = 8;

/// Crops frames for the page.
pub(super) struct Pictures {
    feed: PictureFeed,
    first_ns: Option<i64>,
}

/// [`Pictures`] while a run's camera has them; they come back when its watch is dropped.
struct Lent {
    pictures: Option<Pictures>,
    back: Sender<Pictures>,
}

impl Pictures {
    pub(super) fn new(feed: PictureFeed) -> Self {
        Self {
            feed,
            first_ns: None,
        }
    }

    /// For the camera of a run; `back` receives them when the run is over.
    pub(super) fn lend(self, back: &Sender<Pictures>) -> Box<dyn FrameWatch> {
        Box::new(Lent {
            pictures: Some(self),
            back: back.clone(),
        })
    }

    fn show(&mut self, seen: &SeenFrame<'_>) {
        let at_ns = seen.stamp.mid_exposure_ns;
        let time_s = (at_ns - *self.first_ns.get_or_insert(at_ns)) as f64 * 1e-9;
        if self.feed.is_due(time_s) {
            self.feed.offer(time_s, |picture| crop(seen, picture));
        }
    }
}

impl FrameWatch for Lent {
    fn frame(&mut self, seen: &SeenFrame<'_>) {
        if let Some(pictures) = &mut self.pictures {
            pictures.show(seen);
        }
    }
}

impl Drop for Lent {
    fn drop(&mut self) {
        if let Some(pictures) = self.pictures.take() {
            // If nobody receives them, the page is over.
            let _ = self.back.send(pictures);
        }
    }
}

/// The part of a frame around the bead or cell, in 8 bits.
fn crop(seen: &SeenFrame<'_>, picture: &mut Picture) {
    let crop = Crop::about(seen, crop::MOST, STEPS);
    let shift = seen.bits.saturating_sub(8);
    for span in crop.rows() {
        match seen.frame.pixels {
            Pixels::Mono8(pixels) => picture.pixels.extend_from_slice(&pixels[span]),
            Pixels::Mono16(pixels) => picture
                .pixels
                .extend(pixels[span].iter().map(|v| (v >> shift).min(255) as u8)),
        }
    }
    (picture.width, picture.height) = (crop.size.0 as u16, crop.size.1 as u16);
    let scale = seen.scale;
    let along = if scale.upright {
        crop.origin.1
    } else {
        crop.origin.0
    };
    picture.um_per_px = scale.um_per_px as f32;
    picture.upright = scale.upright;
    picture.first_um = (scale.first_um + scale.um_per_px * along as f64) as f32;
    picture.centre_px = seen.centre_px.map_or([f32::NAN; 2], |centre| {
        let (x, y) = crop.place(centre);
        [x as f32, y as f32]
    });
    picture.outline_px.clear();
    let points = seen.outline_px.iter().take(OUTLINE_POINTS);
    picture.outline_px.extend(points.map(|point| {
        let (x, y) = crop.place(*point);
        [x as f32, y as f32]
    }));
    picture.half_px = [seen.half_px.0 as f32, seen.half_px.1 as f32];
    picture.gate_px = if seen.expected_sd_px.is_finite() {
        (4.0 * seen.expected_sd_px) as f32
    } else {
        f32::NAN
    };
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_live::{Feed, Hello};

    #[test]
    fn a_crop_holds_the_bead_and_says_where_it_lies() {
        let (width, height) = (1024, 64);
        let mut pixels = vec![40_u16; width * height];
        pixels[32 * width + 900] = 4000;
        let seen = SeenFrame {
            frame: cellpos_vision::Frame {
                width,
                height,
                pixels: Pixels::Mono16(&pixels),
            },
            bits: 12,
            stamp: cellpos_rig::FrameStamp {
                id: 0,
                mid_exposure_ns: 0,
                exposure_ns: 0,
                arrival_ns: 0,
                true_um: f64::NAN,
                true_pzt_um: f64::NAN,
            },
            centre_px: Some((900.0, 32.0)),
            half_px: (5.0, 5.0),
            outline_px: &[(899.0, 31.0), (901.0, 31.0), (900.0, 33.0)],
            expected_px: (900.0, 32.0),
            expected_sd_px: f64::INFINITY,
            scale: cellpos_rig::PictureScale {
                first_um: -10.0,
                um_per_px: 0.1,
                upright: false,
            },
        };
        let (mut feed, _hub) = Feed::new(Hello {
            pictures: true,
            ..Hello::default()
        });
        let mut shown = None;
        feed.take_pictures().unwrap().offer(0.0, |picture| {
            crop(&seen, picture);
            shown = Some(picture.clone());
        });
        let picture = shown.unwrap();
        assert_eq!((picture.width, picture.height), (384, 64));
        let [x, y] = picture.centre_px;
        assert_eq!(picture.pixels[y as usize * 384 + x as usize], 250);
        assert_eq!(picture.outline_px[0], [x - 1.0, y - 1.0]);
        assert_eq!(picture.outline_px.len(), 3);
        let um = picture.first_um + picture.um_per_px * x;
        assert!((um - 80.0).abs() < 1e-3, "{um}");
    }
}
