//! Counts of `cellpos vision`, and the figures drawn from them.

use super::vision::Advice;
use cellpos_drivers::CalibrationFile;
use cellpos_drivers::sources::RecordingInfo;
use cellpos_numeric::statistics;
use cellpos_vision::{Cell, Fix, FixQuality};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::Path;

/// Bins of the sub-pixel histogram.
const BINS: usize = 10;

/// What has been seen so far.
#[derive(Debug, Default)]
pub(super) struct Tally {
    /// Time per frame, us.
    pub time_us: Vec<f64>,
    tracks: BTreeMap<u32, Vec<(usize, f64, f64)>>,
    refused: BTreeMap<&'static str, u64>,
    snr: Vec<f64>,
    residual: Vec<f64>,
    sd_px: Vec<f64>,
    subpixel: [u64; BINS],
    cells: Vec<Cell>,
    most_cells: usize,
    frames_without: u64,
}

/// Figures of the run, as printed and as JSON.
#[derive(Debug, Serialize)]
pub(super) struct Summary {
    /// Recording.
    pub source: String,
    /// Kind of recording.
    pub kind: &'static str,
    /// Pixels per row.
    pub width_px: usize,
    /// Rows.
    pub height_px: usize,
    /// Bits per pixel.
    pub bits: u16,
    /// Frames looked at.
    pub frames: usize,
    /// Frames of which the numbers are missing.
    pub lost_frames: u64,
    /// What is to be said of how the recording was read.
    pub note: Option<&'static str>,
    /// Settings found in the recording.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub settings: Option<Advice>,
    /// Beads numbered, or the most cells in a frame.
    pub objects: usize,
    /// Good fixes.
    pub fixes: usize,
    /// Frames without a good fix.
    pub frames_without: u64,
    /// Fixes refused, by verdict.
    pub refused: BTreeMap<&'static str, u64>,
    /// Figures of beads.
    pub beads: Option<BeadFigures>,
    /// Figures of cells.
    pub cells: Option<CellFigures>,
    /// Time per frame.
    pub time_us: Times,
    /// Calibration in force.
    pub calibration: Option<CalibrationFile>,
    /// Folder of the results.
    pub out: String,
}

/// Quality of bead fixes.
#[derive(Debug, Serialize)]
pub(super) struct BeadFigures {
    /// Median signal-to-noise ratio.
    pub snr_median: f64,
    /// Least one.
    pub snr_min: f64,
    /// Median residual ratio.
    pub residual_median: f64,
    /// Largest one.
    pub residual_max: f64,
    /// Median of the standard deviations from the Fisher information, px.
    pub bound_px: f64,
    /// Localisation noise from the recording itself, px; none when it does not show.
    pub noise_px: Option<f64>,
    /// Good fixes by the fractional part of x and y.
    pub subpixel_counts: [u64; BINS],
    /// Chi^2 per degree of freedom of the counts against equal counts.
    pub subpixel_chi2: f64,
}

/// Sizes of cells.
#[derive(Debug, Serialize)]
pub(super) struct CellFigures {
    /// Median area, px.
    pub area_median_px: f64,
    /// Median length, px.
    pub length_median_px: f64,
    /// Median width, px.
    pub width_median_px: f64,
}

/// Quantiles of a time, us.
#[derive(Debug, Serialize)]
pub(super) struct Times {
    /// Median.
    pub p50: f64,
    /// 99th percentile.
    pub p99: f64,
    /// Largest.
    pub max: f64,
}

impl Tally {
    /// A bead's fix in a frame.
    pub(super) fn fix(&mut self, frame: usize, bead: u32, fix: &Fix) {
        if fix.verdict != FixQuality::Good {
            self.refuse(verdict_name(fix.verdict));
            return;
        }
        self.tracks
            .entry(bead)
            .or_default()
            .push((frame, fix.x_px, fix.y_px));
        self.snr.push(fix.snr);
        self.residual.push(fix.residual_ratio);
        self.sd_px
            .push((0.5 * (fix.var_x_px2 + fix.var_y_px2)).sqrt());
        for c in [fix.x_px, fix.y_px] {
            let bin = ((c - c.floor()) * BINS as f64) as usize;
            self.subpixel[bin.min(BINS - 1)] += 1;
        }
    }

    /// Something that was looked at and not taken.
    pub(super) fn refuse(&mut self, reason: &'static str) {
        *self.refused.entry(reason).or_default() += 1;
    }

    /// A cell.
    pub(super) fn cell(&mut self, cell: &Cell) {
        self.cells.push(*cell);
    }

    /// The end of a frame with `good` objects.
    pub(super) fn frame(&mut self, good: usize) {
        self.most_cells = self.most_cells.max(good);
        self.frames_without += u64::from(good == 0);
    }

    /// The figures.
    pub(super) fn summary(
        &self,
        info: &RecordingInfo,
        frames: usize,
        calibration: Option<&CalibrationFile>,
        out: &Path,
    ) -> Summary {
        let beads = (!self.snr.is_empty()).then(|| BeadFigures {
            snr_median: quantile(&self.snr, 0.5),
            snr_min: quantile(&self.snr, 0.0),
            residual_median: quantile(&self.residual, 0.5),
            residual_max: quantile(&self.residual, 1.0),
            bound_px: quantile(&self.sd_px, 0.5),
            noise_px: self.noise_px(),
            subpixel_counts: self.subpixel,
            subpixel_chi2: uniformity(&self.subpixel),
        });
        let of =
            |get: fn(&Cell) -> f64| quantile(&self.cells.iter().map(get).collect::<Vec<_>>(), 0.5);
        let cells = (!self.cells.is_empty()).then(|| CellFigures {
            area_median_px: of(|c| c.area_px),
            length_median_px: of(|c| c.axes_px().0),
            width_median_px: of(|c| c.axes_px().1),
        });
        Summary {
            source: info.path.display().to_string(),
            kind: info.kind,
            width_px: info.width_px,
            height_px: info.height_px,
            bits: info.bits,
            frames,
            lost_frames: info.lost,
            note: info.note,
            settings: None,
            objects: if cells.is_some() {
                self.most_cells
            } else {
                self.tracks.len()
            },
            fixes: self.snr.len() + self.cells.len(),
            frames_without: self.frames_without,
            refused: self.refused.clone(),
            beads,
            cells,
            time_us: Times {
                p50: quantile(&self.time_us, 0.5),
                p99: quantile(&self.time_us, 0.99),
                max: quantile(&self.time_us, 1.0),
            },
            calibration: calibration.cloned(),
            out: out.display().to_string(),
        }
    }

    /// Localisation noise from the steps of the beads: an error in one position enters two successive steps with
    /// opposite signs, so their covariance is minus the noise's variance, whatever the diffusion.
    fn noise_px(&self) -> Option<f64> {
        let (mut sum, mut squares, mut n) = (0.0, 0.0, 0.0_f64);
        for track in self.tracks.values() {
            let pairs: Vec<[f64; 4]> = track
                .windows(3)
                .filter(|w| w[1].0 == w[0].0 + 1 && w[2].0 == w[1].0 + 1)
                .map(|w| {
                    [
                        w[1].1 - w[0].1,
                        w[2].1 - w[1].1,
                        w[1].2 - w[0].2,
                        w[2].2 - w[1].2,
                    ]
                })
                .collect();
            let count = pairs.len() as f64;
            if count < 10.0 {
                continue;
            }
            let mean = |k: usize| pairs.iter().map(|p| p[k]).sum::<f64>() / count;
            let m = [mean(0), mean(1), mean(2), mean(3)];
            for p in &pairs {
                for product in [(p[0] - m[0]) * (p[1] - m[1]), (p[2] - m[2]) * (p[3] - m[3])] {
                    sum += product;
                    squares += product * product;
                    n += 1.0;
                }
            }
        }
        // Large steps hide small errors: what lies within two standard errors of zero shows nothing.
        (-sum > 2.0 * f64::sqrt(squares)).then(|| (-sum / n).sqrt())
    }
}

/// The word for a verdict.
pub(super) fn verdict_name(verdict: FixQuality) -> &'static str {
    match verdict {
        FixQuality::Good => "good",
        FixQuality::NoSignal => "no-signal",
        FixQuality::BadFit => "bad-fit",
        FixQuality::AtBorder => "at-border",
        FixQuality::NotConverged => "not-converged",
    }
}

fn quantile(values: &[f64], q: f64) -> f64 {
    let values = if values.is_empty() { &[0.0] } else { values };
    statistics::quantile(values, q)
}

fn uniformity(counts: &[u64; BINS]) -> f64 {
    let mean = counts.iter().sum::<u64>() as f64 / BINS as f64;
    let chi2: f64 = counts
        .iter()
        .map(|n| (*n as f64 - mean).powi(2) / mean.max(1e-9))
        .sum();
    chi2 / (BINS - 1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A bead that diffuses by `step_px` per frame and is located with the error `noise_px`.
    fn tally(frames: usize, step_px: f64, noise_px: f64) -> Tally {
        let mut random = cellpos_numeric::Random::new(3);
        let mut tally = Tally::default();
        let (mut x, mut y) = (100.0, 50.0);
        for n in 0..frames {
            x += step_px * random.normal();
            y += step_px * random.normal();
            let (ex, ey) = (noise_px * random.normal(), noise_px * random.normal());
            tally.fix(
                n,
                0,
                &Fix {
                    x_px: x + ex,
                    y_px: y + ey,
                    ..Fix::none(0.0, 0.0, FixQuality::Good)
                },
            );
        }
        tally
    }

    #[test]
    fn localisation_noise_is_told_from_diffusion() {
        let noise_px = tally(40_000, 0.3, 0.1).noise_px().expect("the noise shows");
        assert!((noise_px - 0.1).abs() < 0.005, "{noise_px}");
    }

    #[test]
    fn localisation_noise_hidden_by_large_steps_is_not_invented() {
        assert_eq!(tally(50, 1.0, 0.005).noise_px(), None);
    }

    #[test]
    fn equal_counts_are_uniform_and_locked_ones_are_not() {
        assert!(uniformity(&[100; BINS]) < 1e-9);
        let mut locked = [20; BINS];
        locked[0] = 900;
        assert!(uniformity(&locked) > 100.0);
    }
}
