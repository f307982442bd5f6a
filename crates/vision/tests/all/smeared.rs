//! Cells that move while the frame is exposed: the outline is that of the cell at rest.

use crate::common::Random;
use cellpos_vision::{Cell, CellConfig, CellFinder, Frame, Pixels};

const WIDTH: usize = 128;
const HEIGHT: usize = 96;

/// A cell: half axes, px, and what it shows at a distance outside its outline, px.
struct Drawn {
    name: &'static str,
    half_px: (f64, f64),
    contrast: fn(f64) -> f64,
    /// Largest error of the area. The rim of a small cell is hardly narrower than the way, and the profile at rest is known less.
    most: f64,
}

/// A dark rim, a weak body and a bright halo, as a bead or a cell out of phase has them.
fn rim_and_halo(d: f64) -> f64 {
    let lobe = |at: f64, sd: f64| (-0.5 * ((d - at) / sd).powi(2)).exp();
    let body = -4.0 / (1.0 + (2.0 * d).exp());
    body - 24.0 * lobe(-1.8, 1.2) + 5.0 * lobe(1.8, 1.2)
}

/// A body that absorbs, with a soft edge.
fn body(d: f64) -> f64 {
    -30.0 / (1.0 + (2.0 * d).exp())
}

const CELLS: [Drawn; 4] = [
    Drawn {
        name: "round 9 px, rim",
        half_px: (9.0, 9.0),
        contrast: rim_and_halo,
        most: 0.022,
    },
    Drawn {
        name: "round 14 px, rim",
        half_px: (14.0, 14.0),
        contrast: rim_and_halo,
        most: 0.01,
    },
    Drawn {
        name: "round 9 px, body",
        half_px: (9.0, 9.0),
        contrast: body,
        most: 0.01,
    },
    Drawn {
        name: "16 by 11 px, rim",
        half_px: (16.0, 11.0),
        contrast: rim_and_halo,
        most: 0.022,
    },
];

impl Drawn {
    /// What the cell adds at a place relative to its middle.
    fn at(&self, x: f64, y: f64) -> f64 {
        let (a, b) = self.half_px;
        let r = f64::hypot(x / a, y / b);
        let slope = f64::hypot(x / (a * a), y / (b * b)) / r.max(1e-6);
        // Distance from the outline: exact for a circle, to second order for an ellipse.
        let distance = if slope > 0.0 {
            (r - 1.0) / slope
        } else {
            -a.min(b)
        };
        (self.contrast)(distance)
    }

    /// Mean over the exposure.
    fn picture(&self, way: (f64, f64), random: &mut Random) -> Vec<u8> {
        let times = if way == (0.0, 0.0) { 1 } else { 48 };
        (0..WIDTH * HEIGHT)
            .map(|k| {
                let (x, y) = ((k % WIDTH) as f64 - 63.3, (k / WIDTH) as f64 - 47.6);
                let mean = (0..times).map(|n| {
                    let t = (f64::from(n) + 0.5) / f64::from(times) - 0.5;
                    self.at(x - t * way.0, y - t * way.1)
                });
                let grey = 120.0 + mean.sum::<f64>() / f64::from(times) + 0.5 * random.normal();
                grey.round() as u8
            })
            .collect()
    }
}

fn frame(pixels: &[u8]) -> Frame<'_> {
    Frame {
        width: WIDTH,
        height: HEIGHT,
        pixels: Pixels::Mono8(pixels),
    }
}

#[test]
fn the_area_of_a_smeared_cell_is_that_of_the_cell_at_rest() {
    let mut random = Random(17);
    let mut finder = CellFinder::new(WIDTH, HEIGHT, CellConfig::default()).unwrap();
    for _ in 0..20 {
        let empty: Vec<u8> = (0..WIDTH * HEIGHT)
            .map(|_| (120.0 + 0.5 * random.normal()).round() as u8)
            .collect();
        finder.take_background(&frame(&empty)).unwrap();
    }
    let mut failed = Vec::new();
    for cell in &CELLS {
        let mut found = |way: (f64, f64)| -> Cell {
            finder.expect_smear(way);
            let pixels = cell.picture(way, &mut random);
            let cells = finder.find(&frame(&pixels)).unwrap();
            assert_eq!(cells.len(), 1, "{} {way:?}: {cells:?}", cell.name);
            cells[0]
        };
        let rest = found((0.0, 0.0));
        for px in [3.0, 6.0] {
            for angle in [0.0_f64, 0.5, 1.6] {
                let own = found((px * angle.cos(), px * angle.sin()));
                let area = own.area_px / rest.area_px - 1.0;
                let along = |c: &Cell| c.extent_px((angle.cos(), angle.sin()));
                let length = along(&own) / along(&rest) - 1.0;
                let sigmas = (own.area_px - rest.area_px).abs() / own.var_area_px2.sqrt();
                println!(
                    "{:17} {px} px at {angle:.1} rad: area {:+.2} %, length {:+.2} %, {sigmas:.1} sigma of {:.2} %",
                    cell.name,
                    100.0 * area,
                    100.0 * length,
                    100.0 * own.var_area_px2.sqrt() / own.area_px,
                );
                if area.abs() > cell.most || sigmas > 3.0 {
                    failed.push(format!(
                        "{} {px} px at {angle}: {area:.3} {length:.3}",
                        cell.name
                    ));
                }
            }
        }
    }
    assert!(failed.is_empty(), "{failed:#?}");
}
