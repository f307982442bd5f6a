//! A channel whose walls were moved, each by another way, seen by a camera with a pattern of its own: cells are found as before.

use crate::common::Random;
use cellpos_vision::{Cell, CellConfig, CellFinder, Frame, Pixels};

const WIDTH: usize = 250;
const HEIGHT: usize = 80;
/// Noise of a frame, and of the pattern that all frames have, grey levels.
const NOISE: f64 = 1.1;
const PATTERN: f64 = 2.0;
/// Half axes of the cell, px.
const HALF: (f64, f64) = (18.0, 11.0);

/// Where the two walls are, px down; by how much they are lower at the right end; and how wide their fringes are drawn.
#[derive(Clone, Copy)]
struct Walls {
    upper: f64,
    lower: f64,
    turned: f64,
    focus: f64,
}

const AT_REST: Walls = Walls {
    upper: 12.0,
    lower: 66.0,
    turned: 0.0,
    focus: 1.0,
};

/// A dark line with fringes towards the channel, `d` px from the wall.
fn wall(d: f64) -> f64 {
    let fringe = -30.0 * (-0.5 * (d / 2.5).powi(2)).exp();
    let halo = 18.0 * (-0.5 * ((d - 7.0) / 4.0).powi(2)).exp();
    fringe + halo
}

fn pattern() -> Vec<f64> {
    let mut random = Random(77);
    (0..WIDTH * HEIGHT)
        .map(|_| PATTERN * random.normal())
        .collect()
}

fn picture(walls: Walls, cell: Option<(f64, f64)>, random: &mut Random) -> Vec<u8> {
    let pattern = pattern();
    let pixel = |(k, own): (usize, &f64)| {
        let (x, y) = ((k % WIDTH) as f64, (k / WIDTH) as f64);
        let down = walls.turned * (x / WIDTH as f64 - 0.5);
        let upper = wall((y - walls.upper - down) / walls.focus);
        let lower = wall((walls.lower + down - y) / walls.focus);
        let mut grey = 80.0 + upper + lower + own;
        if let Some((cx, cy)) = cell {
            let r = f64::hypot((x - cx) / HALF.0, (y - cy) / HALF.1);
            grey -= 40.0 / (1.0 + (1.7 * (r - 1.0) * HALF.1 / 0.8).exp());
        }
        (grey + NOISE * random.normal()).round().clamp(0.0, 255.0) as u8
    };
    pattern.iter().enumerate().map(pixel).collect()
}

fn frame(pixels: &[u8]) -> Frame<'_> {
    Frame {
        width: WIDTH,
        height: HEIGHT,
        pixels: Pixels::Mono8(pixels),
    }
}

fn finder(random: &mut Random) -> CellFinder {
    let mut finder = CellFinder::new(WIDTH, HEIGHT, CellConfig::default()).unwrap();
    for _ in 0..40 {
        let pixels = picture(AT_REST, None, random);
        finder.take_background(&frame(&pixels)).unwrap();
    }
    finder
}

fn good(found: &[Cell]) -> Vec<Cell> {
    let good = found.iter().filter(|c| !c.at_border && !c.in_contact);
    good.copied().collect()
}

#[test]
fn a_cell_between_walls_that_moved_each_by_another_way_is_found_whole() {
    let mut random = Random(21);
    let mut finder = finder(&mut random);
    let area = std::f64::consts::PI * HALF.0 * HALF.1;
    let rows = [
        ("at rest", AT_REST),
        (
            "apart",
            Walls {
                upper: 11.0,
                lower: 67.5,
                ..AT_REST
            },
        ),
        (
            "moved and turned",
            Walls {
                upper: 14.8,
                lower: 68.4,
                turned: 0.5,
                ..AT_REST
            },
        ),
        (
            "another focus",
            Walls {
                upper: 13.9,
                lower: 68.2,
                turned: 0.4,
                focus: 1.15,
            },
        ),
    ];
    for (what, walls) in rows {
        const N: usize = 40;
        let (mut whole, mut false_cells) = (0, 0);
        for _ in 0..N {
            let place = (
                60.0 + 130.0 * random.uniform(),
                36.0 + 7.0 * random.uniform(),
            );
            let pixels = picture(walls, Some(place), &mut random);
            let found = good(finder.find(&frame(&pixels)).unwrap());
            let own = |c: &&Cell| f64::hypot(c.x_px - place.0, c.y_px - place.1) < 1.0;
            let is_whole = |c: &Cell| (c.area_px / area - 1.0).abs() < 0.02;
            whole += usize::from(found.iter().find(own).is_some_and(is_whole));
            false_cells += found.iter().filter(|c| !own(c)).count();
            let empty = picture(walls, None, &mut random);
            false_cells += good(finder.find(&frame(&empty)).unwrap()).len();
        }
        println!("{what}: {whole} of {N} whole, {false_cells} false");
        assert!(whole * 20 >= 19 * N, "{what}: {whole} of {N}");
        assert_eq!(false_cells, 0, "{what}");
    }
}

/// The scatter of whole grey levels is no whole level: a finder that is given a picture of the empty channel learns the noise.
#[test]
fn noise_learnt_from_frames_of_whole_grey_levels_is_that_of_the_pixels() {
    for noise in [0.6_f64, 0.9, 1.1, 1.5, 2.4] {
        let mut random = Random(22);
        let mut drawn = || -> Vec<u8> {
            (0..WIDTH * HEIGHT)
                .map(|_| (80.3 + noise * random.normal()).round() as u8)
                .collect()
        };
        let mut finder = CellFinder::new(WIDTH, HEIGHT, CellConfig::default()).unwrap();
        finder
            .set_background(&frame(&vec![80; WIDTH * HEIGHT]))
            .unwrap();
        for _ in 0..10 {
            let pixels = drawn();
            finder.learn_noise(&frame(&pixels)).unwrap();
        }
        let ratio = finder.noise_grey() / f64::hypot(noise, (1.0_f64 / 12.0).sqrt());
        println!("noise {noise}: {ratio:.3} of it");
        assert!((0.85..1.15).contains(&ratio), "{noise}: {ratio}");
    }
}
