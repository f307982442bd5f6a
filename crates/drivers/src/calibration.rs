//! From pixels to micrometres along the channel.

use cellpos_rig::PictureScale;
use cellpos_vision::Cell;
use serde::{Deserialize, Serialize};

/// An axis of the picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Axis {
    /// Along the rows.
    #[default]
    X,
    /// Along the columns.
    Y,
}

/// From pixels to micrometres along the channel.
///
/// With `a` the coordinate along [`Calibration::axis`] and `b` the other one,
/// `position_um = sign * pixel_um * ((a - origin_px) cos(tilt) + (b - origin_across_px) sin(tilt))`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Calibration {
    /// Size of a pixel in the object plane, um.
    pub pixel_um: f64,
    /// Coordinate of position 0 along the axis, px.
    pub origin_px: f64,
    /// +1 when the coordinate rises in the direction in which the bead moves when the PZT extends, else -1.
    pub sign: f64,
    /// Axis of the picture that the channel follows.
    #[serde(default)]
    pub axis: Axis,
    /// Angle from that axis to the channel, positive towards the rising other coordinate, -45 to 45 degrees.
    #[serde(default)]
    pub tilt_deg: f64,
    /// Coordinate of position 0 across the axis, px; of no effect without a tilt.
    #[serde(default)]
    pub origin_across_px: f64,
}

impl Calibration {
    /// A channel that lies exactly along the rows.
    pub fn along_rows(pixel_um: f64, origin_px: f64, sign: f64) -> Self {
        Self {
            pixel_um,
            origin_px,
            sign,
            axis: Axis::X,
            tilt_deg: 0.0,
            origin_across_px: 0.0,
        }
    }

    /// The first invalid value: key, value, and what would be right.
    pub fn problem(&self) -> Option<(&'static str, f64, &'static str)> {
        let pixel_ok = (1e-4..=1e3).contains(&self.pixel_um);
        let sign_ok = self.sign.abs() == 1.0;
        let tilt_ok = self.tilt_deg.abs() <= 45.0;
        [
            (
                pixel_ok,
                "pixel_um",
                self.pixel_um,
                "between 0.0001 and 1000 um",
            ),
            (
                self.origin_px.is_finite(),
                "origin_px",
                self.origin_px,
                "a finite coordinate, px",
            ),
            (sign_ok, "sign", self.sign, "1 or -1"),
            (
                tilt_ok,
                "tilt_deg",
                self.tilt_deg,
                "between -45 and 45 degrees; beyond that take the other axis",
            ),
            (
                self.origin_across_px.is_finite(),
                "origin_across_px",
                self.origin_across_px,
                "a finite coordinate, px",
            ),
        ]
        .into_iter()
        .find_map(|(ok, key, value, must_be)| (!ok).then_some((key, value, must_be)))
    }

    /// Unit vector of the channel in the picture, in the direction of rising positions.
    fn direction(&self) -> (f64, f64) {
        let (sin, cos) = self.tilt_deg.to_radians().sin_cos();
        match self.axis {
            Axis::X => (self.sign * cos, self.sign * sin),
            Axis::Y => (self.sign * sin, self.sign * cos),
        }
    }

    fn origin(&self) -> (f64, f64) {
        match self.axis {
            Axis::X => (self.origin_px, self.origin_across_px),
            Axis::Y => (self.origin_across_px, self.origin_px),
        }
    }

    /// Position of a point of the picture, um.
    pub fn position_um(&self, x_px: f64, y_px: f64) -> f64 {
        let ((ux, uy), (ox, oy)) = (self.direction(), self.origin());
        self.pixel_um * ((x_px - ox) * ux + (y_px - oy) * uy)
    }

    /// The point of the picture at a position along the channel, with the coordinate across the axis given, px.
    pub fn point_px(&self, position_um: f64, across_px: f64) -> (f64, f64) {
        let (sin, cos) = self.tilt_deg.to_radians().sin_cos();
        let way_px = self.sign * position_um / self.pixel_um;
        let along_px = self.origin_px + (way_px - (across_px - self.origin_across_px) * sin) / cos;
        match self.axis {
            Axis::X => (along_px, across_px),
            Axis::Y => (across_px, along_px),
        }
    }

    /// Variance of a position from the covariance of the point, um^2.
    pub fn variance_um2(&self, var_x_px2: f64, var_y_px2: f64, cov_xy_px2: f64) -> f64 {
        let (ux, uy) = self.direction();
        let var_px2 = ux * ux * var_x_px2 + 2.0 * ux * uy * cov_xy_px2 + uy * uy * var_y_px2;
        var_px2 * self.pixel_um * self.pixel_um
    }

    /// Length of a cell along the channel, um.
    pub fn length_um(&self, cell: &Cell) -> f64 {
        self.pixel_um * cell.extent_px(self.direction())
    }

    /// Area of a cell, um^2.
    pub fn area_um2(&self, cell: &Cell) -> f64 {
        self.pixel_um * self.pixel_um * cell.area_px
    }

    /// Standard deviation of [`Calibration::length_um`], um: that of the picture, not of the pixel size.
    pub fn length_sd_um(&self, cell: &Cell) -> f64 {
        self.pixel_um * cell.extent_sd_px(self.direction())
    }

    /// Standard deviation of [`Calibration::area_um2`], um^2: that of the picture, not of the pixel size.
    pub fn area_sd_um2(&self, cell: &Cell) -> f64 {
        self.pixel_um * self.pixel_um * cell.var_area_px2.sqrt()
    }

    /// A speed along the channel (um/s), in the picture, px/s.
    pub fn flow_px_per_s(&self, um_per_s: f64) -> (f64, f64) {
        let (ux, uy) = self.direction();
        let px_per_s = um_per_s / self.pixel_um;
        (px_per_s * ux, px_per_s * uy)
    }

    /// The channel in a picture to first order, on the line through the origin.
    pub fn picture_scale(&self) -> PictureScale {
        let (ox, oy) = self.origin();
        let [first_um, next_um] = [0.0, 1.0].map(|along| match self.axis {
            Axis::X => self.position_um(along, oy),
            Axis::Y => self.position_um(ox, along),
        });
        PictureScale {
            first_um,
            um_per_px: next_um - first_um,
            upright: self.axis == Axis::Y,
        }
    }

    /// Lowest and highest position in a picture, um.
    pub fn field_um(&self, width_px: usize, height_px: usize) -> [f64; 2] {
        let (last_x, last_y) = (
            width_px.saturating_sub(1) as f64,
            height_px.saturating_sub(1) as f64,
        );
        // Along the channel's axis, on the line through the origin: the corners of a tilted picture are not channel.
        let (ox, oy) = self.origin();
        let ends = match self.axis {
            Axis::X => [(0.0, oy), (last_x, oy)],
            Axis::Y => [(ox, 0.0), (ox, last_y)],
        }
        .map(|(x, y)| self.position_um(x, y));
        [ends[0].min(ends[1]), ends[0].max(ends[1])]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STRAIGHT: Calibration = Calibration {
        pixel_um: 0.1,
        origin_px: 100.0,
        sign: 1.0,
        axis: Axis::X,
        tilt_deg: 0.0,
        origin_across_px: 20.0,
    };

    #[test]
    fn a_position_becomes_the_point_that_gives_it_back() {
        for axis in [Axis::X, Axis::Y] {
            for (sign, tilt_deg) in [(1.0, 0.0), (-1.0, 12.0), (1.0, -30.0)] {
                let calibration = Calibration {
                    axis,
                    sign,
                    tilt_deg,
                    origin_across_px: 7.0,
                    ..STRAIGHT
                };
                let (x, y) = calibration.point_px(-3.5, 20.0);
                assert_eq!(if axis == Axis::X { y } else { x }, 20.0);
                assert!((calibration.position_um(x, y) + 3.5).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn axis_and_sign_choose_which_way_the_bead_moves() {
        let c = STRAIGHT;
        assert_eq!(c.position_um(130.0, 77.0), 3.0);
        let c = Calibration { sign: -1.0, ..c };
        assert_eq!(c.position_um(130.0, 77.0), -3.0);
        let c = Calibration {
            axis: Axis::Y,
            ..STRAIGHT
        };
        assert_eq!(c.position_um(77.0, 130.0), 3.0);
        assert_eq!(c.field_um(40, 301), [-10.0, 20.0]);
        assert_eq!(c.flow_px_per_s(5.0), (0.0, 50.0));
        assert_eq!(c.variance_um2(1.0, 4.0, 0.5), 4.0 * 0.1 * 0.1);
    }

    #[test]
    fn motion_along_a_tilted_channel_is_measured_in_full_and_motion_across_it_not_at_all() {
        for axis in [Axis::X, Axis::Y] {
            for sign in [-1.0, 1.0] {
                let c = Calibration {
                    axis,
                    sign,
                    tilt_deg: 20.0,
                    ..STRAIGHT
                };
                let (vx, vy) = c.flow_px_per_s(30.0);
                let (ox, oy) = c.origin();
                assert!((c.position_um(ox + 0.1 * vx, oy + 0.1 * vy) - 3.0).abs() < 1e-12);
                assert!(c.position_um(ox - vy, oy + vx).abs() < 1e-12);
                // Isotropic noise does not change with the angle.
                assert!((c.variance_um2(2.0, 2.0, 0.0) - 0.02).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn values_that_cannot_be_are_named() {
        assert_eq!(STRAIGHT.problem(), None);
        for (bad, key) in [
            (
                Calibration {
                    pixel_um: 0.0,
                    ..STRAIGHT
                },
                "pixel_um",
            ),
            (
                Calibration {
                    sign: 0.5,
                    ..STRAIGHT
                },
                "sign",
            ),
            (
                Calibration {
                    tilt_deg: 60.0,
                    ..STRAIGHT
                },
                "tilt_deg",
            ),
            (
                Calibration {
                    origin_px: f64::NAN,
                    ..STRAIGHT
                },
                "origin_px",
            ),
        ] {
            assert_eq!(bad.problem().map(|p| p.0), Some(key));
        }
    }
}
