//! Cost of an MPC tick at 1 kHz: clarabel and the active-set solver, easy and constrained, compared with a bare loop.
//!
//!     cargo bench -p cellpos-benches --bench solvers              60 s each
//!     cargo bench -p cellpos-benches --bench solvers -- 10        10 s each
//!     cargo bench -p cellpos-benches --bench solvers -- --problems FOLDER
//!     scripts/solvers-beside.py FOLDER                            the same problems by solvers with a Python interface
//!
//! The third solves the problems of 20 s of each loop one after another, without a loop around it, and writes them into the folder.
//!
//! Each tick sleeps to its due time, then takes one step of the whole controller on the simulated rig: estimator, reference,
//! problem, solver, fallback, limits. Only the step is timed. `easy` holds a position. `constrained`
//! allows 1 um/ms and lets the reference jump so that most ticks are at a bound. The competitor is the same loop with LQG,
//! which solves nothing, and a bare absolute-sleep loop of the same policy.

use cellpos_benches::problems;
use cellpos_control::*;
use cellpos_rig::clock::{monotonic_ns, sleep_until_ns};
use cellpos_runtime::latency::Latency;
use cellpos_runtime::realtime::{self, bare_loop};
use std::path::Path;
use std::time::{Duration, Instant};

const PERIOD_NS: i64 = 1_000_000;
/// What the solver may use of a tick.
const DEADLINE: Duration = Duration::from_micros(170);

struct Outcome {
    step: Latency,
    solve: Latency,
    ticks: u64,
    at_bound: u64,
    stopped: u64,
    reused: u64,
    fallbacks: u64,
    iterations: u64,
}

fn run(controller: ControllerConfig, constrained: bool, seconds: u64) -> Outcome {
    let (limits, reference) = problems::terms(constrained);
    let config = LoopConfig {
        model: LoopModel::eq6(2e-3),
        estimator: EstimatorConfig::default(),
        controller,
        limits,
    };
    let mut rig = SimulatedRig::new(RigConfig::eq6(1)).expect("the nominal rig");
    let mut controller = Controller::new(config).expect("a sound controller");
    controller.start(20.0, 20.0);
    let mut preview = vec![0.0; controller.preview_len()];
    let mut out = Outcome {
        step: Latency::new(),
        solve: Latency::new(),
        ticks: seconds * 1000,
        at_bound: 0,
        stopped: 0,
        reused: 0,
        fallbacks: 0,
        iterations: 0,
    };
    let start = monotonic_ns() + PERIOD_NS;
    for k in 0..out.ticks {
        sleep_until_ns((start + k as i64 * PERIOD_NS).max(monotonic_ns()));
        let fix = rig.measure();
        let from = Instant::now();
        for (ahead, slot) in (1..).zip(&mut preview) {
            *slot = reference(k + ahead);
        }
        let input = LoopInput {
            measurement: Some(fix),
            reference_um: reference(k),
            preview_um: &preview,
            solver: SolverTerms::Until(from + DEADLINE),
            ..LoopInput::default()
        };
        let done = controller.step(&input);
        out.step.record(from.elapsed().as_nanos() as u64, k);
        out.solve.record(u64::from(done.solver.solve_ns), k);
        out.at_bound += u64::from(done.solver.active > 0);
        out.stopped += u64::from(done.solver.status == SolverStatus::Feasible);
        out.reused += u64::from(done.solver.status == SolverStatus::PreviousPlan);
        out.fallbacks += u64::from(done.solver.status == SolverStatus::FallbackPi);
        out.iterations += u64::from(done.solver.iterations);
        rig.advance(done.command_um);
    }
    out
}

fn bare(seconds: u64) {
    let (latency, missed) = bare_loop(Duration::from_secs(seconds), |_| {});
    let q = latency.quantiles_us();
    println!(
        "{:<28} wake-up p50 {:>6.1}  p99 {:>6.1}  p99.9 {:>6.1}  max {:>7.1} us, {missed} periods missed",
        "bare loop", q.p50, q.p99, q.p999, q.max
    );
}

/// The problems of both loops by both solvers, one after another, and into files.
fn stored(folder: &Path) -> std::io::Result<()> {
    std::fs::create_dir_all(folder)?;
    for (name, constrained) in [("easy", false), ("constrained", true)] {
        let all = problems::collect(constrained, 20_000);
        let (limits, _) = problems::terms(constrained);
        let solved = [SolverKind::ActiveSet, SolverKind::Clarabel].map(|solver| {
            let law = problems::law(solver, &limits);
            let solved = law.solve_timed(&all);
            let mut latency = Latency::new();
            let mut iterations = 0;
            for (k, one) in (0..).zip(&solved) {
                latency.record(one.took.as_nanos() as u64, k);
                iterations += u64::from(one.iterations);
            }
            let q = latency.quantiles_us();
            println!(
                "{:<28} alone   p50 {:>6.1}  p99 {:>6.1}  p99.9 {:>6.1}  max {:>7.1} us, {:.1} iterations",
                format!("{solver:?}, {name}"),
                q.p50,
                q.p99,
                q.p999,
                q.max,
                iterations as f64 / solved.len() as f64
            );
            solved
        });
        let off = solved[0]
            .iter()
            .zip(&solved[1])
            .filter_map(|(a, b)| Some((a.first_um? - b.first_um?).abs()));
        println!(
            "{:<28} largest difference of the first move {:.2e} um",
            "",
            off.fold(0.0, f64::max)
        );
        let law = problems::law(SolverKind::ActiveSet, &limits);
        problems::write(
            &folder.join(format!("{name}.txt")),
            law.matrices(),
            &all,
            &solved[0],
        )?;
    }
    Ok(())
}

fn main() {
    let mut arguments = std::env::args().skip_while(|argument| argument != "--problems");
    if arguments.next().is_some() {
        let folder = arguments.next().expect("a folder after --problems");
        stored(Path::new(&folder)).expect("files that can be written");
        return;
    }
    let seconds = std::env::args()
        .skip(1)
        .find_map(|argument| argument.parse().ok())
        .unwrap_or(60);
    let mpc = |solver| {
        ControllerConfig::Mpc(
            Mpc {
                solver,
                ..Mpc::default()
            },
            Pi::new(0.46, 19.5),
        )
    };
    let work = move || {
        let conditions = realtime::apply(&realtime::Request::control_thread());
        print!("{conditions}");
        bare(seconds);
        for (name, controller) in [
            ("lqg", ControllerConfig::Lqg(Lqg::default())),
            ("active set", mpc(SolverKind::ActiveSet)),
            ("clarabel", mpc(SolverKind::Clarabel)),
        ] {
            for constrained in [false, true] {
                let o = run(controller, constrained, seconds);
                let kind = if constrained { "constrained" } else { "easy" };
                for (what, latency) in [("step ", &o.step), ("solve", &o.solve)] {
                    let q = latency.quantiles_us();
                    println!(
                        "{:<28} {what}   p50 {:>6.1}  p99 {:>6.1}  p99.9 {:>6.1}  max {:>7.1} us",
                        format!("{name}, {kind}"),
                        q.p50,
                        q.p99,
                        q.p999,
                        q.max
                    );
                }
                println!(
                    "{:<28} {:.0} % of {} ticks at a bound, {:.1} iterations, {} stopped (best feasible point), {} plans reused, {} PI",
                    "",
                    100.0 * o.at_bound as f64 / o.ticks as f64,
                    o.ticks,
                    o.iterations as f64 / o.ticks as f64,
                    o.stopped,
                    o.reused,
                    o.fallbacks
                );
            }
        }
        bare(seconds);
    };
    std::thread::spawn(work).join().expect("a loop that ends");
}
