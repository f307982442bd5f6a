//! One closed membrane and what is none: two cells that lie side by side with a gap.

use crate::common::Random;
use cellpos_vision::{Cell, CellConfig, CellFinder, Frame, Pixels};

const WIDTH: usize = 140;
const HEIGHT: usize = 70;
const NOISE: f64 = 1.2;
/// Standard deviation of a soft edge, px.
const EDGE_PX: f64 = 0.8;
const CONTRAST: f64 = -40.0;

fn frame(pixels: &[u8]) -> Frame<'_> {
    Frame {
        width: WIDTH,
        height: HEIGHT,
        pixels: Pixels::Mono8(pixels),
    }
}

/// What is found of a contrast by place, in grey levels.
fn found(contrast: &dyn Fn(f64, f64) -> f64, random: &mut Random) -> Vec<Cell> {
    let mut picture = |with: bool| -> Vec<u8> {
        (0..WIDTH * HEIGHT)
            .map(|k| {
                let (x, y) = ((k % WIDTH) as f64, (k / WIDTH) as f64);
                let own = if with { contrast(x, y) } else { 0.0 };
                (90.0 + own + NOISE * random.normal()).round() as u8
            })
            .collect()
    };
    let mut finder = CellFinder::new(WIDTH, HEIGHT, CellConfig::default()).unwrap();
    for _ in 0..20 {
        finder.take_background(&frame(&picture(false))).unwrap();
    }
    finder.find(&frame(&picture(true))).unwrap().to_vec()
}

/// Share of a pixel within an edge, `d` px outside of it.
fn within(d: f64) -> f64 {
    1.0 / (1.0 + (1.7 * d / EDGE_PX).exp())
}

/// Distance from an ellipse to first order, px: positive outside.
fn from_ellipse((x, y): (f64, f64), (a, b): (f64, f64)) -> f64 {
    let (u, v) = (x / a, y / b);
    let r = f64::hypot(u, v).max(1e-6);
    (r - 1.0) * r / f64::hypot(u / a, v / b)
}

/// Two cells side by side, one turned against the other: between their tips the halos of both add up, and the outline goes over the
/// gap, where there is no edge.
#[test]
fn an_outline_that_goes_over_a_gap_is_not_one_good_cell() {
    let mut random = Random(31);
    let (mut whole, mut pairs) = (0, 0);
    const N: usize = 60;
    for _ in 0..N {
        let at = (60.0 + 20.0 * random.uniform(), 33.0 + random.uniform());
        let half = (18.0 + 3.0 * random.uniform(), 5.0 + random.uniform());
        let (apart, turned) = (4.0 + random.uniform(), 0.02 + 0.08 * random.uniform());
        let from = |x: f64, y: f64, side: f64| {
            let (dx, dy) = (x - at.0, y - at.1);
            let own = (dx, dy - side * (apart + turned * (dx + half.0)));
            from_ellipse(own, half)
        };
        let halo = |d: f64| 0.6 * CONTRAST * (1.0 - within(d)) * (-0.5 * (d / 3.0).powi(2)).exp();
        let drawn = |d: &[f64]| {
            let nearest = d.iter().copied().fold(f64::MAX, f64::min);
            let halos: f64 = d.iter().map(|d| halo(*d)).sum();
            CONTRAST * within(nearest) - halos * (1.0 - within(nearest))
        };
        let good = |found: Vec<Cell>| {
            let good =
                |c: &Cell| !c.at_border && !c.in_contact && c.area_px > 1.5 * half.0 * half.1;
            found.into_iter().filter(good).count()
        };
        let one = |x: f64, y: f64| drawn(&[from(x, y, 0.0)]);
        whole += good(found(&one, &mut random));
        let two = |x: f64, y: f64| drawn(&[from(x, y, -1.0), from(x, y, 1.0)]);
        pairs += good(found(&two, &mut random));
    }
    println!("{whole} of {N} whole cells good, {pairs} of {N} pairs");
    assert_eq!(whole, N);
    assert_eq!(pairs, 0);
}
