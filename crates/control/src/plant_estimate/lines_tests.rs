//! Rate of false positives in white noise, and the time until one is removed.

use super::*;
use cellpos_numeric::Random;

const AGO: f64 = 2.0;

/// A search in white residuals of one unit, in which what is found is cancelled.
struct White {
    settings: LineSettings,
    whitener: Whitener,
    lines: Lines,
    random: Random,
    tick: u64,
    found: usize,
}

impl White {
    fn new(seed: u64, sample_s: f64, interval: f64) -> Self {
        Self {
            settings: LineSettings::new(sample_s, interval, 0.0),
            whitener: Whitener::new(6.6e-4, 1e-9, 4e-4, interval).unwrap(),
            lines: Lines::new(),
            random: Random::new(seed),
            tick: 0,
            found: 0,
        }
    }

    fn count(&self) -> usize {
        self.lines
            .cancelled(&self.settings)
            .iter()
            .flatten()
            .count()
    }

    fn second(&mut self) {
        let settings = self.settings;
        for _ in 0..(1.0 / settings.sample_s).round() as usize {
            self.tick += 1;
            let before = self.count();
            if self.tick.is_multiple_of(settings.interval as u64) {
                let fix_um = self.random.normal();
                (self.lines).learn(&settings, &self.whitener, (fix_um, 1.0), AGO);
            }
            self.lines.tick(&settings);
            self.found += self.count().saturating_sub(before);
        }
    }
}

#[test]
fn in_white_noise_no_line_is_found_and_one_that_is_none_is_soon_gone() {
    for (sample_s, interval) in [(1e-3, 1.0), (5e-4, 1.0), (2e-4, 5.0)] {
        let mut white = White::new(7, sample_s, interval);
        for _ in 0..200 {
            white.second();
        }
        assert_eq!(white.found, 0, "{sample_s} s");
        for bin in [2.3, 20.7, 350.1] {
            white.lines.add(&white.settings, bin);
            let mut seconds = 0;
            while white.lines.count > 0 && seconds < 100 {
                white.second();
                seconds += 1;
            }
            assert!(seconds < 5, "{sample_s} s, bin {bin}: {seconds} s");
        }
    }
}

#[test]
#[ignore = "eighty hours of noise: for the nightly run"]
fn lines_are_found_in_white_noise_as_often_as_is_said() {
    let mut found = 0;
    for seed in 0..8 {
        let mut white = White::new(seed, 1e-3, 1.0);
        for _ in 0..36_000 {
            white.second();
        }
        found += white.found;
    }
    println!("{found} lines in 80 hours of white noise");
    // 2.9 are expected, and chance makes more than 7 once in 100.
    assert!(found <= 7, "{found}");
}

/// A plant that a command moves by `u_k + jump (u_k - u_(k-1))` in a tick, and the motion with these ends.
#[test]
fn the_motion_against_a_line_has_the_lines_amplitude_at_its_frequency() {
    const FINE: usize = 50;
    const TICKS: usize = 10_000;
    for jump in [0.0, 0.05, 0.5, 5.0] {
        for turn in [0.05, 0.4, 0.63, 1.2] {
            let line = Line {
                amplitude: [0.3, -0.4],
                phase: [1.0, 0.0],
                turn,
                ..Line::default()
            };
            let end_um = |k: usize| line.end(k as f64, line.jump(jump))[0];
            let mut before_um = end_um(1) - end_um(0);
            let (mut sum, mut farthest) = ([0.0; 2], 0.0_f64);
            for k in 1..TICKS {
                let (from_um, to_um) = (end_um(k), end_um(k + 1));
                let command_um = (to_um - from_um + jump * before_um) / (1.0 + jump);
                let jumped_um = from_um + jump * (command_um - before_um);
                before_um = command_um;
                for i in 0..FINE {
                    let part = (i as f64 + 0.5) / FINE as f64;
                    let at_um = jumped_um + part * (to_um - jumped_um);
                    let t = k as f64 + part;
                    let shown = unit(-turn * t).map(|x| x * at_um);
                    sum = [sum[0] + shown[0], sum[1] + shown[1]];
                    if k > TICKS / 2 {
                        let left_um = line.at(t)[0] - at_um;
                        farthest = farthest.max((line.left_um(-t, jump) - left_um).abs());
                    }
                }
            }
            let found = sum.map(|x| 2.0 * x / (FINE * (TICKS - 1)) as f64);
            let off = square([found[0] - 0.3, found[1] + 0.4]).sqrt();
            assert!(
                off < 0.003 && farthest < 1e-3,
                "{jump} {turn}: {off} {farthest}"
            );
        }
    }
}
