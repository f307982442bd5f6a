//! The fit of a calibration: the velocity that goes with the commanded offset, and its lag.

use crate::watch::Sighting;
use cellpos_drivers::{Axis, CalibrationFile};
use serde::Serialize;

/// What the pulses showed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Response {
    /// Bead velocity per displacement of the PZT along columns' and rows' numbers, px/s per um.
    pub gain_px_per_s: [f64; 2],
    /// Its standard deviation, per axis.
    pub sd_px_per_s: f64,
    /// Delay from a command to its motion in the frames, ms.
    pub lag_ms: f64,
    /// Frames used.
    pub frames: usize,
    /// Size of the frames, px.
    pub size_px: [usize; 2],
}

impl Response {
    /// Length of the gain vector, px/s per um.
    pub fn gain(&self) -> f64 {
        self.gain_px_per_s[0].hypot(self.gain_px_per_s[1])
    }

    /// Axis, sign, tilt (degrees) and the tilt's standard deviation.
    pub fn direction(&self) -> (Axis, i8, f64, f64) {
        let [x, y] = self.gain_px_per_s;
        let (axis, along, other) = if x.abs() >= y.abs() {
            (Axis::X, x, y)
        } else {
            (Axis::Y, y, x)
        };
        let sign = if along < 0.0 { -1 } else { 1 };
        let tilt_deg = (other / along).atan().to_degrees();
        let sd_deg = (self.sd_px_per_s / self.gain()).to_degrees();
        (axis, sign, tilt_deg, sd_deg)
    }

    /// The calibration, with a pixel size from elsewhere. A tilt below two of its standard deviations counts as zero.
    pub fn calibration(&self, pixel_um: f64, pixel_um_sd: f64, method: String) -> CalibrationFile {
        let (axis, sign, tilt_deg, sd_deg) = self.direction();
        let [width, height] = self.size_px.map(|px| px.saturating_sub(1) as f64);
        let (origin_px, across_px) = match axis {
            Axis::X => (0.5 * width, 0.5 * height),
            Axis::Y => (0.5 * height, 0.5 * width),
        };
        CalibrationFile {
            pixel_um,
            pixel_um_sd,
            axis,
            sign,
            origin_px,
            tilt_deg: if tilt_deg.abs() > 2.0 * sd_deg {
                tilt_deg
            } else {
                0.0
            },
            origin_across_px: across_px,
            date: jiff::Timestamp::now().strftime("%Y-%m-%d").to_string(),
            method,
        }
    }
}

/// Mean of the commanded offset from `from_ns` to `to_ns`. The commands are in the order of their times.
fn mean_offset(commands: &[(i64, f64)], from_ns: i64, to_ns: i64) -> f64 {
    let mut sum = 0.0;
    // Of a long measurement all but a few are before or after.
    let in_force = commands.partition_point(|&(at_ns, _)| at_ns <= from_ns);
    for (k, &(since_ns, offset_um)) in commands
        .iter()
        .enumerate()
        .skip(in_force.saturating_sub(1))
        .take_while(|(_, (since_ns, _))| *since_ns < to_ns)
    {
        let until_ns = commands.get(k + 1).map_or(i64::MAX, |next| next.0);
        let (a, b) = (since_ns.max(from_ns), until_ns.min(to_ns));
        if a < b {
            sum += offset_um * (b - a) as f64;
        }
    }
    sum / (to_ns - from_ns) as f64
}

/// Velocity against offset, by least squares with a constant for drift and zero flow, at the lag with the smallest residual. (The
/// slope does not show the lag: averaged over a wrong lag, pulses and responses both shrink.)
pub(super) fn fit(
    commands: &[(i64, f64)],
    sightings: &[Sighting],
    size_px: [usize; 2],
) -> Option<Response> {
    const LONGEST_GAP_NS: i64 = 20_000_000;
    let mut sorted = sightings.to_vec();
    sorted.sort_by_key(|s| s.at_ns);
    let pairs: Vec<(Sighting, Sighting)> = (sorted.windows(2))
        .map(|pair| (pair[0], pair[1]))
        .filter(|(a, b)| (1..LONGEST_GAP_NS).contains(&(b.at_ns - a.at_ns)))
        .collect();
    if pairs.len() < 50 {
        return None;
    }
    // A lag that is 0.25 ms off takes 3 % of the slope of pulses of 15 ms.
    (-10..=60)
        .map(|tenth_ms| regress(commands, &pairs, tenth_ms * 100_000, size_px))
        .min_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, response)| response)
}

/// The residual sum of squares of a lag, (px/s)^2, and its fit.
fn regress(
    commands: &[(i64, f64)],
    pairs: &[(Sighting, Sighting)],
    lag_ns: i64,
    size_px: [usize; 2],
) -> (f64, Response) {
    let n = pairs.len() as f64;
    let rows: Vec<(f64, [f64; 2])> = pairs
        .iter()
        .map(|(a, b)| {
            let s = (b.at_ns - a.at_ns) as f64 * 1e-9;
            let u = mean_offset(commands, a.at_ns - lag_ns, b.at_ns - lag_ns);
            (u, [(b.x_px - a.x_px) / s, (b.y_px - a.y_px) / s])
        })
        .collect();
    let mean_u = rows.iter().map(|(u, _)| u).sum::<f64>() / n;
    let suu = rows.iter().map(|(u, _)| (u - mean_u).powi(2)).sum::<f64>();
    let mut gain = [0.0; 2];
    let mut residual = 0.0;
    for (axis, gain) in gain.iter_mut().enumerate() {
        let mean_v = rows.iter().map(|(_, v)| v[axis]).sum::<f64>() / n;
        let suv: f64 = rows
            .iter()
            .map(|(u, v)| (u - mean_u) * (v[axis] - mean_v))
            .sum();
        *gain = suv / suu.max(f64::MIN_POSITIVE);
        residual += (rows.iter())
            .map(|(u, v)| (v[axis] - mean_v - *gain * (u - mean_u)).powi(2))
            .sum::<f64>();
    }
    let response = Response {
        gain_px_per_s: gain,
        sd_px_per_s: (residual / (2.0 * n - 4.0) / suu.max(f64::MIN_POSITIVE)).sqrt(),
        lag_ms: lag_ns as f64 * 1e-6,
        frames: pairs.len() + 1,
        size_px,
    };
    (residual, response)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bead_that_goes_with_the_pulses_shows_axis_sign_tilt_and_gain_through_drift() {
        // 500 frames with a drift of 300 px/s. The gain is 4000 px/s per um, up and to the left at 10 degrees from the rows.
        let tilt = 170_f64.to_radians();
        let (gx, gy) = (4000.0 * tilt.cos(), 4000.0 * tilt.sin());
        let commands: Vec<(i64, f64)> = (0..500)
            .map(|k| {
                (
                    k * 1_000_000,
                    if (k + 7) / 15 % 2 == 0 { 0.2 } else { -0.2 },
                )
            })
            .collect();
        let (mut x, mut y) = (100.0, 30.0);
        let lag_ns = 2_200_000;
        let sightings: Vec<Sighting> = (10..500)
            .map(|k| {
                let u = mean_offset(
                    &commands,
                    (k - 1) * 1_000_000 - lag_ns,
                    k * 1_000_000 - lag_ns,
                );
                x += (gx * u + 300.0) * 1e-3;
                y += gy * u * 1e-3;
                Sighting {
                    at_ns: k * 1_000_000,
                    x_px: x,
                    y_px: y,
                }
            })
            .collect();
        let response = fit(&commands, &sightings, [256, 64]).expect("enough frames");
        let (axis, sign, tilt_deg, _) = response.direction();
        assert_eq!((axis, sign), (Axis::X, -1));
        assert!((tilt_deg + 10.0).abs() < 0.5, "{tilt_deg}");
        assert!((response.gain() - 4000.0).abs() < 20.0, "{response:?}");
        assert!((response.lag_ms - 2.2).abs() < 1e-9, "{response:?}");
        let file = response.calibration(0.1, 0.001, "test".to_string());
        assert_eq!((file.axis, file.sign, file.origin_px), (Axis::X, -1, 127.5));
    }

    #[test]
    fn half_a_minute_of_pulses_has_the_gain_of_each() {
        // With a look at every command for every frame this test takes minutes.
        const MS: i64 = 30_000;
        let up = |k: i64| (k + 7) / 15 % 2 == 0;
        let commands: Vec<(i64, f64)> = (0..MS)
            .map(|k| (k * 1_000_000, if up(k) { 0.2 } else { -0.2 }))
            .collect();
        let mut x_px = 100.0;
        let mut sighting = |k: i64| {
            x_px += if up(k - 1) { 0.8 } else { -0.8 };
            Sighting {
                at_ns: k * 1_000_000,
                x_px,
                y_px: 30.0,
            }
        };
        let sightings: Vec<Sighting> = (1..MS).map(&mut sighting).collect();
        let response = fit(&commands, &sightings, [256, 64]).expect("enough frames");
        assert!((response.gain() - 4000.0).abs() < 1.0, "{response:?}");
    }

    #[test]
    fn a_few_frames_are_not_enough() {
        let sightings = [Sighting {
            at_ns: 0,
            x_px: 0.0,
            y_px: 0.0,
        }; 10];
        assert_eq!(fit(&[(0, 0.1)], &sightings, [10, 10]), None);
    }
}
