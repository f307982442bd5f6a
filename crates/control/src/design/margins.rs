//! Margins and sensitivities of a linear loop, on its frequency response up to the Nyquist frequency.

use crate::design::plant::DesignPlant;
use crate::linear::LinearLaw;
use cellpos_numeric::golden_section;
use cellpos_plant::{DiscretePlant, PlantError};
use nalgebra::{Complex, DMatrix, Schur};
use std::f64::consts::{PI, TAU};

/// Margins of a loop. With `stable = false` the other figures describe the open loop's curve only.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Margins {
    /// All closed-loop poles lie inside the unit circle.
    pub stable: bool,
    /// Largest magnitude of a closed-loop pole.
    pub spectral_radius: f64,
    /// Smallest phase margin over all gain crossovers, deg; infinite without a crossover.
    pub pm_deg: f64,
    /// Frequency of that crossover, Hz.
    pub crossover_hz: f64,
    /// Smallest factor on the gain, in dB, that makes the loop unstable; infinite without a phase crossover.
    pub gm_db: f64,
    /// Smallest extra dead time that makes the loop unstable, s.
    pub delay_margin_s: f64,
    /// Peak of the sensitivity `S = 1 / (1 + L)`.
    pub ms: f64,
    /// Where, Hz.
    pub ms_hz: f64,
    /// Peak of the complementary sensitivity `T = L / (1 + L)`.
    pub mt: f64,
    /// Where, Hz.
    pub mt_hz: f64,
    /// Disturbances below this frequency are reduced: the first at which `|S|` reaches 1, Hz.
    pub s_below_1_hz: f64,
    /// The first frequency at which `|T|` falls below -3 dB, Hz.
    pub bandwidth_3db_hz: f64,
}

/// The plant's frequency response on a grid, so that many control laws can be weighed on it.
#[derive(Debug, Clone)]
pub(crate) struct Grid {
    plant: DiscretePlant,
    sample_time_s: f64,
    points: Vec<(f64, Complex<f64>, Complex<f64>)>,
}

impl Grid {
    pub(crate) fn new(plant: &DesignPlant, per_decade: usize) -> Result<Self, PlantError> {
        let measured = plant.measured()?;
        let nyquist_hz = 0.5 / plant.sample_time_s;
        let low_hz = 1e-5 * nyquist_hz;
        let count = 5 * per_decade;
        let points = (0..=count)
            .map(|i| low_hz * (nyquist_hz / low_hz).powf(i as f64 / count as f64))
            .map(|hz| {
                let z = Complex::from_polar(1.0, TAU * hz * plant.sample_time_s);
                (hz, z, measured.at(z))
            })
            .collect();
        Ok(Self {
            plant: measured,
            sample_time_s: plant.sample_time_s,
            points,
        })
    }

    fn loop_gain(&self, law: &LinearLaw, hz: f64) -> Complex<f64> {
        let z = Complex::from_polar(1.0, TAU * hz * self.sample_time_s);
        law.at(z) * self.plant.at(z)
    }

    /// Peaks of |S| and |T| only, on the grid: for searches.
    pub(crate) fn peaks(&self, law: &LinearLaw) -> (f64, f64) {
        let mut squares = (0.0_f64, 0.0_f64);
        for (_, z, p) in &self.points {
            let l = law.at(*z) * p;
            let s = 1.0 / (l + 1.0).norm_sqr();
            squares = (squares.0.max(s), squares.1.max(s * l.norm_sqr()));
        }
        (squares.0.sqrt(), squares.1.sqrt())
    }

    pub(crate) fn margins(&self, law: &LinearLaw) -> Margins {
        let curve: Vec<(f64, Complex<f64>)> = self
            .points
            .iter()
            .map(|(hz, z, p)| (*hz, law.at(*z) * p))
            .collect();
        let spectral_radius = spectral_radius(&closed_loop(&self.plant, law));
        let mut m = Margins {
            stable: spectral_radius < 1.0,
            spectral_radius,
            pm_deg: f64::INFINITY,
            crossover_hz: f64::NAN,
            gm_db: f64::INFINITY,
            delay_margin_s: f64::INFINITY,
            ms: 0.0,
            ms_hz: f64::NAN,
            mt: 0.0,
            mt_hz: f64::NAN,
            s_below_1_hz: f64::INFINITY,
            bandwidth_3db_hz: f64::INFINITY,
        };
        let sensitivity = |hz: f64| (self.loop_gain(law, hz) + 1.0).inv().norm();
        let complementary = |hz: f64| {
            let l = self.loop_gain(law, hz);
            (l / (l + 1.0)).norm()
        };
        for pair in curve.windows(2) {
            let [(f0, l0), (f1, l1)] = [pair[0], pair[1]];
            if (l0.norm() - 1.0) * (l1.norm() - 1.0) <= 0.0 {
                let hz = bisect(f0, f1, |hz| self.loop_gain(law, hz).norm() - 1.0);
                let angle = self.loop_gain(law, hz).arg();
                // Angle from -180 deg, on the side from which more lag brings it there.
                let pm = (angle + PI).rem_euclid(TAU);
                m.delay_margin_s = m.delay_margin_s.min(pm / (TAU * hz));
                let nearest = pm.min(TAU - pm);
                if nearest.to_degrees() < m.pm_deg {
                    m.pm_deg = nearest.to_degrees();
                    m.crossover_hz = hz;
                }
            }
            if l0.im * l1.im <= 0.0 && l0.re < 0.0 && l1.re < 0.0 {
                let hz = bisect(f0, f1, |hz| self.loop_gain(law, hz).im);
                let gain = self.loop_gain(law, hz).norm();
                if gain < 1.0 && gain > 0.0 {
                    m.gm_db = m.gm_db.min(-20.0 * gain.log10());
                }
            }
            if m.s_below_1_hz.is_infinite() {
                let (s0, s1) = ((l0 + 1.0).inv().norm(), (l1 + 1.0).inv().norm());
                if s0 >= 1.0 {
                    m.s_below_1_hz = f0;
                } else if s1 >= 1.0 {
                    m.s_below_1_hz = bisect(f0, f1, |hz| sensitivity(hz) - 1.0);
                }
            }
            if m.bandwidth_3db_hz.is_infinite() {
                let level = 0.5_f64.sqrt();
                let (t0, t1) = (l0 / (l0 + 1.0), l1 / (l1 + 1.0));
                if t0.norm() >= level && t1.norm() < level {
                    m.bandwidth_3db_hz = bisect(f0, f1, |hz| complementary(hz) - level);
                }
            }
        }
        (m.ms_hz, m.ms) = peak(&curve, sensitivity, |l| (l + 1.0).inv().norm());
        (m.mt_hz, m.mt) = peak(&curve, complementary, |l| (l / (l + 1.0)).norm());
        m
    }
}

/// Margins of a law on a plant.
///
/// # Errors
/// A sample time or delay that cannot be discretised.
pub fn margins(plant: &DesignPlant, law: &LinearLaw) -> Result<Margins, PlantError> {
    Ok(Grid::new(plant, 400)?.margins(law))
}

/// Whether the loop's poles lie inside the unit circle; poles that cannot be computed do not.
pub(crate) fn is_stable(plant: &DesignPlant, law: &LinearLaw) -> Result<bool, PlantError> {
    Ok(spectral_radius(&closed_loop(&plant.measured()?, law)) < 1.0)
}

fn closed_loop(plant: &DiscretePlant, law: &LinearLaw) -> DMatrix<f64> {
    let (pa, pb, pc) = plant.matrices();
    let (a, b, c, d) = law.matrices();
    let (n, m) = (pa.nrows(), a.nrows());
    let mut closed = DMatrix::zeros(n + m, n + m);
    closed
        .view_mut((0, 0), (n, n))
        .copy_from(&(&pa - &pb * &pc * d));
    closed.view_mut((0, n), (n, m)).copy_from(&(-(&pb * &c)));
    closed.view_mut((n, 0), (m, n)).copy_from(&(&b * &pc));
    closed.view_mut((n, n), (m, m)).copy_from(&a);
    closed
}

/// Largest magnitude of an eigenvalue; NaN if it cannot be computed: the entries are NaN, or so badly scaled that the iteration
/// does not end.
fn spectral_radius(a: &DMatrix<f64>) -> f64 {
    /// Sweeps for each row; a sound matrix needs two or three.
    const SWEEPS: usize = 60;
    if !a.iter().all(|entry| entry.is_finite()) {
        return f64::NAN;
    }
    let schur = Schur::try_new(a.clone(), f64::EPSILON, SWEEPS * a.nrows().max(1));
    schur.map_or(f64::NAN, |schur| {
        let radius = |most: f64, v: &Complex<f64>| most.max(v.norm());
        schur.complex_eigenvalues().iter().fold(0.0, radius)
    })
}

fn bisect(mut low: f64, mut high: f64, f: impl Fn(f64) -> f64) -> f64 {
    let sign = f(low);
    for _ in 0..60 {
        let middle = (low * high).sqrt();
        if (f(middle) > 0.0) == (sign > 0.0) {
            low = middle
        } else {
            high = middle
        }
    }
    (low * high).sqrt()
}

/// Largest value: on the curve, then by golden section between the neighbours.
fn peak(
    curve: &[(f64, Complex<f64>)],
    exact: impl Fn(f64) -> f64,
    at: impl Fn(Complex<f64>) -> f64,
) -> (f64, f64) {
    let values: Vec<f64> = curve.iter().map(|(_, l)| at(*l)).collect();
    let best = (0..values.len())
        .max_by(|&i, &j| values[i].total_cmp(&values[j]))
        .unwrap_or(0);
    let hz = golden_section(
        curve[best.saturating_sub(1)].0,
        curve[(best + 1).min(curve.len() - 1)].0,
        0.0,
        |hz| -exact(hz),
    );
    let refined = exact(hz);
    if refined > values[best] {
        (hz, refined)
    } else {
        (curve[best].0, values[best])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pi::Pi;
    use cellpos_plant::TransferFunction;

    fn law(kp: f64, ki: f64) -> LinearLaw {
        LinearLaw::Pi {
            pi: Pi::new(kp, ki),
            sample_time_s: 1e-3,
        }
    }

    #[test]
    fn a_proportional_loop_on_an_integrator_has_the_margins_of_the_closed_form() {
        // L = a / (z^d (z - 1)): |L| = a / (2 sin(w/2)), arg = -90 deg - w/2 - d w.
        let (k, kp, d) = (400.0, 0.3, 2.0);
        let plant = DesignPlant {
            plant: TransferFunction::integrator(k).unwrap(),
            ..DesignPlant::eq6(2.5e-3)
        };
        let m = margins(&plant, &law(kp, 0.0)).unwrap();
        let a: f64 = k * kp * 1e-3;
        let wc = 2.0 * (0.5 * a).asin();
        let pm = 0.5 * PI - wc * (0.5 + d);
        assert!((m.crossover_hz - wc / TAU * 1e3).abs() < 1e-6 * m.crossover_hz);
        assert!((m.pm_deg - pm.to_degrees()).abs() < 1e-6);
        assert!((m.delay_margin_s - 1e-3 * pm / wc).abs() < 1e-9);
        let w180 = 0.5 * PI / (0.5 + d);
        let gm = 20.0 * (2.0 * (0.5 * w180).sin() / a).log10();
        assert!((m.gm_db - gm).abs() < 1e-6, "{} {gm}", m.gm_db);
        assert!(m.stable);
    }

    #[test]
    fn a_loop_is_unstable_exactly_beyond_its_gain_margin() {
        let plant = DesignPlant::eq6(2.5e-3);
        let m = margins(&plant, &law(0.46, 19.5)).unwrap();
        let factor = 10f64.powf(m.gm_db / 20.0);
        for (f, stable) in [(0.999 * factor, true), (1.001 * factor, false)] {
            let changed = plant.changed(f, 0).unwrap();
            assert_eq!(
                margins(&changed, &law(0.46, 19.5)).unwrap().stable,
                stable,
                "at {f}"
            );
        }
    }

    #[test]
    fn a_loop_is_unstable_exactly_beyond_its_delay_margin() {
        let plant = DesignPlant::eq6(2.5e-3);
        let m = margins(&plant, &law(0.46, 19.5)).unwrap();
        for (f, stable) in [(0.98, true), (1.02, false)] {
            let changed = DesignPlant {
                delay_s: plant.delay_s + f * m.delay_margin_s,
                ..plant.clone()
            };
            assert_eq!(
                margins(&changed, &law(0.46, 19.5)).unwrap().stable,
                stable,
                "at {f}"
            );
        }
    }

    #[test]
    fn the_published_gains_have_the_published_margins() {
        let m = margins(&DesignPlant::eq6(2.5e-3), &law(0.46, 19.5)).unwrap();
        let near = |value: f64, wanted: f64| {
            assert!((value / wanted - 1.0).abs() < 0.02, "{value} for {wanted}")
        };
        near(m.pm_deg, 48.7);
        near(m.gm_db, 10.6);
        near(m.delay_margin_s * 1e3, 4.66);
        near(m.ms, 1.58);
        near(m.mt, 1.30);
    }

    #[test]
    fn the_ideal_predictor_limit_bounds_the_rejection_of_a_good_loop() {
        // |S| < 1 ends at 1/(6T) for the ideal predictor: 67 Hz at 2.5 ms. PI stays below.
        let m = margins(&DesignPlant::eq6(2.5e-3), &law(0.46, 19.5)).unwrap();
        assert!(
            m.s_below_1_hz < 67.0 && m.s_below_1_hz > 10.0,
            "{}",
            m.s_below_1_hz
        );
    }
}
