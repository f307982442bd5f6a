//! Time and error of measuring a cell in a whole frame, compared with centroid and moments of the pixels beyond the threshold.
//! Run: `cargo bench -p cellpos-benches --bench cell_fix`.

use cellpos_emulator::{CellConfig, World, WorldConfig};
use cellpos_plant::Model;
use cellpos_vision::{CellFinder, Frame, Pixels};
use std::time::Instant;

const FRAMES: usize = 2000;
const EMPTY: usize = 100;
const WIDTH: usize = 256;
const HEIGHT: usize = 96;

/// A frame with the true place, length and area, px.
struct Scene {
    pixels: Vec<u8>,
    truth: [f64; 3],
}

fn main() {
    let build = if cfg!(debug_assertions) {
        "DEBUG BUILD"
    } else {
        "optimised build"
    };
    println!(
        "conditions: emulated frames of {WIDTH} x {HEIGHT} px with walls, cell of 40 px at rest, contrast 80, noise 1.9 grey levels,\n\
         \x20           background of {EMPTY} frames, {FRAMES} frames each, one thread, {build}"
    );
    println!(
        "{:40} {:>9} {:>9} {:>9} {:>10} {:>9} {:>9}",
        "method", "median us", "p99 us", "max us", "place px", "length %", "area %"
    );
    for stretch in [1.0, 2.0, 3.8] {
        let config = world(stretch);
        let scenes = scenes(&config, stretch);
        let empty = World::empty_frames(&config, EMPTY).expect("a valid world");
        let mut finder =
            CellFinder::new(WIDTH, HEIGHT, Default::default()).expect("valid settings");
        for pixels in &empty {
            finder.take_background(&frame(pixels)).expect("one size");
        }
        let mean: Vec<f64> = (0..WIDTH * HEIGHT)
            .map(|k| empty.iter().map(|p| f64::from(p[k])).sum::<f64>() / EMPTY as f64)
            .collect();
        let threshold = 5.0 * finder.noise_grey();
        run(
            &format!("outline (this crate), stretch {stretch}"),
            &scenes,
            |s| {
                let cell = finder.find(&frame(&s.pixels)).ok()?.first().copied()?;
                Some([cell.x_px, cell.extent_px((1.0, 0.0)), cell.area_px])
            },
        );
        run(
            &format!("thresholded pixels, stretch {stretch}"),
            &scenes,
            |s| thresholded(&s.pixels, &mean, threshold),
        );
    }
}

fn frame(pixels: &[u8]) -> Frame<'_> {
    Frame {
        width: WIDTH,
        height: HEIGHT,
        pixels: Pixels::Mono8(pixels),
    }
}

/// A cell that has its length from the start and keeps it.
fn world(stretch: f64) -> WorldConfig {
    WorldConfig {
        pixel_um: 0.2,
        height_px: HEIGHT as u16,
        cell: Some(CellConfig {
            entry_um: -1000.0,
            stretch_first: stretch,
            stretch_last: stretch,
            loading_s: 1e-4,
            ..CellConfig::default()
        }),
        ..WorldConfig::default()
    }
}

fn scenes(config: &WorldConfig, stretch: f64) -> Vec<Scene> {
    let mut world = World::new(config, &Model::eq6(), 0).expect("a valid world");
    let mut scenes = Vec::new();
    let mut pixels = Vec::new();
    let length_px = 40.0 * stretch;
    let area_px = std::f64::consts::FRAC_PI_4 * 40.0 * 40.0 * stretch.sqrt();
    while scenes.len() < FRAMES {
        world.advance_to(world.now_ns() + 500_000, config.neutral_um);
        while let Some(info) = world.take_frame(&mut pixels) {
            // The first frames still see it stretch.
            if info.id > 10 {
                scenes.push(Scene {
                    pixels: pixels.clone(),
                    truth: [config.px_from_um(info.true_um), length_px, area_px],
                });
            }
        }
    }
    scenes
}

/// Centroid, length and area of the pixels beyond the threshold, as `regionprops` of image libraries gives them.
fn thresholded(pixels: &[u8], mean: &[f64], threshold: f64) -> Option<[f64; 3]> {
    let [mut n, mut sx, mut sxx] = [0.0; 3];
    for (k, (p, m)) in pixels.iter().zip(mean).enumerate() {
        if (f64::from(*p) - m).abs() > threshold {
            let x = (k % WIDTH) as f64;
            n += 1.0;
            sx += x;
            sxx += x * x;
        }
    }
    let x = sx / n;
    (n > 0.0).then(|| [x, 4.0 * (sxx / n - x * x + 1.0 / 12.0).sqrt(), n])
}

fn run(name: &str, scenes: &[Scene], mut measure: impl FnMut(&Scene) -> Option<[f64; 3]>) {
    let mut times_us = Vec::with_capacity(scenes.len());
    let (mut squares, mut sums, mut n) = (0.0, [0.0; 2], 0.0);
    for scene in scenes {
        let start = Instant::now();
        let found = measure(scene);
        times_us.push(start.elapsed().as_secs_f64() * 1e6);
        if let Some([x, length, area]) = found {
            n += 1.0;
            squares += (x - scene.truth[0]).powi(2);
            sums[0] += length / scene.truth[1] - 1.0;
            sums[1] += area / scene.truth[2] - 1.0;
        }
    }
    times_us.sort_by(f64::total_cmp);
    let at = |share: f64| times_us[((times_us.len() - 1) as f64 * share) as usize];
    println!(
        "{name:40} {:9.1} {:9.1} {:9.1} {:10.4} {:9.2} {:9.2}",
        at(0.5),
        at(0.99),
        at(1.0),
        f64::sqrt(squares / n),
        100.0 * sums[0] / n,
        100.0 * sums[1] / n
    );
}
