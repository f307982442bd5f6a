//! Cells: how well a surface is measured, and that one cell is followed and no other.

use crate::common::Random;
use cellpos_vision::{
    Cell, CellConfig, CellError, CellFinder, CellTracker, Decision, FixQuality, Frame, Pixels,
    TrackState, TrackerConfig,
};

const WIDTH: usize = 240;
const HEIGHT: usize = 64;
/// Standard deviation of the soft edge, px.
const EDGE_PX: f64 = 0.8;

/// An ellipse: middle, full length along the rows, full width, contrast.
#[derive(Clone, Copy)]
struct Drawn {
    x: f64,
    y: f64,
    length: f64,
    width: f64,
    contrast: f64,
}

impl Drawn {
    /// A round cell of 24 px.
    fn at(x: f64) -> Self {
        Drawn {
            x,
            y: 31.6,
            length: 24.0,
            width: 24.0,
            contrast: 40.0,
        }
    }

    /// The same volume, `stretch` times as long.
    fn stretched(self, stretch: f64) -> Self {
        Drawn {
            length: self.length * stretch,
            width: self.width / stretch.sqrt(),
            ..self
        }
    }

    fn area(&self) -> f64 {
        std::f64::consts::FRAC_PI_4 * self.length * self.width
    }

    fn value(&self, x: f64, y: f64) -> f64 {
        let (a, b) = (0.5 * self.length, 0.5 * self.width);
        let (u, v) = ((x - self.x) / a, (y - self.y) / b);
        let r = f64::hypot(u, v);
        let slope = f64::hypot(u / a, v / b);
        // Distance from the outline, to first order.
        let distance = if slope > 0.0 {
            (r - 1.0) * r / slope
        } else {
            -a.min(b)
        };
        self.contrast / (1.0 + (1.7 * distance / EDGE_PX).exp())
    }
}

/// A channel with a wall along it, and cells.
fn picture(cells: &[Drawn], noise: f64, random: &mut Random) -> Vec<u8> {
    (0..WIDTH * HEIGHT)
        .map(|k| {
            let (x, y) = ((k % WIDTH) as f64, (k / WIDTH) as f64);
            let wall = -30.0 * (-0.5 * (y - 58.0) * (y - 58.0)).exp();
            let light: f64 = cells.iter().map(|c| c.value(x, y)).sum();
            (110.0 + 0.1 * x + wall + light + noise * random.normal())
                .round()
                .clamp(0.0, 255.0) as u8
        })
        .collect()
}

fn frame(pixels: &[u8]) -> Frame<'_> {
    Frame {
        width: WIDTH,
        height: HEIGHT,
        pixels: Pixels::Mono8(pixels),
    }
}

fn finder(noise: f64, random: &mut Random) -> CellFinder {
    finder_with(noise, random, CellConfig::default())
}

fn finder_with(noise: f64, random: &mut Random, config: CellConfig) -> CellFinder {
    let mut finder = CellFinder::new(WIDTH, HEIGHT, config).unwrap();
    for _ in 0..40 {
        let empty = picture(&[], noise, random);
        finder.take_background(&frame(&empty)).unwrap();
    }
    finder
}

#[test]
fn length_area_and_place_are_true_to_a_fraction_of_a_pixel_and_the_variance_is_what_it_says() {
    let mut random = Random(7);
    for (noise, stretch) in [(1.5, 1.0), (1.5, 2.0), (1.5, 3.8), (4.0, 1.0), (4.0, 3.8)] {
        let mut finder = finder(noise, &mut random);
        let [mut z2x, mut z2y, mut bias, mut length, mut area] = [0.0; 5];
        const N: usize = 120;
        for _ in 0..N {
            let place = 120.0 + random.uniform();
            let cell = Drawn::at(place).stretched(stretch);
            let pixels = picture(&[cell], noise, &mut random);
            let found = finder.find(&frame(&pixels)).unwrap();
            assert_eq!(found.len(), 1, "{found:?}");
            let c: Cell = found[0];
            z2x += (c.x_px - cell.x).powi(2) / c.var_x_px2 / N as f64;
            z2y += (c.y_px - cell.y).powi(2) / c.var_y_px2 / N as f64;
            bias += (c.x_px - cell.x) / N as f64;
            length += c.extent_px((1.0, 0.0)) / cell.length / N as f64;
            area += c.area_px / cell.area() / N as f64;
        }
        eprintln!(
            "noise {noise} stretch {stretch}: error/predicted x {:.3} y {:.3}, bias {bias:.4} px, length {length:.4}, area {area:.4}",
            z2x.sqrt(),
            z2y.sqrt()
        );
        assert!((0.8..1.25).contains(&z2x.sqrt()), "{}", z2x.sqrt());
        assert!((0.8..1.35).contains(&z2y.sqrt()), "{}", z2y.sqrt());
        assert!(bias.abs() < 0.02, "{bias}");
        assert!((length - 1.0).abs() < 0.004, "{length}");
        assert!((area - 1.0).abs() < 0.008, "{area}");
    }
}

/// Differences of two measurements of a cell: place, area and length, over half of the first one's standard deviation or a
/// thousandth of the size, whichever is more (the edge in the mean profile is told to a hundredth of a pixel).
fn apart(a: &Cell, b: &Cell) -> [f64; 3] {
    let along = (1.0, 0.0);
    let (area, length) = (a.area_px, a.extent_px(along));
    [
        (a.x_px - b.x_px) / (0.5 * a.var_x_px2.sqrt()),
        (area - b.area_px) / (0.5 * a.var_area_px2.sqrt()).max(1e-3 * area),
        (length - b.extent_px(along)) / (0.5 * a.extent_sd_px(along)).max(1e-3 * length),
    ]
}

#[test]
fn an_outline_laid_through_half_of_the_rays_is_that_through_all_to_a_fraction_of_its_standard_deviation()
 {
    let mut random = Random(17);
    for (noise, stretch, size) in [
        (1.5, 1.0, 24.0),
        (1.5, 1.0, 44.0),
        (4.0, 1.0, 44.0),
        (1.5, 2.0, 40.0),
        (4.0, 3.8, 40.0),
    ] {
        let mut finder = finder(noise, &mut random);
        let mut squares = [0.0; 3];
        const N: usize = 40;
        for _ in 0..N {
            let drawn = Drawn {
                length: size,
                width: size,
                ..Drawn::at(120.0 + random.uniform())
            };
            let drawn = drawn.stretched(stretch);
            let pixels = picture(&[drawn], noise, &mut random);
            finder.set_thorough(true);
            let all = finder.find(&frame(&pixels)).unwrap()[0];
            finder.set_thorough(false);
            let fast = finder.find(&frame(&pixels)).unwrap()[0];
            for (sum, d) in squares.iter_mut().zip(apart(&all, &fast)) {
                *sum += d * d / N as f64;
            }
        }
        let rms = squares.map(f64::sqrt);
        eprintln!(
            "noise {noise}, {size} px, stretch {stretch}: place, area, length {rms:.3?} of what they may be apart"
        );
        assert!(
            rms.iter().all(|r| *r < 1.0),
            "{noise} {stretch} {size}: {rms:?}"
        );
    }
}

#[test]
fn length_along_a_tilted_channel_and_the_axes_agree_with_the_ellipse() {
    let mut random = Random(8);
    let mut finder = finder(1.0, &mut random);
    let cell = Drawn {
        length: 60.0,
        width: 20.0,
        ..Drawn::at(100.0)
    };
    let pixels = picture(&[cell], 1.0, &mut random);
    let c = finder.find(&frame(&pixels)).unwrap()[0];
    let (length, width) = c.axes_px();
    assert!(
        (length - 60.0).abs() < 0.4 && (width - 20.0).abs() < 0.3,
        "{length} {width}"
    );
    assert!(c.angle_rad().abs() < 0.01);
    // The extent along 45 degrees is the root mean square of both axes.
    let half = std::f64::consts::FRAC_1_SQRT_2;
    let across = (0.5 * (60.0_f64.powi(2) + 20.0_f64.powi(2))).sqrt();
    assert!((c.extent_px((half, half)) - across).abs() < 0.4);
}

struct Run {
    tracker: CellTracker,
    random: Random,
    n: u32,
}

impl Run {
    fn new(seed: u64) -> Self {
        let mut random = Random(seed);
        let finder = finder(1.5, &mut random);
        Run {
            tracker: CellTracker::new(finder, TrackerConfig::default()).unwrap(),
            random,
            n: 0,
        }
    }

    fn see(&mut self, cells: &[Drawn]) -> cellpos_vision::CellStep {
        let pixels = picture(cells, 1.5, &mut self.random);
        self.n += 1;
        self.tracker
            .step(Some(&frame(&pixels)), f64::from(self.n) * 1e-3, (0.0, 0.0))
            .unwrap()
    }
}

#[test]
fn a_cell_that_stretches_nearly_fourfold_and_recovers_is_followed_all_the_way() {
    let mut run = Run::new(3);
    let mut taken = 0;
    for n in 0..400 {
        let t = f64::from(n) * 1e-3;
        // Stretches with 50 ms, recovers from 0.2 s on with 160 ms, and moves 3 um/s the while.
        let stretch = if t < 0.2 {
            1.0 + 2.8 * (1.0 - (-t / 0.05).exp())
        } else {
            1.0 + 2.75 * (-(t - 0.2) / 0.16).exp()
        };
        let drawn = Drawn::at(110.0 + 30.0 * t).stretched(stretch);
        let step = run.see(&[drawn]);
        if let Some(cell) = step.cell {
            taken += 1;
            assert!((cell.x_px - drawn.x).abs() < 0.15, "{n}");
            assert!(
                (cell.extent_px((1.0, 0.0)) / drawn.length - 1.0).abs() < 0.03,
                "{n}"
            );
        }
    }
    assert_eq!(taken, 398, "all but the two that confirm");
    assert_eq!(run.tracker.state(), TrackState::Tracking);
}

#[test]
fn an_area_that_changes_by_over_a_fifth_from_frame_to_frame_is_not_taken_without_a_word() {
    let (mut run, mut random) = (Run::new(11), Random(12));
    let (mut before, mut refused) = (None, 0);
    for n in 0..200 {
        // Three frames of every ten have another area.
        let other = n > 10 && n % 10 < 3;
        let area = if other {
            0.6 + 0.8 * random.uniform()
        } else {
            1.0
        };
        let at = Drawn::at(120.0);
        let (length, width) = (at.length * area.sqrt(), at.width * area.sqrt());
        let step = run.see(&[Drawn {
            length,
            width,
            ..at
        }]);
        let now = step.cell.map(|cell| cell.area_px);
        if let (Some(before), Some(now), Decision::Accepted) = (before, now, step.track.decision) {
            assert!(
                (1.0 / 1.2..1.2).contains(&(now / before)),
                "{n}: {now} {before}"
            );
        }
        refused += usize::from(other && now.is_none());
        before = now;
    }
    assert!(refused > 10, "{refused}");
}

#[test]
fn two_cells_that_touch_are_not_taken_and_the_right_one_comes_back() {
    let mut run = Run::new(4);
    let own = Drawn::at(80.0);
    for _ in 0..10 {
        run.see(&[own, Drawn::at(160.0)]);
    }
    // The tracker may have chosen either; it must stay with it.
    run.tracker.choose(Some((80.0, 31.6)));
    for _ in 0..10 {
        run.see(&[own, Drawn::at(160.0)]);
    }
    let (mut refused, mut touched) = (0, 0);
    for n in 0..40 {
        // The other comes up, touches for ten frames, and goes away again.
        let gap = 24.0 + 2.0 * f64::from((n - 20_i32).abs() - 5).max(-0.5);
        let step = run.see(&[own, Drawn::at(80.0 + gap)]);
        touched += u32::from(step.track.decision == Decision::InContact);
        if matches!(step.track.decision, Decision::Merged | Decision::InContact) {
            refused += 1;
            assert_eq!(step.track.fix.verdict, FixQuality::BadFit);
        }
        if let Some(cell) = step.cell {
            assert!((cell.x_px - 80.0).abs() < 0.5, "{n}: {cell:?}");
        } else {
            assert_eq!(step.track.state, TrackState::Coasting, "{n}");
        }
    }
    assert!((5..20).contains(&refused), "{refused}");
    assert!(touched >= 5, "{touched} of {refused}");
    // Nor is it chosen as it is, and the reason is named.
    run.tracker.choose(Some((80.0, 31.6)));
    for _ in 0..6 {
        let step = run.see(&[own, Drawn::at(103.0)]);
        assert_eq!(
            (step.cell, step.track.decision),
            (None, Decision::InContact)
        );
    }
    for _ in 0..3 {
        run.see(&[own]);
    }
    assert_eq!(run.tracker.state(), TrackState::Tracking);
}

#[test]
fn a_cell_that_is_gone_is_lost_and_another_kind_does_not_take_its_place() {
    let mut run = Run::new(5);
    for _ in 0..10 {
        run.see(&[Drawn::at(80.0)]);
    }
    // Debris: a third of the size; and something as large, of twice the contrast.
    let debris = Drawn {
        length: 12.0,
        width: 14.0,
        ..Drawn::at(84.0)
    };
    let bright = Drawn {
        contrast: 85.0,
        ..Drawn::at(150.0)
    };
    for _ in 0..100 {
        let step = run.see(&[debris, bright]);
        assert_eq!(step.cell, None);
    }
    assert_eq!(run.tracker.state(), TrackState::Lost);
    let back = run.see(&[debris, bright, Drawn::at(190.0)]);
    assert_eq!(back.track.decision, Decision::Reacquired);
    assert!((back.cell.unwrap().x_px - 190.0).abs() < 0.2);
}

#[test]
fn dirt_that_stays_while_the_cell_passes_does_not_take_its_place() {
    let mut run = Run::new(7);
    // As large and as dark as the cell: told by its staying alone.
    let dirt = Drawn::at(190.0);
    run.tracker.choose(Some((60.0, 31.6)));
    for n in 0..60 {
        // The cell goes twice its width.
        run.see(&[Drawn::at(60.0 + f64::from(n)), dirt]);
    }
    assert_eq!(run.tracker.state(), TrackState::Tracking);
    let followed = run.see(&[Drawn::at(120.0), dirt]).cell;
    assert!((followed.unwrap().x_px - 120.0).abs() < 0.2, "{followed:?}");
    for _ in 0..100 {
        let step = run.see(&[dirt]);
        assert_eq!(step.cell, None);
    }
    assert_eq!(run.see(&[dirt]).track.decision, Decision::Stays);
    assert_eq!(run.tracker.state(), TrackState::Lost);
    run.tracker.choose(None);
    assert_eq!(run.see(&[dirt]).track.decision, Decision::Stays);
    // Beside it a cell is not ambiguous.
    run.see(&[Drawn::at(80.0), dirt]);
    for _ in 0..3 {
        run.see(&[Drawn::at(80.0), dirt]);
    }
    let step = run.see(&[Drawn::at(80.0), dirt]);
    assert!((step.cell.unwrap().x_px - 80.0).abs() < 0.2);
}

#[test]
fn a_cell_that_the_loop_holds_still_is_never_taken_for_dirt() {
    let mut run = Run::new(8);
    let cell = Drawn::at(100.0);
    for n in 0..200 {
        let pixels = picture(&[cell], 1.5, &mut run.random);
        // The flow that is commanded holds it against another one: carried away it would be by 200 px.
        let step = run
            .tracker
            .step(Some(&frame(&pixels)), f64::from(n) * 1e-3, (1000.0, 0.0));
        let step = step.unwrap();
        assert!(
            n < 3 || step.cell.is_some(),
            "{n}: {:?}",
            step.track.decision
        );
    }
}

#[test]
fn of_two_cells_alike_a_lost_one_is_not_guessed() {
    let mut run = Run::new(6);
    for _ in 0..10 {
        run.see(&[Drawn::at(120.0)]);
    }
    for _ in 0..100 {
        run.see(&[]);
    }
    for _ in 0..20 {
        let step = run.see(&[Drawn::at(70.0), Drawn::at(170.0)]);
        assert_eq!(step.track.decision, Decision::Ambiguous);
    }
    run.tracker.choose(Some((170.0, 30.0)));
    for _ in 0..3 {
        run.see(&[Drawn::at(70.0), Drawn::at(170.0)]);
    }
    let step = run.see(&[Drawn::at(70.0), Drawn::at(170.0)]);
    assert!((step.cell.unwrap().x_px - 170.0).abs() < 0.2);
}

#[test]
fn a_background_that_changes_slowly_is_followed_and_a_cell_that_stays_is_not_taken_in() {
    for refresh_frames in [120, 0] {
        let mut random = Random(10);
        let config = CellConfig {
            refresh_frames,
            ..CellConfig::default()
        };
        let finder = finder_with(1.5, &mut random, config);
        let mut tracker = CellTracker::new(finder, TrackerConfig::default()).unwrap();
        let cell = Drawn::at(190.0);
        let mut last = None;
        for n in 0..900 {
            let t = f64::from(n) / 900.0;
            // One side of the frame grows brighter and the other darker, three times the threshold in all.
            let pixels: Vec<u8> = picture(&[cell], 1.5, &mut random)
                .into_iter()
                .enumerate()
                .map(|(k, p)| {
                    let side = (k % WIDTH) as f64 / (WIDTH as f64 - 1.0) - 0.5;
                    (f64::from(p) + 48.0 * side * t).round() as u8
                })
                .collect();
            let step = tracker
                .step(Some(&frame(&pixels)), f64::from(n) * 1e-3, (0.0, 0.0))
                .unwrap();
            last = step.cell;
        }
        if refresh_frames == 0 {
            assert_eq!(
                last, None,
                "without following the change there is no cell left"
            );
            continue;
        }
        let seen = last.unwrap();
        assert!((seen.x_px - cell.x).abs() < 0.3, "{seen:?}");
        assert!(
            (seen.extent_px((1.0, 0.0)) / 24.0 - 1.0).abs() < 0.02,
            "{seen:?}"
        );
        assert_eq!(tracker.state(), TrackState::Tracking);
    }
}

#[test]
fn a_cell_cut_by_the_border_and_an_empty_frame_say_so() {
    let mut run = Run::new(9);
    for _ in 0..10 {
        run.see(&[Drawn::at(40.0)]);
    }
    let cut = run.see(&[Drawn::at(5.0)]);
    assert_eq!(cut.track.decision, Decision::AtBorder);
    assert_eq!(
        (cut.cell, cut.track.fix.verdict),
        (None, FixQuality::AtBorder)
    );
    assert_eq!(run.see(&[]).track.decision, Decision::NothingFound);
    let wrong = vec![0_u8; 100];
    let small = Frame {
        width: 10,
        height: 10,
        pixels: Pixels::Mono8(&wrong),
    };
    let error = run.tracker.step(Some(&small), 1.0, (0.0, 0.0)).unwrap_err();
    assert!(matches!(error, CellError::Size { .. }), "{error}");
}
