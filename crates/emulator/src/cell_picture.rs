//! The picture of a cell and its channel: an ellipse with a soft edge, a rim and a halo, between two walls.
//!
//! The body is a step blurred by the microscope; defocus adds blur. Out of focus the edge's phase also shows, as the second derivative of
//! that step (transport of intensity). It gives a rim just inside the edge and a halo of the other sign just outside. They swap on the
//! other side of the focus.

use crate::cell::CellConfig;
use crate::config::WorldConfig;

/// Standard deviation of the microscope's soft edge in focus, um.
const BLUR_UM: f64 = 0.2;
/// Standard deviation of the blur that defocus adds, per um (numerical aperture of about 0.5).
const BLUR_PER_FOCUS: f64 = 0.15;
/// Distance from the focus at which the edge's phase shows with the contrast of [`CellConfig::halo`], um.
const HALO_FOCUS_UM: f64 = 1.0;
/// Largest contrast of the phase, in multiples of that.
const MOST_PHASE: f64 = 2.0;
/// Additional contrast of the rim, as a fraction of the body's, and its distance from the edge in edge widths.
const RIM: (f64, f64) = (0.3, 3.0);
/// Distance from the edge beyond which nothing is drawn, in edge widths.
const REACH: f64 = 5.0;
/// Steps of the edge's table per edge width.
const STEPS: f64 = 32.0;
/// Light lost at a wall, grey levels, and the room between the cell and a wall, um.
const WALL_GREY: f64 = 35.0;
const WALL_ROOM_UM: f64 = 0.8;

/// Half axes of a cell, along and across the channel, px.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct HalfAxes {
    along_px: f32,
    across_px: f32,
    /// Square of the share of both axes within which there is neither edge nor rim.
    deep2: f32,
}

/// Draws cells, in units of the body's contrast.
#[derive(Debug, Clone)]
pub(crate) struct CellPicture {
    blur_px: f32,
    /// Contrast well inside.
    body: f32,
    /// Values over the distance from the edge, from `-REACH` to `REACH` edge widths.
    edge: Vec<f32>,
}

impl CellPicture {
    pub(crate) fn new(pixel_um: f64, cell: &CellConfig) -> Self {
        let blur_um = BLUR_UM.hypot(BLUR_PER_FOCUS * cell.focus_um);
        let out_of_focus = (cell.focus_um / HALO_FOCUS_UM).clamp(-MOST_PHASE, MOST_PHASE);
        let phase = cell.halo * out_of_focus;
        let steps = (2.0 * REACH * STEPS) as usize;
        let edge = (0..=steps)
            .map(|k| {
                let widths = k as f64 / STEPS - REACH;
                let rim = (-0.5 * (widths + RIM.1).powi(2)).exp();
                // The logistic function with the slope of a Gaussian's integral.
                let body = 1.0 / (1.0 + (1.702 * widths).exp());
                // Extremes of 1 and -1, one width on either side of the edge.
                let lobes = -widths * (0.5 - 0.5 * widths * widths).exp();
                (cell.body * (body + RIM.0 * rim) + phase * lobes) as f32
            })
            .collect();
        Self {
            blur_px: (blur_um / pixel_um) as f32,
            body: cell.body as f32,
            edge,
        }
    }

    /// The half axes of a cell of a length and a width, px.
    pub(crate) fn half_axes(&self, length_px: f64, width_px: f64) -> HalfAxes {
        let (along_px, across_px) = (0.5 * length_px as f32, 0.5 * width_px as f32);
        let deep = 1.0 - REACH as f32 * self.blur_px / along_px.min(across_px);
        HalfAxes {
            along_px,
            across_px,
            deep2: deep.max(0.0) * deep.max(0.0),
        }
    }

    /// Standard deviation of the soft edge, px.
    pub(crate) fn blur_px(&self) -> f32 {
        self.blur_px
    }

    /// Distance from the middle beyond which a cell draws nothing, along and across, px.
    pub(crate) fn reach_px(&self, axes: HalfAxes) -> (f32, f32) {
        let edge = REACH as f32 * self.blur_px;
        (axes.along_px + edge, axes.across_px + edge)
    }

    /// Share of the body's contrast at a distance from the middle, along and across, px.
    pub(crate) fn value(&self, axes: HalfAxes, dx: f32, dy: f32) -> f32 {
        let (u, v) = (dx / axes.along_px, dy / axes.across_px);
        let r2 = u * u + v * v;
        if r2 < axes.deep2 {
            return self.body;
        }
        let (gx, gy) = (u / axes.along_px, v / axes.across_px);
        let slope2 = gx * gx + gy * gy;
        // Distance from the ellipse, (r - 1) / |grad r|: to first order, exact for a circle.
        let widths = if slope2 > 0.0 {
            (r2 - r2.sqrt()) / (slope2.sqrt() * self.blur_px)
        } else {
            -(REACH as f32)
        };
        let place = (widths + REACH as f32) * STEPS as f32;
        if place <= 0.0 {
            return self.body;
        }
        self.edge.get(place as usize).copied().unwrap_or(0.0)
    }
}

/// Grey levels that the channel's walls take from a pixel, with the pixel's number, if above zero. Outside, the walls are as far apart as
/// the cell at rest is wide; in the constriction, as the least stretched cell.
pub(crate) fn walls(config: &WorldConfig, cell: &CellConfig) -> Vec<(usize, f32)> {
    let blur_um = BLUR_UM.max(config.pixel_um);
    let inside_um = cell.width_um(cell.rest_um * cell.stretch_first.min(cell.stretch_last));
    let (wide_um, narrow_um) = (0.5 * cell.rest_um, 0.5 * inside_um);
    let mut walls = Vec::new();
    for row in 0..config.height_px {
        for column in 0..config.width_px {
            let inside = cell.inside(config.um_from_px(f64::from(column)));
            let y_um = (f64::from(row) - config.origin_y_px()).abs() * config.pixel_um;
            let wall_um = wide_um + (narrow_um - wide_um) * inside + WALL_ROOM_UM;
            let grey = WALL_GREY * (-0.5 * ((y_um - wall_um) / blur_um).powi(2)).exp();
            if grey > 0.2 {
                let number = usize::from(row) * usize::from(config.width_px) + usize::from(column);
                walls.push((number, grey as f32));
            }
        }
    }
    walls
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_of_the_contrast_lies_on_the_ellipse_and_all_of_it_well_inside() {
        let in_focus = CellConfig {
            focus_um: 0.0,
            ..CellConfig::default()
        };
        let picture = CellPicture::new(0.2, &in_focus);
        let axes = picture.half_axes(120.0, 24.0);
        for degrees in 0..90 {
            let (sin, cos) = f32::to_radians(degrees as f32).sin_cos();
            let on = picture.value(axes, 60.0 * cos, 12.0 * sin);
            assert!((on - 0.5).abs() < 0.03, "{degrees}: {on}");
            assert!((picture.value(axes, 20.0 * cos, 4.0 * sin) - 1.0).abs() < 0.01);
        }
        let (x, y) = picture.reach_px(axes);
        assert!(picture.value(axes, x, 0.0) < 1e-3 && picture.value(axes, 0.0, y) < 1e-3);
        assert_eq!(picture.value(axes, 0.0, 0.0), 1.0);
    }

    #[test]
    fn the_walls_leave_room_for_the_cell_and_come_closer_in_the_constriction() {
        let config = WorldConfig {
            pixel_um: 0.2,
            height_px: 64,
            ..WorldConfig::ideal()
        };
        let cell = CellConfig::default();
        let walls = walls(&config, &cell);
        let darkest = |x_um: f64| {
            let column = config.px_from_um(x_um).round() as usize;
            let upper = walls
                .iter()
                .filter(|(number, _)| number % 256 == column && number / 256 < 32);
            let (number, _) = upper.max_by(|a, b| a.1.total_cmp(&b.1)).unwrap();
            (config.origin_y_px() - (number / 256) as f64) * 0.2
        };
        assert!((darkest(-10.0) - 4.8).abs() < 0.15, "{}", darkest(-10.0));
        let narrow = 0.5 * cell.width_um(8.0 * 2.86) + 0.8;
        assert!((darkest(12.0) - narrow).abs() < 0.15, "{}", darkest(12.0));
    }
}
