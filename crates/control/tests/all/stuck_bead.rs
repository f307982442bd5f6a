//! A bead that sticks to the wall and comes free again, under every controller.

use cellpos_control::design::{DesignPlant, PiSearch, default_lead, search_pi};
use cellpos_control::*;

fn controllers() -> [(&'static str, ControllerConfig); 5] {
    let pi = Pi::new(0.46, 19.5);
    let mpc = |solver| {
        ControllerConfig::Mpc(
            Mpc {
                solver,
                ..Mpc::default()
            },
            pi,
        )
    };
    let search = PiSearch {
        lead: Some(default_lead(2.5e-3)),
        ..PiSearch::default()
    };
    let lead = search_pi(&DesignPlant::eq6(2.5e-3), search)
        .unwrap()
        .unwrap();
    [
        ("pi", ControllerConfig::Pi(pi)),
        ("lead", ControllerConfig::Pi(lead)),
        ("lqg", ControllerConfig::Lqg(Lqg::default())),
        ("mpc by clarabel", mpc(SolverKind::Clarabel)),
        ("mpc by active set", mpc(SolverKind::ActiveSet)),
    ]
}

/// What is asked of the bead while it is held, and afterwards.
#[derive(Debug, Clone, Copy)]
struct Case {
    target_um: f64,
    held_ticks: u64,
}

/// Largest speed of the bead from its release on (um per tick), whether it was taken for stuck while it was held, and its
/// distance from the target (um, mean of the last 100 ticks) 1.2 s after the release.
fn release(controller: ControllerConfig, case: Case, gain: f64, seed: u64) -> (f64, bool, f64) {
    const STUCK_FROM: u64 = 1000;
    let free_from = STUCK_FROM + case.held_ticks;
    let eq6 = RigConfig::eq6(seed);
    let mut rig = SimulatedRig::new(RigConfig {
        plant: eq6.plant.scaled(gain).unwrap(),
        ..eq6
    })
    .unwrap();
    let mut controller = Controller::new(LoopConfig {
        model: LoopModel::eq6(2e-3),
        estimator: EstimatorConfig::default(),
        controller,
        limits: Limits::default(),
    })
    .unwrap();
    controller.start(20.0, 20.0);
    let (mut last_um, mut fastest_um, mut flagged, mut away_um) = (0.0, 0.0_f64, false, 0.0);
    for k in 0..free_from + 1300 {
        rig.stuck = (STUCK_FROM..free_from).contains(&k);
        let fix = rig.measure();
        let reference_um = if k < STUCK_FROM + 5 {
            0.0
        } else {
            case.target_um
        };
        let input = LoopInput {
            measurement: Some(fix),
            reference_um,
            ..LoopInput::default()
        };
        let out = controller.step(&input);
        let now_um = rig.true_um();
        if k >= free_from {
            fastest_um = fastest_um.max((now_um - last_um).abs());
        } else {
            flagged |= out.flags.stuck;
        }
        if k >= free_from + 1200 {
            away_um += (now_um - case.target_um) / 100.0;
        }
        last_um = now_um;
        rig.advance(out.command_um);
    }
    (fastest_um, flagged, away_um)
}

#[test]
fn a_stuck_bead_that_comes_free_never_moves_faster_than_2_um_per_frame_under_any_controller() {
    // Held for seconds with the target elsewhere: an integrator, or a drift state, would wind up to the end of the range.
    let cases =
        [(0.3, 3000), (3.0, 2000), (-12.0, 1500), (0.0, 4000)].map(|(target_um, held_ticks)| {
            Case {
                target_um,
                held_ticks,
            }
        });
    // The interior-point solver takes ten times as long, and its law is that of the active set.
    for (name, controller) in controllers() {
        let slow = name == "mpc by clarabel";
        for case in cases.iter().skip(if slow { 3 } else { 0 }) {
            let rigs = [(1.0, 0), (1.0, 1), (1.8, 2)];
            for (gain, seed) in rigs.into_iter().take(if slow { 1 } else { 3 }) {
                let (fastest_um, flagged, away_um) = release(controller, *case, gain, seed);
                assert!(
                    fastest_um <= 2.0,
                    "{name}, {case:?}, gain x {gain}, seed {seed}: {fastest_um} um in a frame"
                );
                assert!(
                    flagged || case.target_um == 0.0,
                    "{name}, {case:?}, gain x {gain}, seed {seed}: not taken for stuck"
                );
                assert!(
                    away_um.abs() < 0.6,
                    "{name}, {case:?}, gain x {gain}, seed {seed}: {away_um} um from its target"
                );
            }
        }
    }
}
