//! The weight of commands that a path needs.
//!
//! Less weight holds the bead closer and leaves less room for a plant that is not the model. That room is asked for at a plant of twice
//! the gain with one more frame of delay. [`Lqg::default`] answers it where every frame has its tick. A frame of a faster
//! camera is a small part of a tick, so the same room costs a slow actuator less weight.

use crate::design::margins::{Grid, is_stable};
use crate::design::plant::DesignPlant;
use crate::design::report::estimator_config;
use crate::lqg::Lqg;
use crate::mpc::Mpc;

/// Largest peak of S for twice the gain with one more frame of delay: that of [`Lqg::default`] on Eq. (6) with the camera path of
/// 2 ms at 1 kHz and exact fixes.
const MOST_AT_THE_CORNER: f64 = 12.4;
/// Gain of the plant there over that of the model.
const GAIN: f64 = 2.0;
/// Weights that are tried, from the least to the usual: a factor of 1.5 apart, which is 2 % of the hold error.
const TRIED: i32 = 20;

impl Lqg {
    /// The law for a path whose camera has a frame each `frame_s`, s: the least weight within the margin of the module's text; if
    /// there is none, the usual weight.
    pub fn for_path(plant: &DesignPlant, frame_s: f64) -> Self {
        let usual = Self::default();
        // A frame a tick, or less: the usual weight answers that.
        if frame_s >= 0.99 * plant.sample_time_s {
            return usual;
        }
        (0..TRIED)
            .map(|step| Self {
                effort: usual.effort * 1.5_f64.powi(step - TRIED),
            })
            .find(|lqg| {
                peak_at_the_corner(lqg, plant, frame_s).is_some_and(|ms| ms <= MOST_AT_THE_CORNER)
            })
            .unwrap_or(usual)
    }
}

impl Mpc {
    /// The law whose weights stand to the usual ones as LQG's do ([`Lqg::for_path`]).
    pub fn for_path(plant: &DesignPlant, frame_s: f64) -> Self {
        let usual = Self::default();
        let share = Lqg::for_path(plant, frame_s).effort / Lqg::default().effort;
        Self {
            effort: share * usual.effort,
            move_effort: share * usual.move_effort,
            ..usual
        }
    }
}

/// Peak of S for twice the gain with one more frame of delay; `None` if the loop is not stable there.
fn peak_at_the_corner(lqg: &Lqg, plant: &DesignPlant, frame_s: f64) -> Option<f64> {
    /// Points per decade of the search: the peak is wide in its logarithm.
    const POINTS: usize = 200;
    let model = plant.loop_model().ok()?;
    let law = lqg.feedback(&model).ok()?;
    let law = law.linear(&estimator_config(plant), &model).ok()?;
    let corner = DesignPlant {
        delay_s: plant.delay_s + frame_s,
        ..plant.changed(GAIN, 0).ok()?
    };
    let stable = is_stable(&corner, &law).unwrap_or(false);
    stable.then(|| {
        Grid::new(&corner, POINTS)
            .ok()
            .map(|grid| grid.peaks(&law).0)
    })?
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::design::{bound_rms_of_path_um, noise_figures};
    use cellpos_plant::TransferFunction;

    /// Eq. (6) or an integrator behind lags, commanded every 20 ms, frames at 1 kHz.
    fn behind(lags_s: &[f64], integrator: bool) -> DesignPlant {
        let bare = match integrator {
            true => TransferFunction::integrator(428.0).unwrap(),
            false => TransferFunction::eq6(),
        };
        let lag = |s: f64| TransferFunction::new(vec![1.0], vec![s, 1.0]).unwrap();
        DesignPlant {
            plant: (lags_s.iter()).fold(bare, |plant, s| plant.series(&lag(*s)).unwrap()),
            delay_s: 2e-3,
            sample_time_s: 20e-3,
            ..DesignPlant::eq6(2.5e-3)
        }
    }

    #[test]
    fn the_usual_weight_is_the_answer_to_a_frame_a_tick() {
        let exact = DesignPlant {
            fix_noise_um: 2e-3,
            ..DesignPlant::eq6(2.5e-3)
        };
        let at = |effort: f64| peak_at_the_corner(&Lqg { effort }, &exact, 1e-3);
        let usual = Lqg::default().effort;
        assert!(at(usual).unwrap() <= MOST_AT_THE_CORNER);
        assert!(at(0.98 * usual).unwrap() > MOST_AT_THE_CORNER);
        assert_eq!(Lqg::for_path(&exact, 1e-3), Lqg::default());
    }

    #[test]
    fn a_slow_actuator_before_a_fast_camera_holds_within_15_percent_of_its_bound() {
        for (lags_s, integrator) in [
            (&[][..], false),
            (&[0.02], false),
            (&[0.05], false),
            (&[0.1], false),
            (&[0.2], false),
            (&[0.05, 0.02], true),
        ] {
            for noise_um in [1e-3, 0.02, 0.03] {
                let plant = DesignPlant {
                    fix_noise_um: noise_um,
                    ..behind(lags_s, integrator)
                };
                let model = plant.loop_model().unwrap();
                let lqg = Lqg::for_path(&plant, 1e-3);
                let law = lqg.feedback(&model).unwrap();
                let law = law.linear(&estimator_config(&plant), &model).unwrap();
                let held = noise_figures(&plant, &law).unwrap().unwrap().rms_um;
                let bound = bound_rms_of_path_um(plant.diffusion_um2_per_s, noise_um, &model);
                assert!(
                    held < 1.15 * bound,
                    "{lags_s:?} {noise_um}: {lqg:?} {}",
                    held / bound
                );
                let ms = crate::design::margins(&plant, &law).unwrap().ms;
                assert!(ms < 2.0, "{lags_s:?} {noise_um}: {lqg:?} Ms {ms}");
            }
        }
    }

    #[test]
    fn mpc_without_constraints_is_weighted_alike() {
        let plant = behind(&[0.05], false);
        let (lqg, mpc) = (Lqg::for_path(&plant, 1e-3), Mpc::for_path(&plant, 1e-3));
        assert_eq!(mpc.effort, lqg.effort);
        assert_eq!(
            mpc.move_effort / mpc.effort,
            Mpc::default().move_effort / Mpc::default().effort
        );
    }
}
