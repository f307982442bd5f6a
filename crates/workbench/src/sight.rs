//! Measures how well vision sees a bead or a cell in successive frames.

use crate::bench::Bench;
use crate::capture::Kept;
use crate::snapshot::Eye;
use cellpos_numeric::statistics::quantile;
use cellpos_session::Failure;
use cellpos_vision::Localiser;
use serde::Serialize;

/// Result of the loop's tracker on some frames.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Sight {
    /// Number of frames since it first accepted a bead or cell, without those in which it had left.
    pub frames: u64,
    /// Of these, with a position.
    pub seen: u64,
    /// Frames before the first.
    pub before: u64,
    /// Frames after it was last seen in an outer quarter of the picture: a free bead drifts out.
    pub left: u64,
    /// Noise of a position along the rows, as stated by the fit, median, px.
    pub stated_px: f64,
    /// The same from the steps between successive frames, px; none if the bead's own motion hides it.
    pub measured_px: Option<f64>,
    /// Farthest that it went between two frames, however far apart, px.
    pub way_px: f64,
    /// Contrast over noise, median.
    pub snr: f64,
    /// Time of looking at a frame, median and 99 of 100, us.
    pub look_us: [f64; 2],
}

impl Sight {
    /// The sight of frames with the rig file's settings.
    ///
    /// # Errors
    /// Invalid settings, or a frame of another size than the background of a cell.
    pub fn of(bench: &Bench, frames: &[Kept]) -> Result<Self, Failure> {
        Self::through(&mut Eye::of(bench)?, frames)
    }

    /// The same for a bead, with another localiser.
    ///
    /// # Errors
    /// Invalid settings.
    pub fn of_bead(bench: &Bench, localiser: Localiser, frames: &[Kept]) -> Result<Self, Failure> {
        Self::through(&mut Eye::of_bead(bench, localiser)?, frames)
    }

    fn through(eye: &mut Eye, frames: &[Kept]) -> Result<Self, Failure> {
        let start_ns = frames.first().map_or(0, |kept| kept.stamp.mid_exposure_ns);
        let mut places = Vec::with_capacity(frames.len());
        let (mut sds, mut snrs, mut times_us) = (Vec::new(), Vec::new(), Vec::new());
        // Least and greatest, along the rows and across.
        let mut spans_px = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
        for kept in frames {
            let time_s = (kept.stamp.mid_exposure_ns - start_ns) as f64 * 1e-9;
            let began = std::time::Instant::now();
            let seen = eye.look(&kept.frame, time_s)?;
            times_us.push(began.elapsed().as_secs_f64() * 1e6);
            if let Some(seen) = seen {
                sds.push(seen.sd_px);
                snrs.push(seen.snr);
                for ([least, most], px) in spans_px.iter_mut().zip([seen.x_px, seen.y_px]) {
                    (*least, *most) = (least.min(px), most.max(px));
                }
            }
            places.push((kept.stamp.id, seen.map(|seen| seen.x_px)));
        }
        let [along_px, across_px] = spans_px.map(|[least, most]| (most - least).max(0.0));
        let before = places.iter().take_while(|(_, x)| x.is_none()).count();
        let width = frames.first().map_or(0, |kept| kept.frame.width);
        let left = frames_after_leaving(&places, width as f64);
        Ok(Self {
            frames: (places.len() - before - left) as u64,
            left: left as u64,
            seen: sds.len() as u64,
            before: before as u64,
            stated_px: quantile(&sds, 0.5),
            measured_px: noise_px(&places),
            way_px: f64::hypot(along_px, across_px),
            snr: quantile(&snrs, 0.5),
            look_us: [quantile(&times_us, 0.5), quantile(&times_us, 0.99)],
        })
    }

    /// Share of the frames with a position.
    pub fn recall(&self) -> f64 {
        self.seen as f64 / self.frames.max(1) as f64
    }
}

/// Frames without a bead that was last seen in an outer quarter of a picture of this width.
fn frames_after_leaving(places: &[(u64, Option<f64>)], width_px: f64) -> usize {
    let mut last_px = None;
    let has_left = |(_, x_px): &&(u64, Option<f64>)| {
        last_px = x_px.or(last_px);
        let outside = |x: f64| (x - 0.5 * (width_px - 1.0)).abs() > 0.25 * width_px;
        x_px.is_none() && last_px.is_some_and(outside)
    };
    places.iter().filter(has_left).count()
}

/// Noise of a position from successive frames. Noise correlates successive steps negatively; free motion does not. The blur of
/// the exposure correlates them positively, so this is a lower bound. `None` below twice its uncertainty.
fn noise_px(places: &[(u64, Option<f64>)]) -> Option<f64> {
    let steps: Vec<(f64, f64)> = places
        .windows(3)
        .filter_map(|three| match three {
            [(a, Some(x)), (b, Some(y)), (c, Some(z))] if b - a == 1 && c - b == 1 => {
                Some((y - x, z - y))
            }
            _ => None,
        })
        .collect();
    let n = steps.len() as f64;
    if n < 100.0 {
        return None;
    }
    let mean = steps.iter().map(|(a, b)| 0.5 * (a + b)).sum::<f64>() / n;
    let (mut cross, mut square) = (0.0, 0.0);
    for (a, b) in &steps {
        cross += (a - mean) * (b - mean) / n;
        square += (a - mean) * (a - mean) / n;
    }
    // The covariance of two steps of n is known to the variance of a step over the root of n.
    let uncertain = square / n.sqrt();
    (-cross > 2.0 * uncertain).then(|| (-cross).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_numeric::Random;

    /// Steps of a bead that wanders by `walk` per frame, with localisation noise 1, from random numbers of variance 1.
    fn noise_of(walk: f64) -> Option<f64> {
        let mut random = Random::new(1);
        let mut x = 0.0;
        let places: Vec<(u64, Option<f64>)> = (0..20_000)
            .map(|id| {
                x += walk * random.normal();
                (id, (id % 50 != 7).then(|| x + random.normal()))
            })
            .collect();
        noise_px(&places)
    }

    #[test]
    fn a_bead_that_drifts_out_has_left_and_one_that_is_lost_in_the_middle_has_not() {
        let seen = |x: f64| (0, Some(x));
        let gone = (0, None);
        let drifts = [
            gone,
            seen(32.0),
            gone,
            seen(60.0),
            gone,
            gone,
            seen(3.0),
            gone,
            seen(30.0),
            gone,
        ];
        assert_eq!(frames_after_leaving(&drifts, 64.0), 3);
    }

    #[test]
    fn the_noise_of_a_bead_that_wanders_is_found_and_not_claimed_where_its_motion_hides_it() {
        for walk in [0.0, 1.0, 3.0] {
            let noise = noise_of(walk).expect("noise");
            assert!((noise - 1.0).abs() < 0.15, "walk {walk}: {noise}");
        }
        assert_eq!(noise_of(30.0), None);
        assert_eq!(
            noise_px(&[(0, Some(1.0)), (1, Some(2.0)), (2, Some(1.0))]),
            None
        );
    }
}
