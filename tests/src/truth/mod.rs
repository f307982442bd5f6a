//! A rig that hides effects, written apart from the catalogue of `cellpos-plant`.
//!
//! Another integrator (fixed-step Runge-Kutta on Eq. (6) in controllable form, 64 steps a millisecond, the jumps of its
//! direct path apart from the flow, where the catalogue is exact), other equations where the literature offers them (Preisach relays for hysteresis, one
//! Kelvin-Voigt element per decade for creep, an internal variable for the standard linear solid), and effects that the
//! catalogue does not have. Nuisances (diffusion, localisation noise, phases) are drawn at random.

mod camera;
pub mod cases;
mod hidden;
mod motion;
mod random;
mod relays;
mod signal;
pub mod table;
pub mod threshold;

pub use hidden::Hidden;
pub use random::Random;

use cellpos_reconcile::Record;
pub use motion::Nuisance;
use motion::positions;
use std::f64::consts::TAU;

/// Commands of one record \[um\], about 4 um.
#[derive(Debug, Clone)]
pub struct Script {
    /// Name of the record.
    pub name: &'static str,
    /// Command per millisecond.
    pub pzt_um: Vec<f64>,
}

/// The set of records of a session: sines, two multisines, steps, triangle, rest.
pub fn scripts(random: &mut Random) -> Vec<Script> {
    let mut sines = Vec::new();
    for hz in [
        2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 120.0, 150.0, 200.0, 300.0,
    ] {
        let rows = ((1.5f64 * hz).ceil() / hz * 1000.0) as usize;
        sines.extend((0..rows).map(|k| 4.0 + 0.8 * (TAU * hz * k as f64 * 1e-3).sin()));
    }
    let mut multisine = |rms: f64| {
        let lines: Vec<(f64, f64)> = (1..=600)
            .map(|i| (0.5 * f64::from(i), TAU * random.uniform()))
            .collect();
        let a = rms * (2.0 / lines.len() as f64).sqrt();
        let period: Vec<f64> = (0..2000)
            .map(|k| {
                4.0 + lines
                    .iter()
                    .map(|(f, p)| a * (TAU * f * f64::from(k) * 1e-3 + p).sin())
                    .sum::<f64>()
            })
            .collect();
        (0..16000).map(|k| period[k % 2000]).collect::<Vec<f64>>()
    };
    let (small, large) = (multisine(0.25), multisine(1.0));
    let levels: Vec<f64> = (0..20)
        .map(|i| {
            if i % 2 == 0 {
                0.0
            } else {
                0.025 * (f64::from(i % 7) - 3.0)
            }
        })
        .collect();
    let steps = (0..16000).map(|k| 4.0 + levels[k / 800]).collect();
    let triangle = (0..12000)
        .map(|k| {
            let p = f64::from(k) * 4e-3 % 1.0;
            4.0 + 1.5
                * (if p < 0.25 {
                    4.0 * p
                } else if p < 0.75 {
                    2.0 - 4.0 * p
                } else {
                    4.0 * p - 4.0
                })
        })
        .collect();
    vec![
        Script {
            name: "sines",
            pzt_um: sines,
        },
        Script {
            name: "multisine-small",
            pzt_um: small,
        },
        Script {
            name: "multisine-large",
            pzt_um: large,
        },
        Script {
            name: "steps",
            pzt_um: steps,
        },
        Script {
            name: "triangle",
            pzt_um: triangle,
        },
        Script {
            name: "rest",
            pzt_um: vec![4.0; 10000],
        },
    ]
}

/// Runs one record. Rows whose frame is dropped are left out of the record, as cameras do.
pub fn run(script: &Script, hidden: &[Hidden], nuisance: Nuisance, random: &mut Random) -> Record {
    let u: Vec<f64> = script.pzt_um.iter().map(|p| p - 4.0).collect();
    let seen = positions(&u, hidden, nuisance, random);
    let (mut time, mut pzt, mut bead) = (Vec::new(), Vec::new(), Vec::new());
    let mut last = f64::NAN;
    for (k, y) in seen.iter().enumerate() {
        let mut y = *y + nuisance.localisation_um * random.normal();
        let mut dropped = false;
        for h in hidden {
            match *h {
                Hidden::Repeats(p) if random.uniform() < p && last.is_finite() => y = last,
                Hidden::Drops(p) => dropped = random.uniform() < p,
                _ => {}
            }
        }
        last = y;
        time.push(k as f64 * 1e-3);
        pzt.push(script.pzt_um[k]);
        bead.push(if dropped {
            f64::NAN
        } else {
            (y * 1e4).round() / 1e4
        });
    }
    match Record::from_rows(script.name, &time, &pzt, &bead) {
        Ok(r) => r,
        Err(e) => panic!("the simulator made a record that cannot be read: {e}"),
    }
}
