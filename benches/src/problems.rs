//! The problems that MPC solves in a loop, for tables of solvers.

use crate::simulated::loop_config;
use cellpos_control::active_set::{QpMatrices, QpVectors, ROWS, VARS};
use cellpos_control::*;
use std::io::Write;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

/// MPC that keeps every problem that it is given.
#[derive(Debug)]
struct Keeping {
    law: MpcLaw,
    kept: Arc<Mutex<Vec<QpVectors>>>,
}

impl ControlLaw for Keeping {
    type State = MpcState;

    fn start(&self, command_um: f64) -> MpcState {
        self.law.start(command_um)
    }

    fn step(&self, state: &mut MpcState, input: &LawInput) -> LawOutput {
        let problem = self.law.problem(input);
        self.kept
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .push(problem);
        self.law.step(state, input)
    }

    fn applied(&self, state: &mut MpcState, input: &LawInput, wish_um: f64, applied_um: f64) {
        self.law.applied(state, input, wish_um, applied_um);
    }

    fn follow(&self, state: &mut MpcState, input: &LawInput, command_um: f64) {
        self.law.follow(state, input, command_um);
    }

    fn preview_len(&self) -> usize {
        self.law.preview_len()
    }
}

/// The law that the tables use, with one of its solvers.
///
/// # Panics
/// A law that cannot be built: a defect.
pub fn law(solver: SolverKind, limits: &Limits) -> MpcLaw {
    let config = Mpc {
        solver,
        ..Mpc::default()
    };
    MpcLaw::new(&config, Pi::new(0.46, 19.5), &LoopModel::eq6(2e-3), limits).expect("a sound law")
}

/// Limits and reference of a loop at rest, or of one at a limit in most ticks: 1 um/ms, and a jump of 16 um every 14 ms, about
/// the time that this slew needs.
pub fn terms(constrained: bool) -> (Limits, impl Fn(u64) -> f64) {
    let limits = Limits {
        slew_um_per_s: if constrained { 1000.0 } else { 10_000.0 },
        ..Limits::default()
    };
    let reference = move |k: u64| {
        if !constrained || (k / 14).is_multiple_of(2) {
            0.0
        } else {
            16.0
        }
    };
    (limits, reference)
}

/// The problems of a number of ticks of a loop on the simulated rig.
///
/// # Panics
/// A rig or a loop that cannot be built: a defect.
pub fn collect(constrained: bool, ticks: u64) -> Vec<QpVectors> {
    let (limits, reference) = terms(constrained);
    let kept = Arc::new(Mutex::new(Vec::new()));
    let config = LoopConfig {
        limits,
        ..loop_config(ControllerConfig::Lqg(Lqg::default()))
    };
    let law = Keeping {
        law: law(SolverKind::ActiveSet, &limits),
        kept: Arc::clone(&kept),
    };
    let mut controller = Controller::with_law(config.with(law)).expect("a sound loop");
    controller.start(20.0, 20.0);
    let mut rig = SimulatedRig::new(RigConfig::eq6(1)).expect("the nominal rig");
    let mut preview = vec![0.0; controller.preview_len()];
    for k in 0..ticks {
        for (ahead, slot) in (1..).zip(&mut preview) {
            *slot = reference(k + ahead);
        }
        let fix = rig.measure();
        let input = LoopInput {
            measurement: Some(fix),
            reference_um: reference(k),
            preview_um: &preview,
            ..LoopInput::default()
        };
        rig.advance(controller.step(&input).command_um);
    }
    drop(controller);
    std::mem::take(&mut *kept.lock().unwrap_or_else(PoisonError::into_inner))
}

/// Writes problems as lines of numbers. First the numbers of variables, rows and problems, then the Hessian and the rows. Then
/// for each problem the linear term, lower and upper bounds (1e5 and more: absent), and the first move of the active set.
///
/// # Errors
/// A file that cannot be written.
pub fn write(
    path: &Path,
    matrices: &QpMatrices,
    problems: &[QpVectors],
    solved: &[TimedSolve],
) -> std::io::Result<()> {
    let mut out = std::io::BufWriter::new(std::fs::File::create(path)?);
    let line = |out: &mut dyn Write, values: &mut dyn Iterator<Item = f64>| {
        for value in values {
            write!(out, "{value:e} ")?;
        }
        writeln!(out)
    };
    writeln!(out, "{VARS} {ROWS} {}", problems.len())?;
    for row in matrices.hessian.row_iter().chain(matrices.rows.row_iter()) {
        line(&mut out, &mut row.iter().copied())?;
    }
    for (problem, solved) in problems.iter().zip(solved) {
        let bounds = problem.low.iter().chain(&problem.high);
        let all = problem.linear.iter().chain(bounds).copied();
        line(
            &mut out,
            &mut all.chain([solved.first_um.unwrap_or(f64::NAN)]),
        )?;
    }
    out.flush()
}
