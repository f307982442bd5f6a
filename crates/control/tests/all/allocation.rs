//! A step of any controller allocates nothing, shown by an allocator that counts; clarabel's are counted and bounded.

use cellpos_control::*;
use cellpos_counting_alloc::allocations;

fn mpc(solver: SolverKind) -> ControllerConfig {
    ControllerConfig::Mpc(
        Mpc {
            solver,
            view_low_um: Some(-20.0),
            view_high_um: Some(20.0),
            ..Mpc::default()
        },
        Pi::new(0.46, 19.5),
    )
}

/// Allocations of each step of a run with steps of the reference under a tight slew limit, lost frames, late frames, a
/// freeze and learning.
fn allocations_by_step(controller: ControllerConfig) -> Vec<u64> {
    let config = LoopConfig {
        model: LoopModel::eq6(2e-3),
        estimator: EstimatorConfig {
            adapt: true,
            ..EstimatorConfig::default()
        },
        controller,
        limits: Limits {
            slew_um_per_s: 1000.0,
            ..Limits::default()
        },
    };
    let mut rig = SimulatedRig::new(RigConfig::eq6(1)).unwrap();
    let mut controller = Controller::new(config).unwrap();
    controller.start(20.0, 20.0);
    let mut preview = vec![0.0; controller.preview_len()];
    let learner = Learner::new(
        LearnConfig::default(),
        5.0,
        1e-3,
        &[HarmonicResponse {
            harmonic: 1,
            re_um_per_um: 0.3,
            im_um_per_um: -5.0,
            relative_uncertainty: 0.5,
        }],
    )
    .unwrap();
    let start = learner.start();
    let mut learning = CycleLearning::new(learner, start);
    let reference = |k: usize| {
        if (k / 100).is_multiple_of(2) {
            0.0
        } else {
            8.0
        }
    };
    (0..1500)
        .map(|k| {
            let mut fix = rig.measure();
            fix.age_samples = u16::from(k % 31 == 5);
            fix.offset_samples = 0.1;
            for (ahead, slot) in (1..).zip(&mut preview) {
                *slot = reference(k + ahead);
            }
            let before = allocations();
            let input = LoopInput {
                measurement: (k % 17 != 3).then_some(fix),
                reference_um: reference(k),
                preview_um: &preview,
                mode: if (700..720).contains(&k) {
                    Mode::Freeze
                } else {
                    Mode::Run
                },
                learned_um: learning.addition_um(Some(k as f64 * 5e-3), reference(k)),
                feed_forward_gain: learning.feed_forward_gain(),
                ..LoopInput::default()
            };
            let out = controller.step(&input);
            learning.learn(Some((fix.position_um, 2.0)), &out.driven);
            let count = allocations() - before;
            rig.advance(out.command_um);
            count
        })
        .collect()
}

#[test]
fn pi_lead_lqg_and_mpc_by_active_set_never_allocate_in_a_step() {
    let lead = Pi {
        lead: Some(Lead {
            zero_hz: 64.0,
            pole_hz: 255.0,
        }),
        ..Pi::new(0.46, 10.0)
    };
    for controller in [
        ControllerConfig::Pi(Pi::new(0.46, 19.5)),
        ControllerConfig::Pi(lead),
        ControllerConfig::Lqg(Lqg::default()),
        mpc(SolverKind::ActiveSet),
    ] {
        let counts = allocations_by_step(controller);
        assert!(counts.iter().all(|n| *n == 0), "{controller:?}");
    }
}

#[test]
fn mpc_by_clarabel_allocates_no_more_than_a_few_times_in_a_step() {
    let counts = allocations_by_step(mpc(SolverKind::Clarabel));
    let (least, most) = (counts.iter().min(), counts.iter().max());
    println!("clarabel: {least:?} to {most:?} allocations a step");
    assert!(most <= Some(&4), "{least:?} to {most:?}");
    assert!(most >= Some(&1), "the count works");
}
