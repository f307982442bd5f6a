//! The cell at one place: mean length and area with their uncertainty.

use cellpos_runtime::TickRecord;
use std::collections::VecDeque;

/// The reference is at one place within this, um: a hundredth of a cell of 10 um.
const SAME_PLACE_UM: f64 = 0.1;
/// The cell is there within this, um: some times the error of holding it, and a tenth of a cell.
const THERE_UM: f64 = 1.0;
/// Frames that are averaged at most, the newest ones: seconds of a rest that may last for an hour.
const MOST: usize = 4000;
/// Blocks whose scatter gives the uncertainty of a mean: errors of neighbouring frames (focus, light, outline) are correlated.
const BLOCKS: usize = 10;

/// A mean and its standard deviation; NaN if nothing was measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct MeanSd {
    pub(super) mean: f64,
    pub(super) sd: f64,
}

/// A rest at one place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Rest {
    at_um: f64,
    pub(super) length_um: MeanSd,
    pub(super) area_um2: MeanSd,
}

impl Rest {
    /// Whether it was at a place, um.
    pub(super) fn was_at(&self, place_um: f64) -> bool {
        (self.at_um - place_um).abs() <= SAME_PLACE_UM
    }
}

/// The measurements at the reference's present place.
#[derive(Debug, Default)]
pub(super) struct Resting {
    at_um: Option<f64>,
    lengths: VecDeque<(f64, f64)>,
    areas: VecDeque<(f64, f64)>,
}

impl Resting {
    /// Takes a frame with the reference at its exposure. If the reference has left its place, returns the rest that is over.
    pub(super) fn add(&mut self, record: &TickRecord, target_um: f64) -> Option<Rest> {
        let same = |at: f64| (target_um - at).abs() <= SAME_PLACE_UM;
        let over = match self.at_um {
            Some(at_um) if same(at_um) => None,
            _ => {
                let over = self.so_far();
                self.lengths.clear();
                self.areas.clear();
                self.at_um = Some(target_um);
                over
            }
        };
        if record.verdict == 0 && (record.measured_um - target_um).abs() <= THERE_UM {
            keep(&mut self.lengths, record.length_um, record.length_sd_um);
            keep(&mut self.areas, record.area_um2, record.area_sd_um2);
        }
        over
    }

    /// The rest up to now; `None` before the first.
    pub(super) fn so_far(&self) -> Option<Rest> {
        Some(Rest {
            at_um: self.at_um?,
            length_um: mean(&self.lengths),
            area_um2: mean(&self.areas),
        })
    }
}

fn keep(values: &mut VecDeque<(f64, f64)>, value: f64, sd: f64) {
    if value.is_finite() {
        if values.len() >= MOST {
            values.pop_front();
        }
        values.push_back((value, sd));
    }
}

/// The mean of values with stated standard deviations. Its uncertainty comes from the scatter of the means of blocks, and is at least
/// that of the stated deviations.
fn mean(values: &VecDeque<(f64, f64)>) -> MeanSd {
    let n = values.len() as f64;
    let mean = values.iter().map(|(value, _)| value).sum::<f64>() / n;
    let stated: Vec<f64> = values
        .iter()
        .filter_map(|(_, sd)| sd.is_finite().then_some(sd * sd))
        .collect();
    let stated = (stated.iter().sum::<f64>() / stated.len() as f64 / n).sqrt();
    let length = values.len().div_ceil(BLOCKS.min(values.len().max(1)));
    let flat: Vec<f64> = values.iter().map(|(value, _)| *value).collect();
    let blocks: Vec<f64> = flat
        .chunks(length.max(1))
        .map(|block| block.iter().sum::<f64>() / block.len() as f64)
        .collect();
    let m = blocks.len() as f64;
    let middle = blocks.iter().sum::<f64>() / m;
    let square: f64 = blocks.iter().map(|block| (block - middle).powi(2)).sum();
    let scattered = (square / (m - 1.0) / m).sqrt();
    // `max` ignores unknown values: one frame has no scatter, and a record may lack stated deviations.
    MeanSd {
        mean,
        sd: scattered.max(stated),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(length_um: f64, measured_um: f64) -> TickRecord {
        TickRecord {
            length_um,
            length_sd_um: 0.05,
            measured_um,
            verdict: 0,
            ..TickRecord::unknown()
        }
    }

    #[test]
    fn the_length_at_rest_is_a_mean_over_the_rest_with_its_uncertainty() {
        let mut resting = Resting::default();
        // On its way there, off its place, another place before.
        for _ in 0..50 {
            assert!(
                resting
                    .add(&frame(30.0, 5.0), 5.0)
                    .is_none_or(|rest| !rest.was_at(0.0))
            );
        }
        assert!(
            resting
                .add(&frame(30.0, 3.0), 0.0)
                .is_some_and(|rest| rest.was_at(5.0))
        );
        let mut random = cellpos_numeric::Random::new(1);
        for _ in 0..400 {
            // The mean of 400 is known to 0.005.
            resting.add(&frame(9.5 + 0.1 * random.normal(), 0.05), 0.01);
        }
        let rest = resting
            .add(&frame(20.0, 0.4), 0.4)
            .expect("the rest is over");
        assert!(rest.was_at(0.0));
        let MeanSd { mean, sd } = rest.length_um;
        assert!((mean - 9.5).abs() < 4.0 * 0.005, "{mean}");
        assert!((0.0025..0.009).contains(&sd), "{sd}");
        assert!(rest.area_um2.mean.is_nan() && rest.area_um2.sd.is_nan());
    }

    #[test]
    fn one_frame_is_known_to_what_it_states() {
        let mut resting = Resting::default();
        resting.add(&frame(9.5, 0.0), 0.0);
        let rest = resting.so_far().expect("a rest").length_um;
        assert_eq!((rest.mean, rest.sd), (9.5, 0.05));
    }

    #[test]
    fn errors_that_go_together_make_a_mean_less_certain_than_their_number_says() {
        let mut resting = Resting::default();
        // A slow wave of 0.1 um over the rest.
        for k in 0..1000 {
            let um = 9.5 + 0.1 * (f64::from(k) * 0.00628).sin();
            resting.add(&frame(um, 0.0), 0.0);
        }
        let sd = resting.so_far().expect("a rest").length_um.sd;
        assert!(sd > 0.015, "{sd}: independent frames would say 0.002");
    }
}
