//! The commands to the rig.

use super::random::Random;
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
fn standard(random: &mut Random) -> Vec<Script> {
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

/// Which records a session has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Excitation {
    /// The same for every seed but for the phases of the multisines.
    Standard,
    /// Amplitudes, frequencies, bands and lengths drawn.
    Drawn,
    /// The same, without rest and without any repetition.
    WithoutFloor,
}

/// The records of a session.
pub fn scripts(excitation: Excitation, random: &mut Random) -> Vec<Script> {
    match excitation {
        Excitation::Standard => standard(random),
        Excitation::Drawn => drawn(random),
        Excitation::WithoutFloor => without_floor(random),
    }
}

fn script(name: &'static str, moved: Vec<f64>) -> Script {
    Script {
        name,
        pzt_um: moved.into_iter().map(|u| 4.0 + u).collect(),
    }
}

/// Sines one after another, amplitudes and frequencies drawn, lowest first \[um\].
fn sines(random: &mut Random) -> Vec<f64> {
    let count = 8 + random.index(4);
    let amplitude = random.between(0.5, 1.4);
    let mut hz: Vec<f64> = (0..count).map(|_| random.between(2.0, 350.0)).collect();
    hz.sort_by(f64::total_cmp);
    let mut out = Vec::new();
    for f in hz {
        let rows = ((1.5 * f).ceil() / f * 1000.0) as usize;
        out.extend((0..rows).map(|k| amplitude * (TAU * f * k as f64 * 1e-3).sin()));
    }
    out
}

/// Lines with drawn phases up to a drawn frequency, in periods of `period` rows \[um\].
fn multisine(random: &mut Random, rms: f64, period: usize, rows: usize) -> Vec<f64> {
    let spacing = 1000.0 / period as f64;
    let top = random.between(180.0, 320.0);
    let count = (top / spacing) as usize;
    let phases: Vec<f64> = (0..count).map(|_| TAU * random.uniform()).collect();
    let a = rms * (2.0 / count as f64).sqrt();
    let mut one = vec![0.0; period.min(rows)];
    for (i, p) in phases.iter().enumerate() {
        let w = TAU * (i + 1) as f64 / period as f64;
        for (k, x) in one.iter_mut().enumerate() {
            *x += a * (w * k as f64 + p).sin();
        }
    }
    (0..rows).map(|k| one[k % one.len()]).collect()
}

/// Levels of drawn height, each held as long \[um\].
fn levels(random: &mut Random, rows: usize) -> Vec<f64> {
    let (held, size) = (300 + random.index(800), random.between(0.03, 0.12));
    let count = rows / held + 1;
    let heights: Vec<f64> = (0..count)
        .map(|i| {
            if i % 3 == 0 {
                0.0
            } else {
                size * (2.0 * random.uniform() - 1.0)
            }
        })
        .collect();
    (0..rows).map(|k| heights[k / held]).collect()
}

/// A triangle of drawn height and slope \[um\].
fn triangle(random: &mut Random, rows: usize) -> Vec<f64> {
    let (height, hz) = (random.between(0.8, 1.8), random.between(2.5, 8.0));
    (0..rows)
        .map(|k| {
            let p = (k as f64 * 1e-3 * hz + 0.25).fract();
            height * (1.0 - 4.0 * (p - 0.5).abs())
        })
        .collect()
}

fn drawn(random: &mut Random) -> Vec<Script> {
    let rows = |random: &mut Random| 9000 + random.index(8000);
    let period = 1400 + 200 * random.index(6);
    let small_um = random.between(0.15, 0.35);
    let large_um = random.between(0.6, 1.1);
    let (a, b, c, d) = (rows(random), rows(random), rows(random), rows(random));
    vec![
        script("sines", sines(random)),
        script("multisine-small", multisine(random, small_um, period, a)),
        script("multisine-large", multisine(random, large_um, period, b)),
        script("levels", levels(random, c)),
        script("triangle", triangle(random, d)),
        script("rest", vec![0.0; 6000 + random.index(6000)]),
    ]
}

fn without_floor(random: &mut Random) -> Vec<Script> {
    let rows = 7000 + random.index(6000);
    let large_um = random.between(0.6, 1.1);
    vec![
        script("sweep", sweep(random, rows)),
        script("multisine", multisine(random, large_um, rows, rows)),
        script("restless", restless(random, rows)),
    ]
}

/// Levels of drawn height, each held for a drawn time that is too short to measure noise in it \[um\].
fn restless(random: &mut Random, rows: usize) -> Vec<f64> {
    let size = random.between(0.03, 0.12);
    let mut out = Vec::new();
    while out.len() < rows {
        let height = size * (2.0 * random.uniform() - 1.0);
        out.resize(out.len() + 40 + random.index(120), height);
    }
    out.truncate(rows);
    out
}

/// A sine whose frequency grows by the same factor in equal times: no part repeats.
fn sweep(random: &mut Random, rows: usize) -> Vec<f64> {
    let (amplitude, first, last) = (
        random.between(0.5, 1.4),
        random.between(0.5, 2.0),
        random.between(200.0, 350.0),
    );
    let rate = (last / first).ln() / rows as f64;
    (0..rows)
        .map(|k| {
            let cycles = first * 1e-3 * ((rate * k as f64).exp() - 1.0) / rate;
            amplitude * (TAU * cycles).sin()
        })
        .collect()
}
