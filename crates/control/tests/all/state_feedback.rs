//! LQG and MPC on the simulated rig: hold at the bound, steps, previewed sines, both solvers, the spread.

use crate::common::{config, mpc};
use cellpos_control::design::{
    DesignPlant, bound_rms_um, margins, noise_figures, spread, step_figures,
};
use cellpos_control::*;

/// RMS of the true error from tick `from` on.
fn rms_um(config: LoopConfig, rig: RigConfig, profile: &Profile, ticks: u64, from: u64) -> f64 {
    let mut rig = SimulatedRig::new(rig).unwrap();
    let mut controller = Controller::new(config).unwrap();
    controller.start(20.0, 20.0);
    let mut preview = vec![0.0; controller.preview_len()];
    let (mut sum, mut n) = (0.0, 0.0);
    for k in 0..ticks {
        let reference_um = profile.at_um(k as f64 * 1e-3);
        fill_preview(profile, k, 1e-3, &mut preview);
        if k >= from {
            sum += (rig.true_um() - reference_um).powi(2);
            n += 1.0;
        }
        let input = LoopInput {
            measurement: Some(rig.measure()),
            reference_um,
            preview_um: &preview,
            ..LoopInput::default()
        };
        let out = controller.step(&input);
        rig.advance(out.command_um);
    }
    f64::sqrt(sum / n)
}

const HOLD: Profile = Profile::Hold { position_um: 0.0 };

fn sine(amplitude_um: f64, frequency_hz: f64) -> Profile {
    Profile::Wave {
        shape: Shape::Sine,
        centre_um: 0.0,
        amplitude_um,
        frequency_hz,
        fade_s: 0.2,
    }
}

#[test]
fn lqg_and_mpc_hold_within_1_12_times_the_noise_free_minimum_variance_bound() {
    let bound = bound_rms_um(0.33, 0.0, 2e-3, 1e-3);
    for controller in [
        ControllerConfig::Lqg(Lqg::default()),
        mpc(SolverKind::ActiveSet),
    ] {
        let squares: [f64; 5] = std::array::from_fn(|seed| {
            let rig = RigConfig::eq6(seed as u64);
            (rms_um(config(controller), rig, &HOLD, 12_000, 2000) / bound).powi(2)
        });
        // Half a minute tells the RMS to about 1 %: the scatter of the five runs says how well.
        let mean = squares.iter().sum::<f64>() / 5.0;
        let variance = squares.iter().map(|s| (s - mean).powi(2)).sum::<f64>() / 4.0;
        let least = (mean - 2.0 * (variance / 5.0).sqrt()).sqrt();
        assert!(
            least <= 1.12,
            "{controller:?}: {} of the bound",
            mean.sqrt()
        );
    }
}

#[test]
fn the_linear_equivalent_predicts_the_hold_error_and_is_stable_over_the_spread() {
    let plant = DesignPlant::eq6(2.5e-3);
    for controller in [
        ControllerConfig::Lqg(Lqg::default()),
        mpc(SolverKind::ActiveSet),
    ] {
        let law = controller
            .linear(&EstimatorConfig::default(), &LoopModel::eq6(2e-3))
            .unwrap();
        let m = margins(&plant, &law).unwrap();
        let predicted = noise_figures(&plant, &law).unwrap().unwrap().rms_um;
        let simulated = rms_um(config(controller), RigConfig::eq6(1), &HOLD, 42_000, 2000);
        for row in spread(&plant, &law).unwrap() {
            assert!(row.margins.stable, "{controller:?}: {row:?}");
        }
        assert!(m.stable);
        assert!(
            (simulated / predicted - 1.0).abs() < 0.05,
            "{controller:?}: {simulated} against {predicted}"
        );
    }
}

/// The more exact the fixes, the more of the state feedback and the less of the filter is in the loop: the default weights
/// must hold for the one as for the other.
#[test]
fn the_margins_over_the_spread_do_not_hang_on_how_exact_the_fixes_are() {
    let plant = DesignPlant::eq6(2.5e-3);
    println!("fix nm  LTR  hold nm  Ms  at twice the gain and one more sample");
    for fix_noise_um in [0.0006, 0.02, 0.06] {
        for controller in [
            ControllerConfig::Lqg(Lqg::default()),
            mpc(SolverKind::ActiveSet),
        ] {
            let figures = |ltr_noise_scaling| {
                let estimator = EstimatorConfig {
                    fix_noise_um,
                    ltr_noise_scaling,
                    ..EstimatorConfig::default()
                };
                let plant = DesignPlant {
                    fix_noise_um,
                    ..plant.clone()
                };
                let law = controller
                    .linear(&estimator, &LoopModel::eq6(2e-3))
                    .unwrap();
                let rows = spread(&plant, &law).unwrap();
                assert!(rows.iter().all(|row| row.margins.stable), "{rows:?}");
                let hold = noise_figures(&plant, &law).unwrap().unwrap().rms_um;
                let (own, worst) = (margins(&plant, &law).unwrap().ms, rows[9].margins.ms);
                println!(
                    "{:.1}  {ltr_noise_scaling}  {:.2}  {own:.2}  {worst:.1}",
                    fix_noise_um * 1e3,
                    hold * 1e3
                );
                (hold, own, worst)
            };
            let (kalman, (hold, own, worst)) = (
                figures(1.0),
                figures(EstimatorConfig::default().ltr_noise_scaling),
            );
            assert!(own < 1.6 && worst < 16.0, "{own} {worst}");
            // What loop transfer recovery costs in hold error, at any noise, is less than the effort costs.
            assert!(hold < 1.01 * kalman.0, "{hold} against {}", kalman.0);
        }
    }
}

#[test]
fn previewed_sines_of_5_um_are_followed_within_1_5_times_the_hold_error() {
    for controller in [
        ControllerConfig::Lqg(Lqg::default()),
        mpc(SolverKind::ActiveSet),
    ] {
        let hold = rms_um(config(controller), RigConfig::eq6(4), &HOLD, 8000, 2000);
        for frequency_hz in [50.0, 100.0] {
            let rms = rms_um(
                config(controller),
                RigConfig::eq6(4),
                &sine(5.0, frequency_hz),
                8000,
                2000,
            );
            assert!(
                rms <= 1.5 * hold,
                "{controller:?} at {frequency_hz} Hz: {rms} against {hold}"
            );
        }
    }
}

#[test]
fn mpc_settles_a_10_um_step_to_2_percent_within_10_ms() {
    for solver in [SolverKind::Clarabel, SolverKind::ActiveSet] {
        let f = step_figures(&DesignPlant::eq6(2.5e-3), &config(mpc(solver)), 10.0).unwrap();
        assert!(
            f.settling_2_percent_s <= 0.010 && f.overshoot_percent < 5.0,
            "{solver:?}: {f:?}"
        );
    }
}

#[test]
fn mpc_takes_a_10_um_step_within_the_limits_on_the_noisy_rig_for_any_seed() {
    for (solver, seed) in [SolverKind::Clarabel, SolverKind::ActiveSet]
        .into_iter()
        .flat_map(|solver| (0..5).map(move |seed| (solver, seed)))
    {
        let config = config(mpc(solver));
        let limits = config.limits;
        let mut controller = Controller::new(config).unwrap();
        let mut rig = SimulatedRig::new(RigConfig::eq6(seed)).unwrap();
        controller.start(20.0, 20.0);
        let mut last_um = controller.previous_command_um();
        let mut after = Vec::new();
        for k in 0..360 {
            let reference_um = if k < 300 { 0.0 } else { 10.0 };
            if k >= 300 {
                after.push(rig.true_um() - 10.0);
            }
            let input = LoopInput {
                measurement: Some(rig.measure()),
                reference_um,
                preview_um: &[reference_um],
                ..LoopInput::default()
            };
            let out = controller.step(&input);
            assert!((limits.low_um..=limits.high_um).contains(&out.command_um));
            assert!((out.command_um - last_um).abs() <= limits.slew_um_per_s * 1e-3 + 1e-9);
            assert_eq!(out.solver.status, SolverStatus::Solved);
            last_um = out.command_um;
            rig.advance(out.command_um);
        }
        let settled = after.iter().rposition(|e| e.abs() > 0.2).unwrap() + 1;
        let overshoot = after.iter().copied().fold(0.0, f64::max);
        assert!(
            settled <= 10 && overshoot < 0.5,
            "{solver:?}, seed {seed}: {settled} ms, {overshoot} um"
        );
    }
}

/// Holds, then steps by 5 um under a slew that binds; with a rig the time is up at once in some ticks, without one the
/// ticks end as they are told.
fn hurried(
    solver: SolverKind,
    mut rig: Option<&mut SimulatedRig>,
    told: &[(Measurement, SolverReport)],
) -> Vec<((Measurement, SolverReport), u64)> {
    let mut tight = config(mpc(solver));
    tight.limits.slew_um_per_s = 1000.0;
    let mut controller = Controller::new(tight).unwrap();
    controller.start(20.0, 20.0);
    (0..80)
        .map(|k| {
            let late = k % 7 == 3 || k > 60;
            let (fix, solver) = match (&mut rig, told.get(k)) {
                (Some(rig), _) => {
                    let most = std::time::Duration::from_millis(if late { 0 } else { 10_000 });
                    let until = SolverTerms::Until(std::time::Instant::now() + most);
                    (rig.measure(), until)
                }
                (None, Some((fix, report))) => (
                    *fix,
                    SolverTerms::Recorded(report.status, report.iterations as u8),
                ),
                (None, None) => unreachable!("as many as were recorded"),
            };
            let input = LoopInput {
                measurement: Some(fix),
                reference_um: if (k / 5) % 2 == 0 { 0.0 } else { 9.0 },
                solver,
                ..LoopInput::default()
            };
            let out = controller.step(&input);
            if let Some(rig) = &mut rig {
                rig.advance(out.command_um);
            }
            ((fix, out.solver), out.command_um.to_bits())
        })
        .collect()
}

#[test]
fn a_solver_out_of_time_gives_its_best_feasible_point_and_replays_to_the_bit() {
    for solver in [SolverKind::Clarabel, SolverKind::ActiveSet] {
        let mut rig = SimulatedRig::new(RigConfig::eq6(1)).unwrap();
        let recorded = hurried(solver, Some(&mut rig), &[]);
        let (told, commands): (Vec<_>, Vec<_>) = recorded.into_iter().unzip();
        let ends = |status| told.iter().filter(|(_, r)| r.status == status).count();
        let feasible = ends(SolverStatus::Feasible);
        assert!(feasible > 5, "{solver:?}: {feasible}");
        assert_eq!(
            ends(SolverStatus::PreviousPlan) + ends(SolverStatus::FallbackPi),
            0
        );
        let again: Vec<u64> = hurried(solver, None, &told)
            .into_iter()
            .map(|t| t.1)
            .collect();
        assert_eq!(again, commands, "{solver:?}");
    }
}

/// Hold error and the time to 0.2 um of a step of 8 um, ticks, where the slew binds; `none_in_time`: the deadline is always
/// past.
fn under_slew(solver: SolverKind, none_in_time: bool) -> (f64, usize) {
    let mut tight = config(mpc(solver));
    tight.limits.slew_um_per_s = 1000.0;
    let mut controller = Controller::new(tight).unwrap();
    controller.start(20.0, 20.0);
    let mut rig = SimulatedRig::new(RigConfig::eq6(4)).unwrap();
    let (mut sum, mut settled) = (0.0, 0);
    for k in 0..2200_usize {
        let reference_um = if k < 2000 { 0.0 } else { 8.0 };
        if (500..2000).contains(&k) {
            sum += rig.true_um().powi(2) / 1500.0;
        }
        if k >= 2000 && (rig.true_um() - 8.0).abs() > 0.2 {
            settled = k - 1999;
        }
        let input = LoopInput {
            measurement: Some(rig.measure()),
            reference_um,
            solver: if none_in_time {
                SolverTerms::Until(std::time::Instant::now())
            } else {
                SolverTerms::Unlimited
            },
            ..LoopInput::default()
        };
        let out = controller.step(&input);
        rig.advance(out.command_um);
    }
    (sum.sqrt(), settled)
}

#[test]
fn a_solver_that_is_never_in_time_holds_as_well_and_steps_little_worse() {
    let (hold, settled) = under_slew(SolverKind::ActiveSet, false);
    for solver in [SolverKind::Clarabel, SolverKind::ActiveSet] {
        let (late_hold, late_settled) = under_slew(solver, true);
        assert!(
            (late_hold / hold - 1.0).abs() < 0.02,
            "{solver:?}: {late_hold} of {hold} um"
        );
        assert!(
            late_settled <= settled + 4,
            "{solver:?}: {late_settled} of {settled} ticks"
        );
    }
}

/// Time until an announced step of 10 um stays within 2 %, ms, and how far it goes past its end, um; 5 nm fixes, or noise-free; with the range
/// and slew of the default limits at any rate.
fn announced_step(
    controller: ControllerConfig,
    sample_time_s: f64,
    seed: Option<u64>,
) -> (f64, f64) {
    let at = (0.5 / sample_time_s).round() as u64;
    let base = config(controller);
    let config = LoopConfig {
        model: LoopModel {
            sample_time_s,
            ..LoopModel::eq6(2.0 * sample_time_s)
        },
        estimator: EstimatorConfig {
            fix_noise_um: 0.005,
            ..base.estimator
        },
        ..base
    };
    let eq6 = RigConfig {
        sample_time_s,
        delay_s: 2.0 * sample_time_s,
        fix_noise_um: 0.005,
        ..RigConfig::eq6(seed.unwrap_or(0))
    };
    let quiet = seed.is_none();
    let mut rig = SimulatedRig::new(if quiet { eq6.noise_free() } else { eq6 }).unwrap();
    let mut controller = Controller::new(config).unwrap();
    controller.start(20.0, 20.0);
    let mut preview = vec![0.0; controller.preview_len()];
    let step = |k: u64| if k >= at { 10.0 } else { 0.0 };
    let (mut last, mut past_um) = (at, 0.0_f64);
    for k in 0..at + (0.06 / sample_time_s) as u64 {
        let off_um = rig.true_um() - step(k);
        if k >= at {
            past_um = past_um.max(off_um);
            if off_um.abs() > 0.2 {
                last = k + 1;
            }
        }
        for (ahead, slot) in (1..).zip(&mut preview) {
            *slot = step(k + ahead);
        }
        let input = LoopInput {
            measurement: Some(rig.measure()),
            reference_um: step(k),
            preview_um: &preview,
            ..LoopInput::default()
        };
        let before_um = controller.previous_command_um();
        let output = controller.step(&input);
        let most_um = config.limits.slew_um_per_s * sample_time_s + 1e-9;
        assert!((output.command_um - before_um).abs() <= most_um && !output.flags.range_limited);
        rig.advance(output.command_um);
    }
    ((last - at) as f64 * sample_time_s * 1e3, past_um)
}

#[test]
fn an_announced_step_is_as_fast_as_range_and_slew_allow_and_does_not_go_past_its_end() {
    for controller in [
        ControllerConfig::Lqg(Lqg::default()),
        mpc(SolverKind::ActiveSet),
    ] {
        for (sample_time_s, most_ms) in [(1e-3, 3.0), (0.5e-3, 3.0), (0.2e-3, 3.0)] {
            let (ms, past_um) = announced_step(controller, sample_time_s, None);
            assert!(
                ms <= most_ms && past_um < 0.1,
                "{controller:?}, {sample_time_s} s: {ms} ms, {past_um} um past"
            );
        }
        for seed in 0..5 {
            // Brownian motion leaves a band of four standard deviations now and then: only the end is asked for.
            let (_, past_um) = announced_step(controller, 1e-3, Some(seed));
            assert!(past_um < 0.4, "{controller:?}: {past_um} um past");
        }
    }
}

#[test]
fn an_announced_step_takes_hardly_longer_than_the_slew_at_any_rate() {
    // 98 % of 10 um cannot be made in less than 2.8 ms with 10,000 um/s.
    for (sample_time_s, most_ms) in [(1e-3, 4.0), (0.5e-3, 3.5), (0.2e-3, 3.0)] {
        let laws = [
            ControllerConfig::Lqg(Lqg::default()),
            mpc(SolverKind::ActiveSet),
        ];
        for controller in laws {
            let steps = (0..5).map(|seed| announced_step(controller, sample_time_s, Some(seed)));
            let (ms, over_um) = steps.fold((0.0, 0.0), |worst: (f64, f64), step| {
                (worst.0.max(step.0), worst.1.max(step.1))
            });
            println!("{sample_time_s} s: {ms:.1} ms, {over_um:.2} um");
            assert!(
                ms <= most_ms + 1e-9,
                "{controller:?}, {sample_time_s} s: {ms} ms"
            );
            assert!(over_um < 0.5, "{controller:?}: {over_um} um");
        }
    }
}
