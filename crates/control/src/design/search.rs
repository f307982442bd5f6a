//! Gains of a PI controller for a plant: the largest integral gain under limits on the peaks of S and T.
//!
//! The integral gain is the inverse of the integrated error after a step of drift, so the criterion is "the fastest
//! rejection of flow drift that the limits allow". For each proportional gain the largest integral gain is found by
//! bisection, then the best proportional gain by a scan and golden section.

use crate::design::margins::{Grid, is_stable};
use crate::design::plant::DesignPlant;
use crate::linear::LinearLaw;
use crate::pi::{Lead, Pi};
use cellpos_numeric::golden_section;
use cellpos_plant::{Hertz, PlantError};

/// How exactly the best proportional gain is found, as a part of two steps of the scan.
const KP_TOLERANCE: f64 = 7e-5;

/// What to search under.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PiSearch {
    /// Limit on the peak of the sensitivity.
    pub max_ms: f64,
    /// Limit on the peak of the complementary sensitivity.
    pub max_mt: f64,
    /// Lead to search with.
    pub lead: Option<Lead>,
}

impl Default for PiSearch {
    fn default() -> Self {
        Self {
            max_ms: 1.6,
            max_mt: 1.3,
            lead: None,
        }
    }
}

struct Problem<'a> {
    plant: &'a DesignPlant,
    grid: Grid,
    search: PiSearch,
    sign: f64,
}

impl Problem<'_> {
    fn law(&self, kp: f64, ki: f64) -> LinearLaw {
        let pi = Pi {
            lead: self.search.lead,
            ..Pi::new(self.sign * kp, self.sign * ki)
        };
        LinearLaw::Pi {
            pi,
            sample_time_s: self.plant.sample_time_s,
        }
    }

    fn allowed(&self, kp: f64, ki: f64) -> bool {
        let law = self.law(kp, ki);
        let (ms, mt) = self.grid.peaks(&law);
        ms <= self.search.max_ms
            && mt <= self.search.max_mt
            && is_stable(self.plant, &law).unwrap_or(false)
    }

    /// Largest integral gain for a proportional one, 0 if none is allowed.
    fn best_ki(&self, kp: f64) -> f64 {
        let scale = kp / self.plant.sample_time_s;
        let (mut low, mut high) = (1e-6 * scale, scale);
        if !self.allowed(kp, low) {
            return 0.0;
        }
        for _ in 0..40 {
            let middle = (low * high).sqrt();
            if self.allowed(kp, middle) {
                low = middle
            } else {
                high = middle
            }
        }
        low
    }

    /// The integral gain, lowered until the peaks between the points of the search's grid keep the limits, too.
    fn within_limits(&self, kp: f64, ki: f64) -> Result<f64, PlantError> {
        /// Points per decade: as the margins that are reported.
        const FINE: usize = 400;
        let grid = Grid::new(self.plant, FINE)?;
        let mut allowed = ki;
        for _ in 0..100 {
            let m = grid.margins(&self.law(kp, allowed));
            if m.ms <= self.search.max_ms && m.mt <= self.search.max_mt {
                break;
            }
            allowed *= 0.999;
        }
        Ok(allowed)
    }
}

/// The PI controller (with the search's lead, if any) of largest integral gain; `None` if no gain keeps the limits.
///
/// # Errors
/// A sample time or delay that cannot be discretised.
pub fn search_pi(plant: &DesignPlant, search: PiSearch) -> Result<Option<Pi>, PlantError> {
    let velocity_gain = plant.plant.velocity_gain_at(Hertz(20.0));
    let sign = match plant.loop_model() {
        Ok(model) => model.gain_per_s.signum(),
        Err(_) => 1.0,
    };
    let problem = Problem {
        plant,
        grid: Grid::new(plant, 80)?,
        search,
        sign,
    };
    // A pure integrator with delay T becomes unstable at kp = pi / (2 K T).
    let mut highest = 2.0 / (velocity_gain * plant.loop_delay_s());
    let scan_to = |highest: f64| -> Vec<(f64, f64)> {
        (1..=60)
            .map(|i| highest * f64::from(i) / 60.0)
            .map(|kp| (kp, problem.best_ki(kp)))
            .collect()
    };
    let best_of = |scan: &[(f64, f64)]| {
        (0..scan.len())
            .max_by(|&i, &j| scan[i].1.total_cmp(&scan[j].1))
            .filter(|&best| scan[best].1 > 0.0)
    };
    let mut scan = scan_to(highest);
    // A plant that has lost half of its gain by 20 Hz lags there: lags count like delay and lower the gain that the scan begins
    // with, so that a regulator of seconds needs a hundredth of it.
    let lags = plant.plant.velocity_gain_at(Hertz(0.5)).abs() > 2.0 * velocity_gain.abs();
    for _ in 0..2 {
        if lags && best_of(&scan).is_none() {
            highest /= 30.0;
            scan = scan_to(highest);
        }
    }
    let Some(best) = best_of(&scan) else {
        return Ok(None);
    };
    let step = highest / 60.0;
    let (low, high) = (scan[best].0 - step, scan[best].0 + step);
    let refined = golden_section(low, high, KP_TOLERANCE, |kp| -problem.best_ki(kp));
    let (kp, ki) = std::iter::once((refined, problem.best_ki(refined)))
        .chain(std::iter::once(scan[best]))
        .max_by(|a, b| a.1.total_cmp(&b.1))
        .unwrap_or(scan[best]);
    let ki = problem.within_limits(kp, ki)?;
    Ok(Some(Pi {
        lead: search.lead,
        ..Pi::new(sign * kp, sign * ki)
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::design::margins;

    #[test]
    fn found_gains_keep_the_limits_and_reject_drift_at_least_as_well_as_the_published_ones() {
        for (delay_s, published_ki) in [(2.5e-3, 19.5), (3.5e-3, 9.6)] {
            let plant = DesignPlant::eq6(delay_s);
            let pi = search_pi(&plant, PiSearch::default()).unwrap().unwrap();
            let m = margins(
                &plant,
                &LinearLaw::Pi {
                    pi,
                    sample_time_s: 1e-3,
                },
            )
            .unwrap();
            assert!(m.stable && m.ms <= 1.6 && m.mt <= 1.3, "{m:?}");
            assert!(pi.ki_per_s >= published_ki, "{pi:?}");
        }
    }

    #[test]
    fn a_plant_of_opposite_sign_gets_gains_of_opposite_sign() {
        let plant = DesignPlant::eq6(2.5e-3);
        let turned = plant.changed(-1.0, 0).unwrap();
        let (a, b) = (
            search_pi(&plant, PiSearch::default()).unwrap(),
            search_pi(&turned, PiSearch::default()).unwrap(),
        );
        let (a, b) = (a.unwrap(), b.unwrap());
        assert!((a.kp + b.kp).abs() < 1e-9 && (a.ki_per_s + b.ki_per_s).abs() < 1e-9);
    }

    #[test]
    fn a_pressure_regulator_of_50_ms_commanded_every_20_ms_gets_gains() {
        let lag = cellpos_plant::TransferFunction::new(vec![1.0], vec![0.05, 1.0]).unwrap();
        let eq6 = DesignPlant::eq6(2.5e-3);
        let plant = DesignPlant {
            plant: eq6.plant.series(&lag).unwrap(),
            delay_s: 2e-3,
            sample_time_s: 20e-3,
            ..eq6
        };
        let pi = search_pi(&plant, PiSearch::default()).unwrap().unwrap();
        let law = LinearLaw::Pi {
            pi,
            sample_time_s: 20e-3,
        };
        let m = margins(&plant, &law).unwrap();
        assert!(m.stable && m.ms <= 1.6 && m.mt <= 1.3, "{m:?}");
        // What an integrator with the delay of lag, hold and camera together would get.
        let expected = 0.46 * 2.5 / 62.0;
        assert!((0.5 * expected..2.0 * expected).contains(&pi.kp), "{pi:?}");
    }

    #[test]
    fn limits_that_no_gain_keeps_give_no_gains() {
        let search = PiSearch {
            max_ms: 1.01,
            max_mt: 1.0001,
            lead: None,
        };
        assert_eq!(search_pi(&DesignPlant::eq6(2.5e-3), search).unwrap(), None);
    }
}
