//! Time of one fix on a 25 x 25 window, compared with the same model fitted by a general Levenberg-Marquardt solver and with two
//! methods without a template. Run: `cargo bench -p cellpos-benches --bench vision_fix`.

use cellpos_numeric::Random;
use cellpos_vision::{
    Detector, Frame, Localiser, LocaliserConfig, PixelNoise, PixelResponse, Pixels, Polarity,
    ProfileSpec, RadialProfile, RadialSymmetry, RingProfile,
};
use levenberg_marquardt::{LeastSquaresProblem, LevenbergMarquardt};
use nalgebra::{Dyn, OMatrix, OVector, Owned, U4, Vector4};
use std::hint::black_box;
use std::time::Instant;

const SIDE: usize = 64;
const WINDOW: usize = 25;
const RUNS: usize = 4000;
const SNR: f64 = 40.0;
const NOISE: f64 = 2.0;
/// Ways of beads that move while the shutter is open, px.
const MOVES_PX: [f64; 3] = [0.5, 1.0, 4.0];
/// Places along a way at which a moving bead is drawn.
const DRAWN: usize = 16;

fn main() {
    let spec = ProfileSpec::Ring {
        edge_px: RingProfile::MEASURED_EDGE_PX,
    };
    let config = LocaliserConfig {
        window_px: WINDOW,
        noise: PixelNoise::Estimated,
        ..LocaliserConfig::new(spec)
    };
    let mut localiser = Localiser::new(config).expect("the configuration is valid");
    let mut symmetry = RadialSymmetry::new(WINDOW);
    let mut detector = Detector::new(&localiser, 8);
    let mut random = Random::new(1);
    let mut scenes_of = |way_px| -> Vec<Scene> {
        let scene = |_| Scene::new(&mut random, way_px);
        (0..RUNS).map(scene).collect()
    };
    let scenes = scenes_of(0.0);

    println!(
        "conditions: ring profile, edge 6.373 px, SNR {SNR}, 8-bit frames of {SIDE} x {SIDE} px, window {WINDOW} x {WINDOW} px,"
    );
    println!(
        "            guess within 0.3 px (as a predictor gives), one thread, {RUNS} different frames, {}",
        build()
    );
    println!(
        "{:44} {:>9} {:>9} {:>9} {:>9}",
        "method", "median us", "p99 us", "max us", "RMS px"
    );
    let frame = |s: &Scene| (s.x, s.y, s.guess);
    run("template fit (this crate)", &scenes, |s| {
        let fix = localiser.locate(&s.frame(), Some(frame(s).2));
        Some((fix.x_px, fix.y_px))
    });
    for way_px in MOVES_PX {
        let moving = scenes_of(way_px);
        localiser.expect_streak((way_px, 0.0));
        let name = format!("template fit, {way_px} px of way while exposed");
        run(&name, &moving, |s| {
            let fix = localiser.locate(&s.frame(), Some(frame(s).2));
            Some((fix.x_px, fix.y_px))
        });
    }
    localiser.expect_streak((0.0, 0.0));
    let mut walled = scenes_of(0.0);
    walled.iter_mut().for_each(Scene::beside_a_wall);
    run("template fit, a wall in the window", &walled, |s| {
        let fix = localiser.locate(&s.frame(), Some(frame(s).2));
        Some((fix.x_px, fix.y_px))
    });
    run("template fit, whole frame searched first", &scenes, |s| {
        let fix = localiser.locate(&s.frame(), None);
        Some((fix.x_px, fix.y_px))
    });
    let profile = RingProfile::new(RingProfile::MEASURED_EDGE_PX).expect("a valid size");
    run(
        "competitor: levenberg-marquardt crate, same fit",
        &scenes,
        |s| general_solver(&profile, s),
    );
    run("radial symmetry", &scenes, |s| {
        symmetry.locate(&s.frame(), s.guess.0, s.guess.1)
    });
    run("threshold centroid", &scenes, |s| {
        symmetry.threshold_centroid(
            &s.frame(),
            s.guess.0,
            s.guess.1,
            Polarity::Bright,
            profile.radius_px(),
        )
    });
    run("detection of all beads in the frame", &scenes, |s| {
        detector
            .detect(&s.frame())
            .first()
            .map(|b| (b.x_px, b.y_px))
    });
}

fn build() -> &'static str {
    if cfg!(debug_assertions) {
        "DEBUG BUILD"
    } else {
        "optimised build"
    }
}

fn run(name: &str, scenes: &[Scene], mut locate: impl FnMut(&Scene) -> Option<(f64, f64)>) {
    let mut times_us = Vec::with_capacity(scenes.len());
    let mut squares = 0.0;
    for s in scenes {
        let start = Instant::now();
        let found = black_box(locate(black_box(s)));
        times_us.push(start.elapsed().as_secs_f64() * 1e6);
        let (x, y) = found.unwrap_or((f64::NAN, f64::NAN));
        squares += ((x - s.x).powi(2) + (y - s.y).powi(2)) / (2 * scenes.len()) as f64;
    }
    times_us.sort_by(f64::total_cmp);
    let at = |q: f64| times_us[((times_us.len() - 1) as f64 * q) as usize];
    println!(
        "{name:44} {:9.2} {:9.2} {:9.2} {:9.4}",
        at(0.5),
        at(0.99),
        at(1.0),
        squares.sqrt()
    );
}

/// A frame with one bead.
struct Scene {
    pixels: Vec<u8>,
    x: f64,
    y: f64,
    guess: (f64, f64),
}

impl Scene {
    /// Of a bead that goes `way_px` along the row while the shutter is open.
    fn new(random: &mut Random, way_px: f64) -> Self {
        let (x, y) = (28.0 + 8.0 * random.uniform(), 28.0 + 8.0 * random.uniform());
        let spec = ProfileSpec::Ring {
            edge_px: RingProfile::MEASURED_EDGE_PX,
        };
        let template = spec.template(PixelResponse::Point).expect("a valid size");
        let mut image = vec![110.0_f32; SIDE * SIDE];
        for k in 0..DRAWN {
            let along = (k as f64 + 0.5) / DRAWN as f64 - 0.5;
            let share = SNR * NOISE / DRAWN as f64;
            template.draw(&mut image, SIDE, x + along * way_px, y, share);
        }
        let pixels = image
            .iter()
            .map(|v| (f64::from(*v) + NOISE * random.normal()).round() as u8)
            .collect();
        let guess = (
            x + 0.6 * (random.uniform() - 0.5),
            y + 0.6 * (random.uniform() - 0.5),
        );
        Scene {
            pixels,
            x,
            y,
            guess,
        }
    }

    /// Darkens the two first rows of the bead's window, and all before them.
    fn beside_a_wall(&mut self) {
        let rows = self.y.round() as usize + 2 - WINDOW / 2;
        for grey in self.pixels.iter_mut().take(rows * SIDE) {
            *grey -= 40;
        }
    }

    fn frame(&self) -> Frame<'_> {
        Frame {
            width: SIDE,
            height: SIDE,
            pixels: Pixels::Mono8(&self.pixels),
        }
    }
}

struct General<'a> {
    profile: &'a RingProfile,
    scene: &'a Scene,
    origin: (usize, usize),
    parameters: Vector4<f64>,
}

impl General<'_> {
    fn pixel(&self, k: usize) -> (f64, f64, f64) {
        let (i, j) = (self.origin.0 + k % WINDOW, self.origin.1 + k / WINDOW);
        let grey = f64::from(self.scene.pixels[j * SIDE + i]);
        (
            i as f64 - self.parameters[0],
            j as f64 - self.parameters[1],
            grey,
        )
    }
}

impl LeastSquaresProblem<f64, Dyn, U4> for General<'_> {
    type ResidualStorage = Owned<f64, Dyn>;
    type JacobianStorage = Owned<f64, Dyn, U4>;
    type ParameterStorage = Owned<f64, U4>;

    fn set_params(&mut self, x: &Vector4<f64>) {
        self.parameters = *x;
    }
    fn params(&self) -> Vector4<f64> {
        self.parameters
    }
    fn residuals(&self) -> Option<OVector<f64, Dyn>> {
        Some(OVector::<f64, Dyn>::from_fn(WINDOW * WINDOW, |k, _| {
            let (dx, dy, grey) = self.pixel(k);
            self.parameters[2] * self.profile.value(f64::hypot(dx, dy)) + self.parameters[3] - grey
        }))
    }
    fn jacobian(&self) -> Option<OMatrix<f64, Dyn, U4>> {
        let mut jacobian = OMatrix::<f64, Dyn, U4>::zeros(WINDOW * WINDOW);
        for k in 0..WINDOW * WINDOW {
            let (dx, dy, _) = self.pixel(k);
            let r = f64::hypot(dx, dy).max(1e-9);
            let inward = -self.parameters[2] * self.profile.slope(r) / r;
            jacobian[(k, 0)] = inward * dx;
            jacobian[(k, 1)] = inward * dy;
            jacobian[(k, 2)] = self.profile.value(r);
            jacobian[(k, 3)] = 1.0;
        }
        Some(jacobian)
    }
}

fn general_solver(profile: &RingProfile, scene: &Scene) -> Option<(f64, f64)> {
    let corner = |c: f64| c.round() as usize - WINDOW / 2;
    let origin = (corner(scene.guess.0), corner(scene.guess.1));
    let parameters = Vector4::new(scene.guess.0, scene.guess.1, SNR * NOISE, 110.0);
    let problem = General {
        profile,
        scene,
        origin,
        parameters,
    };
    // The tolerance to which this crate's fit is run.
    let (solved, report) = LevenbergMarquardt::new().with_tol(1e-4).minimize(problem);
    report
        .termination
        .was_successful()
        .then_some((solved.parameters[0], solved.parameters[1]))
}
