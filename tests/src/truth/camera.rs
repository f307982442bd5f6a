//! What the frames show.

use super::hidden::Hidden;
use super::random::Random;
use super::second::Second;
use super::strangers::Stranger;
use std::f64::consts::TAU;

/// What the frames show of a fine path.
///
/// `path[i]` holds the position right before and right after time i h.
pub(super) fn camera(
    path: &[[f64; 2]],
    u: &[f64],
    h: f64,
    hidden: &[Hidden],
    random: &mut Random,
) -> Vec<f64> {
    let (mut delay, mut exposure, mut skew) = (0.0, 0.0, 0.0);
    let (mut unsteady, mut ramps) = (0.0, 0.0);
    let phase = TAU * random.uniform();
    for e in hidden {
        match *e {
            Hidden::Second(Second::UnsteadyDelay(d)) => (delay, unsteady) = (d - 20e-6, 40e-6),
            Hidden::Second(Second::ShutterRamps(e)) => (exposure, ramps) = (e, 0.2),
            Hidden::Stranger(Stranger::FrameJitter(s)) => unsteady = s,
            Hidden::Delay(d) => delay = d,
            Hidden::Exposure(e) => exposure = e,
            Hidden::ClockSkew(ppm) => skew = 1e-6 * ppm,
            _ => {}
        }
    }
    let at = |t: f64| {
        // Limits from the left: a command that acts at the very instant is not seen yet.
        let x = (t / h).max(0.0);
        let i = ((x - 1e-6).ceil() - 1.0)
            .max(0.0)
            .min(path.len() as f64 - 2.0) as usize;
        if x <= 1e-6 {
            return path[0][0];
        }
        path[i][1] + (path[i + 1][0] - path[i][1]) * (x - i as f64)
    };
    let mut late = random.fork();
    (0..u.len())
        .map(|k| {
            let row_s = k as f64 * 1e-3;
            let mut t = row_s * (1.0 + skew) - delay;
            if unsteady > 0.0 {
                t -= unsteady * late.uniform();
            }
            for e in hidden {
                match *e {
                    Hidden::Second(Second::SteppedSkew(ppm)) => {
                        t += 1e-6 * ppm * (row_s * 10.0).floor() / 10.0;
                    }
                    Hidden::Stranger(Stranger::ClockWander(s, period)) => {
                        t += s * ((TAU * row_s / period + phase).sin() - 1.0);
                    }
                    _ => {}
                }
            }
            let mut y = if exposure > 0.0 {
                let n = 64;
                let (mut sum, mut weights) = (0.0, 0.0);
                for i in 0..n {
                    let part = (f64::from(i) + 0.5) / f64::from(n);
                    let edge = part.min(1.0 - part);
                    let open = if edge < ramps { edge / ramps } else { 1.0 };
                    sum += open * at(t - exposure * part);
                    weights += open;
                }
                sum / weights
            } else {
                at(t)
            };
            for e in hidden {
                match *e {
                    Hidden::Hum(hz, um) | Hidden::Line(hz, um) => {
                        y += um * (TAU * hz * k as f64 * 1e-3 + phase).sin()
                    }
                    Hidden::Second(Second::RichHum(hz, um)) => {
                        let angle = TAU * hz * row_s + phase;
                        y += um * (angle.sin() + 0.15 * (3.0 * angle).sin());
                    }
                    Hidden::Second(Second::UnevenPixels(p, b)) => {
                        let angle = TAU * y / p;
                        y += b * p * (angle.sin() + 0.2 * (2.0 * angle).sin());
                    }
                    Hidden::Second(Second::Magnification(f)) => y *= f,
                    Hidden::Stranger(Stranger::Pulsation(hz, um, second)) => {
                        let angle = TAU * hz * row_s + phase;
                        y += um * (angle.sin() + second * (2.0 * angle).sin());
                    }
                    Hidden::Stranger(Stranger::CurvedLens(c)) => y += c * y * y * y,
                    Hidden::Stranger(Stranger::Crosstalk(c)) => y += c * u[k],
                    Hidden::PixelLocking(p, b) => y += b * p * (TAU * y / p).sin(),
                    Hidden::Distortion(c) => y += c * y * y,
                    _ => {}
                }
            }
            y
        })
        .collect()
}
