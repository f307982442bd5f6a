//! Cells: what differs from a background frame, and the outline of each.
//!
//! For objects without a known shape. The contrast keeps its sign: a cell is its dark (or bright) body and rim, and the
//! bright (or dark) halo about it is not counted as cell. Place, area, length and width are those of the surface within the
//! outline, each with its variance. Allocates only when made.

mod along;
mod background;
mod drift;
mod finder;
mod focus;
mod regions;
mod softer;

use serde::{Deserialize, Serialize};

pub use finder::CellFinder;

/// Settings of a [`CellFinder`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CellConfig {
    /// A patch of 4 x 4 pixels stands out when its RMS contrast is this many standard deviations of a pixel's noise (noise
    /// alone gives 1). An object needs a patch of twice this.
    pub threshold_sigma: f64,
    /// Smallest area within the outline, px: what is smaller is dust.
    pub min_area_px: f64,
    /// Most regions told apart in a frame.
    pub max_regions: u32,
    /// Frames over which the background follows slow changes of light and focus where no cell is; 0: it stays as it was
    /// recorded.
    pub refresh_frames: u32,
}

impl Default for CellConfig {
    fn default() -> Self {
        CellConfig {
            threshold_sigma: 2.5,
            min_area_px: 30.0,
            max_regions: 64,
            // Twenty seconds at 1000 frames a second.
            refresh_frames: 20_000,
        }
    }
}

/// A cell in a frame: the surface within its outline, which lies between rim and halo.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cell {
    /// Middle of the surface, px.
    pub x_px: f64,
    /// Middle of the surface, px.
    pub y_px: f64,
    /// Variance of `x_px` from the noise of the pixels at the outline, and from what rim and halo differ along it, px^2.
    pub var_x_px2: f64,
    /// Variance of `y_px`, px^2.
    pub var_y_px2: f64,
    /// Covariance of the two, px^2.
    pub cov_xy_px2: f64,
    /// Area, px.
    pub area_px: f64,
    /// Variance of the area, px^2.
    pub var_area_px2: f64,
    /// Central second moments of the surface: x x, x y, y y, px^2.
    pub moments_px2: [f64; 3],
    /// Their covariance, px^4: of the first with all three, of the second with the last two, of the last with itself.
    pub moments_var_px4: [f64; 6],
    /// Contrast of the rim, grey levels, whatever its sign.
    pub body_grey: f64,
    /// Whether the rim is darker than the background.
    pub dark: bool,
    /// Contrast of the halo, grey levels, whatever its sign; 0 without one.
    pub halo_grey: f64,
    /// RMS contrast over the region with its halo, grey levels.
    pub mean_grey: f64,
    /// Largest RMS contrast of a patch of 4 x 4 pixels, grey levels.
    pub peak_grey: f64,
    /// Contrast of the rim over the noise of one pixel.
    pub snr: f64,
    /// Whether the outline is cut by the frame's border: then all of the above is that of a part.
    pub at_border: bool,
    /// Whether another cell touches or overlaps it: the outline is not convex, has a waist, crosses a gap without an edge, or has
    /// as much contrast outside as a cell.
    pub in_contact: bool,
}

impl Cell {
    /// Full length along a direction (a unit vector), px: of the ellipse with the same second moments.
    pub fn extent_px(&self, (ux, uy): (f64, f64)) -> f64 {
        let [xx, xy, yy] = self.moments_px2;
        // A uniform ellipse of full axis L has the second moment L^2 / 16 along it.
        4.0 * (ux * ux * xx + 2.0 * ux * uy * xy + uy * uy * yy)
            .max(0.0)
            .sqrt()
    }

    /// Standard deviation of [`Cell::extent_px`], px.
    pub fn extent_sd_px(&self, (ux, uy): (f64, f64)) -> f64 {
        let g = [ux * ux, 2.0 * ux * uy, uy * uy];
        let [aa, ab, ac, bb, bc, cc] = self.moments_var_px4;
        let variance = g[0] * (g[0] * aa + 2.0 * (g[1] * ab + g[2] * ac))
            + g[1] * (g[1] * bb + 2.0 * g[2] * bc)
            + g[2] * g[2] * cc;
        // The extent is 4 times the root of the moment: its derivative is 8 over the extent.
        8.0 * variance.max(0.0).sqrt() / self.extent_px((ux, uy)).max(1e-9)
    }

    /// Full length and width along the long and the short axis, px.
    pub fn axes_px(&self) -> (f64, f64) {
        let [xx, xy, yy] = self.moments_px2;
        let (mean, half) = (0.5 * (xx + yy), 0.5 * f64::hypot(xx - yy, 2.0 * xy));
        (
            4.0 * (mean + half).sqrt(),
            4.0 * (mean - half).max(0.0).sqrt(),
        )
    }

    /// Angle of the long axis from the x axis towards y, rad, -pi/2 to pi/2.
    pub fn angle_rad(&self) -> f64 {
        let [xx, xy, yy] = self.moments_px2;
        0.5 * (2.0 * xy).atan2(xx - yy)
    }
}

/// Why a frame was not taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum CellError {
    /// The frame has another size than the finder was made for.
    #[error(
        "frame of {width} x {height} px: this cell finder was made for {expected_width} x {expected_height} px"
    )]
    Size {
        /// Its width, px.
        width: usize,
        /// Its height, px.
        height: usize,
        /// Width expected, px.
        expected_width: usize,
        /// Height expected, px.
        expected_height: usize,
    },
    /// The frame holds fewer pixels than it claims.
    #[error("frame holds {pixels} pixels, its size says {expected}")]
    Truncated {
        /// Pixels held.
        pixels: usize,
        /// Pixels expected.
        expected: usize,
    },
    /// No background yet.
    #[error("no background yet: take in at least 2 frames without a cell")]
    NoBackground,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::{Frame, Pixels};
    use cellpos_numeric::Random;

    const SIZE: (usize, usize) = (96, 48);

    /// Uneven light, noise of 2 grey levels, and an elliptic cell with a dark rim when `cell` gives its centre.
    fn picture(cell: Option<(f64, f64)>, light: f64, noise: &mut Random) -> Vec<u8> {
        let pixel = |k: usize| {
            let (x, y) = ((k % SIZE.0) as f64, (k / SIZE.0) as f64);
            let mut v = 110.0 + 0.4 * x - 0.3 * y;
            if let Some((cx, cy)) = cell {
                let r = f64::hypot((x - cx) / 14.0, (y - cy) / 10.0);
                v += if r < 0.75 {
                    6.0
                } else if r < 1.0 {
                    -30.0
                } else {
                    0.0
                };
            }
            (light * v + 2.0 * noise.normal()).round().clamp(0.0, 255.0) as u8
        };
        (0..SIZE.0 * SIZE.1).map(pixel).collect()
    }

    fn frame(pixels: &[u8]) -> Frame<'_> {
        Frame {
            width: SIZE.0,
            height: SIZE.1,
            pixels: Pixels::Mono8(pixels),
        }
    }

    fn taught(noise: &mut Random) -> CellFinder {
        let mut finder = CellFinder::new(SIZE.0, SIZE.1, CellConfig::default()).unwrap();
        for _ in 0..20 {
            finder
                .take_background(&frame(&picture(None, 1.0, noise)))
                .unwrap();
        }
        finder
    }

    #[test]
    fn a_cell_gets_its_place_size_and_intensity_in_uneven_and_flickering_light() {
        let mut noise = Random::new(4);
        let mut finder = taught(&mut noise);
        assert!(
            (finder.noise_grey() - 2.02).abs() < 0.1,
            "{}",
            finder.noise_grey()
        );
        for (light, cell) in [
            (1.0, (40.2, 20.7)),
            (0.9, (55.0, 25.0)),
            (1.1, (30.5, 22.0)),
        ] {
            let pixels = picture(Some(cell), light, &mut noise);
            let found = finder.find(&frame(&pixels)).unwrap();
            assert_eq!(found.len(), 1, "{found:?}");
            let c = found[0];
            assert!(
                (c.x_px - cell.0).abs() < 0.2 && (c.y_px - cell.1).abs() < 0.2,
                "{c:?}"
            );
            let area = std::f64::consts::PI * 14.0 * 10.0;
            assert!((c.area_px / area - 1.0).abs() < 0.05, "{c:?}");
            let (length_px, width_px) = c.axes_px();
            assert!(
                (length_px - 28.0).abs() < 0.6 && (width_px - 20.0).abs() < 0.6,
                "{c:?}"
            );
            assert!((15.0..32.0).contains(&(c.body_grey / light)), "{c:?}");
            assert!(c.dark && !c.at_border && !c.in_contact, "{c:?}");
        }
    }

    #[test]
    fn an_empty_channel_has_no_cell() {
        let mut noise = Random::new(5);
        let mut finder = taught(&mut noise);
        for light in [0.9, 1.0, 1.1] {
            let pixels = picture(None, light, &mut noise);
            assert!(finder.find(&frame(&pixels)).unwrap().is_empty());
        }
    }

    #[test]
    fn a_frame_of_another_size_a_short_one_and_a_missing_background_are_errors() {
        let mut noise = Random::new(6);
        let pixels = picture(None, 1.0, &mut noise);
        let mut finder = CellFinder::new(SIZE.0, SIZE.1, CellConfig::default()).unwrap();
        assert_eq!(finder.find(&frame(&pixels)), Err(CellError::NoBackground));
        let wrong = Frame {
            width: 10,
            ..frame(&pixels)
        };
        assert!(matches!(
            finder.take_background(&wrong),
            Err(CellError::Size { width: 10, .. })
        ));
        let short = frame(&pixels[..100]);
        assert!(matches!(
            finder.take_background(&short),
            Err(CellError::Truncated { pixels: 100, .. })
        ));
        let bad = CellConfig {
            min_area_px: f64::NAN,
            ..CellConfig::default()
        };
        assert_eq!(CellFinder::new(8, 8, bad).unwrap_err().key, "min_area_px");
    }
}
