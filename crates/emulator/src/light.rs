//! Uneven light of the empty channel: a slope, dark corners, a wall of the channel, specks of dust.

use crate::config::WorldConfig;
use cellpos_numeric::Random;

/// Ranges of the light lost at the middle of a speck, grey levels, and of its size (standard deviation), um.
const DUST_GREY: (f64, f64) = (5.0, 20.0);
const DUST_UM: (f64, f64) = (0.15, 0.4);
/// Width of the line by which a wall shows (standard deviation), um, and the room between it and the outermost bead, um.
const WALL_UM: f64 = 0.12;
const WALL_ROOM_UM: f64 = 0.3;

/// Grey level of each pixel, rows contiguous; empty if the light is even.
pub(crate) fn empty_channel(config: &WorldConfig) -> Vec<f32> {
    let it = config.imperfections();
    if it.has_even_light() || config.background_grey == 0.0 {
        return Vec::new();
    }
    let (width, height) = (usize::from(config.width_px), usize::from(config.height_px));
    let mut luck = Random::stream(config.seed, 33);
    let mut between = |(low, high): (f64, f64)| low + (high - low) * luck.uniform();
    let specks: Vec<[f64; 4]> = (0..it.dust)
        .map(|_| {
            let (x, y) = (between((0.0, width as f64)), between((0.0, height as f64)));
            let sigma_px = between(DUST_UM) / config.pixel_um;
            [x, y, 0.5 / (sigma_px * sigma_px), between(DUST_GREY)]
        })
        .collect();
    let (sin, cos) = it.tilt_deg.to_radians().sin_cos();
    // One wall, on the far side: the channel is wider than the picture is high.
    let wall_um = it.lateral_um + config.bead_radius_um + WALL_ROOM_UM;
    let level = |k: usize| {
        let (x, y) = ((k % width) as f64, (k / width) as f64);
        let (dx, dy) = (x - config.origin_x_px(), y - config.origin_y_px());
        let (u, v) = (dx / width as f64, dy / height as f64);
        let light = (1.0 + it.light_slope * u) * (1.0 - 2.0 * it.vignette * (u * u + v * v));
        let across_um = config.pixel_um * (dy * cos - dx * sin);
        let from_wall = (across_um - wall_um) / WALL_UM;
        let wall = it.wall_grey * (-0.5 * from_wall * from_wall).exp();
        let dust: f64 = specks
            .iter()
            .map(|[px, py, k, grey]| grey * (-k * ((x - px).powi(2) + (y - py).powi(2))).exp())
            .sum();
        (config.background_grey * light - wall - dust).max(0.0) as f32
    };
    (0..width * height).map(level).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_light_has_its_slope_its_corners_its_wall_and_its_dust() {
        let only = |config: WorldConfig| {
            let grey = empty_channel(&WorldConfig {
                ideal: true,
                ..config
            });
            move |x: usize, y: usize| f64::from(grey[y * 256 + x])
        };
        let default = WorldConfig::ideal;
        assert!(empty_channel(&default()).is_empty());
        let at = only(WorldConfig {
            light_slope: Some(0.2),
            ..default()
        });
        assert!((at(255, 16) - at(0, 16) - 20.0).abs() < 0.2);
        let at = only(WorldConfig {
            vignette: Some(0.1),
            ..default()
        });
        assert!((at(128, 16) - 100.0).abs() < 0.1 && (at(0, 0) - 90.0).abs() < 0.5);
        let at = only(WorldConfig {
            wall_grey: Some(30.0),
            tilt_deg: Some(1.0),
            ..default()
        });
        let darkest = |x: usize| (0..32).min_by(|&a, &b| at(x, a).total_cmp(&at(x, b)));
        // 1.05 um from the middle line, which rises by 1 degree: 2.2 pixels over half the width.
        assert_eq!((darkest(128), darkest(5)), (Some(26), Some(24)));
        let at = only(WorldConfig {
            dust: Some(5),
            ..default()
        });
        let dark = (0..32 * 256).filter(|k| at(k % 256, k / 256) < 97.0);
        assert!((20..2000).contains(&dark.count()));
    }
}
