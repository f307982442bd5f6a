//! The active-set solver against clarabel on random condensed problems, and against the optimality conditions.

use cellpos_control::active_set::{QpEnd, QpMatrices, QpVectors, ROWS, Stop, VARS, WorkingSet};
use cellpos_control::*;
use cellpos_numeric::Random;
use clarabel::algebra::CscMatrix;
use clarabel::solver::{
    DefaultSettingsBuilder, DefaultSolver, IPSolver, SolverStatus, SupportedConeT,
};
use nalgebra::DMatrix;

fn uniform(random: &mut Random, low: f64, high: f64) -> f64 {
    low + (high - low) * random.uniform()
}

/// Matrices of the shape of MPC: bounds on each variable, on differences, and on random mixtures.
fn matrices(random: &mut Random) -> QpMatrices {
    let root = DMatrix::from_fn(VARS, VARS, |i, j| {
        if j <= i {
            uniform(random, -1.0, 1.0)
        } else {
            0.0
        }
    });
    let hessian = &root * root.transpose() + DMatrix::identity(VARS, VARS) * 0.05;
    let mut rows = DMatrix::zeros(ROWS, VARS);
    for b in 0..VARS {
        rows[(b, b)] = 1.0;
        rows[(VARS + b, b)] = 1.0;
        if b > 0 {
            rows[(VARS + b, b - 1)] = -1.0;
        }
        for j in 0..=b {
            rows[(2 * VARS + b, j)] = uniform(random, 0.0, 0.5);
        }
    }
    QpMatrices::new(hessian, rows).unwrap()
}

/// Bounds that a random point keeps, some of them exactly, so that rows are often active together and dependent.
fn vectors(m: &QpMatrices, random: &mut Random) -> QpVectors {
    let mut inside = [0.0; VARS];
    let step = uniform(random, 0.1, 1.0);
    for b in 0..VARS {
        let before = if b > 0 { inside[b - 1] } else { 0.0 };
        inside[b] = (before + uniform(random, -1.2, 1.2) * step)
            .clamp(before - step, before + step)
            .clamp(-1.0, 1.0);
    }
    let mut v = QpVectors {
        linear: [0.0; VARS],
        low: [-1e6; ROWS],
        high: [1e6; ROWS],
    };
    v.linear
        .iter_mut()
        .for_each(|f| *f = uniform(random, -8.0, 8.0));
    for b in 0..VARS {
        (v.low[b], v.high[b]) = (-1.0, 1.0);
        (v.low[VARS + b], v.high[VARS + b]) = (-step, step);
        if uniform(random, 0.0, 1.0) < 0.3 {
            let at: f64 = (0..VARS)
                .map(|j| m.rows[(2 * VARS + b, j)] * inside[j])
                .sum();
            v.high[2 * VARS + b] = at + uniform(random, 0.0, 0.2);
        }
    }
    v
}

fn reference_solver(m: &QpMatrices, tolerance: f64) -> DefaultSolver<f64> {
    let dense = |rows: usize, at: &dyn Fn(usize, usize) -> f64, upper: bool| {
        let (mut starts, mut indices, mut values) = (vec![0], Vec::new(), Vec::new());
        for j in 0..VARS {
            for i in (0..rows).filter(|i| !upper || *i <= j) {
                indices.push(i);
                values.push(at(i, j));
            }
            starts.push(indices.len());
        }
        CscMatrix::new(rows, VARS, starts, indices, values)
    };
    let p = dense(VARS, &|i, j| m.hessian[(i, j)], true);
    let a = dense(
        2 * ROWS,
        &|i, j| {
            if i < ROWS {
                m.rows[(i, j)]
            } else {
                -m.rows[(i - ROWS, j)]
            }
        },
        false,
    );
    let settings = DefaultSettingsBuilder::default()
        .verbose(false)
        .presolve_enable(false)
        .tol_gap_abs(tolerance)
        .tol_gap_rel(tolerance)
        .tol_feas(tolerance)
        .build()
        .unwrap();
    let cones = [SupportedConeT::NonnegativeConeT(2 * ROWS)];
    DefaultSolver::new(&p, &[0.0; VARS], &a, &[1.0; 2 * ROWS], &cones, settings).unwrap()
}

#[test]
fn the_active_set_solver_agrees_with_clarabel_to_1_nm_in_the_first_move() {
    agrees_with_clarabel(1_000);
}

#[test]
#[ignore = "minutes: the fast one has a hundredth of the problems"]
fn the_active_set_solver_agrees_with_clarabel_in_100_000_problems() {
    agrees_with_clarabel(100_000);
}

fn agrees_with_clarabel(problems: usize) {
    let mut random = Random::new(5);
    let (mut solved, mut infeasible, mut constrained) = (0, 0, 0);
    let mut largest_um: f64 = 0.0;
    let mut set = WorkingSet::default();
    let mut m = matrices(&mut random);
    // Where a degenerate problem stops the tight one short of its tolerance, clarabel's own default is asked.
    let references = |m: &QpMatrices| [1e-11, 1e-8].map(|t| reference_solver(m, t));
    let mut reference = references(&m);
    let mut loose = 0;
    for k in 0..problems {
        if k % 500 == 0 {
            m = matrices(&mut random);
            reference = references(&m);
            set = WorkingSet::default();
        }
        let v = vectors(&m, &mut random);
        // The working set of an unrelated problem is the worst warm start there is.
        let (end, _) = m.solve(&v, &mut set, Stop::default());
        let bounds: Vec<f64> = v
            .high
            .iter()
            .map(|h| h.min(50.0))
            .chain(v.low.iter().map(|l| -l.max(-50.0)))
            .collect();
        let [tight, default] = &mut reference;
        let solve = |solver: &mut DefaultSolver<f64>| {
            solver.update_q(&v.linear.to_vec()).unwrap();
            solver.update_b(&bounds).unwrap();
            solver.solve();
            solver.solution.status
        };
        let mut status = solve(tight);
        let mut first = tight.solution.x[0];
        if status == SolverStatus::InsufficientProgress {
            loose += 1;
            status = solve(default);
            first = default.solution.x[0];
        }
        match (end, status) {
            (QpEnd::Solved(w), SolverStatus::Solved | SolverStatus::AlmostSolved) => {
                solved += 1;
                constrained += usize::from(!set.is_empty());
                let difference = (w[0] - first).abs();
                largest_um = largest_um.max(difference);
                assert!(difference < 1e-3, "problem {k}: {difference} um");
            }
            (
                QpEnd::Infeasible,
                SolverStatus::PrimalInfeasible | SolverStatus::AlmostPrimalInfeasible,
            ) => infeasible += 1,
            (end, status) => panic!("problem {k}: {end:?} against {status:?}"),
        }
    }
    println!(
        "{solved} solved, {constrained} of them with active rows, {infeasible} infeasible; largest difference {largest_um:e} um; {loose} at clarabel's default tolerance"
    );
    assert!(
        solved > problems * 9 / 10 && constrained > problems / 2,
        "{solved} {constrained} {infeasible}"
    );
}

#[test]
fn a_problem_without_a_point_within_its_bounds_is_called_infeasible() {
    let mut random = Random::new(1);
    let m = matrices(&mut random);
    let mut v = vectors(&m, &mut random);
    // Two neighbours are held apart further than their slew allows.
    (v.low[0], v.high[0], v.low[1], v.high[1]) = (0.9, 1.0, -1.0, -0.9);
    (v.low[VARS + 1], v.high[VARS + 1]) = (-0.5, 0.5);
    let (end, _) = m.solve(&v, &mut WorkingSet::default(), Stop::default());
    assert_eq!(end, QpEnd::Infeasible);
}

#[test]
fn both_solvers_steer_the_same_course_through_active_limits() {
    let limits = Limits {
        slew_um_per_s: 1000.0,
        ..Limits::default()
    };
    let run = |solver| {
        let controller = ControllerConfig::Mpc(
            Mpc {
                solver,
                ..Mpc::default()
            },
            Pi::new(0.46, 19.5),
        );
        let config = LoopConfig {
            model: LoopModel::eq6(2e-3),
            estimator: EstimatorConfig::default(),
            controller,
            limits,
        };
        let mut controller = Controller::new(config).unwrap();
        let mut rig = SimulatedRig::new(RigConfig::eq6(3)).unwrap();
        controller.start(20.0, 20.0);
        let mut active = 0;
        let course: Vec<f64> = (0..600)
            .map(|k| {
                let reference_um = if (k / 40) % 2 == 0 { 0.0 } else { 8.0 };
                let input = LoopInput {
                    measurement: Some(rig.measure()),
                    reference_um,
                    ..LoopInput::default()
                };
                let out = controller.step(&input);
                active += usize::from(out.solver.active > 0);
                assert_eq!(
                    out.solver.status,
                    cellpos_control::SolverStatus::Solved,
                    "tick {k}"
                );
                rig.advance(out.command_um);
                out.command_um
            })
            .collect();
        assert!(
            active > 90,
            "{solver:?}: limits are active in {active} ticks"
        );
        course
    };
    let (a, b) = (run(SolverKind::Clarabel), run(SolverKind::ActiveSet));
    for (k, (a, b)) in a.iter().zip(&b).enumerate() {
        assert!((a - b).abs() < 5e-3, "tick {k}: {a} against {b}");
    }
}
